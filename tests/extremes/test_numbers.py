"""Numbers at the edges: the published stages, gains at the clamp, broken points, focal lengths that nobody has."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget
from arbiview_aug.favs.renderer import render_paper
from arbiview_aug.render.harmonise import estimate_gains
from tests.extremes.test_geometry import POINTS as CLOUD
from tests.extremes.test_geometry import SOURCES, TARGETS, camera, focal, no_numpy_warnings, ring
from tests.helpers import sampled


@pytest.mark.parametrize(
    "name",
    ["one camera", "179 degrees"]
    + [pytest.param(name, marks=pytest.mark.slow) for name in ("focal 1e-2 px", "focal 1e5 px", "upside down")],
)
def test_the_published_stages_at_the_edges(name: str) -> None:
    source = SOURCES[name]()
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(len(source), 3, 18, 24, generator=generator)
    images = torch.nn.functional.interpolate(coarse, size=source[0].size, mode="bicubic").clamp(0, 1)
    for make in TARGETS.values():
        target = make()
        if target.lens != "pinhole":
            continue
        with no_numpy_warnings():
            view = render_paper(source, Rig([target]), list(images)).targets[0]
        assert view.image.isfinite().all() and view.image.min() >= 0 and view.image.max() <= 1
        assert all(np.isfinite(report.H_final).all() and report.reason for report in view.reports)


# --- gains ------------------------------------------------------------------------------------------------------------
def pictures(rig: Rig) -> list[torch.Tensor]:
    """Views (3, h, w) in [0.05, 0.85] of a smooth world at infinity, from one centre."""
    waves = np.array([[5.0, 3.0, 7.0], [-6.0, 4.0, 3.0], [2.0, -7.0, 5.0]])
    rays = [camera.unproject(camera.pixel_grid()).directions for camera in rig]
    return [torch.from_numpy((0.45 + 0.4 * np.sin(d @ waves.T)).transpose(2, 0, 1).copy()).float() for d in rays]


@pytest.mark.parametrize(
    ("dtype", "execution", "max_gain"),
    sampled([torch.uint8, torch.float32, torch.float16], ["opencv", "torch"], [2.5, 8.0]),
)
def test_gains_at_the_clamp(
    dtype: torch.dtype, execution: str, max_gain: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = ring(6, position_m=(0.0, 0.0, 1.5))
    images = pictures(rig)
    images[2] = images[2] / 12
    images = [(image * 255).round().to(dtype) if dtype == torch.uint8 else image.to(dtype) for image in images]
    for name, value in (("MAX_GAIN", max_gain), ("PRIOR_LOG_GAIN", 10.0), ("DARK", 0.0)):
        monkeypatch.setattr(f"arbiview_aug.render.harmonise.{name}", value)
    report = estimate_gains(rig, images)
    assert report.accepted and report.gains[2] == pytest.approx(max_gain, rel=1e-12), str(report)
    assert all(1 / max_gain <= gain <= max_gain for gain in report.gains)
    with no_numpy_warnings():
        out = RigRetarget(rig.turned(yaw_deg=25), match_exposure=True, backend=execution)(
            {"images": images, "rig": rig}
        )
    views = out["images"].float() / (255 if dtype == torch.uint8 else 1)
    assert views.isfinite().all() and views.min() >= 0 and views.max() <= 1


# --- LiDAR ------------------------------------------------------------------------------------------------------------
NAN = float("nan")
POINTS: dict[str, Any] = {
    "none": torch.zeros(0, 3),
    "one": [[12.0, 1.0, 1.0]],
    "NaN alone": [[NAN, NAN, NAN]] * 5,
    "duplicates": [[12.0, 1.0, 1.0]] * 1000,
    "at infinity among others": [[12.0, 1.0, 1.0], [math.inf, 0.0, 0.0], [1e300, 1e300, 0.0], [0.0, -math.inf, NAN]],
    "on the image plane": [[1.5, 5.0, 1.5], [1.5, -5.0, 1.5], [1.5, 0.0, 9.0]],
    "at the centre, straight above and below": [[1.5, 0.3, 1.9 + z] for z in (0.0, 1e-9, 1e-3, 3.0, -1.4)],
    "everywhere": np.random.default_rng(1).normal(size=(5000, 3)) * 20,
}


@pytest.mark.parametrize(("name", "quality"), sampled(POINTS, ["draft", "fast", "accurate"]))
def test_few_or_broken_points(name: str, quality: Any) -> None:
    rig = ring(2, position_m=(1.5, 0.0, 1.5), horizontal_fov_deg=90.0)
    images = torch.stack(pictures(rig))
    points = torch.as_tensor(POINTS[name], dtype=torch.float32)
    sample = {"images": images, "rig": rig, "points": points}
    retarget = RigRetarget(Rig([camera("t", position_m=(1.5, 0.3, 1.9))]), quality=quality, geometry="lidar")
    with no_numpy_warnings():
        out = retarget(sample)
    assert out["images"].isfinite().all() and 0 <= out["images"].min() <= out["images"].max() <= 1
    if name in ("none", "NaN alone"):  # nothing was measured: the street
        street = RigRetarget(Rig([camera("t", position_m=(1.5, 0.3, 1.9))]), quality=quality, geometry="street")
        assert torch.equal(out["images"], street(sample)["images"])


@pytest.mark.parametrize("geometry", ["lidar", "fused"])
def test_huge_focal_lengths_end(geometry: Any) -> None:
    rig, maps = ring(2), torch.full((2, 72, 96), 12.0)
    sample = {"images": torch.stack(pictures(rig)), "rig": rig, "points": torch.from_numpy(CLOUD)}
    out = RigRetarget(Rig([camera(K=focal(1e8))]), geometry=geometry)(sample | {"motion_depth_m": maps})
    assert out["images"].isfinite().all()
