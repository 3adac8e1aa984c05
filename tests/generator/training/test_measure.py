"""Scores inside holes, their intervals, pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from arbiview_aug.errors import GeneratorError, TrainingError
from arbiview_aug.evaluate.report.pictures import save_picture
from arbiview_aug.generator import Generator
from arbiview_aug.generator.completion import shown_condition
from arbiview_aug.generator.training.data import Frames, open_frames
from arbiview_aug.generator.training.held_out import (
    bootstrap,
    case_of,
    gains,
    held_out_scores,
    hole_psnr,
    picture,
    sampled,
    spread,
)
from arbiview_aug.generator.training.losses import without_attention
from arbiview_aug.generator.training.pseudo_views import Batch, PseudoViews, collate
from tests.generator.small import ring, stirred
from tests.generator.training.small import OneColour, config, frames
from tests.generator.training.test_pseudo_views import HOLE


@pytest.fixture(scope="module")
def batch() -> Batch:
    made = PseudoViews(frames(), [0, 1], config().pseudo_views, config().generator, HOLE, seed=0)
    return collate([made[k] for k in range(3)])


@pytest.fixture(scope="module")
def generator() -> Generator:
    torch.manual_seed(0)
    made = Generator.from_config(config().generator)
    stirred(made.denoiser)
    return made.eval()


def test_only_holes_count() -> None:
    truth = torch.rand(2, 1, 3, 4, 6)
    made = truth.clone()
    holes = torch.zeros(2, 1, 4, 6, dtype=torch.bool)
    holes[0, :, :, :3] = True
    made[:, :, :, :, :3] += 0.1
    made[:, :, :, :, 3:] += 0.7
    psnr = hole_psnr(made, truth, holes)
    assert float(psnr[0]) == pytest.approx(20.0, abs=1e-3) and math.isnan(float(psnr[1]))


def test_intervals_hold_the_mean() -> None:
    values = torch.randn(200, generator=torch.Generator().manual_seed(0)).add(1).tolist()
    interval = bootstrap(values)
    assert interval.low < interval.mean < interval.high
    assert interval.high - interval.low == pytest.approx(4 / 200**0.5, rel=0.2)
    assert bootstrap([2.0] * 5) == (2.0, 2.0, 2.0)


@pytest.mark.parametrize("steps", [1, 3])
def test_samples_repeat_and_leave_known_pixels(batch: Batch, generator: Generator, steps: int) -> None:
    made = sampled(generator, batch, steps=steps, seed=1)
    assert torch.equal(made, sampled(generator, batch, steps=steps, seed=1))
    known = batch.known[:, :, None].expand_as(made)
    assert torch.equal(made[known], batch.favs[known])
    assert bool(torch.isfinite(made).all())


def test_switches_of_the_attention_are_felt(batch: Batch, generator: Generator) -> None:
    made = [
        sampled(generator, batch._replace(geometry=change(batch.geometry)), steps=1, seed=0)
        for change in (lambda geometry: geometry, without_attention)
    ]
    assert not torch.equal(made[0], made[1])


@pytest.mark.slow
def test_held_out_streets_are_scored_against_their_truth(generator: Generator) -> None:
    streets = open_frames("synthetic", config().generator.image_size, scenes=1)
    scores = held_out_scores(generator, streets, [0], seeds=(0, 1), steps=2, mean_of=2, show=False)
    assert set(scores) == {"telea", "one_step", "sample", "mean", "sample_spectrum"}
    assert all(len(values) == 2 and all(map(math.isfinite, values)) for values in scores.values())
    assert set(gains(scores)) == {"one_step", "sample", "mean"}
    twice = {"telea": [0.0] * 8, "one_step": [1.0, 2.0, 3.0, 4.0] * 2}  # two views that say the same of each street
    once = {name: values[:4] for name, values in twice.items()}
    assert gains(twice, scenes=["a", "b", "c", "d"] * 2) == gains(once) != gains(twice)
    again = held_out_scores(generator, streets, [0], seeds=(0,), steps=2, mean_of=0, show=False)
    assert again["sample"] == scores["sample"][:1] and "mean" not in again
    untrained = Generator.from_config(config().generator)
    of_telea = held_out_scores(untrained, streets, [0], steps=2, mean_of=0, show=False)
    assert of_telea["one_step"] == pytest.approx(of_telea["telea"], abs=0.05)  # starts as what it is given


def test_real_frames_are_scored_by_lidar_points_in_the_holes(generator: Generator) -> None:
    """The points have the colours of the camera that is hidden there; what is seen elsewhere does not count."""
    real = Frames(OneColour(), config().generator.image_size, ["0"] * 5)
    case = case_of(real, 0, torch.Generator().manual_seed(1))
    ((place, hidden),) = ((k, camera.mask) for k, camera in enumerate(case.sources) if camera.mask is not None)
    holes = ~case.view.covered
    of_camera = torch.full((1, 3, *case.target.size), (40 * place + 10) / 255)
    assert bool(holes.any()) and case.psnr_db(of_camera) > 100  # of one colour: no difference at all
    assert case.psnr_db(torch.where(holes[:, None], of_camera + 0.1, 0)) == pytest.approx(20, abs=1e-3)
    assert not hidden.all()
    scores = held_out_scores(generator, real, [0, 1], steps=2, mean_of=0, show=False)
    assert set(scores) == {"telea", "one_step", "sample"} and all(map(math.isfinite, scores["sample"]))


def test_scores_are_of_the_runs_own_steps_and_guidance(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(0)
    own = Generator.from_config(replace(config().generator, steps=3, guidance=2.5))
    used: list[tuple[int, float]] = []

    def denoised(_: Any, settings: Any, geometry: Any, conditions: Any, noise: torch.Tensor) -> torch.Tensor:
        used.append((settings.steps, settings.guidance))
        return torch.zeros(*noise.shape[:2], 3, *settings.image_size)

    monkeypatch.setattr("arbiview_aug.generator.completion.denoised", denoised)
    monkeypatch.setattr("arbiview_aug.generator.training.held_out.denoised", denoised)
    real = Frames(OneColour(), config().generator.image_size, ["0"] * 5)
    held_out_scores(own, real, [0], mean_of=1, show=False)
    assert used == [(1, 2.5), (3, 2.5), (3, 2.5)]
    items = PseudoViews(frames(), [0], config().pseudo_views, own.config, HOLE, seed=0)
    sampled(own, items[0], steps=3, seed=0)
    assert used[-1] == (3, 2.5)


def test_scored_frames_are_spread_over_all() -> None:
    assert spread(range(10, 20), 4) == [10, 12, 15, 17]
    assert spread((3, 4), 64) == [3, 4] and spread((), 64) == []


def test_other_frames_have_no_truth(generator: Generator) -> None:
    with pytest.raises(TrainingError, match="frame frame 0: expected LiDAR points, which score real frames"):
        held_out_scores(generator, frames(), [0], show=False)


def test_pictures(batch: Batch, tmp_path: Path) -> None:
    image = picture(batch, batch.truth)
    save_picture(tmp_path / "a" / "grid.png", image)
    back = cv2.imread(str(tmp_path / "a" / "grid.png"))
    assert back.shape == image.shape and image.shape[1] >= 7 * 112
    assert (back[..., ::-1] == image).all()


def test_holes_of_the_condition_as_they_were_in_training(batch: Batch) -> None:
    """Grey for a generator of Algorithm 1 as written, inpainted for the others; what is known stays."""
    settings = config().generator
    grey = shown_condition(replace(settings, prefilled=False), batch.condition, batch.known)
    known = batch.known[:, :, None].expand_as(grey)
    assert bool((~batch.known).any()) and bool((grey[~known] == 0.5).all())
    assert torch.equal(grey[known], batch.condition[known])
    assert shown_condition(settings, batch.condition, batch.known) is batch.condition
    made = []
    for prefilled in (False, True):
        torch.manual_seed(0)
        generator = stirred(Generator.from_config(replace(settings, prefilled=prefilled)))
        made.append(sampled(generator, batch, steps=2, seed=0))
    assert not torch.equal(*made)


def test_one_step_of_a_generator_that_was_not_trained_for_it() -> None:
    settings = replace(config().generator, one_step=False, name="of samples")
    generator = Generator.from_config(settings)
    rig = ring(3)
    black = torch.zeros(3, 3, *rig[0].size)
    asked: dict[str, Any] = {"coverage": torch.zeros(3, *rig[0].size, dtype=torch.bool), "targets": rig}
    with pytest.raises(GeneratorError, match="the one-step regression of generator 'of samples' was not trained"):
        generator.complete_views(black, source_images=black, sources=rig, steps=1, **asked)
    with pytest.raises(GeneratorError, match="was not trained"):
        held_out_scores(generator, frames(), [0], steps=1, show=False)
    done = generator.complete_views(black, source_images=black, sources=rig, steps=2, **asked)
    assert done.denoised == [0, 1, 2]
