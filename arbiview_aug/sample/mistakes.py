"""``check``: mistakes in a sample that rendering cannot notice, found from its points, boxes, poses and masks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import is_mounted, pose_mistake
from arbiview_aug.sample.inputs import Frame, as_array, focal_mistake, misnamed_keys, read_frames
from arbiview_aug.sample.masks import CLEANING, dark_rims, without_specks
from arbiview_aug.scene.boxes import checked_boxes, points_in
from arbiview_aug.scene.point_cloud import checked_points, own_car
from arbiview_aug.scene.surface import Points

ROAD_M = 0.2
"""Largest distance of the points' road from ``ground_z_m``; on three real frames and six streets it is up to 0.01."""

_ROAD_RADIUS_M, _SECTORS, _LEAST_SECTORS, _LEAST_IN_SECTOR = 10.0, 36, 12, 20
_ROAD_PERCENTILE = 10  # of a sector's points: those above stand on the road
_OVER_ROAD_M = 0.3  # points above this are objects'

_LIDAR_HEIGHT_M = 1.2  # points this far below the road come from the height of a LiDAR on a roof

_LEAST_POINTS = 5  # in a box, for it to speak
_MOST_POINTS = 50  # near boxes count as much as others
_BETTER = 1.3  # times as many points: a box of another reading holds clearly more
_LEAST_WINS, _WIN_RATIO = 3, 4
"""Boxes that must hold more points in another reading, and how many for each that holds fewer. No other reading passes
on 820 right frames: one of nuScenes and 40 streets, turned, thinned, with jittered labels."""

_LONG_M, _LEAST_LONG, _MOST_LONG = 3.0, 3, 0.75
"""Boxes longer than this are vehicles, longest along their length: 3 of them at least, three quarters of all."""

_NEAR_M = 40.0  # boxes farther away stand on another height of the road
_ELSEWHERE_M = 200.0  # nothing nearer than this: another frame, or another unit
_MANY_DEG = 2 * math.pi + 1e-3

_OFF_CENTER, _OFF_CENTER_ALONE, _ALIKE = 0.04, 0.08, 0.06
"""Principal points off centre by such a share of the width, in all cameras or in one alone, and by about the same of
the height, are another resolution's. Real ones are off by up to 0.02 of the width, in both directions."""


@dataclass(frozen=True)
class Finding:
    """One probable mistake.

    Attributes:
        where: The camera or key.
        expected: The right value.
        found: The sample's value.
        fix: The step that mends it.
    """

    where: str
    expected: str
    found: str
    fix: str

    def __str__(self) -> str:
        return f"{self.where}: expected {self.expected}, found {self.found}; {self.fix}"


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

    Points in boxes tell the reading of the boxes and the frame of the points; the road in the points tells
    ``ground_z_m``; poses are compared with cameras that stand upright over the road.

    Args:
        sample: A sample or batch as ``RigRetarget`` takes it.
        source: The rig of samples that carry none.

    Raises:
        ArbiviewError: ``RigRetarget`` would refuse the sample too.
    """
    frames = read_frames(sample, source)
    findings = [
        Finding(wrong, f"the name {meant!r}", "a key that is not read", f"did you mean {meant}? Rename it")
        for wrong, meant in misnamed_keys(sample, source is not None or sample.get("rig") is not None).items()
    ]
    findings += _depth_findings(sample.get("depth_m"))
    for frame in frames:
        # Holes of an earlier retargeting are masks too, of any shape.
        own_masks = sample.get("coverage") is None and sample.get("ego_mask") is None
        findings += check_rig(frame.rig, masks=own_masks)
        findings += _image_findings(frame)
        boxes, points = frame.array("boxes_3d"), frame.array("points")
        boxes = None if boxes is None else checked_boxes(boxes)
        points = None if points is None else checked_points(points)
        findings += _label_findings(frame.rig, boxes, points)
    return CheckReport(tuple(dict.fromkeys(findings)))


def check_rig(rig: Rig, *, masks: bool = True) -> list[Finding]:
    """Mistakes in poses, intrinsics and, where ``masks``, masks alone."""
    findings = []
    mistake = pose_mistake(rig.cam2ego, rig.ground_z_m)
    if mistake is not None:
        expected = "cameras upright over the road: cam2ego with axes right, down, forward, in metres"
        findings.append(Finding("cam2ego", expected, *mistake))
    for camera, mounted in zip(rig, is_mounted(rig.cam2ego, rig.ground_z_m), strict=True):
        if mistake is None and not mounted:
            at = ", ".join(f"{x:.1f}" for x in camera.center_m)
            fix = "compare it with the other cameras': metres, and cam2ego instead of its inverse?"
            findings.append(Finding(f"camera {camera.name!r}: cam2ego", "a place on a vehicle", f"({at}) m", fix))
    findings += _resolution_findings(rig)
    for camera in rig:
        if found := focal_mistake(camera):
            findings.append(Finding(f"camera {camera.name!r}: K", "a focal length in pixels", *found))
        if camera.mask is None or not masks:
            continue
        turned = int((without_specks(camera.mask) != camera.mask).sum())
        if turned:
            fix = f"clean it: {CLEANING}"
            findings.append(
                Finding(f"camera {camera.name!r}: mask", "whole regions", f"specks of {turned} pixels", fix)
            )
        upper = camera.mask[: camera.height_px // 3].mean()
        if upper < 0.2 < camera.mask.mean():
            seen = f"{1 - upper:.0%} of the upper third hidden"
            findings.append(Finding(f"camera {camera.name!r}: mask", "True on the scene", seen, "pass ~mask"))
    return findings


def _resolution_findings(rig: Rig) -> Iterator[Finding]:
    sizes = np.array([(camera.width_px, camera.height_px) for camera in rig])
    off = (rig.K[:, :2, 2] + 0.5) / sizes - 0.5
    together = (np.abs(off[:, 0]) > _OFF_CENTER).all() and len(set(np.sign(off[:, 0]))) == 1
    least = _OFF_CENTER if together else _OFF_CENTER_ALONE
    for camera, (x, y), (w, h) in zip(rig, off, sizes, strict=True):
        if abs(x) > least and abs(x - y) < _ALIKE:
            center = f"({camera.K[0, 2]:.0f}, {camera.K[1, 2]:.0f})"
            yield Finding(
                f"camera {camera.name!r}: K",
                f"a principal point near the middle of {w} x {h} pixels",
                f"{center}, the middle of about {w * (1 + 2 * x):.0f} x {h * (1 + 2 * y):.0f}",
                "is K of another resolution? Camera.resize scales it",
            )


def _image_findings(frame: Frame) -> Iterator[Finding]:
    for camera, circle in dark_rims(frame.rig, frame.images):
        yield Finding(
            f"camera {camera.name!r}: image",
            "a mask that hides the dark rim around the image circle",
            f"no mask, and {1 - circle.holds(camera).mean():.0%} of the image that would be read as scene",
            f"mask it: {CLEANING}",
        )


def _depth_findings(depth_m: Any) -> Iterator[Finding]:
    maps = depth_m if isinstance(depth_m, list | tuple) else [] if depth_m is None else [depth_m]
    arrays = [as_array("depth_m", one) for one in maps]
    nearest_m = min((float(array[array > 0].min(initial=np.inf)) for array in arrays), default=np.inf)
    if _ELSEWHERE_M < nearest_m < np.inf:
        found = f"the nearest pixel {nearest_m:.0f} m away"
        yield Finding("depth_m", "metres, 0 where unknown", found, "is it in millimetres? Divide by 1000")


# --- boxes and points -------------------------------------------------------------------------------------------------
def _label_findings(rig: Rig, boxes: FloatArray | None, points: Points | None) -> list[Finding]:
    findings = []
    for key, rows in (("boxes_3d", boxes), ("points", points)):
        nearest_m = np.inf if rows is None else np.hypot(rows[:, 0], rows[:, 1]).min(initial=np.inf)
        if _ELSEWHERE_M < nearest_m < np.inf:
            fix = "are they in the world's frame? Apply inv(ego2world), to yaw too; or in millimetres? Divide by 1000"
            findings.append(Finding(key, "positions around the vehicle", f"the nearest {nearest_m:.0f} m away", fix))
    if findings:
        return findings
    road_m = None if points is None else road_height_m(points)
    if boxes is not None and (np.abs(boxes[:, 6]) > _MANY_DEG).any():
        largest = float(np.abs(boxes[:, 6]).max())
        return [Finding("boxes_3d", "yaw in radians", f"yaw up to {largest:.1f}", "pass degrees through torch.deg2rad")]
    if boxes is not None and len(boxes):
        objects = None
        if points is not None:
            level_m = rig.ground_z_m if road_m is None else road_m
            objects = points[(points[:, 2] > level_m + _OVER_ROAD_M) & ~own_car(points)]
            turned = _frame_finding(boxes, objects, level_m - rig.ground_z_m)
            if turned is not None:
                return [turned]
        findings += list(_box_findings(rig, boxes, objects))
    if road_m is not None and abs(road_m - rig.ground_z_m) > ROAD_M:
        findings.append(_road_finding(rig, boxes, road_m))
    return findings


def road_height_m(points: Points) -> float | None:
    """Height of the road around the vehicle: the median over directions of each one's low points; None if unknown."""
    points = points[~own_car(points)]
    x, y, z = points[np.hypot(points[:, 0], points[:, 1]) < _ROAD_RADIUS_M, :3].T
    sector = ((np.arctan2(y, x) / (2 * np.pi) + 0.5) * _SECTORS).astype(int) % _SECTORS
    of_sectors = [z[sector == k] for k in range(_SECTORS)]
    low = [np.percentile(heights, _ROAD_PERCENTILE) for heights in of_sectors if len(heights) >= _LEAST_IN_SECTOR]
    return float(np.median(low)) if len(low) >= _LEAST_SECTORS else None


def _road_finding(rig: Rig, boxes: FloatArray | None, road_m: float) -> Finding:
    seen = f"{road_m:+.2f} in the points"
    stand = None if boxes is None else _bottoms_m(rig, boxes)
    if road_m - rig.ground_z_m < -_LIDAR_HEIGHT_M and (stand is None or abs(float(np.median(stand[0]))) < ROAD_M * 2):
        fix = "are the points in the LiDAR's frame? Apply lidar2ego to them"
        return Finding("points", f"the road at z = {rig.ground_z_m:+.2f} m, as ground_z_m says", seen, fix)
    fix = f"set ground_z_m={road_m:.2f}; or, if points and boxes are in the LiDAR's frame, apply lidar2ego to both"
    return Finding("ground_z_m", f"the road's height, {seen}", f"{rig.ground_z_m:+.2f}", fix)


def _bottoms_m(rig: Rig, boxes: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Heights (n,) of the near boxes' bottoms over the road, and the boxes' own; None where there are too few."""
    near = boxes[np.hypot(boxes[:, 0], boxes[:, 1]) < _NEAR_M]
    return (near[:, 2] - near[:, 5] / 2 - rig.ground_z_m, near[:, 5]) if len(near) >= _LEAST_WINS else None


def _box_findings(rig: Rig, boxes: FloatArray, objects: Points | None) -> Iterator[Finding]:
    """Another order of the columns, another yaw, another height of the centre."""
    order = _order_finding(boxes, objects)
    if order is not None:
        yield order
        return
    if objects is not None:
        yaw, quarter = boxes[:, 6], math.pi / 2
        yaws = {"-yaw": -yaw, "yaw + pi / 2": yaw + quarter, "pi / 2 - yaw": quarter - yaw}
        readings = {name: np.column_stack([boxes[:, :6], other]) for name, other in yaws.items()}
        leads = {n: _lead(other, boxes, objects, _informative(boxes, other)) for n, other in readings.items()}
        best = max(leads, key=lambda name: leads[name])
        if leads[best]:
            expected, seen = "yaw counter-clockwise from the x axis", f"more points in the boxes of {best}"
            yield Finding("boxes_3d", expected, seen, f"pass {best}")
    lifted = boxes + np.array([0, 0, 0.5, 0, 0, 0, 0]) * boxes[:, 5:6]
    bottoms = _bottoms_m(rig, boxes)
    sunk = False
    if objects is not None:
        sunk = _lead(lifted, boxes, objects) > 0
    elif bottoms is not None:
        share = bottoms[0] / bottoms[1]
        sunk = bool(abs(np.median(share) + 0.5) < 0.15 and np.ptp(np.percentile(share, [25, 75])) < 0.3)
    if sunk:
        seen, fix = "more points inside if z is the bottom", "add half the height to z"
        if objects is None:
            seen, fix = "boxes half below the road", f"{fix}, or is ground_z_m wrong?"
        yield Finding("boxes_3d", "z of the box's centre", seen, fix)


def _order_finding(boxes: FloatArray, objects: Points | None) -> Finding | None:
    """Vehicles that are wider or higher than long; points decide between the first and a yaw that fits it."""
    long = boxes[boxes[:, 3:6].max(axis=1) > _LONG_M]
    if len(long) < _LEAST_LONG:
        return None
    share = np.bincount(long[:, 3:6].argmax(axis=1), minlength=3) / len(long)
    expected = "columns x y z length width height yaw"
    if share[2] >= _MOST_LONG:
        seen = f"{share[2]:.0%} of {len(long)} vehicles highest along the sixth column"
        return Finding("boxes_3d", expected, seen, "is it height, width, length? Reorder the columns")
    if share[1] < _MOST_LONG:
        return None
    other = boxes[:, [0, 1, 2, 4, 3, 5, 6]]
    if objects is not None and _lead(boxes, other, objects, _informative(boxes, other)):
        return None  # the yaw is counted from the other side, and the boxes are right
    seen = f"{share[1]:.0%} of {len(long)} vehicles wider than long"
    return Finding("boxes_3d", expected, seen, "is it width, length, height? Swap columns 3 and 4")


def _frame_finding(boxes: FloatArray, objects: Points, offset_m: float) -> Finding | None:
    """Points that fit the boxes once they are turned by quarters and put on the road."""
    leads = []
    for quarters in range(4):
        c, s = (round(f(quarters * math.pi / 2)) for f in (math.cos, math.sin))
        moved = objects @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T - (0, 0, offset_m)
        is_same = quarters == 0 and abs(offset_m) < _LIDAR_HEIGHT_M
        leads.append(0 if is_same else _lead(boxes, boxes, moved, points=objects))
    best = int(np.argmax(leads))
    if not leads[best]:
        return None
    is_clear = leads[best] > 2 * sorted(leads)[-2]
    turn = ("", "turned by -90 degrees", "turned by 180 degrees", "turned by 90 degrees")[best] if is_clear else "moved"
    lower = f"{abs(offset_m):.1f} m {'lower' if offset_m < 0 else 'higher'}" if abs(offset_m) > ROAD_M else ""
    seen = f"points {' and '.join(filter(None, (turn, lower)))}"
    fix = "are they in the LiDAR's frame? Apply lidar2ego to them"
    return Finding("points", "points and boxes in one ego frame", seen, fix)


def _informative(one: FloatArray, two: FloatArray) -> Any:
    """Boxes (B,) bool of which two readings clearly differ: not square, and not turned by half a turn."""
    sides = np.sort(one[:, 3:5], axis=1)
    quarter = np.where(one[:, 3] == two[:, 3], 0.0, math.pi / 2)  # sides were swapped
    apart = np.abs((two[:, 6] - one[:, 6] + quarter + math.pi / 2) % math.pi - math.pi / 2)
    return (sides[:, 1] > 1.5 * sides[:, 0]) & (apart > math.radians(15))


def _lead(
    one: FloatArray, two: FloatArray, objects: Points, which: Any = slice(None), *, points: Points | None = None
) -> int:
    """By how many points one reading of the boxes holds more than another, if it clearly does; else 0.

    ``points`` are those of the other reading, if not the same.
    """
    counts, others = _counts(one[which], objects), _counts(two[which], objects if points is None else points)
    wins, losses = _wins(counts, others), _wins(others, counts)
    if wins < _LEAST_WINS or wins < _WIN_RATIO * losses:
        return 0
    return max(0, int((counts.clip(max=_MOST_POINTS) - others.clip(max=_MOST_POINTS)).sum()))


def _counts(boxes: FloatArray, points: Points) -> FloatArray:
    return np.array([len(inside) for inside in points_in(boxes, points)], np.float64)


def _wins(counts: FloatArray, others: FloatArray) -> int:
    """The number of boxes with clearly more points."""
    return int(((counts >= _LEAST_POINTS) & (counts > _BETTER * others)).sum())
