"""nuScenes: against a real keyframe's published calibration, and against broken tables of synthetic streets."""

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
from arbiview_aug.datasets.nuscenes import tables as tables_module
from arbiview_aug.datasets.nuscenes.reader import CAMERA_RING
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.errors import DataError
from tests.datasets.nuscenes_root import CHANNELS, Tables, streets, tables_of, write_root

Change = Callable[[Tables], Any]

SIZE = (48, 64)
RIG = demo_source_rig(SIZE)
STREETS = streets(1, one=lambda time_s: 5 * time_s, two=lambda time_s: 5 * time_s)
SAMPLES = ["one-sample-0", "two-sample-0"]


def write(root: Path, change: Change | None = None) -> Path:
    """Two scenes of one keyframe each."""
    data = tables_of(RIG, STREETS)
    if change:
        change(data)
    return write_root(root, data, SIZE)


def test_the_sample(tmp_path: Path) -> None:
    dataset, street = NuScenesDataset(write(tmp_path)), STREETS[0]
    assert dataset.tokens == SAMPLES and dataset.channels == list(CAMERA_RING)
    sample = dataset[0]
    assert sample["rig"].names == list(CAMERA_RING) and sample["rig"].ground_z_m == 0
    assert sample["token"] == SAMPLES[0] and sample["scene_token"] == "one"
    np.testing.assert_array_equal(sample["K"], sample["rig"].K)
    np.testing.assert_array_equal(sample["cam2ego"], sample["rig"].cam2ego)
    np.testing.assert_allclose(sample["points"], [[5, 1, -0.5, 9, 1]], atol=1e-6)
    np.testing.assert_allclose(sample["ego2world"], street.ego2world(0.0), atol=1e-9)
    rows = [int(token.split("-")[1]) for token in sample["box_tokens"]]
    np.testing.assert_allclose(sample["boxes_3d"][:, :7], street.scene.boxes_ego(0.0)[rows], atol=1e-4)
    assert sample["boxes_3d"][:, 7:].isnan().all() and set(sample["box_names"]) == {"thing"}  # one keyframe: no speed
    still = NuScenesDataset(tmp_path, compensate_ego_motion=False)[0]["rig"]
    for camera in still:
        np.testing.assert_allclose(camera.cam2ego, RIG[CHANNELS.index(camera.name)].cam2ego, atol=1e-9)


def test_lookup_scenes_channels_and_switches(tmp_path: Path) -> None:
    dataset = NuScenesDataset(write(tmp_path))
    assert dataset.by_token(SAMPLES[1])["token"] == dataset[-1]["token"] == SAMPLES[1]
    part = NuScenesDataset(tmp_path, split_scenes={"two"})
    assert part.tokens == SAMPLES[1:] and part[0]["box_tokens"][0].startswith("two-")
    settings: dict[str, Any] = {"load_points": False, "load_boxes": False, "reduce": 2}
    bare = NuScenesDataset(tmp_path, channels=["CAM_BACK", "CAM_FRONT"], **settings)[0]
    assert not {"points", "boxes_3d"} & {*bare} and bare["images"].shape == (2, 3, 24, 32)
    assert bare["rig"].names == ["CAM_BACK", "CAM_FRONT"] and bare["rig"].sizes == [(24, 32)] * 2


def test_a_keyframe_without_boxes(tmp_path: Path) -> None:
    def lose(*scenes: str) -> Change:
        return lambda data: data.update(
            sample_annotation=[row for row in data["sample_annotation"] if not row["token"].startswith(scenes)]
        )

    dataset = NuScenesDataset(write(tmp_path, lose("one")))
    assert dataset[0]["boxes_3d"].shape == (0, 9) and dataset[0]["box_names"] == [] and len(dataset[1]["boxes_3d"])
    write(tmp_path / "none", lose("one", "two"))
    with pytest.warns(UserWarning, match="sample_annotation has no rows of these samples"):
        unlabelled = NuScenesDataset(tmp_path / "none")
    assert "boxes_3d" not in unlabelled[1]  # or all would say that nothing moves


# --- the real keyframe ------------------------------------------------------------------------------------------------
def test_real_poses_points_and_images_are_the_published_ones(nuscenes_root: Path) -> None:
    calib = json.loads((nuscenes_root / "calib.json").read_text())
    cameras = {camera["name"]: camera for camera in calib["cameras"]}
    for compensate, key, tolerance in ((True, "cam2ego", 1e-6), (False, "cam2ego_static", 1e-9)):
        sample = NuScenesDataset(nuscenes_root, compensate_ego_motion=compensate)[0]
        assert tuple(sample["rig"].names) == CAMERA_RING
        for camera in sample["rig"]:
            np.testing.assert_allclose(camera.cam2ego, cameras[camera.name][key], atol=tolerance)
        np.testing.assert_allclose(sample["ego2world"], calib["ego2world"], atol=1e-9)
    folder = FrameFolder(nuscenes_root)[0]
    np.testing.assert_allclose(sample["points"][:, :4], folder["points"], atol=1e-4)
    assert torch.equal(sample["images"], folder["images"]) and np.array_equal(sample["K"], folder["K"])


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
def put(table: str, key: str, value: Any, token: str = "") -> Change:
    """Change a column of the first row of a table, or of the one with a token."""
    return lambda data: next(r for r in data[table] if r["token"].startswith(token)).update({key: value})


def lose(data: Tables) -> None:
    data["sample_data"] = [row for row in data["sample_data"] if not row["token"].startswith("one-LIDAR")]


def sensors(message: str, **columns: Any) -> tuple[Change, str]:
    return lambda data: [row.update(columns) for row in data["calibrated_sensor"]], message


FRONT = "one-CAM_FRONT-0"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda data: data.pop("ego_pose"), r"table ego_pose: expected the file .*ego_pose\.json, got none"),
        (lambda data: data.pop("instance"), "table instance: expected the file .*docs/formats.md has the tables"),
        (put("sample_data", "ego_pose_token", "x", FRONT), "table ego_pose: expected the token 'x' that a row of"),
        (
            put("sample_data", "calibrated_sensor_token", "x", FRONT),
            f"table calibrated_sensor: expected the token 'x' that row '{FRONT}-0' of sample_data names, got none",
        ),
        (put("calibrated_sensor", "sensor_token", "x"), "table sensor: .*'x' that row 'cs-CAM_FRONT' of calibrated"),
        (put("sample", "scene_token", "x"), "table scene: expected the token 'x' that row 'one-sample-0' of sample na"),
        (put("sample_annotation", "instance_token", "x"), "table instance: expected the token 'x' that row"),
        (lambda data: data["sample_data"][0].pop("filename"), "table sample_data: expected key 'filename', got a row"),
        (lose, "table sample_data: .*LIDAR_TOP for sample one-sample-0, got none"),
        (put("calibrated_sensor", "rotation", [0, 0, 0, 0]), "unit quaternions w x y z, got .*'cs-CAM_FRONT'"),
        (put("ego_pose", "translation", [1, 2], FRONT), r"expected translation of shape \(3,\), .*finite"),
        (put("calibrated_sensor", "camera_intrinsic", [[float("nan")] * 3] * 3), "'cs-CAM_FRONT'.*finite numb.*nan"),
        sensors("expected 4 or 5 or 8 coefficients of radtan, got 3", camera_distortion=[0.1, 0.2, 0.3]),
        sensors("a lens for its coefficients, .*write distortion_model", camera_distortion=[0.1, 0.2, 0, 0]),
        sensors("4 or 5 or 8 coefficients of radtan, got 6; undistort", camera_distortion=[0.1, 0, 0, 0, 0, 0.2]),
        sensors("MEI or omni without distortion, got", lens_model="omni", xi=0.9, D=[0.1] * 4),
        sensors("camera_model: expected plumb_bob, .*, got 'cylindrical'", camera_model="cylindrical"),
        sensors("keys that are read, got 'rectified': False", rectified=False),
        (put("sample_data", "camera_intrinsic", np.eye(3).tolist(), FRONT), "each image's calibration in cal"),
        (put("sample_data", "is_undistorted", False, FRONT), "got is_undistorted: False in row"),
        (put("sample_data", "timestamp", 1.5e9 + 0.5, FRONT), "as a whole number of microseconds"),
        (
            put("sample_data", "is_key_frame", "true", FRONT),
            "is_key_frame as true or false, got 'true'.*docs/formats.md",
        ),
    ],
)
def test_broken_tables(tmp_path: Path, change: Change, message: str) -> None:
    with pytest.raises(DataError, match=message) as caught:
        NuScenesDataset(write(tmp_path, change))
    assert "archive" not in str(caught.value)


def test_times_in_milliseconds(tmp_path: Path) -> None:
    data = tables_of(RIG, streets(2, one=lambda time_s: 5 * time_s))
    for row in data["sample_data"]:
        row["timestamp"] //= 1000
    with pytest.raises(DataError, match="are they in milliseconds or seconds"):
        NuScenesDataset(write_root(tmp_path, data, SIZE))


def test_wrong_arguments(tmp_path: Path) -> None:
    write(tmp_path)
    for arguments, message in (
        ({"version": "v1.0-x"}, r"expected a folder of tables 'v1\.0-x', found none.*: v1\.0-mini"),
        ({"channels": ["CAM_FRONT"] * 2}, "channels: expected each once, got 'CAM_FRONT', 'CAM_FRONT'"),
        ({"channels": ["CAM_FRONT", "CAM_TOP"]}, "expected some of CAM_BACK, .*, got 'CAM_TOP'"),
        ({"split_scenes": ["one", "nine"]}, "table scene: expected the scenes nine, got 2 others"),
        ({"split_scenes": "one"}, r"split_scenes: expected a collection of names such as \['one'\]"),
        ({"channels": "CAM_FRONT"}, r"channels: expected .* such as \['CAM_FRONT'\], got 'CAM_FRONT'"),
    ):
        with pytest.raises(DataError, match=message):
            NuScenesDataset(tmp_path, **arguments)  # type: ignore[arg-type]


def test_missing_and_broken_files(tmp_path: Path) -> None:
    dataset = NuScenesDataset(write(tmp_path))
    points, image = (next((tmp_path / "samples" / sensor).glob("one*")) for sensor in ("LIDAR_TOP", "CAM_BACK"))
    for numbers, message in ((np.zeros(7), r"\.bin: expected whole points of 5 float32, got 28 bytes"), (None, "")):
        points.unlink() if numbers is None else numbers.astype(np.float32).tofile(points)
        with pytest.raises(DataError, match=message or r"expected the LiDAR's file, got No such.*load_points=False"):
            dataset[0]
    np.full(5, np.nan, np.float32).tofile(points)
    with pytest.warns(UserWarning, match="points: rows with NaN"):
        assert dataset[0]["points"].shape == (0, 5)
    image.unlink()
    with pytest.raises(DataError, match=r"camera 'CAM_BACK': image .*\.png: expected an image file, found none"):
        dataset[0]
    cv2.imwrite(str(image), np.zeros((64, 48, 3), np.uint8))
    with pytest.raises(DataError, match=r"'CAM_BACK'.*expected 64x48 .*got 48x64; .*swapped"):
        dataset[0]
    shutil.rmtree(tmp_path / "v1.0-mini")
    with pytest.raises(DataError, match="found none; folders with tables: none"):
        NuScenesDataset(tmp_path)


# --- tables are read a part at a time ---------------------------------------------------------------------------------
def table(root: Path, text: str) -> Any:
    (root / "v1.0-mini").mkdir(parents=True, exist_ok=True)
    (root / "v1.0-mini" / "sample.json").write_text(text)
    return tables_module.Tables(root, "v1.0-mini")


@pytest.mark.parametrize("indent", [None, 0, 4])
def test_rows_are_those_of_json(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, indent: int | None) -> None:
    """Whatever a block ends in."""
    monkeypatch.setattr(tables_module, "_BLOCK", 500)
    monkeypatch.setattr(tables_module, "_LONGEST_ROW", 400)
    monkeypatch.setattr(tables_module, "_BATCH", 7)
    rows: list[dict[str, Any]] = [
        {"token": "]}, {[" * (k % 5), "é": [k, -k / 7, None], "deep": {"of": [{}]}, "n": k} for k in range(100)
    ]
    tables = table(tmp_path, "\n " + json.dumps(rows, indent=indent) + "\n")
    assert tables.rows("sample") == rows
    assert [len(batch) for batch in tables.batches("sample")] == [7] * 14 + [2]


def test_byte_order_marks_and_empty_tables(tmp_path: Path) -> None:
    for name, text, rows in (("a", '\ufeff[{"token": "a"}]\r\n', [{"token": "a"}]), ("b", " [ ] ", [])):
        assert table(tmp_path / name, text).rows("sample") == rows


def test_what_is_no_table(tmp_path: Path) -> None:
    for text, message in (
        ("", "expected JSON, got"),
        ("[", "expected JSON, got"),
        ('[{"token": 1}', "expected JSON, got Expecting ',' delimiter"),
        ('[{"token": 1},]', "expected JSON, got"),
        ('[{"token": 1} {"token": 2}]', "expected JSON, got Expecting ',' delimiter"),
        ('[{"token": "1', "expected JSON, got Unterminated string"),
        ('[{"token": 1}] [', "expected JSON, got Extra data"),
        ("{}", "expected a list of objects, got dict"),
        ("[{}, 3]", "expected a list of objects, got an entry int"),
        ("[" * 100_000, "expected JSON, got"),
    ):
        with pytest.raises(DataError, match=f"table sample: {message}"):
            table(tmp_path, text).rows("sample")
