"""Compiled loops of rendering: reading ahead, readings of shared pixels, tone curves, and blending along seams."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.environment import compiled, inlined

_ZERO, _ONE = np.float32(0), np.float32(1)
_MOST_SIDE_PX = 32767
_AHEAD_COLUMNS, _MOST_AHEAD = 176, 32  # columns of a strip at a time, and maximum number of reads for each pixel
_BLOCK_PX = 128  # of a row that are compared at once


@compiled
def read_ahead(atlas: Any, pixel: int, packed: Any, winner: Any) -> int:
    """Read what a strip of a view is about to read from an atlas, so that it lies in the cache; the result is no use.

    The view itself reads along slanted lines with gaps, which no cache foresees: it would take up to twice as long.

    Args:
        atlas: (rows, bytes) uint8.
        pixel: Bytes of one of its pixels.
        packed: (h, w) ``FixedMap.packed``.
        winner: (h, w) int8 source, -1 where none is read.
    """
    (h, w), total = winner.shape, 0
    ends = np.empty((4, 128), np.int32)  # first and last row and column of each source
    for x0 in range(0, w, _AHEAD_COLUMNS):
        ends[0::2] = _MOST_SIDE_PX
        ends[1::2] = -1
        for j in range(0, h + 3, 4):
            for i in range(x0, min(x0 + _AHEAD_COLUMNS, w) + 7, 8):
                y, x = min(j, h - 1), min(i, w - 1)
                k, row, column = winner[y, x], packed[y, x] >> 16, packed[y, x] & 0xFFFF
                if k >= 0:
                    ends[0, k], ends[1, k] = min(ends[0, k], row), max(ends[1, k], row)
                    ends[2, k], ends[3, k] = min(ends[2, k], column), max(ends[3, k], column)
        for k in range(128):
            top, bottom, left, right = ends[0, k], ends[1, k], ends[2, k], ends[3, k]
            if (bottom - top) * (right - left) <= _MOST_AHEAD * h * _AHEAD_COLUMNS:
                for row in range(top, min(bottom + 2, atlas.shape[0])):
                    for at in range(left * pixel, min((right + 2) * pixel, atlas.shape[1]), 64):
                        total ^= atlas[row, at]
    return total  # else nothing would be read


@compiled
def read_pixels(image: Any, camera: int, source: Any, at: Any, scale: Any, pixels: Any) -> None:
    """Read the pixels of a ``camera``'s image (3, h, w), times a float32 scale; what is no number is 0.

    ``pixels`` (2, n, 3) are written where ``source`` (2, n) is this camera; ``at`` (2, n, 2) are rows and columns.
    """
    for side in range(2):
        for k in range(source.shape[1]):
            for c in range(3 if source[side, k] == camera else 0):
                value = np.float32(image[c, at[side, k, 0], at[side, k, 1]]) * scale
                pixels[side, k, c] = value if np.isfinite(value) else _ZERO


@compiled
def log_ratios(pixels: Any, ends: Any, dark: float, bright: float, measured: Any) -> None:
    """Log-ratios between both readings ``pixels`` (2, n, 3) of each group, where they count.

    Pixels count above the mean value ``dark``, and below ``bright`` in every channel. ``ends`` (G + 1,) are the groups'
    first pixels and the last one's end; ``measured`` (G, 3) are written: the number of pixels that count, and the
    median and spread of their log-ratios; 0 without any.
    """
    ratios = np.empty(pixels.shape[1])
    for g in range(len(ends) - 1):
        n = 0
        for k in range(ends[g], ends[g + 1]):
            one, two = pixels[0, k], pixels[1, k]
            light, other = one[0] + one[1] + one[2], two[0] + two[1] + two[2]
            most = max(one[0], one[1], one[2], two[0], two[1], two[2])
            if min(light, other) > 3 * dark and most < bright:
                ratios[n] = np.log(np.float64(light) / np.float64(other))
                n += 1
        measured[g] = 0
        if n:
            middle = np.median(ratios[:n])
            measured[g, 0], measured[g, 1] = n, middle
            measured[g, 2] = 1.4826 * np.median(np.abs(ratios[:n] - middle))


@compiled
def list_runs(values: Any, runs: Any) -> int:
    """List the runs of equal values in the rows of an image (h, w): row, first column, end, value; return their number.

    ``runs`` (h w, 4) are written.
    """
    (h, w), count = values.shape, 0
    for y in range(h):
        row, x = values[y], 0
        while x < w:
            end, value = x + 1, row[x]
            while end < w:
                block, others = row[end : end + _BLOCK_PX], 0
                for k in range(len(block)):
                    others += block[k] != value
                if others:
                    for k in range(len(block)):
                        if block[k] != value:
                            break
                        end += 1
                    break
                end += len(block)
            runs[count, 0], runs[count, 1], runs[count, 2], runs[count, 3] = y, x, end, value
            count, x = count + 1, end
    return count


@inlined
def _toned(value: Any, gain: Any, slope: Any, top: Any) -> Any:
    """A value after a curve, as ``harmonise.tone_curves`` makes it."""
    x = np.float32(value)
    lower, upper = x * gain, x * slope + top * (_ONE - slope)
    return min(lower, upper) if gain > _ONE else max(lower, upper)


@compiled
def tone(values: Any, runs: Any, curves: Any, top: Any, rounding: Any) -> None:
    """Put the pixels of a view (h, 3 w) of interleaved colours, uint8 or float32, through their sources' tone curves.

    ``runs`` (r, 4) are those of ``list_runs``, negative for no source; ``curves`` (N, h, 2) those of each source in
    each row, as ``harmonise.tone_curves`` makes them. ``rounding`` is added before the fraction is cut off.
    """
    for r in range(len(runs)):
        y, first, end, source = runs[r, 0], runs[r, 1], runs[r, 2], runs[r, 3]
        if source >= 0 and curves[source, y, 0] != _ONE:
            part, gain, slope = values[y, 3 * first : 3 * end], curves[source, y, 0], curves[source, y, 1]
            for j in range(len(part)):
                part[j] = _toned(part[j], gain, slope, top) + rounding


@compiled
def tone_pixels(values: Any, source: Any, row: Any, curves: Any, top: Any, rounding: Any) -> None:
    """Put pixels (n, 3) of sources (n,) in rows (n,) of a view through their curves, as ``tone`` does."""
    for k in range(len(values)):
        gain, slope = curves[source[k], row[k], 0], curves[source[k], row[k], 1]
        for c in range(3 if gain != _ONE else 0):
            values[k, c] = _toned(values[k, c], gain, slope, top) + rounding


@compiled
def blend(view: Any, pixel: Any, second: Any, weight: Any, rounding: Any) -> None:
    """Blend colours (n, 3) with shares (n,) float32 into pixels (n,) of a view (h w, 3), uint8 or float32.

    ``rounding`` is added before the fraction is cut off.
    """
    for k in range(len(pixel)):
        at, share = pixel[k], weight[k]
        for c in range(3):
            level = np.float32(view[at, c])
            view[at, c] = level + (np.float32(second[k, c]) - level) * share + rounding


def warm_up() -> None:
    """Compile these kernels, or load them from numba's cache."""
    source, at, number = np.zeros((2, 1), np.int64), np.zeros((2, 1, 2), np.int64), np.zeros(1, np.int64)
    pixels, curves = np.ones((2, 1, 3), np.float32), np.ones((1, 1, 2), np.float32)
    log_ratios(pixels, np.array([0, 1]), 0.0, 2.0, np.empty((1, 3)))
    list_runs(np.zeros((1, 1), np.int8), np.zeros((1, 4), np.int32))
    for planes in (np.zeros((3, 2, 2), np.uint8), np.zeros((3, 2, 2), np.float32)):
        for image in (planes, planes.transpose(0, 2, 1)):  # channels first, and last
            read_pixels(image, 0, source, at, _ONE, pixels)
        view = np.zeros((1, 3), planes.dtype)
        tone(view, np.zeros((1, 4), np.int32), curves, _ONE, _ZERO)
        tone_pixels(view, number.astype(np.int8), number, curves, _ONE, _ZERO)
        blend(view, number, view, curves[0, 0, :1], _ZERO)
