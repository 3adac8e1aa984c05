"""Base class of readers, and the neighbours of a frame in its drive (see ``arbiview_aug.sample.neighbours``)."""

from __future__ import annotations

import math
import operator
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
from torch.utils.data import Dataset

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import Reduce, is_number, is_whole
from arbiview_aug.datasets.image_io import check_reduce
from arbiview_aug.errors import ArbiviewError, DataError, shown, warn
from arbiview_aug.sample.neighbours import STILL_M

Direction = Literal["both", "past", "future"]

CONVERSION_FOLDER = "conversion"  # of a root that ``convert`` writes: manifest, provenance and report
BEGUN_FILE, FINISHED_FILE = "settings.json", "provenance.json"  # in it: the first file of all, and the last


def is_converted(root: Path) -> bool:
    """Whether ``convert`` wrote a root, or has begun to."""
    return os.path.isfile(root / CONVERSION_FOLDER / BEGUN_FILE)  # unlike Path.is_file, False for impossible names


def warn_of_unfinished(root: Path, found: int) -> None:
    """Warn of a conversion that is not finished, with the number of frames found."""
    if is_converted(root) and not (root / CONVERSION_FOLDER / FINISHED_FILE).is_file():
        warn(f"{root}: unfinished conversion: {found} frames so far; run convert again")


def checked_index(index: Any, count: int) -> int:
    """Index from 0 of one of ``count`` samples; TypeError for a slice, IndexError for a number beyond them."""
    try:
        return range(count)[operator.index(index)]
    except TypeError:
        fix = "take several with torch.utils.data.Subset"
        raise TypeError(f"index: expected a whole number, got {type(index).__name__}; {fix}") from None
    except IndexError:
        raise IndexError(f"index: expected one of {count} samples, got {index}") from None


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """Selection of neighbours by distance travelled; a drive without motion has none.

    Attributes:
        count: Maximum number in each direction.
        step_m: Metres of travel from one to the next; the first frame at or beyond each step is taken.
        direction: ``past`` frames, ``future`` ones, or ``both``.

    Raises:
        ValueError: A count below 1, a step that is not positive, another direction.
    """

    count: int = 1
    step_m: float = 1.2
    direction: Direction = "both"

    def __post_init__(self) -> None:
        if not is_whole(self.count, 1):
            raise ValueError(f"neighbours: count: expected a whole number from 1, got {self.count!r}")
        if not is_number(self.step_m) or not 0 < self.step_m < float("inf"):
            raise ValueError(f"neighbours: step_m: expected metres above 0, got {self.step_m!r}")
        if self.direction not in ("both", "past", "future"):
            raise ValueError(f"neighbours: direction: expected both, past or future, got {self.direction!r}")

    @property
    def signs(self) -> tuple[int, ...]:
        """-1 for the past, 1 for the future."""
        return {"both": (-1, 1), "past": (-1,), "future": (1,)}[self.direction]


def check_neighbours(value: Any) -> None:
    """Raise TypeError unless the value is ``Neighbours`` or None."""
    if value is not None and not isinstance(value, Neighbours):
        raise TypeError(f"neighbours: expected Neighbours or None, got {type(value).__name__}")


def parts_of_clock(names: Sequence[str], times_s: Mapping[str, float] | None, where: str) -> npt.NDArray[np.int64]:
    """(F,) parts of a drive with frames ``names``; a new one begins, with a warning, where the clock goes back."""
    goes_back = [times_s is not None and times_s[after] <= times_s[before] for before, after in pairwise(names)]
    for k in np.flatnonzero(goes_back).tolist():
        warn_of_clock(where, f"frame {names[k]!r}", repr(names[k + 1]))
    return np.cumsum([0, *goes_back], dtype=np.int64)[: len(names)]


def warn_of_clock(where: str, before: str, after: str) -> None:
    """Warn of a clock that goes back from one frame to the next."""
    warn(f"{where}: the clock goes back from {before} to {after}: they are no neighbours")


def camera_fields(rig: Rig, images: Any, token: str) -> dict[str, Any]:
    """A sample's images, rig and calibration tensors, and its token."""
    K, cam2ego = torch.from_numpy(rig.K), torch.from_numpy(rig.cam2ego)
    return {"images": images, "rig": rig, "K": K, "cam2ego": cam2ego, "token": token}


class Drive:
    """Distance travelled by a vehicle, from its positions (F, 3) in the world, in recording order.

    ``rows`` (F,) number the frames. ``parts`` (F,) are non-decreasing numbers of uninterrupted parts; neighbours share
    their part. Pose jitter of a standing vehicle does not count as travel.
    """

    def __init__(self, rows: npt.ArrayLike, positions_m: FloatArray, parts: npt.NDArray[np.int64]) -> None:
        total_m, distances_m, last = 0.0, [], None
        for position in positions_m.tolist():
            step_m = 0.0 if last is None else math.dist(last, position)
            if last is None or step_m >= STILL_M:
                last, total_m = position, total_m + step_m
            distances_m.append(total_m)
        self._rows, self._travelled_m, self._parts = np.array(rows, np.int64), np.array(distances_m), parts

    def neighbours(self, row: int, wanted: Neighbours) -> list[int]:
        """Rows of a frame's neighbours, nearest first in each direction; none of a frame that is not in the drive."""
        places = list[int]()
        for index in np.flatnonzero(self._rows == row).tolist():
            first, end = (int(k) for k in np.searchsorted(self._parts, self._parts[index] + [0, 1]))
            travelled_m = self._travelled_m[first:end]
            for sign in wanted.signs:
                for k in range(1, wanted.count + 1):
                    # 1 mm of tolerance: the poses of a standing vehicle jitter.
                    target_m = self._travelled_m[index] + sign * (k * wanted.step_m - 1e-3)
                    at = first + int(np.searchsorted(travelled_m, target_m, "left" if sign > 0 else "right"))
                    at -= sign < 0
                    if first <= at < end and at not in places:
                        places.append(at)
        return self._rows[places].tolist()


class Recording(Dataset[dict[str, Any]]):
    """Base class of the readers: samples on disk, each with a token; ``FrameFolder`` explains the options."""

    root: Path  # folder of the data
    tokens: list[str]  # unique name of each sample, in order
    load_points: bool  # whether to read the LiDAR's points
    writer: str | None = None  # subclass of ``Writer`` as ``module:Class``; None if ``convert`` has none

    def __init__(
        self, root: str | Path, reduce: Reduce = 1, load_points: bool = True, neighbours: Neighbours | None = None
    ) -> None:
        check_reduce(reduce)
        check_neighbours(neighbours)
        self.root, self.reduce, self.load_points, self.neighbours = Path(root), reduce, load_points, neighbours

    @cached_property
    def _index(self) -> dict[str, int]:
        return {token: k for k, token in enumerate(self.tokens)}

    def __len__(self) -> int:
        return len(self.tokens)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} samples in {self.root})"

    def by_token(self, token: str) -> dict[str, Any]:
        """The sample with this token; DataError if there is none."""
        if not isinstance(token, str) or token not in self._index:
            got = f"{shown(token)}; they are {', '.join(self.tokens[:3])} …"
            raise DataError(f"{self.root}: expected the token of one of {len(self)} samples, got {got}")
        return self[self._index[token]]

    def files(self, index: int) -> list[Path]:
        """All files that a sample is read from, for ``convert``."""
        raise NotImplementedError

    def _neighbours(self, drive: Drive, row: int) -> list[LazyFrame]:
        """Neighbours of a row of the drive; broken ones raise on access."""
        frames: list[LazyFrame] = []
        for k in drive.neighbours(row, self.neighbours or Neighbours()):
            try:
                frames.append(self._neighbour(k))
            except ArbiviewError as error:
                frames.append(LazyFrame({"token": self._token(k)}, dict, error=error))
        return frames

    def _neighbour(self, row: int) -> LazyFrame:
        """The frame of a row of the drive; its images and points are read on access."""
        raise NotImplementedError

    def _token(self, row: int) -> str:
        return self.tokens[row]


class LazyFrame(Mapping[str, Any]):
    """Neighbour with ``fields``, whose images and points ``load`` and ``points`` read on first access.

    An ``error`` is raised by every access but to the token.
    """

    def __init__(
        self,
        fields: Mapping[str, Any],
        load: Callable[[], Any],
        points: Callable[[], Any] | None = None,
        error: ArbiviewError | None = None,
    ) -> None:
        self._fields, self._error = dict(fields), error
        self._loads = {"images": load} if points is None else {"images": load, "points": points}
        self.is_broken = False  # whether an access failed

    def __getitem__(self, key: str) -> Any:
        try:
            if self._error is not None and key != "token":
                raise self._error
            if key in self._loads and key not in self._fields:
                self._fields[key] = self._loads[key]()
        except (ArbiviewError, OSError):
            self.is_broken = True
            raise
        return self._fields[key]

    def __contains__(self, key: object) -> bool:
        return key in self._loads or key in self._fields  # the images need not be decoded

    def __iter__(self) -> Iterator[str]:
        return iter({**self._fields, **self._loads})

    def __len__(self) -> int:
        return len({**self._fields, **self._loads})
