"""Warnings about targets that a sample's cameras cannot show, or show over too little geometry."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import pose_mistake
from arbiview_aug.errors import GeometryWarning, UnreachableError, WarnOnce
from arbiview_aug.render.requirements import harm_remedies

Coverages = Sequence[BoolArray | float]
"""Coverage (h, w) of each target camera, or its share."""

_UNREACHABLE = 0.5  # warn of target cameras of which less than this share is covered
_SUSPICIOUS = 0.3  # a rig of which less is covered may have wrong poses


def check_reach(source: Rig, target: Rig, coverages: Coverages, unseen: str, warn: WarnOnce) -> None:
    """Warn once of target cameras that the sources hardly cover.

    Args:
        source: The source rig.
        target: The target rig.
        coverages: Coverage of the target's cameras.
        unseen: A sentence on what becomes of uncovered pixels.
        warn: Issues the warning.

    Raises:
        UnreachableError: The sources cover none of the target's pixels.
    """
    is_empty = not any(map(np.any, coverages))
    if "unreachable" in warn.topics and not is_empty:  # the means below take milliseconds
        return
    lost = f"the target rig {target.name!r} cannot be reached from this data"
    if is_empty:
        cause = _likely_cause(source, target)
        raise UnreachableError(f"{lost}: expected some pixels to be covered, got none. {cause}")
    shares = [float(np.mean(coverage)) for coverage in coverages]
    poor = [f"{c.name} {share:.0%}" for c, share in zip(target, shares, strict=True) if share < _UNREACHABLE]
    if poor:
        cause = f"{_likely_cause(source, target)}. " if np.mean(shares) < _SUSPICIOUS else ""
        covered = f"covered are {', '.join(poor)}. {cause}{unseen}"
        warn("unreachable", f"{lost}: {covered} Or choose another target", GeometryWarning)


def warn_of_harm(harm: str, source: Rig, target: Rig, warn: WarnOnce) -> None:
    """Warn once that ``auto`` falls back to the static street although cameras move, which harms a detector."""
    message = f"{harm}. Better: {harm_remedies(source, target)}; geometry='street' accepts it"
    warn("static", message, GeometryWarning)


def _likely_cause(source: Rig, target: Rig) -> str:
    """Why a target sees nothing of the sources, and the fix."""
    for whose, rig in (("source", source), ("target", target)):
        if mistake := pose_mistake(rig.cam2ego, rig.ground_z_m):
            return f"The {whose}'s cam2ego seems to be {mistake[0]}: {mistake[1]}"
    return "No source camera looks where the target's do, or masks hide it; python -m arbiview_aug check tests the data"
