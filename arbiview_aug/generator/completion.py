"""Sampling of target views from their conditions (Sec. CVC-SSL; appendix: The Multi-Branch U-Net).

The reverse process is DPM-Solver++ (2M) (Lu et al. 2022), diffusers' ``DPMSolverMultistepScheduler`` of order 2, from
noised pre-filled latents. Time steps are spaced "trailing", t_k = round(T s (1 − k / steps)) − 1 with strength s: the
first is the noise added to the pre-filled latent, and the last step ends without noise. "Leading" spacing with one step
would be t = 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator.conditioning import FrameGeometry, ViewInputs
from arbiview_aug.generator.config import TIMESTEPS, GeneratorConfig
from arbiview_aug.generator.correspondence import TokenWindow
from arbiview_aug.generator.denoiser import REGRESSION, Autoencoder, noise_schedule
from arbiview_aug.generator.generator import Generator

Predict = Callable[[torch.Tensor, int], torch.Tensor]  # maps (x_t, t) to the prediction, or to x0 at ``REGRESSION``


class Conditions(NamedTuple):
    """Inputs of the generator for N targets and S sources of B frames, at its image size."""

    prefilled: torch.Tensor  # (B, N, 3, H, W) in [0, 1], FAVS at the targets with holes inpainted
    known: torch.Tensor  # (B, N, H, W) bool, or shares in [0, 1]
    confidence: torch.Tensor  # (B, N, H, W) in [0, 1]
    sources: torch.Tensor  # (B, S, 3, H, W) in [0, 1], read where they are seen
    seen: torch.Tensor  # (B, S, H, W) valid pixels of the sources, bool, or 0 and 1

    def encoded(
        self, config: GeneratorConfig, autoencoder: Autoencoder, geometry: FrameGeometry
    ) -> tuple[ViewInputs, ViewInputs]:
        """The denoiser's conditions of the targets and of the sources."""
        latent = autoencoder.encode(shown_condition(config, self.prefilled, self.known)).float()
        sources = autoencoder.encode(self.sources * self.seen[:, :, None]).float()
        targets = geometry.target_views(latent, self.known, self.confidence)
        return targets, geometry.source_views(sources, self.seen, self.seen)


def with_sampling(config: GeneratorConfig, steps: int | None, guidance: float | None) -> GeneratorConfig:
    """The config with steps and guidance where given; GeneratorError where its generator cannot sample so."""
    own = config.guidance
    steps, guidance = config.steps if steps is None else steps, own if guidance is None else guidance
    config = replace(config, steps=steps, guidance=guidance)
    if config.steps == 1 and not config.one_step:
        why = f"the one-step regression of generator {config.name!r} was not trained (loss.regression=0)"
        raise GeneratorError(f"steps: expected at least 2, got 1: {why}")
    if config.steps == 1 and guidance not in (1, own):
        raise GeneratorError(f"guidance: expected none with one step, which it cannot change, got {guidance}")
    return config


def denoised(
    generator: Generator,
    config: GeneratorConfig,
    geometry: FrameGeometry,
    conditions: Conditions,
    noise: torch.Tensor,
) -> torch.Tensor:
    """Sample the N targets of B frames from noise (B, N, C, h, w): (B, N, 3, H, W) float32, not yet cut to [0, 1].

    ``config`` may differ from the generator's in ``steps`` and ``guidance``.
    """
    denoiser, autoencoder = generator.denoiser, generator.autoencoder
    views, source_views = conditions.encoded(config, autoencoder, geometry)
    sources = denoiser.read_sources(source_views, geometry.source_windows())
    windows = geometry.target_windows()
    all_frames = torch.ones(len(noise), dtype=torch.bool, device=noise.device)
    is_guided = config.guidance != 1 and config.steps > 1
    unconditional = (views.dropped(all_frames), geometry.target_windows(all_frames)) if is_guided else None

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        def run(views: ViewInputs, windows: Sequence[TokenWindow]) -> torch.Tensor:
            generator.calls += 1
            return denoiser(x, torch.full((len(x),), t, device=x.device), views, windows, sources).float()

        conditional = run(views, windows)
        if unconditional is None or t == REGRESSION:
            return conditional
        return guided(conditional, run(*unconditional), config.guidance, config.guidance_rescale)

    starts_inpainted = not (config.prefilled or config.residual or config.steps == 1)
    start = autoencoder.encode(conditions.prefilled) if starts_inpainted else views.latent
    return autoencoder.decode(sample(predict, start, noise, config)).float()


def shown_condition(config: GeneratorConfig, prefilled: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """The condition (..., 3, H, W) as in training: inpainted, or with grey holes if the config is not ``prefilled``."""
    return prefilled if config.prefilled else torch.where(known[..., None, :, :] >= 0.5, prefilled, 0.5)


def unit(image: torch.Tensor) -> torch.Tensor:
    """An image, uint8 or in [0, 1], as float32 in [0, 1]."""
    return image.float() / 255 if image.dtype == torch.uint8 else image.float()


def valid_pixels(camera: Camera) -> torch.Tensor:
    """(H, W) bool: True on the scene, False on the camera's own car."""
    return torch.ones(camera.size, dtype=torch.bool) if camera.mask is None else torch.tensor(camera.mask)


# --- the reverse process ----------------------------------------------------------------------------------------------
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
