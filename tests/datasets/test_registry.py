"""Readers: which one opens a folder, and that one row adds a kind to every command."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.datasets import FrameFolder, NuScenesDataset, open_data
from arbiview_aug.datasets.drive import Recording
from arbiview_aug.datasets.registry import READERS, Reader, data_name, kinds_of, split_kind
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import DataError


@cache
def street() -> dict[str, Any]:
    return SyntheticDrive(demo_source_rig((48, 132)), num_frames=1, lidar=False)[0]


class Toy(Recording):
    """One synthetic street."""

    def __init__(self, root: Path) -> None:
        self.root, self.tokens, self.load_points = root, ["street"], True

    def __getitem__(self, index: int) -> dict[str, Any]:
        return {**street(), "token": self.tokens[index]}


@pytest.fixture
def toy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    row = Reader("toy folder (with toy.txt)", lambda root: (root / "toy.txt").is_file(), lambda root, **_: Toy(root))
    monkeypatch.setitem(READERS, "toy", row)
    folder = tmp_path / "toys"
    folder.mkdir()
    (folder / "toy.txt").touch()
    return folder


def test_one_row_adds_a_kind(toy: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert isinstance(open_data(toy), Toy) and isinstance(open_data(f"toy:{toy}", kind="toy"), Toy)
    rendered = ["--target", "waymo", "--size", "32x56", "--geometry", "infinity", "--output", str(tmp_path / "out")]
    assert main(["demo", "--data", f"toy:{toy}", *rendered]) == 0
    assert main(["evaluate", "--data", f"toy:{toy}", *rendered]) == 0
    assert main(["inspect", f"toy:{toy}", "waymo", "--output", str(tmp_path / "rigs.png")]) == 0
    with pytest.raises(SystemExit, match="0"):
        main(["demo", "--help"])
    said = capsys.readouterr()
    assert "toy: toy folder (with toy.txt)" in " ".join(said.out.split())
    convert = ["convert", "--data", str(toy), "--target", "waymo", "--output", str(tmp_path / "new")]
    assert main(convert) == 2
    assert "expected a kind that can be written, got a toy folder" in capsys.readouterr().err


def test_data_without_samples(toy: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    empty = Toy(toy)
    empty.tokens = []
    monkeypatch.setitem(READERS, "toy", replace(READERS["toy"], open=lambda root, **_: empty))
    monkeypatch.setitem(sys.modules, "rerun", ModuleType("rerun"))  # of the extra viewer
    for command in (["check"], ["demo", "--data"], ["view"]):
        assert main([*command, str(toy)]) == 2
        assert "toys: expected samples, got none" in capsys.readouterr().err


def test_kind_and_path() -> None:
    assert split_kind("nuscenes:/data/nuscenes") == ("nuscenes", Path("/data/nuscenes"))
    assert split_kind(Path("frames:drive")) == ("frames", Path("drive"))
    for other in ("frames", "frames:", "C:data", "kitti:drive"):
        assert split_kind(other) == (None, Path(other))
    assert data_name("frames:.") == Path.cwd().name


@pytest.mark.slow
def test_frame_folders_win_over_tables(nuscenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert kinds_of(nuscenes_root) == ["frames", "nuscenes"]
    assert isinstance(open_data(nuscenes_root), FrameFolder)
    for tables in (open_data(f"nuscenes:{nuscenes_root}"), open_data(nuscenes_root, kind="nuscenes")):
        assert isinstance(tables, NuScenesDataset)
    assert main(["inspect", f"nuscenes:{nuscenes_root}", "--output", str(tmp_path / "rigs.png")]) == 0
    assert not capsys.readouterr().err
    options = ["--target", "argoverse2", "--size", "32x40", "--geometry", "infinity", "--downscale", "4"]
    assert main(["evaluate", "--data", str(nuscenes_root), *options, "--output", str(tmp_path)]) == 0
    note = f"{nuscenes_root}: taken as a frame folder (calib.json in it or in its folders); otherwise: "
    assert f"{note}nuscenes:{nuscenes_root}\n" in capsys.readouterr().err


def test_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for data, kind, message in (
        ("nowhere", None, "data nowhere: expected a folder, found none$"),
        ("kitti:nowhere", None, "expected a folder, found none; the kinds of KIND:PATH are frames, nuscenes, py123d"),
        ("nuscenes:nowhere", None, "data nowhere: expected a folder, found none$"),
        (".", "kitti", "expected a kind of frames, nuscenes, py123d, got 'kitti'"),
        (".", None, r"expected a frame folder \(calib.json .* or a nuScenes root .*, found none of them"),
    ):
        with pytest.raises(DataError, match=message):
            open_data(data, kind=kind)
    (tmp_path / "v1.0-mini").mkdir()
    with pytest.raises(DataError, match=r"table|scene\.json|v1\.0-mini"):
        open_data(tmp_path)
    (tmp_path / "v1.0-mini").rmdir()
    (tmp_path / "sync.arrow").touch()
    with pytest.raises(DataError, match=r"expected no clean_masks \(--clean-masks\), which a folder of py123d's logs"):
        open_data(tmp_path, clean_masks=True)
