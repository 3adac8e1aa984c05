"""Samples of training items, PSNR inside holes, pictures."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import cv2
import pytest
import torch

from arbiview_aug.evaluate.report.pictures import save_picture
from arbiview_aug.generator import Generator
from arbiview_aug.generator.completion import shown_condition
from arbiview_aug.generator.training.pseudo_views import Batch, PseudoViews, collate
from arbiview_aug.generator.training.trainer import hole_psnr, picture, sampled
from tests.generator.small import stirred
from tests.generator.training.small import config, frames
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


@pytest.mark.parametrize("steps", [1, 3])
def test_samples_repeat_and_leave_known_pixels(batch: Batch, generator: Generator, steps: int) -> None:
    made = sampled(generator, batch, steps=steps, seed=1)
    assert torch.equal(made, sampled(generator, batch, steps=steps, seed=1))
    known = batch.known[:, :, None].expand_as(made)
    assert torch.equal(made[known], batch.favs[known])
    assert bool(torch.isfinite(made).all())


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
