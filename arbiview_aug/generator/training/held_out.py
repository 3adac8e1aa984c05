"""Scores on held-out streets with true pixels: filled target views against Telea's inpainting, inside the holes."""

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
from arbiview_aug.generator.training.pseudo_views import Rendered, favs

MIN_HOLES = 0.05  # smallest share of holes in a drawn target

_TRIES = 20


def held_out_scores(
    generator: Generator,
    frames: Frames,
    indices: Sequence[int],
    *,
    seeds: Sequence[int] = (0,),
    steps: int = 4,
    mean_of: int = 8,
    show: bool = True,
) -> dict[str, list[float]]:
    """Score each filling method by PSNR (dB) inside the holes, one value for each (seed, scene).

    Each target is drawn from the retarget distribution; FAVS renders it from all cameras and the generator completes
    it, as at inference. A perfect sampler is 3 dB below the posterior's mean, so a single sample, the mean of several
    and the one-step regression are scored separately.

    Args:
        generator: The model.
        frames: Synthetic streets, whose true pixels are known, and the ``indices`` of held-out ones.
        seeds: Seeds of targets and noise.
        steps: Denoising steps of the samples, of which ``mean_of`` make the mean; 0 leaves it out.

    Returns:
        Values of ``telea``, ``one_step`` (if trained), ``sample``, ``mean``; and ``sample_energy``, the gradient energy
        relative to the truth.

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
        target, view = _target(frame, torch.Generator().manual_seed(100_003 * (seed + 1) + index))
        rig = Rig([target], ground_z_m=frame.rig.ground_z_m)
        truth = drive.render(index, rig).images[0].float()[None, None] / 255
        holes = ~view.covered[None]
        inputs = view.images, view.covered, rig, frame.images, frame.rig
        complete = partial(generator.complete_views, *inputs, confidence=view.confidence, frame=frame.token)
        filled = {"telea": telea(view.images[0], holes[0, 0])[None]}
        if generator.config.one_step:
            filled["one_step"] = torch.as_tensor(complete(steps=1, seed=0).images)
        filled["sample"] = torch.as_tensor(complete(steps=steps, seed=seed).images)
        if mean_of:
            samples = [complete(steps=steps, seed=1000 * (seed + 1) + k).images for k in range(mean_of)]
            filled["mean"] = torch.stack([torch.as_tensor(images) for images in samples]).mean(0)
        for name, images in filled.items():
            scores.setdefault(name, []).append(float(hole_psnr(images[None], truth, holes)))
        sample, true = (as_arrays(images)[0] for images in (filled["sample"], truth[0]))
        energy = gradient_energy_ratio(sample, true, holes[0, 0].numpy())
        if energy is not None:
            scores.setdefault("sample_energy", []).append(energy)
    return scores


def _target(frame: TrainingFrame, rng: torch.Generator) -> tuple[Camera, Rendered]:
    """Draw a target camera with holes, and render it by FAVS."""
    for _ in range(_TRIES):
        camera = replace(retarget(frame.rig[one_of(rng, len(frame.rig))], rng), mask=None)
        view = favs(frame.images, frame.rig, [camera])
        if float((~view.covered).float().mean()) >= MIN_HOLES and bool(view.covered.any()):
            return camera, view
    raise TrainingError(f"frame {frame.token}: expected targets with holes of {MIN_HOLES:.0%}, none in {_TRIES} draws")


def gains(scores: Mapping[str, Sequence[float]], seeds: int = 1) -> dict[str, Interval]:
    """Paired gain in dB of each method over Telea, with 95 % bootstrap intervals over streets.

    The ``seeds`` views of a street are resampled together.
    """
    methods = [name for name in scores if name not in ("telea", "sample_energy")]
    gain = {name: np.subtract(scores[name], scores["telea"]).reshape(seeds, -1).mean(0) for name in methods}
    return {name: bootstrap(of_street.tolist()) for name, of_street in gain.items()}


def report(scores: Mapping[str, Sequence[float]], seeds: int = 1, say: Callable[[str], None] = print) -> None:
    """Print the scores; arguments as for ``gains``."""
    count = len(scores["telea"])
    say(f"inside the holes of {count} held-out views; Telea {sum(scores['telea']) / count:.2f} dB; against it, dB:")
    for name, gain in gains(scores, seeds).items():
        say(f"  {name:<9} {gain}")
    energies = scores.get("sample_energy", [])
    if energies:
        say(f"  gradient energy of a sample against the truth: {sum(energies) / len(energies):.2f}")
