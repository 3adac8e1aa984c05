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
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator import Diffusion, Generator, load_inpainter
from arbiview_aug.generator.completion import sample, timesteps
from arbiview_aug.generator.denoiser import REGRESSION, noise_schedule
from arbiview_aug.render.rendered import Views
from arbiview_aug.sample.frame import Frame
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.generator.small import ring, small_config
from tests.helpers import assert_same_to_a_level

SOURCES = ring(4, horizontal_fov_deg=100)
TARGETS = ring(3, horizontal_fov_deg=110, yaw_deg=25, name="t", z_m=1.8)


def rendered(targets: Rig = TARGETS, sources: Rig = SOURCES) -> tuple[Views, Frame]:
    """Smooth views with holes of a fifth on the right, and source images."""
    rng = torch.Generator().manual_seed(0)

    def smooth(camera: Camera) -> torch.Tensor:
        coarse = 255 * torch.rand(1, 3, 3, 4, generator=rng)
        return torch.nn.functional.interpolate(coarse, camera.size, mode="bilinear")[0].to(torch.uint8)

    coverage = [torch.ones(c.size, dtype=torch.bool) for c in targets]
    for seen in coverage:
        seen[:, -seen.shape[1] // 5 :] = False
    views = [smooth(c) * seen for c, seen in zip(targets, coverage, strict=True)]
    source = Frame(tuple(smooth(c) for c in sources), sources, further={"token": "a"})
    return Views(views, targets, coverage), source


def filled(generator: Generator, frame: Views, source: Frame, **settings: Any) -> Views:
    return Diffusion(generator, **{"steps": 2, **settings}).fill([frame], [source])[0]


def completed(generator: Generator, targets: Rig = TARGETS, sources: Rig = SOURCES, **settings: Any) -> Views:
    return filled(generator, *rendered(targets, sources), **settings)


@pytest.mark.parametrize("is_float", [False, True])
def test_known_pixels_stay_bit_for_bit_and_holes_are_marked(generator: Generator, is_float: bool) -> None:
    frame, source = rendered()
    if is_float:
        frame = replace(frame, images=[view / 255 for view in frame.images])
        source = replace(source, images=tuple(image / 255 for image in source.images))
    before = copy.deepcopy(frame.images)
    out = filled(generator, frame, source)
    for view, given, image, seen, made in zip(
        frame.images, before, out.images, frame.coverage, out.generated, strict=True
    ):
        assert image.dtype == view.dtype and torch.equal(made, ~seen) and torch.equal(view, given)
        assert torch.equal(image[:, seen], view[:, seen]) and image[:, ~seen].float().std() > 0
        assert image.min() >= 0 and image.max() <= (1 if is_float else 255)


def test_complete_and_almost_complete_views_need_no_denoiser(generator: Generator) -> None:
    generator = copy.copy(generator)
    frame, source = rendered()
    coverage = [torch.ones_like(seen) for seen in frame.coverage]
    for holes, steps, calls in ((0, 2, 0), (9, 2, 0), (10, 4, 4)):  # of 3840 pixels: none, 0.47 % and 0.52 %
        coverage[1][:2, :holes] = False
        generator.calls = 0
        out = filled(generator, replace(frame, coverage=coverage), source, steps=steps)
        assert generator.calls == calls and torch.equal(out.generated, ~torch.stack(coverage))
        assert torch.equal(out.images[0], frame.images[0])
        if holes == 9:
            near = frame.images[1][:, 2:4, :9].float().mean((1, 2), keepdim=True)
            assert (out.images[1][:, :2, :9].float() - near).abs().max() < 40  # inpainted from around


@pytest.mark.parametrize(("steps", "guidance", "calls"), [(1, 1.0, 1), (4, 1.0, 4), (4, 7.5, 7)])
def test_calls_of_the_denoiser(generator: Generator, steps: int, guidance: float, calls: int) -> None:
    """All views together: as many calls as steps, twice with guidance, but the regression, which is the first."""
    before = generator.calls
    out = completed(generator, steps=steps, guidance=guidance)
    assert generator.calls - before == calls
    assert all(image.float().isfinite().all() for image in out.images)


def test_the_result_depends_on_seed_frame_and_camera_alone(generator: Generator) -> None:
    base = completed(generator)
    torch.manual_seed(123)
    assert all(map(torch.equal, completed(generator).images, base.images))  # not on torch's RNG
    assert not torch.equal(completed(generator, seed=1).images[0], base.images[0])
    frame, source = rendered()
    other = filled(generator, frame, replace(source, further={"token": "b"}))
    assert not torch.equal(other.images[0], base.images[0])
    order = [3, 1, 0, 2]
    moved = replace(
        source, images=tuple(source.images[k] for k in order), rig=SOURCES.with_cameras([SOURCES[k] for k in order])
    )
    found = filled(pickle.loads(pickle.dumps(generator)), frame, moved)  # sums in another order
    assert_same_to_a_level(torch.stack(found.images), torch.stack(base.images))


def test_the_own_cars_are_neither_generated_nor_read(generator: Generator) -> None:
    """Training has them black."""
    mask = np.ones((48, 80), bool)
    mask[40:] = False
    targets, sources = (rig.with_cameras([replace(c, mask=mask) for c in rig]) for rig in (TARGETS, SOURCES))
    frame, source = rendered(targets, sources)
    out = filled(generator, frame, source)
    assert torch.equal(out.generated, ~torch.stack(list(frame.coverage)) & torch.from_numpy(mask))
    assert all(torch.equal(a[:, 40:], b[:, 40:]) for a, b in zip(out.images, frame.images, strict=True))
    painted = tuple(torch.where(torch.from_numpy(mask), image, 255 - image) for image in source.images)
    other = filled(generator, frame, replace(source, images=painted))
    assert all(map(torch.equal, out.images, other.images))


def test_generated_pixels_that_are_not_finite_are_refused(generator: Generator) -> None:
    """As bytes NaN would be 0: black, and marked as generated."""
    frame, source = rendered()
    broken = replace(source, images=tuple(torch.full(i.shape, torch.nan) for i in source.images))
    with pytest.raises(GeneratorError, match=r"frame a, camera 't0': expected finite pixels from generator 'test'"):
        filled(generator, frame, broken)


@pytest.mark.parametrize(
    ("made", "settings", "message"),
    [
        ({"one_step": False}, {"guidance": float("nan")}, "guidance: expected a finite"),
        ({"one_step": False}, {"steps": 9000}, "GeneratorConfig.steps: expected a whole number from 1 to 1000, got 90"),
        ({"one_step": False}, {"steps": 1}, "got 1: the one-step regression of generator 'test' was not trained"),
        ({"steps": 1, "guidance": 2.0}, {"guidance": 50.0}, "expected none with one step, which it cannot change"),
    ],
)
def test_an_inpainter_refuses_what_its_generator_cannot_do(made: Any, settings: Any, message: str) -> None:
    generator = Generator.from_config(small_config(**made))
    with pytest.raises(GeneratorError, match=message):
        Diffusion(generator, **settings)
    Diffusion(generator, guidance=made.get("guidance"))


def test_extremes_are_finite_in_bfloat16(generator: Generator) -> None:
    """One and twelve cameras, nothing covered at all, no source that looks there."""
    low = copy.deepcopy(generator).to(torch.bfloat16)
    for count in (1, 12):
        frame, source = rendered(ring(count, name="t", yaw_deg=3))
        nothing = [torch.zeros_like(seen) for seen in frame.coverage]
        frame = replace(frame, images=[view / 255 for view in frame.images], coverage=nothing)
        out = filled(low, frame, source, guidance=7.5)
        assert all(made.all() for made in out.generated) and all(image.isfinite().all() for image in out.images)
    behind = Rig([ring(1, horizontal_fov_deg=40)[0].turned(yaw_deg=180)])
    assert completed(low, ring(1, horizontal_fov_deg=40, name="t"), behind).images[0].float().isfinite().all()


def test_without_diffusers_the_install_command_is_given(monkeypatch: pytest.MonkeyPatch) -> None:
    for package, needed in (("diffusers", lambda: Generator.from_config(small_config())),
                            ("safetensors", lambda: Generator.from_pretrained("anywhere"))):  # fmt: skip
        monkeypatch.setitem(sys.modules, package, None)
        monkeypatch.delitem(sys.modules, f"{package}.torch", raising=False)
        with pytest.raises(ImportError, match=rf"{package} is not installed: pip install 'arbiview_aug\[generator\]'"):
            needed()


def test_a_generator_is_asked_for() -> None:
    for make in (Diffusion, lambda: RigRetarget("waymo", holes="diffusion"), lambda: load_inpainter(None)):
        with pytest.raises(GeneratorError, match="expected a generator or its folder, got none: python -m"):
            make()


def randn(seed: int) -> torch.Tensor:
    return torch.randn(1, 2, 4, 5, 6, generator=torch.Generator().manual_seed(seed))


def config(prediction: str = "v_prediction", residual: bool = False, **settings: Any) -> Any:
    is_v = prediction == "v_prediction"
    return small_config(prediction=prediction, zero_snr=is_v, residual=residual, **{"temperature": 1.0, **settings})


def test_time_steps_are_trailing() -> None:
    assert timesteps(4, 1.0) == [999, 749, 499, 249]
    assert timesteps(4, 0.6) == [599, 449, 299, 149]
    assert timesteps(1, 1.0) == [999]  # "leading" would be 0
    assert timesteps(50, 0.6)[:2] == [599, 587] and len(timesteps(50, 0.6)) == 50
    assert timesteps(50, 0.01) == list(range(9, -1, -1))  # no time twice
    assert timesteps(4, 1e-9) == [0]


@pytest.mark.parametrize("prediction", ["v_prediction", "epsilon"])
@pytest.mark.parametrize(("steps", "strength"), [(2, 1.0), (4, 0.6), (50, 0.6), (4, 0.001)])
def test_a_perfect_denoiser_gives_the_image_back(prediction: str, steps: int, strength: float) -> None:
    """x0 comes out exactly, whatever the start; also from t = 999, where nothing of it is left in v's schedule."""
    x0, noise, settings = randn(0), randn(1), config(prediction, steps=steps, strength=strength)
    alphas = noise_schedule(settings).alphas_cumprod.double()
    seen: list[int] = []

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        seen.append(t)
        a, s = alphas[t].sqrt(), (1 - alphas[t]).sqrt()
        eps = (x.double() - a * x0) / s
        return (eps if prediction == "epsilon" else a * eps - s * x0).float()

    got = sample(predict, x0 + 0.3 * randn(2), noise, settings)
    assert torch.allclose(got, x0, atol=5e-3)
    assert seen == timesteps(steps, strength)


@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("steps", [1, 4])
def test_the_start_is_the_prefilled_latent_or_the_regressions_result_with_noise(residual: bool, steps: int) -> None:
    calls: list[tuple[int, torch.Tensor]] = []

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        calls.append((t, x))
        return x + 1 if t == REGRESSION else torch.zeros_like(x)

    settings = config(residual=residual, steps=steps, strength=0.6, temperature=0.5)
    out = sample(predict, randn(0), randn(1), settings)
    is_regression = residual or steps == 1
    assert [t for t, _ in calls] == [REGRESSION] * is_regression + (timesteps(4 - residual, 0.6) if steps > 1 else [])
    start = randn(0) + is_regression
    if steps == 1:
        assert torch.equal(out, start)
    else:
        a = noise_schedule(settings).alphas_cumprod[599]
        assert torch.allclose(calls[int(residual)][1], a.sqrt() * start + 0.5 * (1 - a).sqrt() * randn(1), atol=1e-5)
