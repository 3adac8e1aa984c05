"""Images as arrays on the scale 0-255, errors between them, and their means over images."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.errors import SampleError

Image = npt.NDArray[np.uint8] | npt.NDArray[np.floating[Any]]  # (h, w, 3) RGB, 0-255

_PEAK = 255.0
_STRIP_PX = 32  # rows at a time: their scratch stays in the cache
_SMALLEST_MSE = 1e-9


class RenderedView(NamedTuple):
    image: Image  # (h, w, 3), black where nothing covers it
    coverage: BoolArray  # (h, w) bool, where some source saw it
    confidence: npt.NDArray[np.float32] | None = None  # (h, w) in [0, 1], if the renderer gives it
    generated: BoolArray | None = None  # (h, w) bool, inpainted or generated pixels, if any


def as_arrays(images: torch.Tensor | Sequence[torch.Tensor]) -> list[Image]:
    """Convert images (N, 3, h, w) or a list of (3, h, w), uint8 or float in [0, 1], to (h, w, 3) on the scale 0-255."""
    arrays: list[Image] = []
    for image in images:
        image = image.detach().cpu()
        array = image.numpy() if image.dtype == torch.uint8 else image.float().numpy() * 255
        if array.ndim != 3 or array.shape[0] != 3:
            raise SampleError(f"images: expected (3, h, w) each, got {tuple(array.shape)}")
        arrays.append(np.ascontiguousarray(array.transpose(1, 2, 0)))
    return arrays


def as_tensors(images: Sequence[Image]) -> list[torch.Tensor]:
    """Convert arrays on the scale 0-255 to uint8 tensors (3, h, w)."""
    return [torch.from_numpy(np.ascontiguousarray(to_bytes(image).transpose(2, 0, 1))) for image in images]


def to_bytes(image: Image) -> npt.NDArray[np.uint8]:
    """Round to uint8; uint8 is returned unchanged."""
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)


def errors(got: npt.NDArray[Any], want: npt.NDArray[Any], prefix: str = "") -> dict[str, float]:
    """PSNR (finite for equal colours), MAE and RMSE of colours (n, 3) on the scale 0-255; empty without colours."""
    if len(got) == 0:
        return {}
    difference = got.astype(np.float64) - want
    mse = float((difference**2).mean())
    mae = float(np.abs(difference).mean())
    return {f"{prefix}psnr_db": psnr_db(mse), f"{prefix}mae": mae, f"{prefix}rmse": mse**0.5}


def psnr_db(mse: float) -> float:
    """Peak signal-to-noise ratio of a mean squared error on the scale 0-255."""
    return float(10 * np.log10(_PEAK**2 / max(mse, _SMALLEST_MSE)))


def ssim_map(image: npt.NDArray[Any], truth: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Structural similarity (Wang et al. 2004) per pixel and channel (h, w, c) of images on the scale 0-255.

    Gaussian window 11x11 with σ = 1.5, K1 = 0.01, K2 = 0.03; borders are reflected.
    """
    from kornia.metrics import ssim  # imported late: it takes half a second

    around = ((5, 5), (5, 5), (0, 0))
    padded = (np.pad(array.astype(np.float64), around, "reflect") for array in (image, truth))
    a, b = (torch.from_numpy(array).permute(2, 0, 1)[None] for array in padded)
    strips = []
    for top in range(0, len(image), _STRIP_PX):  # a large image at once is slower: its scratch leaves the cache
        part = slice(top, top + _STRIP_PX + 10)
        strips.append(ssim(a[:, :, part], b[:, :, part], window_size=11, max_val=_PEAK, padding="valid")[0])
    return np.asarray(torch.cat(strips, 1).permute(1, 2, 0).numpy())


def mean_of(rows: Iterable[Mapping[str, Any]]) -> dict[str, float]:
    """Mean of each key over the rows that have it; text is left out."""
    values: dict[str, list[float]] = {}
    for row in rows:
        for key, value in row.items():
            if not isinstance(value, str):
                values.setdefault(key, []).append(value)
    return {key: float(np.mean(column)) for key, column in values.items()}


def truth_metrics(
    image: Image,
    truth: Image,
    *,
    coverage: BoolArray | None = None,
    classes: Mapping[str, BoolArray] | None = None,
    valid: BoolArray | None = None,
) -> dict[str, float]:
    """Compare a view (h, w, 3) with the true one, scale 0-255, where that is ``valid`` (h, w), by default everywhere.

    Returns:
        ``psnr_db, mae, rmse, ssim, share`` over all valid pixels. The same with the prefixes ``covered_`` and ``hole_``
        by ``coverage`` (h, w), where some source saw the view; ``<class>_`` by ``classes``, (h, w) bool by name; and
        ``covered_<class>_``, ``hole_<class>_``. SSIM is the mean of the map over a region's pixels, ``share`` their
        part of the valid ones. A region without pixels has a share of 0 and no other entries.
    """
    everywhere = np.ones(image.shape[:2], bool) if valid is None else valid
    regions = {"": everywhere}
    if coverage is not None:
        regions |= {"covered_": everywhere & coverage, "hole_": everywhere & ~coverage}
    for prefix, region in list(regions.items()):
        regions |= {f"{prefix}{name}_": region & mask for name, mask in (classes or {}).items()}
    similarity = ssim_map(image, truth).mean(-1)
    total = max(1, int(everywhere.sum()))
    row: dict[str, float] = {}
    for prefix, region in regions.items():
        row[f"{prefix}share"] = int(region.sum()) / total
        if region.any():
            row |= errors(image[region], truth[region], prefix)
            row[f"{prefix}ssim"] = float(similarity[region].mean())
    return row
