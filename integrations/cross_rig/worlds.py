"""The vehicles and the streets of the experiment."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from arbiview_aug import Camera, Rig
from arbiview_aug.datasets.synthetic import demo_target_rig

Size = tuple[int, int]
"""(h, w) of every image."""

Split = Literal["train", "val", "test"]

World = Literal["drive", "cuboids"]
"""Generators of streets: ``SyntheticDrive``, and the one of ``cuboids`` with other shapes, textures and light."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")
OF_TESTS = SPLITS[1:]
"""Streets of vehicle B: for thresholds, and for tests."""

STREETS = 100
"""The world that constants of the renderer were chosen on; another hundred is another world."""


def street_seed(split: Split, streets: int = STREETS) -> int:
    """Seed of ``SyntheticDrive`` for a split of a world: datasets with different seeds share no street."""
    return streets + 1 + SPLITS.index(split)


_AZIMUTHS_DEG = (0.0, 55.0, -55.0, 110.0, -110.0, 180.0)
"""nuScenes' six cameras."""
_NAMES = ("front", "front_left", "front_right", "back_left", "back_right", "back")
_RING_RADIUS_M = 0.8
_RING_CENTRE_X_M = 0.9
_HEIGHT_M = 1.5
_FOV_DEG = 65.0


@dataclass(frozen=True)
class Change:
    """A change of vehicle: its title in tables, and vehicle B at a size, in A's ego frame."""

    title: str
    target: Callable[[Size], Rig]


def source_rig(size: Size, *, fov_deg: float = _FOV_DEG, height_m: float = _HEIGHT_M) -> Rig:
    """Vehicle A: six cameras around a car's roof, all with one field of view."""
    cameras = []
    for name, azimuth in zip(_NAMES, _AZIMUTHS_DEG, strict=True):
        angle = math.radians(azimuth)
        x, y = _RING_CENTRE_X_M + _RING_RADIUS_M * math.cos(angle), 0.6 * _RING_RADIUS_M * math.sin(angle)
        cameras.append(
            Camera.looking(
                name=name,
                azimuth_deg=azimuth,
                position_m=(x, y, height_m),
                width_px=size[1],
                height_px=size[0],
                horizontal_fov_deg=fov_deg,
            )
        )
    return Rig(cameras, name="A")


CHANGES: dict[str, Change] = {
    "fov50": Change("FOV 65° → 50°", lambda size: source_rig(size, fov_deg=50.0)),
    "up70": Change("+0.7 m", lambda size: source_rig(size, height_m=_HEIGHT_M + 0.7)),
    "waymo": Change("Waymo-like, 5 at 2.1 m", demo_target_rig),
}
"""By name. ``waymo``: Waymo's azimuths and height at A's field of view, so that it stays a change of the layout."""
