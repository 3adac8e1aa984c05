"""``results`` dicts of every documented shape, made of a synthetic sample: for the example and the tests."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from arbiview_aug import Rig
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rotations import rotation_z
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.integrations.mmdet3d.bevdet import MEAN_STD

SPEED_MPS = 9.0
LIDAR2EGO = np.eye(4)
LIDAR2EGO[:3, :3] = rotation_z(-90)  # nuScenes' LiDAR looks to the right
LIDAR2EGO[:3, 3] = 0.94, 0.0, 1.84
EGO2GLOBAL = np.eye(4)
EGO2GLOBAL[:3, :3] = rotation_z(35)
EGO2GLOBAL[:3, 3] = 600.0, 1640.0, 0.0


class Boxes:
    """What is read of mmdet3d's ``LiDARInstance3DBoxes``: eight corners a box, in the LiDAR's frame."""

    def __init__(self, boxes_ego: FloatArray) -> None:
        signs = np.array([[-1, -1, -1], [-1, -1, 1], [-1, 1, 1], [-1, 1, -1], [1, -1, -1], [1, -1, 1], [1, 1, 1]])
        corners = []
        for box in boxes_ego:
            places = np.vstack([signs, [1, 1, -1]]) / 2 * box[3:6]
            corners.append(places @ rotation_z(np.degrees(box[6])).T + box[:3])
        ego2lidar = np.linalg.inv(LIDAR2EGO)
        x = np.array(corners).reshape(-1, 8, 3) @ ego2lidar[:3, :3].T + ego2lidar[:3, 3]
        self.corners = torch.from_numpy(x)


def source_rig(size: tuple[int, int]) -> Rig:
    """The synthetic street's six cameras by nuScenes' names, in BEVDet's order."""
    rig = demo_source_rig(size)
    order = ("front_left", "front", "front_right", "back_left", "back", "back_right")
    return rig.with_cameras([replace(rig[name], name=f"CAM_{name.upper()}") for name in order])


@dataclass(frozen=True)
class Recording:
    """A sample and how it was recorded: each camera a little before or after the LiDAR, on a moving vehicle.

    Attributes:
        sample: Its ``rig`` has each camera where it was when it exposed.
        moved: (N, 4, 4) the ego then, in the ego frame at the LiDAR's time.
    """

    sample: dict[str, Any]
    moved: FloatArray

    @property
    def rig(self) -> Rig:
        """Where the cameras were."""
        rig: Rig = self.sample["rig"]
        return rig

    @property
    def mounted(self) -> FloatArray:
        """(N, 4, 4) where they are mounted."""
        return np.linalg.inv(self.moved) @ self.rig.cam2ego

    @property
    def lidar2cam(self) -> FloatArray:
        """(N, 4, 4)."""
        return np.linalg.inv(self.rig.cam2ego) @ LIDAR2EGO

    @property
    def K(self) -> FloatArray:
        """(N, 4, 4)."""
        K = np.tile(np.eye(4), (len(self.rig), 1, 1))
        K[:, :3, :3] = self.rig.K
        return K

    @property
    def arrays(self) -> list[np.ndarray]:
        """Images (H, W, 3) BGR."""
        return [np.ascontiguousarray(image.permute(1, 2, 0).numpy()[..., ::-1]) for image in self.sample["images"]]

    @property
    def labels(self) -> dict[str, Any]:
        """Points and boxes as loaded, in the LiDAR's frame."""
        points = self.sample["points"].double().numpy()
        ego2lidar = np.linalg.inv(LIDAR2EGO)
        points[:, :3] = points[:, :3] @ ego2lidar[:3, :3].T + ego2lidar[:3, 3]
        boxes = Boxes(self.sample["boxes_3d"].double().numpy())
        return {"points": torch.from_numpy(points).float(), "gt_bboxes_3d": boxes}


def recording(sample: dict[str, Any]) -> Recording:
    """The sample as of a vehicle at ``SPEED_MPS`` whose cameras exposed up to 40 ms before the LiDAR turned by."""
    moved = np.tile(np.eye(4), (len(sample["rig"]), 1, 1))
    moved[:, 0, 3] = -SPEED_MPS * np.linspace(0.005, 0.04, len(moved))
    return Recording(sample, moved)


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
        "cam2global": list(EGO2GLOBAL @ given.rig.cam2ego),
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
    return {
        "img_filename": [f"{name}.jpg" for name in given.rig.names],
        "img": [image.astype(np.float32) for image in given.arrays],
        "lidar2img": list(given.K @ given.lidar2cam),
        "cam_intrinsic": list(given.K),
        "lidar2cam": list(given.lidar2cam),
        **{key: shape for key in ("img_shape", "ori_shape", "pad_shape")},
        "ann_info": {"gt_bboxes_3d": given.labels["gt_bboxes_3d"], "bboxes": np.zeros((0, 4))},
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
        torch.from_numpy(EGO2GLOBAL @ given.moved).double(),
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


FORMS: dict[str, Callable[[Recording], dict[str, Any]]] = {
    "mmdet3d": mmdet3d,
    "mmdet3d BEVFusion": mmdet3d_bevfusion,
    "mit-han-lab BEVFusion": mit_bevfusion,
    "DETR3D": detr3d,
    "PETR": petr,
    "BEVDet": bevdet,
}
"""A maker of each form by its framework's name."""
