"""Compiled inner loops over colours: readings of shared pixels, tone curves, and blended seams."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.environment import compiled

_ZERO, _ONE = np.float32(0), np.float32(1)


@compiled
def read_pixels(image: Any, at: Any, scale: Any, pixels: Any) -> None:
    """Read an image (3, h, w) at (n, 2) rows and columns, times a scale, into (n, 3) float32; no number is 0."""
    for k in range(len(at)):
        for c in range(3):
            value = np.float32(image[c, at[k, 0], at[k, 1]]) * scale
            pixels[k, c] = value if np.isfinite(value) else _ZERO


@compiled
def log_ratios(pixels: Any, reads: Any, dark: float, bright: float, measured: Any) -> None:
    """Log-ratios between the two readings of each pair's pixels, where they count.

    Args:
        pixels: (K, 3) float32 readings.
        reads: (2, P, L) two readings of each pixel; K after a pair's last one.
        dark: Pixels count above this mean value,
        bright: and below this value in every channel.
        measured: (P, 3) float64, written where pixels count: their number, and the median and spread of their
            log-ratios.
    """
    ratios = np.empty(reads.shape[2])
    for p in range(reads.shape[1]):
        n = 0
        for j in range(reads.shape[2]):
            if reads[0, p, j] == len(pixels):
                break
            one, two = pixels[reads[0, p, j]], pixels[reads[1, p, j]]
            light, other = one[0] + one[1] + one[2], two[0] + two[1] + two[2]
            most = max(one[0], one[1], one[2], two[0], two[1], two[2])
            if min(light, other) > 3 * dark and most < bright:
                ratios[n] = np.log(np.float64(light) / np.float64(other))
                n += 1
        if n:
            middle = np.median(ratios[:n])
            measured[p, 0], measured[p, 1] = n, middle
            measured[p, 2] = 1.4826 * np.median(np.abs(ratios[:n] - middle))


@compiled
def pair_errors(pixels: Any, reads: Any, errors: Any) -> None:
    """Mean squared difference (P,) between the two readings of each pair's pixels; arguments as in ``log_ratios``."""
    for p in range(reads.shape[1]):
        total, n = 0.0, 0
        for j in range(reads.shape[2]):
            if reads[0, p, j] == len(pixels):
                break
            for c in range(3):
                total += np.float64(pixels[reads[0, p, j], c] - pixels[reads[1, p, j], c]) ** 2
            n += 3
        errors[p] = total / n


@compiled
def tone(values: Any, runs: Any, curves: Any, top: Any, rounding: Any) -> None:
    """Put the pixels of a view through the tone curves of their sources.

    Args:
        values: (3 n,) uint8 or float32, changed.
        runs: (r, 3) first pixel, end and source of each run of pixels.
        curves: (s, 2) float32 of each source, as ``harmonise.tone_curves`` makes them.
        top: Largest value.
        rounding: Added before the fraction is cut off.
    """
    for r in range(len(runs)):
        start, end, source = runs[r, 0], runs[r, 1], runs[r, 2]
        gain, slope = curves[source, 0], curves[source, 1]
        if gain == _ONE:
            continue
        part, offset = values[3 * start : 3 * end], top * (_ONE - slope)
        if gain > _ONE:
            for j in range(len(part)):
                x = np.float32(part[j])
                part[j] = min(x * gain, x * slope + offset) + rounding
        else:
            for j in range(len(part)):
                x = np.float32(part[j])
                part[j] = max(x * gain, x * slope + offset) + rounding


@compiled
def blend(first: Any, second: Any, weight: Any, rounding: Any) -> None:
    """Blend images (h, 3 w) of interleaved colours, uint8 or float32, into the first one.

    ``weight`` (h, w) float32 is the share of the second; ``rounding`` is added before the fraction is cut off.
    """
    (h, w), shares = weight.shape, np.empty(first.shape[1], np.float32)
    for y in range(h):
        one, two = first[y], second[y]
        for x in range(w):
            shares[3 * x] = shares[3 * x + 1] = shares[3 * x + 2] = weight[y, x]
        for x in range(3 * w):
            level = np.float32(one[x])
            one[x] = level + (np.float32(two[x]) - level) * shares[x] + rounding


def warm_up() -> None:
    """Compile these kernels, or load them from numba's cache."""
    reads, pixels, curve = np.zeros((2, 1, 1), np.int64), np.ones((1, 3), np.float32), np.ones((1, 2), np.float32)
    log_ratios(pixels, reads, 0.0, 2.0, np.empty((1, 3)))
    pair_errors(pixels, reads, np.empty(1))
    for planes in (np.zeros((3, 1, 1), np.uint8), np.zeros((3, 1, 1), np.float32)):
        for image in (planes, planes.transpose(0, 2, 1)):  # channels first, and last
            read_pixels(image, reads[:, :, 0].T.copy(), _ONE, pixels)
        tone(planes.reshape(-1), np.zeros((1, 3), np.int64), curve, _ONE, _ZERO)
        blend(planes.reshape(1, 3), planes.reshape(1, 3), pixels[:, :1], _ZERO)
