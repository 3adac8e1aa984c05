"""The reverse process (appendix: Latent Diffusion Models): DPM-Solver++ from noised pre-filled latents, and guidance.

Diffusers' ``DPMSolverMultistepScheduler`` of order 2 is DPM-Solver++ (2M) (Lu et al. 2022). Time steps are spaced
"trailing", t_k = round(T s (1 − k / steps)) − 1 with strength s: the first is the noise added to the pre-filled latent,
and the last step ends without noise. "Leading" spacing with one step would be t = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from arbiview_aug.environment import optional_package
from arbiview_aug.generator.config import TIMESTEPS, GeneratorConfig
from arbiview_aug.generator.denoiser import REGRESSION

Predict = Callable[[torch.Tensor, int], torch.Tensor]  # maps (x_t, t) to the prediction, or to x0 at ``REGRESSION``


def noise_schedule(config: GeneratorConfig) -> Any:
    """Stable Diffusion's schedule (scaled linear, β from 0.00085 to 0.012, 1000 steps).

    ``zero_snr`` rescales it to zero terminal SNR (Lin et al. 2023).
    """
    return optional_package("diffusers", "generator").DPMSolverMultistepScheduler(
        num_train_timesteps=TIMESTEPS,
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        prediction_type=config.prediction,
        rescale_betas_zero_snr=config.zero_snr,
        timestep_spacing="trailing",
    )


def timesteps(steps: int, strength: float) -> list[int]:
    """At most ``steps`` times from T · strength − 1 down, with trailing spacing; no time twice."""
    spaced = [round(TIMESTEPS * strength * (1 - k / steps)) - 1 for k in range(steps)]
    return sorted({t for t in spaced if t >= 0}, reverse=True) or [0]


def sample(predict: Predict, prefilled: torch.Tensor, noise: torch.Tensor, config: GeneratorConfig) -> torch.Tensor:
    """Sample x0 (B, N, C, h, w) float32 from pre-filled latents and standard normal noise of that shape.

    ``predict``, the denoiser with its conditions, is called once per step. A single step is the one-step regression,
    without noise. A ``residual`` generator's first step is the regression too, whose result is then noised.
    """
    prefilled = prefilled.float()
    if config.steps == 1 or config.residual:
        prefilled = predict(prefilled, REGRESSION).float()
    if config.steps == 1:
        return prefilled
    schedule = noise_schedule(config)
    schedule.set_timesteps(timesteps=timesteps(config.steps - config.residual, config.strength))
    schedule.set_begin_index(0)
    times = schedule.timesteps.tolist()
    x = schedule.add_noise(prefilled, config.temperature * noise.float(), torch.tensor(times[:1]))
    for t in times:
        x = schedule.step(predict(x, t).float(), t, x, return_dict=False)[0]
    return x


def guided(conditional: torch.Tensor, unconditional: torch.Tensor, guidance: float, rescale: float) -> torch.Tensor:
    """Classifier-free guidance u + g (c − u) of (B, N, C, h, w), rescaled to the deviation of c by φ = ``rescale``.

    Lin et al. 2023, Sec. 3.4: φ = 0.7 keeps strong guidance from overexposing.
    """
    mixed = unconditional + guidance * (conditional - unconditional)
    deviation, mixed_deviation = (x.std((2, 3, 4), keepdim=True) for x in (conditional, mixed))
    scaled = mixed * (deviation / mixed_deviation.clamp(min=1e-6))
    return rescale * scaled + (1 - rescale) * mixed
