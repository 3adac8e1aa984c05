"""``results`` dicts of every documented shape, made of a synthetic sample: for the example and the tests."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from arbiview_aug import Rig
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rotations import rotation_z
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.integrations.mmdet3d.transform import MEAN_STD

SPEED_MPS = 9.0
LIDAR2EGO = np.eye(4)
LIDAR2EGO[:3, :3] = rotation_z(-90)  # nuScenes' LiDAR looks to the right
LIDAR2EGO[:3, 3] = 0.94, 0.0, 1.84
EGO2GLOBAL = np.eye(4)
EGO2GLOBAL[:3, :3] = rotation_z(35)
EGO2GLOBAL[:3, 3] = 600.0, 1640.0, 0.0


class Boxes:
    """The part that is read of mmdet3d's ``LiDARInstance3DBoxes``: numbers and corners of boxes in the LiDAR's frame.

    Args:
        boxes_ego: (B, >=7) centre, length, width, height and yaw in the ego frame.
        is_old: As before mmdet3d 1.0: x is the width's axis, and the yaw counts clockwise.
    """

    def __init__(self, boxes_ego: FloatArray, *, is_old: bool = False) -> None:
        signs = np.array([[-1, -1, -1], [-1, -1, 1], [-1, 1, 1], [-1, 1, -1], [1, -1, -1], [1, -1, 1], [1, 1, 1]])
        signs = np.vstack([signs, [1, 1, -1]])
        corners = [signs / 2 * box[3:6] @ rotation_z(np.degrees(box[6])).T + box[:3] for box in boxes_ego]
        x = _in_lidar(np.array(corners).reshape(-1, 8, 3))
        yaw = boxes_ego[:, 6] - np.arctan2(LIDAR2EGO[1, 0], LIDAR2EGO[0, 0])
        if is_old:
            x, yaw = x[:, [4, 5, 1, 0, 7, 6, 2, 3]], -yaw - np.pi / 2
        self.tensor = torch.from_numpy(np.column_stack([x.mean(axis=1), boxes_ego[:, 3:6], yaw]))
        self._corners, self._is_old = torch.from_numpy(x), is_old

    @property
    def corners(self) -> torch.Tensor:
        """(B, 8, 3)."""
        assert len(self.tensor) or not self._is_old
        return self._corners


def _in_lidar(points_ego: FloatArray) -> FloatArray:
    """Points (..., >=3) in the LiDAR's frame."""
    ego2lidar, moved = np.linalg.inv(LIDAR2EGO), points_ego.copy()
    moved[..., :3] = points_ego[..., :3] @ ego2lidar[:3, :3].T + ego2lidar[:3, 3]
    return moved


def source_rig(size: tuple[int, int]) -> Rig:
    """The synthetic street's six cameras by nuScenes' names, in BEVDet's order."""
    rig = demo_source_rig(size)
    order = ("front_left", "front", "front_right", "back_left", "back", "back_right")
    return rig.with_cameras([replace(rig[name], name=f"CAM_{name.upper()}") for name in order])


class Recording(NamedTuple):
    """A sample and how it was recorded: each camera a little before or after the LiDAR, on a moving vehicle.

    Attributes:
        sample: Its ``rig`` has each camera where it was when it exposed.
        rig: Poses of the cameras.
        moved: (N, 4, 4) the ego then, in the ego frame at the LiDAR's time.
        mounted: (N, 4, 4) where the cameras are mounted.
        ego2global: (4, 4) the ego at the LiDAR's time.
        K, lidar2cam: (N, 4, 4).
        arrays: Images (H, W, 3) BGR.
        labels: Points and boxes as loaded, in the LiDAR's frame.
    """

    sample: dict[str, Any]
    rig: Rig
    moved: FloatArray
    mounted: FloatArray
    ego2global: FloatArray
    K: FloatArray
    lidar2cam: FloatArray
    arrays: list[np.ndarray]
    labels: dict[str, Any]


def recording(sample: dict[str, Any], ahead_m: float = 0.0) -> Recording:
    """The sample as of a vehicle at ``SPEED_MPS`` whose cameras exposed up to 40 ms before the LiDAR turned by."""
    rig: Rig = sample["rig"]
    moved, K, ahead = np.tile(np.eye(4), (len(rig), 1, 1)), np.tile(np.eye(4), (len(rig), 1, 1)), np.eye(4)
    moved[:, 0, 3], K[:, :3, :3], ahead[0, 3] = -SPEED_MPS * np.linspace(0.005, 0.04, len(rig)), rig.K, ahead_m
    points = torch.from_numpy(_in_lidar(sample["points"].double().numpy())).float()
    return Recording(
        sample=sample,
        rig=rig,
        moved=moved,
        mounted=np.linalg.inv(moved) @ rig.cam2ego,
        ego2global=EGO2GLOBAL @ ahead,
        K=K,
        lidar2cam=np.linalg.inv(rig.cam2ego) @ LIDAR2EGO,
        arrays=[np.ascontiguousarray(image.permute(1, 2, 0).numpy()[..., ::-1]) for image in sample["images"]],
        labels={"points": points, "gt_bboxes_3d": Boxes(sample["boxes_3d"].double().numpy())},
    )


def recorded_drive(samples: Sequence[dict[str, Any]]) -> list[Recording]:
    """Frames of one drive every 0.5 s, the current one last, straight ahead at ``SPEED_MPS``."""
    return [recording(sample, SPEED_MPS * 0.5 * t) for t, sample in enumerate(samples)]


def mmdet3d(given: Recording) -> dict[str, Any]:
    """After mmdet3d's ``LoadMultiViewImageFromFiles`` on version 1.1 infos of nuScenes."""
    infos = {
        camera.name: {
            "img_path": f"{camera.name}.jpg",
            "cam2img": K[:3, :3].tolist(),
            "cam2ego": mounted.tolist(),
            "lidar2cam": lidar2cam.tolist(),
        }
        for camera, K, mounted, lidar2cam in zip(given.rig, given.K, given.mounted, given.lidar2cam, strict=True)
    }
    shape = given.rig.sizes[0]
    return {
        "images": infos,
        "lidar_points": {"lidar2ego": LIDAR2EGO.tolist()},
        "filename": [info["img_path"] for info in infos.values()],
        "cam2img": [info["cam2img"] for info in infos.values()],
        "lidar2cam": [info["lidar2cam"] for info in infos.values()],
        "ori_cam2img": [info["cam2img"] for info in infos.values()],
        "lidar2img": list(given.K @ given.lidar2cam),
        "cam2global": list(given.ego2global @ given.rig.cam2ego),
        "cam_instances": {name: [] for name in infos},
        "img": given.arrays,
        **{key: shape for key in ("img_shape", "ori_shape", "pad_shape")},
        "num_views": len(infos),
        **given.labels,
    }


def mmdet3d_bevfusion(given: Recording) -> dict[str, Any]:
    """After ``BEVLoadMultiViewImageFromFiles`` of mmdet3d's project BEVFusion."""
    results = mmdet3d(given)
    lidar2cam = given.lidar2cam
    return {key: results[key] for key in ("images", "lidar_points", "num_views", "img_shape", "ori_shape")} | {
        "img": [image[..., ::-1].astype(np.float32) for image in given.arrays],
        "img_path": results["filename"],
        "cam2img": given.K.astype(np.float32),
        "ori_cam2img": given.K.astype(np.float32),
        "lidar2cam": lidar2cam,
        "cam2lidar": np.linalg.inv(lidar2cam),
        "lidar2img": given.K @ lidar2cam,
        **given.labels,
    }


def mit_bevfusion(given: Recording) -> dict[str, Any]:
    """After ``LoadMultiViewImageFromFiles`` of mit-han-lab's BEVFusion: PIL images, (w, h) shapes."""
    from PIL import Image

    K, lidar2cam = given.K.astype(np.float32), given.lidar2cam.astype(np.float32)
    size = given.rig.sizes[0][::-1]
    return {
        "image_paths": [f"{name}.jpg" for name in given.rig.names],
        "filename": [f"{name}.jpg" for name in given.rig.names],
        "lidar2ego": LIDAR2EGO.astype(np.float32),
        "camera_intrinsics": list(K),
        "camera2ego": list(given.mounted.astype(np.float32)),
        "camera2lidar": list(np.linalg.inv(lidar2cam)),
        "lidar2camera": list(lidar2cam),
        "lidar2image": list(K @ lidar2cam),
        "img": [Image.fromarray(np.ascontiguousarray(image[..., ::-1])) for image in given.arrays],
        **{key: size for key in ("img_shape", "ori_shape", "pad_shape")},
        **given.labels,
    }


def detr3d(given: Recording) -> dict[str, Any]:
    """After ``LoadMultiViewImageFromFiles(to_float32=True)`` of mmdet3d before 1.0, with DETR3D's matrices."""
    shape = (*given.rig.sizes[0], 3, len(given.rig))
    boxes = Boxes(given.sample["boxes_3d"].double().numpy(), is_old=True)
    return {
        "img_filename": [f"{name}.jpg" for name in given.rig.names],
        "img": [image.astype(np.float32) for image in given.arrays],
        "lidar2img": list(given.K @ given.lidar2cam),
        "cam_intrinsic": list(given.K),
        "lidar2cam": list(given.lidar2cam),
        **{key: shape for key in ("img_shape", "ori_shape", "pad_shape")},
        "scale_factor": 1.0,
        "ann_info": {"gt_bboxes_3d": boxes, "bboxes": np.zeros((0, 4))},
    }


def petr(given: Recording) -> dict[str, Any]:
    """The same for PETR: ``extrinsics`` are transposed."""
    results = detr3d(given)
    K, lidar2cam = results.pop("cam_intrinsic"), results.pop("lidar2cam")
    return results | {
        "intrinsics": K,
        "extrinsics": [pose.T for pose in lidar2cam],
        "timestamp": 1.5,
        "img_timestamp": [1.5 - 0.01 * k for k in range(len(K))],
    }


def bevdet(given: Recording) -> dict[str, Any]:
    """After BEVDet's ``PrepareImageInputs`` in training: PIL's resize and crop; the second image also flipped."""
    from PIL import Image

    mean, std = (torch.tensor(numbers)[:, None, None] for numbers in MEAN_STD)
    images, rotations, shifts = [], [], []
    h, w = given.rig.sizes[0]
    scale, top = 0.75, round(h * 0.75) // 4
    size = round(w * scale), round(h * scale)
    for k, array in enumerate(given.arrays):
        image = Image.fromarray(array).resize(size, Image.Resampling.BILINEAR).crop((0, top, size[0], size[1]))
        rotation, shift = scale * torch.eye(3), torch.tensor([0.0, -top, 0.0])
        rotation[2, 2] = 1
        if k == 1:
            image = image.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
            mirror = torch.diag(torch.tensor([-1.0, 1.0, 1.0]))
            rotation, shift = mirror @ rotation, mirror @ shift + torch.tensor([size[0], 0.0, 0.0])
        images.append((torch.from_numpy(np.array(image)).permute(2, 0, 1).float() - mean) / std)
        rotations.append(rotation)
        shifts.append(shift)
    entries = (
        torch.stack(images),
        torch.from_numpy(given.mounted).float(),
        torch.from_numpy(given.ego2global @ given.moved).double(),
        torch.from_numpy(given.rig.K).float(),
        torch.stack(rotations),
        torch.stack(shifts),
        torch.eye(3),
    )
    boxes = given.sample["boxes_3d"].double().numpy()
    boxes[:, :3] -= given.moved[given.rig.names.index("CAM_FRONT"), :3, 3]
    return {
        "img_inputs": entries,
        "cam_names": given.rig.names,
        "canvas": given.arrays,
        "ann_infos": (boxes, [0] * len(boxes)),
    }


def sparse4d(given: Recording) -> dict[str, Any]:
    """After Sparse4D's ``LoadMultiViewImageFromFiles`` and ``LoadPointsFromFile``, in training."""
    quaternion = [np.cos(np.pi / 4), 0.0, 0.0, -np.sin(np.pi / 4)]  # LIDAR2EGO's
    boxes = _in_lidar(given.sample["boxes_3d"].double().numpy())
    boxes[:, 6] += np.pi / 2
    return {
        "img_filename": [f"{name}.jpg" for name in given.rig.names],
        "img": [image.astype(np.float32) for image in given.arrays],
        "lidar2img": list(given.K @ given.lidar2cam),
        "cam_intrinsic": list(given.K[:, :3, :3]),
        "lidar2ego_rotation": quaternion,
        "lidar2ego_translation": LIDAR2EGO[:3, 3].tolist(),
        "lidar2global": given.ego2global @ LIDAR2EGO,
        "img_shape": [(*size, 3) for size in given.rig.sizes],
        "aug_config": {"resize": 1.0, "flip": False, "rotate": 0, "rotate_3d": 0.0},
        "timestamp": 1.5,
        "points": given.labels["points"].numpy(),
        "gt_bboxes_3d": boxes,
    }


def bevdet4d(drive: Sequence[Recording]) -> dict[str, Any]:
    """After BEVDet's ``PrepareImageInputs(sequential=True)``: the current frame and those before, latest first."""
    frames = [bevdet(given) for given in reversed(drive)]
    entries = [frame["img_inputs"] for frame in frames]
    images = torch.stack([of_frame[0] for of_frame in entries], dim=1).flatten(0, 1)  # by camera, then by frame
    rest = [torch.cat([of_frame[k] for of_frame in entries]) for k in range(1, 6)]
    infos = [{"cams": {}, "ann_infos": frame["ann_infos"], "scene_token": "drive"} for frame in frames]
    return frames[0] | {"img_inputs": (images, *rest, torch.eye(3)), "curr": infos[0], "adjacent": infos[1:]}


FORMS: dict[str, Callable[[Recording], dict[str, Any]]] = {
    "mmdet3d": mmdet3d,
    "mmdet3d BEVFusion": mmdet3d_bevfusion,
    "mit-han-lab BEVFusion": mit_bevfusion,
    "DETR3D": detr3d,
    "PETR": petr,
    "BEVDet": bevdet,
    "Sparse4D": sparse4d,
}
"""A maker of each form by its framework's name."""
