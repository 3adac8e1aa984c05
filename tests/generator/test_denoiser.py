"""The denoiser: a plain U-Net until its attention is trained, shared weights, and who reads whom."""

from __future__ import annotations

import copy

import pytest
import torch
from diffusers import UNet2DConditionModel

from arbiview_aug.generator import Generator
from arbiview_aug.generator.attention import token_sizes
from arbiview_aug.generator.conditioning import FrameGeometry, ViewInputs, frame_geometry
from arbiview_aug.generator.denoiser import REGRESSION, Denoiser, Rows
from tests.generator.small import ring, small_config


def views(geometry: FrameGeometry, of: str, seed: int = 0, channels: int = 3) -> ViewInputs:
    rays = geometry.target_rays if of == "target" else geometry.source_rays
    b, n, _, h, w = rays.shape
    rng = torch.Generator().manual_seed(seed)
    latent = torch.randn(b, n, channels, h, w, generator=rng)
    make = geometry.target_views if of == "target" else geometry.source_views
    mask = torch.rand(b, n, h, w, generator=rng) < 0.7
    return make(latent, mask, mask * torch.rand(b, n, h, w, generator=rng))


def run(denoiser: Denoiser, geometry: FrameGeometry, t: int = 400, seed: int = 0, rows: list[Rows] | None = None):
    targets, sources = views(geometry, "target", seed), views(geometry, "source", seed + 1)
    noisy = torch.randn(targets.latent.shape, generator=torch.Generator().manual_seed(seed + 2))
    read = denoiser.read_sources(sources, geometry.source_windows())
    time = torch.full((len(noisy),), t)
    return denoiser(noisy, time, targets, geometry.target_windows(), read, rows)


@pytest.fixture
def geometry() -> FrameGeometry:
    sources = ring(4, horizontal_fov_deg=100)
    targets = ring(4, horizontal_fov_deg=120, yaw_deg=20, name="t")
    return frame_geometry(list(targets)[:2], list(sources), 0.0, small_config())


@pytest.mark.parametrize("size", [(6, 10), (5, 7), (3, 5)])
@pytest.mark.parametrize("checkpointing", [False, True])
def test_untrained_attention_leaves_the_plain_unet(size: tuple[int, int], checkpointing: bool) -> None:
    """Difference 0, also at odd sizes and under gradient checkpointing; the conditions enter by zero weights."""
    torch.manual_seed(0)
    config = small_config(image_size=size)
    plain = UNet2DConditionModel(**config.unet.arguments(3, 3))
    denoiser = Denoiser(copy.deepcopy(plain), config)
    denoiser.gradient_checkpointing = checkpointing
    geometry = frame_geometry(list(ring(3, name="t")), list(ring(3)), 0.0, config)
    targets = views(geometry, "target")
    noisy = torch.randn(targets.latent.shape)
    read = denoiser.read_sources(views(geometry, "source"), geometry.source_windows())
    got = denoiser(noisy, torch.tensor([400]), targets, geometry.target_windows(), read)
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


def test_targets_read_sources_and_targets(generator: Generator, geometry: FrameGeometry) -> None:
    denoiser, t = generator.denoiser, torch.tensor([400])
    targets, sources = views(geometry, "target"), views(geometry, "source", 1)
    noisy = torch.randn(targets.latent.shape, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        read = denoiser.read_sources(sources, geometry.source_windows())
        windows = geometry.target_windows()
        base = denoiser(noisy, t, targets, windows, read)
        other = sources._replace(latent=sources.latent + 1)
        changed = denoiser(noisy, t, targets, windows, denoiser.read_sources(other, geometry.source_windows()))
        assert (changed - base).abs().max() > 1e-3
        noisy_too = noisy.clone()
        noisy_too[:, 1] += 1
        beside = denoiser(noisy_too, t, targets, windows, read)
        assert (beside[:, 0] - base[:, 0]).abs().max() > 1e-3
        # Without sources, as classifier-free guidance has it, nothing of them is left.
        dropped = torch.tensor([True])
        alone = [
            denoiser(noisy, t, targets.dropped(dropped), geometry.target_windows(dropped), keys)
            for keys in (read, denoiser.read_sources(other, geometry.source_windows()))
        ]
        assert torch.equal(*alone)


def test_permuting_the_cameras_permutes_the_output(generator: Generator) -> None:
    sources, config = ring(4, horizontal_fov_deg=100), small_config()
    targets = ring(5, horizontal_fov_deg=100, yaw_deg=15, name="t")
    denoiser, t = generator.denoiser, torch.tensor([300])
    order, source_order = [4, 2, 0, 3, 1], [2, 3, 1, 0]
    base = frame_geometry(list(targets), list(sources), 0.0, config)
    moved = frame_geometry([targets[k] for k in order], [sources[k] for k in source_order], 0.0, config)
    of_targets, of_sources = views(base, "target"), views(base, "source", 1)
    noisy = torch.randn(of_targets.latent.shape, generator=torch.Generator().manual_seed(2))
    with torch.no_grad():
        read = denoiser.read_sources(of_sources, base.source_windows())
        expected = denoiser(noisy, t, of_targets, base.target_windows(), read)[:, order]
        of_sources = ViewInputs(*(value[:, source_order] for value in of_sources))
        of_targets = ViewInputs(*(value[:, order] for value in of_targets))
        assert torch.allclose(of_targets.pose, moved.target_pose)
        read = denoiser.read_sources(of_sources, moved.source_windows())
        got = denoiser(noisy[:, order], t, of_targets, moved.target_windows(), read)
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
        assert [w.valid.shape[-1] for w in geometry.target_windows()] == [h * w for h, w in token_sizes(size, 2)]
        with torch.no_grad():
            out = run(denoiser, geometry)
        assert out.shape == (1, count, 3, *size) and torch.isfinite(out).all()


def test_rows_for_the_geometric_loss(generator: Generator, geometry: FrameGeometry) -> None:
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
    targets = views(geometry, "target")
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
        read = denoiser.read_sources(views(geometry, "source"), geometry.source_windows())
        with torch.no_grad():
            v = denoiser(x, torch.tensor([t]), targets, geometry.target_windows(), read)
        return a * x - s * v

    share = (a * deviation) ** 2 / ((a * deviation) ** 2 + s**2)
    expected = targets.latent + share * (lacking + s / max(a, 1e-8) * eps)
    assert torch.allclose(x0_of(lacking), expected, atol=1e-3 if a > 1e-3 else 0.1)
    assert x0_of(torch.zeros_like(lacking)).isfinite().all()
