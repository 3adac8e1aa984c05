"""The reverse process: time steps, the solver, the start in between, guidance."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from arbiview_aug.generator.denoiser import REGRESSION
from arbiview_aug.generator.sampler import guided, noise_schedule, sample, timesteps
from tests.generator.small import small_config


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


def test_guidance() -> None:
    c, u = randn(0), randn(1)
    assert torch.allclose(guided(c, u, 1.0, 0.0), c)
    assert torch.allclose(guided(c, u, 3.0, 0.0), u + 3 * (c - u))
    strong = guided(c, u, 7.5, 1.0)  # each view has its conditional's deviation
    assert torch.allclose(strong.std((2, 3, 4)), c.std((2, 3, 4)), rtol=1e-4)
    assert torch.isfinite(guided(torch.zeros_like(c), torch.zeros_like(c), 7.5, 0.7)).all()
