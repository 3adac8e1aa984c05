"""The vehicles and the streets of the experiment."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from arbiview_aug import Camera, Rig, load_rig
from arbiview_aug.cameras.lens import LensName
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


@dataclass(frozen=True, kw_only=True)
class Change:
    """A change of vehicle.

    Attributes:
        name: On the command line and in files.
        title: In tables.
        target: Vehicle B at a size, in A's ego frame.
        has_lens: Whether its cameras are no pinholes. The detectors read K alone: they are not trained on its frames.
    """

    name: str
    title: str
    target: Callable[[Size], Rig]
    has_lens: bool = False


def source_rig(
    size: Size, *, fov_deg: float = _FOV_DEG, height_m: float = _HEIGHT_M, lens: LensName = "pinhole"
) -> Rig:
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
                lens=lens,
                distortion=(0.0,) * 4 if lens == "fisheye" else (),
            )
        )
    return Rig(cameras, name="A")


def _zoomed(fov_deg: float) -> Callable[[Size], Rig]:
    return lambda size: source_rig(size, fov_deg=fov_deg)


def _lifted(by_m: float) -> Callable[[Size], Rig]:
    return lambda size: source_rig(size, height_m=_HEIGHT_M + by_m)


def _argoverse2(size: Size) -> Rig:
    """The shipped seven-camera rig, each camera cut to the aspect of ``size`` around its principal row."""
    rig = load_rig("argoverse2")
    cameras = []
    for camera in rig:
        height = min(camera.height_px, round(camera.width_px * size[0] / size[1]))
        top = int(np.clip(round(camera.K[1, 2] - height / 2), 0, camera.height_px - height))
        cameras.append(camera.crop(top, 0, (height, camera.width_px)).resize(size))
    return rig.with_cameras(cameras).in_frame_of(source_rig(size))


CHANGES: dict[str, Change] = {
    change.name: change
    for change in (
        Change(name="fov50", title="FOV 65° → 50°", target=_zoomed(50.0)),
        Change(name="up70", title="+0.7 m", target=_lifted(0.7)),
        Change(name="up35", title="+0.35 m", target=_lifted(0.35)),
        Change(name="down35", title="−0.35 m", target=_lifted(-0.35)),
        Change(name="waymo", title="Waymo-like, 5 at 2.1 m", target=demo_target_rig),
        Change(name="av2", title="Argoverse-2-like, 7 cameras", target=_argoverse2),
        Change(name="fov80", title="FOV 65° → 80°", target=_zoomed(80.0)),
        Change(name="turned", title="turned by 30°", target=lambda size: source_rig(size).turned(yaw_deg=30.0)),
        Change(name="pitched", title="5° down", target=lambda size: source_rig(size).turned(pitch_deg=-5.0)),
        Change(name="aside60", title="0.6 m to the left", target=lambda size: source_rig(size).shifted(y_m=0.6)),
        Change(
            name="fisheye",
            title="fisheye, 100° wide",
            target=lambda size: source_rig(size, fov_deg=100.0, lens="fisheye"),
            has_lens=True,
        ),
    )
}
"""By name. ``waymo``: Waymo's azimuths and height at A's field of view, so that it stays a change of the layout."""
