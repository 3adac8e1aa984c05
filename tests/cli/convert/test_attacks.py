"""Data sets that mean harm: names and links that lead elsewhere, and samples that raise what nobody expects.

``tests/test_atomic_io.py`` has all such names and links; here is every place that takes one, and whole conversions.
"""

from __future__ import annotations

import itertools
import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest

from arbiview_aug import RigRetarget
from arbiview_aug.__main__ import main
from arbiview_aug.cli.convert import command as command_module
from arbiview_aug.cli.convert import job
from arbiview_aug.datasets import FrameFolder, RetargetedDataset
from arbiview_aug.errors import DataError
from tests.cli.convert.drives import TARGET, command, tree, write_frames, write_nuscenes

VICTIM = "years of work"


@pytest.fixture(scope="module")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("sources")
    return {"nuscenes": write_nuscenes(root / "nuscenes", 2), "frames": write_frames(root / "frames", 3)}


class Home:
    """A folder with a data set to attack with, and files that must stay as they are.

    Attributes:
        root: The folder: ``in`` is what an archive may bring, ``new`` the output of conversions.
        source: A copy of the data set, in ``in``.
        said: Text that the last command printed on standard error.
    """

    def __init__(self, root: Path, original: Path, capsys: pytest.CaptureFixture[str] | None = None) -> None:
        self.root, self.output, self._capsys, self.said = root, root / "new", capsys, ""
        (root / "in" / "folder").mkdir(parents=True)
        for name in (".bashrc", "secret", "in/secret.png", "in/folder/x.bin"):
            (root / name).write_text(VICTIM)
        (root / "in" / ".bashrc").write_text("rm -rf ~")
        self.source = Path(shutil.copytree(original, root / "in" / "source"))

    def outside(self) -> dict[str, tuple[Any, ...]]:
        """All but the output: contents, and inodes and numbers of links of what is not the source's."""
        files: dict[str, tuple[Any, ...]] = {}
        for path in sorted(self.root.rglob("*")):
            name = path.relative_to(self.root).as_posix()
            if name.split("/")[0] == "new" or not (path.is_file() or path.is_symlink()):
                continue
            status, content = path.lstat(), path.read_bytes() if path.is_file() else b""
            files[name] = (content,) if name.startswith("in/source/") else (content, status.st_ino, status.st_nlink)
        return files

    def run(self, *arguments: str) -> int:
        """The status of a command, which changes nothing outside its output and prints no traceback."""
        before = self.outside()
        status = main([*arguments])
        assert self.outside() == before
        if self._capsys is not None:
            self.said = self._capsys.readouterr().err
        assert "Traceback" not in self.said
        return status

    def convert(self, *more: str) -> int:
        return self.run(*command(self.source, self.output), *more)

    def change(self, table: str, edit: Callable[[list[dict[str, Any]]], None]) -> None:
        path = self.source / "v1.0-mini" / f"{table}.json"
        rows = json.loads(path.read_text()) if path.is_file() else []
        edit(rows)
        path.write_text(json.dumps(rows))

    def rename(self, table: str, name: Any, part: str = "RADAR") -> str:
        """Give a file of a table another name; gives the row's token."""
        tokens: list[str] = []

        def edit(rows: list[dict[str, Any]]) -> None:
            if table in ("lidarseg", "panoptic"):
                rows.append({"token": "attack", "sample_data_token": "x", "filename": ""})
            row = rows[-1] if table != "sample_data" else next(row for row in rows if part in row["filename"])
            row["filename"] = name
            tokens.append(row["token"])

        self.change(table, edit)
        return tokens[0]

    def calibrate(self, key: str, name: Any) -> None:
        """Give the image, mask or points of frame 0001 another name."""
        path = self.source / "0001" / "calib.json"
        calib = json.loads(path.read_text())
        if key == "lidar":
            calib["lidar"] = {"file": name}
        else:
            calib["cameras"][0][key] = name
        path.write_text(json.dumps(calib))


@pytest.fixture
def tables(originals: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Home:
    return Home(tmp_path / "tables", originals["nuscenes"], capsys)


@pytest.fixture
def frames(originals: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Home:
    return Home(tmp_path / "frames", originals["frames"], capsys)


# --- names ------------------------------------------------------------------------------------------------------------
OWN_FILES = ("conversion/settings.json", "v1.0-mini/sample.json", "samples//ring_front_center/0.jpg")
"""Names that the conversion itself writes."""


@pytest.mark.parametrize(
    ("table", "name"),
    [
        *((table, "../.bashrc") for table in ("sample_data", "lidarseg", "panoptic", "map")),
        *(("sample_data", name) for name in OWN_FILES),
    ],
)
def test_names_of_kept_files(table: str, name: str, tables: Home) -> None:
    """``../.bashrc`` of a radar replaced a file beside the output."""
    if name in OWN_FILES:
        (tables.source / name).parent.mkdir(parents=True, exist_ok=True)
        (tables.source / name).touch()
    token = tables.rename(table, name)
    assert tables.convert() == 2 and not tables.output.exists()
    said = [f"got one in {Path(name).parent}"] if name in OWN_FILES else [f"table {table}: ", repr(token), "filename"]
    assert all(words in tables.said for words in said)


@pytest.mark.parametrize("key", ["file", "mask", "lidar"])
@pytest.mark.parametrize("name", ["../../secret.png", "{root}/in/secret.png", 7])
def test_frame_folders_refuse_names(key: str, name: Any, frames: Home) -> None:
    original = frames.source / "0001" / ("lidar.npy" if key == "lidar" else "00.jpg")
    shutil.copy(original, frames.root / "in" / "secret.png")  # it could be read
    frames.calibrate(key, name.format(root=frames.root) if isinstance(name, str) else name)
    data = FrameFolder(frames.source)
    wrapped = RetargetedDataset(data, RigRetarget(TARGET, size=(24, 40), geometry="street"))
    assert {"points", "images"} < set(data[0])
    for of in (data, wrapped):
        with pytest.raises(ValueError, match=r"0001.*: expected") as caught:
            of[1]
        assert type(caught.value).__name__ in ("DataError", "CalibrationError")


def test_a_frame_shares_files_of_frames_beside_it(frames: Home) -> None:
    """A real drive does, and a frame alone shares masks; anything else beside it is refused, and so is a link."""
    source = frames.source
    frames.calibrate("file", "../0000/00.jpg")
    assert FrameFolder(source)[1]["images"].shape[0] == 2
    with pytest.raises(DataError, match="expected"):
        FrameFolder(source / "0001")[0]
    frames.calibrate("file", "00.jpg")
    size = FrameFolder(source)[1]["rig"][0].size
    (source / "other").mkdir()
    for name in ("0000/mask.png", "mask.png", "other/mask.png"):
        cv2.imwrite(str(source / name), np.full(size, 255, np.uint8))
    (source / "0000" / "link.png").symlink_to(source / "mask.png")
    frames.calibrate("mask", "../0000/mask.png")
    assert FrameFolder(source / "0001")[0]["rig"][0].mask.all()
    elsewhere = ("../mask.png", "../other/mask.png", "../0000/link.png", "../../mask.png", "../0000/../mask.png")
    for name in (*elsewhere, "../a\0b/c", f"../{'x' * 300}/c", "../a\ud800b/c"):
        frames.calibrate("mask", name)
        with pytest.raises(DataError, match=r"0001.*: expected"):
            FrameFolder(source / "0001")[0]


@pytest.mark.parametrize("name", ["..", "x" * 300])
def test_cameras_whose_names_are_no_folders(name: str, tables: Home) -> None:
    rig = TARGET.to_dict()
    rig["cameras"][0]["name"] = name
    (tables.root / "rig.json").write_text(json.dumps(rig))
    assert tables.convert("--target", str(tables.root / "rig.json")) == 2
    assert "expected a" in tables.said and not tables.output.exists()


@pytest.mark.parametrize("name", ["3" * 250, "车" * 80])
def test_frames_of_long_names(name: str, frames: Home) -> None:
    (frames.source / "sequence.json").unlink()
    (frames.source / "0001").rename(frames.source / name)
    assert frames.convert() == 0
    assert len(FrameFolder(frames.output)) == 3


# --- links ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("kind", "name"),
    [
        *(("tables", f"samples/{name}") for name in ("RADAR_FRONT/*", "CAM_FRONT/*", "LIDAR_TOP/*", "RADAR_FRONT")),
        *(("tables", name) for name in ("sweeps", "v1.0-mini/attribute.json", "maps/map.png", "maps")),
        *(("frames", f"0001/{name}") for name in ("lidar.npy", "00.jpg", "calib.json")),
        *(("frames", name) for name in ("0001", "sequence.json")),
    ],
)
def test_links_that_leave_the_root(kind: str, name: str, request: pytest.FixtureRequest) -> None:
    """A link to a system file became a second link to its inode; calibrations and tables were copied."""
    home: Home = request.getfixturevalue(kind)
    (home.source / "v1.0-mini").is_dir() and (home.source / "v1.0-mini" / "attribute.json").write_text("[]")
    path = sorted(home.source.glob(name))[0]
    path.rename(home.root / "in" / "elsewhere")
    path.symlink_to(home.root / "in" / "elsewhere")
    assert home.convert() in (1, 2)
    assert "links must not leave the folder" in home.said and path.name in home.said


@pytest.mark.parametrize("kind", ["tables", "frames"])
def test_links_that_stay_in_the_root(kind: str, request: pytest.FixtureRequest) -> None:
    """Files and a folder that are links, in a root that is one."""
    home: Home = request.getfixturevalue(kind)
    (home.source / "sequence.json").unlink(missing_ok=True)  # its names are of frames
    assert main(command(home.source, home.root / "plain", "--points", "source")) == 0
    blobs = home.source / "blobs"
    (home.source / ("maps" if kind == "tables" else "0001")).rename(home.root / "folder")
    for k, path in enumerate(sorted(home.source.rglob("*.*"))):
        if path.suffix in (".bin", ".npy", ".jpg", ".png"):
            (blobs / str(k)).mkdir(parents=True)
            moved = path.rename(blobs / str(k) / path.name)
            path.symlink_to(os.path.relpath(moved, path.parent))
    (home.root / "folder").rename(blobs / "folder")
    (home.source / ("maps" if kind == "tables" else "0001")).symlink_to(Path("blobs", "folder"))
    (home.root / "root").symlink_to(Path("in", "source"))
    assert main(command(home.root / "root", home.output, "--points", "source")) == 0
    plain, linked = tree(home.root / "plain"), tree(home.output)
    named = {"conversion/settings.json", "conversion/provenance.json"}  # the roots have other names
    assert {name for name in plain if linked.get(name) != plain[name]} <= named and plain.keys() == linked.keys()
    assert not any(path.is_symlink() for path in home.output.rglob("*"))


def test_depth_is_not_written_elsewhere(frames: Home) -> None:
    """Into a folder that a link in the data leads to; or a link in its place."""
    (frames.source / "motion_depth").symlink_to(frames.root / "in" / "folder")
    assert frames.run("depth", "--data", str(frames.source)) == 2
    assert "links must not leave the folder" in frames.said
    assert frames.convert("--geometry", "motion") == 2
    told = frames.root / "in" / "folder"
    assert main(["depth", "--data", str(frames.source), "--output", str(told)]) == 1  # no drive, so no depth
    assert len(list(told.glob("*.npz"))) == 3  # as it was told


# --- whatever a sample raises -----------------------------------------------------------------------------------------


def raises(error: BaseException | None = None) -> Any:
    raise error or ZeroDivisionError("of something")


def test_a_cluster_that_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    ray = SimpleNamespace(init=lambda **_: raises(ValueError("Malformed address nonsense")))
    monkeypatch.setattr(command_module, "optional_package", lambda *_: ray)
    with pytest.raises(DataError, match=r"expected a cluster \(RAY_ADDRESS\) that can be reached, got Malformed"):
        command_module.ray_results(SimpleNamespace(), 1)  # type: ignore[arg-type]


@pytest.mark.parametrize("step", ["read", "retarget", "write"])
@pytest.mark.parametrize("on_error", ["report", "skip"])
def test_errors_that_nobody_expects(step: str, on_error: str, frames: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    steps = {"read": (FrameFolder, "__getitem__"), "retarget": (RigRetarget, "forward"), "write": (job, "rig_of")}
    calls, sound = itertools.count(1), getattr(*steps[step])
    monkeypatch.setattr(*steps[step], lambda *inputs: raises() if next(calls) == 2 else sound(*inputs))
    assert frames.convert("--on-error", on_error) == (0 if on_error == "skip" else 1)
    state = "skipped" if on_error == "skip" else "failed"
    assert f"0001: {state}: ZeroDivisionError: of something" in frames.said
    assert (frames.output / "0002").exists()


def test_an_interrupt_is_no_samples_fault(frames: Home, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(FrameFolder, "__getitem__", lambda *_: raises(KeyboardInterrupt()))
    assert frames.convert("--on-error", "skip") == 130
    assert "run it again to go on" in frames.said


@pytest.mark.parametrize("name", ["conversion", "conversion/samples", "v1.0-mini"])
def test_no_link_leads_out_of_the_output(name: str, tables: Home) -> None:
    """Records and tables were written where it led."""
    (tables.root / "elsewhere").mkdir()
    (tables.output / name).parent.mkdir(parents=True)
    (tables.output / name).symlink_to(tables.root / "elsewhere")
    assert tables.convert() == 2 and "links must not leave the folder" in tables.said
    assert not [*(tables.root / "elsewhere").iterdir()]
