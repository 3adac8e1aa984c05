"""The training loop and its command (Algorithm 1): steps, averaging, logs, validation, and the state to resume from.

Learning rates are functions of the step, and every draw comes from (seed, step): the state is the weights, their
averages, the deviation and the optimiser. A resumed run equals one that never stopped.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import cv2
import torch
from torch import nn
from torch.utils.data import DataLoader
from tqdm import tqdm

from arbiview_aug.cli.arguments import writable_folder
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import GeneratorError, OutputError, TrainingError, one_line, shown
from arbiview_aug.generator.completion import denoised, shown_condition
from arbiview_aug.generator.conditioning import pooled
from arbiview_aug.generator.config import CONFIGS, TrainConfig, overridden
from arbiview_aug.generator.generator import FILE, Generator, read_checkpoint, write_checkpoint
from arbiview_aug.generator.training.losses import Perceptual, Step, draw, load_perceptual
from arbiview_aug.generator.training.pseudo_views import Batch, Frames, PseudoViews, collate, open_frames
from arbiview_aug.inpaint.inpainter import digest_of

_LOG_EVERY = 10
_DEVIATION_ITEMS = 32
_MIN_DEVIATION = 0.02  # lower bound of the residual's deviation, 2.5 grey levels: the error of rendering twice
_TIMEOUT = timedelta(hours=3)  # of a process that waits for the others: they validate and save
_SEEDS = {"items": 1, "validation": 2, "draws": 4}  # offsets: no stream sees another's draws
_MAY_DIFFER = ("workers", "save_every", "validate_every", "validation_items")  # in a resumed run


class Trainer:
    """Training of a generator's denoiser (Algorithm 1), on one process or many.

    The output folder gets ``generator/`` (averaged weights, for ``Generator.from_pretrained``), ``state/`` (to resume
    from) and ``log.jsonl`` (losses and scores by step).

    Args:
        generator: Trained in place on the ``frames``; its autoencoder is frozen.
        output: Folder; the run resumes from a state that it holds.
        perceptual: VGG16 for L_perceptual; None only with ``loss.perceptual=0``.
        show: Show a progress bar.
        say: Called with messages.

    Raises:
        TrainingError: The output holds a run with other settings, data, frozen weights or number of processes, or a
            generator without a state; the generator is frozen or has another configuration; VGG16 is missing.
        ImportError: accelerate is not installed.
        ValueError: The process has trained in another precision.
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
        options = {"mixed_precision": config.precision, "cpu": not torch.cuda.is_available()}
        self.accelerator = accelerate.Accelerator(**options)
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
        generator.trained_on = {"data": frames.name, "seed": config.seed, "held_out": self.split.held_out}
        self.perceptual = perceptual.to(self.device) if config.loss.perceptual and perceptual is not None else None
        self.step = Step(config, generator.denoiser, generator.autoencoder, self.perceptual)
        trained = {n: p for n, p in generator.denoiser.named_parameters() if p.requires_grad}
        if not trained:
            raise TrainingError(
                "Trainer: expected weights to train, got a generator that is frozen, as from_pretrained loads it: call "
                "generator.denoiser.requires_grad_(True), with frozen_unet on each of own_parameters() alone"
            )
        optimiser = torch.optim.AdamW(trained.values(), lr=config.lr, weight_decay=config.weight_decay)
        ema = optional_package("diffusers.training_utils", "generator").EMAModel
        frozen: list[torch.Tensor] = [p for p in generator.parameters() if not p.requires_grad]
        frozen += [generator.denoiser.context.empty_prompt, *(self.perceptual.parameters() if self.perceptual else ())]
        run = {
            **asdict(config),
            "data": generator.trained_on,
            "frozen weights": digest_of(frozen),
            "number of processes": self.accelerator.num_processes,
        }
        buffers = {"deviation": generator.denoiser.deviation} if config.generator.residual else {}
        average = ema(trained.values(), decay=config.ema, foreach=True)
        self.state = RunState(self.output / "state", run, trained, buffers, average, optimiser)
        self.done, is_resumed = 0, has_state(self.output)
        if is_resumed:
            self.done = self.state.load()
            self.say(f"going on after step {self.done} of {self.state.folder}")
        # The optimiser is not placed: AdamW's step counters on a GPU would synchronise one by one.
        self.model, self._optimiser = self.accelerator.prepare(self.step, optimiser, device_placement=[True, False])
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
            shown = shown_condition(self.config.generator, batch.targets)
            squared = (encode(batch.truth) - encode(shown)).float().square().mean(2)
            known, valid = (pooled(maps, size) > 0.99 for maps in (batch.targets.known, batch.valid))
            for row, pixels in enumerate((valid & ~known, valid & known)):
                sums[row] += torch.stack([squared[pixels].sum(), pixels.sum()]).cpu()
        deviation = (sums[:, 0] / sums[:, 1].clamp(min=1)).sqrt().clamp(min=_MIN_DEVIATION)
        self.generator.denoiser.deviation.copy_(deviation)

    # --- the loop -----------------------------------------------------------------------------------------------------
    def train(self) -> None:
        """Train to the last step, and save.

        TrainingError if a loss or gradient is not finite, OutputError if the last state could not be saved.
        """
        config = self.config
        bar = tqdm(total=config.steps, initial=self.done, desc="train", unit="step", disable=not self.show)
        with bar:
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
                if self.done % config.save_every == 0 and not last:
                    try:
                        self.save()
                    except OutputError as error:
                        self.say(f"step {self.done}: not saved, continuing with the last good state: {error}")
            self.save()

    def train_step(self, batch: Batch) -> dict[str, float]:
        """Update the weights once; returns loss terms and the gradient's norm. TrainingError if one is not finite."""
        config = self.config
        number = self.done * self.accelerator.num_processes + self.accelerator.process_index
        rng = torch.Generator().manual_seed((10 * config.seed + _SEEDS["draws"]) * 2**32 + number)
        batch = batch.to(self.device)
        for group in self.state.optimiser.param_groups:
            group["lr"] = learning_rate(config, self.done)
        with_perceptual = self.perceptual is not None and self.done % config.loss.perceptual_every == 0
        terms = self.model(batch, draw(config, batch, rng), with_perceptual)
        total = self.step.total(terms)
        self.accelerator.backward(total)
        norm = self.accelerator.clip_grad_norm_(self.model.parameters(), config.max_grad_norm or math.inf)
        numbers = torch.stack([*terms.values(), total, norm]).detach().tolist()  # one synchronisation with a GPU
        values = dict(zip((*terms, "total", "gradient_norm"), numbers, strict=True))
        for name, value in values.items():
            if not math.isfinite(value):
                raise TrainingError(
                    f"step {self.done}: expected finite losses and gradients, got {name} {value}; the batch: "
                    f"{', '.join(batch.tokens)}. The last saved state is from before; try a lower lr, or bf16 off"
                )
        self._optimiser.step()
        self._optimiser.zero_grad(set_to_none=True)
        self.state.average.step(self.state.parameters.values())
        return values

    def _batches(self) -> Iterator[Batch]:
        config, world = self.config, self.accelerator.num_processes
        first = range(self.done * world + self.accelerator.process_index, config.steps * world, world)
        numbers: Any = [range(n * config.batch, (n + 1) * config.batch) for n in first]
        workers: dict[str, Any] = {"num_workers": config.workers}
        if config.workers:  # not the default from Python 3.14: workers share what was read
            workers |= {"multiprocessing_context": "fork", "worker_init_fn": lambda worker: cv2.setNumThreads(0)}
        return iter(DataLoader(self.items, batch_sampler=numbers, collate_fn=collate, **workers))

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
                self.state.save(self.done)
                with self.state.averaged():
                    self.generator.save_pretrained(self.output / "generator")
        finally:  # the other processes wait in any case
            self.accelerator.wait_for_everyone()

    def _validate(self) -> None:
        """Log the mean PSNR inside the holes, in dB by method, of fixed items sampled by the averaged weights."""
        config, steps = self.config, max(2, self.config.generator.steps)
        if self.is_main:
            batch = collate([self.validation[k] for k in range(config.validation_items)]).to(self.device)
            methods = {"condition": batch.targets.images}
            with self.state.averaged():
                if config.loss.regression:
                    methods["one_step"] = sampled(self.generator, batch, steps=1, seed=0)
                methods[f"{steps}_steps"] = sampled(self.generator, batch, steps=steps, seed=0)
            inside = {name: hole_psnr(made, batch.truth, batch.holes) for name, made in methods.items()}
            scores = {name: float(psnr.nanmean()) for name, psnr in inside.items()}
            self._log({f"hole_psnr/{name}": value for name, value in scores.items()})
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
    images = denoised(generator, config, batch.targets, batch.sources, noise).clamp(0, 1)
    return torch.where(batch.targets.known[:, :, None], batch.favs, images) if pasted else images


def hole_psnr(images: torch.Tensor, truth: torch.Tensor, holes: torch.Tensor) -> torch.Tensor:
    """(B,) PSNR in dB of images (B, N, 3, H, W) in [0, 1] inside the holes (B, N, H, W); NaN without any."""
    error = ((images - truth) ** 2).mean(2) * holes
    mse = error.sum((1, 2, 3)) / holes.sum((1, 2, 3))
    return -10 * torch.log10(mse.clamp(min=1e-10))


# --- the state of a run ----------------------------------------------------------------------------------------------
def has_state(output: Path) -> bool:
    """Whether a run's folder has a state to resume from; TrainingError for a generator without one.

    A run writes its state first: a killed first save leaves a state or neither, and can be resumed.
    """
    if (output / "state" / FILE).is_file():
        return True
    generator = output / "generator"
    if generator.exists():
        raise TrainingError(
            f"{generator}: expected none, since {output / 'state'} holds no state to go on from, and a new run would "
            f"replace the generator; give another --output, or remove {generator}"
        )
    return False


@dataclass
class RunState:
    """All that a run needs to be resumed. Accelerate's ``save_state`` pickles, and writes into the folder in place."""

    folder: Path
    run: Mapping[str, Any]  # plain data that must be the same in a resumed run
    parameters: Mapping[str, nn.Parameter]
    buffers: Mapping[str, torch.Tensor]
    average: Any  # diffusers' ``EMAModel`` of the parameters
    optimiser: torch.optim.Optimizer

    def save(self, step: int) -> None:
        """Write the state after ``step`` steps; OutputError if it fails, and the last state is unchanged."""
        tensors = {f"weights.{name}": parameter.detach() for name, parameter in self.parameters.items()}
        tensors |= {f"buffers.{name}": value for name, value in self.buffers.items()}
        averages = zip(self.parameters, self.average.shadow_params, strict=True)
        tensors |= {f"average.{name}": value for name, value in averages}
        for k, state in self.optimiser.state_dict()["state"].items():
            tensors |= {f"optimiser.{k}.{key}": torch.as_tensor(value) for key, value in state.items()}
        write_checkpoint(self.folder, {"step": step, "training": self.run}, tensors)

    def load(self) -> int:
        """Load the saved state; returns its steps. TrainingError for another ``run``, or a broken state."""
        now = json.loads(json.dumps(self.run))
        try:
            data, tensors = read_checkpoint(self.folder)
            before, step = dict(data["training"]), data["step"]
            changed = [name for name in now | before if name not in _MAY_DIFFER and before.get(name) != now.get(name)]
            if changed:
                fix = "resume with the same ones, or give another --output"
                raise TrainingError(f"{self.folder}: a run with other {', '.join(changed)}; {fix}")
            if type(step) is not int or not 0 <= step <= now["steps"]:
                raise ValueError(f"step: expected 0 to {now['steps']}, got {shown(step)}")
            for (name, parameter), shadow in zip(self.parameters.items(), self.average.shadow_params, strict=True):
                parameter.data.copy_(tensors[f"weights.{name}"])
                shadow.copy_(tensors[f"average.{name}"])
            for name, buffer in self.buffers.items():
                buffer.copy_(tensors[f"buffers.{name}"])
            self.average.optimization_step = step
            states: dict[int, dict[str, torch.Tensor]] = {}
            for name, value in tensors.items():
                if name.startswith("optimiser."):
                    _, k, key = name.split(".")
                    states.setdefault(int(k), {})[key] = value
            self.optimiser.load_state_dict({**self.optimiser.state_dict(), "state": states})
        except TrainingError:
            raise
        except (GeneratorError, KeyError, RuntimeError, TypeError, ValueError) as error:
            text = f"{one_line(error)}; delete it, or give another --output"
            raise TrainingError(f"{self.folder}: expected the state of a training run: {text}") from None
        return step

    @contextmanager
    def averaged(self) -> Iterator[None]:
        """Put the averaged weights into the parameters for a while."""
        self.average.store(self.parameters.values())
        self.average.copy_to(self.parameters.values())
        try:
            yield
        finally:
            self.average.restore(self.parameters.values())


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
        model = "Stable Diffusion 1.5 in diffusers' layout, for its frozen U-Net"
        raise TrainingError(f"{where}: expected --weights, a folder or hub id of {model}")
    if not settings.frozen_unet and weights is not None:
        raise TrainingError(f"--weights: expected none for {where}, which is trained from scratch")
    if not settings.frozen_unet and settings.autoencoder.widths:
        fix = "generator.autoencoder.widths=[] (squares of pixels), or a --config of --weights"
        raise TrainingError(f"{where}: an autoencoder is not trained: expected {fix}")
    options["perceptual"] = load_perceptual(arguments.vgg_weights) if config.loss.perceptual else None
    data = arguments.data or "synthetic"
    frames = open_frames(data, settings.image_size, scenes=config.scenes, seed=config.seed)
    torch.manual_seed(config.seed)
    made = Generator.from_config(settings) if weights is None else Generator.from_stable_diffusion(weights, settings)
    Trainer(config, frames, made.to(processes.device), output, **options).train()
    return 0
