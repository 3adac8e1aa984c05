"""A retargeted view of any dataset: the transform runs where the sample is read, so in the DataLoader's workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

from torch.utils.data import Dataset, IterableDataset

from arbiview_aug.errors import SampleTypeError

Retarget = Callable[[Any], Any]


class RetargetedDataset(Dataset[Any]):
    """A map-style dataset whose samples pass through ``retarget``.

    Errors of either pass unchanged. ``__getitems__`` (DataLoader's batched access) uses the dataset's own where it has
    one.

    Args:
        dataset: With ``__getitem__`` and ``__len__``.
        retarget: Sample in, sample out: a ``RigRetarget``, or any composition around one.

    Raises:
        SampleTypeError: ``dataset`` is not map-style, or ``retarget`` cannot be called.
    """

    def __init__(self, dataset: Any, retarget: Retarget) -> None:
        name = type(self).__name__
        if isinstance(dataset, IterableDataset) or not hasattr(dataset, "__getitem__"):
            fix = "use RetargetedIterable" if hasattr(dataset, "__iter__") else "pass the dataset first"
            raise SampleTypeError(f"{name}: expected a map-style dataset, got {type(dataset).__name__}; {fix}")
        if not hasattr(dataset, "__len__"):
            raise SampleTypeError(f"{name}: expected a dataset with __len__, got {type(dataset).__name__}")
        self.dataset = dataset
        self.retarget = _checked_retarget(retarget, name)

    def __len__(self) -> int:
        return len(self.dataset)

    def __getitem__(self, index: Any) -> Any:
        return self.retarget(self.dataset[index])

    def __getitems__(self, indices: Sequence[Any]) -> list[Any]:
        if callable(getattr(self.dataset, "__getitems__", None)):
            return [self.retarget(sample) for sample in self.dataset.__getitems__(indices)]
        return [self[index] for index in indices]


class RetargetedIterable(IterableDataset[Any]):
    """An iterable dataset whose samples pass through ``retarget``.

    Splitting the stream between workers is left to the dataset: one that does not look at
    ``torch.utils.data.get_worker_info`` gives every sample once per worker, with or without this wrapper.

    Args:
        dataset: With ``__iter__``; started anew by every iteration.
        retarget: Sample in, sample out: a ``RigRetarget``, or any composition around one.

    Raises:
        SampleTypeError: ``dataset`` is not iterable, or ``retarget`` cannot be called.
    """

    def __init__(self, dataset: Any, retarget: Retarget) -> None:
        name = type(self).__name__
        if not hasattr(dataset, "__iter__"):
            fix = "use RetargetedDataset" if hasattr(dataset, "__getitem__") else "pass the dataset first"
            raise SampleTypeError(f"{name}: expected an iterable dataset, got {type(dataset).__name__}; {fix}")
        if isinstance(dataset, Iterator):
            raise SampleTypeError(
                f"{name}: expected a dataset that can be iterated again, got {type(dataset).__name__}, which ends "
                "after one epoch; pass an IterableDataset, whose __iter__ starts a new one"
            )
        self.dataset = dataset
        self.retarget = _checked_retarget(retarget, name)

    def __iter__(self) -> Iterator[Any]:
        for sample in self.dataset:
            yield self.retarget(sample)


def _checked_retarget(retarget: Any, name: str) -> Retarget:
    if not callable(retarget):
        raise SampleTypeError(f"{name}: expected a callable such as RigRetarget, got {type(retarget).__name__}")
    return retarget  # type: ignore[no-any-return]
