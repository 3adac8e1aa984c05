"""The diffusion generator as an inpainter of rendered views."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from pathlib import Path

import torch
from torch.nn import functional

from arbiview_aug.errors import GeneratorError, WarnOnce
from arbiview_aug.generator.completion import Conditions, denoised, unit, valid_pixels, with_sampling
from arbiview_aug.generator.conditioning import FrameGeometry, batched, frame_geometry, nearest_sources
from arbiview_aug.generator.generator import Generator
from arbiview_aug.image_ops import resized
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
from arbiview_aug.inpaint.telea import telea
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
        generator: ``Generator.from_pretrained(DIR)``; None loads the shipped weights, trained on synthetic streets.
        steps: Denoising steps, from 1 (regression) on; the generator's default if None.
        guidance: Classifier-free guidance, 1 for none; the generator's default if None.
        min_confidence: As for every ``Inpainter``, like ``seed``.

    Raises:
        ValueError: Impossible settings.
        GeneratorError: Steps or guidance that the generator cannot sample with.
    """

    outcome = "made up by the generator"
    is_random = True

    def __init__(
        self,
        generator: Generator | None = None,
        *,
        steps: int | None = None,
        guidance: float | None = None,
        min_confidence: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.min_confidence, self.seed = checked_settings(min_confidence, seed, steps, guidance)
        if generator is not None and not isinstance(generator, Generator):
            raise ValueError(f"generator: expected a Generator, got {type(generator).__name__}")
        self.generator = Generator.shipped() if generator is None else generator
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

        Views that are almost complete are inpainted by Telea's method. A frame's others are denoised together, so that
        they agree. Frames with as many views and sources share the denoiser's calls. GeneratorError for generated
        pixels that are not finite.
        """
        images, holes = self._completed(rendered, frames)
        return [put(*frame) for frame in zip(rendered, images, holes, strict=True)]

    @torch.no_grad()
    def _completed(
        self, rendered: Sequence[Views], frames: Sequence[Frame]
    ) -> tuple[list[list[torch.Tensor]], list[list[torch.Tensor]]]:
        """Images of each frame that are right in the holes, and the holes."""
        check_device(self.generator)
        names, images, holes = frame_names(frames), [list(frame.images) for frame in rendered], []
        alike: dict[tuple[int, int], list[tuple[int, list[int], _Inputs]]] = {}
        for n, (frame, source) in enumerate(zip(rendered, frames, strict=True)):
            known, of_frame = holes_of(frame, self.min_confidence)
            holes.append(of_frame)
            left = [m for m, hole in enumerate(of_frame) if float(hole.float().mean()) > 1 - ALMOST_COMPLETE]
            for m, hole in enumerate(of_frame):
                if m not in left and bool(hole.any()):
                    images[n][m] = telea(images[n][m], ~known[m])
            if left:
                inputs = self._inputs(frame, source, known, left, names[n])
                alike.setdefault((len(left), inputs[0].sources.shape[1]), []).append((n, left, inputs))
        for (count, _), group in alike.items():
            size = max(1, VIEWS_AT_ONCE // count)
            for together in (group[start : start + size] for start in range(0, len(group), size)):
                done = self._denoised([inputs for _, _, inputs in together])
                for (n, left, _), generated in zip(together, done, strict=True):
                    for m, image in zip(left, generated, strict=True):
                        if not bool(image.isfinite().all()):
                            where = f"frame {names[n]:.40}, camera {rendered[n].rig[m].name!r}"
                            expected = f"finite pixels from generator {self.generator.config.name!r}"
                            fix = "pass finite images, no float16, less guidance"
                            raise GeneratorError(f"{where}: expected {expected}, got NaN or infinity: {fix}")
                        images[n][m] = _like(image, images[n][m])
        return images, holes

    def _inputs(self, rendered: Views, source: Frame, known: Tensors, left: list[int], name: str) -> _Inputs:
        """Conditions, cameras and noise of a frame's views ``left``, on the CPU."""
        config = self.generator.config
        rig, size = rendered.rig.in_frame_of(source.rig), config.image_size
        branches = sorted({k for m in left for k in nearest_sources(rig[m], source.rig.cameras)})
        trust = rendered.coverage if rendered.confidence is None else rendered.confidence
        views = [_prefilled(rendered.images[m], known[m], trust[m], size) for m in left]
        images = [unit(resized(source.images[k], size)) for k in branches]
        cameras = [source.rig[k] for k in branches]
        seen = [valid_pixels(camera.resize(size)).float() for camera in cameras]
        conditions = Conditions(*(torch.stack(list(part))[None] for part in (*zip(*views, strict=True), images, seen)))
        # Noise is drawn on the CPU, the same on every device, and by camera number: batches have no names.
        shape = config.autoencoder.latent_channels, *config.latent_size
        noise = [torch.randn(shape, generator=seeded(self.seed, name, str(m))) for m in left]
        geometry = frame_geometry([rig[m] for m in left], cameras, source.rig.ground_z_m, config)
        return conditions, geometry, torch.stack(noise)[None]

    def _denoised(self, inputs: Sequence[_Inputs]) -> torch.Tensor:
        """(B, N, 3, H, W) images of frames with as many views and sources, on the generator's device."""
        generator, device = self.generator, self.generator.device
        conditions, geometries, noise = zip(*inputs, strict=True)
        together = Conditions(*(torch.cat(part).to(device) for part in zip(*conditions, strict=True)))
        config = with_sampling(generator.config, self.steps, self.guidance)
        return denoised(generator, config, batched(geometries).to(device), together, torch.cat(noise).to(device))


def _prefilled(
    image: torch.Tensor, known: torch.Tensor, trust: torch.Tensor, size: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A view at the generator's size with holes inpainted (3, H, W), its known share and its confidence (H, W).

    Colours are averaged over known pixels alone.
    """
    weight = known.float()[None]
    planes = torch.cat([unit(image) * weight, weight, (trust.float() * known)[None]])[None]
    if tuple(image.shape[-2:]) != size:
        planes = functional.interpolate(planes, size, mode="bilinear", antialias=True)
    colour, share, confidence = planes[0].split([3, 1, 1])
    filled = telea((colour / share.clamp(min=1e-3)).clamp(0, 1), share[0] < 0.5)
    return filled, share[0].clamp(0, 1), confidence[0].clamp(0, 1)


def _like(generated: torch.Tensor, view: torch.Tensor) -> torch.Tensor:
    """A generated image (3, H, W) with the size, type and device of a view."""
    generated = generated.clamp(0, 1).to(view.device)
    if generated.shape != view.shape:
        generated = functional.interpolate(generated[None], view.shape[-2:], mode="bicubic", antialias=True)[0]
    generated = generated.clamp(0, 1)
    return ((generated * 255).round() if view.dtype == torch.uint8 else generated).to(view.dtype)


def load_inpainter(where: str | Path | None = None, *, steps: int | None = None) -> Diffusion | NetworkInpainter:
    """Load what fills holes: a generator's folder, a TorchScript file, or an inpainting pipeline of diffusers.

    Args:
        where: The folder, file or hub id; None loads the shipped generator.
        steps: As for ``Diffusion``; TorchScript files have none.

    Raises:
        GeneratorError: None of these.
    """
    if where is None:
        return Diffusion(steps=steps)
    if os.path.isfile(where):
        return TorchScriptInpainter(where)
    is_there = os.path.isdir(where)
    if not is_there and not _HUB_ID.fullmatch(str(where)):
        expected = "a folder of a generator or of diffusers, a TorchScript file, or OWNER/NAME on the Hugging Face Hub"
        raise GeneratorError(f"generator {where}: expected {expected}, found none")
    if not is_there or (Path(where) / "model_index.json").is_file():
        return PipelineInpainter.from_pretrained(where, steps=steps)
    return Diffusion(Generator.from_pretrained(where), steps=steps)
