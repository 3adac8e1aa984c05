"""Run ``python -m arbiview_aug.train``: open the data, load weights, then train or evaluate."""

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
from arbiview_aug.generator.training.held_out import held_out_scores, report, spread
from arbiview_aug.generator.training.losses import load_perceptual
from arbiview_aug.generator.training.trainer import Trainer, silent

_TIMEOUT = timedelta(hours=3)  # of a process that waits for the others: they prepare frames, validate and save


def run(arguments: argparse.Namespace, say: Callable[[str], None] = print) -> int:
    config = overridden(CONFIGS[arguments.config](), arguments.set)
    output = Path(arguments.output)
    if arguments.command == "train":
        writable_folder(output, arguments.output)
    accelerate = optional_package("accelerate", "generator")
    processes = accelerate.PartialState(cpu=not torch.cuda.is_available(), timeout=_TIMEOUT)
    if not processes.is_main_process:
        say = silent
    options: dict[str, Any] = {"show": processes.is_main_process and not arguments.quiet, "say": say}
    if arguments.command == "evaluate":
        _evaluate(arguments, config, output, processes.device, **options)
        return 0
    check_weights(config, arguments.weights)
    if has_state(output):
        check_settings(output / "state", asdict(config))
    options["perceptual"] = load_perceptual(arguments.vgg_weights) if config.loss.perceptual else None
    data, device = arguments.data or "synthetic", processes.device
    frames = open_frames(data, config.generator.image_size, scenes=config.scenes, seed=config.seed, device=device)
    if data == "synthetic":
        split = frames.split(config.seed)
        used = [*split.training, *split.validation]
        if device.type != "cpu" and config.workers:
            frames.check_fits(used)
        # Each process takes a second to start, a street half a second to render.
        readers = min(8, os.cpu_count() or 1) if device.type == "cpu" and len(used) >= 16 else 0
        frames.prepare(used, workers=readers, show=options["show"])
    Trainer(config, frames, fresh(config, arguments.weights).to(device), output, **options).train()
    return 0


def _evaluate(
    arguments: argparse.Namespace,
    config: TrainConfig,
    output: Path,
    device: torch.device,
    show: bool,
    say: Callable[[str], None],
) -> None:
    generator = Generator.from_pretrained(output / "generator").to(device)
    trained_on, size, seeds = generator.trained_on, generator.config.image_size, range(arguments.seeds)
    data = arguments.data or (trained_on.data if trained_on else "synthetic")
    unseen = None if trained_on is None else trained_on.unseen(None if data == "synthetic" else data)
    scenes, seed = config.scenes, config.seed
    if trained_on is not None and unseen is not None:
        if arguments.set or arguments.config not in ("tiny", generator.config.name):
            name = generator.config.name
            raise TrainingError(f"evaluate: expected no --set and no --config but {name}: the generator has its own")
        scenes, seed = max(unseen, default=0) + 1, trained_on.seed
    frames = open_frames(data, size, scenes=scenes, seed=seed, points=True, device=device)
    held_out = tuple(frames.split(seed).held_out)
    if unseen is not None:
        if data != "synthetic" and held_out != unseen:
            raise TrainingError(f"evaluate: {data}: expected the scenes that the generator was trained on, got others")
        held_out = unseen
    else:
        known = "unknown data" if trained_on is None else trained_on.data
        say(f"{data}: frames that are not known to be unseen: the generator was trained on {known}")
    indices = spread(held_out, arguments.views)
    if not indices:
        raise TrainingError(f"evaluate: {data}: expected at least two scenes, one to train on and one held out")
    scores = held_out_scores(generator, frames, indices, seeds=seeds, steps=arguments.steps, show=show)
    say(f"{data}, {arguments.steps or generator.config.steps} steps, guidance {generator.config.guidance:g}")
    report(scores, [frames.scenes[index] for index in indices] * len(seeds), say)


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
