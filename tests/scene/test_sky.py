"""Points that photographs add where no scan line returned."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import RayCache
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import Quality
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.scene.sky import FAR_M, sky_points
from arbiview_aug.scene.surface import Points
from arbiview_aug.transforms import renderers


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32])
def test_sky_is_far_and_a_wall_continues_above_the_highest_scan_line(dtype: torch.dtype) -> None:
    """To the left a wall rises out of view, to the right it ends below the highest of the lines, which reach 12°."""
    camera = Camera.looking(name="front", azimuth_deg=0, width_px=320, height_px=240, horizontal_fov_deg=80)
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-39, 39, 0.5)), np.radians(np.arange(-10, 12.5, 1)))
    rays = np.stack([np.ones_like(azimuth), np.tan(azimuth), np.tan(elevation) / np.cos(azimuth)], -1)
    points = camera.center_m + 10 * rays[(azimuth > 0) | (elevation < np.radians(4))]
    directions = camera.unproject(camera.pixel_grid())[0]
    is_wall = (directions[..., 1] > 0) | (directions[..., 2] < np.sin(np.radians(4.5)))
    grey = np.random.default_rng(0).integers(60, 120, (240, 320, 1)) * np.ones(3)
    image = torch.from_numpy(np.where(is_wall[..., None], grey, (150, 180, 230)).transpose(2, 0, 1).astype(np.uint8))
    image = image if dtype == torch.uint8 else image.float() / 255
    added = sky_points(Rig([camera], name="one", ground_z_m=0.0), [image], points, RayCache()) - camera.center_m
    distance = np.linalg.norm(added, axis=1)
    far, near = added[distance > FAR_M - 1], added[distance < FAR_M - 1]
    assert len(far) > 100 and (far[:, 1] < 0).all() and (far[:, 2] > 0).all()
    assert len(near) > 100 and (near[:, 1] > 0).all()
    np.testing.assert_allclose(near[:, 0], 10, rtol=0.03)
    assert np.degrees(np.arctan2(near[:, 2], np.hypot(near[:, 0], near[:, 1]))).min() > 11


def test_a_view_without_sky_adds_nothing() -> None:
    camera = Camera.looking(name="front", azimuth_deg=0, width_px=320, height_px=240, horizontal_fov_deg=80)
    y, z = np.meshgrid(np.linspace(-8, 8, 60), np.linspace(0, 3.5, 30))
    wall = np.stack([np.full(y.size, 10.0), y.ravel(), z.ravel()], -1)
    image = torch.from_numpy(np.random.default_rng(0).integers(0, 255, (3, 240, 320), np.uint8))
    assert len(sky_points(Rig([camera], name="one", ground_z_m=0.0), [image], wall, RayCache())) == 0


@pytest.mark.parametrize(("quality", "calls"), [("fast", 0), ("accurate", 1)])
def test_accurate_alone_looks_for_sky(quality: Quality, calls: int, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = list[Rig]()

    def no_sky(rig: Rig, *_: object) -> Points:
        asked.append(rig)
        return np.zeros((0, 3), np.float32)

    monkeypatch.setattr(renderers, "sky_points", no_sky)
    source = demo_source_rig((64, 96))
    sample = {"images": torch.zeros(6, 3, 64, 96), "rig": source, "points": torch.tensor([[12.0, 1.0, 1.0]])}
    RigRetarget(source.shifted(z_m=0.5), quality=quality, holes="black")(sample)
    assert len(asked) == calls
