"""Numbers at the edges: ill-conditioned homographies, weights of nothing, gains at the clamp, broken points; and
calibrations and scenes of all magnitudes: finite pixels or an error of ours, within 20 s of CPU time a frame.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import ArbiviewError, Camera, PaperConfig, RenderConfig, Rig, RigRetarget
from arbiview_aug.favs.renderer import render_paper
from arbiview_aug.favs.stage2_features import (
    Matches,
    Region,
    accept,
    consistency,
    optimise_transformation,
)
from arbiview_aug.render.harmonise import LEVELS, SHARES, estimate_gains, tone_curves
from arbiview_aug.render.photometry_kernels import tone
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.torch_backend import render_torch
from arbiview_aug.render.view_planner import ViewPlanner, build_plan
from arbiview_aug.scene.scene import GEOMETRIES
from tests import helpers
from tests.extremes.conftest import Worst
from tests.extremes.test_geometry import LENSES, SOURCES, TARGETS, camera, no_numpy_warnings, ring
from tests.helpers import sampled

SIZE = (300, 800)  # the width at which PaperConfig states its lengths
EVERYWHERE = Region(0, 0, 799, 299)


# --- homographies -----------------------------------------------------------------------------------------------------


def conditioned(exponent: int, seed: int) -> np.ndarray:
    """A random (3, 3) with a condition number of 10**exponent and a positive determinant."""
    rng = np.random.default_rng(seed)
    U, V = (np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(2))
    H = U @ np.diag(10.0 ** (-exponent * np.array([0, rng.random(), 1]))) @ V
    return H * np.sign(np.linalg.det(H))


@pytest.mark.parametrize("exponent", range(13))
def test_matches_that_nearly_determine_nothing_move_nothing_far(exponent: int, worst: Worst) -> None:
    """Matches on a line but for 10**-exponent px: what they say is declined in words, or it is bounded."""
    rng = np.random.default_rng(exponent)
    config = PaperConfig()
    for slope in (0.0, 0.3):
        x = np.linspace(50, 750, 40)
        points = np.stack([x, 150 + slope * (x - 400) + 10.0**-exponent * rng.normal(size=40)], 1)
        matches = Matches(points, points + (3, 2) + 1e-3 * rng.normal(size=(40, 2)))
        for H_geometric in (np.eye(3), -1e6 * np.eye(3), 1e-6 * np.eye(3)):
            with no_numpy_warnings():
                report = accept(H_geometric, matches, EVERYWHERE, EVERYWHERE, 1.0, 1.0, config)
                moved_px = consistency(np.eye(3), report.H_base, EVERYWHERE.corners)
            assert report.reason and np.isfinite(report.H_base).all() and 0 <= report.quality <= 1
            assert np.linalg.det(report.H_base) > 0
            worst("px, corners moved by nearly collinear matches (bound 24)", moved_px)
            assert moved_px <= config.inconsistent_px


@pytest.mark.parametrize("exponent", [0, 3, 6, 9, 12])
def test_ill_conditioned_geometry_is_declined_in_words(exponent: int) -> None:
    texture = np.random.default_rng(0).integers(0, 256, SIZE, dtype=np.uint8)
    everywhere = np.ones(SIZE, bool)
    for seed in range(3):
        H = conditioned(exponent, seed)
        with no_numpy_warnings():
            report = optimise_transformation(
                H, texture, texture, (everywhere, everywhere), EVERYWHERE, 1.0, PaperConfig()
            )
        assert np.isfinite(report.H_base).all() and report.reason
        assert exponent < 6 or (report.case == "geometric" and "distorts" in report.reason)


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
        assert all(np.isfinite(report.H_final).all() and report.features.reason for report in view.reports)


# --- weights ----------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("execution", ["opencv", "torch"])
@pytest.mark.parametrize("weight", [0.0, 5e-324, 1e-45, 1e-38, 1e-30])
def test_coverage_does_not_depend_on_weights(weight: float, execution: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Weights of nothing, or nearly: the same pixels are covered, by shades of the sources that see them."""
    rig, target = ring(8), Rig([camera("t", azimuth_deg=20.0, position_m=(0.1, 0.2, 1.7))])
    images = [torch.full((1, 3, *c.size), s) for c, s in zip(rig, np.linspace(0.2, 1, len(rig)).tolist(), strict=True)]
    build = partial(build_plan, rig, target, geometry="street", config=RenderConfig(seam_width=0.1))
    covered = build().targets[0].coverage
    monkeypatch.setattr(ViewPlanner, "_weights", lambda self: np.full_like(self.nodes.score, weight))
    with no_numpy_warnings():
        plan = build()
        view = render_torch(plan, images)[0] if execution == "torch" else render_opencv(plan, [i[0] for i in images])
    image = view[0].numpy()[0]
    assert np.array_equal(plan.targets[0].coverage, covered) and np.isfinite(image).all()
    assert (image[covered] >= 0.2 - 1e-4).all() and image.max() <= 1 and (image[~covered] == 0).all()
    assert all(0 <= band.weight.min() and band.weight.max() <= 0.5 for band in plan.targets[0].bands)


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


@pytest.mark.parametrize("gain", [1e-3, 1 / 16, 1 / 2.5, 2.5, 16.0, 1e3])
def test_curves_stay_in_range_and_rise(gain: float, worst: Worst) -> None:
    curve = tone_curves(gain)
    x, levels = np.linspace(0, 1, 4097), np.arange(256, dtype=np.uint8).repeat(3)
    lines = x * curve[0], 1 - (1 - x) * curve[1]
    exact, triple = np.minimum(*lines) if gain > 1 else np.maximum(*lines), x.astype(np.float32).repeat(3)
    for values, scale in ((levels, LEVELS), (triple, SHARES)):
        tone(
            values[None],
            np.array([[0, 0, len(values) // 3, 0]], np.int32),
            curve[None, None].astype(np.float32),
            *scale,
        )
    single = triple[::3]
    for y in (exact, single):
        assert y[0] == 0 and y[-1] == pytest.approx(1, abs=1e-6) and (np.diff(y) >= -1e-6).all()
    assert (np.diff(levels.astype(int)) >= 0).all() and levels[-1] == 255
    error = 255 * np.abs(single - exact).max()
    worst("grey levels, tone curves in float32", error)
    assert error <= 1e-3


# --- half precision ---------------------------------------------------------------------------------------------------


# --- LiDAR ------------------------------------------------------------------------------------------------------------
NAN = float("nan")
POINTS: dict[str, Any] = {
    "none": torch.zeros(0, 3),
    "one": [[12.0, 1.0, 1.0]],
    "NaN alone": [[NAN, NAN, NAN]] * 5,
    "duplicates": [[12.0, 1.0, 1.0]] * 1000,
    "at infinity among others": [[12.0, 1.0, 1.0], [math.inf, 0.0, 0.0], [1e300, 1e300, 0.0], [0.0, -math.inf, NAN]],
    "on the image plane": [[1.5, 5.0, 1.5], [1.5, -5.0, 1.5], [1.5, 0.0, 9.0]],
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


# --- calibrations and scenes of all magnitudes ------------------------------------------------------------------------
LIMIT_S = 20
NUMBERS = (
    *(5e-324, 1e-38, 1e-12, 1e-6, 1e-3, 1.0, 1e3, 1e5, 1e7, 1e9, 1e11, 1e15, 1e20, 1e38, 1e150, 1e308),
    *(math.nan, math.inf, -1.0, -1e9, -1e308, 0.0),
)
IMAGE_SIZES = ((1, 1), (1, 4000), (4000, 1), (2, 2), (3, 700), (1080, 1920))

COEFFICIENTS = {lens: values["distortion"] for lens, values in LENSES.items() if values}
"""Sound ones, of which one is changed at a time."""

Case = tuple[str, str, Any]  # the side (source or target), the field, its value


def cases() -> Iterator[Case]:
    """All cases but the geometry."""
    for side in ("source", "target"):
        for field in ("fx", "fy", "f", "cx", "cy", "skew", "x", "y", "z", "xyz", "R", "R00", "ground_z_m"):
            yield from ((side, field, value) for value in NUMBERS)
        for lens, coefficients in COEFFICIENTS.items():
            yield from ((side, lens, (k, value)) for k in range(len(coefficients)) for value in NUMBERS)
        yield from ((side, "size", size) for size in IMAGE_SIZES)
        yield from ((side, "size and f", (size, f)) for size in IMAGE_SIZES for f in (1e-6, 1e3, 1e9))
    for field in ("points", "points noise", "depth_m", "boxes", "boxes size", "boxes yaw", "ego2ego", "time_s"):
        yield from (("scene", field, value) for value in NUMBERS)


def changed(camera: Camera, field: str, value: Any) -> Camera:
    K, pose, others = camera.K.copy(), camera.cam2ego.copy(), {}
    (h, w), size = camera.size, value if field == "size" else value[0] if field == "size and f" else camera.size
    K[:2, :2] *= max(size) / max(h, w)
    K[:2, 2] = (size[1] - 1) / 2, (size[0] - 1) / 2
    entries = {"fx": [(0, 0)], "fy": [(1, 1)], "f": [(0, 0), (1, 1)], "cx": [(0, 2)], "cy": [(1, 2)], "skew": [(0, 1)]}
    for at in entries.get("f" if field == "size and f" else field, ()):
        K[at] = value[1] if field == "size and f" else value
    if set(field) <= set("xyz"):
        pose[["xyz".index(axis) for axis in field], 3] = value
    elif field == "R":
        pose[:3, :3] *= value
    elif field == "R00":  # nearly a rotation, and anything else
        pose[0, 0] += value
    elif field in COEFFICIENTS:
        coefficients = [*COEFFICIENTS[field]]
        coefficients[value[0]] = value[1]
        others = {"lens": field, "distortion": tuple(coefficients)}
    return Camera(name=camera.name, width_px=size[1], height_px=size[0], K=K, cam2ego=pose, **others)


def rig_of(side: str, case: Case) -> Rig:
    rig = helpers.ring(2 if side == "source" else 1, size=(48, 64), z_m=1.5 if side == "source" else 1.9)
    if case[0] != side:
        return rig
    if case[1] == "ground_z_m":
        return Rig(rig.cameras, ground_z_m=case[2])
    return Rig([changed(rig[0], *case[1:]), *rig.cameras[1:]])


def scene_of(rig: Rig, case: Case) -> dict[str, Any]:
    """Points, maps and boxes before the cameras, and a neighbouring frame."""
    rng = np.random.default_rng(0)
    field, value = case[1:] if case[0] == "scene" else ("", 1.0)
    points = rng.normal(size=(500, 3)) * (15, 15, 1) + (0, 0, 1)
    points[: len(points) if field == "points" else 5 if field == "points noise" else 0] *= value
    boxes = np.array([[9.0, 0.5, 0.8, 4.0, 2.0, 1.6, 0.2], [-9.0, -1.0, 0.8, 4.0, 2.0, 1.6, 0.2]])
    boxes[:, {"boxes": slice(0, 3), "boxes size": slice(3, 6), "boxes yaw": 6}.get(field, slice(0, 0))] *= value
    depth_m = 12.0 * (value if field == "depth_m" else 1.0)
    maps = [torch.full(camera.size, depth_m, dtype=torch.float64) for camera in rig]
    images = [torch.randint(0, 256, (3, *camera.size), dtype=torch.uint8) for camera in rig]
    ego2ego = torch.eye(4, dtype=torch.float64)
    ego2ego[0, 3] = value if field == "ego2ego" else -1.0
    neighbour = {"images": images, "ego2ego": ego2ego, "time_s": value if field == "time_s" else -0.5}
    measured = {"points": torch.from_numpy(points), "boxes_3d": torch.from_numpy(boxes)}
    measured |= dict.fromkeys(("depth_m", "learned_depth_m"), maps)
    return {"images": images, "rig": rig, **measured, "time_s": 0.0, "neighbours": [neighbour]}


def renders(geometry: str, case: Case) -> bool:
    """Whether a case renders; it is refused otherwise, and other errors are raised."""
    torch.manual_seed(0)
    try:
        retarget = RigRetarget(rig_of("target", case), geometry=geometry)  # type: ignore[arg-type]
        images = retarget(scene_of(rig_of("source", case), case))["images"]
    except ArbiviewError:
        return False
    assert all(image.isfinite().all() for image in images)
    return True


@pytest.mark.parametrize("geometry", ["lidar", "fused"])
def test_huge_focal_lengths_end(geometry: str) -> None:
    assert renders(geometry, ("target", "f", 1e8))
    for side, f in (("source", 1e8), ("target", 1e308)):  # such a source shows no pixel of the target
        assert not renders(geometry, (side, "f", f))


@pytest.mark.slow
@pytest.mark.parametrize("geometry", [name for name in GEOMETRIES if name != "auto"])
def test_all_magnitudes_render_or_are_refused(geometry: str, worst: Worst) -> None:
    assert renders(geometry, ("none", "", 1.0))  # kernels are compiled before the clock runs
    for case in cases():
        before_s = time.process_time()
        renders(geometry, case)
        took_s = time.process_time() - before_s
        worst("s of CPU time, a frame of any magnitudes", took_s)
        assert took_s < LIMIT_S, case


# --- cameras drawn ----------------------------------------------------------------------------------------------------
