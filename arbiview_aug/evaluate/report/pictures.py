"""Pictures to look at: contact sheets and uncovered regions. All are (h, w, 3) uint8 RGB."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.images import Image, to_bytes

Picture = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

INK: Colour = (40, 40, 40)
PAPER: Colour = (255, 255, 255)
HOLE: Colour = (255, 0, 160)
"""Outline and hatching of uncovered regions: a colour that streets do not have."""

_GAP_PX = 6
_CAPTION_PX = 20
_TITLE_PX = 28
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def text_size(text: str, scale: float) -> tuple[int, int]:
    """(height, width) in pixels of a line of text."""
    (width, height), _ = cv2.getTextSize(text, _FONT, scale, 1)
    return int(height), int(width)


def put_text(
    picture: Picture,
    text: str,
    xy: tuple[float, float],
    *,
    scale: float = 0.45,
    colour: Colour = INK,
    anchor: Literal["left", "middle", "right"] = "left",
    halo: Colour | None = None,
) -> None:
    """Write ASCII text in place; ``xy`` is on the base line, ``halo`` keeps it readable over a picture."""
    # OpenCV's fonts know no other characters and print '?' for each.
    text = text.replace("−", "-").replace("°", " deg").encode("ascii", "replace").decode()
    shift = {"left": 0.0, "middle": 0.5, "right": 1.0}[anchor] * text_size(text, scale)[1]
    at = round(xy[0] - shift), round(xy[1])
    if halo is not None:
        cv2.putText(picture, text, at, _FONT, scale, halo, 4, cv2.LINE_AA)
    cv2.putText(picture, text, at, _FONT, scale, colour, 1, cv2.LINE_AA)


def contact_sheet(
    rows: Sequence[Sequence[Image]],
    labels: Sequence[Sequence[str]] | None = None,
    *,
    titles: Sequence[str] | None = None,
    width_px: int = 1800,
) -> Picture:
    """Rows of images with captions; the images of a row share a height and fill the width.

    Args:
        rows: Images (h, w, 3) on the scale 0-255, row by row.
        labels: One caption per image; too long ones are cut.
        titles: One line above each row.
        width_px: Width of the sheet.

    Returns:
        (h, width_px, 3) picture.
    """
    if not rows or not all(len(row) for row in rows):
        raise DataError("contact sheet: expected at least one image in every row, got an empty row")
    for name, given in (("labels", labels), ("titles", titles)):
        if given is not None and len(given) != len(rows):
            raise DataError(f"contact sheet: {name}: expected one entry for each of {len(rows)} rows, got {len(given)}")
    strips = []
    for k, row in enumerate(rows):
        if titles is not None:
            strip = _paper(_TITLE_PX, width_px)
            put_text(strip, titles[k], (_GAP_PX, _TITLE_PX - 8), scale=0.6)
            strips.append(strip)
        strips.append(_row(row, labels[k] if labels is not None else None, width_px))
    return np.concatenate([*strips, _paper(_GAP_PX, width_px)])


def _row(images: Sequence[Image], labels: Sequence[str] | None, width_px: int) -> Picture:
    if labels is not None and len(labels) != len(images):
        raise DataError(f"contact sheet: expected {len(images)} labels in a row, got {len(labels)}")
    free = width_px - _GAP_PX * (len(images) + 1)
    aspects = [image.shape[1] / image.shape[0] for image in images]
    # A row of few images would otherwise be taller than the rest of the sheet.
    height = max(1, round(min(free / sum(aspects), 0.3 * width_px)))
    caption = _CAPTION_PX if labels is not None else 0
    strip = _paper(_GAP_PX + height + caption, width_px)
    x = _GAP_PX
    for k, (image, aspect) in enumerate(zip(images, aspects, strict=True)):
        w = max(1, min(round(aspect * height), width_px - x))
        shrinks = image.shape[0] > height
        small = cv2.resize(to_bytes(image), (w, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
        strip[_GAP_PX : _GAP_PX + height, x : x + w] = small
        if labels is not None:
            label = labels[k]
            while label and text_size(label, 0.42)[1] > w:
                label = label[:-1]
            put_text(strip, label, (x, _GAP_PX + height + 14), scale=0.42)
        x += w + _GAP_PX
    return strip


def outline_coverage(image: Image, coverage: BoolArray, *, colour: Colour = HOLE) -> Picture:
    """The image with hatching and an outline where nothing was seen.

    Args:
        image: (h, w, 3) on the scale 0-255.
        coverage: (h, w) bool, True = some source saw it.
        colour: Of the hatching.
    """
    picture = to_bytes(image).copy()
    hole = ~coverage
    if not hole.any():
        return picture
    h, w = coverage.shape
    spacing = max(8, h // 30)
    row, column = np.indices((h, w), sparse=True)
    hatch = hole & ((row + column) % spacing < max(1, spacing // 5))
    picture[hatch] = colour
    contours = cv2.findContours(hole.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)[0]
    cv2.drawContours(picture, contours, -1, colour, max(1, h // 200), cv2.LINE_AA)
    return picture


def overlay_confidence(image: Image, confidence: npt.NDArray[np.floating[Any]]) -> Picture:
    """The image in grey under colours from red (0) over yellow to green (1).

    Args:
        image: (h, w, 3) on the scale 0-255.
        confidence: (h, w) in [0, 1].
    """
    sure = np.clip(confidence.astype(np.float32), 0, 1)[..., None]
    colour = 255 * np.concatenate([np.minimum(1, 2 - 2 * sure), np.minimum(1, 2 * sure), 0 * sure], axis=-1)
    grey = to_bytes(image).mean(axis=-1, keepdims=True)
    return to_bytes(0.5 * grey + 0.5 * colour)


def save_picture(path: str | Path, picture: Picture) -> Path:
    """Write a picture as PNG or JPEG, by its suffix; folders are made."""
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        written = cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    except (OSError, cv2.error):
        written = False
    if not written:
        raise DataError(f"picture {path}: expected a name ending in .png or .jpg, in a folder that can be written to")
    return path


def _paper(height: int, width: int) -> Picture:
    return np.full((height, width, 3), PAPER, np.uint8)
