"""``python -m integrations.benchmarks.cost --config paper inpaint``: cost of a training step, computed without a GPU.

Networks and tensors lie on torch's meta device, which keeps shapes alone; cameras and pseudo poses are a street's.
Counted are the FLOP of matrix products and convolutions (a multiplication and an addition are two), and the bytes that
the backward pass keeps in bfloat16; autocast keeps some in float32, and checkpointing recomputes them. Nothing is
measured.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import torch
from torch.utils.flop_counter import FlopCounterMode

from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.generator import Generator
from arbiview_aug.generator.conditioning import FrameGeometry
from arbiview_aug.generator.denoiser import Rows
from arbiview_aug.generator.training.config import CONFIGS, TrainConfig, overridden
from arbiview_aug.generator.training.data import open_frames
from arbiview_aug.generator.training.pseudo_views import PseudoViews, collate
from integrations.benchmarks.study import run_study, study_parser

SUSTAINED_TFLOPS = (120, 350)
"""About 40 % of the dense bfloat16 peak of an A100 (312) and of an H100 (989): an assumption."""

HEADINGS = (
    *("`--config`", "trained, M", "frozen, M", "targets + sources a step", "TFLOP a step", "of these VAE"),
    "GB without checkpointing, at least",
    *(f"hours for 100,000 steps at {rate} TFLOP/s" for rate in SUSTAINED_TFLOPS),
)


def geometry_of(config: TrainConfig) -> FrameGeometry:
    """The geometry of a step's items on a street."""
    size = config.generator.image_size
    frames = open_frames("synthetic", size, scenes=1)
    masks = torch.ones(1, *size, dtype=torch.bool)
    items = PseudoViews(frames, [0], config.pseudo_views, config.generator, masks, seed=0)
    return collate([items[k] for k in range(config.batch)]).geometry


def step_cost(config: TrainConfig) -> dict[str, float]:
    """Parameters, FLOP and bytes of one step."""
    geometry = geometry_of(config)
    with torch.device("meta"):
        generator = Generator.from_config(config.generator)
    denoiser, vae = generator.denoiser, generator.autoencoder.vae  # ``Autoencoder`` asks for autocast, unknown to meta
    generator.autoencoder.requires_grad_(False)
    parameters = [(p.requires_grad, p.numel()) for p in generator.parameters()]
    trained, frozen = (sum(n for is_trained, n in parameters if is_trained == kind) for kind in (True, False))
    generator.to(torch.bfloat16)
    B, N = geometry.target_pose.shape[:2]
    S = geometry.source_pose.shape[1]
    # --- the denoiser, forward and backward
    latent = (config.generator.autoencoder.latent_channels, *config.generator.latent_size)
    windows = [
        [type(w)(*(v.to("meta") for v in w)) for w in make()]
        for make in (geometry.target_windows, geometry.source_windows)
    ]
    geometry = geometry.to("meta")

    def views(count: int, make: Any) -> Any:
        maps = torch.zeros(B, count, *config.generator.latent_size, device="meta")
        return make(torch.zeros(B, count, *latent, device="meta"), maps, maps)

    kept: dict[int, torch.UntypedStorage] = {}
    own = {p.untyped_storage()._cdata for p in generator.parameters()}

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        storage = tensor.untyped_storage()
        if storage._cdata not in own:
            kept[storage._cdata] = storage  # referenced, so that no later one has its number
        return tensor

    rows: list[Rows] | None = [] if config.loss.geo else None
    with FlopCounterMode(display=False) as counter:
        with torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor):
            sources = denoiser.read_sources(views(S, geometry.source_views), windows[1])
            t = torch.zeros(B, dtype=torch.long, device="meta")
            noisy = torch.zeros(B, N, *latent, device="meta")
            out = denoiser(noisy, t, views(N, geometry.target_views), windows[0], sources, rows)
            loss = out.float().sum() + sum(row.predicted.sum() for row in rows or [])
        forward = counter.get_total_flops()
        loss.backward()
    flop = counter.get_total_flops() + config.checkpointing * forward
    # --- the autoencoder: condition and sources; the decoder of L_perceptual
    encoded, decoded = 0.0, 0.0
    if vae is not None:
        image = torch.zeros(1, 3, *config.generator.image_size, device="meta", dtype=torch.bfloat16)
        with FlopCounterMode(display=False) as counter, torch.no_grad():
            vae.encode(image)
        encoded = B * (N + S) * counter.get_total_flops()
        with FlopCounterMode(display=False) as counter:
            one = torch.zeros(1, *latent, device="meta", dtype=torch.bfloat16, requires_grad=True)
            vae.decode(one).sample.sum().backward()
        share = bool(config.loss.perceptual) * config.loss.perceptual_below_t / 1000 / config.loss.perceptual_every
        decoded = B * N * share * counter.get_total_flops()
    # Frozen weights in float32 and autocast's copy; the trained ones with gradient, AdamW's two moments, the average.
    held = 6 * frozen + (4 * 5 + 2) * trained + sum(storage.nbytes() for storage in kept.values())
    total = flop + encoded + decoded
    found = {"trained": trained, "frozen": frozen, "targets": B * N, "sources": B * S, "flop": total}
    return found | {"vae": encoded + decoded, "bytes": held}


def row(name: str, cost: dict[str, float]) -> list[str]:
    """One line of the table."""
    hours = [f"{cost['flop'] * 1e5 / (rate * 1e12) / 3600:.0f}" for rate in SUSTAINED_TFLOPS]
    numbers = [f"{cost['trained'] / 1e6:.0f}", f"{cost['frozen'] / 1e6:.0f}"]
    numbers.append(f"{cost['targets']:.0f} + {cost['sources']:.0f}")
    return [
        f"`{name}`",
        *numbers,
        f"{cost['flop'] / 1e12:.1f}",
        f"{cost['vae'] / 1e12:.1f}",
        f"{cost['bytes'] / 1e9:.0f}",
        *hours,
    ]


def main(argv: Sequence[str] | None = None) -> int:
    """Print the table; the exit status."""
    return run_study(parser(), _run, argv)


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    parser = study_parser("cost", "What a training step costs, computed.", "--config paper --set batch=4")
    parser.add_argument("--config", nargs="+", choices=tuple(CONFIGS), default=["paper", "inpaint"], help="presets")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting, such as batch=4")
    return parser


def _run(arguments: argparse.Namespace) -> None:
    table = [row(name, step_cost(overridden(CONFIGS[name](), arguments.set))) for name in arguments.config]
    print(markdown_table(HEADINGS, table))


if __name__ == "__main__":
    sys.exit(main())
