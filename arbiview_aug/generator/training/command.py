"""Run ``python -m arbiview_aug.train``: open the data, load weights, then train."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import asdict
from datetime import timedelta
from pathlib import Path
from typing import Any

import torch

from arbiview_aug.cli.arguments import writable_folder
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import TrainingError
from arbiview_aug.generator import Generator
from arbiview_aug.generator.training.checkpointing import check_settings, has_state
from arbiview_aug.generator.training.config import CONFIGS, TrainConfig, overridden
from arbiview_aug.generator.training.data import open_frames
from arbiview_aug.generator.training.losses import load_perceptual
from arbiview_aug.generator.training.trainer import Trainer, silent

_TIMEOUT = timedelta(hours=3)  # of a process that waits for the others: they prepare frames, validate and save


def run(arguments: argparse.Namespace, say: Callable[[str], None] = print) -> int:
    config = overridden(CONFIGS[arguments.config](), arguments.set)
    output = Path(arguments.output)
    writable_folder(output, arguments.output)
    accelerate = optional_package("accelerate", "generator")
    processes = accelerate.PartialState(cpu=not torch.cuda.is_available(), timeout=_TIMEOUT)
    if not processes.is_main_process:
        say = silent
    options: dict[str, Any] = {"show": processes.is_main_process and not arguments.quiet, "say": say}
    check_weights(config, arguments.weights)
    if has_state(output):
        check_settings(output / "state", asdict(config))
    options["perceptual"] = load_perceptual(arguments.vgg_weights) if config.loss.perceptual else None
    data = arguments.data or "synthetic"
    frames = open_frames(data, config.generator.image_size, scenes=config.scenes, seed=config.seed)
    if data == "synthetic":
        split = frames.split(config.seed)
        used = [*split.training, *split.validation]
        # Each process takes a second to start, a street half a second to render.
        readers = min(8, os.cpu_count() or 1) if len(used) >= 16 else 0
        frames.prepare(used, workers=readers, show=options["show"])
    Trainer(config, frames, fresh(config, arguments.weights).to(processes.device), output, **options).train()
    return 0


def check_weights(config: TrainConfig, weights: str | None) -> None:
    """Check, before any work, that weights are given exactly if ``fresh`` needs them; TrainingError otherwise."""
    name = config.generator.name
    if config.generator.frozen_unet and weights is None:
        model = f"Stable Diffusion 1.5{' inpainting' if config.generator.inpainting else ''} in diffusers' layout"
        raise TrainingError(f"--config {name}: expected --weights, a folder or hub id of {model}, for its frozen U-Net")
    if not config.generator.frozen_unet and weights is not None:
        raise TrainingError(f"--weights: expected none for --config {name}, which is trained from scratch")
    if not config.generator.frozen_unet and config.generator.autoencoder.widths:
        fix = "generator.autoencoder.widths=[] (squares of pixels), or a --config of --weights"
        raise TrainingError(f"--config {name}: an autoencoder is not trained: expected {fix}")


def fresh(config: TrainConfig, weights: str | None) -> Generator:
    """The untrained generator of a run, the same for the same seed."""
    torch.manual_seed(config.seed)
    settings = config.generator
    return Generator.from_config(settings) if weights is None else Generator.from_stable_diffusion(weights, settings)
