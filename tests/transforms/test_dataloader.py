"""In DataLoader workers: the same bits however many there are, draws that differ, no fight for the cores."""

from __future__ import annotations

import pickle
from typing import Any

import cv2
import pytest
import torch
from torch.utils.data import DataLoader, Dataset, default_collate, get_worker_info

from arbiview_aug import MixedDataset, RandomRig, RetargetedDataset, Rig, RigRetarget, SampleKeys
from tests.helpers import ring, same

SIZE = (36, 64)
FRAMES = 8
PER_SEQUENCE = 4


def rig(size: tuple[int, int] = SIZE) -> Rig:
    """Four cameras all around."""
    return Rig(ring(4, radius_m=0.0, size=size, horizontal_fov_deg=120.0).cameras, name="ring")


class Frames(Dataset[dict[str, Any]]):
    """Random images that depend on the index alone, four to a sequence."""

    def __init__(self, length: int = FRAMES, size: tuple[int, int] = SIZE) -> None:
        self.length, self.rig, self.size = length, rig(size), size

    def __len__(self) -> int:
        return self.length

    def __getitem__(self, index: int) -> dict[str, Any]:
        generator = torch.Generator().manual_seed(index)
        images = torch.randint(0, 256, (4, 3, *self.size), generator=generator, dtype=torch.uint8)
        return {"images": images, "rig": self.rig, "scene_token": f"scene {index // PER_SEQUENCE}", "index": index}


class Watched(Dataset[dict[str, Any]]):
    """Retargeted samples, with what the process that made them looks like."""

    def __init__(self, dataset: Dataset[Any], retarget: RigRetarget) -> None:
        self.dataset, self.retarget = dataset, retarget

    def __len__(self) -> int:
        return len(self.dataset)  # type: ignore[arg-type]

    def __getitem__(self, index: int) -> dict[str, Any]:
        sample = self.retarget(self.dataset[index])
        worker = get_worker_info()
        return {
            **sample,
            "worker": -1 if worker is None else worker.id,
            "cv2_threads": cv2.getNumThreads(),
            "torch_threads": torch.get_num_threads(),
            "plans_built": self.retarget.renderer.plans.misses,
        }


STARTS = [(0, None), (2, "fork"), pytest.param(2, "spawn", marks=pytest.mark.slow)]  # spawned ones import torch anew


def batches(dataset: Any, workers: int, start: str | None = None, **settings: Any) -> list[dict[str, Any]]:
    """All batches of an epoch."""
    settings = {"batch_size": 2, **settings}
    return list(DataLoader(dataset, num_workers=workers, multiprocessing_context=start, **settings))


def draws(loader: DataLoader[Any], name: str = "yaw_deg") -> list[float]:
    """The drawn values of an epoch, in order."""
    return [value for batch in loader for value in batch["retarget_params"][name].tolist()]


# --- the same bits ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("workers", "start"), STARTS)
def test_workers_give_the_same_bits(workers: int, start: str | None) -> None:
    target = rig((30, 50)).turned(yaw_deg=20).shifted(z_m=0.4)
    dataset = RetargetedDataset(Frames(), RigRetarget(target, keys=SampleKeys(extra=["source_camera"])))
    expected = [default_collate([dataset[k], dataset[k + 1]]) for k in range(0, len(dataset), 2)]
    assert expected[0]["images"].shape == (2, 4, 3, 30, 50)
    assert same(batches(dataset, workers, start), expected)


def test_plans_built_before_the_fork_are_shared() -> None:
    retarget = RigRetarget(rig().turned(yaw_deg=9), source=rig())
    retarget.prepare()
    for batch in batches(Watched(Frames(), retarget), 2, "fork"):
        assert batch["plans_built"].tolist() == [1, 1]  # the one that is there


# --- draws ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("workers", [0, 2])
def test_draws_differ_between_samples_workers_and_epochs(workers: int) -> None:
    dataset = RetargetedDataset(Frames(), RigRetarget(RandomRig(rig(), yaw_deg=20)))
    loader = DataLoader(dataset, batch_size=2, num_workers=workers)
    torch.manual_seed(5)
    epochs = [draws(loader), draws(loader)]
    assert len(set(epochs[0] + epochs[1])) == 2 * len(dataset)
    torch.manual_seed(5)
    assert [draws(loader), draws(loader)] == epochs


@pytest.mark.parametrize("workers", [0, 2])
@pytest.mark.parametrize("p", [1.0, 0.5])
def test_one_draw_a_sequence_in_every_worker(workers: int, p: float) -> None:
    """That of the rig and that of ``p``."""
    random_rig = RandomRig(rig(), yaw_deg=20, per="sequence")
    watched = Watched(Frames(), RigRetarget(random_rig, p=p, size=SIZE))
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


def test_sequences_draw_anew_with_every_start_of_the_workers() -> None:
    random_rig = RandomRig(rig(), yaw_deg=20, per="sequence")
    dataset = RetargetedDataset(Frames(), RigRetarget(random_rig))
    loader = DataLoader(dataset, batch_size=PER_SEQUENCE, num_workers=2)
    torch.manual_seed(3)
    one, two = set(draws(loader)), set(draws(loader))
    assert len(one) == len(two) == 2 and not one & two
    torch.manual_seed(3)
    assert set(draws(loader)) == one


def test_set_epoch_reaches_persistent_workers() -> None:
    """Whoever hands it on; a run that goes on draws as one that was not cut off."""
    random_rig = pickle.loads(pickle.dumps(RandomRig(rig(), yaw_deg=20, per="sequence")))  # as copies are shared
    retarget = RigRetarget(random_rig)
    dataset = RetargetedDataset(Frames(), retarget)
    mixed = MixedDataset(Frames(), dataset, share=1)
    torch.manual_seed(0)
    loader = DataLoader(mixed, batch_size=PER_SEQUENCE, num_workers=1, persistent_workers=True)
    first, again = draws(loader), draws(loader)
    assert first == again
    epochs = [set(first)]
    for epoch, holder in enumerate([random_rig, retarget, dataset, mixed], 1):
        holder.set_epoch(epoch)
        epochs.append(set(draws(loader)))
    assert len(set.union(*epochs)) == 2 * len(epochs)
    torch.manual_seed(0)
    assert set(draws(DataLoader(mixed, batch_size=PER_SEQUENCE, num_workers=1))) == epochs[-1]


# --- threads ----------------------------------------------------------------------------------------------------------
@pytest.mark.slow
@pytest.mark.parametrize("start", ["fork", "spawn"])
def test_workers_have_a_thread_each(start: str) -> None:
    watched = Watched(Frames(), RigRetarget(rig().turned(yaw_deg=9)))
    before = cv2.getNumThreads()
    for batch in batches(watched, 2, start):
        assert set(batch["cv2_threads"].tolist()) <= {0, 1}
        assert batch["torch_threads"].tolist() == [1, 1]
    batches(watched, 0)
    assert cv2.getNumThreads() == before  # the main process keeps its own
