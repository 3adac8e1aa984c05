"""Telea's inpainting of holes: what is known stays bit for bit."""

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug.inpaint.inpainter import RADIUS_PX, telea


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float64, torch.float16])
def test_known_pixels_stay_and_holes_take_their_surroundings(dtype: torch.dtype) -> None:
    torch.manual_seed(0)
    image = torch.randint(100, 150, (3, 20, 30)).to(torch.uint8)
    image = image if dtype == torch.uint8 else (image / 255).to(dtype)
    hole = torch.zeros(20, 30, dtype=torch.bool)
    hole[5:12, 8:20] = True
    broken = torch.where(hole, torch.zeros_like(image), image)
    filled = telea(broken, hole)
    assert filled.dtype == dtype and torch.equal(filled[:, ~hole], image[:, ~hole])
    inside = filled[:, hole].double() * (1 if dtype == torch.uint8 else 255)
    assert inside.min() >= 99 and inside.max() <= 151
    assert torch.equal(broken[:, hole], torch.zeros_like(broken[:, hole]))  # the input is not written to


def test_only_what_is_around_the_holes_is_looked_at() -> None:
    """The same bits as OpenCV gives for the whole image."""
    rng = np.random.default_rng(0)
    image = cv2.GaussianBlur(rng.integers(0, 256, (90, 120, 3), dtype=np.uint8), (0, 0), 3)
    for trial in range(20):
        hole = np.zeros((90, 120), np.uint8)
        for _ in range(trial % 3 + 1):
            y, x = rng.integers(0, 90), rng.integers(0, 120)
            hole[y : y + rng.integers(1, 30), x : x + rng.integers(1, 30)] = 1
        expected = cv2.inpaint(image, hole, RADIUS_PX, cv2.INPAINT_TELEA).transpose(2, 0, 1)
        got = telea(torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(hole) > 0)
        assert np.array_equal(got.numpy(), expected)


def test_nothing_to_do_and_nothing_to_start_from() -> None:
    image = torch.randint(0, 256, (3, 6, 7), dtype=torch.uint8)
    assert telea(image, torch.zeros(6, 7, dtype=torch.bool)) is image
    everything = torch.ones(6, 7, dtype=torch.bool)
    assert (telea(image, everything) == 128).all()
    assert (telea(image / 255, everything) == 0.5).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 5), (3, 1), (2, 2)])
def test_the_smallest_images(size: tuple[int, int]) -> None:
    image = torch.full((3, *size), 200, dtype=torch.uint8)
    hole = torch.zeros(size, dtype=torch.bool)
    hole[0, 0] = True
    assert telea(image, hole).shape == image.shape
