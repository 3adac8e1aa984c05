"""Silent mistakes, made in right samples."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from arbiview_aug import Camera, Rig
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rotations import (
    CAMERA_AXES_IN_EGO,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_z,
)

Sample = dict[str, Any]
Mistake = Callable[[Sample], Sample]
BODY = np.eye(4)
BODY[:3, :3] = CAMERA_AXES_IN_EGO


def turned(sample: Sample, yaw_deg: float) -> Sample:
    """The sample in an ego frame turned about z, so that yaw conventions differ; it stays right."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_z(yaw_deg)
    points, boxes = sample["points"].clone(), sample["boxes_3d"].clone()
    for rows in (points, boxes):
        rows[:, :3] = rows[:, :3] @ torch.from_numpy(pose[:3, :3].T).to(rows.dtype)
    boxes[:, 6] = torch.remainder(boxes[:, 6] + math.radians(yaw_deg) + math.pi, 2 * math.pi) - math.pi
    rig = sample["rig"].with_cameras([camera.moved(pose) for camera in sample["rig"]])
    return {**sample, "rig": rig, "points": points, "boxes_3d": boxes}


def boxes(change: Callable[[torch.Tensor], torch.Tensor]) -> Mistake:
    return lambda sample: {**sample, "boxes_3d": change(sample["boxes_3d"])}


def columns(order: list[int]) -> Mistake:
    """Boxes with their first seven columns in another order."""
    return boxes(lambda rows: rows[:, order])


def yaws(change: Callable[[torch.Tensor], torch.Tensor]) -> Mistake:
    return boxes(lambda rows: torch.cat([rows[:, :6], change(rows[:, 6:7]), rows[:, 7:]], dim=1))


def raised(heights: float) -> Mistake:
    return boxes(lambda rows: torch.cat([rows[:, :2], rows[:, 2:3] + heights * rows[:, 5:6], rows[:, 3:]], dim=1))


def sizes(factor: float) -> Mistake:
    return boxes(lambda rows: rows[:, :7] * torch.tensor([1.0] * 3 + [factor] * 3 + [1.0]))


at_the_bottom, at_the_top = raised(-0.5), raised(0.5)


def without(*keys: str) -> Mistake:
    return lambda sample: {key: value for key, value in sample.items() if key not in keys}


def lidar_frame(yaw_deg: float, forward_m: float = 0.94, up_m: float = 1.84) -> Mistake:
    """Points in the frame of a LiDAR on the roof; its x axis looks to ``-yaw_deg``."""
    R = rotation_z(yaw_deg)
    return moved("points", R, tuple(R @ (-forward_m, 0, -up_m)))


def ground(shift_m: float) -> Mistake:
    return lambda sample: {**sample, "rig": Rig(list(sample["rig"]), ground_z_m=sample["rig"].ground_z_m + shift_m)}


def cameras(change: Callable[[Camera], Camera]) -> Mistake:
    return lambda sample: {**sample, "rig": sample["rig"].with_cameras(list(map(change, sample["rig"])))}


def poses(change: Callable[[FloatArray], FloatArray]) -> Mistake:
    return cameras(lambda camera: replace(camera, cam2ego=change(camera.cam2ego)))


def millimetres(cam2ego: FloatArray) -> FloatArray:
    return np.hstack([cam2ego[:, :3], cam2ego[:, 3:] * [[1000], [1000], [1000], [1]]])


WORLD = np.array([[0.6, -0.8, 0, 411.0], [0.8, 0.6, 0, 1181], [0, 0, 1, 0.4], [0, 0, 0, 1]])
"""A pose of the ego in the world."""


def in_world(key: str) -> Mistake:
    return moved(key, WORLD[:3, :3], tuple(WORLD[:3, 3]))


def scaled_K(factor: float) -> Mistake:
    """K of images of ``factor`` times the size."""
    return cameras(lambda camera: replace(camera, K=np.diag([factor, factor, 1]) @ camera.K))


def speckled(sample: Sample) -> Sample:
    mask = np.ones(sample["rig"][0].size, bool)
    mask[-20:] = False
    mask[5, 7], mask[-10, 30] = False, True
    first = replace(sample["rig"][0], mask=mask)
    return {**sample, "rig": sample["rig"].with_cameras([first, *list(sample["rig"])[1:]])}


def inverted_mask(sample: Sample) -> Sample:
    def own_car(camera: Camera) -> Camera:
        mask = np.zeros(camera.size, bool)
        mask[-camera.height_px // 4 :] = True
        return replace(camera, mask=mask)

    return cameras(own_car)(sample)


def renamed(key: str, name: str) -> Mistake:
    return lambda sample: {name if k == key else k: value for k, value in sample.items()}


def moved(key: str, A: FloatArray | list[list[float]], t: tuple[float, ...] = (0, 0, 0)) -> Mistake:
    """Points or boxes moved by A (3, 3) and t; boxes' headings with them."""

    def mistaken(sample: Sample) -> Sample:
        rows, matrix = sample[key].clone(), torch.as_tensor(A, dtype=sample[key].dtype)
        rows[:, :3] = rows[:, :3] @ matrix.T + torch.tensor(t, dtype=rows.dtype)
        if key == "boxes_3d":
            yaw = rows[:, 6]
            ahead = torch.stack([yaw.cos(), yaw.sin(), 0 * yaw], dim=1) @ matrix.T
            rows[:, 3:6] *= matrix[0].norm()
            rows[:, 6] = torch.atan2(ahead[:, 1], ahead[:, 0])
        return {**sample, key: rows}

    return mistaken


def in_camera(key: str) -> Mistake:
    """Points, or boxes as KITTI has them: the bottom's centre, and yaw about the y axis down."""

    def mistaken(sample: Sample) -> Sample:
        pose, rows = sample["rig"][0].cam2ego, sample[key].double().numpy().copy()
        if key == "boxes_3d":
            rows[:, 2] -= rows[:, 5] / 2
            ahead = np.stack([np.cos(rows[:, 6]), np.sin(rows[:, 6]), 0 * rows[:, 6]], axis=1) @ pose[:3, :3]
            rows[:, 6] = np.arctan2(-ahead[:, 2], ahead[:, 0])
        rows[:, :3] = (rows[:, :3] - pose[:3, 3]) @ pose[:3, :3]
        return {**sample, key: torch.from_numpy(rows)}

    return mistaken


def in_local_world(key: str) -> Mistake:
    """In a world that begins nearby, as simulators and odometry have it."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_z(37), (25, -14, 0.3)
    change = moved(key, pose[:3, :3], tuple(pose[:3, 3]))
    return lambda sample: {**change(sample), "ego2world": torch.from_numpy(pose)}


def second_camera(change: Callable[[FloatArray], FloatArray]) -> Mistake:
    def mistaken(sample: Sample) -> Sample:
        first, second, *others = sample["rig"]
        second = replace(second, cam2ego=change(second.cam2ego))
        return {**sample, "rig": sample["rig"].with_cameras([first, second, *others])}

    return mistaken


def turn(change: Callable[[FloatArray], FloatArray]) -> Callable[[FloatArray], FloatArray]:
    """A change of the rotation alone."""
    return lambda pose: np.vstack([np.hstack([change(pose[:3, :3]), pose[:3, 3:]]), pose[3:]])


def quaternion_misread(order: list[int]) -> Mistake:
    return second_camera(turn(lambda R: rotation_from_quaternion(quaternion_from_rotation(R)[order])))


def swapped_images(sample: Sample) -> Sample:
    first, second, *others = sample["images"]
    return {**sample, "images": torch.stack([second, first, *others])}


MIRROR = np.diag([1.0, -1, 1, 1])
FLIP_Y, FLIP_X, DOWN, SWAP = np.diag([1.0, -1, 1]), np.diag([-1.0, 1, 1]), np.diag([1.0, -1, -1]), np.eye(3)[[1, 0, 2]]
quarter = math.pi / 2
MISTAKES: dict[str, tuple[Mistake, str]] = {
    "yaw in degrees": (yaws(torch.rad2deg), "boxes_3d: .*in radians.* torch.deg2rad"),
    "width before length": (columns([0, 1, 2, 4, 3, 5, 6]), "boxes_3d: .*wider than long.*Swap columns 3 and 4"),
    "height first": (columns([0, 1, 2, 5, 4, 3, 6]), "boxes_3d: .*highest along the sixth.*Reorder"),
    "yaw the other way round": (yaws(lambda yaw: -yaw), "boxes_3d: .*; pass -yaw$"),
    "yaw from the y axis": (yaws(lambda yaw: yaw - quarter), r"boxes_3d: .*; pass yaw \+ pi / 2$"),
    "heading from north": (yaws(lambda yaw: quarter - yaw), "boxes_3d: .*; pass pi / 2 - yaw$"),
    "z at the bottom": (at_the_bottom, "boxes_3d: .*centre.*add half the height"),
    "LiDAR's frame": (lidar_frame(90), "points: .*1.8.*LiDAR's frame"),
    "LiDAR's frame, turned back": (lidar_frame(180), "points: .*LiDAR's frame"),
    "another frame of the same height": (lidar_frame(90, 0, 0), "points: .*LiDAR's frame"),
    "ground_z_m too low": (ground(-0.33), r"ground_z_m: .*found -0.33; set ground_z_m=-?0.0\d"),
    "ground_z_m too high": (ground(0.33), r"ground_z_m: .*found \+0.33; set ground_z_m=-?0.0\d"),
    "ROS axes": (poses(lambda pose: pose @ BODY.T), r"cam2ego: .*ROS.*\[\[0, 0, 1\], \[-1, 0, 0\], \[0, -1, 0\]\]"),
    "K in millimetres": (cameras(lambda c: replace(c, K=np.diag([0.02, 0.02, 1]) @ c.K)), "K: .*pixels.*millimetres"),
    "inverted cam2ego": (poses(np.linalg.inv), r"cam2ego: .*inverse.*np\.linalg\.inv"),
    "depth in millimetres": (
        lambda s: {**s, "depth_m": torch.full((len(s["rig"]), *s["rig"].sizes[0]), 4000, dtype=torch.int32)},
        "depth_m: .*nearest pixel 4000 m away; is it in millimetres",
    ),
    "millimetres": (poses(millimetres), "cam2ego: .*millimetres.* by 1000"),
    "poses in the world": (poses(lambda pose: WORLD @ pose), "cam2ego: .*world's frame; pass np.linalg.inv.ego2world"),
    "points in the world": (in_world("points"), "points: .*nearest 1[12].. m away; are they in the world's frame"),
    "boxes in the world": (in_world("boxes_3d"), "boxes_3d: .*nearest 1[12].. m away; are they in the world's frame"),
    "OpenGL's axes": (poses(lambda pose: pose @ np.diag([1.0, -1, -1, 1])), r"cam2ego: .*OpenGL.*negate"),
    "an ego frame with a camera's axes": (poses(lambda pose: BODY.T @ pose), "cam2ego: .*from the left"),
    "K of a smaller image": (scaled_K(0.8), "K: .*another resolution"),
    "K of a larger image": (scaled_K(1.25), "K: .*another resolution"),
    "specks in a mask": (speckled, "mask: .*specks of 2 pixels.*clean_masks=True"),
    "an inverted mask": (inverted_mask, "mask: .*upper third hidden; pass ~mask"),
    "gt_boxes": (renamed("boxes_3d", "gt_boxes"), "gt_boxes: .*did you mean boxes_3d"),
    "boxes3d": (renamed("boxes_3d", "boxes3d"), "boxes3d: .*did you mean boxes_3d"),
    "lidar_points": (renamed("points", "lidar_points"), "lidar_points: .*did you mean points"),
    "boxes in a camera's frame": (
        in_camera("boxes_3d"),
        "boxes_3d: .*frame of camera .*; apply the cam2ego of",
    ),
    "boxes in the LiDAR's frame": (
        moved("boxes_3d", rotation_z(90), (0.0, 0.94, -1.84)),
        "boxes_3d: .*turned by 90 degrees and 1.8 m lower.*lidar2ego",
    ),
    "mirrored boxes": (moved("boxes_3d", FLIP_Y), "boxes_3d: .*mirrored.*; negate y and yaw$"),
    "boxes with x backward": (moved("boxes_3d", FLIP_X), "boxes_3d: .*; negate x, and pass pi - yaw$"),
    "boxes with x and y swapped": (moved("boxes_3d", SWAP), "boxes_3d: .*; swap x and y, and pass pi / 2 - yaw$"),
    "boxes with z down": (moved("boxes_3d", DOWN), "boxes_3d: .*z down.*; negate y, z and yaw$"),
    "boxes in feet": (moved("boxes_3d", np.eye(3) / 0.3048), "boxes_3d: .*multiply positions and sizes by 0.3048"),
    "boxes in a world nearby": (in_local_world("boxes_3d"), r"boxes_3d: .*; apply inv\(ego2world\), to yaw too"),
    "z at the top": (at_the_top, "boxes_3d: .*centre.*subtract half the height"),
    "sizes from the centre": (sizes(0.5), "boxes_3d: .*half the size of what.*Double"),
    "sizes twice as large": (sizes(2.0), "boxes_3d: .*twice the size of what.*halve"),
    "sizes in millimetres": (sizes(1000.0), "boxes_3d: expected sizes in metres.*millimetres"),
    "mirrored points": (moved("points", FLIP_Y), "points: .*mirrored.*edges of the images; negate y$"),
    "points with x and y swapped": (moved("points", SWAP), "points: .*; swap x and y$"),
    "points with z down": (moved("points", DOWN), "points: .*z down.*; negate y and z$"),
    "points in a camera's frame": (in_camera("points"), "points: .*frame of camera .*; apply the cam2ego of"),
    "points in a world nearby": (in_local_world("points"), r"points: .*; apply inv\(ego2world\)$"),
    "one camera with a body's axes": (second_camera(lambda pose: pose @ BODY.T), "camera .*: cam2ego: .*ROS.*right$"),
    "one camera with OpenGL's axes": (
        second_camera(lambda pose: pose @ np.diag([1.0, -1, -1, 1])),
        "camera .*: cam2ego: .*OpenGL.*; negate",
    ),
    "one camera rolled": (second_camera(turn(lambda R: R @ rotation_z(120))), "camera .*: cam2ego: .*rolled by -1[12]"),
    "one quaternion x y z w": (quaternion_misread([1, 2, 3, 0]), "camera .*: cam2ego: .*x y z w read as w x y z"),
    "one quaternion w x y z": (quaternion_misread([3, 0, 1, 2]), "camera .*: cam2ego: .*w x y z read as x y z w"),
    "left-handed positions": (
        poses(lambda pose: pose * np.array([1.0, 1, 1, -1]) ** np.array([[0], [1], [0], [0]])),
        r"cam2ego: .*mirrored; positions are left-handed.*negate cam2ego\[1, 3\]",
    ),
    "left-handed poses": (
        poses(lambda pose: MIRROR @ pose @ np.diag([-1.0, 1, 1, 1])),
        r"cam2ego: .*left and right are swapped.*; negate cam2ego\[1\] and",
    ),
    "y of the ego frame forward": (
        poses(lambda pose: np.vstack([rotation_z(90) @ pose[:3], pose[3:]])),
        "cam2ego: .*turned by 1[12]. degrees; x of the ego frame is forward",
    ),
    "a mask that hides all": (
        cameras(lambda c: replace(c, mask=np.zeros(c.size, bool))),
        "mask: .*100% of the image hidden; pass ~mask",
    ),
}
"""Each mistake, and how its finding reads."""
