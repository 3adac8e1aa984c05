"""LiDAR scanners: pose, beam table, columns and range."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import islice
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.key_names import check_keys, refuse_unknown
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.validation import checked_array, checked_pose
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
        try:
            elevations = tuple(islice(self.elevations_deg, MOST_BEAMS + 1))  # a generator may have no end
        except TypeError:
            elevations = ()
        check, beams = partial(checked_array, self._where), len(elevations)
        expected = f"1 to {MOST_BEAMS} elevations from -90 to 90 degrees"
        table = check(
            "elevations_deg", elevations, (-1,), expected, lambda deg: 0 < beams <= MOST_BEAMS and abs(deg).max() <= 90
        )
        expected = "two azimuths in degrees, the first below the second by at most 360"
        ends = check("azimuth_deg", self.azimuth_deg, (2,), expected, lambda ends: 0 < ends[1] - ends[0] <= 360)
        expected = "two distances in metres, 0 <= the least < the largest"
        range_m = check("range_m", self.range_m, (2,), expected, lambda ends: 0 <= ends[0] < ends[1])
        fewest = (ends[1] - ends[0]) * beams / MOST_RAYS
        expected = f"more than {fewest:.2g} and at most 360 degrees"
        step = check("azimuth_step_deg", self.azimuth_step_deg, (), expected, lambda step: fewest <= step <= 360)
        self.__dict__.update(
            name=str(self.name),  # numpy's text is no plain YAML
            lidar2ego=checked_pose(self._where, self.lidar2ego, "lidar2ego"),
            elevations_deg=tuple(table.tolist()),
            azimuth_step_deg=float(step),
            range_m=tuple(range_m.tolist()),
            azimuth_deg=tuple(ends.tolist()),
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
        T[:3, 3] = checked_array(self._where, "shift", (x_m, y_m, z_m), (3,), "three finite numbers of metres")
        return self.moved(T)

    def to_dict(self) -> dict[str, Any]:
        """Plain data in the rig file's format."""
        values = {key: getattr(self, key) for key in (*_KEYS, "azimuth_deg")} | {"lidar2ego": self.lidar2ego.tolist()}
        return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

    @classmethod
    def from_dict(cls, entry: Any, where: str) -> Lidar:
        """A scanner from an entry of a rig file; ``where`` is named in errors."""
        check_keys(entry, _KEYS, (*_KEYS, "azimuth_deg"), where)
        refuse_unknown(entry, (*_KEYS, "azimuth_deg", "source", "notes"), where)
        with calibration_of(where):
            return cls(**{key: entry[key] for key in (*_KEYS, "azimuth_deg") if key in entry})
