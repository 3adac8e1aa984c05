"""The one place where images change between the package's tensors and the arrays that ``evaluate`` works on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.errors import SampleError

if TYPE_CHECKING:
    import torch

Image = npt.NDArray[np.uint8] | npt.NDArray[np.floating[Any]]
"""(h, w, 3) RGB on the scale 0-255: uint8, or float where a renderer kept fractions."""


class RenderedView(NamedTuple):
    """A rendered view.

    Attributes:
        image: (h, w, 3), black where nothing covers it.
        coverage: (h, w) bool, where some source saw it.
        confidence: (h, w) in [0, 1], where the renderer tells it.
        generated: (h, w) bool, what was made up; None where nothing is.
    """

    image: Image
    coverage: BoolArray
    confidence: npt.NDArray[np.float32] | None = None
    generated: BoolArray | None = None

    @property
    def shown(self) -> BoolArray:
        """(h, w) bool, where it shows anything, seen or made up."""
        return self.coverage if self.generated is None else self.coverage | self.generated


def as_arrays(images: torch.Tensor | Sequence[torch.Tensor]) -> list[Image]:
    """A sample's images as arrays.

    Args:
        images: (N, 3, h, w) or a list of (3, h, w), RGB; uint8, or float in [0, 1].

    Returns:
        (h, w, 3) arrays on the scale 0-255; float images keep their fractions.
    """
    arrays: list[Image] = []
    for image in images:
        array = image.detach().cpu().numpy()
        if array.ndim != 3 or array.shape[0] != 3:
            raise SampleError(f"images: expected (3, h, w) each, got {tuple(array.shape)}")
        if array.dtype != np.uint8:
            array = array.astype(np.float32) * 255
        arrays.append(np.ascontiguousarray(array.transpose(1, 2, 0)))
    return arrays


def as_tensors(images: Sequence[Image]) -> list[torch.Tensor]:
    """Arrays on the scale 0-255 as a sample's uint8 images (3, h, w)."""
    import torch

    return [torch.from_numpy(np.ascontiguousarray(to_bytes(image).transpose(2, 0, 1))) for image in images]


def to_bytes(image: Image) -> npt.NDArray[np.uint8]:
    """uint8, rounded; uint8 comes back as it is."""
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)
