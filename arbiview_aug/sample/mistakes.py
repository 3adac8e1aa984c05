"""``check``: mistakes that rendering cannot notice, found by trying other readings of a sample's labels and points."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.rotations import rotation_z
from arbiview_aug.cameras.validation import Finding
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.sample.camera_mistakes import (
    CLEAR_FIT,
    EDGE_WIDTH_PX,
    check_own_car,
    check_rig,
    edge_fit,
    edge_ranks,
    ego_pose,
    fit_findings,
    gray,
    neighbour_errors,
    neighbour_findings,
    total,
)
from arbiview_aug.sample.inputs import misnamed_keys, read_frames
from arbiview_aug.scene.boxes import checked_boxes, points_in
from arbiview_aug.scene.point_cloud import checked_points, own_car
from arbiview_aug.scene.surface import Points

_ROAD_M = 0.2
"""Largest distance of the points' road from ``ground_z_m``, well above that of right frames."""

_ROAD_RADIUS_M, _SECTORS, _LEAST_SECTORS, _LEAST_IN_SECTOR = 10.0, 36, 12, 20
_ROAD_PERCENTILE = 10  # of a sector's points: higher ones belong to things on the road
_OVER_ROAD_M = 0.3  # points above this are objects'

_LIDAR_HEIGHT_M = 1.2  # points this far below the road come from the height of a LiDAR on a roof

_LEAST_POINTS = 5  # in a box that counts
_MOST_POINTS = 50  # near boxes count as much as others
_BETTER = 1.3  # times as many points: a box of another reading holds clearly more
_LEAST_WINS, _WIN_RATIO = 3, 4
"""Boxes that must hold more points in another reading, and how many for each that holds fewer. No other reading passes
this on right frames, turned, thinned and with jittered labels."""

_LONG_M, _LEAST_LONG, _MOST_LONG = 3.0, 3, 0.75
"""Boxes longer than this are vehicles, longest along their length: 3 of them at least, three quarters of all."""

_OFF_ROAD_M, _ALIKE_M = 2.5, 0.8
"""Bottoms of boxes farther from the road in the median hang, even on a slope; those within such a range are alike."""

_HALVES, _ALONE, _TWICE = 0.35, 1.2, 0.6
"""Shares of the points in boxes twice as large that other readings hold; points a third farther out, where objects
stand alone; shares in boxes' inner halves, where right ones are hollow."""

_MOST_LONG_M = 30.0  # largest median of the boxes' longest sides: beyond it, most objects would be trains
_NEAR_M = 40.0  # at boxes farther away, the road may have another height
_ELSEWHERE_M = 200.0  # nothing nearer than this: another frame, or another unit
_MANY_DEG = 2 * math.pi + 1e-3


@dataclass(frozen=True)
class CheckReport:
    """The findings of ``check``; ``print`` shows one line each."""

    findings: tuple[Finding, ...] = ()

    @property
    def ok(self) -> bool:
        """Whether nothing was found."""
        return not self.findings

    def __str__(self) -> str:
        return "\n".join(map(str, self.findings)) or "no findings"


def check(sample: Mapping[str, Any], source: Rig | None = None) -> CheckReport:
    """Look for mistakes that rendering cannot notice.

    Points in boxes tell the reading of the boxes; edges in the images tell the frame of the points and each camera's
    pose; the road in the points tells ``ground_z_m``. Poses are compared with cameras upright over the road, with their
    names, and by matches with their neighbours. Frames of one drive in a batch show the own car.

    Args:
        sample: A sample or batch as ``RigRetarget`` takes it.
        source: Rig of samples without a calibration.

    Raises:
        ArbiviewError: ``RigRetarget`` would refuse the sample too.
    """
    frames = read_frames(sample, source, further=("points", "boxes_3d", "ego2world"))
    findings = misnamed_keys(sample, source is not None or sample.get("rig") is not None)
    depth_m = sample.get("depth_m")
    maps = depth_m if isinstance(depth_m, list | tuple) else [] if depth_m is None else [depth_m]
    arrays = [as_array("depth_m", depth) for depth in maps]
    nearest_m = min((float(array[array > 0].min(initial=np.inf)) for array in arrays), default=np.inf)
    if _ELSEWHERE_M < nearest_m < np.inf:
        found = f"the nearest pixel {nearest_m:.0f} m away"
        findings.append(Finding("depth_m", "metres, 0 where unknown", found, "is it in millimetres? Divide by 1000"))
    # Holes of an earlier retargeting are masks too, of any shape.
    is_recorded = sample.get("coverage") is None
    for frame in frames:
        rig_findings = check_rig(frame.rig, frame.images, masks=is_recorded and sample.get("ego_mask") is None)
        findings += rig_findings
        boxes = None if frame.boxes is None else checked_boxes(as_array("boxes_3d", frame.boxes))
        points = None if frame.points is None else checked_points(as_array("points", frame.points))
        # Images tell nothing through poses that are all wrong.
        wrong = [finding.where for finding in rig_findings if finding.where.endswith("cam2ego")]
        is_clear = is_recorded and "cam2ego" not in wrong and 2 * len(wrong) <= len(frame.rig)
        findings += _label_findings(frame.rig, frame.images if is_clear else (), boxes, points, ego_pose(frame))
        if is_clear:
            findings += neighbour_findings(neighbour_errors(frame.rig, frame.images))
    if is_recorded and sample.get("ego_mask") is None:
        findings += check_own_car(frames)
    return CheckReport(tuple(dict.fromkeys(findings)))


class Reading(NamedTuple):
    """A frame that points or boxes may be in."""

    found: str
    fix: str
    fix_of_boxes: str
    pose: FloatArray  # (4, 4) to the ego frame; it may mirror
    is_camera: bool = False  # boxes then turn about the camera's y axis


def _label_findings(
    rig: Rig,
    images: Sequence[torch.Tensor],
    boxes: FloatArray | None,
    points: Points | None,
    ego2world: FloatArray | None,
) -> list[Finding]:
    """Mistakes in boxes and points; ``images`` (3, H, W) tell the points' frame, if there are any."""
    findings: list[Finding] = []
    for key, rows in (("boxes_3d", boxes), ("points", points)):
        nearest_m = np.inf if rows is None else np.hypot(rows[:, 0], rows[:, 1]).min(initial=np.inf)
        if _ELSEWHERE_M < nearest_m < np.inf:
            fix = "are they in the world's frame? Apply inv(ego2world), to yaw too; or in millimetres? Divide by 1000"
            findings.append(Finding(key, "positions around the vehicle", f"the nearest {nearest_m:.0f} m away", fix))
    if boxes is not None and len(boxes) and (length_m := float(np.median(boxes[:, 3:6].max(axis=1)))) > _MOST_LONG_M:
        found = f"a median length of {length_m:.0f} m"
        findings.append(Finding("boxes_3d", "sizes in metres", found, "are they in millimetres or centimetres?"))
    if findings:
        return findings
    if boxes is not None and (np.abs(boxes[:, 6]) > _MANY_DEG).any():
        largest = float(np.abs(boxes[:, 6]).max())
        return [Finding("boxes_3d", "yaw in radians", f"yaw up to {largest:.1f}", "pass degrees through torch.deg2rad")]
    point_findings, points, is_sure = _points_finding(rig, images, points, ego2world)
    findings += point_findings
    road_m = None if points is None else road_height_m(points)
    level_m = rig.ground_z_m if road_m is None else road_m
    objects = None
    if points is not None and abs(level_m - rig.ground_z_m) <= _LIDAR_HEIGHT_M:  # others say nothing about the boxes
        objects = points[(points[:, 2] > level_m + _OVER_ROAD_M) & ~own_car(points)]
    if boxes is not None and len(boxes):
        mistake = _order_finding(boxes, objects) or (None if objects is None else _size_finding(boxes, objects))
        mistake = mistake or _box_finding(rig, boxes, objects, ego2world, is_sure)
        findings += [mistake] if mistake else []
    if road_m is None or abs(road_m - rig.ground_z_m) <= _ROAD_M:
        return findings
    seen, bottoms = f"{road_m:+.2f} in the points", None if boxes is None else _bottoms_m(rig, boxes)
    is_level = bottoms is None or abs(float(np.median(bottoms[0]))) < _ROAD_M * 2
    if road_m - rig.ground_z_m < -_LIDAR_HEIGHT_M and is_level:
        expected = f"the road at z = {rig.ground_z_m:+.2f} m, as ground_z_m says"
        return [*findings, Finding("points", expected, seen, _OF_LIDAR)]
    fix = f"set ground_z_m={road_m:.2f}; or, if points and boxes are in the LiDAR's frame, apply lidar2ego to both"
    return [*findings, Finding("ground_z_m", f"the road's height, {seen}", f"{rig.ground_z_m:+.2f}", fix)]


_FLIPS: tuple[tuple[str, FloatArray, str, str], ...] = (
    ("mirrored (y to the right)", np.diag([1.0, -1, 1]), "negate y", "negate y and yaw"),
    ("with x backward", np.diag([-1.0, 1, 1]), "negate x", "negate x, and pass pi - yaw"),
    ("with x and y swapped", np.eye(3)[[1, 0, 2]], "swap x and y", "swap x and y, and pass pi / 2 - yaw"),
    ("with y to the right and z down", np.diag([1.0, -1, -1]), "negate y and z", "negate y, z and yaw"),
    ("in centimetres", np.eye(3) / 100, "divide by 100", "divide positions and sizes by 100"),
    ("in feet", np.eye(3) * 0.3048, "multiply by 0.3048", "multiply positions and sizes by 0.3048"),
)
"""Finding, matrix to the ego frame, and the fixes for points and for boxes."""

_OF_LIDAR = "are they in the LiDAR's frame? Apply lidar2ego to them"


def _readings(rig: Rig, ego2world: FloatArray | None, lift_m: float) -> Iterator[Reading]:
    """Frames that can be told without a calibration of a further sensor; the last are a LiDAR's, once it is lifted."""
    for found, A, fix, fix_of_boxes in _FLIPS:
        yield Reading(found, fix, fix_of_boxes, _pose(A))
    for camera in rig:
        fix = f"apply the cam2ego of {camera.name!r}"
        found = f"in the frame of camera {camera.name!r}"
        yield Reading(found, fix, f"{fix}, to yaw too", camera.cam2ego, is_camera=True)
    if ego2world is not None:
        fix, inverse = "apply inv(ego2world)", np.asarray(np.linalg.inv(ego2world), np.float64)
        yield Reading("in the world's frame", fix, f"{fix}, to yaw too", inverse)
    lower = f"{abs(lift_m):.1f} m {'lower' if lift_m > 0 else 'higher'}" if abs(lift_m) > _ROAD_M else ""
    for quarters, turn in enumerate(("", "turned by -90 degrees", "turned by 180 degrees", "turned by 90 degrees")):
        if quarters or abs(lift_m) >= _LIDAR_HEIGHT_M:
            found, pose = " and ".join(filter(None, (turn, lower))), _pose(rotation_z(90 * quarters).round(), lift_m)
            yield Reading(found, _OF_LIDAR, f"{_OF_LIDAR}, to yaw too", pose)


def _pose(A: FloatArray, up_m: float = 0.0) -> FloatArray:
    pose = np.eye(4)
    pose[:3, :3], pose[2, 3] = A, up_m
    return pose


def _points_finding(
    rig: Rig, images: Sequence[torch.Tensor], points: Points | None, ego2world: FloatArray | None
) -> tuple[list[Finding], Points | None, bool]:
    """A frame in which the points fit the images' edges better; the points in it, and whether the images are clear."""
    if points is None or not len(images):
        return [], points, False
    small = [gray(camera, image, EDGE_WIDTH_PX) for camera, image in zip(rig, images, strict=True)]
    views = [(camera, edge_ranks(pixels)) for camera, pixels in small]
    xyz = points[:, :3].astype(np.float64)
    fit = total([edge_fit(*view, xyz) for view in views])
    road_m = road_height_m(points)
    off_m = 0.0 if road_m is None else rig.ground_z_m - road_m
    readings = list(_readings(rig, ego2world, off_m))
    if fit.gain >= CLEAR_FIT and abs(off_m) <= _LIDAR_HEIGHT_M:
        readings = readings[:1]  # another frame is costly to try: only mirrored points may fit as well
    best, chosen, moved = fit, None, points
    for reading in readings:
        there = xyz @ reading.pose[:3, :3].T + reading.pose[:3, 3]
        level_m = road_height_m(there)
        if level_m is not None and abs(level_m - rig.ground_z_m) > 2 * _ROAD_M:
            continue  # another frame must put the road in its place
        candidate = total([edge_fit(*view, there) for view in views])
        if candidate.beats(fit) and candidate.gain > best.gain:
            best, chosen, moved = candidate, reading, there
    if chosen is None:
        return list(fit_findings(rig, views, xyz)), points, fit.gain > CLEAR_FIT
    seen = f"points {chosen.found}, by the edges of the images"
    return [Finding("points", "points in the ego frame", seen, chosen.fix)], moved, True


_CENTER = "z of the box's centre"
_FACES = (
    ("bottom", 0.5, "add half the height to z", "half below the road", "is ground_z_m wrong?"),
    (
        "top",
        -0.5,
        "subtract half the height from z",
        "half a height over the road",
        "are sizes halves, or ground_z_m wrong?",
    ),
)
"""Face that z may be of, heights from it to the centre, and the fix; without points, the finding and other causes."""


def _box_finding(
    rig: Rig, boxes: FloatArray, objects: Points | None, ego2world: FloatArray | None, is_sure: bool
) -> Finding | None:
    """Another frame, yaw or height of the boxes, which hold more points with it, or stand on the road with it alone."""
    bottoms = _bottoms_m(rig, boxes)
    height_m, spread_m = (0.0, 0.0) if bottoms is None else _spread(bottoms[0])
    readings = _readings(rig, ego2world, -height_m if abs(height_m) > _LIDAR_HEIGHT_M and spread_m < _ALIKE_M else 0.0)
    moved = [(reading, there) for reading in readings for there in _moved(boxes, reading)]
    if objects is not None:
        tries, also = [], "" if is_sure else "; or mend the points"
        for reading, there in moved:
            found = f"boxes {reading.found}: they hold more points elsewhere"
            tries.append(("boxes in the ego frame", found, reading.fix_of_boxes + also, there))
        for yaw, there in _yaws(boxes).items():
            found = f"more points in the boxes of {yaw}"
            tries.append(("yaw counter-clockwise from the x axis", found, f"pass {yaw}", there))
        for face, lift, fix, *_ in _FACES:
            tries.append((_CENTER, f"more points inside if z is the {face}", fix, _lifted(boxes, lift)))
        leads = [_lead(there, boxes, objects) for *_, there in tries]
        if max(leads):
            return Finding("boxes_3d", *tries[int(np.argmax(leads))][:3])
    if bottoms is None:
        return None
    hangs = abs(height_m) > _OFF_ROAD_M or spread_m > 2 * _OFF_ROAD_M
    if hangs or abs(height_m) > _LIDAR_HEIGHT_M:
        hang = "bottoms {:+.1f} to {:+.1f} m over it".format(*np.percentile(bottoms[0], [10, 90]))
        rigid = [(reading, there) for reading, there in moved if abs(np.linalg.det(reading.pose)) > 0.99]
        stand = [(reading, low[0]) for reading, there in rigid if (low := _bottoms_m(rig, there)) is not None]
        off_m = [sum(np.abs(_spread(heights_m))) for _, heights_m in stand]
        if min(off_m, default=np.inf) < _ALIKE_M:
            chosen = stand[int(np.argmin(off_m))][0]
            fix = chosen.fix_of_boxes + (", or is ground_z_m wrong?" if chosen.fix == _OF_LIDAR else "")
            return Finding("boxes_3d", "boxes on the road", f"{hang}: boxes {chosen.found}", fix)
        if hangs:
            fix = "are they in another sensor's frame, or other units?"
            return Finding("boxes_3d", "boxes on the road", hang, fix)
    share, spread = _spread(bottoms[0] / bottoms[1])
    for _, lift, fix, seen, cause in _FACES if objects is None and spread < 0.3 else ():
        if abs(share + lift) < 0.15:
            return Finding("boxes_3d", _CENTER, f"boxes {seen}", f"{fix}, or {cause}")
    return None


def _moved(boxes: FloatArray, reading: Reading) -> Iterator[FloatArray]:
    """Boxes in the ego frame, if they were given in a reading's; labels of cameras differ in yaw and centre."""
    pose, c, s = reading.pose[:3, :3], np.cos(boxes[:, 6]), np.sin(boxes[:, 6])
    sizes = boxes[:, 3:6] * np.linalg.norm(pose[0])
    nothing = np.zeros_like(c)
    ahead = np.stack([c, nothing, -s] if reading.is_camera else [c, s, nothing], axis=-1) @ pose.T
    turned = np.arctan2(ahead[:, 1], ahead[:, 0])
    for half in (0.0, 0.5) if reading.is_camera else (0.0,):
        centers = boxes[:, :3] @ pose.T + reading.pose[:3, 3] + [[0, 0, half]] * sizes[:, 2:]
        for yaw in (turned, boxes[:, 6]) if reading.is_camera else (turned,):
            yield np.column_stack([centers, sizes, yaw])


def _spread(values: FloatArray) -> tuple[float, float]:
    """Median and interquartile range."""
    low, middle, high = np.percentile(values, [25, 50, 75])
    return float(middle), float(high - low)


def road_height_m(points: Points) -> float | None:
    """Height of the road around the vehicle: the median of low points over directions; None if unknown."""
    points = points[~own_car(points)]
    x, y, z = points[np.hypot(points[:, 0], points[:, 1]) < _ROAD_RADIUS_M, :3].T
    sector = ((np.arctan2(y, x) / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
    sectors = [z[sector == k] for k in range(_SECTORS)]
    low = [np.percentile(heights, _ROAD_PERCENTILE) for heights in sectors if len(heights) >= _LEAST_IN_SECTOR]
    return float(np.median(low)) if len(low) >= _LEAST_SECTORS else None


def _bottoms_m(rig: Rig, boxes: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Heights (n,) of the near boxes' bottoms over the road, and of the boxes; None if there are too few."""
    near = boxes[np.hypot(boxes[:, 0], boxes[:, 1]) < _NEAR_M]
    return (near[:, 2] - near[:, 5] / 2 - rig.ground_z_m, near[:, 5]) if len(near) >= _LEAST_WINS else None


def _size_finding(boxes: FloatArray, objects: Points) -> Finding | None:
    """Sizes that are halves, as simulators give extents, or twice the true ones."""

    def share(of: FloatArray, whole: FloatArray) -> float:
        """The median share of the points in larger boxes that others hold; NaN if too few boxes have enough."""
        enough = whole >= 4 * _LEAST_POINTS
        return float(np.median(of[enough] / whole[enough])) if enough.sum() >= _LEAST_WINS else np.nan

    inner, inside, double, beyond = (_counts(boxes * ([1] * 3 + [k] * 3 + [1]), objects) for k in (0.55, 1.0, 2.0, 2.6))
    expected, seen = "whole lengths, widths and heights", "the size of what the points show"
    if share(beyond, double) < _ALONE:
        candidates = boxes, *(_lifted(boxes, lift) for _, lift, *_ in _FACES), *_yaws(boxes).values()
        if max(share(_counts(candidate, objects), double) for candidate in candidates) < _HALVES:
            fix = "are they extents from the centre? Double them"
            return Finding("boxes_3d", expected, f"half {seen}", fix)
    if share(inner, inside) > _TWICE:
        return Finding("boxes_3d", expected, f"twice {seen}", "halve them")
    return None


def _lifted(boxes: FloatArray, heights: float) -> FloatArray:
    """The boxes moved up by a multiple of their heights."""
    return np.asarray(boxes + np.array([0, 0, heights, 0, 0, 0, 0]) * boxes[:, 5:6])


def _yaws(boxes: FloatArray) -> dict[str, FloatArray]:
    """The boxes with another yaw, by its formula."""
    yaw, quarter = boxes[:, 6], math.pi / 2
    yaws = {"-yaw": -yaw, "yaw + pi / 2": yaw + quarter, "pi / 2 - yaw": quarter - yaw}
    return {formula: np.column_stack([boxes[:, :6], turned]) for formula, turned in yaws.items()}


def _order_finding(boxes: FloatArray, objects: Points | None) -> Finding | None:
    """Vehicles that are wider or higher than long; points decide between the first and a yaw that fits it."""
    long = boxes[boxes[:, 3:6].max(axis=1) > _LONG_M]
    if len(long) < _LEAST_LONG:
        return None
    share = np.bincount(long[:, 3:6].argmax(axis=1), minlength=3) / len(long)
    if share[1:].max() < _MOST_LONG:
        return None
    expected, seen = "columns x y z length width height yaw", f"{share[1:].max():.0%} of {len(long)} vehicles"
    if share[2] >= _MOST_LONG:
        fix = "is it height, width, length? Reorder the columns"
        return Finding("boxes_3d", expected, f"{seen} highest along the sixth column", fix)
    if objects is not None and _lead(boxes, boxes[:, [0, 1, 2, 4, 3, 5, 6]], objects):
        return None  # the yaw is counted from the other side, and the boxes are right
    return Finding("boxes_3d", expected, f"{seen} wider than long", "is it width, length, height? Swap columns 3 and 4")


def _lead(boxes: FloatArray, rivals: FloatArray, objects: Points) -> int:
    """Number of points that one reading of the boxes holds more than another, if it clearly does; else 0."""
    counts, rival_counts = _counts(boxes, objects), _counts(rivals, objects)
    pairs = (counts, rival_counts), (rival_counts, counts)
    wins, losses = (((more >= _LEAST_POINTS) & (more > _BETTER * fewer)).sum() for more, fewer in pairs)
    if wins < _LEAST_WINS or wins < _WIN_RATIO * losses:
        return 0
    return max(0, int((counts.clip(max=_MOST_POINTS) - rival_counts.clip(max=_MOST_POINTS)).sum()))


def _counts(boxes: FloatArray, points: Points) -> FloatArray:
    return np.array([len(inside) for inside in points_in(boxes, points)], np.float64)
