"""Resizing with crop, pad or stretch: the scaled size and the window cut from it."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

from arbiview_aug.cameras.validation import MAX_SIZE_PX, checked_size
from arbiview_aug.errors import CalibrationError, shown

Fit = Literal["crop", "pad", "stretch"]
"""``stretch`` scales each side separately; others keep the aspect ratio. ``crop`` scales to cover the size and cuts
at the top and both sides. ``pad`` scales to fit inside and adds bars above and at both sides."""


class Framing(NamedTuple):
    """The size (h, w) that an image is scaled to, and the window of ``size`` (h, w) with first pixel (left, top).

    ``top`` and ``left`` are negative where bars are added.
    """

    scaled: tuple[int, int]
    top: int
    left: int
    size: tuple[int, int]

    @property
    def has_bars(self) -> bool:
        """Whether the window exceeds the scaled image."""
        return self.scaled[0] < self.size[0] or self.scaled[1] < self.size[1]


def framing(name: str, size: tuple[int, int], to: tuple[int, int], fit: Fit) -> Framing:
    """Frame an image of ``size`` for the size ``to``, both (h, w) in pixels.

    The bottom row stays and columns are centred, as BEV detectors crop their images. ``name`` is the camera's.
    """
    if fit not in get_args(Fit):
        raise CalibrationError(f"camera {name!r}: fit: expected one of {', '.join(get_args(Fit))}, got {fit!r}")
    h, w = to = checked_size(f"camera {shown(name)}", to)
    if fit == "stretch":
        return Framing(to, 0, 0, to)
    # In integers: rounding errors of floats would change the window by a pixel where the aspects are equal.
    (old_h, old_w), by_height = size, (h * size[1] >= w * size[0]) == (fit == "crop")
    scaled = (h, (2 * h * old_w + old_h) // (2 * old_h)) if by_height else ((2 * w * old_h + old_w) // (2 * old_w), w)
    scaled = max(1, scaled[0]), max(1, scaled[1])
    if max(scaled) > MAX_SIZE_PX:
        got = f"{scaled}, scaled from {size}; use fit='pad' or 'stretch', or a size of the image's shape"
        expected = f"expected at most {MAX_SIZE_PX} px a side before cropping"
        raise CalibrationError(f"camera {name!r}: size={to}, fit={fit!r}: {expected}, got {got}")
    return Framing(scaled, scaled[0] - h, (scaled[1] - w) // 2, to)
