"""``python -m integrations.benchmarks.tops``: colours given to vehicles' tops that no camera saw, against true views.

Vehicles of varied paint on synthetic streets of either world, cameras 0.7 m higher, LiDAR and boxes. The error of a
vehicle is the mean over the channels of how far the mean colour of its painted tops is from the true one, in levels of
255.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator

import numpy as np

from arbiview_aug import RigRetarget
from arbiview_aug.cli.arguments import count, seed, size
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import DataError
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.scene.boxes import PARTS, TOP_PART
from integrations.benchmarks.study import run_study, study_parser
from integrations.cross_rig.cuboids import CuboidDrive

LEAST_PX = 40
"""Painted pixels of a vehicle that suffice to score it."""


def main(argv: list[str] | None = None) -> int:
    """Measure and print one line; the exit status."""
    return run_study(parser(), _run, argv)


def _run(arguments: argparse.Namespace) -> None:
    of_vehicles = list(errors(arguments.world, arguments.frames, arguments.seed, arguments.size))
    if not of_vehicles:
        fix = "take more --frames or a larger --size"
        raise DataError(f"expected a vehicle with {LEAST_PX} painted pixels on its tops, found none: {fix}")
    error, pixels = np.array(of_vehicles).T
    print(
        f"{len(error)} vehicles: mean {error.mean():.1f}, median {np.median(error):.1f}, "
        f"90 % {np.quantile(error, 0.9):.1f}, by pixel {np.average(error, weights=pixels):.1f} levels"
    )


def errors(world: str, frames: int, seed: int, image_size: tuple[int, int]) -> Iterator[tuple[float, int]]:
    """Error of each vehicle, levels, and the number of pixels it is of."""
    source = demo_source_rig(image_size)
    target = source.shifted(z_m=0.7)
    make = CuboidDrive if world == "cuboids" else SyntheticDrive
    drive, retarget = make(source, num_frames=frames, seed=seed), RigRetarget(target)
    for k in range(frames):
        sample, truth = drive[k], drive.render(k, target)
        views = retarget(sample)["images"].numpy()
        painted: dict[int, list[np.ndarray]] = {}
        plan = retarget.plan_frame(read_frames(sample, None)[0], target).plan
        for view, true, instances, one in zip(views, truth.images, truth.instances, plan.targets, strict=True):
            if one.paint is None:
                continue
            pixel = one.paint.pixel[one.paint.part % PARTS == TOP_PART]
            both = np.stack([view.reshape(3, -1)[:, pixel], true.numpy().reshape(3, -1)[:, pixel]]).astype(float)
            row = instances.numpy().reshape(-1)[pixel]
            for box in np.unique(row[row >= 0]):
                painted.setdefault(int(box), []).append(both[:, :, row == box])
        for parts in painted.values():
            of_box = np.concatenate(parts, 2)
            if of_box.shape[2] >= LEAST_PX:
                yield float(np.abs(np.diff(of_box.mean(2), axis=0)).mean()), of_box.shape[2]


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    parser = study_parser(
        "tops", "Colours given to vehicles' tops that no camera saw, against true views.", "--frames 10"
    )
    parser.add_argument("--world", choices=("drive", "cuboids"), default="drive", help="streets (default: %(default)s)")
    parser.add_argument("--frames", type=count, default=90, metavar="N", help="number of them (default: %(default)s)")
    parser.add_argument("--seed", type=seed, default=8000, help="seed of the streets (default: %(default)s)")
    parser.add_argument("--size", type=size, default=(256, 704), metavar="HxW", help="size of the views")
    return parser


if __name__ == "__main__":
    sys.exit(main())
