"""Data sets that mean harm: names and links that lead elsewhere, and samples that raise what nobody expects."""

from __future__ import annotations

import json
import os
import pickle
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from torch.utils.data import DataLoader

from arbiview_aug import RigRetarget, load_rig
from arbiview_aug.__main__ import main
from arbiview_aug.cli.convert import job, ray_runner
from arbiview_aug.cli.convert.job import Jobs
from arbiview_aug.cli.convert.ray_runner import Actor
from arbiview_aug.cli.convert.settings import Settings
from arbiview_aug.datasets import FrameFolder, NuScenesDataset, RetargetedDataset
from arbiview_aug.errors import DataError
from tests.cli.convert.drives import command, tree, write_frames, write_nuscenes

VICTIM = "years of work"
NAMES = ("../.bashrc", "samples/../../.bashrc", "/etc/hostname", "", "a\0b", "a\ud800b", "x" * 300, None)
"""Names that no file of a data set may have."""


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("sources")
    return {"nuscenes": write_nuscenes(root / "nuscenes", 2), "frames": write_frames(root / "frames", 3)}


@pytest.fixture(scope="module")
def smallest(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    root = tmp_path_factory.mktemp("smallest")
    return {"nuscenes": write_nuscenes(root / "nuscenes", 1), "frames": write_frames(root / "frames", 2)}


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A folder with files that must stay as they are, and what an archive may bring to ``in/``, beside the source."""
    return make_home(tmp_path)


def make_home(home: Path) -> Path:
    (home / "in").mkdir(parents=True)
    for path in (home / ".bashrc", home / "secret", home / "in" / "secret.png"):
        path.write_text(VICTIM)
    (home / "in" / ".bashrc").write_text("rm -rf ~")
    (home / "in" / "folder").mkdir()
    (home / "in" / "folder" / "x.bin").write_text(VICTIM)
    return home


def outside(home: Path) -> dict[str, tuple[Any, ...]]:
    """Everything but the output: contents, and of what is not the source's also inodes and how many links they have."""
    found: dict[str, tuple[Any, ...]] = {}
    for path in sorted(home.rglob("*")):
        name = path.relative_to(home).as_posix()
        if name.split("/")[0] == "new" or not (path.is_file() or path.is_symlink()):
            continue
        status, content = path.lstat(), path.read_bytes() if path.is_file() else b""
        found[name] = (content,) if name.startswith("in/source/") else (content, status.st_ino, status.st_nlink)
    return found


def change(root: Path, table: str, edit: Callable[[list[dict[str, Any]]], None]) -> None:
    path = root / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text()) if path.is_file() else []
    edit(rows)
    path.write_text(json.dumps(rows))


def renamed(root: Path, table: str, name: Any, part: str = "RADAR") -> str:
    """Give a file of a table another name; gives the row's token."""
    tokens: list[str] = []

    def edit(rows: list[dict[str, Any]]) -> None:
        if table in ("lidarseg", "panoptic"):
            rows.append({"token": "attack", "sample_data_token": "x", "filename": ""})
        row = rows[-1] if table != "sample_data" else next(row for row in rows if part in row["filename"])
        row["filename"] = name
        tokens.append(row["token"])

    change(root, table, edit)
    return tokens[0]


def with_calibration(root: Path, edit: Callable[[dict[str, Any]], None], frame: str = "0001") -> None:
    path = root / frame / "calib.json"
    calib = json.loads(path.read_text())
    edit(calib)
    path.write_text(json.dumps(calib))


def name_of(key: str, name: Any) -> Callable[[dict[str, Any]], None]:
    """An edit that gives a frame's image, mask or points another name."""

    def edit(calib: dict[str, Any]) -> None:
        if key == "lidar":
            calib["lidar"] = {"file": name}
        else:
            calib["cameras"][0][key] = name

    return edit


# --- names ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("table", "name"),
    [*(("sample_data", name) for name in NAMES), *((table, NAMES[0]) for table in ("lidarseg", "panoptic", "map"))],
)
def test_names_of_kept_files(
    table: str, name: Any, made: dict[str, Path], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """``../.bashrc`` of a radar replaced a file beside the output."""
    source = shutil.copytree(made["nuscenes"], home / "in" / "source")
    token = renamed(source, table, name)
    before = outside(home)
    assert main(command(source, home / "new")) == 2
    said = capsys.readouterr().err
    assert f"table {table}: " in said and repr(token) in said and "filename" in said and "Traceback" not in said
    assert outside(home) == before and not (home / "new").exists()


def test_names_of_the_conversions_own_files(
    made: dict[str, Path], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("conversion/settings.json", "v1.0-mini/sample.json", "samples/ring_front_center/0.jpg"):
        source = shutil.copytree(made["nuscenes"], home / "in" / "source")
        (source / name).parent.mkdir(parents=True, exist_ok=True)
        (source / name).touch()
        renamed(source, "sample_data", name)
        assert main(command(source, home / "new")) == 2
        assert f"got one in {Path(name).parent}" in capsys.readouterr().err and not (home / "new").exists()
        shutil.rmtree(source)


@pytest.mark.parametrize("channel", ["CAM_FRONT__", "LIDAR_TOP"])
@pytest.mark.parametrize("name", NAMES)
def test_readers_of_tables_refuse_names(channel: str, name: Any, made: dict[str, Path], home: Path) -> None:
    source = shutil.copytree(made["nuscenes"], home / "in" / "source")

    def edit(rows: list[dict[str, Any]]) -> None:
        for row in rows:
            if channel in row["filename"] and row["is_key_frame"]:
                row["filename"] = name

    change(source, "sample_data", edit)
    for wrap in (lambda data: data, lambda data: RetargetedDataset(data, lambda sample: sample)):
        with pytest.raises(DataError, match="expected "):
            next(iter(DataLoader(wrap(NuScenesDataset(source)), batch_size=None)))


@pytest.mark.parametrize("key", ["file", "mask", "lidar"])
@pytest.mark.parametrize("name", ["../../secret.png", "{home}/in/secret.png", "a\0b", "a\ud800b", "x" * 300, 7])
def test_frame_folders_refuse_names(key: str, name: Any, made: dict[str, Path], home: Path) -> None:
    source = shutil.copytree(made["frames"], home / "in" / "source")
    if name in ("../../secret.png", "{home}/in/secret.png"):  # those that could be read
        target = home / "in" / "secret.png"
        shutil.copy(source / "0001" / ("lidar.npy" if key == "lidar" else "00.jpg"), target)
    name = name.format(home=home) if isinstance(name, str) else name
    with_calibration(source, name_of(key, name))
    data = FrameFolder(source)
    wrapped = RetargetedDataset(data, RigRetarget(load_rig("argoverse2"), size=(24, 40), surface="street"))
    assert {"points", "images"} < set(data[0])
    for of in (data, wrapped):
        with pytest.raises(ValueError, match=r"0001.*: expected") as caught:
            of[1]
        assert type(caught.value).__name__ in ("DataError", "CalibrationError")


def test_a_frames_files_may_lie_in_other_frames(made: dict[str, Path], home: Path) -> None:
    source = shutil.copytree(made["frames"], home / "in" / "source")
    with_calibration(source, name_of("file", "../0000/00.jpg"))
    assert FrameFolder(source)[1]["images"].shape[0] == 2
    with pytest.raises(DataError, match="expected"):
        FrameFolder(source / "0001")[0]


def test_a_frame_alone_shares_masks_of_frames_beside_it(made: dict[str, Path], home: Path) -> None:
    """A real drive does; anything else beside the frame is refused, and so is a link out of the other frame."""
    source = shutil.copytree(made["frames"], home / "in" / "source")
    size = FrameFolder(source)[1]["rig"][0].size
    mask = cv2.imencode(".png", np.full(size, 255, np.uint8))[1].tobytes()
    (source / "0000" / "mask.png").write_bytes(mask)
    (source / "mask.png").write_bytes(mask)
    (source / "other").mkdir()
    (source / "other" / "mask.png").write_bytes(mask)
    (source / "0000" / "link.png").symlink_to(source / "mask.png")
    with_calibration(source, name_of("mask", "../0000/mask.png"))
    assert FrameFolder(source / "0001")[0]["rig"][0].mask.all()
    for name in ("../mask.png", "../other/mask.png", "../0000/link.png", "../../mask.png", "../0000/../mask.png"):
        with_calibration(source, name_of("mask", name))
        with pytest.raises(DataError, match=r"0001.*: expected"):
            FrameFolder(source / "0001")[0]
    for name in ("../a\0b/c", f"../{'x' * 300}/c", "../a\ud800b/c"):
        with_calibration(source, name_of("mask", name))
        with pytest.raises(DataError, match=r"0001.*: expected"):
            FrameFolder(source / "0001")[0]


def test_cameras_whose_names_are_no_folders(
    made: dict[str, Path], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("..", "x" * 300):
        rig = load_rig("argoverse2").to_dict()
        rig["cameras"][0]["name"] = name
        (home / "rig.json").write_text(json.dumps(rig))
        asked = command(made["nuscenes"], home / "new")
        asked[asked.index("argoverse2")] = str(home / "rig.json")
        assert main(asked) == 2
        assert "expected a" in capsys.readouterr().err and not (home / "new").exists()


@pytest.mark.parametrize("name", ["3" * 250, "车" * 80])
def test_frames_of_long_names(name: str, made: dict[str, Path], home: Path) -> None:
    source = shutil.copytree(made["frames"], home / "in" / "source")
    (source / "sequence.json").unlink()
    (source / "0001").rename(source / name)
    assert main(command(source, home / "new")) == 0
    assert len(FrameFolder(home / "new")) == 3


# --- links ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("kind", "name", "target"),
    [
        ("nuscenes", "{radar}", "secret"),
        ("nuscenes", "{radar}", "../../../secret"),
        ("nuscenes", "{camera}", "in/secret.png"),
        ("nuscenes", "{lidar}", "in/folder/x.bin"),
        ("nuscenes", "samples/RADAR_FRONT", "in/folder"),
        ("nuscenes", "sweeps", "in/folder"),
        ("nuscenes", "v1.0-mini/attribute.json", "in/folder/table.json"),
        ("nuscenes", "maps/map.png", "secret"),
        ("nuscenes", "maps", "in/folder"),
        ("frames", "0001/lidar.npy", "in/folder/lidar.npy"),
        ("frames", "0001/00.jpg", "in/folder/00.jpg"),
        ("frames", "0001/calib.json", "in/folder/calib.json"),
        ("frames", "0001", "in/folder"),
        ("frames", "sequence.json", "in/folder/sequence.json"),
    ],
)
def test_links_that_leave_the_root(
    kind: str, name: str, target: str, made: dict[str, Path], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A link to a system file became a second link to its inode; calibrations and tables were copied."""
    source = shutil.copytree(made[kind], home / "in" / "source")
    if kind == "nuscenes":
        (home / "in" / "folder" / "table.json").write_text("[]")
        channels = {"radar": "RADAR_FRONT", "camera": "CAM_FRONT", "lidar": "LIDAR_TOP"}
        names = {key: sorted((source / "samples" / channel).iterdir())[0] for key, channel in channels.items()}
        path = source / name.format(**names)
        for file in sorted((source / "samples" / "RADAR_FRONT").iterdir()):
            shutil.copy(file, home / "in" / "folder" / file.name)
        for channel in ("LIDAR_TOP", "RADAR_FRONT"):
            (home / "in" / "folder" / channel).mkdir()
            for file in (source / "sweeps" / channel).iterdir():
                shutil.copy(file, home / "in" / "folder" / channel)
    else:
        shutil.copytree(source / "0001", home / "in" / "folder", dirs_exist_ok=True)
        shutil.copy(source / "sequence.json", home / "in" / "folder")
        path = source / name
    if path.is_dir():
        shutil.rmtree(path)
    path.unlink(missing_ok=True)
    path.symlink_to(target if target.startswith("..") else home / target)
    before = outside(home)
    assert main(command(source, home / "new")) in (1, 2)
    said = capsys.readouterr().err
    assert "links must not leave the folder" in said and path.name in said and "Traceback" not in said
    assert outside(home) == before


@pytest.mark.parametrize("kind", ["nuscenes", "frames"])
def test_links_that_stay_in_the_root(kind: str, made: dict[str, Path], home: Path) -> None:
    """Files and a folder that are links, in a root that is one."""
    source = shutil.copytree(made[kind], home / "in" / "source")
    if kind == "frames":
        (source / "sequence.json").unlink()
    assert main(command(source, home / "plain")) == 0
    for path in [path for path in sorted(source.rglob("*")) if path.suffix in (".bin", ".npy", ".jpg", ".png")]:
        held = source / "blobs" / path.relative_to(source)
        held.parent.mkdir(parents=True, exist_ok=True)
        path.rename(held)
        path.symlink_to(os.path.relpath(held, path.parent))
    folder = source / ("maps" if kind == "nuscenes" else "0001")
    folder.rename(source / "blobs" / "moved")
    folder.symlink_to(Path("blobs", "moved"))
    for path in (source / "blobs" / "moved").iterdir():
        if path.is_symlink():
            held = source / "blobs" / folder.name / path.name
            path.unlink()
            path.symlink_to(held)
    (home / "root").symlink_to(Path("in", "source"))
    assert main(command(home / "root", home / "new")) == 0
    plain, linked = tree(home / "plain"), tree(home / "new")
    own = {"conversion/settings.json", "conversion/provenance.json"}  # the roots have other names
    assert {name for name in plain if linked.get(name) != plain[name]} <= own and plain.keys() == linked.keys()
    assert not any(path.is_symlink() for path in (home / "new").rglob("*"))


def test_pipes_are_not_waited_for(made: dict[str, Path], home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = shutil.copytree(made["frames"], home / "in" / "source")
    (source / "0001" / "lidar.npy").unlink()
    os.mkfifo(source / "0001" / "lidar.npy")
    with pytest.raises(DataError, match=r"lidar: expected a regular file, got .*, a pipe, socket or device"):
        FrameFolder(source)[1]
    source = shutil.copytree(made["nuscenes"], home / "tables")
    radar = sorted((source / "samples" / "RADAR_FRONT").iterdir())[0]
    radar.unlink()
    os.mkfifo(radar)
    assert main(command(source, home / "new")) == 2
    assert "expected a regular file" in capsys.readouterr().err


def test_depth_is_not_written_elsewhere(made: dict[str, Path], home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Into a folder that a link in the data leads to; or a link in its place."""
    source = shutil.copytree(made["frames"], home / "in" / "source")
    (source / "motion_depth").symlink_to(home / "in" / "folder")
    before = outside(home)
    assert main(["depth", "--data", str(source)]) == 2
    assert "links must not leave the folder" in capsys.readouterr().err and outside(home) == before
    assert main([*command(source, home / "new"), "--surface", "motion"]) == 2
    assert main(["depth", "--data", str(source), "--output", str(home / "in" / "folder")]) == 0  # as it was told


# --- whatever a sample raises -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("key", ["file", "lidar"])
@pytest.mark.parametrize("name", ["a\0b", "a\ud800b", "x" * 300])
@pytest.mark.parametrize("workers", ["1", pytest.param("2", marks=pytest.mark.slow)])
def test_names_that_no_file_can_have(
    key: str, name: str, workers: str, made: dict[str, Path], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Stopped the conversion with a traceback, whatever was to become of such samples."""
    if workers == "2" and (key, name) != ("file", "a\ud800b"):
        pytest.skip("one name shows it: processes take seconds to start")
    source = shutil.copytree(made["frames"], home / "in" / "source")
    with_calibration(source, name_of(key, name))
    asked = [*command(source, home / "new"), "--on-error"]
    asked[asked.index("--workers") + 1] = workers
    assert main([*asked, "report"]) == 1
    captured = capsys.readouterr()
    assert "2 samples converted, 1 failed" in captured.out and "0001: failed: " in captured.err
    assert main([*asked, "skip"]) == 0
    assert "0001: skipped: " in capsys.readouterr().err
    assert FrameFolder(home / "new").tokens == ["0000", "0002"]


def test_a_camera_image_of_tables_with_such_a_name(
    made: dict[str, Path], home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A camera's file is not kept: so its sample alone is broken."""
    source = shutil.copytree(made["nuscenes"], home / "in" / "source")
    renamed(source, "sample_data", "../a\0b", "samples/CAM_FRONT/")
    assert main([*command(source, home / "new"), "--on-error", "skip"]) == 0
    assert capsys.readouterr().err.count("skipped: nuScenes") == 1
    assert len(NuScenesDataset(home / "new")) == 3


@pytest.mark.parametrize("step", ["read", "retarget", "write"])
@pytest.mark.parametrize("on_error", ["report", "skip", "fatal"])
def test_errors_that_nobody_expects(
    step: str,
    on_error: str,
    made: dict[str, Path],
    home: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def broken(self: Any, *given: Any) -> Any:
        if broken.calls == 1:  # type: ignore[attr-defined]
            broken.calls += 1  # type: ignore[attr-defined]
            raise ZeroDivisionError("of something")
        broken.calls += 1  # type: ignore[attr-defined]
        return sound(self, *given)

    broken.calls = 0  # type: ignore[attr-defined]
    of, name = {"read": (FrameFolder, "__getitem__"), "retarget": (RigRetarget, "forward"), "write": (job, "rig_of")}[
        step
    ]
    sound = getattr(of, name)
    monkeypatch.setattr(of, name, broken)
    assert main([*command(made["frames"], home / "new"), "--on-error", on_error]) == (0 if on_error == "skip" else 1)
    state = "skipped" if on_error == "skip" else "failed"
    assert f"0001: {state}: ZeroDivisionError: of something" in capsys.readouterr().err
    assert (home / "new" / "0002").exists() == (on_error != "fatal")


def test_an_interrupt_is_no_samples_fault(
    made: dict[str, Path], home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(FrameFolder, "__getitem__", interrupted)
    assert main([*command(made["frames"], home / "new"), "--on-error", "skip"]) == 130
    assert "run it again to go on" in capsys.readouterr().err


def test_errors_that_nobody_expects_in_ray_actors(
    made: dict[str, Path], home: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What an actor does: Ray itself is started by the slow test."""

    def broken(*_: Any) -> Any:
        raise ZeroDivisionError("of \ud800")

    asked = Settings(root=made["frames"], target=load_rig("argoverse2"), output=home / "new", size=(24, 40))
    monkeypatch.setattr(FrameFolder, "__getitem__", broken)
    monkeypatch.setattr(ray_runner, "optional_package", lambda *_: SimpleNamespace(get_gpu_ids=list))
    row = Actor(Jobs(asked, asked.open(), range(3), "skip"))({"id": 1})
    done = pickle.loads(row["done"])
    assert (done.token, done.state, done.messages) == ("0001", "skipped", ("ZeroDivisionError: of \ud800",))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_ray_goes_on_without_a_sample(
    made: dict[str, Path], home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'arbiview_aug[distributed]'")
    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    source = shutil.copytree(made["frames"], home / "in" / "source")
    with_calibration(source, name_of("file", "a\ud800b"))
    try:
        assert main([*command(source, home / "new"), "--runner", "ray", "--on-error", "skip"]) == 0
    finally:
        ray.shutdown()
    assert "0001: skipped: " in capsys.readouterr().err


def test_the_depth_command_goes_on(
    made: dict[str, Path], home: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def broken(self: FrameFolder, index: int) -> Any:
        if index == 1:
            raise ZeroDivisionError("of something")
        return sound(self, index)

    sound = FrameFolder.__getitem__
    monkeypatch.setattr(FrameFolder, "__getitem__", broken)
    assert main(["depth", "--data", str(made["frames"]), "--output", str(home / "depth")]) == 1
    assert "0001: failed: ZeroDivisionError: of something" in capsys.readouterr().err
    assert sorted(path.name for path in (home / "depth").iterdir()) == ["0000.npz", "0002.npz"]


# --- drawn ------------------------------------------------------------------------------------------------------------
PARTS = ("..", ".", "", "samples", "conversion", "secret", "folder", ".bashrc", "new", "x.bin", "a\0", "~")
DRAWN = st.lists(st.sampled_from(PARTS), min_size=1, max_size=5).map("/".join) | st.text(max_size=8)
TARGETS = st.sampled_from(["secret", "in/folder", "in/secret.png", "in", "."])
PLACES = st.sampled_from(["sample_data", "camera", "lidarseg", "panoptic", "map", "file", "mask", "lidar", "sequence"])


@settings(max_examples=12, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(place=PLACES, name=DRAWN, absolute=st.booleans(), target=st.none() | TARGETS, skip=st.booleans())
@example(place="sample_data", name="../.bashrc", absolute=False, target=None, skip=False)
@example(place="sample_data", name="samples/x.bin", absolute=False, target="secret", skip=True)
@example(place="lidarseg", name="folder/x.bin", absolute=False, target="in/folder", skip=False)
def test_nothing_outside_the_output_changes(
    place: str,
    name: str,
    absolute: bool,
    target: str | None,
    skip: bool,
    smallest: dict[str, Path],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Whatever a file is called, and wherever a link of that name leads: no traceback either."""
    home = make_home(tmp_path_factory.mktemp("home"))
    kind = "frames" if place in ("file", "mask", "lidar", "sequence") else "nuscenes"
    source = shutil.copytree(smallest[kind], home / "in" / "source")
    if target is not None:
        _link(source / "0001" if kind == "frames" else source, name, home / target)
    named = f"{home}/{name}" if absolute else name
    if place == "sequence":
        (source / "sequence.json").write_text(json.dumps({"frames": ["0000", named]}))
    elif kind == "frames":
        with_calibration(source, name_of(place, named))
    else:
        table, part = ("sample_data", "samples/CAM_FRONT/") if place == "camera" else (place, "RADAR")
        renamed(source, table, named, part)
    before = outside(home)
    assert main([*command(source, home / "new"), *(["--on-error", "skip"] if skip else [])]) in (0, 1, 2)
    assert outside(home) == before
    victims = {value[1] for key, value in before.items() if len(value) > 1}
    assert not victims & {path.stat().st_ino for path in (home / "new").rglob("*") if path.is_file()}
    shutil.rmtree(home)


def _link(folder: Path, name: str, target: Path) -> None:
    """A link at a name below a folder, where there can be one."""
    try:
        path = Path(os.path.normpath(folder / name))
        if folder in path.parents:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.symlink_to(target)
    except (OSError, ValueError):
        pass
