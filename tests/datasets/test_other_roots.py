"""Roots in nuScenes' layout with other vehicles' cameras, as CamShift and PCCR have them: read, rendered, converted."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from arbiview_aug import Rig, RigRetarget, collate, load_rig
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import Neighbours, NuScenesDataset, open_data
from arbiview_aug.errors import DataError
from tests.cli.convert.drives import SIZE, SURROUND, TARGET_FILE, command
from tests.datasets.nuscenes_root import CHANNELS, START_US, Tables, streets, tables_of, write_root

Edit = Callable[[Tables], Any]

NAMES = ("CAM_BUMPER_FRONT", *(f"CAM_FENDER_{end}" for end in ("FRONT_LEFT", "FRONT_RIGHT", "L", "R")), "CAM_TAILGATE")


def write_vehicle(root: Path, rig: Rig, names: tuple[str, ...] = CHANNELS) -> Path:
    """Write a root of the cameras of ``rig``, with other names."""
    text = json.dumps(tables_of(rig, streets(2, goes=lambda time_s: 8 * time_s)))
    for old, new in sorted(zip(CHANNELS, names, strict=True), reverse=True):  # CAM_FRONT_LEFT before CAM_FRONT
        text = text.replace(old, new)
    return write_root(root, json.loads(text), SIZE)


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


def put(table: str, **columns: Any) -> Edit:
    """Change columns of all rows of a table, by value or by function of the row."""

    def edit(data: Tables) -> None:
        for row in data[table]:
            row |= {key: value(row) if callable(value) else value for key, value in columns.items()}

    return edit


def drop(*names: str) -> Edit:
    return lambda data: [data.pop(name) for name in names]


READ: dict[str, tuple[Edit, str]] = {
    "another LiDAR": (renamed("LIDAR_LEFT"), ""),
    "no LiDAR": (renamed(None), ""),
    "flags as numbers": (put("sample_data", is_key_frame=lambda row: int(row["is_key_frame"])), ""),
    "no labels": (drop("category", "instance", "sample_annotation"), "no table category, sample_annotation"),
    "a box of size 0": (lambda data: data["sample_annotation"][0].update(size=[0, 1, 1]), "1 boxes, row .* left out"),
    "a box of NaN": (lambda d: d["sample_annotation"][0].update(translation=[float("nan"), 1, 1]), "left out"),
    "nanoseconds": (put("sample_data", timestamp=lambda row: row["timestamp"] * 1000), ""),
    "capitals": (put("sensor", modality=lambda row: row["modality"].upper()), ""),
    "no sizes": (put("sample_data", width=0, height=None), ""),
    "zero distortion": (put("calibrated_sensor", camera_distortion=[0] * 6, distortion_model="plumb_bob"), ""),
}

CONVERTED = ("another LiDAR", "no LiDAR", "no labels", "a box of NaN")  # and the others are no different there


@pytest.mark.parametrize("title", READ)
def test_own_tables_are_read_and_converted(title: str, tmp_path: Path) -> None:
    edit, said = READ[title]
    data = tables_of(SURROUND, streets(2, goes=lambda time_s: 8 * time_s))
    edit(data)
    root = write_root(tmp_path / "root", data, SIZE)
    if title == "nanoseconds":  # all others are neighbours as before
        assert NuScenesDataset(root, neighbours=Neighbours())[0]["time_s"] == pytest.approx(1e-6 * START_US)
    with pytest.warns(UserWarning, match=said) if said else nullcontext():
        (batch,) = DataLoader(NuScenesDataset(root), batch_size=2, collate_fn=collate)
    assert batch["images"].shape == (2, 6, 3, *SIZE)
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
    put("calibrated_sensor", **columns)(data)
    (camera, *_) = NuScenesDataset(write_root(tmp_path, data, SIZE))[0]["rig"]
    assert camera.lens == lens and camera.distortion == coefficients


def test_one_of_several_lidars_is_chosen(tmp_path: Path) -> None:
    data = tables_of(SURROUND, streets(1, stands=lambda time_s: 0.0))
    renamed("LIDAR_LEFT")(data)
    data["sensor"].append({"token": "other", "channel": "LIDAR_RIGHT", "modality": "lidar"})
    root = write_root(tmp_path / "root", data, SIZE)
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
