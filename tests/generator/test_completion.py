"""Inference on a frame: known pixels stay, holes are filled and marked, the denoiser is called no more than needed."""

from __future__ import annotations

import copy
import pickle
import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.errors import GeneratorError, SampleError
from arbiview_aug.generator import Diffusion, Generator
from arbiview_aug.generator.config import AutoencoderConfig
from tests.generator.small import ring, small_config, stirred
from tests.helpers import assert_same_to_a_level

SOURCES = ring(4, horizontal_fov_deg=100)
TARGETS = ring(3, horizontal_fov_deg=110, yaw_deg=25, name="t", z_m=1.8)


def frame(targets: Rig = TARGETS, sources: Rig = SOURCES, seed: int = 0):
    """Smooth views with holes of a fifth on the right, coverage, and source images."""
    rng = torch.Generator().manual_seed(seed)

    def smooth(camera: Camera) -> torch.Tensor:
        coarse = 255 * torch.rand(1, 3, 3, 4, generator=rng)
        return torch.nn.functional.interpolate(coarse, camera.size, mode="bilinear")[0].to(torch.uint8)

    coverage = [torch.ones(c.size, dtype=torch.bool) for c in targets]
    for seen in coverage:
        seen[:, -seen.shape[1] // 5 :] = False
    views = [smooth(c) * seen for c, seen in zip(targets, coverage, strict=True)]
    return views, coverage, [smooth(c) for c in sources]


def completed(generator: Generator, targets: Rig = TARGETS, sources: Rig = SOURCES, **settings: object):
    views, coverage, images = frame(targets, sources)
    return generator.complete_views(views, coverage, targets, images, sources, **{"steps": 2, **settings})


@pytest.mark.parametrize("kind", ["uint8", "float32", "tensor"])
def test_known_pixels_stay_bit_for_bit_and_holes_are_marked(generator: Generator, kind: str) -> None:
    views, coverage, images = frame()
    if kind == "float32":
        views, images = [v / 255 for v in views], [v / 255 for v in images]
    given = torch.stack(views) if kind == "tensor" else views
    before = copy.deepcopy(given)
    seen = torch.stack(coverage) if kind == "tensor" else coverage
    out = generator.complete_views(given, seen, TARGETS, images, SOURCES, steps=2)
    assert out.images.dtype == views[0].dtype and out.images.shape == (3, 3, 48, 80)
    assert torch.equal(out.generated, ~torch.stack(coverage))
    known = torch.stack(coverage)[:, None].expand_as(out.images)
    assert torch.equal(out.images[known], torch.stack(views)[known])
    assert out.images[~known].float().std() > 0 and out.denoised == [0, 1, 2]
    top = 255 if kind != "float32" else 1
    assert out.images.min() >= 0 and out.images.max() <= top
    assert all(torch.equal(a, b) for a, b in zip(before, given, strict=True))


def test_complete_and_almost_complete_views_need_no_denoiser(generator: Generator) -> None:
    generator = copy.copy(generator)
    generator.calls = 0
    views, coverage, images = frame()
    coverage = [torch.ones_like(seen) for seen in coverage]
    out = generator.complete_views(views, coverage, TARGETS, images, SOURCES)
    assert generator.calls == 0 and not out.generated.any() and out.denoised == []
    assert torch.equal(out.images, torch.stack(views))
    coverage[1][:2, :9] = False  # 18 of 3840 pixels: 0.47 %
    out = generator.complete_views(views, coverage, TARGETS, images, SOURCES)
    assert generator.calls == 0 and torch.equal(out.generated, ~torch.stack(coverage))
    near = views[1][:, 2:4, :9].float().mean((1, 2), keepdim=True)
    assert (out.images[1][:, :2, :9].float() - near).abs().max() < 40  # inpainted from beside
    coverage[1][:2, :10] = False  # 20: 0.52 %
    out = generator.complete_views(views, coverage, TARGETS, images, SOURCES, steps=4)
    assert generator.calls == 4 and out.denoised == [1]


@pytest.mark.parametrize(("steps", "guidance", "calls"), [(1, 1.0, 1), (4, 1.0, 4), (10, 1.0, 10), (4, 7.5, 7)])
def test_calls_of_the_denoiser(generator: Generator, steps: int, guidance: float, calls: int) -> None:
    """All views together: as many calls as steps, twice with guidance, but the regression, which is the first."""
    before = generator.calls
    out = completed(generator, steps=steps, guidance=guidance)
    assert generator.calls - before == calls
    assert out.images.float().isfinite().all()


def test_the_result_depends_on_seed_frame_and_camera_alone(generator: Generator) -> None:
    base = completed(generator)
    torch.manual_seed(123)
    assert torch.equal(completed(generator).images, base.images)  # not on torch's RNG
    for other in ({"seed": 1}, {"frame": "b"}):
        assert not torch.equal(completed(generator, **other).images, base.images)
    order, source_order = [2, 0, 1], [3, 1, 0, 2]
    views, coverage, images = frame()
    moved = generator.complete_views(
        [views[k] for k in order], [coverage[k] for k in order], TARGETS.with_cameras([TARGETS[k] for k in order]),
        [images[k] for k in source_order], SOURCES.with_cameras([SOURCES[k] for k in source_order]), steps=2,
    )  # fmt: skip
    assert_same_to_a_level(moved.images, base.images[order])  # sums in another order


def test_confidence_decides_what_is_known(generator: Generator) -> None:
    views, coverage, images = frame()
    confidence = [torch.ones(seen.shape) for seen in coverage]
    for trust in confidence:
        trust[10:20, 10:30] = 0.2
    out = generator.complete_views(
        views, coverage, TARGETS, images, SOURCES, confidence=confidence, min_confidence=0.5, steps=1
    )
    expected = ~torch.stack(coverage)
    expected[:, 10:20, 10:30] = True
    assert torch.equal(out.generated, expected)
    kept = generator.complete_views(views, coverage, TARGETS, images, SOURCES, confidence=confidence, steps=1)
    assert torch.equal(kept.generated, ~torch.stack(coverage))


def test_the_own_car_is_not_generated(generator: Generator) -> None:
    mask = np.ones((48, 80), bool)
    mask[40:] = False
    targets = TARGETS.with_cameras([replace(c, mask=mask) for c in TARGETS])
    views, coverage, _ = frame(targets)
    out = completed(generator, targets)
    assert not out.generated[:, 40:].any() and out.generated[:, :40].any()
    assert torch.equal(out.images[:, :, 40:], torch.stack(views)[:, :, 40:])
    assert torch.equal(out.generated, ~torch.stack(coverage) & torch.from_numpy(mask))


def test_what_a_source_shows_of_its_own_car_is_not_read(generator: Generator) -> None:
    """Training has it black."""
    mask = np.ones((48, 80), bool)
    mask[32:] = False
    sources = SOURCES.with_cameras([replace(c, mask=mask) for c in SOURCES])
    views, coverage, images = frame()
    first = generator.complete_views(views, coverage, TARGETS, images, sources, steps=2)
    painted = [torch.where(torch.from_numpy(mask), image, 255 - image) for image in images]
    other = generator.complete_views(views, coverage, TARGETS, painted, sources, steps=2)
    assert torch.equal(first.images, other.images)


def test_generated_pixels_that_are_not_finite_are_refused(generator: Generator) -> None:
    """As bytes NaN would be 0: black, and marked as generated."""
    views, coverage, images = frame()
    broken = [torch.full_like(image, float("nan"), dtype=torch.float32) for image in images]
    with pytest.raises(GeneratorError, match=r"frame 7, camera 't0': expected finite pixels from generator 'test'"):
        generator.complete_views(views, coverage, TARGETS, broken, SOURCES, frame=7, steps=2)
    infinite = copy.deepcopy(generator)
    with torch.no_grad():
        infinite.denoiser.regression.bias.fill_(torch.inf)
    with pytest.raises(GeneratorError, match="got NaN or infinity"):
        completed(infinite, steps=1)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"guidance": float("nan")}, "guidance: expected a finite"),
        ({"steps": 9000}, "GeneratorConfig.steps: expected a whole number from 1 to 1000, got 9000"),
        ({"steps": 1}, "2, got 1"),
    ],
)
def test_an_inpainter_refuses_what_its_generator_cannot_do(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(GeneratorError, match=message):
        Diffusion(Generator.from_config(small_config(one_step=False)), **settings)


def test_guidance_of_one_step_is_refused() -> None:
    """It would change nothing."""
    made = Generator.from_config(small_config(steps=1, guidance=2.0))
    with pytest.raises(GeneratorError, match="expected no guidance with one step, which it cannot change, got 50"):
        Diffusion(made, guidance=50.0)
    for guidance in (None, 1, 2.0):
        Diffusion(made, guidance=guidance)


def test_views_of_other_sizes_and_lenses(generator: Generator) -> None:
    sources, waymo = load_rig("nuscenes").resized(0.1), load_rig("waymo").resized(0.08)
    out = completed(generator, waymo, sources)
    assert isinstance(out.images, list) and [tuple(i.shape[1:]) for i in out.images] == waymo.sizes
    views, coverage, _ = frame(waymo, sources)
    for image, view, seen, made in zip(out.images, views, coverage, out.generated, strict=True):
        assert torch.equal(image[:, seen], view[:, seen]) and torch.equal(made, ~seen)


def test_extremes_are_finite_in_bfloat16(generator: Generator) -> None:
    """One and twelve cameras, nothing covered at all, no source that looks there."""
    low = copy.deepcopy(generator).to(torch.bfloat16)
    for count in (1, 12):
        targets = ring(count, name="t", yaw_deg=3)
        views, coverage, images = frame(targets)
        views = [v / 255 for v in views]
        nothing = [torch.zeros_like(seen) for seen in coverage]
        out = low.complete_views(views, nothing, targets, [i / 255 for i in images], SOURCES, steps=2, guidance=7.5)
        assert out.generated.all() and torch.isfinite(out.images).all()
    behind = Rig([ring(1, horizontal_fov_deg=40)[0].turned(yaw_deg=180)])
    assert completed(low, ring(1, horizontal_fov_deg=40, name="t"), behind).images.float().isfinite().all()


def test_with_an_autoencoder(generator: Generator) -> None:
    vae = AutoencoderConfig(widths=(16, 16), layers=1, latent_channels=4, norm_groups=8)
    torch.manual_seed(0)
    made = Generator.from_config(small_config(autoencoder=vae, image_size=(12, 20))).eval()
    stirred(made.denoiser)
    out = completed(made)
    assert out.denoised == [0, 1, 2] and out.images.shape == (3, 3, 48, 80)
    with pytest.raises(GeneratorError, match="float16"):
        completed(made.half())


def test_messages(generator: Generator) -> None:
    views, coverage, images = frame()
    with pytest.raises(SampleError, match=r"'views': 2.*'target cameras': 3"):
        generator.complete_views(views[:2], coverage, TARGETS, images, SOURCES)
    with pytest.raises(SampleError, match="expected 4 source images, got 1"):
        generator.complete_views(views, coverage, TARGETS, images[:1], SOURCES)
    with pytest.raises(SampleError, match=r"camera 't1': expected a view \(3, h, w\), coverage and .* \(48, 80\)"):
        generator.complete_views([views[0], views[1][:, 1:], views[2]], coverage, TARGETS, images, SOURCES)
    with pytest.raises(SampleError, match=r"camera 't0': coverage: expected bool.*pass coverage > 0"):
        generator.complete_views(views, [c.float() for c in coverage], TARGETS, images, SOURCES)
    with pytest.raises(GeneratorError, match="steps: expected a whole number from 1 to 1000, got 0"):
        generator.complete_views(views, coverage, TARGETS, images, SOURCES, steps=0)
    small, permuted = [image[:, :32, :50] for image in images], [image.permute(1, 2, 0) for image in images]
    for maps, message in (
        ({"source_images": small}, r"camera '.*': expected a source image \(3, 48, 80\), got \(3, 32, 50\)"),
        ({"source_images": permuted}, r"expected a source image \(3, 48, 80\), got \(48, 80, 3\)"),
        ({"views": [view.int() for view in views]}, r"expected images of uint8, or of floats in \[0, 1\], got"),
        ({"confidence": torch.ones(3, 10, 10)}, r"camera 't0': .*, got .* and \(10, 10\)"),
        ({"confidence": torch.ones(2, 48, 80)}, "'confidence': 2"),
        ({"confidence": torch.full((3, 48, 80), 255.0)}, r"camera 't0': confidence: expected 0 to 1, got 255 to 255"),
        ({"confidence": torch.full((3, 48, 80), torch.nan)}, "confidence: expected 0 to 1, got nan to nan"),
        ({"views": [view.numpy() for view in views]}, "complete: expected tensors, got ndarray; pass torch.as_tensor"),
        ({"source_images": [image.numpy() for image in images]}, "expected tensors, got ndarray"),
        ({"min_confidence": "a"}, "min_confidence: expected a number from 0 to 1, got 'a'"),
    ):
        with pytest.raises(ValueError, match=message):
            given = {"views": views, "coverage": coverage, "source_images": images, **maps}
            generator.complete_views(targets=TARGETS, sources=SOURCES, **given)


def test_it_can_be_sent_to_workers(generator: Generator) -> None:
    again = pickle.loads(pickle.dumps(generator))
    assert torch.equal(completed(again).images, completed(generator).images)


def test_without_diffusers_the_install_command_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    """Calls that need diffusers say how to get it; ``test_imports`` tests that importing the package does not."""
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(ImportError, match=r"diffusers is not installed: pip install 'arbiview_aug\[generator\]'"):
        Generator.from_config(small_config())
    monkeypatch.setitem(sys.modules, "safetensors", None)
    monkeypatch.delitem(sys.modules, "safetensors.torch", raising=False)
    with pytest.raises(ImportError, match=r"safetensors is not installed: pip install 'arbiview_aug\[generator\]'"):
        Generator.from_pretrained("anywhere")
