"""Cameras as in a rig file: made of what readers found, and taken apart for writers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from arbiview_aug.cameras import validation
from arbiview_aug.cameras.lens import LENSES, FloatArray
from arbiview_aug.errors import CalibrationError

WAY_OUT = (
    "undistort the images to a pinhole's, or fit a lens of this package (docs/rigs.md, A lens that is not read), and "
    "write a rig file"
)


def refusal(name: str, expected: str, got: str, fix: str = "", *, key: str = "") -> CalibrationError:
    """The error of a camera whose file says something else than ``expected``."""
    return validation.refusal(f"camera {name!r}", key, expected, got, fix)


def fitted(name: str, lens: str, coefficients: Any) -> tuple[str, list[float]]:
    """A lens and as many coefficients as it has, without zeros behind them; a polynomial of zeros is a pinhole."""
    numbers = [float(k) for k in np.ravel(coefficients)]
    if lens == "radtan" and not any(numbers):
        return "pinhole", []
    counts = LENSES[lens].coefficient_counts
    for count in reversed(counts):
        if len(numbers) >= count and not any(numbers[count:]):
            return lens, numbers[:count]
    got = f"{len(numbers)}{' (thin prism or tilt)' if lens == 'radtan' and len(numbers) > 8 else ''}"
    raise refusal(name, f"{' or '.join(map(str, counts))} coefficients of {lens}", got, WAY_OUT)


def camera_entry(
    name: str, size: tuple[Any, Any], K: Any, cam2ego: FloatArray, lens: str = "pinhole", coefficients: Any = ()
) -> dict[str, Any]:
    """A camera as in a rig file, of (width, height)."""
    lens, coefficients = fitted(name, lens, coefficients)
    return {
        **{"name": name, "width": size[0], "height": size[1]},
        **{"K": np.asarray(K, float).tolist(), "cam2ego": cam2ego.tolist()},
        "distortion": {"model": lens, "coeffs": coefficients} if lens != "pinhole" else None,
    }


def matrix(fx: float, fy: float, cx: float, cy: float) -> list[list[float]]:
    """(3, 3) intrinsics."""
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


def focal_and_center(camera: Mapping[str, Any], tool: str) -> list[float]:
    """fx, fy, cx and cy of a rig file's camera, for a tool that knows no skew."""
    (fx, skew, cx), (_, fy, cy), _ = camera["K"]
    if skew:
        raise refusal(camera["name"], f"K without skew for {tool}", skew)
    return [fx, fy, cx, cy]


def lens_of(camera: Mapping[str, Any], tool: str, most: Mapping[str, int]) -> tuple[str, list[float]]:
    """Lens and coefficients of a rig file's camera for a tool that has ``most`` coefficients of each of its lenses.

    A pinhole is a polynomial of four zeros.
    """
    bent = camera["distortion"] or {"model": "radtan", "coeffs": [0.0] * 4}
    lens, coefficients = bent["model"], list(bent["coeffs"])
    if lens == "radtan" and not any(coefficients[4:]):
        coefficients = coefficients[:4]
    if len(coefficients) > most.get(lens, -1):
        known = ", ".join(f"{name} ({count} coefficients at most)" for name, count in most.items())
        got = f"{lens} with {len(coefficients)}"
        raise refusal(camera["name"], f"a lens of {tool}: pinhole, {known}", got)
    return lens, coefficients
