"""The diffusion generator as an inpainter of rendered views."""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from arbiview_aug.errors import GeneratorError, WarnOnce
from arbiview_aug.generator.completion import complete_together, with_sampling
from arbiview_aug.generator.denoiser import GeneratorNetworks
from arbiview_aug.generator.generator import Generator
from arbiview_aug.inpaint.inpainter import Inpainter, Tensors, checked_settings, frame_names, put
from arbiview_aug.inpaint.networks import NetworkInpainter, PipelineInpainter, TorchScriptInpainter
from arbiview_aug.render.rendered import RenderedFrame
from arbiview_aug.sample.inputs import Frame

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
        generator: GeneratorNetworks | None = None,
        *,
        steps: int | None = None,
        guidance: float | None = None,
        min_confidence: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.min_confidence, self.seed = checked_settings(min_confidence, seed, steps, guidance)
        if generator is not None and not isinstance(generator, GeneratorNetworks):
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

    def fill(self, rendered: Sequence[RenderedFrame], frames: Sequence[Frame]) -> list[RenderedFrame]:
        """Fill rendered frames, which share the network's calls; ``frames`` hold their source images."""
        # Noise by camera number: cameras have no names in a batch.
        rigs = [one.rig.with_cameras([replace(c, name=str(k)) for k, c in enumerate(one.rig)]) for one in rendered]
        done = complete_together(
            self.generator,
            [replace(one, rig=rig) for one, rig in zip(rendered, rigs, strict=True)],
            frames,
            frame_names(frames),
            min_confidence=self.min_confidence,
            steps=self.steps,
            guidance=self.guidance,
            seed=self.seed,
        )
        return [put(one, list(views.images), list(views.generated)) for one, views in zip(rendered, done, strict=True)]


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
