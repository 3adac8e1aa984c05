"""In DataLoader workers: the same bits however many there are, draws that differ, no fight for the cores."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import pytest
import torch
from torch.utils.data import DataLoader, default_collate

from arbiview_aug import MixedDataset, RandomRig, RetargetedDataset, RigRetarget, SampleKeys
from tests.helpers import same

STARTS = [(0, None), (2, "fork"), pytest.param(2, "spawn", marks=pytest.mark.slow)]  # spawned ones import torch anew


@pytest.fixture
def samples(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The datasets' module, where spawned workers find it too: they take over ``sys.path``."""
    monkeypatch.syspath_prepend(str(Path(__file__).parents[1]))
    return importlib.import_module("worker_samples")


def batches(dataset: Any, workers: int, start: str | None = None, **settings: Any) -> list[dict[str, Any]]:
    """All batches of an epoch."""
    settings = {"batch_size": 2, **settings}
    return list(DataLoader(dataset, num_workers=workers, multiprocessing_context=start, **settings))


def draws(loader: DataLoader[Any], name: str = "yaw_deg") -> list[float]:
    """The drawn values of an epoch, in order."""
    return [value for batch in loader for value in batch["retarget_params"][name].tolist()]


# --- the same bits ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("workers", "start"), STARTS)
def test_workers_give_the_same_bits(workers: int, start: str | None, samples: ModuleType) -> None:
    target = samples.rig((30, 50)).turned(yaw_deg=20).shifted(z_m=0.4)
    dataset = RetargetedDataset(samples.Frames(), RigRetarget(target, keys=SampleKeys(extra=["source_camera"])))
    expected = [default_collate([dataset[k], dataset[k + 1]]) for k in range(0, len(dataset), 2)]
    assert expected[0]["images"].shape == (2, 4, 3, 30, 50)
    assert same(batches(dataset, workers, start), expected)


def test_plans_built_before_the_fork_are_shared(samples: ModuleType) -> None:
    retarget = RigRetarget(samples.rig().turned(yaw_deg=9), source=samples.rig())
    retarget.prepare()
    for batch in batches(samples.Watched(samples.Frames(), retarget), 2, "fork"):
        assert batch["plans_built"].tolist() == [1, 1]  # the one that is there


# --- draws ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("workers", [0, 2])
def test_draws_differ_between_samples_workers_and_epochs(samples: ModuleType, workers: int) -> None:
    dataset = RetargetedDataset(samples.Frames(), RigRetarget(RandomRig(samples.rig(), yaw_deg=20)))
    loader = DataLoader(dataset, batch_size=2, num_workers=workers)
    torch.manual_seed(5)
    epochs = [draws(loader), draws(loader)]
    assert len(set(epochs[0] + epochs[1])) == 2 * len(dataset)
    torch.manual_seed(5)
    assert [draws(loader), draws(loader)] == epochs


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("p", [1.0, 0.5])
def test_one_draw_a_sequence_in_every_worker(samples: ModuleType, workers: int, p: float) -> None:
    """That of the rig and that of ``p``."""
    random_rig = RandomRig(samples.rig(), yaw_deg=20, per="sequence")
    watched = samples.Watched(samples.Frames(), RigRetarget(random_rig, p=p, size=samples.SIZE))
    loader = DataLoader(watched, batch_size=1, num_workers=workers)
    epochs = []
    for epoch in range(2):
        random_rig.set_epoch(epoch)
        values: dict[str, set[tuple[float, ...]]] = {}
        processes: dict[str, set[int]] = {}
        for batch in loader:
            drawn_now = tuple(value.item() for value in batch["retarget_params"].values())
            values.setdefault(batch["scene_token"][0], set()).add(drawn_now)
            processes.setdefault(batch["scene_token"][0], set()).add(batch["worker"].item())
        assert all(len(drawn) == 1 for drawn in values.values()) and len(values) == 2
        assert all(len(seen) == max(workers, 1) for seen in processes.values())  # both had a part of it
        epochs.append([drawn.pop() for drawn in values.values()])
    assert len({*epochs[0], *epochs[1]}) == 4


def test_sequences_draw_anew_with_every_start_of_the_workers(samples: ModuleType) -> None:
    random_rig = RandomRig(samples.rig(), yaw_deg=20, per="sequence")
    dataset = RetargetedDataset(samples.Frames(), RigRetarget(random_rig))
    loader = DataLoader(dataset, batch_size=samples.PER_SEQUENCE, num_workers=2)
    torch.manual_seed(3)
    one, two = set(draws(loader)), set(draws(loader))
    assert len(one) == len(two) == 2 and not one & two
    torch.manual_seed(3)
    assert set(draws(loader)) == one


def test_set_epoch_reaches_persistent_workers(samples: ModuleType) -> None:
    """Whoever hands it on; a run that goes on draws as one that was not cut off."""
    random_rig = RandomRig(samples.rig(), yaw_deg=20, per="sequence")
    retarget = RigRetarget(random_rig)
    dataset = RetargetedDataset(samples.Frames(), retarget)
    mixed = MixedDataset(samples.Frames(), dataset, share=1)
    torch.manual_seed(0)
    loader = DataLoader(mixed, batch_size=samples.PER_SEQUENCE, num_workers=1, persistent_workers=True)
    first, again = draws(loader), draws(loader)
    assert first == again
    epochs = [set(first)]
    for epoch, holder in enumerate([random_rig, retarget, dataset, mixed], 1):
        holder.set_epoch(epoch)
        epochs.append(set(draws(loader)))
    assert len(set.union(*epochs)) == 2 * len(epochs)
    torch.manual_seed(0)
    assert set(draws(DataLoader(mixed, batch_size=samples.PER_SEQUENCE, num_workers=1))) == epochs[-1]


# --- threads ----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_have_a_thread_each(samples: ModuleType, start: str) -> None:
    watched = samples.Watched(samples.Frames(), RigRetarget(samples.rig().turned(yaw_deg=9)))
    before = cv2.getNumThreads()
    for batch in batches(watched, 2, start):
        assert set(batch["cv2_threads"].tolist()) <= {0, 1}
        assert batch["torch_threads"].tolist() == [1, 1]
    batches(watched, 0)
    assert cv2.getNumThreads() == before  # the main process keeps its own


# --- real data --------------------------------------------------------------------------------------------------------
