"""From pre-filled latents to samples: the reverse process by DPM-Solver++ or DDIM, guidance, the start in between.

Both solvers are diffusers' ``DPMSolverMultistepScheduler``: of order 2 it is DPM-Solver++ (2M), of order 1 DDIM (Lu et
al. 2022, Sec. 4). ``DDIMScheduler`` itself only knows steps of equal whole length from t = 999 on, and ends at the
noise of t = 0 where they do not come out even: 4 grey levels in pixel space.

Time steps are spaced "trailing", t_k = round(T s (1 − k / steps)) − 1 with strength s: the first is the noise that is
added to the pre-filled latent, the last step ends at no noise at all. "Leading" spacing with one step would be t = 0.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal

import torch

from arbiview_aug.environment import optional_package
from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator.denoiser import REGRESSION, TIMESTEPS

Solver = Literal["dpm++", "ddim"]

Predict = Callable[[torch.Tensor, int], torch.Tensor]
"""(x_t (B, N, C, h, w) float32, t) to what the schedule predicts, or to x0 at t = ``REGRESSION``."""


def noise_schedule(*, prediction: str, zero_snr: bool, solver: Solver = "dpm++") -> Any:
    """Stable Diffusion's schedule (scaled linear, β from 0.00085 to 0.012, 1000 steps) with a solver.

    Args:
        prediction: ``epsilon`` or ``v_prediction``.
        zero_snr: Rescaled so that nothing of the image is left at t = 999 (Lin et al. 2023).
        solver: ``dpm++`` or ``ddim``.

    Raises:
        GeneratorError: Zero terminal SNR with ε: the first step would not be finite.
    """
    if zero_snr and prediction != "v_prediction":
        raise GeneratorError(
            f"zero_snr: expected prediction 'v_prediction', got {prediction!r}: ε holds no x0 at t = 999"
        )
    return optional_package("diffusers", "generator").DPMSolverMultistepScheduler(
        num_train_timesteps=TIMESTEPS,
        beta_start=0.00085,
        beta_end=0.012,
        beta_schedule="scaled_linear",
        prediction_type=prediction,
        rescale_betas_zero_snr=zero_snr,
        solver_order={"dpm++": 2, "ddim": 1}[solver],
        timestep_spacing="trailing",
    )


def timesteps(steps: int, strength: float) -> list[int]:
    """``steps`` times from T · strength − 1 down, trailing; fewer where there are not as many times."""
    start = TIMESTEPS * strength
    spaced = [round(start * (1 - k / steps)) - 1 for k in range(steps)]
    return sorted({t for t in spaced if t >= 0}, reverse=True) or [0]


def sample(
    predict: Predict,
    prefilled: torch.Tensor,
    noise: torch.Tensor,
    schedule: Any,
    *,
    steps: int,
    strength: float,
    temperature: float = 1.0,
    warm: bool = False,
) -> torch.Tensor:
    """x0 (B, N, C, h, w) float32.

    Args:
        predict: The denoiser with its conditions.
        prefilled: (B, N, C, h, w) where to start from.
        noise: Likewise, standard normal.
        schedule: From ``noise_schedule``; its state is used up.
        steps: 1 is the one-step regression: neither noise nor schedule. More are so many calls of ``predict``.
        strength: In (0, 1]: how much of the diffusion the pre-filled latent is put back; 0.6 starts at t = 599.
        temperature: What the noise is multiplied by.
        warm: The first step is the regression, and what it gives is put back instead.
    """
    prefilled = prefilled.float()
    if steps == 1 or warm:
        prefilled = predict(prefilled, REGRESSION).float()
    if steps == 1:
        return prefilled
    schedule.set_timesteps(timesteps=timesteps(steps - warm, strength))
    schedule.set_begin_index(0)
    times = schedule.timesteps.tolist()
    x = schedule.add_noise(prefilled, temperature * noise.float(), torch.tensor(times[:1]))
    for t in times:
        x = schedule.step(predict(x, t).float(), t, x, return_dict=False)[0]
    return x


def guided(conditional: torch.Tensor, unconditional: torch.Tensor, guidance: float, rescale: float) -> torch.Tensor:
    """Classifier-free guidance u + g (c − u), rescaled to the conditional's deviation (Lin et al. 2023, Sec. 3.4).

    Args:
        conditional: (B, N, C, h, w) with conditions.
        unconditional: Likewise without.
        guidance: g; 1 is no guidance.
        rescale: φ in [0, 1]: 0.7 keeps strong guidance from overexposing.
    """
    mixed = unconditional + guidance * (conditional - unconditional)
    each = (2, 3, 4)
    scaled = mixed * (conditional.std(each, keepdim=True) / mixed.std(each, keepdim=True).clamp(min=1e-6))
    return rescale * scaled + (1 - rescale) * mixed
