"""The step on ``data_dict``s of KITTI and nuScenes, through the loop of OpenPCDet's ``DataAugmentor``."""

from __future__ import annotations

import pickle
import re
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
import yaml

from arbiview_aug import CalibrationError, Lidar, RandomRig, RigRetarget, SampleError, load_rig, retarget_points
from arbiview_aug.integrations.openpcdet import RigRetargetDataDict
from integrations.mmdet3d.fake_results import LIDAR2EGO, Recording, source_rig
from integrations.openpcdet.fake_data import CROP, KITTI_LIDAR2EGO, kitti, nuscenes, street
from integrations.snippets import snippets

SIZE = (36, 132)
SOURCE = source_rig((64, 176))
POSE = np.array([[1.0, 0, 0, 1.2], [0, 1, 0, 0.1], [0, 0, 1, 2.4], [0, 0, 0, 1]])
TOP = Lidar("top", POSE, tuple(np.linspace(-25, 5, 16)), 1.0, (1.0, 80.0))
TARGET = replace(load_rig("waymo").undistorted().resized(SIZE), lidars=[TOP])
README = (Path(__file__).parents[1] / "README.md").read_text()


@pytest.fixture(scope="module")
def given() -> Recording:
    return street()


def step(target: Any = TARGET, lidar2ego: Any = KITTI_LIDAR2EGO, **settings: Any) -> RigRetargetDataDict:
    return RigRetargetDataDict(target, lidar2ego=lidar2ego, **{"geometry": "street", **settings})


def in_ego(points: np.ndarray, lidar2ego: np.ndarray) -> np.ndarray:
    return points[:, :3].astype(float) @ lidar2ego[:3, :3].T + lidar2ego[:3, 3]


class DataAugmentor:
    """OpenPCDet's, restated: looks its methods up by ``NAME``, then calls what they return."""

    def __init__(self, configs: list[dict[str, Any]]) -> None:
        self.queue = [getattr(self, config["NAME"])(config=config) for config in configs]

    def forward(self, data_dict: dict[str, Any]) -> dict[str, Any]:
        for augmentor in self.queue:
            data_dict = augmentor(data_dict=data_dict)
        mask = data_dict.pop("gt_boxes_mask")
        return data_dict | {key: data_dict[key][mask] for key in ("gt_boxes", "gt_names")}


def prepare_data(augmentor: DataAugmentor, data_dict: dict[str, Any]) -> dict[str, Any]:
    """``DatasetTemplate.prepare_data``, restated: puts the calibration back that it was given."""
    kept = {"calib": data_dict["calib"]} if "calib" in data_dict else {}
    return augmentor.forward({**data_dict, "gt_boxes_mask": np.ones(len(data_dict["gt_boxes"]), bool)}) | kept


@pytest.mark.parametrize("columns", [4, 5])
def test_points_of_kitti(given: Recording, columns: int) -> None:
    data = kitti(given)
    data["points"] = np.pad(data["points"], [(0, 0), (0, columns - 4)])
    out = step()(data)
    expected = retarget_points(given.sample["points"], TARGET, boxes_3d=given.sample["boxes_3d"]).points
    assert out["points"].dtype == np.float32 and out["points"].shape[1] == columns
    np.testing.assert_allclose(in_ego(out["points"], KITTI_LIDAR2EGO), expected[:, :3], atol=2e-3)
    np.testing.assert_allclose(out["points"][:, 3], expected[:, 3])
    assert all(out[key] is data[key] for key in ("gt_boxes", "gt_names", "calib", "road_plane", "frame_id"))


def test_another_frame(given: Recording) -> None:
    """Points, boxes, headings, velocities and cameras in the frame that B's own data set has."""
    data, to = nuscenes(given), POSE @ np.diag([-1.0, -1.0, 1.0, 1.0])
    here, there = step(lidar2ego=LIDAR2EGO)(data), step(lidar2ego=LIDAR2EGO, target_lidar2ego=to)(data)
    np.testing.assert_allclose(in_ego(there["points"], to), in_ego(here["points"], LIDAR2EGO), atol=1e-4)
    for boxes, pose in ((here["gt_boxes"], LIDAR2EGO), (there["gt_boxes"], to)):
        true = given.sample["boxes_3d"].numpy()
        np.testing.assert_allclose(in_ego(boxes, pose), true[:, :3], atol=1e-4)
        turn = np.arctan2(pose[1, 0], pose[0, 0])
        np.testing.assert_allclose(np.exp(1j * (boxes[:, 6] + turn)), np.exp(1j * true[:, 6]), atol=1e-5)
        np.testing.assert_allclose(boxes[:, 7:] @ pose[:2, :2].T, [[5.0, 0.0]] * len(boxes), atol=1e-5)
    xyz1 = np.pad(there["points"][:, :3], [(0, 0), (0, 1)], constant_values=1)
    same = np.pad(here["points"][:, :3], [(0, 0), (0, 1)], constant_values=1)
    for k in range(5):
        np.testing.assert_allclose(
            xyz1 @ there["lidar2image"][k].T, same @ here["lidar2image"][k].T, rtol=1e-4, atol=0.05
        )
        np.testing.assert_allclose(there["lidar2camera"][k] @ there["camera2lidar"][k], np.eye(4), atol=1e-4)


def test_cameras_of_nuscenes(given: Recording) -> None:
    """Images were resized and cropped before: that is part of their cameras. Those that come out are whole."""
    data = nuscenes(given)
    out = step(lidar2ego=LIDAR2EGO)(data)
    assert len(out["camera_imgs"]) == 5 and out["camera_imgs"][0].size == out["ori_shape"] == SIZE[::-1]
    assert out["img_process_infos"] == [[1.0, (0, 0, *SIZE[::-1]), False, 0]] * 5 and out["image_paths"] == TARGET.names
    target = TARGET.in_frame_of(SOURCE)
    for k, camera in enumerate(target):
        np.testing.assert_allclose(out["camera_intrinsics"][k][:3, :3], camera.K, rtol=1e-5)
        np.testing.assert_allclose(out["camera2ego"][k], camera.cam2ego, atol=1e-5)
        ego = in_ego(out["points"], LIDAR2EGO)
        uv, depth_m, valid = camera.project(ego)
        x = np.pad(out["points"][:, :3], [(0, 0), (0, 1)], constant_values=1) @ out["lidar2image"][k].T
        seen = valid & (depth_m > 1) & camera.contains(uv)
        assert seen.sum() > 20
        np.testing.assert_allclose(x[seen, :2] / x[seen, 2:3], uv[seen], atol=1e-2)
    resize, (left, top, right, bottom) = CROP
    cropped = SOURCE.resized(resize).with_cameras(
        [camera.crop(top, left, (bottom - top, right - left)) for camera in SOURCE.resized(resize)]
    )
    pixels = np.stack([np.asarray(image) for image in data["camera_imgs"]])
    sample = {"images": torch.from_numpy(pixels).permute(0, 3, 1, 2), "rig": cropped}
    expected = RigRetarget(TARGET, geometry="street")(sample)["images"].permute(0, 2, 3, 1).numpy()
    off = np.abs(np.stack([np.asarray(image) for image in out["camera_imgs"]]).astype(float) - expected)
    assert off.mean() < 1  # as of cameras that exposed up to 0.36 m away


def test_in_the_augmentors_of_a_config(given: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The YAML of the README, after ``register``; twice is allowed, and workers get a copy."""
    monkeypatch.chdir(tmp_path)
    TARGET.save("van_pinhole.yaml")
    (code,), names = snippets("openpcdet"), ("pcdet", "pcdet.datasets", "pcdet.datasets.augmentor")
    module = ModuleType("pcdet.datasets.augmentor.data_augmentor")
    module.DataAugmentor = DataAugmentor  # type: ignore[attr-defined]
    for one in (*map(ModuleType, names), module):
        monkeypatch.setitem(sys.modules, one.__name__, one)
    exec(code, {})
    exec(code, {})
    (text,) = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    augmentor = DataAugmentor(yaml.safe_load(text)["DATA_AUGMENTOR"]["AUG_CONFIG_LIST"][:1])
    data = kitti(given)
    count = len(data["gt_boxes"])
    torch.manual_seed(0)
    kept = set()
    for _ in range(6):
        out = prepare_data(pickle.loads(pickle.dumps(augmentor)), data)
        assert len(out["gt_boxes"]) == len(out["gt_names"])
        kept.add((len(out["points"]), len(out["gt_boxes"])))
    assert len(kept) == 2 and (len(data["points"]), count) in kept  # skipped, and retargeted with fewer boxes


def test_boxes_without_points(given: Recording) -> None:
    data = kitti(given)
    far = np.array([[500.0, 0, 0, 4, 2, 1.5, 0]], np.float32)
    data |= {"gt_boxes": np.concatenate([data["gt_boxes"], far]), "gt_names": np.append(data["gt_names"], "car")}
    out = step(min_points_in_gt=1)(data)
    assert 0 < len(out["gt_boxes"]) == len(out["gt_names"]) < len(data["gt_boxes"])
    assert out["gt_boxes"][:, 0].max() < 400
    counted = step(min_points_in_gt=1)(data | {"num_points_in_gt": np.full(len(data["gt_boxes"]), 9)})
    assert counted["num_points_in_gt"].min() > 0 and len(counted["num_points_in_gt"]) == len(out["gt_boxes"])
    assert step()(data | {"num_points_in_gt": np.full(len(data["gt_boxes"]), 9)})["num_points_in_gt"][-1] == 0
    assert step(min_points_in_gt=1)(data | {"gt_boxes": None})["gt_boxes"] is None
    masked = step(min_points_in_gt=1)(data | {"gt_boxes_mask": np.ones(len(data["gt_boxes"]), bool)})
    assert masked["gt_boxes_mask"].sum() == len(out["gt_boxes"]) and not masked["gt_boxes_mask"][-1]


def test_without_labels_and_with_a_drawn_rig(given: Recording) -> None:
    data = {key: value for key, value in kitti(given).items() if not key.startswith("gt_")}
    torch.manual_seed(0)
    lengths = {len(step(RandomRig(TARGET, height_m=1.0))(data)["points"]) for _ in range(3)}
    assert len(lengths) > 1 and min(lengths) > 200


def test_frames_of_a_drive_share_a_draw(given: Recording) -> None:
    """The rig's draw and that of ``p``, with images and without."""
    random = RandomRig(TARGET, height_m=1.0, per="sequence")
    for one, data in ((step(random), kitti(given)), (step(random, lidar2ego=LIDAR2EGO), nuscenes(given))):
        a, again, b = (one(data | {"scene_token": name})["points"] for name in "aab")
        assert np.array_equal(a, again) and not np.array_equal(a, b)
    with pytest.raises(SampleError, match="sequence_key: expected 'scene_token' in the results"):
        step(random)(kitti(given))
    skipping, bare = step(p=0.5, sequence_key="scene_token"), {"points": np.zeros((0, 4), np.float32)}
    skipping._points = lambda data_dict: None  # type: ignore[method-assign]
    skips = [[skipping({**bare, "scene_token": name})["points"] is None for name in range(30)] for _ in range(2)]
    assert skips[0] == skips[1] and {*skips[0]} == {False, True}


def test_points_need_no_pinholes_and_stay_on_demand(given: Recording) -> None:
    lenses, data = replace(load_rig("waymo"), lidars=[TOP]), kitti(given)
    assert np.array_equal(step(lenses)(data)["points"], step()(data)["points"])
    with pytest.raises(CalibrationError, match="target: expected pinhole cameras"):
        step(lenses, lidar2ego=LIDAR2EGO, size=SIZE)(nuscenes(given))
    assert step(keys={"points": "source"})(data)["points"] is data["points"]
    assert len(step()(data | {"noise_scale": 1.0, "flip_x": False})["points"])


@pytest.mark.parametrize(
    ("form", "entries", "message"),
    [
        (kitti, {"noise_rot": np.float32(0.3)}, "noise_rot: expected a frame as it was recorded, got an augmented one"),
        (kitti, {"points": [[1.0, 2.0, 0.0, 3.0]]}, r"^points: expected"),
        (kitti, {"points": torch.ones(2, 4)}, r"^points: expected"),
        (kitti, {"points": np.ones((2, 2), np.float32)}, r"^points: expected"),
        (kitti, {"points": None}, r"^points: expected"),
        (kitti, {"images": np.zeros((9, 9, 3))}, r"^images: expected points alone"),
        (nuscenes, {"lidar2image": None}, "lidar2image: expected beside camera_imgs, found none"),
        (nuscenes, {"img_process_infos": [[1, (0, 0, 9, 9), True, 0]] * 6}, "before imgaug"),
        (nuscenes, {"img_process_infos": [(1.0,)] * 6}, r"infos: expected \(resize, crop, flip, rotate\) of each"),
        (nuscenes, {"img_process_infos": [[1.0, (0, 0, 9, 9), False, 0]] * 5}, r"img_process_infos: expected"),
        (nuscenes, {"lidar_aug_matrix": np.eye(3)}, r"lidar_aug_matrix: expected numbers of shape \(4, 4\)"),
        (nuscenes, {"gt_names": np.array(["car"])}, "gt_names: expected one of each of the"),
    ],
)
def test_malformed_entries_are_named(given: Recording, form: Any, entries: dict[str, Any], message: str) -> None:
    data = {key: value for key, value in (form(given) | entries).items() if value is not None}
    with pytest.raises(SampleError, match=message):
        step(lidar2ego=LIDAR2EGO if form is nuscenes else KITTI_LIDAR2EGO, min_points_in_gt=1)(data)


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"min_points_in_gt": "x"}, ValueError, "min_points_in_gt: expected a number of points, got 'x'"),
        ({"target_lidar2ego": np.diag([1.0, -1.0, -1.0, 1.0])}, CalibrationError, "expected a frame whose z points up"),
        ({"lidar2ego": np.eye(3)}, CalibrationError, r"^lidar2ego: expected"),
        ({"p": 2}, ValueError, "p: expected a probability"),
    ],
)
def test_malformed_settings_are_named(settings: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        step(**settings)


def test_a_target_without_scanners_is_refused(given: Recording) -> None:
    with pytest.raises(SampleError, match="target: expected scanners"):
        step(replace(TARGET, lidars=()))(kitti(given))
