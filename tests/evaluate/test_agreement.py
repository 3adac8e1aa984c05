"""``evaluate`` against the protocol in code, on real frames at half resolution."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import adjacent_pairs, half_way_view
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.agreement import overlap_psnr, overlap_scores, source_overlap
from arbiview_aug.evaluate.lidar import (
    coloured_points,
    equalised,
    equalising_gains,
    lidar_split,
    sparse_metrics,
)
from arbiview_aug.evaluate.methods import retargeting
from arbiview_aug.evaluate.targets import paper_target, without_masks
from tests.helpers import ring, score_targets

AGREEMENT_DB = 0.01


class Frame:
    """One frame as the protocol reads it, and as this package does."""

    def __init__(self, referee: ModuleType, folder: Path) -> None:
        self.cameras, self.points, _ = referee.load_frame(str(folder), 0.5)
        self.rig = Rig([as_camera(name, c) for name, c in self.cameras.items()], ground_z_m=0.0, name=folder.name)
        self.images = [c["image"] for c in self.cameras.values()]


def as_camera(name: str, c: dict[str, Any]) -> Camera:
    h, w = c["image"].shape[:2]
    return Camera(name=name, width_px=w, height_px=h, K=c["K"], cam2ego=c["cam2ego"], mask=c["mask"] > 0)


@pytest.fixture(scope="module", params=["nuscenes_root", pytest.param("ddad_root", marks=pytest.mark.slow)])
def frame(request: pytest.FixtureRequest, referee: ModuleType) -> Frame:
    return Frame(referee, request.getfixturevalue(request.param))


def referee_targets(rig: Rig) -> list[tuple]:
    return [(c.name, c.K, c.cam2ego, c.size) for c in rig]


@pytest.mark.slow
def test_sparse_metrics_agree(referee: ModuleType, frame: Frame) -> None:
    cameras = referee.equalised(frame.cameras, frame.points)
    images = equalised(frame.rig, frame.images, frame.points)
    for ours, theirs in zip(images, cameras.values(), strict=True):
        assert np.abs(ours.astype(int) - theirs["image"]).max() <= 1
    render = referee.reference_renderer(cameras, "ground")
    points = coloured_points(frame.rig, images, frame.points)
    want_points, want_colours = referee.coloured_points(cameras, frame.points)
    assert len(points) == len(want_points)
    np.testing.assert_allclose(points.colours, want_colours, atol=1.0)

    target = without_masks(frame.rig.shifted(z_m=0.6).turned(yaw_deg=22.0))
    theirs = referee.rotated_targets(cameras, 22.0, (0.0, 0.0, 0.6))
    for camera, image, (_, K, cam2ego, _) in zip(target, render(theirs), theirs, strict=True):
        np.testing.assert_allclose(camera.cam2ego, cam2ego, atol=1e-9)
        want = referee.sparse_metrics(image, K, cam2ego, want_points, want_colours)
        got = sparse_metrics(image, camera, points)
        assert got is not None
        assert got["points"] == want["n"]
        assert got["psnr_db"] == pytest.approx(want["psnr"], abs=AGREEMENT_DB)
        assert got["mae"] == pytest.approx(want["mae"], abs=0.01)
        assert got["rmse"] == pytest.approx(want["rmse"], abs=0.02)
        assert got["ssim"] == pytest.approx(want["ssim"], abs=1e-4)


@pytest.mark.slow
def test_mean_score_agrees(referee: ModuleType, frame: Frame) -> None:
    """The whole protocol on one cheap target: each camera alone, on the far surface."""
    render = referee.reference_renderer(frame.cameras, "far", own_camera_only=True)
    want = referee.score(render, frame.cameras, frame.points, [referee.rotated_targets(frame.cameras, -11.0)])
    points = coloured_points(frame.rig, frame.images, frame.points)
    target = without_masks(frame.rig.turned(yaw_deg=-11.0))
    got = score_targets(lambda rig: render(referee_targets(rig)), points, [target])
    assert got["psnr_db"] == pytest.approx(want["psnr"], abs=AGREEMENT_DB)
    assert got["ssim"] == pytest.approx(want["ssim"], abs=1e-4)
    assert got["points"] == pytest.approx(want["n"], abs=0.5)
    assert got["coverage"] < 1 and got["covered_psnr_db"] > got["psnr_db"]


def test_gains_agree(referee: ModuleType, frame: Frame) -> None:
    gains = equalising_gains(frame.rig, frame.images, frame.points)
    want = referee.equalised(frame.cameras, frame.points)
    for gain, before, after in zip(gains, frame.images, want.values(), strict=True):
        light = (before > 60) & (before < 120)
        assert gain == pytest.approx((after["image"][light] + 0.5).mean() / before[light].mean(), rel=0.005)


def test_targets_agree(referee: ModuleType, frame: Frame) -> None:
    for share in referee.PAPER_SHARES:
        ours = paper_target(frame.rig, share)
        if frame.rig.name == "nuscenes-one":
            want = referee.paper_targets(frame.cameras, share)
            np.testing.assert_allclose(ours.cam2ego, [T for _, _, T, _ in want], atol=1e-9)
        assert all(c.mask is None for c in ours)


def test_lidar_split_agrees(referee: ModuleType, frame: Frame) -> None:
    for ours, theirs in zip(lidar_split(frame.points), referee.lidar_split(frame.points), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_overlap_agrees(referee: ModuleType, frame: Frame) -> None:
    pairs = adjacent_pairs(frame.rig)
    assert len(pairs) == 6
    a, b = pairs[0]
    pair = frame.rig.with_cameras([frame.rig[a], frame.rig[b]])
    names = pair.names
    size = (225, 400)
    one, two = (frame.cameras[name] for name in names)
    K, T = referee.half_way_view(one, two, size)
    view = half_way_view(*pair, size)
    np.testing.assert_allclose(view.K, K, atol=1e-9)
    np.testing.assert_allclose(view.cam2ego, T, atol=1e-9)

    def render(view: Camera, source: int) -> tuple[np.ndarray, np.ndarray]:
        alone = referee.reference_renderer({names[source]: frame.cameras[names[source]]}, "ground")
        image = next(alone(referee_targets(Rig([view]))))
        return image, image.any(-1)

    images = [render(view, k) for k in range(2)]
    both = images[0][1] & images[1][1]
    (score,) = overlap_scores(pair, render, size=size)
    assert score.first == names[0] and score.pixels == both.sum() > 1000
    for fitted, ours in ((False, score.raw_psnr_db), (True, score.fitted_psnr_db)):
        want = referee.overlap_psnr(images[0][0], images[1][0], both, fitted=fitted)
        assert ours == pytest.approx(want, abs=AGREEMENT_DB)
        assert overlap_psnr(images[0][0], images[1][0], both, fitted=fitted) == ours


def test_a_camera_that_sees_nothing_of_a_half_way_view_has_no_score() -> None:
    """Their fields of view overlap in azimuth, but one looks up and the other down."""
    up, down = ring(6)[:2]
    rig = Rig([up.turned(pitch_deg=80), down.turned(pitch_deg=-80)])
    sample = {"images": torch.zeros(2, 3, 72, 96, dtype=torch.uint8), "rig": rig}
    (score,) = source_overlap(sample, retargeting("fast", "street"), size=(20, 30))
    assert score.pixels == 0
