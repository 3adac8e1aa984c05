"""Points of the target's scanners in the dicts of frameworks that fuse LiDAR and cameras, or supervise depth."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Lidar, RandomRig, RigRetarget, depth_maps, load_rig
from arbiview_aug.cameras.rotations import rotation_from_quaternion
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.integrations.mmdet3d.transform import RigRetargetMultiView
from integrations.mmdet3d.fake_results import FORMS, LIDAR2EGO, Recording, recording, source_rig

SIZE = (48, 136)
SOURCE = source_rig((64, 176))
POSE = np.array([[1.0, 0, 0, 1.2], [0, 1, 0, 0.1], [0, 0, 1, 2.3], [0, 0, 0, 1]])
TOP = Lidar("top", POSE, tuple(np.linspace(-25, 5, 16)), 1.0, (1.0, 80.0))
TARGET = replace(load_rig("waymo").undistorted().resized(SIZE), lidars=[TOP])
FUSING = ("mmdet3d", "mmdet3d BEVFusion", "mit-han-lab BEVFusion", "Sparse4D")

pytestmark = pytest.mark.filterwarnings("ignore:retarget. drops")


class LiDARPoints:
    """The part of mmdet3d's class that is used."""

    def __init__(self, tensor: torch.Tensor) -> None:
        self.tensor = tensor

    def new_point(self, data: torch.Tensor) -> LiDARPoints:
        return LiDARPoints(data.to(self.tensor.device))


@pytest.fixture(scope="module")
def given() -> Recording:
    return recording(SyntheticDrive(SOURCE, num_frames=1)[0])


def step(target: Any = TARGET, **settings: Any) -> RigRetargetMultiView:
    return RigRetargetMultiView(target, lidar2ego=LIDAR2EGO, **{"geometry": "street", **settings})


def in_ego(points: Any, lidar2ego: np.ndarray = LIDAR2EGO) -> np.ndarray:
    """Points of a dict, (P, C), in the ego frame."""
    array = np.asarray(getattr(points, "tensor", points), np.float64).copy()
    array[:, :3] = array[:, :3] @ lidar2ego[:3, :3].T + lidar2ego[:3, 3]
    return array


@pytest.mark.parametrize("form", FUSING)
def test_points_are_those_of_the_targets_scanner(given: Recording, form: str) -> None:
    """In the frame of the LiDAR that recorded, so that ``lidar2img`` leads them into the new images."""
    results = FORMS[form](given)
    after, expected = step()(results), RigRetarget(TARGET, geometry="street")(given.sample)
    assert type(after["points"]) is type(results["points"]) and after["points"].dtype == results["points"].dtype
    np.testing.assert_allclose(in_ego(after["points"]), expected["points"], atol=2e-3)


def test_types_and_numbers_of_points(given: Recording) -> None:
    results, count = FORMS["mmdet3d"](given), len(given.sample["boxes_3d"])
    results["points"] = LiDARPoints(results["points"])
    results["ann_info"] = {"num_lidar_pts": np.full(count, -1), "gt_labels_3d": np.zeros(count)}
    results["instances"] = [{"num_lidar_pts": -1, "bbox_label": k} for k in range(count)]
    after, expected = step()(results), RigRetarget(TARGET, geometry="street")(given.sample)["num_points"]
    assert isinstance(after["points"], LiDARPoints) and expected.sum() > 0
    np.testing.assert_array_equal(after["ann_info"]["num_lidar_pts"], expected)
    assert [one["num_lidar_pts"] for one in after["instances"]] == expected.tolist()
    assert results["instances"][0]["num_lidar_pts"] == -1 and after["instances"][1]["bbox_label"] == 1


def test_points_stay_on_demand_and_where_samples_are_skipped(given: Recording) -> None:
    results = FORMS["mmdet3d"](given)
    assert step(keys={"points": "source"})(results)["points"] is results["points"]
    skipping = step(replace(SOURCE, lidars=[TOP]), p=0.0, size=SIZE)
    assert skipping(results)["points"] is results["points"]
    bare = {key: value for key, value in results.items() if key != "points"}
    assert "points" not in step()(bare)


def test_points_of_a_drawn_rig(given: Recording) -> None:
    random = RandomRig(TARGET, height_m=0.5)
    after = step(random)(FORMS["mmdet3d"](given))
    drawn = random.rig(after["retarget_params"])
    expected = RigRetarget(drawn, geometry="street")(given.sample)["points"]
    np.testing.assert_allclose(in_ego(after["points"]), expected, atol=2e-3)


def pose_of(info: dict[str, Any], name: str) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(np.asarray(info[f"{name}_rotation"], np.float64))
    pose[:3, 3] = info[f"{name}_translation"]
    return pose


def point_to_multi_view_depth(results: dict[str, Any]) -> np.ndarray:
    """(N, h, w): what BEVDet's step of this name makes of ``points``, ``curr`` and ``img_inputs``, restated."""
    images, _, _, intrins, post_rots, post_trans = results["img_inputs"][:6]
    points, curr = results["points"].tensor.double().numpy(), results["curr"]
    h, w = images.shape[-2:]
    maps = []
    for k, name in enumerate(results["cam_names"]):
        camera, cam2img = curr["cams"][name], np.eye(4)
        cam2img[:3, :3] = intrins[k]
        lidar2global = pose_of(curr, "ego2global") @ pose_of(curr, "lidar2ego")
        cam2global = pose_of(camera, "ego2global") @ pose_of(camera, "sensor2ego")
        lidar2img = cam2img @ np.linalg.inv(cam2global) @ lidar2global
        x = points[:, :3] @ lidar2img[:3, :3].T + lidar2img[:3, 3]
        x = np.concatenate([x[:, :2] / x[:, 2:], x[:, 2:]], axis=1) @ post_rots[k].numpy().T + post_trans[k].numpy()
        column, row = np.rint(x[:, :2]).T
        kept = (column >= 0) & (column < w) & (row >= 0) & (row < h) & (x[:, 2] > 0)
        one = np.full((h, w), np.inf)
        np.minimum.at(one, (row[kept].astype(int), column[kept].astype(int)), x[kept, 2])
        maps.append(np.where(np.isfinite(one), one, 0))
    return np.stack(maps)


def test_depth_supervision_is_of_the_targets_points(given: Recording) -> None:
    """BEVDet: points that are loaded before the step; its depth maps of them, against those of ``Camera.project``."""
    turned = {"lidar2ego": -90, "ego2global": 35}
    curr: dict[str, Any] = {"cams": {name: {} for name in SOURCE.names}}
    for name, pose in (("lidar2ego", LIDAR2EGO), ("ego2global", given.ego2global)):
        half = np.radians(turned[name]) / 2
        curr |= {f"{name}_rotation": [np.cos(half), 0, 0, np.sin(half)], f"{name}_translation": pose[:3, 3].tolist()}
    results = FORMS["BEVDet"](given) | {"curr": curr, "points": LiDARPoints(given.labels["points"])}
    after = step()(results)
    to_key = np.linalg.inv(given.moved[1])
    points = given.sample["points"].clone()
    points[:, 0] += to_key[0, 3]
    key = {"images": given.sample["images"], "points": points}
    key["rig"] = SOURCE.with_cameras([camera.moved(to_key) for camera in SOURCE])
    key["boxes_3d"] = torch.from_numpy(results["ann_infos"][0]).float()
    expected = RigRetarget(TARGET, geometry="street")(key)
    off = np.abs(in_ego(after["points"], to_key @ LIDAR2EGO) - expected["points"].numpy()).max(axis=1)
    assert np.mean(off < 3e-3) > 0.995
    maps, true = point_to_multi_view_depth(after), depth_maps(expected["points"], expected)
    assert isinstance(true, torch.Tensor) and (true > 0).sum() > 300
    either = (maps > 0) | (true.numpy() > 0)
    agree = np.abs(maps - true.numpy())[either] < 0.01
    assert agree.mean() > 0.98  # float32 poses move a point over a pixel's edge now and then
    assert np.abs(point_to_multi_view_depth({**after, "points": results["points"]}) - maps).max() > 1
