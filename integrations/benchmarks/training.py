"""``python -m integrations.benchmarks.training``: train variants of the settings and score each on held-out streets."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from arbiview_aug.cli.arguments import add_output, count, writable_folder
from arbiview_aug.errors import INTERRUPTED, DataError
from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.generator import Generator
from arbiview_aug.generator.conditioning import FrameGeometry
from arbiview_aug.generator.correspondence import Correspondence
from arbiview_aug.generator.denoiser import REGRESSION, Rows
from arbiview_aug.generator.training.command import fresh
from arbiview_aug.generator.training.config import CONFIGS, PseudoViewConfig, TrainConfig, overridden
from arbiview_aug.generator.training.data import Frames, open_frames
from arbiview_aug.generator.training.held_out import gains, held_out_scores, mean_hole_psnr, sampled, spread
from arbiview_aug.generator.training.losses import without_attention
from arbiview_aug.generator.training.pseudo_views import Batch, PseudoViews, collate
from arbiview_aug.generator.training.trainer import Trainer
from integrations.benchmarks.study import run_study, study_parser

_AS_WRITTEN = (
    "pseudo_views.p_mask_transfer=0",
    "generator.prefilled=false",
)

VARIANTS: dict[str, tuple[str, ...]] = {
    "as written": _AS_WRITTEN,
    "+ transferred masks": _AS_WRITTEN[1:],
    "+ pre-filled condition": (),
    "without L_geo": ("loss.geo=0",),
    "without attention": ("attention=false",),
}
"""Settings of each variant, on top of the run's own."""

SEEN_ITEMS = 32
"""Number of held-out real views whose condition is masked where a source branch shows the pixels."""


def wrong_rig(geometry: FrameGeometry) -> FrameGeometry:
    """The geometry with the homographies of another frame of the batch; rays and poses stay."""
    return geometry.with_reads(lambda reads: Correspondence(*(value.roll(1, 0) for value in reads)))


@torch.no_grad()
def correct_correspondences(generator: Generator, batch: Batch) -> float:
    """Share of the attention's rows whose largest weight lies on the tap nearest to H p_i."""
    geometry, denoiser = batch.geometry, generator.denoiser
    views, source_views = batch.conditions.encoded(generator.config, generator.autoencoder, geometry)
    sources = denoiser.read_sources(source_views, geometry.source_windows())
    rows: list[Rows] = []
    t = torch.full((len(views.latent),), REGRESSION, device=views.latent.device)
    denoiser(views.latent, t, views, geometry.target_windows(), sources, rows)
    right = torch.cat([(row.predicted.argmax(1) == row.target.argmax(1)).float() for row in rows])
    return float(right.mean())


def seen_scores(generator: Generator, batch: Batch) -> dict[str, float]:
    """Mean PSNR in a batch's holes in one step, with the right homographies, without attention and a wrong rig's."""
    right = batch.geometry
    geometries = {"seen": right, "without": without_attention(right), "wrong rig": wrong_rig(right)}
    images = {name: sampled(generator, batch._replace(geometry=g), steps=1, seed=0) for name, g in geometries.items()}
    return mean_hole_psnr(images, batch)


def seen_batch(frames: Frames, indices: Sequence[int], config: TrainConfig, masks: torch.Tensor) -> Batch:
    """Items whose holes a source branch shows, which attention can fill."""
    settings = PseudoViewConfig(p_mask_transfer=1.0, hidden=0.0, p_translate=config.pseudo_views.p_translate)
    items = PseudoViews(frames, indices, settings, config.generator, masks, seed=77)
    return collate([items[k] for k in range(SEEN_ITEMS)])


def ablate(config: TrainConfig, frames: Frames, output: Path, *, views: int = 64, show: bool = True) -> dict[str, Any]:
    """Train and score each variant on synthetic streets, and write ``training.json``; a stopped study resumes.

    Each variant gets a folder in ``output`` and is scored on ``views`` held-out views.
    """
    split = frames.split(config.seed)
    indices = spread(split.held_out or split.validation, views)
    if not indices:
        raise DataError(f"{frames.name}: expected two scenes or more, one of them to score on; found one")
    table: dict[str, dict[str, Any]] = {}
    for variant, settings in VARIANTS.items():
        changed = overridden(config, settings)
        folder = output / variant.replace(" ", "_").replace("+", "with")
        trainer = Trainer(changed, frames, fresh(changed, None), folder, show=show)
        if not trainer.train():
            return table  # stopped by a signal
        generator = Generator.from_pretrained(folder / "generator").to(trainer.device)
        batch = seen_batch(frames, indices, changed, trainer.items.masks).to(trainer.device)
        scores = held_out_scores(generator, frames, indices, steps=config.generator.steps, mean_of=0, show=show)
        gain = gains(scores, [frames.scenes[index] for index in indices])
        table[variant] = {
            "against Telea": {name: interval._asdict() for name, interval in gain.items()},
            "seen by a source": seen_scores(generator, batch),
            "top-1": correct_correspondences(generator, batch),
        }
        (output / "training.json").write_text(json.dumps(table, indent=1) + "\n")
    print(text_of(table))
    return table


def text_of(table: dict[str, dict[str, Any]]) -> str:
    """Format the scores: gains over Telea on held-out targets, then PSNR where a source sees the hole, in one step."""
    rows = []
    for variant, row in table.items():
        gain = row["against Telea"]  # of the methods that the settings train
        cells = [f"{gain[method]['mean']:+.2f}" if method in gain else "" for method in ("one_step", "sample")]
        cells += [f"{psnr:.2f}" for psnr in row["seen by a source"].values()]
        rows.append([variant, *cells, f"{row['top-1']:.0%}"])
    return markdown_table(("dB in the holes", "one step", "sample", "seen", "without", "wrong rig", "top-1"), rows)


def main(argv: Sequence[str] | None = None) -> int:
    """Train, score and print the table; the exit status, ``INTERRUPTED`` if a signal stopped it."""
    return run_study(parser(), _run, argv, resumable=True)


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    text = "Train variants of the settings, and score each on held-out streets. Run it again to go on where it stopped."
    parser = study_parser("training", text, "--set steps=200 --views 32")
    add = parser.add_argument
    scratch = [name for name, make in CONFIGS.items() if not make().generator.frozen_unet]
    add("--config", choices=scratch, default="tiny", help="preset of all settings, trained from scratch")
    add("--data", default="synthetic", metavar="DATA", help="synthetic, or real frames with their kind, KIND:PATH")
    add_output(parser, "folder of the runs")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting, such as steps=100 or loss.geo=0")
    add("--views", type=count, default=64, metavar="N", help="number of held-out views to score")
    add("--quiet", action="store_true", help="no progress bars")
    return parser


def _run(arguments: argparse.Namespace) -> int:
    config = overridden(CONFIGS[arguments.config](), arguments.set)
    folder = writable_folder(Path(arguments.output), arguments.output)
    frames = open_frames(arguments.data, config.generator.image_size, scenes=config.scenes, seed=config.seed)
    table = ablate(config, frames, folder, views=arguments.views, show=not arguments.quiet)
    return 0 if len(table) == len(VARIANTS) else INTERRUPTED


if __name__ == "__main__":
    sys.exit(main())
