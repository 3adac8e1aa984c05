"""Held-out streets with true pixels: completed targets against Telea's inpainting, inside the holes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from tqdm import tqdm

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.errors import TrainingError
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.metrics import gradient_energy_ratio
from arbiview_aug.generator import Generator
from arbiview_aug.generator.inpainting import telea
from arbiview_aug.generator.training.data import Frames, TrainingFrame
from arbiview_aug.generator.training.masks import one_of, retarget
from arbiview_aug.generator.training.measure import Interval, bootstrap, hole_psnr
from arbiview_aug.generator.training.pseudo_views import favs

LEAST_HOLES = 0.05
MEAN_OF = 8
_TRIES = 20


def held_out_scores(
    generator: Generator,
    frames: Frames,
    indices: Sequence[int],
    *,
    seeds: Sequence[int] = (0,),
    steps: int = 4,
    mean_of: int = MEAN_OF,
    show: bool = True,
) -> dict[str, list[float]]:
    """Score each filling method by PSNR (dB) inside the holes, one value for each (seed, scene).

    A target is drawn for each from the retarget distribution, with holes of at least 5 %; FAVS renders it from all
    cameras, as at inference, and the generator completes it. A perfect sampler is 3 dB below the posterior's mean, so
    a single sample, the mean of several and the one-step regression are scored apart.

    Args:
        generator: The model.
        frames: Of synthetic streets: others have no true pixels.
        indices: Which, held out.
        seeds: Of targets and noise.
        steps: Of the samples.
        mean_of: Samples of the mean; 0 leaves it out.
        show: Progress bar.

    Returns:
        A value for each seed's scenes, one after the other: ``telea``, ``one_step`` where that was trained, ``sample``,
        ``mean``; and ``sample_energy``, gradient energy against the truth.

    Raises:
        TrainingError: Frames without truth.
    """
    drive = frames.dataset
    if not isinstance(drive, SyntheticDrive):
        raise TrainingError("held-out scores: expected synthetic streets, whose true pixels are known")
    scores: dict[str, list[float]] = {}
    cases = [(seed, index) for seed in seeds for index in indices]
    for seed, index in tqdm(cases, desc="held out", unit="view", disable=not show):
        frame = frames[index]
        target, shown, covered, trust = _target(frame, torch.Generator().manual_seed(100_003 * (seed + 1) + index))
        rig = Rig([target], ground_z_m=frame.rig.ground_z_m)
        truth = drive.render(index, rig).images[0].float()[None, None] / 255
        holes = ~covered[None, None]
        completed = partial(_completed, generator, frame, rig, shown, covered, trust)
        ways = {"telea": telea(shown, ~covered)[None, None]}
        if generator.config.one_step:
            ways["one_step"] = completed(1, 0)
        ways["sample"] = completed(steps, seed)
        if mean_of:
            others = [completed(steps, 1000 * (seed + 1) + k) for k in range(mean_of)]
            ways["mean"] = torch.stack(others).mean(0)
        for name, image in ways.items():
            scores.setdefault(name, []).append(float(hole_psnr(image, truth, holes)))
        made, true = (as_arrays(image[0])[0] for image in (ways["sample"], truth))
        energy = gradient_energy_ratio(made, true, holes[0, 0].numpy())
        if energy is not None:
            scores.setdefault("sample_energy", []).append(energy)
    return scores


def _completed(
    generator: Generator,
    frame: TrainingFrame,
    rig: Rig,
    shown: torch.Tensor,
    covered: torch.Tensor,
    trust: torch.Tensor,
    steps: int,
    seed: int,
) -> torch.Tensor:
    """(1, 1, 3, h, w) the one target view of a frame, completed as in use."""
    done = generator.complete_views(
        shown[None],
        covered[None],
        rig,
        frame.images,
        frame.rig,
        confidence=trust[None],
        steps=steps,
        seed=seed,
        frame=frame.token,
    )
    return torch.as_tensor(done.images)[None]


def _target(frame: TrainingFrame, rng: torch.Generator) -> tuple[Camera, torch.Tensor, torch.Tensor, torch.Tensor]:
    """A drawn target camera, FAVS there (3, h, w) in [0, 1], its coverage and its confidence (h, w)."""
    for _ in range(_TRIES):
        camera = replace(retarget(frame.rig[one_of(rng, len(frame.rig))], rng), mask=None)
        shown, covered, trust = (value[0] for value in favs(frame.images, frame.rig, [camera]))
        if float((~covered).float().mean()) >= LEAST_HOLES and bool(covered.any()):
            return camera, shown, covered, trust
    raise TrainingError(
        f"frame {frame.token}: expected targets with holes of {LEAST_HOLES:.0%}, none in {_TRIES} draws"
    )


def gains(scores: Mapping[str, Sequence[float]], seeds: int = 1) -> dict[str, Interval]:
    """Paired gain in dB of each method over Telea, with 95 % bootstrap intervals over streets.

    Args:
        scores: By ``held_out_scores``.
        seeds: How many views there are of each street: they are drawn together.
    """
    ways = [name for name in scores if name not in ("telea", "sample_energy")]
    better = {name: np.subtract(scores[name], scores["telea"]).reshape(seeds, -1).mean(0) for name in ways}
    return {name: bootstrap(of_street.tolist()) for name, of_street in better.items()}


def report(scores: Mapping[str, Sequence[float]], seeds: int = 1, say: Callable[[str], None] = print) -> None:
    """Print the scores; arguments as for ``gains``."""
    count = len(scores["telea"])
    say(f"inside the holes of {count} held-out views; Telea {sum(scores['telea']) / count:.2f} dB; against it, dB:")
    for name, gain in gains(scores, seeds).items():
        say(f"  {name:<9} {gain}")
    energies = scores.get("sample_energy", [])
    if energies:
        say(f"  gradient energy of a sample against the truth: {sum(energies) / len(energies):.2f}")
