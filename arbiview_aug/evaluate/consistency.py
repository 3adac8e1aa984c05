"""Agreement without any reference: of neighbouring source cameras, and of neighbouring rendered views."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from arbiview_aug.camera import BoolArray, Camera
from arbiview_aug.evaluate.images import Image, View, as_arrays, as_tensors
from arbiview_aug.evaluate.methods import Method
from arbiview_aug.evaluate.overlap import OverlapScore, overlap_scores
from arbiview_aug.favs.synthesis import render_opencv
from arbiview_aug.overlaps import VIEW_SIZE
from arbiview_aug.plan import build_plan
from arbiview_aug.rig import Rig


def source_overlap(
    sample: Mapping[str, Any], method: Method, *, size: tuple[int, int] = VIEW_SIZE
) -> list[OverlapScore]:
    """Overlap metrics of a method: neighbouring source cameras, each alone rendered to their half-way view.

    Args:
        sample: With ``rig`` and ``images``.
        method: The method; what it knows of the scene from all cameras it keeps (``Method.alone``).
        size: (h, w) of the half-way views.
    """
    rig: Rig = sample["rig"]

    def from_one(view: Camera, k: int) -> tuple[Image, BoolArray]:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of views that one camera cannot cover: it need not
            alone = method.alone(sample, k, rig.with_cameras([view]))
        return alone.image, alone.coverage

    return overlap_scores(rig, from_one, size=size)


def target_consistency(rig: Rig, views: Sequence[View], *, size: tuple[int, int] = VIEW_SIZE) -> list[OverlapScore]:
    """Do neighbouring rendered views show the same scene? Overlap metrics of the rendered views themselves.

    Each view, where it shows anything, is resampled to the half-way view over the street surface. Views rendered over
    that same surface agree even where it is wrong, and views that are right about objects disagree there: compare
    methods of one surface. On nuScenes' frame 1 m higher, where LiDAR is 10 dB nearer to the points than the street,
    its views score 10 dB lower here.

    Args:
        rig: The target rig, on its own road.
        views: One for each of its cameras.
        size: (h, w) of the half-way views.
    """

    def from_one(view: Camera, k: int) -> tuple[Image, BoolArray]:
        seen = views[k].shown
        if not seen.any():
            return np.zeros((*view.size, 3), np.uint8), np.zeros(view.size, bool)
        plan = build_plan(rig.with_cameras([replace(rig[k], mask=seen)]), rig.with_cameras([view]), surface="street")
        (image,) = as_arrays(render_opencv(plan, as_tensors([views[k].image])))
        return image, plan.coverage[0]

    return overlap_scores(rig, from_one, size=size)


def summary(prefix: str, pairs: Sequence[OverlapScore]) -> dict[str, float]:
    """Mean over the pairs, and the worst pair's fitted figure, as ``<prefix>_...``; pairs without a score are left out.

    A rig without overlaps has an empty summary.
    """
    row: dict[str, float] = {}
    for kind in ("raw", "fitted"):
        found = [value for pair in pairs if (value := getattr(pair, f"{kind}_psnr_db")) is not None]
        if found:
            row[f"{prefix}_{kind}_psnr_db"] = float(np.mean(found))
            row[f"{prefix}_worst_{kind}_psnr_db"] = min(found)
    return row
