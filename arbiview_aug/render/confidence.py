"""Confidence of rendered pixels: their expected error, from the geometry and from the images.

A pixel is wrong if the scene differs from the surface along its ray, or if its source has another resolution. Both are
known when a plan is built (``certainty``). The error of its colour then depends on the contrast of the view around it,
and on how much two sources disagree at a seam (``confidence``).

Constants were fitted on synthetic streets and hold on others (acceptance/test_confidence.py).
"""

from __future__ import annotations

import functools

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import FloatArray

EXPECTED_ERROR_LEVELS = 10.0
"""Confidence is exp(-e / this) for an expected error of e grey levels of 255: 0.5 means 7 levels, 0.9 means 1."""

DECORRELATION_RAD = 0.01
"""Displacement over which a view's details become unrelated; insensitive from 0.3 to 2 times."""

RESOLUTION_POWER = 0.5
"""Exponent of the share of detail that a coarser or finer source keeps; insensitive from 0.25 to 1."""

_ERROR_PER_CONTRAST = 0.55
"""Mean absolute error of unrelated detail, as a share of the standard deviation around it."""

_LEAST_CONTRAST = 6.0
"""Grey levels added to the contrast, for objects displaced into uniform areas; insensitive from 4 to 12."""

_CELL = 0.005  # contrast is gathered in cells of this share of the width
_WINDOWS = (5, 11)  # cells a side: 3 and 6 % of the width


def certainty(parallax_rad: FloatArray, pixels_per_pixel: FloatArray) -> FloatArray:
    """Share (...,) in [0, 1] of a source's detail that is correct: 1 at the target's own centre and resolution.

    ``parallax_rad`` (...,) is the displacement that unknown depth is expected to cause; ``pixels_per_pixel`` (...,) are
    source pixels per target pixel along the worse axis: fewer blur, more alias.
    """
    ratio = np.clip(pixels_per_pixel, 1e-3, 1e3)
    detail = np.minimum(ratio, 1 / ratio) ** RESOLUTION_POWER
    return np.asarray(np.exp(-parallax_rad / DECORRELATION_RAD) * detail)


def confidence(
    view: torch.Tensor, certain: npt.NDArray[np.uint8] | torch.Tensor, covered: torch.Tensor, seam: torch.Tensor
) -> torch.Tensor:
    """Confidence (..., h, w) float32 in [0, 1] of a rendered view: 0 where uncovered, 1 where the source is exact.

    The view (..., 3, h, w) is uint8, or float in [0, 1]; ``certain`` (h, w) is ``certainty`` in 255ths; ``seam``
    (..., h, w), in the view's unit, is the change of the winner's colour by blending a second source.
    """
    levels = 1.0 if view.dtype == torch.uint8 else 255.0
    with torch.no_grad():
        # In place, for speed.
        doubt = torch.as_tensor(certain).to(view.device).float().div_(-255).add_(1)
        error = _contrast(view.detach(), levels, covered).add_(_LEAST_CONTRAST).mul_(doubt).add_(seam, alpha=levels)
        return error.mul_(-_ERROR_PER_CONTRAST / EXPECTED_ERROR_LEVELS).exp_().mul_(covered)


def _contrast(view: torch.Tensor, levels: float, covered: torch.Tensor) -> torch.Tensor:
    """Standard deviation (..., h, w) of covered grey levels around each pixel: the mean of two window sizes."""
    h, w = covered.shape
    cell = max(1, 2 * round(_CELL * w / 2))
    step = max(1, cell // 2)  # four pixels of each cell suffice
    seen = covered[::step, ::step].float()
    grey = view[..., ::step, ::step].float().mean(-3) * levels
    # Around mid-grey: float32 would lose the variance of bright areas.
    flat = (grey.reshape(-1, *seen.shape) - 128) * seen
    moments = torch.stack([seen.expand_as(flat), flat, flat * flat], 1)
    side = cell // step
    # Zero padding is not covered: it adds nothing to any moment.
    padded = torch.nn.functional.pad(moments, (0, -seen.shape[1] % side, 0, -seen.shape[0] % side))
    cells = torch.nn.functional.avg_pool2d(padded, side, divisor_override=1)
    spread = torch.zeros_like(cells[:, :1])
    for window in _WINDOWS:
        # Sums over rows, then over columns: five times as fast as pooling.
        rows, columns = cells.shape[-2:]
        around = torch.nn.functional.pad(cells, [window // 2] * 4)
        around = functools.reduce(torch.add, (around[..., k : k + columns] for k in range(window)))
        around = functools.reduce(torch.add, (around[..., k : k + rows, :] for k in range(window)))
        count, total, squares = around.split(1, 1)
        count = count.clamp(min=1e-6)
        spread += (squares / count - (total / count) ** 2).clamp(min=0).sqrt() / len(_WINDOWS)
    size = [n * cell for n in spread.shape[-2:]]
    smooth = torch.nn.functional.interpolate(spread, size=size, mode="bilinear", align_corners=False)
    return smooth[:, 0, :h, :w].reshape(*view.shape[:-3], h, w)
