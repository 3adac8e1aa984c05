"""The diffusion generator as an inpainter of rendered views."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch
from torch.nn import functional

from arbiview_aug.errors import GeneratorError, WarnOnce
from arbiview_aug.generator.completion import Conditions, denoised, unit, valid_pixels, with_sampling
from arbiview_aug.generator.conditioning import FrameGeometry, batched, frame_geometry, nearest_sources
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

ALMOST_COMPLETE = 0.995  # share of known pixels from which a view is inpainted: what is left is a seam
VIEWS_AT_ONCE = 24  # views that the denoiser sees in one call; a whole frame in any case

_Inputs = tuple[Conditions, FrameGeometry, torch.Tensor]
_warn = WarnOnce()
_HUB_ID = re.compile(r"\w[\w.-]*/[\w.-]+")


class Diffusion(Inpainter, torch.nn.Module):
    """Fills holes by a generator, which sees all views and sources of a frame (Sec. CVC-SSL).

    On a GPU it needs ``num_workers=0``, or ``complete_batch`` after collating.

    Args:
        generator: A generator, or the folder of one, which ``python -m arbiview_aug.train`` makes.
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
            fix = "python -m arbiview_aug.train trains one on your frames (docs/holes.md); holes='continue' needs none"
            raise GeneratorError(f"Diffusion: expected a generator or its folder, got none: {fix}")
        if not isinstance(generator, Generator | str | Path):
            raise ValueError(f"generator: expected a Generator or its folder, got {type(generator).__name__}")
        self.generator = generator if isinstance(generator, Generator) else Generator.from_pretrained(generator)
        self.steps, self.guidance = steps, guidance
        config = self.generator.config
        with_sampling(config, steps, guidance)
        if config.steps == 1 < (steps or 1):
            made_for = f"steps={steps}: generator {config.name!r} was trained for one step; more add noise"
            _warn(config.name, f"{made_for}. Pass steps=1, or a model made for more")

    def train(self, mode: bool = True) -> Diffusion:
        """Leave the generator in evaluation mode: a transform in a model that trains still fills holes."""
        super().train(mode)
        self.generator.eval()
        return self

    @property
    def needs_confidence(self) -> bool:
        return True

    def inpaint(self, views: Tensors, holes: Tensors, seeds: Sequence[int]) -> list[torch.Tensor]:
        raise NotImplementedError("a generator needs whole frames: call fill")

    def fill(self, rendered: Sequence[Views], frames: Sequence[Frame]) -> list[Views]:
        """Fill rendered frames; ``frames`` hold their source images.

        All are filled as by default (``Continue``); views that are almost complete stay so. A frame's others are
        denoised together, so that they agree. Frames with as many views and sources share the denoiser's calls.
        GeneratorError for generated pixels that are not finite.
        """
        images, holes = self._completed(rendered, frames)
        return [put(*frame) for frame in zip(rendered, images, holes, strict=True)]

    @torch.no_grad()
    def _completed(
        self, rendered: Sequence[Views], frames: Sequence[Frame]
    ) -> tuple[list[list[torch.Tensor]], list[list[torch.Tensor]]]:
        """Images of each frame that are right in the holes, and the holes."""
        check_device(self.generator)
        names, images, holes = frame_names(frames), [list[torch.Tensor]() for _ in frames], []
        alike: dict[tuple[int, int], list[tuple[int, list[int], _Inputs]]] = {}
        for n, (frame, source) in enumerate(zip(rendered, frames, strict=True)):
            known, of_frame = holes_of(frame, self.min_confidence)
            holes.append(of_frame)
            copied = [image.clone() for image in frame.images]
            images[n] = Continue().fill([replace(frame, images=copied, coverage=known)], [source])[0].images
            left = [m for m, hole in enumerate(of_frame) if float(hole.float().mean()) > 1 - ALMOST_COMPLETE]
            if left:
                inputs = self._inputs(frame, source, images[n], known, left, names[n])
                alike.setdefault((len(left), inputs[0].sources.shape[1]), []).append((n, left, inputs))
        config, device = with_sampling(self.generator.config, self.steps, self.guidance), self.generator.device
        for (count, _), group in alike.items():
            size = max(1, VIEWS_AT_ONCE // count)
            for together in (group[start : start + size] for start in range(0, len(group), size)):
                conditions, geometries, noise = zip(*(inputs for _, _, inputs in together), strict=True)
                batch = Conditions(*(torch.cat(part).to(device) for part in zip(*conditions, strict=True)))
                geometry = batched(geometries).to(device)
                done = denoised(self.generator, config, geometry, batch, torch.cat(noise).to(device)).cpu()
                for (n, left, (before, *_)), generated in zip(together, done, strict=True):
                    for m, image in zip(left, generated - before.prefilled[0], strict=True):
                        if not bool(image.isfinite().all()):
                            where = f"frame {names[n]:.40}, camera {rendered[n].rig[m].name!r}"
                            expected = f"finite pixels from generator {self.generator.config.name!r}"
                            fix = "pass finite images, no float16, less guidance"
                            raise GeneratorError(f"{where}: expected {expected}, got NaN or infinity: {fix}")
                        images[n][m] = _changed(images[n][m], image)
        return images, holes

    def _inputs(
        self, rendered: Views, source: Frame, filled: Tensors, known: Tensors, left: list[int], name: str
    ) -> _Inputs:
        """Conditions, cameras and noise of a frame's views ``left``, ``filled`` as by default, on the CPU."""
        config = self.generator.config
        rig, size = rendered.rig.in_frame_of(source.rig), config.image_size
        branches = sorted({k for m in left for k in nearest_sources(rig[m], source.rig.cameras)})
        trust = rendered.coverage if rendered.confidence is None else rendered.confidence
        views = []
        for m in left:
            maps = torch.stack([known[m].float(), trust[m].float() * known[m]])[None].cpu()
            shares = functional.interpolate(maps, size, mode="bilinear", antialias=True)[0].clamp(0, 1)
            views.append((unit(resized(filled[m].cpu(), size)), *shares))
        images = [unit(resized(source.images[k], size)) for k in branches]
        cameras = [source.rig[k] for k in branches]
        seen = [valid_pixels(camera.resize(size)).float() for camera in cameras]
        conditions = Conditions(*(torch.stack(list(part))[None] for part in (*zip(*views, strict=True), images, seen)))
        # Noise is drawn on the CPU, the same on every device, and by camera number: batches have no names.
        shape = config.autoencoder.latent_channels, *config.latent_size
        noise = [torch.randn(shape, generator=seeded(self.seed, name, str(m))) for m in left]
        geometry = frame_geometry([rig[m] for m in left], cameras, source.rig.ground_z_m, config)
        return conditions, geometry, torch.stack(noise)[None]


def _changed(view: torch.Tensor, change: torch.Tensor) -> torch.Tensor:
    """A view (3, h, w) changed as the generator changed it at its size, (3, H, W): a larger view keeps its details."""
    if change.shape != view.shape:
        change = functional.interpolate(change[None], view.shape[-2:], mode="bicubic", antialias=True)[0]
    changed = (unit(view) + change.to(view.device)).clamp(0, 1)
    return ((changed * 255).round() if view.dtype == torch.uint8 else changed).to(view.dtype)


def load_inpainter(where: str | Path | None, *, steps: int | None = None) -> Diffusion | NetworkInpainter:
    """Load what fills holes: a generator's folder, a TorchScript file, or an inpainting pipeline of diffusers.

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
        return PipelineInpainter.from_pretrained(where, steps=steps)
    return Diffusion(where, steps=steps)
