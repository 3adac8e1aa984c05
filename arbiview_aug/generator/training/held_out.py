"""Samples of training items; scores of filled target views on held-out frames against Telea's, inside the holes.

Streets are scored by their true pixels, real frames by LiDAR points.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from tqdm import tqdm

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.errors import TrainingError
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.lidar import visible_points
from arbiview_aug.evaluate.metrics import errors, spectrum_distance_db
from arbiview_aug.evaluate.report.pictures import contact_sheet
from arbiview_aug.generator import Generator
from arbiview_aug.generator.completion import denoised, valid_pixels, with_sampling
from arbiview_aug.generator.training.data import Frames, TrainingFrame
from arbiview_aug.generator.training.pseudo_views import Batch, Rendered, favs, mask_bank, one_of, retarget
from arbiview_aug.inpaint.telea import telea
from arbiview_aug.scene.point_cloud import own_car


@torch.no_grad()
def sampled(generator: Generator, batch: Batch, *, steps: int, seed: int, pasted: bool = True) -> torch.Tensor:
    """Sample a batch's targets: (B, N, 3, H, W) images in [0, 1], known pixels of FAVS ``pasted`` as at inference."""
    config = replace(generator.config, steps=steps)
    size = (*batch.truth.shape[:2], config.autoencoder.latent_channels, *config.latent_size)
    noise = torch.randn(size, generator=torch.Generator().manual_seed(seed)).to(batch.truth.device)
    images = denoised(generator, config, batch.geometry, batch.conditions, noise).clamp(0, 1)
    return torch.where(batch.known[:, :, None], batch.favs, images) if pasted else images


def hole_psnr(images: torch.Tensor, truth: torch.Tensor, holes: torch.Tensor) -> torch.Tensor:
    """(B,) PSNR in dB of images (B, N, 3, H, W) in [0, 1] inside the holes (B, N, H, W); NaN without any."""
    error = ((images - truth) ** 2).mean(2) * holes
    mse = error.sum((1, 2, 3)) / holes.sum((1, 2, 3))
    return -10 * torch.log10(mse.clamp(min=1e-10))


def mean_hole_psnr(images: Mapping[str, torch.Tensor], batch: Batch) -> dict[str, float]:
    """Mean of ``hole_psnr`` over a batch's items for each method's images."""
    return {name: float(hole_psnr(image, batch.truth, batch.holes).nanmean()) for name, image in images.items()}


class Interval(NamedTuple):
    mean: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.mean:+.2f} ({self.low:+.2f} to {self.high:+.2f})"


def bootstrap(values: Sequence[float]) -> Interval:
    """Mean and 95 % percentile interval of paired differences."""
    array = np.asarray(values, np.float64)
    drawn = np.random.default_rng(0).integers(len(array), size=(2000, len(array)))
    low, high = np.quantile(array[drawn].mean(1), [0.025, 0.975])
    return Interval(float(array.mean()), float(low), float(high))


COLUMNS = ("source", "source", "FAVS", "mask", "filled", "sample", "truth")
_COLUMN_PX = 120  # smaller views are enlarged


def picture(batch: Batch, samples: torch.Tensor) -> np.ndarray:
    """(height, width, 3) uint8: a row for each item of a batch with samples (B, N, 3, H, W), a column for each view."""
    mask = batch.known[:, :1, None].float().expand_as(batch.favs[:, :1])
    firsts = (batch.favs, mask, batch.condition, samples, batch.truth)
    views = torch.cat([batch.sources[:, :2], *(views[:, :1] for views in firsts)], 1).cpu().clamp(0, 1) * 255
    rows = views.permute(0, 1, 3, 4, 2).numpy()  # [B, columns, h, w, 3]
    width = len(COLUMNS) * max(_COLUMN_PX, rows.shape[3])
    titled = [(token, list(row), COLUMNS) for token, row in zip(batch.tokens, rows, strict=True)]
    return contact_sheet(titled, width_px=width)


# --- scores -----------------------------------------------------------------------------------------------------------
MIN_HOLES = 0.05  # smallest share of holes in a drawn target

_TRIES = 60
_Z_BUFFER_WIDTH = 400  # smallest width at which occluded points are found: its cells have 8 pixels
_MIN_POINTS = 50  # smallest number of LiDAR points that score a target


class Case(NamedTuple):
    """A target with holes, and what scores the images (1, 3, h, w) in [0, 1] that fill them."""

    target: Camera
    view: Rendered  # FAVS at the target
    sources: Rig  # the cameras that it was rendered from
    psnr_db: Callable[[torch.Tensor], float]  # inside the holes
    truth: torch.Tensor | None  # (3, h, w) in [0, 1], if each pixel is known


def held_out_scores(
    generator: Generator,
    frames: Frames,
    indices: Sequence[int],
    *,
    seeds: Sequence[int] = (0,),
    steps: int | None = None,
    mean_of: int = 8,
    show: bool = True,
) -> dict[str, list[float]]:
    """Score each filling method by PSNR (dB) inside the holes, one value for each (seed, scene).

    Targets are drawn from the retarget distribution; FAVS renders them from all cameras, and the generator completes
    them, as at inference. A perfect sampler is 3 dB below the posterior's mean: a single sample, the mean of several
    and the one-step regression are scored separately.

    Args:
        frames: Synthetic streets, whose true pixels are known, or samples with LiDAR points; see ``case_of``.
        indices: Held-out ones.
        seeds: Seeds of targets and noise.
        steps: Denoising steps of the samples, of which ``mean_of`` make the mean; 0 leaves it out. Default: the
            generator's own. A single step is the regression, which has no samples.

    Returns:
        Values of ``telea``, ``one_step`` (if trained), ``sample``, ``mean``; and ``sample_spectrum``, the
        distance of a sample's power spectrum to the truth's in dB, on streets.

    Raises:
        TrainingError: Frames without truth and points, or without a target that they score.
        GeneratorError: A single step of a generator that was not trained for it.
    """
    steps = with_sampling(generator.config, steps, None).steps
    scores: dict[str, list[float]] = {}
    cases = [(seed, index) for seed in seeds for index in indices]
    for seed, index in tqdm(cases, desc="held out", unit="view", disable=not show):
        frame, rng = frames[index], torch.Generator().manual_seed(100_003 * (seed + 1) + index)
        case = case_of(frames, index, rng)
        holes = ~case.view.covered[0]
        rig = Rig([case.target], ground_z_m=frame.rig.ground_z_m)
        inputs = case.view.images, case.view.covered, rig, frame.images, case.sources
        complete = partial(generator.complete_views, *inputs, confidence=case.view.confidence, frame=frame.token)
        filled = {"telea": telea(case.view.images[0], holes)[None]}
        if generator.config.one_step:
            filled["one_step"] = torch.as_tensor(complete(steps=1, seed=0).images)
        if steps > 1:
            filled["sample"] = torch.as_tensor(complete(steps=steps, seed=seed).images)
        if steps > 1 and mean_of:
            samples = [complete(steps=steps, seed=1000 * (seed + 1) + k).images for k in range(mean_of)]
            filled["mean"] = torch.stack([torch.as_tensor(images) for images in samples]).mean(0)
        for name, images in filled.items():
            scores.setdefault(name, []).append(case.psnr_db(images))
        if "sample" in filled and case.truth is not None:
            sample, true = (as_arrays(images)[0] for images in (filled["sample"], case.truth[None]))
            distance = spectrum_distance_db(sample, true, holes.numpy())
            if distance is not None:
                scores.setdefault("sample_spectrum", []).append(distance)
    return scores


def case_of(frames: Frames, index: int, rng: torch.Generator) -> Case:
    """Draw targets until one has holes, and true pixels or points in them; TrainingError if none of many has."""
    frame, drive = frames[index], frames.dataset
    street = drive if isinstance(drive, SyntheticDrive) else None
    points: Any = drive[index].get("points") if street is None else None
    if street is None and points is None:
        raise TrainingError(f"frame {frame.token}: expected LiDAR points, which score real frames, found none")
    for _ in range(_TRIES):
        place = one_of(rng, len(frame.rig))
        target = retarget(frame.rig[place], rng)
        if street is not None:
            case = _street_case(street, index, frame, target)
        else:
            case = _lidar_case(frame, place, target, points.numpy(), rng)
        if case is not None and float((~case.view.covered).float().mean()) >= MIN_HOLES:
            return case
    raise TrainingError(f"frame {frame.token}: expected targets with holes of {MIN_HOLES:.0%}, none in {_TRIES} draws")


def _street_case(drive: SyntheticDrive, index: int, frame: TrainingFrame, target: Camera) -> Case | None:
    """A target of a street, scored by its true pixels; None without any covered pixel."""
    view = favs(frame.images, frame.rig, [target])
    if not bool(view.covered.any()):
        return None
    truth = drive.render(index, Rig([target], ground_z_m=frame.rig.ground_z_m)).images[0].float() / 255

    def psnr_db(images: torch.Tensor) -> float:
        return float(hole_psnr(images[None], truth[None, None], ~view.covered[None]))

    return Case(target, view, frame.rig, psnr_db, truth)


def _lidar_case(
    frame: TrainingFrame, place: int, target: Camera, points: FloatArray, rng: torch.Generator
) -> Case | None:
    """A target of a real frame, scored by LiDAR points (P, >=3) in holes; None with too few of them.

    Points in the holes of a real target have no colour, since no camera saw them. Therefore a drawn mask hides a part
    of the camera at this place from FAVS and from the generator, and colours the points there.
    """
    camera, cameras = frame.rig[place], list(frame.rig)
    seed = int(torch.randint(2**31, (), generator=rng))
    hidden, valid = ~mask_bank(frame.rig, 1, seed)[0].numpy(), valid_pixels(camera).numpy()
    cameras[place] = replace(camera, mask=valid & ~hidden)
    sources = frame.rig.with_cameras(cameras)
    view = favs(frame.images, sources, [target])
    points = points[~own_car(points), :3].astype(np.float64)
    index, row, column = _pixels_of(camera, points)
    is_hidden = (valid & hidden)[row, column]
    colours = as_arrays([frame.images[place]])[0][row, column][is_hidden]
    index, row, column = _pixels_of(target, points[index[is_hidden]])
    in_hole = ~view.covered[0].numpy()[row, column]
    if in_hole.sum() < _MIN_POINTS:
        return None
    row, column, wanted = row[in_hole], column[in_hole], colours[index[in_hole]]

    def psnr_db(images: torch.Tensor) -> float:
        return errors(as_arrays(images)[0][row, column], wanted)["psnr_db"]

    return Case(target, view, sources, psnr_db, None)


def _pixels_of(camera: Camera, points: FloatArray) -> tuple[npt.NDArray[np.intp], ...]:
    """Indices of the visible points (P, 3), and the rows and columns of the pixels that they fall on."""
    h, w = camera.size
    scale = max(1, -(-_Z_BUFFER_WIDTH // w))
    index, uv, _ = visible_points(camera.resize((scale * h, scale * w)), points)
    column, row = np.floor((uv + 0.5) / scale).astype(np.intp).clip(0, [w - 1, h - 1]).T
    return index, row, column


def spread(indices: Sequence[int], count: int) -> list[int]:
    """At most ``count`` of the indices, evenly spread over them: the first frames of a data set are of one scene."""
    count = min(count, len(indices))
    return [indices[k * len(indices) // count] for k in range(count)]


def gains(scores: Mapping[str, Sequence[float]], scenes: Sequence[str] = ()) -> dict[str, Interval]:
    """Paired gain in dB of each method over Telea, mean over scenes, with 95 % bootstrap intervals over them.

    ``scenes`` are those of the values, whose views are averaged; by default each value is of its own.
    """
    _, scene = np.unique(scenes or range(len(scores["telea"])), return_inverse=True)
    methods = [name for name in scores if name not in ("telea", "sample_spectrum")]
    gain = {name: np.bincount(scene, np.subtract(scores[name], scores["telea"])) for name in methods}
    return {name: bootstrap((of_scene / np.bincount(scene)).tolist()) for name, of_scene in gain.items()}


def report(scores: Mapping[str, Sequence[float]], scenes: Sequence[str], say: Callable[[str], None] = print) -> None:
    """Print the scores; arguments as for ``gains``."""
    telea = sum(scores["telea"]) / len(scenes)
    views = f"{len(scenes)} held-out views of {len(set(scenes))} scenes"
    say(f"inside the holes of {views}; Telea {telea:.2f} dB; against it, dB:")
    for name, gain in gains(scores, scenes).items():
        say(f"  {name:<9} {gain}")
    distances = scores.get("sample_spectrum", [])
    if distances:
        say(f"  power spectrum of a sample, distance to the truth's: {sum(distances) / len(distances):.1f} dB")
