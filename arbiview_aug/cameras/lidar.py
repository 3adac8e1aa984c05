"""LiDAR scanners: pose, beam table, columns and range."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.key_names import hint, unknown_key
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.validation import checked_numbers, checked_pose, refusal
from arbiview_aug.errors import CalibrationError, calibration_of, shown

MOST_BEAMS, MOST_RAYS = 1024, 1 << 21  # largest scanner, well beyond products (128 beams and 500,000 rays)
_KEYS = ("name", "lidar2ego", "elevations_deg", "azimuth_step_deg", "range_m")


@dataclass(frozen=True, eq=False)
class Lidar:
    """One scanner. Its rays leave one centre: a beam for each elevation, a column for each azimuth.

    Args:
        name: Unique among the scanners of its rig.
        lidar2ego: (4, 4) pose, ``p_ego = lidar2ego @ p_lidar``; scanner axes x forward, y left, z up.
        elevations_deg: Angle of each beam over the scanner's x-y plane, -90 to 90; a beam's place here is its ring.
        azimuth_step_deg: Angle from column to column.
        range_m: Least and largest distance of returns.
        azimuth_deg: First azimuth, and the end of the last column; 0 along x, 90 along y.

    Raises:
        CalibrationError: An impossible value; the message names the scanner.
    """

    name: str
    lidar2ego: FloatArray
    elevations_deg: tuple[float, ...]
    azimuth_step_deg: float
    range_m: tuple[float, float]
    azimuth_deg: tuple[float, float] = (-180.0, 180.0)

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise CalibrationError(f"lidar name: expected a non-empty string, got {shown(self.name)}")
        where, elevations = self._where, self.elevations_deg
        beams = f"1 to {MOST_BEAMS} elevations from -90 to 90 degrees"
        try:
            count = len(elevations)
        except TypeError:  # a generator, which may have no end, or a number
            count = 0
        is_short = 0 < count <= MOST_BEAMS
        table = checked_numbers(where, "elevations_deg", elevations, count, beams) if is_short else ()
        if not table or max(map(abs, table)) > 90:
            raise refusal(where, "elevations_deg", beams, shown(elevations))
        span = "two azimuths in degrees, the first below the second by at most 360"
        first, end = checked_numbers(where, "azimuth_deg", self.azimuth_deg, 2, span)
        ranges = "two distances in metres, 0 <= the least < the largest"
        least, most = checked_numbers(where, "range_m", self.range_m, 2, ranges)
        (step,) = checked_numbers(where, "azimuth_step_deg", [self.azimuth_step_deg], 1, "a number of degrees")
        pose = checked_pose(where, self.lidar2ego, "lidar2ego")
        fewest = (end - first) * count / MOST_RAYS
        for field, is_valid, expected, got in (
            ("azimuth_deg", 0 < end - first <= 360, span, (first, end)),
            ("range_m", 0 <= least < most, ranges, (least, most)),
            ("azimuth_step_deg", fewest <= step <= 360 and step > 0, f"more than {fewest:.2g} and at most 360", step),
        ):
            if not is_valid:
                raise refusal(where, field, expected, got)
        self.__dict__.update(
            **{"name": str(self.name), "lidar2ego": pose, "elevations_deg": table},  # numpy's text is no plain YAML
            **{"azimuth_step_deg": step, "range_m": (least, most), "azimuth_deg": (first, end)},
        )

    @property
    def _where(self) -> str:
        return f"lidar {shown(self.name)}"

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self.lidar2ego.setflags(write=False)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Lidar):
            return NotImplemented
        return self.name == other.name and self.content_key == other.content_key

    def __hash__(self) -> int:
        return hash((self.name, self.content_key))

    def __repr__(self) -> str:
        x, y, z = self.center_m
        return f"Lidar({self.name} {self.words} at ({x:.2f}, {y:.2f}, {z:.2f}) m)"

    @property
    def words(self) -> str:
        """Beams, columns, elevations and range, for tables."""
        low, high = min(self.elevations_deg), max(self.elevations_deg)
        beams, columns = self.shape
        return f"{beams} x {columns} rays, {low:+.1f} to {high:+.1f} deg, {self.range_m[0]:g} to {self.range_m[1]:g} m"

    @property
    def shape(self) -> tuple[int, int]:
        """Beams and columns."""
        first, end = self.azimuth_deg
        return len(self.elevations_deg), max(1, round((end - first) / self.azimuth_step_deg))

    @property
    def center_m(self) -> FloatArray:
        """(3,) origin of the rays in the ego frame."""
        return np.asarray(self.lidar2ego[:3, 3])

    @cached_property
    def content_key(self) -> bytes:
        """Digest of the calibration, without the name."""
        numbers = *self.elevations_deg, self.azimuth_step_deg, *self.range_m, *self.azimuth_deg
        return hashlib.sha256(self.lidar2ego.tobytes() + np.array(numbers, np.float64).tobytes()).digest()

    @cached_property
    def rays(self) -> npt.NDArray[np.float32]:
        """(3, beams, columns) unit rays in the ego frame."""
        beams, columns = self.shape
        azimuth = np.radians(self.azimuth_deg[0] + self.azimuth_step_deg * np.arange(columns))
        elevation = np.radians(self.elevations_deg)[:, None]
        up = np.broadcast_to(np.sin(elevation), (beams, columns))
        local = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), up])
        return np.tensordot(self.lidar2ego[:3, :3], local, 1).astype(np.float32)

    def moved(self, ego2ego: Any) -> Lidar:
        """The same scanner in another ego frame: ``lidar2ego`` becomes ``ego2ego @ lidar2ego``."""
        return replace(self, lidar2ego=checked_pose(self._where, ego2ego, "ego2ego") @ self.lidar2ego)

    def shifted(self, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0) -> Lidar:
        """Moved along the ego's axes."""
        T = np.eye(4)
        T[:3, 3] = checked_numbers(self._where, "shift", (x_m, y_m, z_m), 3, "three finite numbers of metres")
        return self.moved(T)

    def to_dict(self) -> dict[str, Any]:
        """Plain data in the rig file's format."""
        values = {key: getattr(self, key) for key in (*_KEYS, "azimuth_deg")} | {"lidar2ego": self.lidar2ego.tolist()}
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    @classmethod
    def from_dict(cls, entry: Any, where: str) -> Lidar:
        """A scanner from an entry of a rig file; ``where`` is named in errors."""
        if not isinstance(entry, Mapping):
            raise CalibrationError(f"{where}: expected a mapping, got {type(entry).__name__}")
        if missing := [key for key in _KEYS if entry.get(key) is None]:
            expected, guesses = ", ".join((*_KEYS, "azimuth_deg")), hint(entry, missing)
            raise CalibrationError(f"{where}: expected keys {expected}, missing {', '.join(missing)}{guesses}")
        if unknown := unknown_key(entry, (*_KEYS, "azimuth_deg", "source", "notes")):
            raise CalibrationError(f"{where}: {unknown}")
        with calibration_of(where):
            return cls(**{key: entry[key] for key in (*_KEYS, "azimuth_deg") if key in entry})
