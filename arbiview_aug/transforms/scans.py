"""Points of a sample as the target's scanners would have measured them, and points in each box."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.errors import CalibrationError, SampleError, SampleTypeError
from arbiview_aug.sample.batching import is_readable
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.neighbours import Warn, points_of_neighbours
from arbiview_aug.scene.boxes import checked_boxes, points_by_box
from arbiview_aug.scene.point_cloud import checked_points, finite_rows

RINGS_KEY, COUNTS_KEY = "point_rings", "num_points"


class RetargetedPoints(NamedTuple):
    """Points of one frame.

    Attributes:
        points: (n, C) of the type, dtype and device of the measured ones, in their ego frame.
        rings: (n,) int32 beam, counted on from scanner to scanner; -1 where they are as measured.
        counts: (B,) int64 points in each box; None without boxes.
        unsupported: Share of rays that meet nothing measured; the sky's are among them.
    """

    points: Any
    rings: torch.Tensor
    counts: torch.Tensor | None
    unsupported: float = 0.0


def retarget_points(
    points: Any,
    target: Rig | str | Path,
    *,
    boxes_3d: Any = None,
    ground_z_m: float = 0.0,
    skip: bool = False,
    sweeps: Sequence[Any] = (),
) -> RetargetedPoints:
    """Measure a frame's scene by a target's scanners, as ``RigRetarget`` does; no images are needed.

    Args:
        points: (P, C >= 3) float tensor or array x y z ... in the frame's ego frame. Columns beyond z are those of
            the measured point whose surface a ray meets.
        target: A rig with ``lidars``, as ``RigRetarget`` takes it.
        boxes_3d: (B, >= 7) labelled objects, to count the points in each; they change no point.
        ground_z_m: Height of the road in the frame's ego frame.
        skip: Leave the points unchanged, and count those in boxes.
        sweeps: Arrays or tensors of points (Q, C) of other frames in this frame's ego frame, with the same columns.
            They fill rays that the frame's points do not support.

    Raises:
        SampleError: Points or boxes of another shape.
        SampleTypeError: Points that are not floats.
        CalibrationError: A rig without scanners, or with one that is not over the road.
    """
    from arbiview_aug.scene.scan import scan  # compiled

    target = load_rig(target)
    if not (target.lidars or skip):
        raise CalibrationError(f"rig {target.name!r}: expected lidars, which measure the points, got none")
    if not (isinstance(points, np.ndarray) and points.dtype.kind == "f"):
        if not is_readable(points) or not points.is_floating_point():
            kind = points.dtype if isinstance(points, torch.Tensor) else type(points).__name__
            raise SampleTypeError(f"points: expected a float tensor or array to scan, got {kind}")
    array = as_array("points", points)
    measured = checked_points(array)
    boxes = None if boxes_3d is None else checked_boxes(boxes_3d)
    unsupported, rings = 0.0, torch.full((len(array),), -1, dtype=torch.int32)
    if not skip:
        if (ground := as_array("ground_z_m", ground_z_m)).size != 1:
            raise SampleError(f"ground_z_m: expected one height, got shape {ground.shape}")
        ground_z_m = ground.item()
        up = ground_z_m - target.ground_z_m  # scanners keep their rays where nothing moves
        lidars = [lidar.shifted(z_m=up) for lidar in target.lidars] if up else target.lidars
        if not isinstance(sweeps, Sequence | np.ndarray | torch.Tensor) or getattr(sweeps, "ndim", 1) == 0:
            raise SampleTypeError(f"sweeps: expected a list of points (Q, C), got {type(sweeps).__name__}")
        arrays = [array, *(as_array(f"sweeps[{k}]", sweep) for k, sweep in enumerate(sweeps))]
        for k, sweep in enumerate(arrays[1:]):
            if array.ndim != 2 or sweep.ndim != 2 or sweep.shape[1] != array.shape[1]:
                expected = f"expected the columns of points {array.shape}"
                raise SampleError(f"sweeps[{k}]: {expected}, got {sweep.shape}")
        count = len(measured)
        if len(arrays) > 1:
            array = as_array("points", np.concatenate(arrays).astype(array.dtype))
        measured = checked_points(array)
        hits, nearest, beams, unsupported = scan(lidars, measured, ground_z_m, len(measured) - count)
        rows = array[np.flatnonzero(finite_rows(array))[nearest] if len(measured) else nearest]
        if rows.ndim == 2:  # an empty list is points too
            rows[:, :3] = hits
        points = rows.astype(points.dtype) if isinstance(points, np.ndarray) else torch.from_numpy(rows).to(points)
        measured, rings = hits, torch.from_numpy(beams)
    counts = None
    if boxes is not None:
        _, ends = points_by_box(boxes, measured, 0.0)
        counts = torch.from_numpy(np.diff(ends, prepend=0))
    return RetargetedPoints(points, rings, counts, unsupported)


def retarget_frames(
    frames: Sequence[Frame], target: Rig, skip: bool, warn: Warn, *, neighbours: bool
) -> list[RetargetedPoints]:
    """``retarget_points`` of a sample's frames, filled by their neighbours; empty if the sample has no points."""
    if frames[0].points is None:
        return []
    parts = []
    for frame in frames:
        sweeps = points_of_neighbours(frame, warn) if neighbours and not skip else []
        columns, found = as_array("points", frame.points).shape[-1], [sweep.shape[1] for sweep in sweeps]
        if found != [columns] * len(found):
            warn("columns of points", f"points of neighbours: expected {columns} columns, got {found}")
        boxes_3d = None if frame.boxes is None else as_array("boxes_3d", frame.boxes)
        settings: dict[str, Any] = {"boxes_3d": boxes_3d, "ground_z_m": frame.rig.ground_z_m, "skip": skip}
        fitting = [sweep for sweep in sweeps if sweep.shape[1] == columns]
        parts.append(retarget_points(frame.points, target, sweeps=fitting, **settings))
    return parts


def entries_of(parts: Sequence[RetargetedPoints], lead: tuple[int, ...]) -> dict[str, Any]:
    """Entries of the output sample; with leading dimensions, lists over the frames."""
    keys = {"points": [p.points for p in parts], RINGS_KEY: [p.rings for p in parts]}
    if parts[0].counts is not None:
        keys[COUNTS_KEY] = [p.counts for p in parts]
    return {key: values if lead else values[0] for key, values in keys.items()}


def describe_points(part: RetargetedPoints, frame: Frame, target: Rig) -> str:
    """One line for ``explain``."""
    rays = sum(math.prod(lidar.shape) for lidar in target.lidars)
    return (
        f"points: {len(frame.points)} measured, {len(part.points)} by the target's "
        f"{', '.join(lidar.name for lidar in target.lidars)} ({rays} rays); "
        f"{part.unsupported:.0%} of the rays, the sky's among them, meet nothing that was measured"
    )
