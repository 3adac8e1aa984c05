"""Weights of sources on the nodes, around seams, and the bands that a second source adds to."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numba import njit

from arbiview_aug.cameras import kernels as camera_kernels
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.render import kernels
from arbiview_aug.render.kernels import cut_bands, find_bands
from arbiview_aug.render.node_kernels import soften
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.render.structures import Pixels
from arbiview_aug.render.view_planner import PRIMARY_BONUS, ViewPlanner, build_plan
from tests.extremes import reference
from tests.helpers import demo_source_rig


def softened(winner: np.ndarray, border_px: np.ndarray, radius: int) -> np.ndarray:
    """Weights over seams 8 px wide."""
    weights = np.empty_like(border_px)
    soften(winner, border_px, radius, 8.0, weights)
    return weights


def test_weights_ramp_over_the_seam_and_add_up_to_one() -> None:
    winner = np.repeat([[0] * 6 + [1] * 6], 5, axis=0).astype(np.int8)
    left, right = softened(winner, np.full((2, *winner.shape), 1e3, np.float32), radius=1)
    ramp = np.array([1, 1, 1, 1, 8 / 9, 6 / 9, 3 / 9, 1 / 9, 0, 0, 0, 0])  # two boxes of three nodes
    np.testing.assert_allclose(left, np.broadcast_to(ramp, left.shape), atol=1e-6)
    np.testing.assert_allclose(left + right, 1, atol=1e-6)


def test_weights_fade_at_a_sources_own_border() -> None:
    border = np.array([[[-2.0, 0.0, 2.0, 4.0, 8.0, 20.0]]], np.float32)
    (weight,) = softened(np.zeros((1, 6), np.int8), border, radius=2)
    np.testing.assert_allclose(weight, [[0, 0, 0.25, 0.5, 1, 1]])
    (nobody,) = softened(np.full((1, 6), -1, np.int8), border, radius=2)
    assert not nobody.any()


def test_nodes_weigh_as_the_formulas_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """w = min(2 d / side, 1) * clip(r, 0.05, 1) / (1 + p) * w_primary, by the pinhole model in float64.

    d is the distance to the image's border, r the smaller singular value of the Jacobian of (u, v), and p the expected
    displacement: focal length x offset across the ray x expected error of the inverse distance.
    """
    rig = demo_source_rig((128, 352))
    target = Rig([rig[0].turned(yaw_deg=4.0, pitch_deg=2.0), rig[1].shifted(x_m=0.4, z_m=0.3)])
    planners, finish = list[ViewPlanner](), ViewPlanner.finish
    monkeypatch.setattr(ViewPlanner, "finish", lambda self, layout: planners.append(self) or finish(self, layout))
    build_plan(rig, target, geometry="street", config=RenderConfig(layers=False))
    compared = 0
    for planner in planners:
        view, camera = planner.view, planner.camera
        y, x = view.y[1:-2], view.x[1:-2]  # whose next nodes lie a step away
        grid = np.ix_(y, x)
        directions, origin = reference.rays(camera)[0], camera.center_m
        q = reference.inverse_distance("street", origin, directions, rig.ground_z_m)
        street = planner.scene.surface("street", rig.ground_z_m)
        error = street.uncertainty(origin, directions, q)
        for i, k in enumerate(planner.sources):
            source = rig[k]
            uv = reference.seen(source, camera, "street", rig.ground_z_m).uv
            J = (
                np.stack([uv[np.ix_(y, x + view.step)] - uv[grid], uv[np.ix_(y + view.step, x)] - uv[grid]], -1)
                / view.step
            )
            with np.errstate(invalid="ignore"):
                edge = np.minimum(uv[grid], np.array(source.size[::-1]) - 1 - uv[grid]).min(-1) + 0.5
            seen = (edge > 0.6) & np.isfinite(J).all((-2, -1))
            r = np.linalg.svd(np.where(seen[..., None, None], J, 0), compute_uv=False)[..., -1]
            offset = origin - source.center_m
            across = np.linalg.norm(np.cross(directions[grid], offset), axis=-1)
            p = camera.K[0, 0] * across * error[grid]
            primary = PRIMARY_BONUS if np.linalg.norm(offset) < 1e-6 else 1.0
            weight = np.minimum(2 * edge / min(source.size), 1) * np.clip(r, 0.05, 1) / (1 + p) * primary
            got = planner.nodes.score[i][1:-2, 1:-2]
            np.testing.assert_allclose(got[seen], weight[seen], rtol=5e-3)
            compared += int(seen.sum())
    assert compared > 1000


def test_hot_kernels_count_no_references_to_arrays() -> None:
    """References cost a fifth of the time. What they call is linked into them."""
    kernels_ = (kernels.see_nodes, kernels.plan_pixels, kernels._look, kernels._plan_block)
    callees = (camera_kernels.rays_row, camera_kernels.turn_row, camera_kernels.project_row)
    assert all(kernel.targetoptions["_nrt"] is False for kernel in (*kernels_, *callees))


@pytest.mark.slow
def test_code_of_pixels_holds_no_reference_count() -> None:
    rig = demo_source_rig((64, 176))
    called = list[tuple[Any, ...]]()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernels, "plan_pixels", lambda *arguments: called.append(arguments))
        build_plan(rig, rig.turned(yaw_deg=20.0), geometry="street")
    fresh = njit(error_model="numpy", nogil=True, _nrt=False)(kernels.plan_pixels.py_func)
    fresh(*called[0])
    assert "NRT_incref" not in "".join(fresh.inspect_llvm().values())


def test_bands_hold_the_shares_and_places_of_the_second_source() -> None:
    """Rectangles of each source, in strips 128 rows high."""
    h, w, step = 140, 8, 4
    second, xy = np.full((h, w), -1, np.int8), np.arange(h * w, dtype=np.int32).reshape(h, w)
    share, frac, shared = np.zeros((h, w), np.float32), np.full((h, w), 7, np.uint16), np.ones((35, 2), bool)
    share[2:4, 1:3], second[2:4, 1:3] = 0.25, 1
    share[130, 5], second[130, 5] = 0.5, 0
    none = np.zeros((0, 0), np.uint8)
    pixels = Pixels(second, xy, frac, second, xy, frac, share, shared, none, np.zeros(128, np.int64))
    bands = np.empty((8, 5), np.int64)
    assert find_bands(pixels, step, 128, np.array([0, 1]), bands) == 2
    assert bands[:2].tolist() == [[0, 130, 131, 4, 8], [1, 2, 4, 0, 4]]
    band_xy, band_frac, weight = np.empty(12, np.int32), np.empty(12, np.uint16), np.empty(12, np.float32)
    cut_bands(pixels, bands[:2], band_xy, band_frac, weight)
    np.testing.assert_allclose(weight, [0, 0.5, 0, 0, *[0, 0.25, 0.25, 0] * 2])
    assert band_xy[5:7].tolist() == xy[2, 1:3].tolist() and set(band_frac[weight > 0]) == {7}
