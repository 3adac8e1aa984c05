"""Beam tables estimated from scans: ``Lidar.fitted``."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.errors import CalibrationError, shown

LEAST_POINTS = 100
"""Fewest points of all scans together."""

_NEAREST_M = 1.0  # nearer returns are missing ones, which motion compensation moves from zero, or the own car's
_BIN_DEG, _SMOOTH = 0.01, np.array([1, 4, 6, 4, 1]) / 16
_LEAST_DENSITY = 3.0  # of a beam, points in a bin
_VALLEY = 0.5  # two beams have a lower density between them than this share of each
_AT_BEAMS = 0.8  # of the points are within a quarter of the spacing of a beam, or nearest to their own ring's
_SAME_DEG = 0.005  # returns of one ray
_GAP_DEG = 30.0  # a wider gap between azimuths ends a sector

Numbers = npt.NDArray[np.int64]


def checked_scans(name: str, points: Any, rings: Any) -> tuple[list[FloatArray], list[Numbers] | None]:
    """Scans (P, 3), and rings (P,) if given, of one scan or a list of scans.

    Raises:
        CalibrationError: Other shapes.
    """
    parts = points if isinstance(points, list | tuple) else [points]
    try:
        scans = [np.asarray(part, np.float64) for part in parts]
    except (TypeError, ValueError, RuntimeError) as error:  # of words, and of tensors elsewhere or with gradients
        raise _error(name, f"arrays or CPU tensors of numbers, got {shown(points)} ({error})") from None
    if not scans or any(scan.ndim != 2 or scan.shape[1] < 3 for scan in scans):
        raise _error(name, f"scans of shape (P, >= 3), got {shown([scan.shape for scan in scans])}")
    scans = [scan[:, :3] for scan in scans]
    if rings is None:
        return scans, None
    expected = f"lidar {name!r}: rings: expected the ring of each point, {shown([(len(scan),) for scan in scans])}"
    try:
        numbers = [np.asarray(part) for part in (rings if isinstance(rings, list | tuple) else [rings])]
    except (TypeError, ValueError, RuntimeError) as error:
        raise CalibrationError(f"{expected}, got {shown(rings)} ({error})") from None
    if [part.shape for part in numbers] != [(len(scan),) for scan in scans]:
        raise CalibrationError(f"{expected}, got {shown([part.shape for part in numbers])}")
    return scans, numbers


def fitted_fields(name: str, scans: Sequence[FloatArray], rings: Sequence[Numbers] | None) -> dict[str, Any]:
    """Beam table, azimuth step, range and azimuths of the scanner that measured scans (P, 3), in its own frame.

    Raises:
        CalibrationError: Too few points, or elevations that do not gather at beams.
    """
    polar = [polar_deg(scan[_is_return(scan)]) for scan in scans]
    elevation, azimuth, distance = np.concatenate(polar, axis=1)
    if len(elevation) < LEAST_POINTS:
        raise _error(name, f"at least {LEAST_POINTS} finite points off the scanner's own place, got {len(elevation)}")
    if rings is None:
        table = np.array(_peaks_deg(elevation))
        is_at_beam = _is_at_beam(elevation, table)
    else:
        ring = np.concatenate([of_scan[_is_return(scan)] for of_scan, scan in zip(rings, scans, strict=True)])
        numbers, ring = np.unique(ring, return_inverse=True)
        table = np.array([np.median(elevation[ring == k]) for k in range(len(numbers))])
        order = np.argsort(table)
        is_at_beam = order[_nearest(elevation, table[order])] == ring
    if is_at_beam.mean() < _AT_BEAMS:
        got = f"{len(elevation)} points of which {is_at_beam.mean():.0%} are at one of {len(table)}"
        fix = "give the sensor's own pose, and scans that are not merged; motion-compensated ones need rings"
        raise _error(name, f"elevations that gather at beams, got {got}; {fix}")
    step = _azimuth_step_deg(name, polar, table)
    return {
        "elevations_deg": tuple(table.tolist()),
        "azimuth_step_deg": step,
        "range_m": (float(distance.min()), float(distance.max())),
        "azimuth_deg": _span_deg(azimuth, step),
    }


def _is_return(scan: FloatArray) -> BoolArray:
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(scan, axis=1)
    return np.isfinite(distance) & (distance > _NEAREST_M)


def polar_deg(points: FloatArray) -> FloatArray:
    """(3, n) elevations and azimuths in degrees, and distances, of points (n, 3) in a scanner's frame."""
    x, y, z = points.T
    level = np.hypot(x, y)
    return np.stack([np.degrees(np.arctan2(z, level)), np.degrees(np.arctan2(y, x)), np.hypot(level, z)])


def _peaks_deg(elevation: FloatArray) -> list[float]:
    """Elevations at which points gather, with clearly fewer points between them."""
    counts = np.bincount(np.rint((elevation + 90) / _BIN_DEG).astype(int), minlength=round(180 / _BIN_DEG) + 1)
    density = np.convolve(counts, _SMOOTH, "same")
    peaks: list[int] = []
    edge, rising = 0, False  # the bin of the highest density while it rises, of the lowest while it falls
    for k, value in enumerate(density):
        if rising == (value > density[edge]):
            edge = k
        elif rising and value < _VALLEY * density[edge]:
            peaks.append(edge)
            edge, rising = k, False
        elif not rising and value >= _LEAST_DENSITY and value > density[edge] / _VALLEY:
            edge, rising = k, True
    return [float(np.median(part)) for part in _parts(elevation, np.array(peaks) * _BIN_DEG - 90) if len(part)]


def _parts(elevation: FloatArray, table: FloatArray) -> list[FloatArray]:
    """The elevations nearest to each beam of an ascending table, those beyond half a spacing at its ends left out."""
    if len(table) < 2:
        return [elevation[np.abs(elevation - beam) < 1] for beam in table]
    first, last = (3 * table[0] - table[1]) / 2, (3 * table[-1] - table[-2]) / 2
    edges = [first, *(table[1:] + table[:-1]) / 2, last]
    return [elevation[(elevation >= low) & (elevation < high)] for low, high in pairwise(edges)]


def _is_at_beam(elevation: FloatArray, beams: FloatArray) -> BoolArray:
    """Whether elevations (n,) are within a quarter of the spacing there of a beam of an ascending table.

    A single beam has a spacing of 1 degree.
    """
    if len(beams) < 2:
        return np.abs(elevation - beams[0]) < 0.25 if len(beams) else np.zeros(len(elevation), bool)
    beam, spacing = _nearest(elevation, beams), np.diff(beams)
    narrow = np.minimum(np.append(spacing, np.inf), np.append(np.inf, spacing))
    return np.asarray(np.abs(elevation - beams[beam]) <= narrow[beam] / 4)


def _nearest(elevation: FloatArray, beams: FloatArray) -> Numbers:
    """Places (n,) of the nearest beams in an ascending table."""
    return np.searchsorted((beams[1:] + beams[:-1]) / 2, elevation)


def _azimuth_step_deg(name: str, polar: Sequence[FloatArray], table: FloatArray) -> float:
    """The usual angle from a return to the next of the same beam; columns of two scans do not coincide."""
    steps = []
    for elevation, azimuth, _ in polar:
        beam = _nearest(elevation, np.sort(table))
        order = np.lexsort((azimuth, beam))
        apart = np.diff(azimuth[order])
        steps.append(apart[(np.diff(beam[order]) == 0) & (apart > _SAME_DEG)])
    step = np.concatenate(steps)
    if not len(step):
        raise _error(name, "beams with several returns each, to tell the azimuth step")
    usual = np.quantile(step, 0.25)  # rays that did not return make some steps double
    return float(step[(step > usual / 2) & (step < 1.5 * usual)].mean())


def _span_deg(azimuth: FloatArray, step: float) -> tuple[float, float]:
    """First azimuth and end of a sector, or all around."""
    turn = np.sort(azimuth)
    gap = np.diff(turn, append=turn[0] + 360)
    widest = int(gap.argmax())
    if gap[widest] < _GAP_DEG:
        return -180.0, 180.0
    first = float(turn[(widest + 1) % len(turn)])
    return first, first + min(360.0, 360 - float(gap[widest]) + step)


def _error(name: str, words: str) -> CalibrationError:
    return CalibrationError(f"lidar {name!r}: points: expected {words}")
