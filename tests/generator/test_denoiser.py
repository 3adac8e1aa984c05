"""The denoiser: a plain U-Net until its attention is trained, who reads whom, and its conditions."""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from diffusers import UNet2DConditionModel

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.generator import Generator
from arbiview_aug.generator.attention import TokenWindow, joined, token_sizes
from arbiview_aug.generator.conditioning import (
    Branches,
    BranchGeometry,
    ViewInputs,
    frame_geometry,
    nearest_sources,
    plucker_rays,
    pose_vector,
)
from arbiview_aug.generator.denoiser import REGRESSION, Denoiser, Rows
from tests.generator.small import ring, small_config

Geometry = tuple[BranchGeometry, BranchGeometry]  # of the targets, and of the sources


def views(geometry: BranchGeometry, seed: int = 0, channels: int = 3) -> ViewInputs:
    b, n, _, h, w = geometry.rays.shape
    rng = torch.Generator().manual_seed(seed)
    latent = torch.randn(b, n, channels, h, w, generator=rng)
    mask = torch.rand(b, n, h, w, generator=rng) < 0.7
    return Branches(latent, mask, mask * torch.rand(b, n, h, w, generator=rng), geometry).inputs(latent)


def target_windows(geometry: Geometry, dropped: torch.Tensor | None = None) -> list[TokenWindow]:
    return geometry[0].windows(geometry[1].pose.shape[1], dropped)


def run(denoiser: Denoiser, geometry: Geometry, t: int = 400, seed: int = 0, rows: list[Rows] | None = None):
    targets, sources = views(geometry[0], seed), views(geometry[1], seed + 1)
    noisy = torch.randn(targets.latent.shape, generator=torch.Generator().manual_seed(seed + 2))
    read = denoiser.read_sources(sources, geometry[1].windows())
    time = torch.full((len(noisy),), t)
    return denoiser(noisy, time, targets, target_windows(geometry), read, rows)


@pytest.fixture
def geometry() -> Geometry:
    sources = ring(4, horizontal_fov_deg=100)
    targets = ring(4, horizontal_fov_deg=120, yaw_deg=20, name="t")
    return frame_geometry(list(targets)[:2], list(sources), 0.0, small_config())


@pytest.mark.parametrize("size", [(6, 10), (5, 7), (3, 5)])
@pytest.mark.parametrize("checkpointing", [False, True])
def test_untrained_attention_leaves_the_plain_unet(size: tuple[int, int], checkpointing: bool) -> None:
    """Difference 0, also at odd sizes and under gradient checkpointing; the conditions enter by zero weights."""
    torch.manual_seed(0)
    config = small_config(image_size=size, residual=False)
    plain = UNet2DConditionModel(**config.unet.arguments(3, 3))
    denoiser = Denoiser(copy.deepcopy(plain), config)
    denoiser.gradient_checkpointing = checkpointing
    geometry = frame_geometry(list(ring(3, name="t")), list(ring(3)), 0.0, config)
    targets = views(geometry[0])
    noisy = torch.randn(targets.latent.shape)
    read = denoiser.read_sources(views(geometry[1]), geometry[1].windows())
    got = denoiser(noisy, torch.tensor([400]), targets, target_windows(geometry), read)
    context = denoiser.context(targets.pose[0])
    expected = plain(noisy[0], 400, encoder_hidden_states=context).sample
    assert torch.allclose(got[0], expected, atol=1e-5)


def test_every_parameter_takes_part_in_every_step(generator: Generator) -> None:
    """No overlap, one view, regression or not: unused parameters would hang distributed training."""
    apart = frame_geometry(list(ring(1, name="t")), [ring(1)[0].turned(yaw_deg=180)], 0.0, small_config())
    for t in (0, REGRESSION):
        denoiser = copy.deepcopy(generator.denoiser)
        run(denoiser, apart, t).sum().backward()
        assert all(p.grad is not None and torch.isfinite(p.grad).all() for p in denoiser.parameters())


def test_targets_read_sources_and_targets(generator: Generator, geometry: Geometry) -> None:
    denoiser, t = generator.denoiser, torch.tensor([400])
    targets, sources = views(geometry[0]), views(geometry[1], 1)
    noisy = torch.randn(targets.latent.shape, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        read = denoiser.read_sources(sources, geometry[1].windows())
        windows = target_windows(geometry)
        base = denoiser(noisy, t, targets, windows, read)
        other = sources._replace(latent=sources.latent + 1)
        changed = denoiser(noisy, t, targets, windows, denoiser.read_sources(other, geometry[1].windows()))
        assert (changed - base).abs().max() > 1e-3
        noisy_too = noisy.clone()
        noisy_too[:, 1] += 1
        beside = denoiser(noisy_too, t, targets, windows, read)
        assert (beside[:, 0] - base[:, 0]).abs().max() > 1e-3
        # Without sources, as classifier-free guidance has it, nothing of them is left.
        dropped = torch.tensor([True])
        alone = [
            denoiser(noisy, t, targets.dropped(dropped), target_windows(geometry, dropped), keys)
            for keys in (read, denoiser.read_sources(other, geometry[1].windows()))
        ]
        assert torch.equal(*alone)


def test_permuting_the_cameras_permutes_the_output(generator: Generator) -> None:
    sources, config = ring(4, horizontal_fov_deg=100), small_config()
    targets = ring(5, horizontal_fov_deg=100, yaw_deg=15, name="t")
    denoiser, t = generator.denoiser, torch.tensor([300])
    order, source_order = [4, 2, 0, 3, 1], [2, 3, 1, 0]
    base = frame_geometry(list(targets), list(sources), 0.0, config)
    moved = frame_geometry([targets[k] for k in order], [sources[k] for k in source_order], 0.0, config)
    of_targets, of_sources = views(base[0]), views(base[1], 1)
    noisy = torch.randn(of_targets.latent.shape, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        read = denoiser.read_sources(of_sources, base[1].windows())
        expected = denoiser(noisy, t, of_targets, target_windows(base), read)[:, order]
        of_sources = ViewInputs(*(value[:, source_order] for value in of_sources))
        of_targets = ViewInputs(*(value[:, order] for value in of_targets))
        assert torch.allclose(of_targets.pose, moved[0].pose)
        read = denoiser.read_sources(of_sources, moved[1].windows())
        got = denoiser(noisy[:, order], t, of_targets, target_windows(moved), read)
    assert torch.allclose(got, expected, atol=2e-5)


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize("count", [1, 2, 12])
def test_any_number_of_views_on_the_smallest_grids_is_finite(
    generator: Generator, count: int, dtype: torch.dtype
) -> None:
    denoiser = copy.deepcopy(generator.denoiser).to(dtype)
    for size in ((1, 1), (1, 2), (3, 5)):
        config = small_config(image_size=size)
        geometry = frame_geometry(list(ring(count, name="t", yaw_deg=3)), list(ring(count)), 0.0, config)
        assert [w.valid.shape[-1] for w in target_windows(geometry)] == [h * w for h, w in token_sizes(size, 2)]
        with torch.no_grad():
            out = run(denoiser, geometry)
        assert out.shape == (1, count, 3, *size) and torch.isfinite(out).all()


def test_rows_for_the_geometric_loss(generator: Generator, geometry: Geometry) -> None:
    """One entry a block; rows sum to 1; of untrained attention they are about uniform (1/3 off for a whole window)."""
    torch.manual_seed(0)
    fresh = Generator.from_config(small_config()).denoiser
    rows: list[Rows] = []
    run(fresh, geometry, rows=rows)
    assert len(rows) == 5
    for of_block in rows:
        assert len(of_block.predicted) == len(of_block.target) == len(of_block.pair) > 0
        assert torch.allclose(of_block.predicted.sum(1), torch.ones(len(of_block.predicted)), atol=1e-5)
        loss = (of_block.predicted - of_block.target).square().sum(1).mean()
        assert 0.1 < float(loss.detach()) < 0.7
        assert of_block.predicted.requires_grad
    loss.backward()  # with zero-initialised outputs this is all the gradient that queries and keys get
    assert fresh.cross_view["4"].to_q.weight.grad.abs().max() > 0


# --- what the condition lacks -----------------------------------------------------------------------------------------
@pytest.mark.parametrize("t", [0, 1, 300, 999])
def test_an_untrained_residual_network_is_the_best_linear_guess(t: int) -> None:
    """For a white residual no estimate is better, at any noise; and x0 comes back where nothing lacks."""
    torch.manual_seed(0)
    config = small_config()
    denoiser = Generator.from_config(config).denoiser
    denoiser.deviation.copy_(torch.tensor([0.4, 0.1]))
    geometry = frame_geometry(list(ring(3, name="t")), list(ring(3)), 0.0, config)
    targets = views(geometry[0])
    targets = targets._replace(mask=targets.mask.round())
    signal = denoiser.signal
    assert signal is not None
    a = float(signal[t])
    s = (1 - a**2) ** 0.5
    deviation = torch.where(targets.mask > 0.5, 0.1, 0.4)
    lacking = deviation * torch.randn(targets.latent.shape)
    eps = torch.randn(targets.latent.shape)

    def x0_of(r: torch.Tensor) -> torch.Tensor:
        x = a * (targets.latent + r) + s * eps
        read = denoiser.read_sources(views(geometry[1]), geometry[1].windows())
        with torch.no_grad():
            v = denoiser(x, torch.tensor([t]), targets, target_windows(geometry), read)
        return a * x - s * v

    share = (a * deviation) ** 2 / ((a * deviation) ** 2 + s**2)
    expected = targets.latent + share * (lacking + s / max(a, 1e-8) * eps)
    assert torch.allclose(x0_of(lacking), expected, atol=1e-3 if a > 1e-3 else 0.1)
    assert x0_of(torch.zeros_like(lacking)).isfinite().all()


# --- conditions of the denoiser besides the noise ---------------------------------------------------------------------
ONE = Camera.looking(
    name="one", azimuth_deg=0, position_m=(1.0, 0.0, 1.5), width_px=100, height_px=60, horizontal_fov_deg=90
)


def test_rays_are_directions_and_moments_in_the_references_frame() -> None:
    """A camera 1 m to the left of its reference, looking the same way: o = (-1, 0, 0), compressed to half."""
    left = ONE.shifted(y_m=1.0)
    rays = plucker_rays(left, ONE, (3, 5))
    assert rays.shape == (6, 3, 5)
    d, moment = rays[:3].movedim(0, -1), rays[3:].movedim(0, -1)
    assert torch.allclose(d[1, 2], torch.tensor([0.0, 0.0, 1.0]), atol=1e-6)
    assert torch.allclose(d.norm(dim=-1), torch.ones(3, 5), atol=1e-6)
    assert torch.allclose(moment[1, 2], torch.tensor([0.0, 0.5, 0.0]), atol=1e-6)
    own = plucker_rays(left, left, (3, 5))
    assert torch.allclose(own[:3], rays[:3], atol=1e-6) and not own[3:].any()


def test_poses_are_relative_and_bounded() -> None:
    same = pose_vector(ONE, ONE)
    assert torch.allclose(same[:12], torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]))
    turn = np.eye(4)
    turn[:2, :2], turn[:3, 3] = [[0, -1], [1, 0]], (5, 6, 7)
    other = ONE.turned(yaw_deg=12).shifted(y_m=0.4)
    assert torch.allclose(pose_vector(other, ONE), pose_vector(other.moved(turn), ONE.moved(turn)), atol=1e-6)
    for strange in (ONE.shifted(x_m=9e8), replace(ONE, K=np.diag([1e9, 1e-4, 1.0]))):
        pose = pose_vector(strange, ONE)
        assert torch.isfinite(pose).all() and pose[9:12].abs().max() <= 1
        assert torch.isfinite(plucker_rays(strange, ONE, (2, 2))).all()


def test_the_reference_is_the_source_that_looks_most_alike() -> None:
    rig = load_rig("nuscenes")
    target = rig["CAM_BACK_LEFT"].turned(yaw_deg=-20)
    for sources in (list(rig), list(rig)[::-1]):
        assert sources[nearest_sources(target, sources)[0]].name == "CAM_BACK_LEFT"
    twins = [replace(ONE, name="a"), ONE.shifted(z_m=0.1)]
    (first, second), (first_of_reversed, _) = nearest_sources(ONE, twins), nearest_sources(ONE, twins[::-1])
    assert {first, second} == {0, 1} and twins[first] == twins[::-1][first_of_reversed]


def test_frames_of_different_rigs_make_a_batch() -> None:
    config = small_config()
    close, apart = ring(4, radius_m=0.0, horizontal_fov_deg=120), ring(4, horizontal_fov_deg=120)
    frames = [frame_geometry([rig[0]], [rig[1], rig[3]], 0.0, config) for rig in (close, apart)]
    targets, sources = both = joined(frames)
    assert targets.rays.shape == (2, 1, 6, 6, 10) and sources.pose.shape == (2, 2, 16)
    assert [c.valid.shape[-2:] for c in targets.reads] == [(6, 10), (3, 5)]
    assert targets.reads[0].valid.shape[3] == 3 and frames[0][0].reads[0].valid.shape[3] == 1
    for k, frame in enumerate(frames):
        count = int(frame[0].reads[0].valid.sum())
        assert int(targets.reads[0].valid[k].sum()) == count > 0
    dropped = target_windows(both, torch.tensor([True, False]))
    assert not dropped[0].valid[0].any() and dropped[0].valid[1].any()
