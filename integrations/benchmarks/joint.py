"""``python -m integrations.benchmarks.joint``: do neighbouring views agree better where they are denoised together?

Cameras are turned and get wider lenses, so that neighbours share holes. The same views, noise and sources are completed
together, as ``complete_views`` does it, and each alone. Agreement is PSNR between two neighbours on pixels that both
made up, brought to their half-way view.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import torch

from arbiview_aug import RigRetarget, SampleKeys
from arbiview_aug.cli.arguments import count, size
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.agreement import target_consistency
from arbiview_aug.evaluate.images import RenderedView, as_arrays
from arbiview_aug.generator import Generator
from arbiview_aug.generator.training.held_out import bootstrap
from integrations.benchmarks.generator import HELD_OUT_SEED, wide_target
from integrations.benchmarks.study import run_study, study_parser


def main(argv: list[str] | None = None) -> int:
    """Measure and print a line for each number of steps; the exit status."""
    return run_study(parser(), _run, argv)


def _run(arguments: argparse.Namespace) -> None:
    generator = Generator.shipped() if arguments.generator is None else Generator.from_pretrained(arguments.generator)
    source = demo_source_rig(arguments.size)
    drive = SyntheticDrive(source, num_frames=arguments.frames, seed=HELD_OUT_SEED, lidar=False)
    target = wide_target(source)
    render = RigRetarget(
        target, geometry="street", holes="black", keys=SampleKeys(extra=("confidence",)), match_exposure=False
    )
    for steps in arguments.steps:
        gains: dict[str, list[float]] = {"agreement": [], "holes": []}
        for k in range(arguments.frames):
            sample, truth = drive[k], torch.stack(list(drive.render(k, target).images)).float()
            seen = render(sample)
            holes = ~seen["coverage"]
            scores = []
            for groups in ([range(len(target))], [[m] for m in range(len(target))]):
                images = seen["images"].clone()
                for group in map(list, groups):
                    done = generator.complete_views(
                        seen["images"][group],
                        seen["coverage"][group],
                        target.with_cameras([target[m] for m in group]),
                        sample["images"],
                        source,
                        confidence=seen["confidence"][group],
                        steps=steps,
                        frame=k,
                    )
                    images[group] = torch.stack(list(done.images))
                views = [
                    RenderedView(image, hole.numpy()) for image, hole in zip(as_arrays(images), holes, strict=True)
                ]
                found = [pair.raw_psnr_db for pair in target_consistency(target, views)]
                error = (images.float() - truth).square().mean(1)[holes].mean()
                agreement = [psnr for psnr in found if psnr is not None]
                scores.append((float(np.mean(agreement)), float(-10 * torch.log10(error / 255**2))))
            for name, together, alone in zip(gains, *scores, strict=True):
                gains[name].append(together - alone)
        text = ", ".join(f"{name} {bootstrap(values)} dB" for name, values in gains.items())
        print(f"{steps} steps, together against each alone, {arguments.frames} streets: {text}", flush=True)


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    parser = study_parser("joint", "Views denoised together, or each alone.", "--steps 1")
    parser.add_argument("--size", type=size, default=(128, 224), metavar="HxW", help="of every view")
    parser.add_argument("--frames", type=count, default=6, metavar="N", help="held-out streets")
    parser.add_argument("--steps", nargs="+", type=count, default=[1, 4], metavar="N", help="(default: 1 4)")
    parser.add_argument("--generator", metavar="DIR", help="a trained one (default: the package's own)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
