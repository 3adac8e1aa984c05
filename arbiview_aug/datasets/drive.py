"""Other frames of a drive that come with a frame as its ``neighbours`` (see ``arbiview_aug.sample.neighbours``)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from torch.utils.data import Dataset

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.errors import ArbiviewError, DataError
from arbiview_aug.sample.neighbours import STILL_M

Direction = Literal["both", "past", "future"]


class Recording(Dataset[dict[str, Any]]):
    """Samples on disk, each with a token; the base class of the readers.

    Attributes:
        root: The folder.
        tokens: Unique name of each sample, in order.
        load_points: Whether to read the LiDAR's points.
    """

    root: Path
    tokens: list[str]
    load_points: bool
    _index: dict[str, int]

    def __len__(self) -> int:
        return len(self.tokens)

    def by_token(self, token: str) -> dict[str, Any]:
        """The sample with this token.

        Raises:
            DataError: No such sample.
        """
        if token not in self._index:
            some = ", ".join(self.tokens[:3])
            raise DataError(
                f"{self.root}: expected the token of one of {len(self)} samples, got {token!r}; they are {some} …"
            )
        return self[self._index[token]]

    def files(self, index: int) -> list[Path]:
        """All files that a sample is read from, for ``convert``: a reader that has no writer needs none."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Neighbours:
    """Frames by distance travelled: standing still, there are none.

    Attributes:
        count: Maximum number in each direction.
        step_m: Metres of travel from one to the next; the frames are the first at or beyond them.
        direction: ``past`` frames, ``future`` ones, or ``both``.

    Raises:
        ValueError: A count below 1, a step that is not positive, another direction.
    """

    count: int = 1
    step_m: float = 1.2
    direction: Direction = "both"

    def __post_init__(self) -> None:
        if not isinstance(self.count, int) or isinstance(self.count, bool) or self.count < 1:
            raise ValueError(f"neighbours: count: expected a whole number from 1, got {self.count!r}")
        if not 0 < self.step_m < float("inf"):
            raise ValueError(f"neighbours: step_m: expected metres above 0, got {self.step_m!r}")
        if self.direction not in ("both", "past", "future"):
            raise ValueError(f"neighbours: direction: expected both, past or future, got {self.direction!r}")

    @property
    def signs(self) -> tuple[int, ...]:
        """-1 for the past, 1 for the future."""
        return {"both": (-1, 1), "past": (-1,), "future": (1,)}[self.direction]

    def picked(self, travelled_m: FloatArray, index: int) -> list[int]:
        """The neighbours of one frame of a drive, the nearest first in each direction.

        Args:
            travelled_m: (F,) distance along the drive at each of its frames, never falling.
            index: Of the frame.
        """
        found = []
        for sign in self.signs:
            for k in range(1, self.count + 1):
                # Poses waver by millimetres while a vehicle stands.
                wanted = travelled_m[index] + sign * (k * self.step_m - 1e-3)
                if sign > 0:
                    at = int(np.searchsorted(travelled_m, wanted, side="left"))
                else:
                    at = int(np.searchsorted(travelled_m, wanted, side="right")) - 1
                if 0 <= at < len(travelled_m) and at not in found:
                    found.append(at)
        return found


def check_neighbours(value: Any) -> None:
    """Raise TypeError unless the value is ``Neighbours`` or None."""
    if value is not None and not isinstance(value, Neighbours):
        raise TypeError(f"neighbours: expected Neighbours or None, got {type(value).__name__}")


class Drive:
    """Distance travelled by a vehicle, frame by frame.

    Args:
        positions_m: (F, 3) of the vehicle in the world, in the order in which the frames were recorded.
        parts: (F,) whole numbers that never fall: frames of different ones are no neighbours.
    """

    def __init__(self, positions_m: FloatArray, parts: npt.NDArray[np.int64]) -> None:
        self._travelled_m, self._parts = travelled_m(positions_m), parts

    def neighbours(self, index: int, wanted: Neighbours) -> list[int]:
        """The neighbours of one frame, by their numbers."""
        part = self._parts[index]
        first, end = (int(k) for k in np.searchsorted(self._parts, [part, part + 1]))
        return [first + k for k in wanted.picked(self._travelled_m[first:end], index - first)]


def travelled_m(positions_m: FloatArray) -> FloatArray:
    """(F,) distance along positions (F, 3); jitter of a standing vehicle's poses does not count."""
    total, found = 0.0, []
    there: list[float] | None = None
    for here in positions_m.tolist():
        step_m = 0.0 if there is None else math.dist(there, here)
        if there is None or step_m >= STILL_M:
            there, total = here, total + step_m
        found.append(total)
    return np.array(found)


def parts_of_clock(names: Sequence[str], times_s: Mapping[str, float] | None, where: str) -> npt.NDArray[np.int64]:
    """(F,) parts of a drive; a clock that goes back begins another one, with a warning.

    Args:
        names: Its frames, in their order.
        times_s: Seconds by frame, or None.
        where: Named in the warning.
    """
    parts = [0] * len(names)
    for k, (one, two) in enumerate(pairwise(names), 1):
        goes_back = times_s is not None and times_s[two] <= times_s[one]
        parts[k] = parts[k - 1] + goes_back
        if goes_back:
            warnings.warn(went_back(where, one, two), stacklevel=4)
    return np.array(parts, np.int64)


def went_back(where: str, one: str, two: str) -> str:
    """Message for a clock that goes back from one frame to the next."""
    return f"{where}: the clock goes back from frame {one!r} to {two!r}: neither is the other's neighbour"


class LazyFrame(Mapping[str, Any]):
    """A neighbour whose images are decoded on first access.

    Args:
        known: Pose, calibration, time, token.
        load: Decodes the images.
    """

    def __init__(self, known: Mapping[str, Any], load: Callable[[], Any]) -> None:
        self._known, self._load = dict(known), load
        self.is_broken = False
        """Whether an access failed."""

    def __getitem__(self, key: str) -> Any:
        if key == "images" and key not in self._known:
            try:
                self._known[key] = self._load()
            except (ArbiviewError, OSError):
                self.is_broken = True
                raise
        return self._known[key]

    def __iter__(self) -> Iterator[str]:
        return iter({**self._known, "images": None})

    def __len__(self) -> int:
        return len({**self._known, "images": None})

    def __repr__(self) -> str:
        return f"LazyFrame({', '.join(self)})"


class Unreadable(LazyFrame):
    """A broken neighbour: every access but to its token raises the reason.

    Args:
        known: Its token.
        error: The reason.
    """

    def __init__(self, known: Mapping[str, Any], error: ArbiviewError) -> None:
        super().__init__(known, self._refuse)
        self._error = error

    def __getitem__(self, key: str) -> Any:
        return super().__getitem__(key) if key == "token" else self._refuse()

    def _refuse(self) -> Any:
        self.is_broken = True
        raise self._error
