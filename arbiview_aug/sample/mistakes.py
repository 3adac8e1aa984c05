"""``check``: mistakes in a sample that rendering cannot notice, found from its points, boxes, poses and masks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import Finding, doubts, is_rigid
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.sample.camera_mistakes import neighbour_errors, neighbour_findings, own_car_share
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import focal_mistake, misnamed_keys, read_frames
from arbiview_aug.sample.label_mistakes import ELSEWHERE_M, label_findings
from arbiview_aug.sample.masks import CLEANING, dark_rims, without_specks
from arbiview_aug.scene.boxes import checked_boxes
from arbiview_aug.scene.point_cloud import checked_points

_MOVED = 0.5  # largest change of one vehicle's poses: some data sets add its way between the cameras' times
_LEAST_FRAMES = 3  # that show the own car
_MOST_HIDDEN = 0.9  # of an image by its mask; a fisheye's rim hides up to a half


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
    findings = [
        Finding(wrong, f"the name {meant!r}", "a key that is not read", f"did you mean {meant}? Rename it")
        for wrong, meant in misnamed_keys(sample, source is not None or sample.get("rig") is not None).items()
    ]
    depth_m = sample.get("depth_m")
    maps = depth_m if isinstance(depth_m, list | tuple) else [] if depth_m is None else [depth_m]
    arrays = [as_array("depth_m", depth) for depth in maps]
    nearest_m = min((float(array[array > 0].min(initial=np.inf)) for array in arrays), default=np.inf)
    if ELSEWHERE_M < nearest_m < np.inf:
        found = f"the nearest pixel {nearest_m:.0f} m away"
        findings.append(Finding("depth_m", "metres, 0 where unknown", found, "is it in millimetres? Divide by 1000"))
    # Holes of an earlier retargeting are masks too, of any shape.
    is_recorded = sample.get("coverage") is None
    for frame in frames:
        rig_findings = check_rig(frame.rig, masks=is_recorded and sample.get("ego_mask") is None)
        findings += rig_findings
        for camera, circle in dark_rims(frame.rig, frame.images):
            expected = "a mask that hides the dark rim around the image circle"
            found = f"no mask, and {1 - circle.holds(camera).mean():.0%} of the image that would be read as scene"
            findings.append(Finding(f"camera {camera.name!r}: image", expected, found, f"mask it: {CLEANING}"))
        boxes = None if frame.boxes is None else checked_boxes(as_array("boxes_3d", frame.boxes))
        points = None if frame.points is None else checked_points(as_array("points", frame.points))
        # Images tell nothing through poses that are all wrong.
        wrong = [finding.where for finding in rig_findings if finding.where.endswith("cam2ego")]
        is_clear = is_recorded and "cam2ego" not in wrong and 2 * len(wrong) <= len(frame.rig)
        findings += label_findings(frame.rig, frame.images if is_clear else (), boxes, points, _pose(frame))
        if is_clear:
            findings += neighbour_findings(neighbour_errors(frame.rig, frame.images))
    if is_recorded and sample.get("ego_mask") is None:
        findings += check_own_car(frames)
    return CheckReport(tuple(dict.fromkeys(findings)))


def check_own_car(frames: Sequence[Frame]) -> list[Finding]:
    """Cameras without a mask that see their moving vehicle, in frames with poses."""
    first, rigs = frames[0].rig, [frame.rig for frame in frames]
    poses = [pose for frame in frames if (pose := _pose(frame)) is not None]
    same = all(rig.names == first.names and rig.sizes == first.sizes for rig in rigs)
    same = same and all(np.allclose(rig.cam2ego, first.cam2ego, atol=_MOVED) for rig in rigs)
    findings = []
    for k, camera in enumerate(first if same and len(poses) == len(frames) >= _LEAST_FRAMES else ()):
        images = [frame.images[k] for frame in frames]
        if camera.mask is None and (share := own_car_share(camera, images, poses, first.ground_z_m)):
            found = f"no mask, and edges that stay while the road moves: about {share:.0%} of the image"
            fix = "mask it in the rig file: True on the scene"
            findings.append(Finding(f"camera {camera.name!r}: mask", "a mask that hides the own car", found, fix))
    return findings


def _pose(frame: Frame) -> FloatArray | None:
    """The frame's ``ego2world`` (4, 4); None without one, or if it is no pose: only neighbours need one."""
    pose = frame.further.get("ego2world")
    pose = None if pose is None else np.asarray(as_array("ego2world", pose), np.float64)
    return pose if pose is not None and is_rigid(pose) else None


def check_rig(rig: Rig, *, masks: bool = True) -> list[Finding]:
    """Mistakes in poses, intrinsics and, if ``masks``, masks of a rig alone."""
    findings = doubts(rig.cameras, rig.ground_z_m)
    for camera in rig:
        if found := focal_mistake(camera):
            findings.append(Finding(f"camera {camera.name!r}: K", "a focal length in pixels", *found))
        if camera.mask is None or not masks:
            continue
        where = f"camera {camera.name!r}: mask"
        if turned := int((without_specks(camera.mask) != camera.mask).sum()):
            findings.append(Finding(where, "whole regions", f"specks of {turned} pixels", f"clean it: {CLEANING}"))
        hidden, upper = (1 - mask.mean() for mask in (camera.mask, camera.mask[: camera.height_px // 3]))
        if hidden > _MOST_HIDDEN or (upper > 0.8 > hidden):
            share = f"{hidden:.0%} of the image" if hidden > _MOST_HIDDEN else f"{upper:.0%} of the upper third"
            findings.append(Finding(where, "True on the scene", f"{share} hidden", "pass ~mask"))
    return findings
