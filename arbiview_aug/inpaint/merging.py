"""Merge the views that neighbouring frames have of one hole: votes, exposure, and the sharpest accepted pixel.

The sharpest static view is taken at each pixel, at the current view's exposure. A candidate is accepted by the votes of
the others, as far as the labels require (``ChangeRisk``). ``NONE``: half of the others agree. ``SHADED``: all others
agree. ``BESIDE``: all others agree, and there is at least one. ``UNLABELLED``: the nearest frames before and after the
current one agree with it; where all frames lie on one side, at least three agree, or none of at most two contradicts;
and the current frame shows no newly arrived object next to the hole.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.image_ops import bounding_box, of_cells
from arbiview_aug.sample.neighbours import ChangeRisk

_AGREEMENT_LEVELS = 16.0
"""Largest difference of two frames that agree, in grey levels over a window."""

_CONTRADICTION_LEVELS = 24.0
"""Largest difference between a frame and the current one on a seam, in grey levels (``docs/decisions.md``)."""

_WINDOW_PX = 5
"""Side of the window in which two frames are compared, pixels; at least 3 samples."""

_CONTRADICTION_REACH = 1.25
"""A contradiction on the seam reaches to where agreement is nearer by this factor (``docs/decisions.md``)."""

_SAMPLES_PER_SEAM = 7
"""Rows or columns across a seam in which labelled frames are compared; all of narrower seams."""

_FEW_CANDIDATES = 2
"""With at most this many candidates, accept one without a confirming vote."""

_MIN_SEAM_PX = 20
"""Minimum number of common pixels for an exposure."""

_MAX_LOG_GAIN, _MAX_LOG_TINT = 1.3, 0.25
"""Largest logarithm of the gain between two cameras (real rigs: log 3.5), and of its spread over the channels."""

_SEAM_INLIERS, _OVERLAP_INLIERS = 0.5, 0.7
"""Share of pixels that must agree after the gain: more between two neighbours, which may both show passing traffic."""

_DARK_LEVELS = 4.0
"""Offset added to colours before taking their ratio."""

_MEAN_WEIGHT = 0.02
"""Weight of the seam's mean offset relative to the local one; far from the seam only the mean is left."""


Levels = npt.NDArray[np.float32]
"""An image (3, h, w) in grey levels."""


class Candidate(NamedTuple):
    """The part of a hole that one neighbour shows."""

    shows: BoolArray  # (h, w) bool, the free and seam pixels that it shows
    # (h, w) uint8, how much coarser it shows them, in half octaves; 0 for as sharp as the target
    blur: npt.NDArray[np.uint8]
    risk: npt.NDArray[np.uint8]  # (h, w) uint8 ``ChangeRisk``
    later: bool  # whether it was recorded after the current frame
    image: torch.Tensor = torch.empty(0)  # (3, h, w) of the view's type, once it is rendered

    def part(self, place: tuple[slice, slice]) -> Candidate:
        """Some of its rows and columns."""
        maps = self.shows[place], self.blur[place], self.risk[place]
        return Candidate(*maps, self.later, self.image[(..., *place)])


def merged(
    view: torch.Tensor, free: BoolArray, seam: BoolArray, candidates: Sequence[Candidate], margin_px: int
) -> tuple[torch.Tensor, npt.NDArray[np.int16]]:
    """Fill the free pixels of a view by the sharpest accepted candidate, at the view's exposure.

    Args:
        view: (3, h, w) uint8, or float in [0, 1]; gradients reach the pixels that it keeps.
        free: (h, w) bool, True where the view may be filled.
        seam: (h, w) bool, ``margin_px`` wide, True where view and candidates should agree.
        candidates: The nearest first.

    Returns:
        (3, h, w) filled view, and (h, w) int16 index of the candidate taken, -1 for none.
    """
    pixels, taken_by = view.clone(), np.full(free.shape, -1, np.int16)
    shows = np.logical_or.reduce([candidate.shows for candidate in candidates])
    if not (shows & free).any():
        return pixels, taken_by
    box = bounding_box(shows, margin_px)
    part, free, seam, candidates = pixels[(..., *box)], free[box], seam[box], [c.part(box) for c in candidates]
    # Exposures and votes are computed on a sample of pixels; without labels the borders of moved objects must be found.
    unlabelled = any((candidate.risk == ChangeRisk.UNLABELLED).any() for candidate in candidates)
    step, n = 1 if unlabelled else max(1, margin_px // _SAMPLES_PER_SEAM), len(candidates)
    every = slice(None, None, step), slice(None, None, step)
    levels = 1.0 if view.dtype == torch.uint8 else 255.0
    samples = [candidate.part(every) for candidate in candidates]
    current, images = _levels(part[(..., *every)], levels), [_levels(candidate.image, levels) for candidate in samples]
    recorded = [image.copy() if step > 1 else image for image in images]
    gains = _tone(current, images, free[every], seam[every], samples, max(1, margin_px // 2 // step))
    shown = np.stack([candidate.shows & free[every] for candidate in samples])
    accepted = shown & _accepted(current, images, shown, seam[every], samples, max(3, _WINDOW_PX // step | 1))
    # The order breaks ties.
    rank, chosen = np.full(free.shape, 256 * n, np.uint16), taken_by[box]
    for k, candidate in enumerate(candidates):
        # Samples may miss a border.
        flags = accepted[k], shown[k] & ~accepted[k]
        accepts, rejects = (cv2.dilate(flag.view(np.uint8), np.ones((3, 3), np.uint8)) > 0 for flag in flags)
        usable = of_cells(accepted[k] | (accepts & ~rejects & ~shown[k]), step, free.shape) & candidate.shows & free
        key = candidate.blur * np.uint16(n) + np.uint16(k)
        better = usable & (key < rank)
        np.copyto(rank, key, where=better)
        np.copyto(chosen, np.int16(k), where=better)
    filled = part.clone(memory_format=torch.contiguous_format)
    for k, candidate in enumerate(candidates):
        taken = np.flatnonzero(chosen == k)
        y, x = np.divmod(taken, free.shape[1])
        at = y // step * current.shape[2] + x // step
        colours = images[k].reshape(3, -1).take(at, 1)
        if step > 1:  # difference of a pixel from its sample
            detail = _levels(candidate.image, levels).reshape(3, -1).take(taken, 1)
            colours += gains[k] * (detail - recorded[k].reshape(3, -1).take(at, 1))
        colours = np.clip(np.rint(colours) if levels == 1 else colours / np.float32(levels), 0, 255 / levels)
        filled.view(3, -1).index_copy_(1, torch.from_numpy(taken).to(view.device), torch.from_numpy(colours).to(view))
    pixels[(..., *box)] = filled
    return pixels, taken_by


def _levels(image: torch.Tensor, levels: float) -> Levels:
    grey = image.detach().cpu().to(torch.float32, memory_format=torch.contiguous_format, copy=True)
    return np.asarray((grey.mul_(levels) if levels != 1 else grey).numpy())


# --- votes ------------------------------------------------------------------------------------------------------------
def _accepted(
    current: Levels,
    toned: Sequence[Levels],
    shown: BoolArray,
    seam: BoolArray,
    candidates: Sequence[Candidate],
    window: int,
) -> BoolArray:
    """Whether each candidate shows the present scene (n, h, w)."""
    votes, nearest = np.zeros(shown.shape, np.uint8), np.full((2, *seam.shape), -1, np.int16)
    for k, candidate in enumerate(candidates):
        side = nearest[int(candidate.later)]
        np.copyto(side, np.int16(k), where=shown[k] & (side < 0))
    static = shown.copy()  # as far as the nearest frames before and after the current one agree
    for pair in combinations(range(len(candidates)), 2):
        both = shown[pair[0]] & shown[pair[1]]
        agree = _agreeing(toned[pair[0]], toned[pair[1]], both, _AGREEMENT_LEVELS, window)
        for i, j in (pair, pair[::-1]):
            votes[i] += agree
            static[i] &= ~both | agree | (nearest[int(candidates[j].later)] != j)
    others = shown.sum(axis=0, dtype=np.uint8) - np.uint8(1)
    risk, few = np.stack([candidate.risk for candidate in candidates]), len(candidates) <= _FEW_CANDIDATES
    unanimous = votes == others
    accepted = unanimous | ((risk < ChangeRisk.SHADED) & (2 * votes >= others))
    accepted &= (risk < ChangeRisk.BESIDE) | (votes >= (0 if few else 1))
    unlabelled = risk == ChangeRisk.UNLABELLED
    if unlabelled.any():
        on_both_sides = (nearest[0] >= 0) & (nearest[1] >= 0)
        static = (static & on_both_sides) | (unanimous & (votes >= (0 if few else 2)) & ~on_both_sides)
        if len(candidates) > 1:  # a single candidate may itself show the moving object
            static &= ~_arrived(current, toned, seam, candidates, window)
        accepted = (static & unlabelled) | (accepted & ~unlabelled)
    return np.asarray(accepted)


def _arrived(
    current: Levels, toned: Sequence[Levels], seam: BoolArray, candidates: Sequence[Candidate], window: int
) -> BoolArray:
    """Pixels (h, w) of a hole that continue an object which only the current frame shows on the seam."""
    known, agree = np.zeros_like(seam), np.zeros_like(seam)
    for image, candidate in zip(toned, candidates, strict=True):
        both = seam & candidate.shows
        known |= both
        agree |= _agreeing(image, current, both, _CONTRADICTION_LEVELS, window)
    contradicts = known & ~agree
    if not contradicts.any():
        return contradicts
    away, near = (
        np.asarray(cv2.distanceTransform((~places).view(np.uint8), cv2.DIST_L2, 5)) for places in (contradicts, agree)
    )
    return np.asarray(away / _CONTRADICTION_REACH < near)


def _agreeing(first: Levels, second: Levels, where: BoolArray, limit: float, window: int) -> BoolArray:
    """Pixels (h, w) where two images differ by less than a limit: means over channels and valid pixels of a window."""
    rows = (image.reshape(-1, image.shape[2]) for image in (first, second))
    apart = np.asarray(cv2.absdiff(*rows)).reshape(first.shape)
    valid = where.astype(np.float32)
    total, count = (
        np.asarray(cv2.boxFilter(part, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT))
        for part in ((apart[0] + apart[1] + apart[2]) * valid, valid)
    )
    return np.asarray(where & (total < 3 * limit * count))


# --- exposure ---------------------------------------------------------------------------------------------------------
def _tone(
    view: Levels,
    images: list[Levels],
    free: BoolArray,
    seam: BoolArray,
    candidates: Sequence[Candidate],
    cell: int,
) -> list[Levels]:
    """Bring the candidates to the view's exposure, in place; return their gains (3, 1)."""
    unmatched, gains = [], [np.ones((3, 1), np.float32)] * len(candidates)
    for k, candidate in enumerate(candidates):
        match = _expose(images[k], view, seam & candidate.shows, _SEAM_INLIERS)
        if match is None:
            unmatched.append(k)
        else:
            gains[k] = match[0]
            images[k] += _offset(*match[1:], seam.shape, cell)
    if not unmatched:
        return gains
    # Candidates with too little of the seam are matched to those with enough.
    reference, known = view.copy(), seam.copy()
    for k in sorted(range(len(candidates)), key=unmatched.__contains__):
        shows = free & candidates[k].shows
        if k in unmatched:
            match = _expose(images[k], reference, shows & known, _OVERLAP_INLIERS)
            if match is None:
                continue
            gains[k] = match[0]
        np.copyto(reference, images[k], where=shows & ~known)
        known |= shows
    return gains


def _expose(
    image: Levels, reference: Levels, where: BoolArray, min_inliers: float
) -> tuple[Levels, npt.NDArray[np.int64], Levels] | None:
    """Give an image a reference's gain, in place: the gain (3, 1), pixels (n,) that then agree, their errors (3, n)."""
    pixel = np.flatnonzero(where)
    if len(pixel) < _MIN_SEAM_PX:
        return None
    ours, theirs = (part.reshape(3, -1).take(pixel, 1) + np.float32(_DARK_LEVELS) for part in (reference, image))
    middle = (len(pixel) - 1) // 2
    gain = np.partition(ours / theirs, middle, axis=1)[:, middle, None]
    logs = np.log(gain)
    if abs(logs.mean()) > _MAX_LOG_GAIN or np.ptp(logs) > _MAX_LOG_TINT:
        return None
    error = ours - gain * theirs
    agree = np.flatnonzero((np.abs(error) < _AGREEMENT_LEVELS).all(axis=0))
    if len(agree) < min_inliers * len(pixel):
        return None
    image *= gain[:, :, None]
    image += np.float32(_DARK_LEVELS) * (gain[:, :, None] - 1)
    return gain, pixel[agree], error.take(agree, 1)


def _offset(pixel: npt.NDArray[np.int64], error: Levels, size: tuple[int, ...], cell: int) -> Levels:
    """(3, h, w) smooth offset of a candidate: the local error near the seam, its mean farther away."""
    h, w = (-(-n // cell) for n in size)
    y, x = np.divmod(pixel, size[1])
    sums = [np.bincount(y // cell * w + x // cell, part, h * w) for part in (*error, np.ones(len(pixel)))]
    around: Any = np.stack(sums, axis=-1).reshape(h, w, 4) / cell**2
    for _ in range(2):
        around = cv2.blur(around, (5, 5), borderType=cv2.BORDER_CONSTANT)
    coarse = (around[..., :3] + _MEAN_WEIGHT * error.mean(axis=1)) / (around[..., 3:] + _MEAN_WEIGHT)
    fine = [cv2.resize(part, (w * cell, h * cell)) for part in np.moveaxis(coarse, -1, 0).astype(np.float32, order="C")]
    return np.stack(fine)[:, : size[0], : size[1]]
