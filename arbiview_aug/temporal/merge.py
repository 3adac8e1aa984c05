"""Merge several frames' views of one hole: take the sharpest static one at each pixel, at the view's exposure.

A candidate is accepted by the votes of the others, as far as the labels require (``ChangeRisk``). ``NONE``: half of the
others agree. ``SHADED``: all others agree. ``BESIDE``: the same, and one confirms it. ``UNLABELLED``: the nearest
frames before and after the current one agree with it; where all frames lie on one side, at least three agree, or none
of at most two contradicts; and the current frame shows no newly arrived object beside the hole.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.temporal.change import ChangeRisk

_AGREEMENT_LEVELS = 16.0
"""Largest difference of two frames that agree, in grey levels over 5 x 5 pixels."""

_CONTRADICTION_LEVELS = 24.0
"""The same between a frame and the current one, on a seam (``docs/drives.md``, Constants)."""

_CONTRADICTION_REACH = 1.25
"""A contradiction on the seam reaches to where agreement is nearer by this factor (``docs/drives.md``, Constants)."""

_FEW_CANDIDATES = 2
"""With at most this many candidates, accept one without a confirming vote."""

_MIN_SEAM_PX = 20
"""Fewest common pixels for an exposure."""

_MAX_LOG_GAIN, _MAX_LOG_TINT = 1.3, 0.25
"""Largest logarithm of the gain between two cameras (real rigs: log 3.5), and of its spread over the channels."""

_SEAM_INLIERS, _OVERLAP_INLIERS = 0.5, 0.7
"""Share of pixels that must agree after the gain: more between two neighbours, which may both show passing traffic."""

_DARK_LEVELS = 4.0
"""Offset added to colours before taking their ratio."""

_MEAN_WEIGHT = 0.02
"""Weight of the seam's mean offset beside the local one; far from the seam it stands alone."""


class Candidate(NamedTuple):
    """One neighbour's view of a hole; ``blur`` and ``risk`` as in ``arbiview_aug.temporal.fill.Fill``.

    Attributes:
        image: (3, h, w) of the view's type.
        shows: (h, w) bool.
        blur: (h, w) uint8.
        risk: (h, w) uint8 ``ChangeRisk``.
        later: Whether it was recorded after the current frame.
    """

    image: torch.Tensor
    shows: torch.Tensor
    blur: torch.Tensor
    risk: torch.Tensor
    later: bool


def merged(
    view: torch.Tensor, free: torch.Tensor, seam: torch.Tensor, candidates: Sequence[Candidate], margin_px: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """Fill the free pixels of a view by the sharpest accepted candidate, at the view's exposure.

    Args:
        view: (3, h, w) uint8, or float in [0, 1].
        free: (h, w) bool, True where the view may be filled.
        seam: (h, w) bool, True where view and candidates should agree.
        candidates: The nearest first.
        margin_px: Width of the seam.

    Returns:
        (3, h, w) filled view, and (h, w) int64 index of the candidate taken, -1 for none.
    """
    levels = 1.0 if view.dtype == torch.uint8 else 255.0
    current = levels * view.float()
    toned = _toned(current, free, seam, candidates, levels, margin_px)
    shown = torch.stack([one.shows for one in candidates]) & free
    accepted = shown & _accepted(current, toned, shown, seam, candidates)
    blur = torch.stack([one.blur for one in candidates]).int()
    # The order breaks ties, as argmin may return any of equal values.
    order = torch.arange(len(candidates), device=view.device)[:, None, None]
    rank = torch.where(accepted, blur * len(candidates) + order, 256 * len(candidates))
    chosen = torch.where(accepted.any(0), rank.argmin(0), -1)
    out = current
    for k, image in enumerate(toned):
        out = torch.where(chosen == k, image, out)
    if view.dtype == torch.uint8:
        return torch.round(out).clamp(0, 255).to(torch.uint8), chosen
    return torch.where(chosen >= 0, (out / levels).clamp(0, 1).to(view.dtype), view), chosen


# --- votes ------------------------------------------------------------------------------------------------------------
def _accepted(
    current: torch.Tensor,
    toned: Sequence[torch.Tensor],
    shown: torch.Tensor,
    seam: torch.Tensor,
    candidates: Sequence[Candidate],
) -> torch.Tensor:
    """(n, h, w) whether each candidate shows what stands there now."""
    votes, others = _votes(toned, shown), shown.sum(0) - 1
    risk = torch.stack([one.risk for one in candidates])
    accepted = 2 * votes >= others
    if not bool((risk != ChangeRisk.NONE).any()):
        return accepted
    unanimous = votes == others
    few = len(candidates) <= _FEW_CANDIDATES
    accepted &= (risk < ChangeRisk.SHADED) | unanimous
    accepted &= (risk < ChangeRisk.BESIDE) | (votes >= (0 if few else 1))
    unlabelled = risk == ChangeRisk.UNLABELLED
    if bool(unlabelled.any()):
        one_sided = unanimous & (votes >= (0 if few else 2))
        static = _static(toned, shown, [one.later for one in candidates], one_sided)
        if len(candidates) > 1:  # a single candidate may itself show the moving object
            static &= ~_arrived(current, toned, seam, candidates)
        accepted = torch.where(unlabelled, static, accepted)
    return accepted


def _votes(toned: Sequence[torch.Tensor], shown: torch.Tensor) -> torch.Tensor:
    """(n, h, w) number of other candidates that agree with each."""
    votes = torch.zeros(shown.shape, dtype=torch.int16, device=shown.device)
    for i in range(len(toned)):
        for j in range(i):
            both = shown[i] & shown[j]
            agree = both & (_difference(toned[i], toned[j], both) < _AGREEMENT_LEVELS)
            votes[i] += agree
            votes[j] += agree
    return votes


def _static(
    toned: Sequence[torch.Tensor], shown: torch.Tensor, later: Sequence[bool], one_sided: torch.Tensor
) -> torch.Tensor:
    """(n, h, w) whether the nearest frames before and after the current one agree with each candidate.

    ``one_sided`` (n, h, w) is the answer where all frames lie on one side.
    """
    both_sides, agree = torch.ones_like(shown[0]), torch.ones_like(shown)
    for side in (False, True):
        nearest, known = torch.zeros_like(toned[0]), torch.zeros_like(shown[0])
        for image, there, is_later in zip(toned, shown, later, strict=True):
            if is_later == side:
                nearest, known = torch.where(there & ~known, image, nearest), known | there
        both_sides &= known
        for k, image in enumerate(toned):
            both = shown[k] & known
            agree[k] &= both & (_difference(image, nearest, both) < _AGREEMENT_LEVELS)
    return torch.where(both_sides, agree, one_sided)


def _arrived(
    current: torch.Tensor, toned: Sequence[torch.Tensor], seam: torch.Tensor, candidates: Sequence[Candidate]
) -> torch.Tensor:
    """(h, w) where a hole continues what the current frame alone shows on the seam."""
    known, agree = torch.zeros_like(seam), torch.zeros_like(seam)
    for image, one in zip(toned, candidates, strict=True):
        both = seam & one.shows
        known |= both
        agree |= both & (_difference(image, current, both) < _CONTRADICTION_LEVELS)
    if not bool((known & ~agree).any()):
        return torch.zeros_like(seam)
    arrived = _distance_px(known & ~agree) < _CONTRADICTION_REACH * _distance_px(agree)
    return torch.from_numpy(arrived).to(seam.device)


def _distance_px(places: torch.Tensor) -> np.ndarray:
    """(h, w) float32 distance to the nearest True pixel; beyond the image's size where there is none."""
    empty = (~places).cpu().numpy().view(np.uint8)
    if empty.all():
        return np.full(empty.shape, float(sum(empty.shape)), np.float32)
    return np.asarray(cv2.distanceTransform(empty, cv2.DIST_L2, 5))


def _difference(one: torch.Tensor, two: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """(h, w) mean difference of two images (3, h, w) over the valid pixels of a window, in grey levels."""
    difference = (one - two).detach().abs().mean(0)
    total, count = (_box(part[None], 2) for part in (difference * where, where.float()))
    return (total / count.clamp(min=1e-6))[0]


# --- exposure ---------------------------------------------------------------------------------------------------------
def _toned(
    current: torch.Tensor,
    free: torch.Tensor,
    seam: torch.Tensor,
    candidates: Sequence[Candidate],
    levels: float,
    margin_px: int,
) -> list[torch.Tensor]:
    """Bring the candidates (3, h, w) to the view's exposure, in grey levels.

    Candidates with too little of the seam are matched to those with enough.
    """
    toned = [levels * one.image.float() for one in candidates]
    reference, known = current, seam
    unmatched = []
    for k, one in enumerate(candidates):
        exposure = _exposure(current, toned[k], seam & one.shows, _SEAM_INLIERS)
        if exposure is None:
            unmatched.append(k)
            continue
        gain, inliers = exposure
        toned[k] = gain * (toned[k] + _DARK_LEVELS) - _DARK_LEVELS
        toned[k] = toned[k] + _offset(current - toned[k], inliers, margin_px)
        new = free & one.shows & ~known
        reference, known = torch.where(new, toned[k], reference), known | new
    for k in unmatched:
        shows = free & candidates[k].shows
        exposure = _exposure(reference, toned[k], shows & known, _OVERLAP_INLIERS)
        if exposure is not None:
            toned[k] = exposure[0] * (toned[k] + _DARK_LEVELS) - _DARK_LEVELS
            reference, known = torch.where(shows & ~known, toned[k], reference), known | shows
    return toned


def _exposure(
    reference: torch.Tensor, image: torch.Tensor, where: torch.Tensor, min_inliers: float
) -> tuple[torch.Tensor, torch.Tensor] | None:
    """Gain (3, 1, 1) from an image to a reference and (h, w) where they then agree; None if implausible."""
    count = int(where.sum())
    if count < _MIN_SEAM_PX:
        return None
    pairs = [part.detach()[:, where] + _DARK_LEVELS for part in (reference, image)]
    # Sorting gives the lower median; CUDA's own median is not deterministic.
    logs = torch.log(pairs[0] / pairs[1]).sort(1).values[:, (count - 1) // 2]
    if float(logs.mean().abs()) > _MAX_LOG_GAIN or float(logs.max() - logs.min()) > _MAX_LOG_TINT:
        return None
    gain = logs.exp()[:, None, None]
    error = (reference - gain * (image + _DARK_LEVELS) + _DARK_LEVELS).detach().abs().amax(0)
    inliers = where & (error < _AGREEMENT_LEVELS)
    return (gain, inliers) if int(inliers.sum()) >= min_inliers * count else None


def _offset(difference: torch.Tensor, inliers: torch.Tensor, margin: int) -> torch.Tensor:
    """(3, h, w) smooth offset of a candidate: the local difference near the seam, its mean farther away."""
    known = torch.cat([difference * inliers, inliers[None].to(difference)])
    mean = known[:3].sum((1, 2), keepdim=True) / known[3:].sum().clamp(min=1)
    cell, (h, w) = max(1, margin // 2), inliers.shape
    cells = torch.nn.functional.avg_pool2d(known[None], cell, ceil_mode=True)[0]
    around = _box(_box(cells, 2), 2)
    coarse = (around[:3] + _MEAN_WEIGHT * mean) / (around[3:] + _MEAN_WEIGHT)
    size = [cell * n for n in coarse.shape[1:]]
    fine = torch.nn.functional.interpolate(coarse[None], size=size, mode="bilinear", align_corners=False)
    return fine[0, :, :h, :w]


def _box(image: torch.Tensor, radius: int) -> torch.Tensor:
    """Means (C, h, w) over squares; zeros around the image."""
    side = 2 * radius + 1
    across = torch.nn.functional.avg_pool2d(image[None], (1, side), 1, (0, radius))
    return torch.nn.functional.avg_pool2d(across, (side, 1), 1, (radius, 0))[0]
