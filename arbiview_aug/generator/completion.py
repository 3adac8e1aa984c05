"""Completion of views by a generator: its sampling (Sec. CVC-SSL), and the ``Diffusion`` that fills frames by it.

The reverse process is DPM-Solver++ (2M) (Lu et al. 2022), diffusers' ``DPMSolverMultistepScheduler`` of order 2, from
noised pre-filled latents. Time steps are spaced "trailing", t_k = round(T s (1 − k / steps)) − 1 with strength s: the
first is the noise added to the pre-filled latent, and the last step ends without noise. "Leading" spacing with one step
would be t = 0.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch.nn import functional
from torch.utils._pytree import tree_map

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator.attention import TokenWindow, joined
from arbiview_aug.generator.conditioning import Branches, ViewInputs, frame_geometry, nearest_sources
from arbiview_aug.generator.config import TIMESTEPS, GeneratorConfig
from arbiview_aug.generator.denoiser import REGRESSION, Autoencoder, noise_schedule
from arbiview_aug.generator.generator import Generator
from arbiview_aug.image_ops import resized
from arbiview_aug.inpaint.continued import Continue
from arbiview_aug.inpaint.inpainter import (
    Inpainter,
    Tensors,
    check_device,
    checked_settings,
    frame_names,
    holes_of,
    put,
    seeded,
)
from arbiview_aug.inpaint.networks import NetworkInpainter, PipelineInpainter, TorchScriptInpainter
from arbiview_aug.render.rendered import Views
from arbiview_aug.sample.frame import Frame

Predict = Callable[[torch.Tensor, int], torch.Tensor]  # maps (x_t, t) to the prediction, or to x0 at ``REGRESSION``


def encoded(
    config: GeneratorConfig, autoencoder: Autoencoder, targets: Branches, sources: Branches
) -> tuple[ViewInputs, ViewInputs]:
    """The denoiser's conditions of the targets and of the sources."""
    shown, seen = shown_condition(config, targets), sources.images * sources.known[:, :, None]
    return targets.inputs(autoencoder.encode(shown).float()), sources.inputs(autoencoder.encode(seen).float())


def denoised(
    generator: Generator, config: GeneratorConfig, targets: Branches, sources: Branches, noise: torch.Tensor
) -> torch.Tensor:
    """Sample the N targets of B frames from noise (B, N, C, h, w): (B, N, 3, H, W) float32, not yet cut to [0, 1].

    ``config`` may differ from the generator's in ``steps`` and ``guidance``.
    """
    denoiser, autoencoder = generator.denoiser, generator.autoencoder
    views, source_views = encoded(config, autoencoder, targets, sources)
    keys = denoiser.read_sources(source_views, sources.geometry.windows())
    count = sources.images.shape[1]
    windows = targets.geometry.windows(count)
    all_frames = torch.ones(len(noise), dtype=torch.bool, device=noise.device)
    is_guided = config.guidance != 1 and config.steps > 1
    unconditional = (views.dropped(all_frames), targets.geometry.windows(count, all_frames)) if is_guided else None

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        def run(views: ViewInputs, windows: Sequence[TokenWindow]) -> torch.Tensor:
            generator.calls += 1
            return denoiser(x, torch.full((len(x),), t, device=x.device), views, windows, keys).float()

        conditional = run(views, windows)
        if unconditional is None or t == REGRESSION:
            return conditional
        without = run(*unconditional)
        return without + config.guidance * (conditional - without)

    starts_inpainted = not (config.prefilled or config.residual or config.steps == 1)
    start = autoencoder.encode(targets.images) if starts_inpainted else views.latent
    return autoencoder.decode(sample(predict, start, noise, config)).float()


def shown_condition(config: GeneratorConfig, targets: Branches) -> torch.Tensor:
    """The condition (B, N, 3, H, W) as in training: with filled holes, or grey ones if not ``prefilled``."""
    return targets.images if config.prefilled else torch.where(targets.known[:, :, None] >= 0.5, targets.images, 0.5)


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


# --- frames -----------------------------------------------------------------------------------------------------------
ALMOST_COMPLETE = 0.995  # share of known pixels from which a view is inpainted: only a seam is left
VIEWS_AT_ONCE = 24  # views that the denoiser sees in one call; a whole frame in any case

_Inputs = tuple[Branches, Branches, torch.Tensor]  # targets, sources, noise
_HUB_ID = re.compile(r"\w[\w.-]*/[\w.-]+")


class Diffusion(Inpainter, torch.nn.Module):
    """Fills holes by a generator, which sees all views and sources of a frame (Sec. CVC-SSL).

    On a GPU it needs ``num_workers=0``, or ``complete_batch`` after collating.

    Args:
        generator: A generator, or the folder of one, which ``python -m arbiview_aug train`` makes.
        steps: Denoising steps, from 1 (regression) on; the generator's default if None.
        guidance: Classifier-free guidance, 1 for none; the generator's default if None.
        min_confidence: As for every ``Inpainter``, like ``seed``.

    Raises:
        ValueError: Impossible settings.
        GeneratorError: No generator; steps or guidance that it cannot sample with.
    """

    outcome = "made up by the generator"
    is_random = True
    needs_layers = True
    needs_confidence = True

    def __init__(
        self,
        generator: Generator | str | Path | None = None,
        *,
        steps: int | None = None,
        guidance: float | None = None,
        min_confidence: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.min_confidence, self.seed = checked_settings(min_confidence, seed, steps, guidance)
        if generator is None:
            fix = "python -m arbiview_aug train trains one on your frames (docs/holes.md); holes='continue' needs none"
            raise GeneratorError(f"Diffusion: expected a generator or its folder, got none: {fix}")
        if not isinstance(generator, Generator | str | Path):
            raise ValueError(f"generator: expected a Generator or its folder, got {type(generator).__name__}")
        self.generator = generator if isinstance(generator, Generator) else Generator.from_pretrained(generator)
        given = self.generator.config
        steps, guidance = given.steps if steps is None else steps, given.guidance if guidance is None else guidance
        self.config = replace(given, steps=steps, guidance=guidance)
        if steps == 1 and not given.one_step:
            why = f"the one-step regression of generator {given.name!r} was not trained (loss.regression=0)"
            raise GeneratorError(f"steps: expected at least 2, got 1: {why}")
        if steps == 1 and guidance not in (1, given.guidance):
            raise GeneratorError(f"guidance: expected none with one step, which it cannot change, got {guidance}")

    def train(self, mode: bool = True) -> Diffusion:
        """Leave the generator in evaluation mode: a transform in a model that trains still fills holes."""
        super().train(mode)
        self.generator.eval()
        return self

    @torch.no_grad()
    def fill(self, rendered: Sequence[Views], frames: Sequence[Frame]) -> list[Views]:
        """Fill rendered frames; ``frames`` hold their source images.

        All views are filled as by default (``Continue``); those that are almost complete stay so. The others of a frame
        are denoised together, so that they agree. Frames with as many views and sources share the denoiser's calls.
        GeneratorError for generated pixels that are not finite.
        """
        check_device(self.generator)
        names, device = frame_names(frames), self.generator.device
        images, holes = [list[torch.Tensor]() for _ in frames], [list[torch.Tensor]() for _ in frames]
        alike: dict[tuple[int, int], list[tuple[int, list[int], _Inputs]]] = {}
        for n, (views, frame, name) in enumerate(zip(rendered, frames, names, strict=True)):
            known, holes[n] = holes_of(views, self.min_confidence)
            copied = [image.clone() for image in views.images]
            images[n] = list(Continue().fill([replace(views, images=copied, coverage=known)], [frame])[0].images)
            left = [m for m, hole in enumerate(holes[n]) if float(hole.float().mean()) > 1 - ALMOST_COMPLETE]
            if left:
                inputs = self._inputs(views, frame, images[n], known, left, name)
                alike.setdefault((len(left), inputs[1].images.shape[1]), []).append((n, left, inputs))
        for (count, _), group in alike.items():
            size = max(1, VIEWS_AT_ONCE // count)
            for together in (group[start : start + size] for start in range(0, len(group), size)):
                batch = tree_map(lambda tensor: tensor.to(device), joined([inputs for _, _, inputs in together]))
                made = denoised(self.generator, self.config, *batch).cpu()
                for (n, left, (targets, *_)), generated in zip(together, made, strict=True):
                    for m, change in zip(left, generated - targets.images[0], strict=True):
                        if not bool(change.isfinite().all()):
                            where = f"frame {names[n]:.40}, camera {rendered[n].rig[m].name!r}"
                            expected = f"finite pixels from generator {self.config.name!r}"
                            fix = "pass finite images, no float16, less guidance"
                            raise GeneratorError(f"{where}: expected {expected}, got NaN or infinity: {fix}")
                        images[n][m] = _changed(images[n][m], change)
        return [put(*frame) for frame in zip(rendered, images, holes, strict=True)]

    def _inputs(
        self, rendered: Views, source: Frame, filled: Tensors, known: Tensors, left: list[int], name: str
    ) -> _Inputs:
        """Targets, sources and noise of a frame's views ``left``, ``filled`` as by default, on the CPU."""
        config, size = self.config, self.config.image_size
        rig = rendered.rig.in_frame_of(source.rig)
        near = sorted({k for m in left for k in nearest_sources(rig[m], source.rig.cameras)})
        cameras = [source.rig[k] for k in near]
        geometry = frame_geometry([rig[m] for m in left], cameras, source.rig.ground_z_m, config)
        trust = rendered.coverage if rendered.confidence is None else rendered.confidence
        maps = [torch.stack([known[m].float(), trust[m].float() * known[m]])[None].cpu() for m in left]
        shares = torch.cat([functional.interpolate(part, size, mode="bilinear", antialias=True) for part in maps])
        views = torch.stack([unit(resized(filled[m].cpu(), size)) for m in left])[None]
        shown, confidence = shares.clamp(0, 1)[None].unbind(2)
        targets = Branches(views, shown, confidence, geometry[0])
        photographs = torch.stack([unit(resized(source.images[k], size)) for k in near])[None]
        seen = torch.stack([valid_pixels(camera.resize(size)).float() for camera in cameras])[None]
        # Noise is drawn on the CPU, the same on every device, and by camera number: batches have no names.
        shape = config.autoencoder.latent_channels, *config.latent_size
        noise = torch.stack([torch.randn(shape, generator=seeded(self.seed, name, str(m))) for m in left])[None]
        return targets, Branches(photographs, seen, seen, geometry[1]), noise


def _changed(view: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    """A view (3, h, w) changed as the generator changed it at its size, (3, H, W): a larger view keeps its details."""
    if change.shape != view.shape:
        change = functional.interpolate(change[None], view.shape[-2:], mode="bicubic", antialias=True)[0]
    changed = (unit(view) + change.to(view.device)).clamp(0, 1)
    return ((changed * 255).round() if view.dtype == torch.uint8 else changed).to(view.dtype)


def load_inpainter(where: str | Path | None, *, steps: int | None = None) -> Diffusion | NetworkInpainter:
    """Load an inpainter: a generator's folder, a TorchScript file, or an inpainting pipeline of diffusers.

    Args:
        where: The folder, file or hub id.
        steps: As for ``Diffusion``; TorchScript files have none.

    Raises:
        GeneratorError: None of these.
    """
    if where is None:
        return Diffusion(None)  # refuses
    if os.path.isfile(where):
        return TorchScriptInpainter(where)
    is_there = os.path.isdir(where)
    if not is_there and not _HUB_ID.fullmatch(str(where)):
        expected = "a folder of a generator or of diffusers, a TorchScript file, or OWNER/NAME on the Hugging Face Hub"
        raise GeneratorError(f"generator {where}: expected {expected}, found none")
    if not is_there or (Path(where) / "model_index.json").is_file():
        return PipelineInpainter(where, steps=steps)
    return Diffusion(where, steps=steps)
