"""``python -m arbiview_aug.train``: train a generator, or score it on held-out frames."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from arbiview_aug.cli.arguments import add_output, command_parser, count
from arbiview_aug.datasets.registry import READERS
from arbiview_aug.errors import exit_status
from arbiview_aug.generator.training.command import COMMANDS, run
from arbiview_aug.generator.training.config import CONFIGS


def parser() -> argparse.ArgumentParser:
    """The parser of the arguments."""
    found = command_parser(
        "",
        "CVC-SSL: train a generator to reconstruct real views from pseudo views beside them. The same command with the "
        "same --output goes on where it stopped. Several GPUs: accelerate launch -m arbiview_aug.train …, or torchrun "
        "--nproc_per_node N -m arbiview_aug.train …",
        "--data nuscenes:ROOT --output output/tiny --set steps=100",
        program="python -m arbiview_aug.train",
    )
    add = found.add_argument
    add("command", nargs="?", choices=COMMANDS, default="train", help="what to do (default: %(default)s)")
    add("--config", choices=tuple(CONFIGS), default="tiny", help="preset of all settings")
    kinds = " or ".join(f"{kind}:PATH" for kind in READERS)
    help_of_data = f"synthetic, or real frames with their kind: {kinds} (default: synthetic; evaluate: the run's)"
    add("--data", metavar="DATA", help=help_of_data)
    add_output(found, "folder of the run")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting, such as steps=100 or loss.geo=0")
    add("--stage", choices=("all", "autoencoder"), default="all", help="autoencoder: that alone, if the config has one")
    add(
        "--weights",
        metavar="DIR",
        help="config paper or inpaint: Stable Diffusion 1.5, or its inpainting model: a folder or hub id",
    )
    add("--vgg-weights", metavar="FILE", help="torchvision's vgg16 weights (default: cache or download)")
    add("--views", type=count, default=64, metavar="N", help="number of held-out views to score")
    add("--seeds", type=count, default=1, metavar="N", help="evaluate: targets a scene")
    add("--steps", type=count, metavar="N", help="evaluate: steps of a sample (default: the run's own)")
    add("--quiet", action="store_true", help="no progress bars")
    return found


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns 0 if done or stopped while training, 2 after an error, 130 after any other Ctrl-C."""
    arguments = parser().parse_args(argv)
    program = "python -m arbiview_aug.train"
    return exit_status(program, lambda: run(arguments), resumable=True)


if __name__ == "__main__":
    sys.exit(main())
