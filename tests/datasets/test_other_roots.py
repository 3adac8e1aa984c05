"""Roots in nuScenes' layout with other vehicles' cameras, as CamShift and PCCR have them: read, rendered, converted."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from torch.utils.data import DataLoader

from arbiview_aug import RetargetedDataset, Rig, RigRetarget, collate, load_rig
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import Neighbours, NuScenesDataset, open_data
from tests.cli.convert.drives import SIZE, SURROUND, TARGET_FILE, command
from tests.datasets.nuscenes_root import CHANNELS, streets, tables_of, write_root

NAMES = ("CAM_BUMPER_FRONT", *(f"CAM_FENDER_{end}" for end in ("FRONT_LEFT", "FRONT_RIGHT", "L", "R")), "CAM_TAILGATE")


def write_vehicle(root: Path, rig: Rig, names: tuple[str, ...] = CHANNELS) -> Path:
    """A root whose cameras stand as those of ``rig`` and have other names."""
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
    asked = ["--data", f"nuscenes:{tall}", "--target", str(tmp_path / "small.yaml"), "--geometry", "street"]
    assert main(["demo", *asked, "--output", str(tmp_path / "demo")]) == 0
    retarget = RigRetarget(target, geometry="street")
    (batch,) = DataLoader(RetargetedDataset(open_data(tall), retarget), batch_size=2, collate_fn=collate)
    assert batch["images"].shape == (2, 6, 3, *SIZE)
    converting = command(tall, tmp_path / "new", "--images", "png")
    converting[converting.index(str(TARGET_FILE))] = str(tmp_path / "small.yaml")
    del converting[converting.index("--size") : converting.index("--size") + 2]
    assert main(converting) == 0 and main([*converting, "--verify"]) == 0
    converted, truth = NuScenesDataset(tmp_path / "new"), NuScenesDataset(small, compensate_ego_motion=False)
    assert converted.channels == truth.channels and converted.tokens == truth.tokens
    for k in range(2):
        one, two = converted[k], truth[k]
        assert np.allclose(one["K"], two["K"]) and np.allclose(one["cam2ego"], two["cam2ego"], atol=1e-9)
        assert np.allclose(one["boxes_3d"], two["boxes_3d"], equal_nan=True)
        assert np.array_equal(one["images"], retarget(open_data(tall)[k])["images"])
