"""The reverse process: time steps, the solver, the start in between, guidance."""

from __future__ import annotations

import pytest
import torch

from arbiview_aug.generator.denoiser import REGRESSION
from arbiview_aug.generator.sampler import guided, noise_schedule, sample, timesteps


def randn(seed: int) -> torch.Tensor:
    return torch.randn(1, 2, 4, 5, 6, generator=torch.Generator().manual_seed(seed))


def schedule(prediction: str = "v_prediction"):
    return noise_schedule(prediction=prediction, zero_snr=prediction == "v_prediction")


def test_time_steps_are_trailing() -> None:
    assert timesteps(4, 1.0) == [999, 749, 499, 249]
    assert timesteps(4, 0.6) == [599, 449, 299, 149]
    assert timesteps(1, 1.0) == [999]  # "leading" would be 0
    assert timesteps(50, 0.6)[:2] == [599, 587] and len(timesteps(50, 0.6)) == 50
    assert timesteps(50, 0.01) == list(range(9, -1, -1))  # no time twice
    assert timesteps(4, 1e-9) == [0]


@pytest.mark.parametrize("prediction", ["v_prediction", "epsilon"])
@pytest.mark.parametrize(("steps", "strength"), [(2, 1.0), (4, 0.6), (10, 1.0), (50, 0.6), (4, 0.001)])
def test_a_perfect_denoiser_gives_the_image_back(prediction: str, steps: int, strength: float) -> None:
    """x0 comes out exactly, whatever the start; also from t = 999, where nothing of it is left in v's schedule."""
    x0, noise = randn(0), randn(1)
    plan = schedule(prediction)
    alphas = plan.alphas_cumprod.double()
    seen: list[int] = []

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        seen.append(t)
        a, s = alphas[t].sqrt(), (1 - alphas[t]).sqrt()
        eps = (x.double() - a * x0) / s
        return (eps if prediction == "epsilon" else a * eps - s * x0).float()

    got = sample(predict, x0 + 0.3 * randn(2), noise, plan, steps=steps, strength=strength)
    assert torch.allclose(got, x0, atol=5e-3)
    assert seen == timesteps(steps, strength)


def test_the_start_is_the_prefilled_latent_with_noise() -> None:
    plan, starts = schedule(), []
    sample(lambda x, t: starts.append((t, x)) or torch.zeros_like(x), randn(0), randn(1), plan, steps=4, strength=0.6)
    a = plan.alphas_cumprod[599]
    assert starts[0][0] == 599
    assert torch.allclose(starts[0][1], a.sqrt() * randn(0) + (1 - a).sqrt() * randn(1), atol=1e-5)


def test_one_step_is_the_regression() -> None:
    calls = []

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        calls.append(t)
        return x + 1

    assert torch.equal(sample(predict, randn(0), randn(1), schedule(), steps=1, strength=0.6), randn(0) + 1)
    assert calls == [REGRESSION]


def test_a_warm_start_is_the_regressions_result_and_one_of_the_steps() -> None:
    starts = []

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        starts.append((t, x))
        return x + 1 if t == REGRESSION else torch.zeros_like(x)

    plan = schedule()
    sample(predict, randn(0), randn(1), plan, steps=4, strength=0.6, temperature=0.5, warm_start=True)
    a = plan.alphas_cumprod[599]
    assert [t for t, _ in starts] == [REGRESSION, *timesteps(3, 0.6)]
    assert torch.allclose(starts[1][1], a.sqrt() * (randn(0) + 1) + 0.5 * (1 - a).sqrt() * randn(1), atol=1e-5)


def test_extreme_predictions_stay_finite() -> None:
    for value in (0.0, 1e4, -1e4):
        for prediction in ("v_prediction", "epsilon"):
            x = sample(lambda x, t, v=value: torch.full_like(x, v), randn(0), randn(1), schedule(prediction),
                       steps=4, strength=1.0)  # fmt: skip
            assert torch.isfinite(x).all()


def test_guidance() -> None:
    c, u = randn(0), randn(1)
    assert torch.allclose(guided(c, u, 1.0, 0.0), c)
    assert torch.allclose(guided(c, u, 3.0, 0.0), u + 3 * (c - u))
    strong = guided(c, u, 7.5, 1.0)
    assert torch.allclose(
        strong.std((2, 3, 4)), c.std((2, 3, 4)), rtol=1e-4
    )  # each view has its conditional's deviation
    assert torch.isfinite(guided(torch.zeros_like(c), torch.zeros_like(c), 7.5, 0.7)).all()
