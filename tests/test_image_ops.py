"""Resized images and label maps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.image_ops import nearest_resized, resized


@pytest.mark.parametrize(
    ("size", "to", "per_pixel", "most"),  # stripes of that many a pixel, and the largest deviation that is left of them
    [
        *((size, (47, 155), (1 / 5.3, 1 / 5.3), 0.07) for size in ((375, 1242), (376, 1240))),
        ((64, 512), (64, 65), (0, 1 / 2), 0.15),
        ((401, 701), (250, 430), (0, 1 / 2), 0.15),
    ],
)
@pytest.mark.parametrize("white", [255, 1.0])
def test_sides_that_do_not_halve_evenly_are_antialiased(
    size: Any, to: Any, per_pixel: Any, most: float, white: float
) -> None:
    y, x = torch.arange(size[0])[:, None] + 0.25, torch.arange(size[1]) + 0.25
    stripes = (torch.sin((per_pixel[0] * y + per_pixel[1] * x) * 2 * np.pi) > 0).expand(3, *size) * white
    planes = stripes.to(torch.uint8 if white == 255 else torch.float32).contiguous()
    for image in (planes, planes.permute(1, 2, 0).contiguous().permute(2, 0, 1)):
        assert resized(image, to).double().std() / white < most


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_labels_are_those_of_the_nearest_pixels_whatever_the_default_dtype_and_device(dtype: torch.dtype) -> None:
    columns = torch.arange(1600)[None]
    torch.set_default_dtype(dtype)
    try:
        assert torch.equal(nearest_resized(columns, (1, 1600)), columns)
        assert torch.equal(nearest_resized(columns, (1, 800)), columns[:, 1::2])
    finally:
        torch.set_default_dtype(torch.float32)
