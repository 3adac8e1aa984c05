"""``python -m arbiview_aug.train``: train a generator, ablate its parts, or score it on held-out streets."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from arbiview_aug.cli.arguments import count
from arbiview_aug.datasets.registry import READERS
from arbiview_aug.errors import ArbiviewError
from arbiview_aug.generator.training.command import COMMANDS, run
from arbiview_aug.generator.training.config import CONFIGS


def parser() -> argparse.ArgumentParser:
    """The arguments."""
    made = argparse.ArgumentParser(
        prog="python -m arbiview_aug.train",
        description="CVC-SSL: train a generator to reconstruct real views from pseudo views beside them. The same "
        "command with the same --output goes on where it stopped. Several GPUs: accelerate launch -m "
        "arbiview_aug.train …, or torchrun --nproc_per_node N -m arbiview_aug.train …",
    )
    made.add_argument("command", nargs="?", choices=COMMANDS, default="train", help="(default: %(default)s)")
    made.add_argument("--config", choices=tuple(CONFIGS), default="tiny", help="(default: %(default)s)")
    made.add_argument(
        "--data",
        default="synthetic",
        metavar="KIND:PATH",
        help=f"synthetic, or real frames with their kind: {' or '.join(f'{kind}:PATH' for kind in READERS)} "
        "(default: %(default)s)",
    )
    made.add_argument("--output", default="output", metavar="DIR", help="(default: %(default)s)")
    made.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="a setting, such as steps=100 or loss.geo=0"
    )
    made.add_argument(
        "--stage", choices=("all", "autoencoder"), default="all", help="autoencoder: only that, where there is one"
    )
    made.add_argument("--weights", metavar="DIR", help="paper: Stable Diffusion 1.5, a folder or hub id")
    made.add_argument("--vgg-weights", metavar="FILE", help="torchvision's vgg16 weights (default: cache or download)")
    made.add_argument("--views", type=count, default=64, metavar="N", help="held-out views to score (default: 64)")
    made.add_argument("--seeds", type=count, default=1, metavar="N", help="evaluate: targets a scene (default: 1)")
    made.add_argument("--steps", type=count, default=4, metavar="N", help="evaluate: of a sample (default: 4)")
    made.add_argument("--quiet", action="store_true", help="no progress bars")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run; returns the exit status: 0 done or stopped on request, 2 settings, data or disks that cannot be used."""
    try:
        return run(parser().parse_args(argv))
    except (ArbiviewError, OSError) as error:
        print(f"python -m arbiview_aug.train: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
