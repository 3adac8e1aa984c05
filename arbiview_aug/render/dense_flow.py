"""Dense optical flow between two images of one view, with its reliability."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray

ROUND_TRIP_PX = 0.75
"""Forward-backward error at which flow has a weight of one half."""

_BLANK_GREY = 2.0  # standard deviation below which an image is blank, in grey levels

_REPEATS = 0.7
"""Autocorrelation along rows above which texture repeats: gratings have 0.9, real overlaps at most 0.35."""


def why_ambiguous(one: npt.NDArray[np.float32], two: npt.NDArray[np.float32], both: BoolArray) -> str:
    """Why views (h, w, 3) in [0, 255] cannot be matched where both see (h, w); "" if they can."""
    if min(float(view[both].std()) for view in (one, two)) < _BLANK_GREY:
        return "one of the images shows nothing"
    if max(_repetition(view, both) for view in (one, two)) > _REPEATS:
        return "the texture repeats itself: matches would be ambiguous"
    return ""


def dense_flow(
    one: npt.NDArray[np.float32], two: npt.NDArray[np.float32], both: BoolArray
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Optical flow (h, w, 2) from one view to the other, and its weight (h, w) in [0, 1].

    The views are brought to one brightness. Pixels that only one of them sees get the blurred mean of both, without any
    motion.
    """
    grey = [cv2.cvtColor(view, cv2.COLOR_RGB2GRAY) for view in (one, two)]
    log = [np.log(np.maximum(view[both], 4)) for view in grey]
    half = np.exp(np.median(log[0] - log[1]) / 2)
    grey = [grey[0] / half, grey[1] * half]
    inside = both.astype(np.float32)
    around = cv2.GaussianBlur((grey[0] + grey[1]) / 2 * inside, (0, 0), 6) / np.maximum(
        cv2.GaussianBlur(inside, (0, 0), 6), 1e-3
    )
    first, second = (np.clip(np.where(both, view, around), 0, 255).astype(np.uint8) for view in grey)
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    dis.setFinestScale(0)
    dis.setVariationalRefinementIterations(0)  # depth is smoothed later
    there: Any = dis.calc(first, second, None)  # type: ignore[call-overload]
    back: Any = dis.calc(second, first, None)  # type: ignore[call-overload]
    h, w = both.shape
    x, y = np.meshgrid(np.arange(w, dtype=np.float32), np.arange(h, dtype=np.float32))
    x, y = x + there[..., 0], y + there[..., 1]
    returned = cv2.remap(back, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e3, 1e3))
    found = cv2.remap(inside, x, y, cv2.INTER_NEAREST)
    miss = np.linalg.norm(there + returned, axis=-1)
    return there, np.where(both & (found > 0), 1 / (1 + (miss / ROUND_TRIP_PX) ** 4), 0).astype(np.float32)


def _repetition(image: npt.NDArray[np.float32], inside: BoolArray) -> float:
    """Highest autocorrelation along the rows of a view (h, w, 3), beyond the shift where it first falls to 0.3."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    window = inside.astype(np.float32)
    size = cv2.getOptimalDFTSize(2 * inside.shape[1])
    mean = cv2.blur(grey * window, (33, 33)) / np.maximum(cv2.blur(window, (33, 33)), 1e-3)
    detail = (grey - mean) * window
    spectra = [np.fft.rfft(values, size, axis=1) for values in (detail, detail**2, window)]
    products = ((0, 0), (1, 2), (2, 1), (2, 2))
    shifted, here, there, pixels = (
        np.fft.irfft((spectra[a] * spectra[b].conj()).sum(axis=0), size)[: inside.shape[1] // 2] for a, b in products
    )
    correlation = shifted / np.sqrt(np.maximum(here, 1e-6) * np.maximum(there, 1e-6))
    correlation = correlation[pixels > pixels[0] / 4]
    fallen = np.flatnonzero(correlation < 0.3)
    return float(correlation[fallen[0] :].max()) if len(fallen) else 0.0
