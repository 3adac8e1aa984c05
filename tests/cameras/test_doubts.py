"""Likely mistakes of a rig's cameras, of which ``load_rig`` warns and which ``check`` finds."""

from __future__ import annotations

import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug import Camera, Rig, load_rig, shipped_rigs
from arbiview_aug.cameras.validation import doubts
from arbiview_aug.errors import CalibrationError
from tests.helpers import camera


def at(name: str, azimuth_deg: float, **changes: Any) -> Camera:
    """A camera on the side of the vehicle to which it looks."""
    a = np.radians(azimuth_deg)
    return camera(name, azimuth_deg, **{"position_m": (np.cos(a), np.sin(a), 1.5), **changes})


AROUND = [at("front", 0.0), at("left", 90.0), at("right", -90.0), at("back", 180.0)]
BODY = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # a body's axes in those of its camera


def turned(camera: Camera, R: np.ndarray) -> Camera:
    pose = camera.cam2ego.copy()
    pose[:3, :3] = R
    return replace(camera, cam2ego=pose)


def test_sound_rigs_raise_no_doubt() -> None:
    down = camera("down", elevation_deg=-90.0)
    rigs = [AROUND, [AROUND[0], down, camera("stereo_left", 1.0), camera("rear_view_mirror")]]
    rigs += [[camera("left", 2.0), camera("right", -2.0)]]  # a stereo pair
    assert not any(doubts(rig, 0.0) for rig in rigs)
    for rig in map(load_rig, shipped_rigs()):
        assert not doubts(rig.cameras, rig.ground_z_m)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("front", BODY, "'front'.*looks up by 90 degrees, as with a body's axes"),
        ("left", np.diag([-1.0, -1.0, 1.0]), "'left'.*rolled by -?180 degrees"),
        ("left", np.diag([1.0, -1.0, -1.0]), "OpenGL's axes"),
        ("back", np.diag([-1.0, 1.0, -1.0]), "'back'.*where its name says, found it looks to .*0 degrees"),
    ],
)
def test_one_camera_of_several(name: str, change: np.ndarray, message: str) -> None:
    rig = [turned(c, c.cam2ego[:3, :3] @ change) if c.name == name else c for c in AROUND]
    (said,) = doubts(rig, 0.0)
    assert re.search(message, str(said)), said


def test_mirrored_rigs_are_called_left_handed(tmp_path: Path) -> None:
    unreal, mirror = np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]]), np.diag([1.0, -1, 1])
    for rig in (
        [turned(c, mirror @ c.cam2ego[:3, :3] @ unreal.T) for c in AROUND],  # y is to the right, as is the camera's
        [turned(c, at(c.name, -c.azimuth_deg).cam2ego[:3, :3]) for c in AROUND],
    ):
        with pytest.warns(UserWarning, match="left and right are swapped, as in left-handed axes"):
            load_rig(Rig(rig).save(tmp_path / "rig.yaml"))
    front = AROUND[0].cam2ego[:3, :3]
    for axes, fix in ((mirror @ front, r"np.diag\(\[1, -1, 1, 1\]\) @ cam2ego"), (front @ mirror, "Unity")):
        with pytest.raises(CalibrationError, match=f"right-handed axes, got mirrored, left-handed.*{fix}"):
            turned(AROUND[0], axes)
    crossed = [at("left", 90.0, position_m=(0, -1, 1.5)), at("right", -90.0, position_m=(0, 1, 1.5))]
    assert "y of all positions mirrored" in doubts(crossed, 0.0)[0].found


@pytest.mark.parametrize("size", [(36, 48), (96, 72), (144, 192)])
def test_intrinsics_of_another_size(size: tuple[int, int]) -> None:
    (said,) = doubts([camera(size=size, K=camera().K)], 0.0)
    assert f"middle of {size[1]}x{size[0]} pixels, found the middle of about 96x72" in str(said)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not doubts([camera().crop(10, 0, (62, 96)), camera("b", 1.0)], 0.0)
