"""Checked neighbouring frames of a drive; unusable ones are left out with a warning. See ``inpaint.neighbours``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import is_rigid
from arbiview_aug.errors import ArbiviewError, SampleError, SampleTypeError, shown
from arbiview_aug.sample.calibration import NUMBERS, as_array, numbers, read_rig
from arbiview_aug.sample.frame import Frame, Neighbour
from arbiview_aug.scene.boxes import checked_boxes, moved_by, points_in
from arbiview_aug.scene.surface import Points

MAX_NEIGHBOURS = 120  # frame numbers are int8
STILL_M, STILL_DEG = 0.1, 0.5  # a frame with less motion than this sees what the current one sees
MAX_SWEEPS = 2  # nearest neighbours whose LiDAR points are used: more take time and hardly help
MAX_TRAVEL_M = 60.0  # largest distance to a neighbour: from farther away it does not see the ground nearby
MAX_SPEED_MPS = 80.0
MAX_TILT_DEG = 6.0  # largest angle between two roads that share one plane: ramps have 5 degrees
_MAX_MOUNTING_M, _MAX_MOUNTING_DEG = 1.5, 10.0
"""Largest change of a camera's pose; allows for ego motion between exposures."""

Warn = Callable[[str, str], None]  # warns of a topic with a message, once per topic


def read_neighbours(frame: Frame, entries: Any, sample: Mapping[str, Any], warn: Warn) -> tuple[Neighbour, ...]:
    """Read the neighbours of a frame, nearest first, of two at one distance the one behind.

    ``sample`` is the frame's, without leading dimensions. ``entries`` is a list of mappings, each another frame of the
    same rig: ``images``; ``ego2ego`` (4, 4), its ego frame to the current one, or ``ego2world`` as in the sample;
    optionally ``points`` and ``boxes_3d`` in its own ego frame, ``time_s``, ``token``, and its calibration where it
    differs. K and cam2ego alone keep the current lenses and masks. Without ``boxes_3d``, the sample's are moved by
    their velocities (columns 7 and 8, m/s in the ego frame) if both frames have a time and all velocities are finite.

    Frames at the same place are left out silently, unusable ones with a warning.
    """
    if not isinstance(entries, list | tuple):
        raise SampleTypeError(f"neighbours: expected a list of frames, got {type(entries).__name__}")
    if len(entries) > MAX_NEIGHBOURS:
        raise SampleError(f"neighbours: expected at most {MAX_NEIGHBOURS} for a frame, got {len(entries)}")
    boxes, neighbours = None if frame.boxes is None else as_array("boxes_3d", frame.boxes), []
    for number, entry in enumerate(entries):
        token = entry.get("token") if isinstance(entry, Mapping) else None
        name = str(number) if token is None else shown(token)
        try:
            neighbours.append(_neighbour(frame, boxes, entry, sample, number, name))
        except (ArbiviewError, OSError) as error:
            _warn_lost(warn, name, error)
    moved = [neighbour for neighbour in neighbours if neighbour is not None]
    return tuple(sorted(moved, key=lambda neighbour: (neighbour.travel_m, neighbour.ahead_m)))


def points_of_neighbours(frame: Frame, warn: Warn) -> list[FloatArray]:
    """Points (P, C) of each neighbour in the frame's ego frame; contradicted and unreadable ones are left out."""
    sweeps = list[FloatArray]()
    for neighbour in (frame.neighbours or ())[:MAX_SWEEPS]:
        try:
            sweeps += [] if neighbour.sweep is None else [neighbour.sweep]
        except (ArbiviewError, OSError) as error:
            warn(f"points of {neighbour.name}", f"points of neighbour {neighbour.name} are left out: {error}")
    return sweeps


def neighbour_images(neighbour: Neighbour, like: Sequence[torch.Tensor], warn: Warn) -> tuple[torch.Tensor, ...] | None:
    """Read a neighbour's images; None, with a warning that names it, if they cannot be read."""
    try:
        return neighbour.images(like)
    except (ArbiviewError, OSError) as error:
        _warn_lost(warn, neighbour.name, error)
        return None


def _warn_lost(warn: Warn, name: str, error: Exception) -> None:
    """Warn that a neighbour is not used."""
    warn(f"neighbour {name}", f"neighbour {name} is left out: {error}; the frame is rendered without it")


def _neighbour(
    frame: Frame, current: Points | None, entry: Any, sample: Mapping[str, Any], number: int, name: str
) -> Neighbour | None:
    if not isinstance(entry, Mapping):
        raise SampleTypeError(f"expected a mapping with images and a pose, got {type(entry).__name__}")
    if entry.get("ego2ego") is not None:
        ego2ego = _pose("ego2ego", entry["ego2ego"])
    else:
        missing = [where for where, keys in (("it", entry), ("the sample", sample)) if keys.get("ego2world") is None]
        if missing:
            raise SampleError(f"expected ego2ego (4, 4), or ego2world here and in the sample; {missing[-1]} has none")
        here, there = _pose("ego2world", sample["ego2world"]), _pose("ego2world", entry["ego2world"])
        ego2ego = np.asarray(np.linalg.solve(here, there), np.float64)
    travel_m, turned_deg = float(np.linalg.norm(ego2ego[:3, 3])), _angle_deg(ego2ego[:3, :3])
    seconds = _checked_seconds(sample, entry, ego2ego, travel_m)
    if travel_m < STILL_M and turned_deg < STILL_DEG:
        return None
    cameras = [camera.moved(ego2ego) for camera in _checked_rig(frame, entry)]
    rig = Rig(cameras, ground_z_m=frame.rig.ground_z_m, name=f"{frame.rig.name} {name}".strip())
    now, then = _boxes(current, entry, ego2ego, seconds)
    return Neighbour(number, name, rig, travel_m, float(ego2ego[0, 3]), seconds, then, now, ego2ego, entry, frame)


def _checked_rig(frame: Frame, entry: Mapping[str, Any]) -> Rig:
    """The neighbour's cameras, of the current images' sizes, in its ego frame; SampleError for another rig's."""
    is_whole = entry.get("rig") is not None or (entry.get("K") is None and entry.get("cam2ego") is None)
    given = {key: numbers(key, entry[key]) for key in NUMBERS if entry.get(key) is not None}
    rig = read_rig(frame.images, {**entry, "K": frame.rig.K, **given}, frame.rig if is_whole else None)
    cameras = []
    for moved, camera in zip(rig, frame.rig, strict=True):
        if not is_whole:
            lens, mask = moved if entry.get("lens") is not None else camera, moved.mask
            mask = camera.mask if mask is None else mask
            moved = replace(moved, name=camera.name, lens=lens.lens, distortion=lens.distortion, mask=mask)
        scale = float(np.abs(moved.K - camera.K).max()) / camera.width_px
        if moved.lens != camera.lens or scale > 0.02:
            raise SampleError(f"camera {camera.name!r}: expected the current frame's lens and K, got another rig's")
        shift_m = float(np.linalg.norm(moved.center_m - camera.center_m))
        turned_deg = _angle_deg(moved.cam2ego[:3, :3] @ camera.cam2ego[:3, :3].T)
        if shift_m > _MAX_MOUNTING_M or turned_deg > _MAX_MOUNTING_DEG:
            got = f"a pose {shift_m:.2f} m and {turned_deg:.1f} degrees away"
            raise SampleError(f"camera {camera.name!r}: expected the current frame's mounting, got {got}; another rig?")
        cameras.append(moved)
    return frame.rig.with_cameras(cameras)


def _pose(key: str, value: Any) -> FloatArray:
    pose = numbers(key, value)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise SampleError(f"{key}: expected (4, 4) finite numbers, got shape {pose.shape}")
    if not is_rigid(pose):
        raise SampleError(f"{key}: expected a rotation, a translation and a last row 0 0 0 1, got {pose.tolist()}")
    return pose


def _checked_seconds(
    sample: Mapping[str, Any], entry: Mapping[str, Any], ego2ego: FloatArray, travel_m: float
) -> float | None:
    """Time from the current frame to this one, None if either has no time; poses that no drive has are refused."""
    seconds = None
    if sample.get("time_s") is not None and entry.get("time_s") is not None:
        here, there = numbers("time_s", sample["time_s"]), numbers("time_s", entry["time_s"])
        if here.size != 1 or there.size != 1 or not np.isfinite([here.item(), there.item()]).all():
            raise SampleError("time_s: expected one finite number of seconds, here and in the sample")
        seconds = float(there.item() - here.item())
    if travel_m > MAX_TRAVEL_M:
        raise SampleError(f"ego2ego: expected at most {MAX_TRAVEL_M:g} m of travel, got {travel_m:.1f} m; check poses")
    tilt_deg, climb_m = math.degrees(math.acos(np.clip(ego2ego[2, 2], -1, 1))), abs(float(ego2ego[2, 3]))
    if tilt_deg > MAX_TILT_DEG or climb_m > travel_m * np.sin(np.radians(2 * MAX_TILT_DEG)) + STILL_M:
        got = f"a tilt of {tilt_deg:.1f} degrees and {climb_m:.2f} m of climb"
        raise SampleError(f"ego2ego: expected both frames on one road plane, got {got}; check poses")
    if seconds is not None and travel_m > MAX_SPEED_MPS * abs(seconds) + STILL_M:
        got = f"{travel_m:.1f} m in {seconds:g} s"
        raise SampleError(f"time_s: expected at most {MAX_SPEED_MPS:g} m/s, got {got}; check poses and clock")
    return seconds


def _angle_deg(R: FloatArray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def _boxes(
    current: Points | None, entry: Mapping[str, Any], ego2ego: FloatArray, seconds: float | None
) -> tuple[FloatArray | None, FloatArray | None]:
    """The labelled objects of the current frame and of the neighbour, in the current ego frame; None if unknown."""
    now = None if current is None else checked_boxes(current)
    if entry.get("boxes_3d") is not None:
        return now, moved_by(checked_boxes(numbers("boxes_3d", entry["boxes_3d"])), ego2ego)
    if now is None or current is None or seconds is None or current.shape[-1] < 9:
        return now, None
    then = now.copy()
    then[:, :2] += current.reshape(-1, current.shape[-1])[:, 7:9] * seconds
    return now, then if np.isfinite(then).all() else None  # nuScenes marks unknown velocities by NaN


BOX_MARGIN_M = 0.4  # margin around labelled objects: contact shadows and mirrors move with them
_SHADOW_REACH, _CONTACT_REACH = 1.3, 0.3
"""Length of an object's shadow (sun at 38 degrees) and of its contact shadow, as multiples of its height."""

_BELOW_M = 0.5  # depth below a box in which its shadow is sought: labels may float above the road


class ChangeRisk(IntEnum):
    """Why a place that another frame shows may look different now, in ascending order."""

    NONE = 0  # labels say that nothing moved there
    SHADED = 1  # the shadow of a moved object may lie there in either frame
    BESIDE = 2  # a moved object is or was right next to it
    UNLABELLED = 3  # a frame has no labels


def change_risks(moved: FloatArray, points: FloatArray) -> npt.NDArray[np.uint8]:
    """Compute the ``ChangeRisk`` (n,) of points (n, 3) on the road near boxes (B, 7) that moved."""
    risks = np.zeros(len(points), np.uint8)
    if not len(points) or not len(moved):
        return risks
    low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
    radius_m = (np.hypot(moved[:, 3], moved[:, 4]) / 2 + 2 * _SHADOW_REACH * moved[:, 5])[:, None]
    in_reach = ((moved[:, :2] > low - radius_m) & (moved[:, :2] < high + radius_m)).all(axis=1)
    for risk, reach in ((ChangeRisk.SHADED, _SHADOW_REACH), (ChangeRisk.BESIDE, _CONTACT_REACH)):
        grown = moved[in_reach]
        grown[:, 3:5] += 2 * reach * grown[:, 5:6]
        grown[:, 5] += 2 * _BELOW_M
        for inside in points_in(grown, points):
            risks[inside] = risk
    return risks
