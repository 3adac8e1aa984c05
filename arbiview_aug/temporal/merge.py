"""What several frames show of one hole, merged: at the view's exposure, the sharpest of what stood still.

Where labels say that nothing moved, a frame is believed unless most others contradict it; where the shadow of what
moved may fall, unless any other does; right beside it, if another confirms it. Where nobody says what moved, two rules
tell what stood still. What the nearest frames before and after the current one both show has not moved in between; seen
from one side only, at least three frames must agree; where there are no more than two frames, one is believed that the
other does not contradict. And what the current frame shows next to the hole goes on into it: where all others show the
road there and it does not, something has come.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.temporal.change import ChangeRisk

_AGREEMENT_LEVELS = 16.0
"""Two frames that differ by more, over 5 by 5 pixels, show different things."""

_CONTRADICTION_LEVELS = 24.0
"""So does a frame that differs by more from the current one, on a seam. Without labels, 8 frames, 16 synthetic streets:
at 16 a tenth less of the road is filled, with a quarter to half fewer ghosts; at 32 there are half as many more."""

_REACH_OF_CONTRADICTION = 1.25
"""What hides the seam may be wider farther in: it reaches up to where what agrees is nearer by this factor. At 1 ghosts
are three times as many and the filled share a quarter larger; at 1.5 two fifths fewer, and a tenth smaller."""

_FEW = 2
"""Of no more frames each is believed alone, where nobody contradicts it: there are no more to ask."""

_LEAST_SEAM_PX = 20
"""Fewer pixels in common say nothing of the exposure."""

_MOST_EXPOSURE, _MOST_TINT = 1.3, 0.25
"""Logarithms of the gain between two cameras, of which the real rigs at hand need up to 3.5, and of its spread over the
channels: what asks for more is another object."""

_ALIKE_SEAM, _ALIKE_OVERLAP = 0.5, 0.7
"""Share of the pixels that a gain must make alike: in an overlap of two other frames both may show what passes by, and
at 0.5 ghosts without labels are a tenth to a half more."""

_DARK_LEVELS = 4.0
"""Added to colours whose ratio is taken."""

_FAR_WEIGHT = 0.02
"""Share of the seam's mean in the offset next to it: far from the seam it is all there is."""


class Candidate(NamedTuple):
    """What a neighbour shows of a hole.

    Attributes:
        image: (3, h, w) of the view's type.
        shows: (h, w) bool.
        blur: (h, w) uint8, see ``fills.Fill``.
        doubt: (h, w) uint8 ``ChangeRisk``.
        later: Whether it was recorded after the current frame.
    """

    image: torch.Tensor
    shows: torch.Tensor
    blur: torch.Tensor
    doubt: torch.Tensor
    later: bool


def merged(
    view: torch.Tensor, free: torch.Tensor, seam: torch.Tensor, candidates: Sequence[Candidate], margin_px: int
) -> tuple[torch.Tensor, torch.Tensor]:
    """One view (3, h, w) with what is free taken from the sharpest candidate that is believed.

    Candidates are brought to the view's exposure: by the difference at the seam beside it, by its mean farther in.

    Args:
        view: uint8, or float in [0, 1].
        free: (h, w) bool, what may be filled.
        seam: (h, w) bool, where view and candidates should look alike.
        candidates: The nearest first.
        margin_px: How wide the seam is.

    Returns:
        The view, and (h, w) int64 which candidate was taken, -1 for none.
    """
    levels = 1.0 if view.dtype == torch.uint8 else 255.0
    current = levels * view.float()
    toned = _toned(current, free, seam, candidates, levels, margin_px)
    shown = torch.stack([one.shows for one in candidates]) & free
    believed = shown & _believed(current, toned, shown, seam, candidates)
    blur = torch.stack([one.blur for one in candidates]).int()
    # Of equals argmin may give any: the order decides.
    order = torch.arange(len(candidates), device=view.device)[:, None, None]
    rank = torch.where(believed, blur * len(candidates) + order, 256 * len(candidates))
    chosen = torch.where(believed.any(0), rank.argmin(0), -1)
    out = current
    for k, image in enumerate(toned):
        out = torch.where(chosen == k, image, out)
    if view.dtype == torch.uint8:
        return torch.round(out).clamp(0, 255).to(torch.uint8), chosen
    return torch.where(chosen >= 0, (out / levels).clamp(0, 1).to(view.dtype), view), chosen


# --- what is believed -------------------------------------------------------------------------------------------------
def _believed(
    current: torch.Tensor,
    toned: Sequence[torch.Tensor],
    shown: torch.Tensor,
    seam: torch.Tensor,
    candidates: Sequence[Candidate],
) -> torch.Tensor:
    """Which pixels of each candidate (n, h, w) show what stands there still."""
    votes, others = _votes(toned, shown), shown.sum(0) - 1
    doubt = torch.stack([one.doubt for one in candidates])
    # Half of the others at least: two cars of one colour may pass the same place.
    believed = 2 * votes >= others
    if not bool((doubt != ChangeRisk.NONE).any()):
        return believed
    unanimous = votes == others
    few = len(candidates) <= _FEW
    believed &= (doubt < ChangeRisk.SHADED) | unanimous
    believed &= (doubt < ChangeRisk.BESIDE) | (votes >= (0 if few else 1))
    nobody_says = doubt == ChangeRisk.UNLABELLED
    if bool(nobody_says.any()):
        stood = _stood_still(toned, shown, [one.later for one in candidates], unanimous & (votes >= (0 if few else 2)))
        if len(candidates) > 1:  # a single one may itself be what is wrong
            stood &= ~_has_come(current, toned, seam, candidates)
        believed = torch.where(nobody_says, stood, believed)
    return believed


def _votes(toned: Sequence[torch.Tensor], shown: torch.Tensor) -> torch.Tensor:
    """For each candidate (n, h, w) how many others show the same there."""
    votes = torch.zeros(shown.shape, dtype=torch.int16, device=shown.device)
    for i in range(len(toned)):
        for j in range(i):
            both = shown[i] & shown[j]
            agree = both & (_apart(toned[i], toned[j], both) < _AGREEMENT_LEVELS)
            votes[i] += agree
            votes[j] += agree
    return votes


def _stood_still(
    toned: Sequence[torch.Tensor], shown: torch.Tensor, later: Sequence[bool], otherwise: torch.Tensor
) -> torch.Tensor:
    """What of each candidate (n, h, w) the nearest frames before and after the current one show as well.

    ``otherwise`` (n, h, w) says it where all frames lie on one side.
    """
    on_both_sides, alike = torch.ones_like(shown[0]), torch.ones_like(shown)
    for side in (False, True):
        nearest, known = torch.zeros_like(toned[0]), torch.zeros_like(shown[0])
        for image, there, is_later in zip(toned, shown, later, strict=True):
            if is_later == side:
                nearest, known = torch.where(there & ~known, image, nearest), known | there
        on_both_sides &= known
        for k, image in enumerate(toned):
            both = shown[k] & known
            alike[k] &= both & (_apart(image, nearest, both) < _AGREEMENT_LEVELS)
    return torch.where(on_both_sides, alike, otherwise)


def _has_come(
    current: torch.Tensor, toned: Sequence[torch.Tensor], seam: torch.Tensor, candidates: Sequence[Candidate]
) -> torch.Tensor:
    """Where (h, w) a hole goes on what the current frame alone shows on the seam."""
    known, alike = torch.zeros_like(seam), torch.zeros_like(seam)
    for image, one in zip(toned, candidates, strict=True):
        both = seam & one.shows
        known |= both
        alike |= both & (_apart(image, current, both) < _CONTRADICTION_LEVELS)
    if not bool((known & ~alike).any()):
        return torch.zeros_like(seam)
    far = _REACH_OF_CONTRADICTION * _distance_px(alike)
    return torch.from_numpy(_distance_px(known & ~alike) < far).to(seam.device)


def _distance_px(places: torch.Tensor) -> np.ndarray:
    """(h, w) float32 how far each pixel is from the nearest of these; farther than any where there are none."""
    empty = (~places).cpu().numpy().view(np.uint8)
    if empty.all():
        return np.full(empty.shape, float(sum(empty.shape)), np.float32)
    return np.asarray(cv2.distanceTransform(empty, cv2.DIST_L2, 5))


def _apart(one: torch.Tensor, two: torch.Tensor, where: torch.Tensor) -> torch.Tensor:
    """By how many grey levels (h, w) two images (3, h, w) differ around each pixel, of what counts."""
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
    """The candidates (3, h, w) in grey levels, at the view's exposure.

    Those that have too little of the seam in common with it follow those that have.
    """
    toned = [levels * one.image.float() for one in candidates]
    reference, known = current, seam
    unsure = []
    for k, one in enumerate(candidates):
        found = _exposure(current, toned[k], seam & one.shows, _ALIKE_SEAM)
        if found is None:
            unsure.append(k)
            continue
        gain, alike = found
        toned[k] = gain * (toned[k] + _DARK_LEVELS) - _DARK_LEVELS
        toned[k] = toned[k] + _offset(current - toned[k], alike, margin_px)
        new = free & one.shows & ~known
        reference, known = torch.where(new, toned[k], reference), known | new
    for k in unsure:
        shows = free & candidates[k].shows
        found = _exposure(reference, toned[k], shows & known, _ALIKE_OVERLAP)
        if found is not None:
            toned[k] = found[0] * (toned[k] + _DARK_LEVELS) - _DARK_LEVELS
            reference, known = torch.where(shows & ~known, toned[k], reference), known | shows
    return toned


def _exposure(
    reference: torch.Tensor, image: torch.Tensor, where: torch.Tensor, least_alike: float
) -> tuple[torch.Tensor, torch.Tensor] | None:
    """The gain (3, 1, 1) that brings an image to a reference, and where (h, w) they are alike then; None without."""
    count = int(where.sum())
    if count < _LEAST_SEAM_PX:
        return None
    pairs = [part.detach()[:, where] + _DARK_LEVELS for part in (reference, image)]
    # The lower median by sorting: that of CUDA refuses deterministic algorithms.
    logs = torch.log(pairs[0] / pairs[1]).sort(1).values[:, (count - 1) // 2]
    if float(logs.mean().abs()) > _MOST_EXPOSURE or float(logs.max() - logs.min()) > _MOST_TINT:
        return None
    gain = logs.exp()[:, None, None]
    off = (reference - gain * (image + _DARK_LEVELS) + _DARK_LEVELS).detach().abs().amax(0)
    alike = where & (off < _AGREEMENT_LEVELS)
    return (gain, alike) if int(alike.sum()) >= least_alike * count else None


def _offset(difference: torch.Tensor, alike: torch.Tensor, margin: int) -> torch.Tensor:
    """What to add to a candidate (3, h, w): near the seam the difference there, farther away its mean.

    It is smooth: found on cells of half a margin, read between them.
    """
    known = torch.cat([difference * alike, alike[None].to(difference)])
    mean = known[:3].sum((1, 2), keepdim=True) / known[3:].sum().clamp(min=1)
    cell, size = max(1, margin // 2), alike.shape
    cells = torch.nn.functional.avg_pool2d(known[None], cell, ceil_mode=True)[0]
    around = _box(_box(cells, 2), 2)
    coarse = (around[:3] + _FAR_WEIGHT * mean) / (around[3:] + _FAR_WEIGHT)
    whole = torch.nn.functional.interpolate(
        coarse[None], size=[cell * n for n in coarse.shape[1:]], mode="bilinear", align_corners=False
    )
    return whole[0, :, : size[0], : size[1]]


def _box(image: torch.Tensor, radius: int) -> torch.Tensor:
    """Means (C, h, w) over squares; zeros around the image."""
    side = 2 * radius + 1
    across = torch.nn.functional.avg_pool2d(image[None], (1, side), 1, (0, radius))
    return torch.nn.functional.avg_pool2d(across, (side, 1), 1, (radius, 0))[0]
