"""nuScenes in the loader, and as nuscenes-devkit reads what we read and what we wrote."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from arbiview_aug import Rig, RigRetarget, load_rig
from arbiview_aug.datasets import NuScenesDataset
from integrations.environments import python_of
from integrations.nuscenes.compare import apart_px, devkit_boxes
from integrations.nuscenes.example import main
from integrations.nuscenes.fake_root import VERSION, fake_root


@pytest.fixture(scope="module")
def root(tmp_path_factory: Any) -> Path:
    return fake_root(tmp_path_factory.mktemp("nuscenes") / "root")


def test_the_fake_root_is_whole(root: Path) -> None:
    """Every token leads somewhere, every link has its way back: the devkit follows them all."""
    tables = {path.stem: json.loads(path.read_text()) for path in (root / VERSION).glob("*.json")}
    assert len(tables) == 13
    for name in ("sample", "sample_annotation", "sample_data"):
        rows = {row["token"]: row for row in tables[name]}
        assert all(rows[row["next"]]["prev"] == token for token, row in rows.items() if row["next"])
    for row in tables["instance"]:
        assert row["nbr_annotations"] == sum(a["instance_token"] == row["token"] for a in tables["sample_annotation"])


def test_example(root: Path, capsys: Any) -> None:
    assert main(["--data", str(root), "--size", "32", "88"]) == 0
    out = capsys.readouterr().out
    assert out.count("(5, 3, 32, 88)") == 2 and "boxes visible in 2D" in out


@pytest.mark.integrations
def test_the_devkit_sees_a_source_as_we_do(root: Path, tmp_path: Path) -> None:
    entries = devkit_boxes(python_of("nuscenes"), root, VERSION, tmp_path / "boxes.json")
    apart = apart_px(entries, NuScenesDataset(root, VERSION).by_token)
    assert len(apart) > 20 and apart.max() <= 0.5


@pytest.mark.integrations
def test_the_devkit_sees_a_real_keyframe_as_we_do(tmp_path: Path) -> None:
    """Our boxes stand upright on the ego's plane, nuScenes' lean by 2 degrees: centres agree, near corners do not."""
    data = os.environ.get("ARBIVIEW_DATA")
    if data is None or not (Path(data) / "nuscenes-one").is_dir():
        pytest.skip("no real frame: set ARBIVIEW_DATA to their folder")
    real = Path(data) / "nuscenes-one"
    entries = devkit_boxes(python_of("nuscenes"), real, VERSION, tmp_path / "boxes.json")
    apart = apart_px(entries, NuScenesDataset(real, VERSION).by_token)
    assert len(apart) > 20 and apart[:, 0].max() <= 0.5


@pytest.mark.integrations
def test_the_devkit_sees_what_was_converted_as_we_retarget_it(root: Path, tmp_path: Path) -> None:
    """Tables that ``convert`` wrote: the devkit's boxes are ours there, and ours of the source seen by the target."""
    target = load_rig("waymo").undistorted().resized((64, 96))
    rig_file, output = target.save(tmp_path / "target.yaml"), tmp_path / "converted"
    command = [sys.executable, "-m", "arbiview_aug", "convert", "--data", f"nuscenes:{root}", "--points", "source"]
    subprocess.run([*command, "--target", str(rig_file), "--output", str(output)], check=True, timeout=500)
    (tables,) = output.glob("v1.0-*")
    entries = devkit_boxes(python_of("nuscenes"), output, tables.name, tmp_path / "boxes.json")
    converted, source = NuScenesDataset(output, tables.name), NuScenesDataset(root, VERSION)
    read = apart_px(entries, converted.by_token)
    assert len(read) > 10 and read.max() <= 0.5
    assert sorted(converted.channels) == sorted(target.names)
    retarget = RigRetarget(target)

    def rig_of(sample: Any) -> Rig:
        poses = retarget(sample)["cam2ego"].numpy()
        return Rig([replace(camera, cam2ego=pose) for camera, pose in zip(target, poses, strict=True)])

    assert apart_px(entries, source.by_token, rig_of).max() <= 0.5
