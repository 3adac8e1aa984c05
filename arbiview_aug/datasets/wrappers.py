"""Dataset wrappers that retarget or mix samples in the DataLoader's workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import torch
from torch.utils.data import Dataset, IterableDataset

from arbiview_aug.choices import is_number
from arbiview_aug.errors import ArbiviewError, DataError, SampleTypeError
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.warm_up import compile_kernels

Retarget = Callable[[Any], Any]


class _Retargeted:
    """A dataset and the transform of its samples."""

    dataset: Any
    retarget: Retarget

    def __len__(self) -> int:
        return len(self.dataset)  # TypeError without one, as of the dataset itself

    def set_epoch(self, epoch: int) -> None:
        """Hand the epoch to the transform and to the dataset, where they have ``set_epoch``."""
        _set_epoch(epoch, self.retarget, self.dataset)


class RetargetedDataset(_Retargeted, Dataset[Any]):
    """A map-style dataset whose samples pass through ``retarget``.

    Args:
        dataset: Map-style dataset.
        retarget: ``RigRetarget``, or any callable from sample to sample.

    Raises:
        SampleTypeError: ``dataset`` is not map-style, or ``retarget`` is not callable.
    """

    def __init__(self, dataset: Any, retarget: Retarget) -> None:
        fix = "use RetargetedIterable" if hasattr(dataset, "__iter__") else "pass the dataset first"
        self.dataset = checked_map_style(dataset, type(self).__name__, fix)
        self.retarget = _checked_retarget(retarget, type(self).__name__)

    def __getitem__(self, index: Any) -> Any:
        return _retargeted(self.retarget, self.dataset[index], index)


class MixedDataset(Dataset[Any]):
    """Random mix of raw and retargeted versions of the same samples.

    Item ``i`` is ``retargeted[i]`` with probability ``share``, else ``raw[i]``, drawn from torch's global RNG on each
    access. Samplers, subsets and the length are those of either dataset. A network that reads several frames of a drive
    needs one draw for all of them: ``p`` with a ``RandomRig(per="sequence")``.

    Unlike with ``RigRetarget(p=...)``, the two may differ in keys and number of cameras. ``default_collate`` cannot
    stack such items: use ``DataLoader(..., batch_size=None)`` for single items, or ``collate_fn=list``.

    Args:
        raw: Map-style dataset of untouched samples.
        retargeted: The same samples in the same order, for example ``RetargetedDataset(raw, retarget)`` or a converted
            folder.
        share: Expected share of retargeted items, from 0 to 1.

    Raises:
        SampleTypeError: One of the datasets is not map-style.
        DataError: Their lengths differ.
        ValueError: ``share`` is no number from 0 to 1.
    """

    def __init__(self, raw: Any, retargeted: Any, share: float = 0.5) -> None:
        name = type(self).__name__
        fix = "pass two that have __getitem__"
        self.raw, self.retargeted = (checked_map_style(dataset, name, fix) for dataset in (raw, retargeted))
        if len(raw) != len(retargeted):
            got = f"got {len(raw)} and {len(retargeted)}; take those that both have with torch.utils.data.Subset"
            raise DataError(f"{name}: expected the same samples untouched and retargeted, {got}")
        if not is_number(share) or not 0 <= share <= 1:
            raise ValueError(f"share: expected a share of retargeted items from 0 to 1, got {share!r}")
        self.share = float(share)

    def __len__(self) -> int:
        return len(self.raw)

    def set_epoch(self, epoch: int) -> None:
        """Hand the epoch to both datasets, where they have ``set_epoch``; coins follow torch's RNG alone."""
        _set_epoch(epoch, self.raw, self.retargeted)

    def __getitem__(self, index: Any) -> Any:
        return (self.retargeted if torch.rand(()).item() < self.share else self.raw)[index]


class RetargetedIterable(_Retargeted, IterableDataset[Any]):
    """An iterable dataset whose samples pass through ``retarget``.

    Splitting the stream between workers is left to the dataset: one that does not look at
    ``torch.utils.data.get_worker_info`` gives every sample once per worker, with or without this wrapper.

    Args:
        dataset: Iterable dataset, not an iterator: each epoch iterates it again.
        retarget: ``RigRetarget``, or any callable from sample to sample.

    Raises:
        SampleTypeError: ``dataset`` is not iterable, or ``retarget`` is not callable.
    """

    def __init__(self, dataset: Any, retarget: Retarget) -> None:
        name = type(self).__name__
        if not hasattr(dataset, "__iter__"):
            fix = "use RetargetedDataset" if hasattr(dataset, "__getitem__") else "pass the dataset first"
            raise SampleTypeError(f"{name}: expected an iterable dataset, got {type(dataset).__name__}; {fix}")
        if isinstance(dataset, Iterator):
            got = f"{type(dataset).__name__}, which ends after one epoch; pass an IterableDataset"
            raise SampleTypeError(f"{name}: expected a dataset that can be iterated again, got {got}")
        self.dataset = dataset
        self.retarget = _checked_retarget(retarget, name)

    def __iter__(self) -> Iterator[Any]:
        for number, sample in enumerate(self.dataset):
            yield _retargeted(self.retarget, sample, number)


def _set_epoch(epoch: int, *parts: Any) -> None:
    """Hand the epoch to those parts that have ``set_epoch``."""
    for part in parts:
        if callable(set_epoch := getattr(part, "set_epoch", None)):
            set_epoch(epoch)


def _retargeted(retarget: Retarget, sample: Any, index: Any) -> Any:
    """The retargeted sample; errors name the sample, which no one else knows in a DataLoader's worker."""
    try:
        return retarget(sample)
    except ArbiviewError as error:
        raise type(error)(f"sample {index}: {error}") from None


def checked_map_style(dataset: Any, name: str, fix: str) -> Any:
    """The dataset; SampleTypeError unless it is map-style, with a length."""
    if isinstance(dataset, IterableDataset) or not hasattr(dataset, "__getitem__"):
        raise SampleTypeError(f"{name}: expected a map-style dataset, got {type(dataset).__name__}; {fix}")
    if not hasattr(dataset, "__len__"):
        raise SampleTypeError(f"{name}: expected a dataset with __len__, got {type(dataset).__name__}")
    return dataset


def _checked_retarget(retarget: Any, name: str) -> Retarget:
    if not callable(retarget):
        raise SampleTypeError(f"{name}: expected a callable such as RigRetarget, got {type(retarget).__name__}")
    if isinstance(retarget, RigRetarget):
        compile_kernels(matching=GEOMETRIES[str(retarget.geometry)].needs == "motion")  # here, not in every worker
    return retarget  # type: ignore[no-any-return]
