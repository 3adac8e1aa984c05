"""Readers: which one opens a folder, one row for a kind; and thin wrappers around data sets."""

from __future__ import annotations

import pickle
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from arbiview_aug.__main__ import main
from arbiview_aug.datasets import (
    FrameFolder,
    MixedDataset,
    NuScenesDataset,
    RetargetedDataset,
    RetargetedIterable,
    WithDepth,
    open_data,
)
from arbiview_aug.datasets.drive import Recording
from arbiview_aug.datasets.registry import READERS, Reader, data_name, kinds_of, split_kind
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import DataError, SampleError, SampleTypeError


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
    assert "expected a kind that can be written, got Toy" in capsys.readouterr().err


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


# --- the wrappers are thin --------------------------------------------------------------------------------------------
class Numbers:
    """Map-style."""

    def __len__(self) -> int:
        return 5

    def __getitem__(self, index: int) -> dict[str, Any]:
        if index == 4:
            raise DataError("camera 'front': image gone.jpg: expected an image file, found none")
        return {"images": torch.tensor(index)}


class Stream(IterableDataset[dict[str, Any]]):
    """Iterable, split between workers."""

    def __iter__(self) -> Iterator[dict[str, Any]]:
        worker = get_worker_info()
        start, step = (worker.id, worker.num_workers) if worker else (0, 1)
        for k in range(start, 6, step):
            yield {"images": torch.tensor(k)}


def add_ten(sample: dict[str, Any]) -> dict[str, Any]:
    return {**sample, "images": sample["images"] + 10}


def test_map_style() -> None:
    dataset = RetargetedDataset(Numbers(), add_ten)
    assert len(dataset) == 5 and dataset[3]["images"] == 13
    with pytest.raises(DataError, match="image gone"):
        dataset[4]
    assert pickle.loads(pickle.dumps(dataset))[0]["images"] == 10


@pytest.mark.parametrize("workers", [0, 2])
def test_map_style_in_a_data_loader(workers: int) -> None:
    settings: dict[str, Any] = {"batch_size": 2, "sampler": range(4), "num_workers": workers}
    loader = DataLoader(RetargetedDataset(Numbers(), add_ten), **settings)
    assert [batch["images"].tolist() for batch in loader] == [[10, 11], [12, 13]]


def test_length_of_a_stream() -> None:
    """That of the dataset, if it has one."""
    four = type("Four", (Stream,), {"__len__": lambda self: 4})()
    assert len(DataLoader(RetargetedIterable(four, add_ten), batch_size=2)) == 2
    endless = RetargetedIterable(Stream(), add_ten)
    assert len(list(endless)) == 6
    with pytest.raises(TypeError, match="has no len"):
        len(endless)


def refuse_three(sample: dict[str, Any]) -> dict[str, Any]:
    if sample["images"] % 100 == 3:
        raise SampleError("K: expected shape (6, 3, 3)")
    return sample


@pytest.mark.parametrize("dataset", [Numbers(), Stream()])
@pytest.mark.parametrize("workers", [0, 1])
def test_errors_name_the_sample(dataset: Any, workers: int) -> None:
    wrapper, more = (RetargetedIterable, {}) if isinstance(dataset, Stream) else (RetargetedDataset, {"sampler": [3]})
    with pytest.raises(SampleError, match="sample 3: K: expected shape"):
        list(DataLoader(wrapper(dataset, refuse_three), num_workers=workers, **more))


class Counting(Numbers):
    """Map-style, with an epoch of its own, as a transform may have one."""

    epoch = 0

    def set_epoch(self, epoch: int) -> None:
        self.epoch = epoch

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        return sample

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return iter([self[0]])


def test_epochs_reach_the_transform_and_the_dataset() -> None:
    raw, dataset, transform, streamed = Counting(), Counting(), Counting(), Counting()
    MixedDataset(raw, RetargetedDataset(dataset, transform)).set_epoch(3)
    RetargetedIterable(streamed, add_ten).set_epoch(3)  # a transform without epochs
    assert raw.epoch == dataset.epoch == transform.epoch == streamed.epoch == 3


UNSIZED = type("Unsized", (), {"__getitem__": lambda self, k: k})()


def test_wrong_types() -> None:
    for wrapper, dataset, transform, message in (
        (RetargetedDataset, Stream(), add_ten, "expected a map-style dataset, got Stream; use RetargetedIterable"),
        (RetargetedDataset, add_ten, Numbers(), "expected a map-style dataset, got function; pass the dataset first"),
        (RetargetedDataset, Numbers(), "waymo", "expected a callable such as RigRetarget, got str"),
        (RetargetedDataset, UNSIZED, add_ten, "with __len__, got Unsized"),
        (WithDepth, 5, "folder", "WithDepth: expected a map-style dataset, got int; pass the dataset first"),
        (lambda *given: WithDepth(*given)[0], [1], "folder", "expected samples that are mappings, got int"),
        (RetargetedIterable, Numbers(), add_ten, "expected an iterable dataset, got Numbers; use RetargetedDataset"),
        (RetargetedIterable, iter([1]), add_ten, "iterated again, got list_iterator, which ends after one epoch"),
    ):
        with pytest.raises(SampleTypeError, match=message):
            wrapper(dataset, transform)  # type: ignore[arg-type,call-arg]


# --- mixing -----------------------------------------------------------------------------------------------------------
def views(cameras: int, count: int = 40) -> list[dict[str, Any]]:
    """Samples with a number of cameras."""
    return [{"index": index, "images": torch.zeros(cameras, 3, 2, 2)} for index in range(count)]


def test_mixed_items_are_the_same_samples_in_one_form_or_the_other() -> None:
    mixed = pickle.loads(pickle.dumps(MixedDataset(views(6), views(5), 0.25)))
    assert len(mixed) == 40
    drawn = []
    for _ in range(2):
        torch.manual_seed(0)
        samples = [mixed[i] for _ in range(25) for i in range(40)]
        assert [sample["index"] for sample in samples] == 25 * list(range(40))
        drawn.append([len(sample["images"]) for sample in samples])
    assert drawn[0] == drawn[1] and drawn[0].count(5) / 1000 == pytest.approx(0.25, abs=0.04)  # 3 standard deviations
    for share, cameras in ((0, 6), (1, 5)):
        assert {len(MixedDataset(views(6), views(5), share)[i]["images"]) for i in range(40)} == {cameras}


def test_wrong_mixtures() -> None:
    with pytest.raises(DataError, match=r"same samples untouched and retargeted, got 40 and 39; take those .*Subset"):
        MixedDataset(views(6), views(5, 39), 0.5)
    for share in (-0.1, 1.1, float("nan"), "half", True):
        with pytest.raises(ValueError, match="share: expected a share of retargeted items from 0 to 1, got"):
            MixedDataset(views(6), views(5), share)  # type: ignore[arg-type]
    for wrong in ((Stream(), views(5)), (views(6), Stream())):
        with pytest.raises(SampleTypeError, match="MixedDataset: expected a map-style dataset, got Stream; pass two"):
            MixedDataset(*wrong, 0.5)
