"""Neighbouring frames of a drive: what a sample says of them, checked; one that is no use is left out, in words.

A drive is seen again and again: what no camera sees now, one often saw a metre ago. See ``arbiview_aug.temporal.fill``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import ArbiviewError, SampleError, SampleTypeError
from arbiview_aug.sample.images import check_container, checked_images
from arbiview_aug.sample.inputs import Frame, frame_from, numbers, of_frames
from arbiview_aug.scene.boxes import checked_boxes, moved_boxes
from arbiview_aug.scene.surface import Points

MAX_NEIGHBOURS = 120
"""Numbers of frames are int8."""

STILL_M, STILL_DEG = 0.1, 0.5
"""A frame no farther away and turned no more sees what the current one sees."""

MAX_TRAVEL_M = 60.0
"""Farther on, nothing of the near ground is left in view."""

MAX_SPEED_MPS = 80.0
"""A pose that asks for more has jumped."""

MAX_TILT_DEG = 6.0
"""Between two roads that one plane should stand for: ramps have 5."""

_MAX_OTHER_MOUNTING = (1.5, 10.0)
"""Metres and degrees by which a camera may stand elsewhere: what a vehicle drives and turns between two cameras."""

Warn = Callable[[str, str], None]
"""Of a topic and a message, once for each topic."""


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Another frame of the drive, seen from the current one.

    Attributes:
        number: Its place in the sample's list.
        name: Its token, else its number.
        rig: Its cameras in the current frame's ego frame, over the current frame's road.
        travel_m: Distance between the two vehicles.
        ahead_m: How far it stood before the current one, along its heading.
        seconds: From the current frame to it; None where either has no time.
        boxes: (B, 7) where labelled objects were then, in the current ego frame; None where nobody said.
        boxes_now: (B, 7) where they are in the current frame; None where nobody said.
        given: The entry itself; its images are read when they are asked for.
    """

    number: int
    name: str
    rig: Rig
    travel_m: float
    ahead_m: float
    seconds: float | None
    boxes: FloatArray | None
    boxes_now: FloatArray | None
    given: Mapping[str, Any]

    @property
    def is_later(self) -> bool:
        """Whether it was recorded after the current frame: without times, whether it stood before it."""
        return (self.seconds or self.ahead_m) > 0

    @property
    def labelled(self) -> FloatArray:
        """(B, 7) the labelled objects, where they were and where they are, in the current ego frame."""
        return np.concatenate([np.zeros((0, 7)), *(b for b in (self.boxes, self.boxes_now) if b is not None)])

    @cached_property
    def moved(self) -> FloatArray | None:
        """(B, 7) the labels of both frames that moved between them; None where either has none."""
        if self.boxes is None or self.boxes_now is None:
            return None
        return moved_boxes(self.boxes_now, self.boxes)

    def images(self, like: Sequence[torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Its images, of the type and on the device of the current ones.

        Raises:
            ArbiviewError: They are missing, broken, or do not fit its cameras.
        """
        found = self.given.get("images")
        if found is None:
            raise SampleError("images: expected the frame's images, got none")
        check_container(found)
        images = checked_images(list(found))
        sizes, expected = [tuple(image.shape[1:]) for image in images], self.rig.sizes
        if sizes != expected:
            raise SampleError(f"images: expected the sizes {expected}, got {sizes}")
        if images[0].dtype != like[0].dtype:
            raise SampleTypeError(f"images: expected {like[0].dtype} as in the current frame, got {images[0].dtype}")
        return tuple(image.to(like[0].device) for image in images)


def neighbours_of_frames(
    sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...], warn: Warn
) -> list[list[Neighbour]]:
    """The neighbours of each frame that can add something, the nearest first.

    ``neighbours`` is a list of mappings, each another frame of the same rig: ``images``; ``ego2ego`` (4, 4), its ego
    frame to the current one, or ``ego2world`` beside the sample's own; its calibration as a sample has it, where it
    differs from the current frame's; and, where there are any, ``boxes_3d`` in its own ego frame, ``time_s`` and
    ``token``. Calibration that is K and cam2ego alone has the current frame's lenses and masks. Without boxes of its
    own, those of the sample are moved by their velocities (columns 7 and 8, m/s in the ego frame), where both frames
    have a time and all velocities are known. Of a batch: a list of such lists.

    Frames at the very same place are left out silently; impossible ones with a warning that names them.

    Args:
        sample: The sample dict.
        frames: Its checked frames.
        lead: Leading dimensions of its images.
        warn: Says what is left out and why.

    Raises:
        SampleTypeError: ``neighbours`` is no list, or of a batch no list of lists.
        SampleError: There are too many.
    """
    value = sample.get("neighbours")
    if value is None:
        return [[] for _ in frames]
    lists = list(value) if lead and isinstance(value, list | tuple) else [value]
    if len(lists) != len(frames) or not all(isinstance(entries, list | tuple) for entries in lists):
        expected = f"a list of {len(frames)} lists, one for each frame of the batch" if lead else "a list of frames"
        raise SampleTypeError(f"neighbours: expected {expected}, got {type(value).__name__}")
    most = max(map(len, lists))
    if most > MAX_NEIGHBOURS:
        raise SampleError(f"neighbours: expected at most {MAX_NEIGHBOURS} for a frame, got {most}")
    boxes = sample.get("boxes_3d")
    current = [None] * len(frames) if boxes is None else of_frames("boxes_3d", boxes, len(frames), lead)
    found = []
    for index, frame, now, entries in zip(np.ndindex(*lead), frames, current, lists, strict=True):
        of_frame = []
        for number, entry in enumerate(entries):
            name = _name(entry, number)
            try:
                neighbour = _neighbour(sample, index, frame, now, entry, number, name)
            except (ArbiviewError, OSError) as error:
                warn_lost(warn, name, error)
                continue
            if neighbour is not None:
                of_frame.append(neighbour)
        found.append(sorted(of_frame, key=lambda one: (one.travel_m, one.number)))
    return found


def warn_lost(warn: Warn, name: str, error: Exception) -> None:
    """Say that a neighbour is not used, and why."""
    warn(f"neighbour {name}", f"neighbour {name} is left out: {error}; the frame is rendered without it")


def _name(entry: Any, number: int) -> str:
    token = entry.get("token") if isinstance(entry, Mapping) else None
    return str(number) if token is None else repr(str(token))


def _neighbour(
    sample: Mapping[str, Any],
    index: tuple[int, ...],
    frame: Frame,
    current: Points | None,
    entry: Any,
    number: int,
    name: str,
) -> Neighbour | None:
    if not isinstance(entry, Mapping):
        raise SampleTypeError(f"expected a mapping with images and a pose, got {type(entry).__name__}")
    ego2ego = _ego2ego(sample, index, entry)
    travel_m, turned_deg = float(np.linalg.norm(ego2ego[:3, 3])), _angle_deg(ego2ego[:3, :3])
    seconds = _seconds(sample, index, entry)
    _check_motion(ego2ego, travel_m, seconds)
    if travel_m < STILL_M and turned_deg < STILL_DEG:
        return None
    own = _own_rig(frame, entry)
    _check_same_vehicle(frame.rig, own)
    cameras = [camera.moved(ego2ego) for camera in own]
    rig = Rig(cameras, ground_z_m=frame.rig.ground_z_m, name=f"{frame.rig.name} {name}".strip())
    now, then = _boxes(current, entry, ego2ego, seconds)
    return Neighbour(number, name, rig, travel_m, float(ego2ego[0, 3]), seconds, then, now, entry)


def _own_rig(frame: Frame, entry: Mapping[str, Any]) -> Rig:
    """Its cameras in its own ego frame.

    Its images are not read before it is known that they are needed; the current frame's are of the same sizes.
    """
    if entry.get("rig") is not None or entry.get("K") is None:
        return frame_from(frame.images, entry, frame.rig).rig
    cameras = []
    for camera, now in zip(frame_from(frame.images, entry, None).rig, frame.rig, strict=True):
        of_lens = camera if entry.get("lens") is not None else now
        mask = now.mask if camera.mask is None else camera.mask
        cameras.append(replace(camera, name=now.name, lens=of_lens.lens, distortion=of_lens.distortion, mask=mask))
    return frame.rig.with_cameras(cameras)


def _ego2ego(sample: Mapping[str, Any], index: tuple[int, ...], entry: Mapping[str, Any]) -> FloatArray:
    if entry.get("ego2ego") is not None:
        pose = numbers("ego2ego", entry["ego2ego"])
    else:
        missing = [where for where, of in (("it", entry), ("the sample", sample)) if of.get("ego2world") is None]
        if missing:
            raise SampleError(f"expected ego2ego (4, 4), or ego2world here and in the sample; {missing[-1]} has none")
        here, there = (numbers("ego2world", of["ego2world"]) for of in (sample, entry))
        here = here[index] if here.ndim > 2 else here
        if here.shape != (4, 4) or there.shape != (4, 4) or not (np.isfinite(here).all() and np.isfinite(there).all()):
            raise SampleError(f"ego2world: expected (4, 4) finite numbers, got shapes {here.shape} and {there.shape}")
        if abs(np.linalg.det(here[:3, :3])) < 0.5:
            raise SampleError("ego2world: expected a pose, got a matrix without a rotation")
        if not all(np.allclose(matrix[3], (0, 0, 0, 1)) for matrix in (here, there)):
            raise SampleError("ego2world: expected a pose, got a last row that is not 0 0 0 1")
        pose = np.linalg.solve(here, there)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise SampleError(f"ego2ego: expected (4, 4) finite numbers, got shape {pose.shape}")
    if np.abs(pose[:3, :3] @ pose[:3, :3].T - np.eye(3)).max() > 1e-3 or np.linalg.det(pose[:3, :3]) < 0:
        raise SampleError("ego2ego: expected a rotation and a translation, got another matrix")
    return np.asarray(pose, np.float64)


def _seconds(sample: Mapping[str, Any], index: tuple[int, ...], entry: Mapping[str, Any]) -> float | None:
    """From the current frame to this one; None where either has no time."""
    if sample.get("time_s") is None or entry.get("time_s") is None:
        return None
    here, there = numbers("time_s", sample["time_s"]), numbers("time_s", entry["time_s"])
    here = here[index] if here.ndim else here
    if here.size != 1 or there.size != 1 or not np.isfinite([here.item(), there.item()]).all():
        raise SampleError("time_s: expected one finite number of seconds, here and in the sample")
    return float(there.item() - here.item())


def _check_motion(ego2ego: FloatArray, travel_m: float, seconds: float | None) -> None:
    """Refuse poses that no drive has."""
    if travel_m > MAX_TRAVEL_M:
        raise SampleError(
            f"ego2ego: expected at most {MAX_TRAVEL_M:g} m of travel, got {travel_m:.1f} m; a pose jumped?"
        )
    tilt_deg = float(np.degrees(np.arccos(np.clip(ego2ego[2, 2], -1, 1))))
    climb_m = abs(float(ego2ego[2, 3]))
    if tilt_deg > MAX_TILT_DEG or climb_m > travel_m * np.sin(np.radians(2 * MAX_TILT_DEG)) + STILL_M:
        raise SampleError(
            f"ego2ego: expected one road under both, got a tilt of {tilt_deg:.1f} degrees and {climb_m:.2f} m of "
            "climb; a pose jumped?"
        )
    if seconds is not None and travel_m > MAX_SPEED_MPS * abs(seconds) + STILL_M:
        raise SampleError(
            f"time_s: expected at most {MAX_SPEED_MPS:g} m/s, got {travel_m:.1f} m in {seconds:g} s; a pose or a clock "
            "jumped?"
        )


def _check_same_vehicle(rig: Rig, own: Rig) -> None:
    for camera, other in zip(rig, own, strict=True):
        scale = float(np.abs(other.K - camera.K).max()) / camera.width_px
        if other.lens != camera.lens or scale > 0.02:
            raise SampleError(
                f"camera {camera.name!r}: expected the current frame's lens and K, got others; another rig?"
            )
        shift_m = float(np.linalg.norm(other.center_m - camera.center_m))
        turned_deg = _angle_deg(other.cam2ego[:3, :3] @ camera.cam2ego[:3, :3].T)
        if shift_m > _MAX_OTHER_MOUNTING[0] or turned_deg > _MAX_OTHER_MOUNTING[1]:
            raise SampleError(
                f"camera {camera.name!r}: expected it where the current frame has it, got it {shift_m:.2f} m and "
                f"{turned_deg:.1f} degrees away; another rig?"
            )


def _angle_deg(R: FloatArray) -> float:
    return float(np.degrees(np.arccos(np.clip((np.trace(R) - 1) / 2, -1, 1))))


def _boxes(
    current: Points | None, entry: Mapping[str, Any], ego2ego: FloatArray, seconds: float | None
) -> tuple[FloatArray | None, FloatArray | None]:
    """Where labelled objects are, and where they were, in the current ego frame; None where nobody said."""
    now = None if current is None else checked_boxes(current)
    if entry.get("boxes_3d") is not None:
        boxes = checked_boxes(numbers("boxes_3d", entry["boxes_3d"]))
        moved = boxes.copy()
        moved[:, :3] = boxes[:, :3] @ ego2ego[:3, :3].T + ego2ego[:3, 3]
        moved[:, 6] += np.arctan2(ego2ego[1, 0], ego2ego[0, 0])
        return now, moved
    if now is None or current is None or seconds is None or current.shape[-1] < 9:
        return now, None
    velocity_mps = current.reshape(-1, current.shape[-1])[:, 7:9]
    if not np.isfinite(velocity_mps).all():  # NaN in nuScenes: one that nobody knows may have driven anywhere
        return now, None
    moved = now.copy()
    moved[:, :2] += velocity_mps * seconds
    return now, moved
