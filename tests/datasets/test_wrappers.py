"""The wrappers are thin: the transform is applied, everything else is the dataset's."""

import pickle
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch.utils.data import DataLoader, IterableDataset, get_worker_info

from arbiview_aug.datasets import MixedDataset, RetargetedDataset, RetargetedIterable, WithDepth
from arbiview_aug.errors import DataError, SampleError, SampleTypeError


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
    few = RetargetedDataset(BatchedNumbers(), add_ten)
    few.dataset.__getitems__ = lambda indices: [Numbers()[k] for k in indices[1:]]
    with pytest.raises(DataError, match=r"BatchedNumbers\.__getitems__: expected 3 samples, got 2"):
        few.__getitems__([0, 1, 2])


@pytest.mark.parametrize("workers", [0, 2])
def test_map_style_in_a_data_loader(workers: int) -> None:
    settings: dict[str, Any] = {"batch_size": 2, "sampler": range(4), "num_workers": workers}
    for numbers, expected in ((Numbers(), [[10, 11], [12, 13]]), (BatchedNumbers(), [[110, 111], [112, 113]])):
        loader = DataLoader(RetargetedDataset(numbers, add_ten), **settings)
        assert [batch["images"].tolist() for batch in loader] == expected


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


@pytest.mark.parametrize("dataset", [Numbers(), BatchedNumbers(), Stream()])
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
