"""nuScenes roots: a real keyframe's published calibration, broken tables, and other vehicles' cameras."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from arbiview_aug import Rig, RigRetarget, collate, load_rig
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import FrameFolder, Neighbours, NuScenesDataset, open_data
from arbiview_aug.datasets.nuscenes import tables as tables_module
from arbiview_aug.datasets.nuscenes.reader import CAMERA_RING
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.errors import DataError
from tests.cli.convert.drives import SIZE as SMALL
from tests.cli.convert.drives import SURROUND, TARGET_FILE, command
from tests.datasets.nuscenes_root import CHANNELS, START_US, Tables, streets, tables_of, write_root

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
        (put("sample", "scene_token", "x"), "table scene: expected the token 'x' that row 'one-sample-0' of sample na"),
        (put("sample_annotation", "instance_token", "x"), "table instance: expected the token 'x' that row"),
        (lambda data: data["sample_data"][0].pop("filename"), "table sample_data: expected key 'filename', got a row"),
        (lose, "table sample_data: .*LIDAR_TOP for sample one-sample-0, got none"),
        (put("sample_data", "ego_pose_token", "x", FRONT), "table ego_pose: expected the token 'x' that a row of"),
        (put("sample_data", "calibrated_sensor_token", "x", FRONT), "table calibrated_sensor: expected the token 'x'"),
        (put("calibrated_sensor", "sensor_token", "x"), "table sensor: .*'x' that row 'cs-CAM_FRONT' of calibrated"),
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
        (put("sample_data", "is_key_frame", "true", FRONT), "is_key_frame as true or false, got 'true'.*docs/form"),
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


# --- roots in nuscenes' layout with other vehicles' cameras, as camshift and pccr have them ---------------------------
Edit = Callable[[Tables], Any]

NAMES = ("CAM_BUMPER_FRONT", *(f"CAM_FENDER_{end}" for end in ("FRONT_LEFT", "FRONT_RIGHT", "L", "R")), "CAM_TAILGATE")


def write_vehicle(root: Path, rig: Rig, names: tuple[str, ...] = CHANNELS) -> Path:
    """Write a root of the cameras of ``rig``, with other names."""
    text = json.dumps(tables_of(rig, streets(2, goes=lambda time_s: 8 * time_s)))
    for old, new in sorted(zip(CHANNELS, names, strict=True), reverse=True):  # CAM_FRONT_LEFT before CAM_FRONT
        text = text.replace(old, new)
    return write_root(root, json.loads(text), SMALL)


@pytest.fixture(scope="module")
def vehicles(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A tall vehicle with nuScenes' names, and a small one with its own."""
    root = tmp_path_factory.mktemp("vehicles")
    small = SURROUND.shifted(x_m=-0.4, z_m=-0.6).turned(pitch_deg=3)
    return write_vehicle(root / "suv", SURROUND.shifted(z_m=0.4)), write_vehicle(root / "small", small, NAMES)


def test_one_vehicles_data_becomes_anothers(vehicles: tuple[Path, Path], tmp_path: Path) -> None:
    tall, small = vehicles
    data = open_data(small)
    assert data[0]["rig"].names == sorted(NAMES) and open_data(tall)[0]["rig"].names[0] == "CAM_FRONT"
    (before,) = NuScenesDataset(small, neighbours=Neighbours(count=1, direction="future"))[0]["neighbours"]
    assert before["rig"].names == sorted(NAMES)
    NuScenesDataset(small, compensate_ego_motion=False)[0]["rig"].save(tmp_path / "small.yaml")
    target = load_rig(tmp_path / "small.yaml")
    retarget = RigRetarget(target, geometry="street")
    converting = command(tall, tmp_path / "new", "--images", "png")
    converting[converting.index(str(TARGET_FILE))] = str(tmp_path / "small.yaml")
    del converting[converting.index("--size") : converting.index("--size") + 2]
    assert main(converting) == 0
    converted, truth = NuScenesDataset(tmp_path / "new"), NuScenesDataset(small, compensate_ego_motion=False)
    assert converted.channels == truth.channels and converted.tokens == truth.tokens
    for k in range(2):
        one, two = converted[k], truth[k]
        assert np.allclose(one["K"], two["K"]) and np.allclose(one["cam2ego"], two["cam2ego"], atol=1e-9)
        assert np.allclose(one["boxes_3d"], two["boxes_3d"], equal_nan=True)
        assert np.array_equal(one["images"], retarget(open_data(tall)[k])["images"])


# --- tables that others write -----------------------------------------------------------------------------------------
def renamed(lidar: str | None) -> Edit:
    def edit(data: Tables) -> None:
        data["sensor"] = [row for row in data["sensor"] if lidar or row["modality"] != "lidar"]
        for row in data["sensor"]:
            row["channel"] = lidar if row["modality"] == "lidar" else row["channel"]
        sensors = {row["token"] for row in data["sensor"]}
        data["calibrated_sensor"] = [row for row in data["calibrated_sensor"] if row["sensor_token"] in sensors]
        tokens = {row["token"] for row in data["calibrated_sensor"]}
        data["sample_data"] = [row for row in data["sample_data"] if row["calibrated_sensor_token"] in tokens]

    return edit


def put_all(table: str, **columns: Any) -> Edit:
    """Change columns of all rows of a table, by value or by function of the row."""

    def edit(data: Tables) -> None:
        for row in data[table]:
            row |= {key: value(row) if callable(value) else value for key, value in columns.items()}

    return edit


READ: dict[str, tuple[Edit, str]] = {
    "another LiDAR": (renamed("LIDAR_LEFT"), ""),
    "no LiDAR": (renamed(None), ""),
    "flags as numbers": (put_all("sample_data", is_key_frame=lambda row: int(row["is_key_frame"])), ""),
    "no labels": (
        lambda data: [data.pop(name) for name in ("category", "instance", "sample_annotation")],
        "no table category, sample_annotation",
    ),
    "a box of size 0": (lambda data: data["sample_annotation"][0].update(size=[0, 1, 1]), "1 boxes, row .* left out"),
    "a box of NaN": (lambda d: d["sample_annotation"][0].update(translation=[float("nan"), 1, 1]), "left out"),
    "nanoseconds": (put_all("sample_data", timestamp=lambda row: row["timestamp"] * 1000), ""),
    "capitals": (put_all("sensor", modality=lambda row: row["modality"].upper()), ""),
    "no sizes": (put_all("sample_data", width=0, height=None), ""),
    "zero distortion": (put_all("calibrated_sensor", camera_distortion=[0] * 6, distortion_model="plumb_bob"), ""),
}

CONVERTED = ("another LiDAR", "no LiDAR", "no labels", "a box of NaN")  # and the others are no different there


@pytest.mark.parametrize("title", READ)
def test_own_tables_are_read_and_converted(title: str, tmp_path: Path) -> None:
    edit, said = READ[title]
    data = tables_of(SURROUND, streets(2, goes=lambda time_s: 8 * time_s))
    edit(data)
    root = write_root(tmp_path / "root", data, SMALL)
    if title == "nanoseconds":  # all others are neighbours as before
        assert NuScenesDataset(root, neighbours=Neighbours())[0]["time_s"] == pytest.approx(1e-6 * START_US)
    with pytest.warns(UserWarning, match=said) if said else nullcontext():
        (batch,) = DataLoader(NuScenesDataset(root), batch_size=2, collate_fn=collate)
    assert batch["images"].shape == (2, 6, 3, *SMALL)
    assert ("points" in batch) == (title != "no LiDAR") and ("boxes_3d" in batch) == (title != "no labels")
    if title not in CONVERTED:
        return
    assert main(command(root, tmp_path / "new", "--points", "source")) == 0
    converted = open_data(tmp_path / "new")[0]
    assert torch.equal(converted["ego2world"], batch["ego2world"][0]) and ("points" in converted) == ("points" in batch)


@pytest.mark.parametrize(
    ("columns", "lens", "coefficients"),
    [
        ({"camera_distortion": [-0.3, 0.1, 0.001, 0.0, 0.02]}, "radtan", (-0.3, 0.1, 0.001, 0.0, 0.02)),
        ({"camera_distortion": [-0.3, 0.1, 0, 0, 0.01, 0]}, "radtan", (-0.3, 0.1, 0, 0, 0.01)),
        ({"distortion": [0.01, 0, 0, 0], "distortion_model": "equidistant"}, "fisheye", (0.01, 0, 0, 0)),
        ({"camera_distortion": [0] * 4, "camera_model": "Fisheye"}, "fisheye", (0, 0, 0, 0)),
        ({"camera_distortion": [], "distortion_model": "none", "rectified": True}, "pinhole", ()),
    ],
)
def test_lenses_in_tables_are_read(columns: dict[str, Any], lens: str, coefficients: Any, tmp_path: Path) -> None:
    """T4 and nuImages have ``camera_distortion``, which was ignored."""
    data = tables_of(SURROUND, streets(1, stands=lambda time_s: 0.0))
    put_all("calibrated_sensor", **columns)(data)
    (camera, *_) = NuScenesDataset(write_root(tmp_path, data, SMALL))[0]["rig"]
    assert camera.lens == lens and camera.distortion == coefficients


def test_one_of_several_lidars_is_chosen(tmp_path: Path) -> None:
    data = tables_of(SURROUND, streets(1, stands=lambda time_s: 0.0))
    renamed("LIDAR_LEFT")(data)
    data["sensor"].append({"token": "other", "channel": "LIDAR_RIGHT", "modality": "lidar"})
    root = write_root(tmp_path / "root", data, SMALL)
    with pytest.raises(DataError, match=r"got LIDAR_LEFT, LIDAR_RIGHT; lidar_channel='LIDAR_LEFT' \(--lidar-channel"):
        NuScenesDataset(root)
    assert "points" not in NuScenesDataset(root, load_points=False)[0]
    with pytest.raises(DataError, match="lidar_channel: expected 'X', with modality lidar, got LIDAR_LEFT, LIDAR_RIGH"):
        open_data(root, lidar_channel="X")
    for path in (root / "samples" / "LIDAR_TOP").iterdir():
        np.ones((7, 4), np.float32).tofile(path)
    asked = ["--lidar-channel", "LIDAR_LEFT", "--lidar-columns", "x", "y", "z", "intensity"]
    assert open_data(root, lidar_channel=asked[1], lidar_columns=asked[3:])[0]["points"].shape == (7, 4)
    assert main(["check", str(root), *asked, "--output", str(tmp_path / "pictures")]) in (0, 1)
    assert main(["check", str(root), *asked[:2], "--output", str(tmp_path / "pictures")]) == 2
    assert main(["inspect", f"nuscenes:{root}", "--output", str(tmp_path / "rig.png")]) == 0
    assert main([*command(root, tmp_path / "new", "--points", "source"), *asked]) == 0


def test_convert_names_channels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_vehicle(tmp_path / "root", SURROUND)
    assert main(command(root, tmp_path / "a", "--points", "source")) == 0
    assert "detectors' converters ask for CAM_FRONT, CAM_FRONT_RIGHT" in (said := capsys.readouterr().err)
    name, *_ = load_rig(TARGET_FILE).names
    assert f"--names {name}=CAM_FRONT ..." in said
    assert main(command(root, tmp_path / "b", "--points", "source", "--names", f"{name}=CAM_FRONT")) == 0
    assert NuScenesDataset(tmp_path / "b").channels[0] == "CAM_FRONT"
    assert main(command(root, tmp_path / "c", "--names", "gone=CAM_FRONT")) == 2
    assert f"--names: expected cameras of the target, {name}, " in capsys.readouterr().err
