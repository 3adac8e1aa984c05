"""Frames at the training size, and their split by scenes."""

from __future__ import annotations

from pathlib import Path

import pytest

from arbiview_aug.generator.training import data
from arbiview_aug.generator.training.data import Frames, open_frames
from tests.generator.training.small import SIZE, Pictures, frames


def test_frames_have_the_size_that_was_asked_for_and_are_read_once() -> None:
    found = frames()
    assert [tuple(image.shape) for image in found[1].images] == [(3, *SIZE)] * 6
    assert found[1].rig.sizes == [SIZE] * 6
    assert found[1] is found[1]


def test_scenes_are_never_split() -> None:
    names = [f"scene {k // 3}" for k in range(60)]
    split = Frames(Pictures(60), SIZE, names).split(seed=1)
    parts = [{names[k] for k in part} for part in split]
    assert [len(part) for part in parts] == [12, 4, 4]
    assert not (parts[0] & parts[1] or parts[1] & parts[2] or parts[0] & parts[2])
    assert sorted(index for part in split for index in part) == list(range(60))
    assert split == Frames(Pictures(60), SIZE, names).split(seed=1) != Frames(Pictures(60), SIZE, names).split(seed=2)


@pytest.mark.parametrize(("count", "sizes"), [(1, [1, 0, 0]), (2, [1, 0, 1]), (3, [2, 0, 1]), (5, [3, 1, 1])])
def test_few_scenes_are_for_training_first(count: int, sizes: list[int]) -> None:
    assert [len(part) for part in frames(count).split()] == sizes


@pytest.mark.parametrize("logs", [1, 3])
def test_logs_are_never_split_and_one_alone_is_cut_into_blocks(
    logs: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    drives = Pictures(30)
    drives.root, drives.tokens = tmp_path, [f"val-2021-07-{k % logs}-{k}" for k in range(30)]  # type: ignore[attr-defined]
    monkeypatch.setattr(data, "open_data", lambda _: drives)
    names = open_frames("py123d:/logs", SIZE, scenes=1).scenes
    assert names == [f"val-2021-07-{k % 3}" if logs == 3 else f"block {k // 3}" for k in range(30)]
