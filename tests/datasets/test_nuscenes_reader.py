"""nuScenes: against a real keyframe's published calibration, and against small made-up tables that can be broken."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug.datasets import FrameFolder, NuScenesDataset
from arbiview_aug.datasets.nuscenes.reader import CAMERA_RING
from arbiview_aug.errors import DataError

Tables = dict[str, list[dict[str, Any]]]
Change = Callable[[Tables], None]

UNTURNED = [1.0, 0.0, 0.0, 0.0]
LEFT_90 = [0.5**0.5, 0.0, 0.0, 0.5**0.5]
CAMERA_FORWARD = [0.5, -0.5, 0.5, -0.5]  # x right, y down, z forward on an ego with x forward, y left, z up


def tables() -> Tables:
    """Two scenes of one keyframe each; a front and a rear camera, a radar, and a sweep that is no keyframe.

    The ego stands at (100, 50, 0), turned left by 90 degrees, at the LiDAR's time; the front camera recorded when it
    was 0.5 m further back (along -y of the world).
    """
    data: Tables = {
        "scene": [{"token": "s0", "name": "scene-1"}, {"token": "s1", "name": "scene-2"}],
        "sensor": [
            {"token": "front", "channel": "CAM_FRONT", "modality": "camera"},
            {"token": "rear", "channel": "CAM_BACK", "modality": "camera"},
            {"token": "lidar", "channel": "LIDAR_TOP", "modality": "lidar"},
            {"token": "radar", "channel": "RADAR_FRONT", "modality": "radar"},
        ],
        "category": [{"token": "c0", "name": "vehicle.car"}],
        "instance": [{"token": "i0", "category_token": "c0"}],
        **{name: [] for name in ("calibrated_sensor", "sample", "sample_data", "ego_pose", "sample_annotation")},
    }
    K = [[40.0, 0, 31.5], [0, 40.0, 23.5], [0, 0, 1]]
    for sensor, x, rotation in (
        ("front", 1.5, CAMERA_FORWARD),
        ("rear", 0.0, [0.5, -0.5, -0.5, 0.5]),
        ("lidar", 1.0, UNTURNED),
        ("radar", 3.0, UNTURNED),
    ):
        row = {"token": f"cs-{sensor}", "sensor_token": sensor, "translation": [x, 0, 1.6], "rotation": rotation}
        data["calibrated_sensor"].append(row | {"camera_intrinsic": K if sensor in ("front", "rear") else []})
    for k in range(2):
        data["sample"].append({"token": f"t{k}", "scene_token": f"s{k}", "timestamp": k})
        for sensor in ("front", "rear", "lidar", "radar"):
            token = f"{sensor}-{k}"
            folder = {"front": "CAM_FRONT", "rear": "CAM_BACK"}.get(sensor, sensor)
            row = {"token": token, "sample_token": f"t{k}", "ego_pose_token": token, "is_key_frame": True}
            row |= {"calibrated_sensor_token": f"cs-{sensor}", "width": 64, "height": 48, "timestamp": k * 500_000}
            row["filename"] = f"samples/{folder}/{k}.{'bin' if sensor in ('lidar', 'radar') else 'png'}"
            data["sample_data"].append(row)
            y = 49.5 if sensor == "front" else 50.0
            data["ego_pose"].append({"token": token, "translation": [100, y, 0], "rotation": LEFT_90})
        sweep = dict(data["sample_data"][-1], token=f"sweep-{k}", is_key_frame=False, ego_pose_token="dropped")
        data["sample_data"].append(sweep)
        # 10 m ahead and 2 m to the right of the ego, turned left by 90 degrees in the world: heading as the ego.
        row = {"token": f"a{k}", "sample_token": f"t{k}", "instance_token": "i0", "translation": [102, 60, 0.8]}
        data["sample_annotation"].append(row | {"size": [1.9, 4.5, 1.6], "rotation": LEFT_90})
    return data


def write(root: Path, change: Change | None = None) -> Path:
    data = tables()
    if change:
        change(data)
    (root / "v1.0-mini").mkdir(parents=True)
    for name, rows in data.items():
        (root / "v1.0-mini" / f"{name}.json").write_text(json.dumps(rows))
    for folder in ("CAM_FRONT", "CAM_BACK", "lidar"):
        (root / "samples" / folder).mkdir(parents=True)
        for k in range(2):
            if folder == "lidar":
                np.array([[9, -2, 0, 7, 3], [4, 0, 0, 1, 2]], np.float32).tofile(root / f"samples/lidar/{k}.bin")
            else:
                cv2.imwrite(str(root / "samples" / folder / f"{k}.png"), np.full((48, 64, 3), 50 + k, np.uint8))
    return root


# --- the made-up drive, by hand ---------------------------------------------------------------------------------------
def test_the_sample(tmp_path: Path) -> None:
    dataset = NuScenesDataset(write(tmp_path))
    assert len(dataset) == 2 and dataset.channels == ["CAM_FRONT", "CAM_BACK"]
    sample = dataset[0]
    assert sample["images"].shape == (2, 3, 48, 64) and sample["images"].dtype == torch.uint8
    assert sample["rig"].names == ["CAM_FRONT", "CAM_BACK"] and sample["rig"].ground_z_m == 0
    assert sample["token"] == "t0" and sample["scene_token"] == "s0"
    np.testing.assert_array_equal(sample["K"], sample["rig"].K)
    np.testing.assert_array_equal(sample["cam2ego"], sample["rig"].cam2ego)
    np.testing.assert_allclose(sample["points"], [[10, -2, 1.6, 7, 3], [5, 0, 1.6, 1, 2]], atol=1e-6)
    np.testing.assert_allclose(sample["boxes_3d"], [[10, -2, 0.8, 4.5, 1.9, 1.6, 0, np.nan, np.nan]], atol=1e-5)
    assert sample["time_s"] == 0 and dataset[1]["time_s"] == 0.5
    assert sample["box_names"] == ["vehicle.car"] and sample["box_tokens"] == ["a0"]
    np.testing.assert_allclose(sample["ego2world"] @ torch.tensor([1.0, 0, 0, 1]).double(), [100, 51, 0, 1], atol=1e-9)


def test_convention_cameras_are_where_they_recorded_seen_from_the_lidars_time(tmp_path: Path) -> None:
    write(tmp_path)
    moving = NuScenesDataset(tmp_path)[0]["rig"]
    still = NuScenesDataset(tmp_path, compensate_ego_motion=False)[0]["rig"]
    np.testing.assert_allclose(still["CAM_FRONT"].center_m, [1.5, 0, 1.6], atol=1e-9)
    np.testing.assert_allclose(moving["CAM_FRONT"].center_m, [1.0, 0, 1.6], atol=1e-9)  # 0.5 m further back
    np.testing.assert_allclose(moving["CAM_BACK"].cam2ego, still["CAM_BACK"].cam2ego, atol=1e-9)
    assert abs(moving["CAM_FRONT"].azimuth_deg) < 1e-9 and abs(abs(moving["CAM_BACK"].azimuth_deg) - 180) < 1e-9


def test_lookup_scenes_channels_and_switches(tmp_path: Path) -> None:
    write(tmp_path)
    dataset = NuScenesDataset(tmp_path)
    assert dataset.by_token("t1")["token"] == dataset[-1]["token"] == "t1"
    assert [sample["token"] for sample in dataset] == ["t0", "t1"]  # type: ignore[attr-defined]
    for scenes in (["scene-2"], {"s1"}):
        part = NuScenesDataset(tmp_path, split_scenes=scenes)
        assert part.tokens == ["t1"] and part[0]["box_tokens"] == ["a1"]
    bare = NuScenesDataset(tmp_path, channels=["CAM_BACK"], load_points=False, reduce=2)
    sample = bare[0]
    assert "points" not in sample
    assert sample["images"].shape == (1, 3, 24, 32) and sample["rig"].sizes == [(24, 32)]
    assert NuScenesDataset(tmp_path, channels=["CAM_BACK", "CAM_FRONT"])[0]["rig"].names == ["CAM_BACK", "CAM_FRONT"]


def test_a_keyframe_without_boxes(tmp_path: Path) -> None:
    dataset = NuScenesDataset(write(tmp_path, lambda data: data["sample_annotation"].pop(0)))
    assert dataset[0]["boxes_3d"].shape == (0, 9) and dataset[0]["box_names"] == []
    assert dataset[1]["box_tokens"] == ["a1"]
    write(tmp_path / "none", lambda data: data["sample_annotation"].clear())
    with pytest.warns(UserWarning, match="sample_annotation has no rows of these samples"):
        unlabelled = NuScenesDataset(tmp_path / "none")
    assert "boxes_3d" not in unlabelled[1]  # or all would say that nothing moves


# --- the real keyframe ------------------------------------------------------------------------------------------------
def test_real_poses_agree_with_the_published_ones(nuscenes_root: Path) -> None:
    calib = json.loads((nuscenes_root / "calib.json").read_text())
    cameras = {camera["name"]: camera for camera in calib["cameras"]}
    for compensate, key, tolerance in ((True, "cam2ego", 1e-6), (False, "cam2ego_static", 1e-9)):
        sample = NuScenesDataset(nuscenes_root, compensate_ego_motion=compensate, reduce=4)[0]
        assert tuple(sample["rig"].names) == CAMERA_RING
        for camera in sample["rig"]:
            np.testing.assert_allclose(camera.cam2ego, cameras[camera.name][key], atol=tolerance)
        np.testing.assert_allclose(sample["ego2world"], calib["ego2world"], atol=1e-9)


def test_real_points_and_images_agree_with_the_frame_folder(nuscenes_root: Path) -> None:
    tables, folder = NuScenesDataset(nuscenes_root)[0], FrameFolder(nuscenes_root)[0]
    np.testing.assert_allclose(tables["points"][:, :4], folder["points"], atol=1e-4)
    assert torch.equal(tables["images"], folder["images"])
    np.testing.assert_array_equal(tables["K"], folder["K"])


def test_real_boxes_hold_the_points_that_the_table_counts(nuscenes_root: Path) -> None:
    sample = NuScenesDataset(nuscenes_root)[0]
    rows = json.loads((nuscenes_root / "v1.0-mini" / "sample_annotation.json").read_text())
    published = {row["token"]: row["num_lidar_pts"] for row in rows}
    points = sample["points"][:, :3].double().numpy()
    assert len(sample["boxes_3d"]) == len(rows)
    for box, token in zip(sample["boxes_3d"].double().numpy(), sample["box_tokens"], strict=True):
        cos, sin = np.cos(box[6]), np.sin(box[6])
        local = (points - box[:3]) @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        inside = int((np.abs(local) <= box[3:6] / 2).all(axis=1).sum())
        # The boxes here are upright in the ego frame, nuScenes' in the world: a degree of roll at their borders.
        assert abs(inside - published[token]) <= max(1, 0.06 * published[token])


# --- bad input --------------------------------------------------------------------------------------------------------
def put(table: str, row: int, key: str, value: Any) -> Change:
    return lambda data: data[table][row].update({key: value})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data.pop("ego_pose"), r"table ego_pose: expected the file .*ego_pose\.json, got none"),
        (lambda data: data.pop("sample"), r"table sample: expected the file .*sample\.json, got none"),
        (lambda data: data.pop("instance"), "table instance: expected the file"),
        (lambda data: data.update(sensor={}), "table sensor: expected a list of objects, got dict"),
        (put("sample_data", 0, "ego_pose_token", "x"), "table ego_pose: expected the token 'x' that a row of sample_d"),
        (
            put("sample_data", 0, "calibrated_sensor_token", "x"),
            "table calibrated_sensor: expected the token 'x' that row 'front-0' of sample_data names, got none",
        ),
        (put("calibrated_sensor", 1, "sensor_token", "x"), "table sensor: .*'x' that row 'cs-rear' of calibrated"),
        (put("sample", 1, "scene_token", "x"), "table scene: expected the token 'x' that row 't1' of sample names"),
        (put("sample_annotation", 0, "instance_token", "x"), "table instance: expected the token 'x' that row 'a0'"),
        (put("instance", 0, "category_token", "x"), "table category: expected the token 'x' that row 'i0'"),
        (lambda data: data["sample_data"][0].pop("filename"), "table sample_data: expected key 'filename', got a row"),
        (lambda data: data["sample_data"].pop(2), "table sample_data: .*LIDAR_TOP for sample t0, got none"),
        (put("calibrated_sensor", 0, "rotation", [0, 0, 0, 0]), "expected unit quaternions w x y z, got .*'cs-front'"),
        (put("ego_pose", 0, "translation", [1, 2]), r"table ego_pose: expected translation of shape \(3,\), .*finite"),
        (
            put("calibrated_sensor", 0, "camera_intrinsic", []),
            r"camera_intrinsic: expected a camera matrix of 3x3 finite numbers, .*, got \[\]",
        ),
        (
            put("calibrated_sensor", 0, "camera_intrinsic", [[float("nan")] * 3] * 3),
            "'cs-front'.*finite numbers, .*nan",
        ),
    ],
)
def test_broken_tables(tmp_path: Path, change: Change, message: str) -> None:
    write(tmp_path, change)
    with pytest.raises(DataError, match=message):
        NuScenesDataset(tmp_path)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"version": "v1.0-x"}, DataError, r"expected a folder of tables 'v1\.0-x', found none.*: v1\.0-mini"),
        ({"channels": ["CAM_FRONT"] * 2}, DataError, "channels: expected each once, got 'CAM_FRONT', 'CAM_FRONT'"),
        ({"channels": ["CAM_FRONT", "CAM_TOP"]}, DataError, "expected some of CAM_BACK, CAM_FRONT, got 'CAM_TOP'"),
        ({"split_scenes": ["scene-1", "scene-9"]}, DataError, "table scene: expected the scenes scene-9, got 2 others"),
        ({"split_scenes": "scene-1"}, DataError, r"split_scenes: expected a collection of names such as \['scene-1'\]"),
        ({"split_scenes": [3]}, DataError, "table scene: expected the scenes 3, got 2 others"),
        ({"channels": "CAM_FRONT"}, DataError, r"channels: expected .* such as \['CAM_FRONT'\], got 'CAM_FRONT'"),
        ({"reduce": 3}, ValueError, "reduce: expected 1, 2 or 4"),
    ],
)
def test_wrong_arguments(tmp_path: Path, arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        NuScenesDataset(**{"root": write(tmp_path)} | arguments)


def test_missing_and_broken_files(tmp_path: Path) -> None:
    dataset = NuScenesDataset(write(tmp_path))
    np.zeros(7, np.float32).tofile(tmp_path / "samples/lidar/0.bin")
    with pytest.raises(DataError, match=r"0\.bin: expected whole points of 5 float32, got 28 bytes"):
        dataset[0]
    np.full(5, np.nan, np.float32).tofile(tmp_path / "samples/lidar/0.bin")
    with pytest.warns(UserWarning, match="points: rows with NaN"):
        assert dataset[0]["points"].shape == (0, 5)
    (tmp_path / "samples/lidar/0.bin").unlink()
    with pytest.raises(DataError, match=r"points .*0\.bin: expected the LiDAR's file, got No such.*load_points=False"):
        dataset[0]
    (tmp_path / "samples/CAM_BACK/0.png").unlink()
    with pytest.raises(DataError, match=r"camera 'CAM_BACK': image .*0\.png: expected an image file, found none"):
        dataset[0]
    cv2.imwrite(str(tmp_path / "samples/CAM_BACK/0.png"), np.zeros((64, 48, 3), np.uint8))
    with pytest.raises(DataError, match=r"'CAM_BACK'.*expected 64x48 .*got 48x64; .*swapped"):
        dataset[0]
    (tmp_path / "v1.0-mini/sample_data.json").write_text("[{")
    with pytest.raises(DataError, match="table sample_data: expected JSON, got"):
        NuScenesDataset(tmp_path)
    shutil.rmtree(tmp_path / "v1.0-mini")
    with pytest.raises(DataError, match="found none; folders with tables: none"):
        NuScenesDataset(tmp_path)
