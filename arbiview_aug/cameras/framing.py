"""How an image comes to another size: resized, then cut to a window, or set between bars."""

from __future__ import annotations

from typing import Literal, NamedTuple, get_args

from arbiview_aug.cameras.validation import MAX_SIZE_PX, checked_size
from arbiview_aug.errors import CalibrationError

Fit = Literal["crop", "pad", "stretch"]
"""``crop`` and ``pad`` keep the aspect. ``crop``: scaled to cover the size, and cut at the top and at both sides.
``pad``: scaled to fit inside, with bars above and at both sides. ``stretch``: each side scaled by itself."""


class Framing(NamedTuple):
    """An image is resized to ``scaled``, then the window of ``size`` whose first pixel is (left, top) is taken.

    Attributes:
        scaled: (h, w) in pixels.
        top: First row of the window; negative: so many rows of bars stand above the image.
        left: First column; negative likewise.
        size: (h, w) of the window.
    """

    scaled: tuple[int, int]
    top: int
    left: int
    size: tuple[int, int]

    @property
    def has_bars(self) -> bool:
        """Whether the window shows more than the image."""
        return self.scaled[0] < self.size[0] or self.scaled[1] < self.size[1]


def framing(name: str, size: tuple[int, int], to: tuple[int, int], fit: Fit) -> Framing:
    """How an image of ``size`` comes to the size ``to``, both (h, w) in pixels.

    The last row stays the last, as detectors in bird's-eye view cut their images: what is near stands there. The
    columns are centred. Where both sizes have one aspect, or nearly, the window is the whole image.

    Args:
        name: Of the camera, for errors.
        size: Of the image.
        to: The size that is wanted.
        fit: How.

    Raises:
        CalibrationError: An unknown ``fit``, or shapes so different that the scaled image would be too large.
    """
    if fit not in get_args(Fit):
        raise CalibrationError(f"camera {name!r}: fit: expected one of {', '.join(get_args(Fit))}, got {fit!r}")
    h, w = to = checked_size(name, to)
    if fit == "stretch":
        return Framing(to, 0, 0, to)
    # In whole numbers: floats would differ by the last bit, and so by a pixel, where the aspects are equal.
    by_height = (h * size[1] >= w * size[0]) == (fit == "crop")
    scaled = (h, max(1, _rounded(h * size[1], size[0]))) if by_height else (max(1, _rounded(w * size[0], size[1])), w)
    if max(scaled) > MAX_SIZE_PX:
        raise CalibrationError(
            f"camera {name!r}: size={to}, fit={fit!r}: expected an image of at most {MAX_SIZE_PX} px a side before it "
            f"is cut, got {scaled}, scaled from {size}; take fit='pad' or 'stretch', or a size of its shape"
        )
    return Framing(scaled, scaled[0] - h, (scaled[1] - w) // 2, to)


def _rounded(numerator: int, denominator: int) -> int:
    """The nearest whole number of a quotient of positive ones."""
    return (2 * numerator + denominator) // (2 * denominator)
