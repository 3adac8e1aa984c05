"""The training loop and its command: steps, averaging, logs, validation and checkpoints (Algorithm 1)."""

from __future__ import annotations

import argparse
import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader
from tqdm import tqdm

from arbiview_aug.cli.arguments import writable_folder
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import DataError, OutputError, TrainingError, one_line
from arbiview_aug.evaluate.report.pictures import contact_sheet, save_picture
from arbiview_aug.generator import Generator
from arbiview_aug.generator.completion import denoised, shown_condition
from arbiview_aug.generator.conditioning import pooled
from arbiview_aug.generator.config import TrainedOn
from arbiview_aug.generator.training.checkpointing import (
    averaged,
    has_state,
    load_state,
    save_state,
    stop_requests,
)
from arbiview_aug.generator.training.config import CONFIGS, TrainConfig, overridden
from arbiview_aug.generator.training.data import Frames, item_workers, open_frames
from arbiview_aug.generator.training.losses import Perceptual, Step, draw, load_perceptual
from arbiview_aug.generator.training.pseudo_views import Batch, PseudoViews, collate
from arbiview_aug.inpaint.inpainter import digest_of

_LOG_EVERY = 10
_DEVIATION_ITEMS = 32
_MIN_DEVIATION = 0.02  # lower bound of the residual's deviation, 2.5 grey levels: the error of rendering twice
_TIMEOUT = timedelta(hours=3)  # of a process that waits for the others: they prepare frames, validate and save
_SEEDS = {"items": 1, "validation": 2, "draws": 4}  # offsets: no stream sees another's draws


class Trainer:
    """Training of a generator's denoiser (Algorithm 1), on one process or many.

    The output folder gets ``generator/`` (averaged weights, for ``Generator.from_pretrained``), ``state/`` (to resume
    from), ``log.jsonl`` (losses and scores by step) and ``validation/`` (PNG).

    Args:
        generator: Trained in place on the ``frames``; its autoencoder is frozen.
        output: Folder; the run resumes from a state that it holds.
        perceptual: VGG16 for L_perceptual; None only with ``loss.perceptual=0``.
        show: Show a progress bar.
        say: Called with messages.

    Raises:
        TrainingError: The output holds a run with other settings, data, frozen weights or number of processes, or a
            generator without a state; the generator is frozen or has another configuration; VGG16 is missing; the
            process has another precision.
        ImportError: accelerate is not installed.
    """

    def __init__(
        self,
        config: TrainConfig,
        frames: Frames,
        generator: Generator,
        output: str | Path,
        *,
        perceptual: Perceptual | None = None,
        show: bool = True,
        say: Callable[[str], None] = print,
    ) -> None:
        accelerate = optional_package("accelerate", "generator")
        self.config, self.frames, self.output = config, frames, Path(output)
        try:
            options = {"mixed_precision": config.precision, "cpu": not torch.cuda.is_available()}
            self.accelerator = accelerate.Accelerator(**options)
        except ValueError as error:
            fix = "a process keeps its first precision; start another one"
            raise TrainingError(f"Trainer: precision={config.precision}: {one_line(error)}; {fix}") from None
        self.is_main: bool = self.accelerator.is_main_process
        self.show, self.say = show and self.is_main, say if self.is_main else lambda _: None
        self.device = self.accelerator.device
        scaled = replace(config.generator.autoencoder, scale=generator.config.autoencoder.scale)
        if generator.config != replace(config.generator, autoencoder=scaled, one_step=generator.config.one_step):
            raise TrainingError("Trainer: expected a generator with the run's settings, got others")
        if config.loss.perceptual and perceptual is None:
            raise TrainingError("Trainer: expected VGG16 for the perceptual term, or loss.perceptual=0")
        self.generator = generator.to(self.device)
        generator.config = replace(generator.config, one_step=config.loss.regression > 0)
        generator.autoencoder.requires_grad_(False)
        generator.denoiser.gradient_checkpointing = config.checkpointing
        self.split = frames.split(config.seed)
        generator.trained_on = TrainedOn(data=frames.name, seed=config.seed, held_out=tuple(self.split.held_out))
        self.perceptual = perceptual.to(self.device) if config.loss.perceptual and perceptual is not None else None
        self.step = Step(config, generator.denoiser, generator.autoencoder, self.perceptual)
        self.trained = {n: p for n, p in generator.denoiser.named_parameters() if p.requires_grad}
        if not self.trained:
            raise TrainingError(
                "Trainer: expected weights to train, got a generator that is frozen, as from_pretrained loads it: call "
                "generator.denoiser.requires_grad_(True), with frozen_unet on each of own_parameters() alone"
            )
        self.optimiser = torch.optim.AdamW(self.trained.values(), lr=config.lr, weight_decay=config.weight_decay)
        ema = optional_package("diffusers.training_utils", "generator").EMAModel
        self.average = ema(self.trained.values(), decay=config.ema, foreach=True)
        frozen: list[torch.Tensor] = [p for p in generator.parameters() if not p.requires_grad]
        frozen += [generator.denoiser.context.empty_prompt, *(self.perceptual.parameters() if self.perceptual else ())]
        self._run = {
            **asdict(config),
            "data": asdict(generator.trained_on),
            "frozen weights": digest_of(frozen),
            "number of processes": self.accelerator.num_processes,
        }
        self._buffers = {"deviation": generator.denoiser.deviation} if config.generator.residual else {}
        self.done, state = 0, self.output / "state"
        is_resumed = has_state(self.output)
        if is_resumed:
            self.done = load_state(state, self._run, self.trained, self._buffers, self.average, self.optimiser)
            self.say(f"going on after step {self.done} of {state}")
        # The optimiser is not placed: AdamW's step counters on a GPU would synchronise one by one.
        self.model, self._optimiser = self.accelerator.prepare(
            self.step, self.optimiser, device_placement=[True, False]
        )
        shared, first = (config.pseudo_views, config.generator), 10 * config.seed
        maker = "cpu" if config.workers else self.device
        self.items = PseudoViews(frames, self.split.training, *shared, first + _SEEDS["items"], maker)
        validation = self.split.validation or self.split.training
        self.validation = PseudoViews(frames, validation, *shared, first + _SEEDS["validation"], maker)
        if config.generator.residual and not is_resumed:
            self._measure_deviation()
        if not self.split.validation:
            self.say("too few scenes for a validation part: validating on training scenes, with other draws")

    @torch.no_grad()
    def _measure_deviation(self) -> None:
        """Measure the standard deviation of the residual inside and outside holes, on the first items."""
        encode, size = self.generator.autoencoder.encode, self.config.generator.latent_size
        sums = torch.zeros(2, 2, dtype=torch.float64)
        for k in range(_DEVIATION_ITEMS):
            batch = self.items[k].to(self.device)
            shown = shown_condition(self.config.generator, batch.condition, batch.known)
            squared = (encode(batch.truth) - encode(shown)).float().square().mean(2)
            known, valid = (pooled(maps, size) > 0.99 for maps in (batch.known, batch.valid))
            for row, pixels in enumerate((valid & ~known, valid & known)):
                sums[row] += torch.stack([squared[pixels].sum(), pixels.sum()]).cpu()
        deviation = (sums[:, 0] / sums[:, 1].clamp(min=1)).sqrt().clamp(min=_MIN_DEVIATION)
        self.generator.denoiser.deviation.copy_(deviation)

    # --- the loop -----------------------------------------------------------------------------------------------------
    def train(self) -> bool:
        """Train to the last step, or until SIGTERM or SIGINT, and save; returns whether all steps are done.

        TrainingError if a loss or gradient is not finite, OutputError if the last state could not be saved.
        """
        config = self.config
        bar = tqdm(total=config.steps, initial=self.done, desc="train", unit="step", disable=not self.show)
        try:
            with stop_requests() as asked:
                for batch in self._batches():
                    terms = self.train_step(batch)
                    self.done += 1
                    bar.update()
                    last = self.done == config.steps
                    if self.done % _LOG_EVERY == 0 or last:
                        self._log({**terms, "lr": learning_rate(config, self.done - 1)})
                        bar.set_postfix({name: f"{value:.3f}" for name, value in terms.items()})
                    if self.done % config.validate_every == 0 or last:
                        self._validate()
                    stops = torch.tensor(float(len(asked)), device=self.device)
                    if self.accelerator.reduce(stops, "sum") > 0:  # all processes stop after the same step
                        break
                    if self.done % config.save_every == 0 and not last:
                        try:
                            self.save()
                        except OutputError as error:
                            self.say(f"step {self.done}: not saved, continuing with the last good state: {error}")
                self.save()
        finally:
            bar.close()
        if self.done < config.steps:
            self.say(f"stopped after step {self.done} of {config.steps}; saved: the same command goes on from there")
        return self.done == config.steps

    def train_step(self, batch: Batch) -> dict[str, float]:
        """Update the weights once; returns the loss terms, TrainingError if one or the gradient is not finite."""
        config = self.config
        number = self.done * self.accelerator.num_processes + self.accelerator.process_index
        rng = torch.Generator().manual_seed((10 * config.seed + _SEEDS["draws"]) * 2**32 + number)
        batch = batch.to(self.device)
        for group in self.optimiser.param_groups:
            group["lr"] = learning_rate(config, self.done)
        with_perceptual = self.perceptual is not None and self.done % config.loss.perceptual_every == 0
        terms = self.model(batch, draw(config, batch, rng), with_perceptual)
        total = self.step.total(terms)
        numbers = torch.stack([*terms.values(), total]).detach().tolist()  # one synchronisation with a GPU
        values = dict(zip((*terms, "total"), numbers, strict=True))
        self._check_finite({f"loss term {name}": value for name, value in values.items()}, batch)
        self.accelerator.backward(total)
        norm = self.accelerator.clip_grad_norm_(self.model.parameters(), config.max_grad_norm or math.inf)
        self._check_finite({"the norm of the gradient": float(norm)}, batch)
        self._optimiser.step()
        self._optimiser.zero_grad(set_to_none=True)
        self.average.step(self.trained.values())
        return values

    def _check_finite(self, values: dict[str, float], batch: Batch) -> None:
        for name, value in values.items():
            if not math.isfinite(value):
                raise TrainingError(
                    f"step {self.done}: {name} is {value}; the batch: {', '.join(batch.tokens)}. The last saved state "
                    "is from before; try a lower lr, or bf16 off"
                )

    def _batches(self) -> Iterator[Batch]:
        config, world = self.config, self.accelerator.num_processes
        first = range(self.done * world + self.accelerator.process_index, config.steps * world, world)
        numbers: Any = [range(n * config.batch, (n + 1) * config.batch) for n in first]
        return iter(DataLoader(self.items, batch_sampler=numbers, collate_fn=collate, **item_workers(config.workers)))

    def _log(self, values: Mapping[str, float]) -> None:
        """Append a line to the log; a full disk costs the line, not the run."""
        if self.is_main:
            with suppress(OSError), (self.output / "log.jsonl").open("a") as log:
                log.write(json.dumps({"step": self.done, **values}) + "\n")

    # --- saving -------------------------------------------------------------------------------------------------------
    def save(self) -> None:
        """Write the state, and the generator with averaged weights; after an OutputError the last is unchanged."""
        try:
            if self.is_main:
                kept = self.trained, self._buffers, self.average, self.optimiser
                save_state(self.output / "state", self._run, self.done, *kept)
                with averaged(self.average, self.trained.values()):
                    self.generator.save_pretrained(self.output / "generator")
        finally:  # the other processes wait in any case
            self.accelerator.wait_for_everyone()

    def _validate(self) -> None:
        """Log samples of fixed items by the averaged weights, and their mean PSNR inside the holes, in dB by method."""
        config, steps = self.config, max(2, self.config.generator.steps)
        if self.is_main:
            batch = collate([self.validation[k] for k in range(config.validation_items)]).to(self.device)
            methods = {"condition": batch.condition}
            with averaged(self.average, self.trained.values()):
                if config.loss.regression:
                    methods["one_step"] = sampled(self.generator, batch, steps=1, seed=0)
                methods[f"{steps}_steps"] = samples = sampled(self.generator, batch, steps=steps, seed=0)
            inside = {name: hole_psnr(made, batch.truth, batch.holes) for name, made in methods.items()}
            scores, image = {name: float(psnr.nanmean()) for name, psnr in inside.items()}, picture(batch, samples)
            self._log({f"hole_psnr/{name}": value for name, value in scores.items()})
            try:
                save_picture(self.output / "validation" / f"{self.done:06d}.png", image)
            except DataError as error:
                self.say(str(error))
            numbers = ", ".join(f"{name} {value:.2f}" for name, value in scores.items())
            self.say(f"step {self.done}: PSNR inside the holes, dB: {numbers}")
        self.accelerator.wait_for_everyone()


def learning_rate(config: TrainConfig, step: int) -> float:
    """Linear warm-up, then a cosine to 0 at the last step (Sec. Training Parameters); a function of the step alone."""
    if step < config.warmup:
        return config.lr * (step + 1) / config.warmup
    done = (step - config.warmup) / max(1, config.steps - config.warmup)
    return config.lr * 0.5 * (1 + math.cos(math.pi * min(1.0, done)))


# --- validation -------------------------------------------------------------------------------------------------------
@torch.no_grad()
def sampled(generator: Generator, batch: Batch, *, steps: int, seed: int, pasted: bool = True) -> torch.Tensor:
    """Sample a batch's targets: (B, N, 3, H, W) images in [0, 1], known pixels of FAVS ``pasted`` as at inference."""
    config = replace(generator.config, steps=steps)
    size = (*batch.truth.shape[:2], config.autoencoder.latent_channels, *config.latent_size)
    noise = torch.randn(size, generator=torch.Generator().manual_seed(seed)).to(batch.truth.device)
    images = denoised(generator, config, batch.geometry, batch.conditions, noise).clamp(0, 1)
    return torch.where(batch.known[:, :, None], batch.favs, images) if pasted else images


def hole_psnr(images: torch.Tensor, truth: torch.Tensor, holes: torch.Tensor) -> torch.Tensor:
    """(B,) PSNR in dB of images (B, N, 3, H, W) in [0, 1] inside the holes (B, N, H, W); NaN without any."""
    error = ((images - truth) ** 2).mean(2) * holes
    mse = error.sum((1, 2, 3)) / holes.sum((1, 2, 3))
    return -10 * torch.log10(mse.clamp(min=1e-10))


COLUMNS = ("source", "FAVS", "mask", "filled", "sample", "truth")


def picture(batch: Batch, samples: torch.Tensor) -> np.ndarray:
    """(height, width, 3) uint8: a row for each item of a batch with samples (B, N, 3, H, W), a column for each view."""
    mask = batch.known[:, :, None].float().expand_as(batch.favs)
    columns = (batch.sources, batch.favs, mask, batch.condition, samples, batch.truth)
    views = torch.cat([views[:, :1] for views in columns], 1).cpu().clamp(0, 1) * 255
    rows = views.permute(0, 1, 3, 4, 2).numpy()  # [B, columns, h, w, 3]
    width = len(COLUMNS) * max(120, rows.shape[3])  # smaller views are enlarged
    titled = [(token, list(row), COLUMNS) for token, row in zip(batch.tokens, rows, strict=True)]
    return contact_sheet(titled, width_px=width)


# --- the command ------------------------------------------------------------------------------------------------------
def run(arguments: argparse.Namespace, say: Callable[[str], None] = print) -> int:
    config = overridden(CONFIGS[arguments.config], arguments.set)
    output = Path(arguments.output)
    writable_folder(output, arguments.output)
    accelerate = optional_package("accelerate", "generator")
    processes = accelerate.PartialState(cpu=not torch.cuda.is_available(), timeout=_TIMEOUT)
    options: dict[str, Any] = {"show": processes.is_main_process and not arguments.quiet, "say": say}
    has_state(output)  # refuses a generator without one
    settings, weights = config.generator, arguments.weights
    where = f"--config {settings.name}"
    if settings.frozen_unet and weights is None:
        model = f"Stable Diffusion 1.5{' inpainting' if settings.inpainting else ''} in diffusers' layout"
        raise TrainingError(f"{where}: expected --weights, a folder or hub id of {model}, for its frozen U-Net")
    if not settings.frozen_unet and weights is not None:
        raise TrainingError(f"--weights: expected none for {where}, which is trained from scratch")
    if not settings.frozen_unet and settings.autoencoder.widths:
        fix = "generator.autoencoder.widths=[] (squares of pixels), or a --config of --weights"
        raise TrainingError(f"{where}: an autoencoder is not trained: expected {fix}")
    options["perceptual"] = load_perceptual(arguments.vgg_weights) if config.loss.perceptual else None
    data = arguments.data or "synthetic"
    frames = open_frames(data, settings.image_size, scenes=config.scenes, seed=config.seed)
    if data == "synthetic":
        split = frames.split(config.seed)
        used = [*split.training, *split.validation]
        # Each process takes a second to start, a street half a second to render.
        readers = min(8, os.cpu_count() or 1) if len(used) >= 16 else 0
        frames.prepare(used, workers=readers, show=options["show"])
    torch.manual_seed(config.seed)
    made = Generator.from_config(settings) if weights is None else Generator.from_stable_diffusion(weights, settings)
    Trainer(config, frames, made.to(processes.device), output, **options).train()
    return 0
