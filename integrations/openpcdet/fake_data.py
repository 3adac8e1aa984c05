"""``data_dict``s as OpenPCDet's data sets write them, made of a synthetic sample: for the example and the tests."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.datasets.synthetic import SyntheticDrive
from integrations.mmdet3d.fake_results import LIDAR2EGO, Recording, recording, source_rig

KITTI_LIDAR2EGO = np.eye(4)
KITTI_LIDAR2EGO[:3, 3] = 0.8, 0.0, 1.73

CROP = 0.75, (0, 12, 132, 48)
"""Resize and crop (left, top, right, bottom) of ``NuScenesDataset.crop_image``."""


class Calibration:
    """The attributes of OpenPCDet's ``calibration_kitti.Calibration``."""

    def __init__(self, P2: FloatArray, R0: FloatArray, V2C: FloatArray) -> None:
        self.P2, self.R0, self.V2C = (matrix.astype(np.float32) for matrix in (P2, R0, V2C))
        self.cu, self.cv, self.fu, self.fv = self.P2[0, 2], self.P2[1, 2], self.P2[0, 0], self.P2[1, 1]
        self.tx, self.ty = self.P2[0, 3] / -self.fu, self.P2[1, 3] / -self.fv

    def lidar_to_img(self, points: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Pixels (n, 2) and depths (n,) of points (n, 3)."""
        rect = np.pad(points, [(0, 0), (0, 1)], constant_values=1) @ (self.V2C.T @ self.R0.T)
        x = np.pad(rect, [(0, 0), (0, 1)], constant_values=1) @ self.P2.T
        return x[:, :2] / rect[:, 2:], x[:, 2] - self.P2[2, 3]


def street(size: tuple[int, int] = (64, 176)) -> Recording:
    """A street recorded by six cameras and a LiDAR."""
    return recording(SyntheticDrive(source_rig(size), num_frames=1)[0])


def labelled(given: Recording, lidar2ego: FloatArray) -> dict[str, Any]:
    """Points (N, 4), boxes with velocities (M, 9) and names, in the LiDAR's frame."""
    ego2lidar = np.linalg.inv(lidar2ego)
    points, boxes = given.sample["points"].double().numpy(), given.sample["boxes_3d"].double().numpy()
    for rows in (points, boxes):
        rows[:, :3] = rows[:, :3] @ ego2lidar[:3, :3].T + ego2lidar[:3, 3]
    boxes[:, 6] += np.arctan2(ego2lidar[1, 0], ego2lidar[0, 0])
    moving = np.tile(ego2lidar[:2, 0] * 5, (len(boxes), 1))  # 5 m/s ahead
    return {
        "points": points.astype(np.float32),
        "frame_id": "000001",
        "gt_boxes": np.hstack([boxes, moving]).astype(np.float32),
        "gt_names": np.array(["car"] * len(boxes)),
    }


def kitti(given: Recording) -> dict[str, Any]:
    """Before ``KittiDataset``'s ``prepare_data``."""
    labels = labelled(given, KITTI_LIDAR2EGO)
    labels["gt_boxes"] = labels["gt_boxes"][:, :7]
    front = given.rig[given.rig.names.index("CAM_FRONT")]
    P2, V2C = np.zeros((3, 4)), (np.linalg.inv(front.cam2ego) @ KITTI_LIDAR2EGO)[:3]
    P2[:, :3], P2[0, 3] = front.K, 0.06 * front.K[0, 0]  # 6 cm beside the camera of the rectified frame
    V2C[0, 3] -= 0.06
    labels |= {"calib": Calibration(P2, np.eye(3), V2C), "road_plane": np.array([0.0, -1.0, 0.0, 1.65])}
    return labels


def nuscenes(given: Recording) -> dict[str, Any]:
    """Before ``NuScenesDataset``'s ``prepare_data``, with ``CAMERA_CONFIG``; points have a time in the last column."""
    from PIL import Image

    labels = labelled(given, LIDAR2EGO)
    labels["points"] = np.hstack([labels["points"], np.zeros((len(labels["points"]), 1), np.float32)])
    resize, crop = CROP
    images = [Image.fromarray(np.ascontiguousarray(array[..., ::-1])) for array in given.arrays]
    w, h = images[0].size
    K, lidar2cam = given.K.astype(np.float32), given.lidar2cam.astype(np.float32)
    return labels | {
        "metadata": {"token": "one"},
        "image_paths": [f"samples/{name}.jpg" for name in given.rig.names],
        "lidar2camera": list(lidar2cam),
        "lidar2image": list(K @ lidar2cam),
        "camera2ego": list(given.mounted.astype(np.float32)),
        "camera_intrinsics": list(K),
        "camera2lidar": list(np.linalg.inv(lidar2cam)),
        "ori_shape": (w, h),
        "camera_imgs": [image.resize((round(w * resize), round(h * resize))).crop(crop) for image in images],
        "img_process_infos": [[resize, crop, False, 0] for _ in images],
    }
