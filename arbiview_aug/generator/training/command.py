"""Run ``python -m arbiview_aug.train``: open the data, load weights, then train, ablate or evaluate."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from datetime import timedelta
from pathlib import Path

import torch

from arbiview_aug.cli.arguments import writable_folder
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import TrainingError
from arbiview_aug.generator import Generator
from arbiview_aug.generator.training.ablation import ablate
from arbiview_aug.generator.training.autoencoder import train_autoencoder
from arbiview_aug.generator.training.checkpointing import saved_config
from arbiview_aug.generator.training.config import CONFIGS, TrainConfig, overridden
from arbiview_aug.generator.training.data import Frames, Split, open_frames
from arbiview_aug.generator.training.held_out import held_out_scores, report
from arbiview_aug.generator.training.losses import Perceptual, load_perceptual
from arbiview_aug.generator.training.trainer import Trainer

COMMANDS = ("train", "ablate", "evaluate")

_LONGEST_WAIT = timedelta(hours=3)


def run(arguments: argparse.Namespace, say: Callable[[str], None] = print) -> int:
    """Run the command and return its exit status.

    Raises:
        ArbiviewError: Settings, data or weights that cannot be used.
    """
    config = overridden(CONFIGS[arguments.config](), arguments.set)
    output = writable_folder(Path(arguments.output), arguments.output)
    if arguments.command == "evaluate":
        config = saved_config(output / "state", config)
    processes = optional_package("accelerate", "generator").PartialState(
        cpu=not torch.cuda.is_available(),
        timeout=_LONGEST_WAIT,  # the others wait while one trains the autoencoder, or scores
    )
    say, show = (say if processes.is_main_process else _nothing), processes.is_main_process and not arguments.quiet
    device = processes.device
    size, seed = config.generator.image_size, config.seed
    frames = open_frames(arguments.data, size, scenes=config.scenes, seed=seed, device=device)
    split = frames.split(seed)
    if arguments.command == "evaluate":
        return evaluate(Generator.from_pretrained(output / "generator").to(device), frames, split, arguments, say)
    if arguments.stage == "autoencoder" and config.autoencoder is None:
        raise TrainingError(f"--stage autoencoder: --config {arguments.config} has none of its own")
    check_weights(config, arguments.weights)
    if arguments.data == "synthetic":
        used = [*split.training, *split.validation]
        if device.type != "cpu" and config.workers:
            frames.check_fits(used)  # workers cannot render there what is not held
        frames.prepare(used, workers=_readers(len(used)) if device.type == "cpu" else 0, show=show)
    perceptual = _perceptual(config, arguments.vgg_weights, say)

    def made(config: TrainConfig) -> tuple[Generator, bool]:
        generator = fresh(config, arguments.weights).to(device)
        with processes.main_process_first():  # the others load what the first one saved
            ready = train_autoencoder(config, frames, generator, output, perceptual=perceptual, show=show, say=say)
        return generator, ready

    generator, ready = made(config)
    if not ready:
        return 0
    if arguments.command == "ablate":
        ablate(
            config,
            frames,
            lambda variant: made(variant)[0],
            output,
            views=arguments.views,
            perceptual=perceptual,
            show=show,
            say=say,
        )
        return 0
    if arguments.stage == "autoencoder":
        say(f"the autoencoder is in {output / 'autoencoder'}")
        return 0
    Trainer(config, frames, generator, output, perceptual=perceptual, show=show, say=say).train()
    return 0


def _readers(count: int) -> int:
    """Number of rendering processes: each takes a second to start, a street half a second to render."""
    return min(8, os.cpu_count() or 1) if count >= 16 else 0


def _nothing(message: str) -> None:
    """Discard a message: only the first process prints."""


def check_weights(config: TrainConfig, weights: str | None) -> None:
    """Check, before any work, that weights are given exactly where ``fresh`` needs them.

    Raises:
        TrainingError: A frozen U-Net without weights, or weights for a configuration that starts from nothing.
    """
    name = config.generator.name
    if config.generator.frozen_unet and weights is None:
        raise TrainingError(
            f"--config {name}: expected --weights, a folder or hub id of Stable Diffusion 1.5 in diffusers' layout: "
            "its U-Net stays as it is"
        )
    if not config.generator.frozen_unet and weights is not None:
        raise TrainingError(f"--weights: expected none for --config {name}, which starts from nothing")


def fresh(config: TrainConfig, weights: str | None) -> Generator:
    """The untrained generator of a run, the same for the same seed."""
    torch.manual_seed(config.seed)
    if weights is not None:
        return Generator.from_stable_diffusion(weights, config.generator)
    return Generator.from_config(config.generator)


def evaluate(
    generator: Generator, frames: Frames, split: Split, arguments: argparse.Namespace, say: Callable[[str], None]
) -> int:
    """Score a trained generator on the held-out streets of its run."""
    indices = split.held_out[: arguments.views]
    if not indices:
        raise TrainingError("evaluate: expected held-out scenes, this data has too few")
    seeds, show = range(arguments.seeds), not arguments.quiet
    scores = held_out_scores(generator, frames, indices, seeds=seeds, steps=arguments.steps, show=show)
    report(scores, len(seeds), say)
    return 0


def _perceptual(config: TrainConfig, weights: str | None, say: Callable[[str], None]) -> Perceptual | None:
    """Load VGG16; None where the term is off, or no file was named and the download failed."""
    if not config.loss.perceptual:
        return None
    try:
        return load_perceptual(weights)
    except TrainingError as error:
        if weights is not None:
            raise
        say(f"L_perceptual is off: {error}")
        return None
