"""Telea's inpainting of holes: what is known stays bit for bit."""

import pytest
import torch

from arbiview_aug.inpainting import telea


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
