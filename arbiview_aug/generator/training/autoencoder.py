"""First training stage: a small KL autoencoder (Rombach et al. 2022), for configurations without pretrained weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader, Dataset
from tqdm import tqdm

from arbiview_aug.errors import GeneratorError, TrainingError
from arbiview_aug.generator import Generator
from arbiview_aug.generator.checkpoint import CONFIG_FILE, load_weights, read_checkpoint, write_checkpoint
from arbiview_aug.generator.training.config import AutoencoderTraining, TrainConfig
from arbiview_aug.generator.training.data import Frames, item_workers
from arbiview_aug.generator.training.losses import Perceptual
from arbiview_aug.generator.training.pseudo_views import one_of

_SCALE_IMAGES = 64  # number of images that set the latents' scale, to within 0.1 %
_MESSAGE_EVERY = 250


def train_autoencoder(
    config: TrainConfig,
    frames: Frames,
    generator: Generator,
    output: Path,
    *,
    perceptual: Perceptual | None = None,
    show: bool = True,
    say: Callable[[str], None] = print,
) -> None:
    """Train a generator's autoencoder in place and save it, or load the one in ``output``.

    L1 + KL, and VGG's distance if there are weights (Rombach et al. 2022, without their discriminator). Afterwards
    latents are scaled to unit variance. The stage takes minutes; a stopped one starts again. Does nothing without
    settings of this stage; the other arguments are those of ``Trainer``. TrainingError if the saved one has another
    architecture, or a loss is not finite.
    """
    stage, vae, folder = config.autoencoder, generator.autoencoder.vae, output / "autoencoder"
    if stage is None or vae is None:
        return
    if (folder / CONFIG_FILE).is_file():
        try:
            data, tensors = read_checkpoint(folder)
            load_weights(vae, tensors, folder)
        except GeneratorError as error:
            raise TrainingError(f"{error}; delete {folder} to train another autoencoder") from None
        generator.autoencoder.scale = float(data["scale"])
        return
    if perceptual is not None:
        perceptual.to(generator.device)
    optimiser = torch.optim.AdamW(vae.parameters(), lr=stage.lr)
    vae.train()
    batches = _Batches(frames, frames.split(config.seed).training, stage.batch, config.seed)
    workers: Any = item_workers(config.workers)
    bar = tqdm(
        DataLoader(batches, batch_size=None, sampler=range(stage.steps), **workers),
        desc="autoencoder",
        unit="step",
        disable=not show,
    )
    for step, on_cpu in enumerate(bar):
        rng = torch.Generator().manual_seed((2 * config.seed + 1) * 2**32 + step)
        images = on_cpu.to(generator.device).float() / 255
        terms = _terms(vae, images, stage, perceptual, rng, bf16=config.precision == "bf16")
        losses = torch.stack(list(terms.values()))
        values = dict(zip(terms, losses.tolist(), strict=True))
        for name, value in values.items():
            if not math.isfinite(value):
                raise TrainingError(f"autoencoder, step {step}: loss term {name} is {value}; lower its lr")
        losses.sum().backward()
        torch.nn.utils.clip_grad_norm_(vae.parameters(), 1.0)
        optimiser.step()
        optimiser.zero_grad(set_to_none=True)
        bar.set_postfix({name: f"{value:.4f}" for name, value in values.items()})
        if step % _MESSAGE_EVERY == 0:
            say(f"autoencoder, step {step}: L1 {255 * values['l1']:.2f} grey levels")
    vae.eval()
    batches.count = _SCALE_IMAGES
    with torch.no_grad():
        images = batches[stage.steps].to(generator.device).float() / 255
        deviation = torch.cat([vae.encode(part * 2 - 1).latent_dist.mode() for part in images.split(8)]).std()
    generator.autoencoder.scale = float(1 / deviation)
    write_checkpoint(folder, {"scale": generator.autoencoder.scale, "training": asdict(stage)}, vae.state_dict())


def _terms(
    vae: Any,
    images: torch.Tensor,
    stage: AutoencoderTraining,
    perceptual: Perceptual | None,
    rng: torch.Generator,
    bf16: bool,
) -> dict[str, torch.Tensor]:
    """Weighted ``l1``, ``kl`` and, with VGG, ``perceptual`` of images (n, 3, H, W) in [0, 1]."""
    with torch.autocast(images.device.type, torch.bfloat16, enabled=bf16):
        posterior = vae.encode(images * 2 - 1).latent_dist
        noise = torch.randn(posterior.mean.shape, generator=rng).to(images.device)
        decoded = vae.decode(posterior.mean + posterior.std * noise).sample
    decoded = decoded.float() / 2 + 0.5
    terms = {"l1": (decoded - images).abs().mean(), "kl": stage.kl * posterior.kl().float().mean()}
    if perceptual is not None:
        terms["perceptual"] = stage.perceptual * perceptual(decoded, images).mean()
    return terms


class _Batches(Dataset[torch.Tensor]):
    """Batches (count, 3, H, W) uint8, half mirrored, each drawn from (seed, step) alone."""

    def __init__(self, frames: Frames, indices: list[int], count: int, seed: int) -> None:
        self.frames, self.indices, self.count, self.seed = frames, indices, count, seed

    def __getitem__(self, step: int) -> torch.Tensor:
        rng = torch.Generator().manual_seed(2 * self.seed * 2**32 + step)
        images: list[torch.Tensor] = []
        while len(images) < self.count:
            drawn = self.frames[self.indices[one_of(rng, len(self.indices))]].images
            images += [image.flip(-1) if one_of(rng, 2) else image for image in drawn]
        return torch.stack(images[: self.count]).cpu()
