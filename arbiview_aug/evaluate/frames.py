"""A frame to evaluate on: the sample that a method gets, and what its views are compared with.

Three references: true views of any rig (synthetic streets), LiDAR points with the colours that the source cameras saw,
and the same with the cameras' exposures made even first, since exposure is not geometry.

A method that reads the LiDAR must not be scored on the points that it read. So where a method may read them, every
method gets the points of alternate azimuth sectors (``sparse.lidar_split``) and all are scored on the others.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import GROUND_CLASSES, RenderedViews, SceneClass
from arbiview_aug.evaluate.images import Image, RenderedView, as_arrays, as_tensors
from arbiview_aug.evaluate.lidar import ColouredPoints, coloured_points, equalised, lidar_split, sparse_metrics
from arbiview_aug.evaluate.metrics import truth_metrics

Render = Callable[[Mapping[str, Any], Rig], list[RenderedView]]
"""Sample and target rig in, one view for each target camera out."""


Exposure = Literal["raw", "even"]
EXPOSURES: tuple[Exposure, ...] = ("raw", "even")
"""The cameras' exposures as recorded, and made even."""


_HELD_TRUTHS = 8  # one for each target would be a gigabyte of six full-size rigs


class LidarReference(NamedTuple):
    """A sample at one exposure, and the points with its colours that score."""

    sample: dict[str, Any]
    points: ColouredPoints


@dataclass(frozen=True)
class ScoredFrame:
    """What a method gets, and what scores it.

    Attributes:
        sample: For the methods: ``rig``, ``images`` and what else they may use.
        lidar: References by exposure; empty without points.
        held_out: Whether ``sample`` holds points, and others score.
        truth: The true views of a rig; None where nobody knows them.
    """

    sample: dict[str, Any]
    lidar: Mapping[Exposure, LidarReference] = field(default_factory=dict)
    held_out: bool = False
    truth: Callable[[Rig], RenderedViews] | None = None

    @property
    def scored_sample(self) -> dict[str, Any]:
        """What methods get where views are scored: with exposures made even, where points score so."""
        return self.lidar["even"].sample if "even" in self.lidar else self.sample


def make_frame(
    sample: Mapping[str, Any],
    *,
    truth: Callable[[Rig], RenderedViews] | None = None,
    exposures: Sequence[Exposure] = EXPOSURES,
    hand_over_points: bool = False,
) -> ScoredFrame:
    """Split a sample into what methods get and what scores them.

    Args:
        sample: With ``rig`` and ``images``; ``points`` in the ego frame where there are any.
        truth: The true views of a rig; those of the last rigs are kept.
        exposures: To score on points at; none for not at all.
        hand_over_points: Whether methods may use points: those of the sectors that do not score, or all where points
            do not score. Otherwise methods get none.
    """
    truth = None if truth is None else lru_cache(_HELD_TRUTHS)(truth)
    given = {key: value for key, value in sample.items() if key != "points"}
    if "points" not in sample:
        return ScoredFrame(given, truth=truth)
    if not exposures:
        return ScoredFrame({**given, "points": sample["points"]} if hand_over_points else given, truth=truth)
    rig, images = sample["rig"], as_arrays(sample["images"])
    cloud = sample["points"].numpy().astype(np.float64)
    if hand_over_points:
        given["points"] = sample["points"][torch.from_numpy(lidar_split(cloud)[0])]
    lidar: dict[Exposure, LidarReference] = {}
    for exposure in exposures:
        exposed: list[Image] = list(equalised(rig, images, cloud)) if exposure == "even" else images
        points = coloured_points(rig, exposed, cloud)
        if hand_over_points:
            points = points.subset(lidar_split(points.points)[1])
        lidar[exposure] = LidarReference({**given, "images": as_tensors(exposed)}, points)
    return ScoredFrame(given, lidar, hand_over_points, truth)


def scores(
    frame: ScoredFrame, render: Render, target: Rig, exposures: Sequence[Exposure] = EXPOSURES
) -> tuple[list[RenderedView], list[dict[str, float]]]:
    """A method's views of a frame, and their metrics: one row for each target camera.

    Args:
        frame: The frame.
        render: The method.
        target: The rig to render, in its own ego frame.
        exposures: Those of the frame's to score at.

    Returns:
        The views of the first exposure, and for each a row with ``seen``, the share of its pixels that some source
        saw; where truth is known ``true_...`` (see ``truth_metrics``, with the classes ground, object and sky); where
        there are points ``raw_...`` and ``even_...`` (see ``SparseScore.as_dict``).
    """
    mounted = target.in_frame_of(frame.sample["rig"])
    references = [(exposure, frame.lidar[exposure]) for exposure in exposures if exposure in frame.lidar]
    views = render(references[0][1].sample if references else frame.sample, target)
    rows = [{"seen": float(view.coverage.mean())} for view in views]
    if frame.truth is not None:
        _add_truth(rows, views, frame.truth(target))
    for k, (exposure, reference) in enumerate(references):
        rendered = views if k == 0 else render(reference.sample, target)
        _add_sparse(rows, rendered, mounted, reference.points, exposure)
    return views, rows


def regions(classes: npt.NDArray[np.uint8]) -> dict[str, BoolArray]:
    """Ground, object and sky of a synthetic view (h, w)."""
    ground, sky = np.isin(classes, [int(c) for c in GROUND_CLASSES]), classes == SceneClass.SKY
    return {"ground": ground, "sky": sky, "object": ~ground & ~sky & (classes != SceneClass.VOID)}


def _add_truth(rows: list[dict[str, float]], views: list[RenderedView], truth: RenderedViews) -> None:
    images, classes = as_arrays(truth.images), [of.numpy() for of in truth.classes]
    for row, view, true, of in zip(rows, views, images, classes, strict=True):
        found = truth_metrics(
            view.image, true, coverage=view.coverage, classes=regions(of), valid=of != SceneClass.VOID
        )
        row |= {f"true_{name}": value for name, value in found.items()}


def _add_sparse(
    rows: list[dict[str, float]], views: list[RenderedView], mounted: Rig, points: ColouredPoints, prefix: str
) -> None:
    for row, camera, view in zip(rows, mounted, views, strict=True):
        score = sparse_metrics(view.image, camera, points, coverage=view.coverage)
        if score is not None:
            row |= {f"{prefix}_{name}": value for name, value in score.as_dict().items()}
