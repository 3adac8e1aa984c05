"""A data step for OpenPCDet: the ``data_dict`` of its data sets, as another vehicle would have recorded it.

Points are (N, >=3) float32 x y z ..., boxes ``gt_boxes`` (M, >=7) x y z dx dy dz heading [vx vy] with z at the centre,
both in the LiDAR's frame.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.random_rig import RandomRig
from arbiview_aug.cameras.validation import checked_pose, refusal
from arbiview_aug.choices import is_number
from arbiview_aug.errors import SampleError
from arbiview_aug.integrations.mmdet3d.matrices import entry, like_array
from arbiview_aug.integrations.mmdet3d.results import check_as_recorded, geometry, moved_points
from arbiview_aug.integrations.mmdet3d.transform import RigRetargetMultiView
from arbiview_aug.scene.boxes import checked_boxes, moved_by, points_by_box
from arbiview_aug.transforms.scans import retarget_points
from arbiview_aug.transforms.settings import checked_probability

DataDict = dict[str, Any]

MATRICES = ("camera_intrinsics", "camera2ego", "camera2lidar", "lidar2camera", "lidar2image")
"""Lists of (4, 4) that ``NuScenesDataset.load_camera_info`` writes next to ``camera_imgs``."""

_LEAST_UP = 0.9  # z of the upward axis of a frame in which boxes are upright


class _Step(RigRetargetMultiView):
    _refuses_lenses = False  # points need no cameras; ``target_views`` refuses lenses where images are rendered


class RigRetargetDataDict:
    """Retargets a ``data_dict``: points, and images with their calibration where it holds them.

    Place it before everything that turns, flips or scales the scene or the images: first in ``DATA_AUGMENTOR``, or
    after ``gt_sampling``, whose pasted objects are then scanned too; or in ``__getitem__`` before ``prepare_data``.

    Args:
        target: A rig's name, file, ``Rig`` or ``RandomRig``. With ``lidars``: points are those of its scanners. With
            images: of pinhole cameras (``Rig.undistorted()``).
        lidar2ego: (4, 4) pose of the frame of points and boxes in the source's ego frame.
        target_lidar2ego: (4, 4) pose of the output's frame, as in B's data set; by default that of the input.
        min_points_in_gt: Boxes with fewer points after retargeting are left out: OpenPCDet's
            ``FILTER_MIN_POINTS_IN_GT``, which counts those before.
        p: Probability of retargeting; a skipped dict is unchanged.
        settings: Further options of ``RigRetargetMultiView``: ``size``, ``ground_z_m``, ``geometry``, ``keys``,
            ``sequence_key`` (frames of a drive share the draw of ``p`` too; ``self.step.set_epoch`` changes it).

    Raises:
        CalibrationError: A target that cannot be loaded; a frame that is not upright.
        ValueError: ``p`` is no probability, ``min_points_in_gt`` no number.
    """

    def __init__(
        self,
        target: Any,
        *,
        lidar2ego: Any,
        target_lidar2ego: Any = None,
        min_points_in_gt: int = 0,
        p: float = 1.0,
        **settings: Any,
    ) -> None:
        self.step = _Step(target, lidar2ego=lidar2ego, **settings)
        self.lidar2ego = _upright_pose("lidar2ego", lidar2ego)
        to = self.lidar2ego if target_lidar2ego is None else _upright_pose("target_lidar2ego", target_lidar2ego)
        self.ego2lidar = np.asarray(np.linalg.inv(self.lidar2ego))
        self.move = np.linalg.inv(to) @ self.lidar2ego  # to the frame of what comes out
        if not is_number(min_points_in_gt):
            raise ValueError(f"min_points_in_gt: expected a number of points, got {min_points_in_gt!r}")
        self.p, self.min_points_in_gt = checked_probability(p), int(min_points_in_gt)

    def __call__(self, data_dict: Mapping[str, Any]) -> DataDict:
        """A new ``data_dict``; ``calib`` is the given object, which becomes that of the new frame.

        ``DatasetTemplate.prepare_data`` restores the object that it was given after all augmentors.

        Raises:
            SampleError: A scene that is turned already, images without matrices or of KITTI, nothing to retarget.
            CalibrationError: Images, and a target with lenses.
        """
        if self.p < 1 and torch.rand((), generator=self.step.rng(data_dict, "p")).item() >= self.p:
            return dict(data_dict)
        check_as_recorded(data_dict)
        if not isinstance(points := data_dict.get("points"), np.ndarray):
            got = f"{type(points).__name__} among {', '.join(map(str, data_dict))}"
            raise SampleError(f"points: expected an array (N, >=3) in the LiDAR's frame, got {got}")
        if "camera_imgs" in data_dict:
            out = self._with_cameras(data_dict)
        elif "images" in data_dict:
            fix = "leave 'images' out of GET_ITEM_LIST, or use nuScenes' form (camera_imgs)"
            raise SampleError(f"images: expected points alone, since KITTI's image is not retargeted; {fix}")
        else:
            out = {**data_dict, "points": self._points(data_dict)}
        return self._filtered(_moved(out, self.move))

    # --- points alone, nuScenes' cameras ------------------------------------------------------------------------------
    def _points(self, data_dict: Mapping[str, Any]) -> Any:
        target = self.step.retarget.target
        rig = target.rig(self.step.draw(data_dict)) if isinstance(target, RandomRig) else target
        if self.step.retarget.keys.points == "source":
            return data_dict["points"]
        if not rig.lidars:
            raise SampleError("target: expected scanners (Rig.lidars) for a data_dict without images, got none")
        given = geometry(self._labels(data_dict), self.lidar2ego)
        boxes, ground_z_m = given.get("boxes_3d"), self.step.ground_z_m
        scan = retarget_points(given["points"], rig, boxes_3d=boxes, ground_z_m=ground_z_m)
        return moved_points(scan.points, self.ego2lidar).numpy().astype(data_dict["points"].dtype)

    def _with_cameras(self, data_dict: Mapping[str, Any]) -> DataDict:
        """``NuScenesDataset`` with ``CAMERA_CONFIG``: PIL images, resized and cropped by ``img_process_infos``."""
        if missing := [key for key in MATRICES if key not in data_dict]:
            raise SampleError(f"{', '.join(missing)}: expected beside camera_imgs, found none")
        matrices = {key: [np.asarray(matrix) for matrix in data_dict[key]] for key in MATRICES}
        infos = data_dict.get("img_process_infos")
        if infos is not None:
            with entry("img_process_infos", "(resize, crop, flip, rotate) of each image"):
                matrices["camera_intrinsics"] = [
                    (_crop(*info) @ K).astype(K.dtype)
                    for info, K in zip(infos, matrices["camera_intrinsics"], strict=True)
                ]
            pairs = zip(matrices["camera_intrinsics"], matrices["lidar2camera"], strict=True)
            matrices["lidar2image"] = [K @ pose for K, pose in pairs]
        results = self.step({"img": data_dict["camera_imgs"], **matrices, **self._labels(data_dict)})
        images = results["img"]
        out = {**data_dict, **{key: results[key] for key in (*MATRICES, "points")}, "camera_imgs": images}
        if "image_paths" in data_dict:
            out["image_paths"] = list(self.step.names)
        w, h = images[0].size
        if infos is not None:
            out["img_process_infos"] = [[1.0, (0, 0, w, h), False, 0] for _ in images]
        return out | {"ori_shape": (w, h)}

    def _labels(self, data_dict: Mapping[str, Any]) -> DataDict:
        """All that the step reads besides cameras: the points, the boxes, and the name of the drive."""
        named = {key: value for key, value in data_dict.items() if key == self.step.sequence_key}
        return {**named, "points": data_dict["points"], "gt_bboxes_3d": data_dict.get("gt_boxes")}

    def _filtered(self, out: DataDict) -> DataDict:
        """Count each box's points; leave boxes of fewer points out, by ``gt_boxes_mask`` where it is there."""
        given = out.get("num_points_in_gt")  # Waymo's
        if out.get("gt_boxes") is None or (self.min_points_in_gt < 1 and given is None):
            return out
        xyz = np.ascontiguousarray(out["points"][:, :3], np.float32)
        _, ends = points_by_box(checked_boxes(out["gt_boxes"]), xyz, 0.0)
        counts = np.diff(ends, prepend=0)
        if given is not None:
            out = {**out, "num_points_in_gt": like_array(given, counts)}
        enough: BoolArray = counts >= self.min_points_in_gt
        if "gt_boxes_mask" in out:
            return {**out, "gt_boxes_mask": out["gt_boxes_mask"] & enough}
        kept = {}
        for key in ("gt_boxes", "gt_names", "num_points_in_gt"):
            if out.get(key) is not None:
                with entry(key, f"one of each of the {len(enough)} boxes"):
                    kept[key] = out[key][enough]
        return out | kept


def register(augmentor: Any) -> None:
    """Register ``rig_retarget`` with OpenPCDet's ``DataAugmentor``; keys of its entry are arguments in capitals."""

    def rig_retarget(_: Any, config: Mapping[str, Any]) -> RigRetargetDataDict:
        return RigRetargetDataDict(**{key.lower(): value for key, value in config.items() if key != "NAME"})

    augmentor.rig_retarget = rig_retarget


def _crop(resize: float, crop: Any, flip: bool, rotate: float) -> FloatArray:
    """(4, 4) of a resize and a crop by PIL, whose outer edges are 0 and w: those of ``Camera`` are -0.5 and w - 0.5."""
    if flip or rotate:
        raise SampleError("img_process_infos: expected images that were only resized and cropped; stand before imgaug")
    moved = np.diag([resize, resize, 1.0, 1.0])
    moved[:2, 2] = 0.5 * resize - 0.5 - np.asarray(crop[:2], np.float64)
    return moved


def _moved(out: DataDict, move: FloatArray) -> DataDict:
    """A ``data_dict`` in another frame: ``move`` (4, 4) leads from the old one to it."""
    if np.array_equal(move, np.eye(4)):
        return out
    back = np.linalg.inv(move)
    changed: DataDict = {"points": moved_points(out["points"], move).numpy().astype(out["points"].dtype)}
    if (boxes := out.get("gt_boxes")) is not None:
        changed["gt_boxes"] = moved_by(boxes, move)
    for key in out.keys() & {"lidar2camera", "lidar2image", "camera2lidar"}:
        matrices = [move @ matrix if key == "camera2lidar" else matrix @ back for matrix in out[key]]
        changed[key] = [moved.astype(matrix.dtype) for moved, matrix in zip(matrices, out[key], strict=True)]
    if "trans_lidar_to_cam" in out:  # KITTI's
        changed["trans_lidar_to_cam"] = (out["trans_lidar_to_cam"] @ back).astype(out["trans_lidar_to_cam"].dtype)
    if (calib := out.get("calib")) is not None:
        calib.V2C = (np.asarray(calib.V2C, np.float64) @ back).astype(calib.V2C.dtype)
    return out | changed


def _upright_pose(name: str, value: Any) -> FloatArray:
    pose = checked_pose("", value, name)
    if pose[2, 2] < _LEAST_UP:
        raise refusal("", name, "a frame whose z points up", f"{pose[2, 2]:.2f} of it upwards")
    return pose
