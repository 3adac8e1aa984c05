"""The wrappers are thin: the transform is applied, everything else is the dataset's."""

import pickle
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from arbiview_aug.datasets import RetargetedDataset, RetargetedIterable
from arbiview_aug.errors import DataError, SampleTypeError


class Numbers:
    """Map-style."""

    def __len__(self) -> int:
        return 5

    def __getitem__(self, index: int) -> dict[str, Any]:
        if index == 4:
            raise DataError("camera 'front': image gone.jpg: expected an image file, found none")
        return {"images": torch.tensor(index)}


class BatchedNumbers(Numbers):
    """Map-style, with batched access of its own."""

    def __getitems__(self, indices: list[int]) -> list[dict[str, Any]]:
        return [{"images": torch.tensor(100 + index)} for index in indices]


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
    assert [int(sample["images"]) for sample in dataset.__getitems__([0, 2])] == [10, 12]
    with pytest.raises(DataError, match="image gone"):
        dataset[4]
    assert pickle.loads(pickle.dumps(dataset))[0]["images"] == 10


@pytest.mark.parametrize("workers", [0, 2])
def test_map_style_in_a_data_loader(workers: int) -> None:
    plain = DataLoader(RetargetedDataset(Numbers(), add_ten), batch_size=2, sampler=range(4), num_workers=workers)
    assert [batch["images"].tolist() for batch in plain] == [[10, 11], [12, 13]]
    batched = DataLoader(
        RetargetedDataset(BatchedNumbers(), add_ten), batch_size=2, sampler=range(4), num_workers=workers
    )
    assert [batch["images"].tolist() for batch in batched] == [[110, 111], [112, 113]]


@pytest.mark.parametrize("workers", [0, 2])
def test_iterable_in_a_data_loader(workers: int) -> None:
    loader = DataLoader(RetargetedIterable(Stream(), add_ten), batch_size=None, num_workers=workers)
    for _ in range(2):
        assert sorted(int(sample["images"]) for sample in loader) == [10, 11, 12, 13, 14, 15]


def test_wrong_types() -> None:
    with pytest.raises(SampleTypeError, match="expected a map-style dataset, got Stream; use RetargetedIterable"):
        RetargetedDataset(Stream(), add_ten)
    with pytest.raises(SampleTypeError, match="expected a map-style dataset, got function; pass the dataset first"):
        RetargetedDataset(add_ten, Numbers())  # type: ignore[arg-type]
    with pytest.raises(SampleTypeError, match="expected an iterable dataset, got Numbers; use RetargetedDataset"):
        RetargetedIterable(Numbers(), add_ten)
    with pytest.raises(SampleTypeError, match="iterated again, got list_iterator, which ends after one epoch"):
        RetargetedIterable(iter([1]), add_ten)
    with pytest.raises(SampleTypeError, match="expected a callable such as RigRetarget, got str"):
        RetargetedDataset(Numbers(), "waymo")  # type: ignore[arg-type]
    with pytest.raises(SampleTypeError, match="with __len__, got Unsized"):
        RetargetedDataset(type("Unsized", (), {"__getitem__": lambda self, k: k})(), add_ten)
