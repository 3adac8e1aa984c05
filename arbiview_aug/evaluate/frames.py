"""Frames to evaluate on: the sample that a method gets, and the references that score its views.

References are true views (synthetic streets), or LiDAR points in the source cameras' colours, as recorded and with even
exposures. If a method may read points, all methods get those of alternate azimuth sectors (``lidar.lidar_split``) and
are scored on the others.
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

Render = Callable[[Mapping[str, Any], Rig], list[RenderedView]]  # a view for each of the target rig

Exposure = Literal["raw", "even"]
EXPOSURES: tuple[Exposure, ...] = ("raw", "even")  # exposures as recorded, and made even
_CACHED_TRUTHS = 8  # one for each target would take a gigabyte


class LidarReference(NamedTuple):
    """A sample at one exposure, and the scoring points in its colours."""

    sample: dict[str, Any]
    points: ColouredPoints


class Photographs(NamedTuple):
    """Images that the cameras of a rig took, as truth."""

    rig: Rig  # in the frame's ego frame, without masks
    images: torch.Tensor | Sequence[torch.Tensor]
    valid: Sequence[BoolArray]  # (h, w) pixels that score, by camera

    def of_rig(self, _: Rig) -> Photographs:
        """``ScoredFrame.truth`` of their own rig."""
        return self


@dataclass(frozen=True)
class ScoredFrame:
    sample: dict[str, Any]  # ``rig``, ``images`` and other keys that methods may use
    lidar: Mapping[Exposure, LidarReference] = field(default_factory=dict)  # by exposure; empty without points
    held_out: bool = False  # whether ``sample`` has points, and others score
    truth: Callable[[Rig], RenderedViews | Photographs] | None = None  # the true views of a rig; None if unknown
    target: Rig | None = None  # the rig that alone has a truth, that of photographs; None for any rig

    @property
    def scored_sample(self) -> dict[str, Any]:
        """Sample that methods get for scoring, with even exposures if points score at those."""
        return self.lidar["even"].sample if "even" in self.lidar else self.sample


def make_frame(
    sample: Mapping[str, Any],
    *,
    truth: Callable[[Rig], RenderedViews] | None = None,
    exposures: Sequence[Exposure] = EXPOSURES,
    hand_over_points: bool = False,
) -> ScoredFrame:
    """Split a sample into the part that methods get and the references.

    ``truth`` renders the true views of a rig; the last ones are cached. Without ``exposures`` points do not score. With
    ``hand_over_points`` methods get the points of the sectors that do not score.
    """
    truth = None if truth is None else lru_cache(_CACHED_TRUTHS)(truth)
    inputs = {key: value for key, value in sample.items() if key != "points"}
    if "points" not in sample or not exposures:
        return ScoredFrame(dict(sample) if hand_over_points else inputs, truth=truth)
    rig, images = sample["rig"], as_arrays(sample["images"])
    cloud = sample["points"].numpy().astype(np.float64)
    if hand_over_points:
        inputs["points"] = sample["points"][torch.from_numpy(lidar_split(cloud)[0])]
    lidar: dict[Exposure, LidarReference] = {}
    for exposure in exposures:
        exposed: list[Image] = list(equalised(rig, images, cloud)) if exposure == "even" else images
        points = coloured_points(rig, exposed, cloud)
        if hand_over_points:
            points = points.subset(lidar_split(points.points)[1])
        lidar[exposure] = LidarReference({**inputs, "images": as_tensors(exposed)}, points)
    return ScoredFrame(inputs, lidar, hand_over_points, truth)


def scores(
    frame: ScoredFrame, render: Render, target: Rig, exposures: Sequence[Exposure] = EXPOSURES
) -> tuple[list[RenderedView], list[dict[str, float]]]:
    """Render a frame for a rig in its own ego frame, and score each view at the exposures that the frame has.

    Returns:
        The views at the first exposure, and one row of metrics each: ``seen``, the share of covered pixels;
        ``true_...`` if the truth is known (``truth_metrics`` with the classes ground, object and sky); ``raw_...`` and
        ``even_...`` if there are points (``sparse_metrics``).
    """
    mounted = target.in_frame_of(frame.sample["rig"])
    references = [(exposure, frame.lidar[exposure]) for exposure in exposures if exposure in frame.lidar]
    views = render(references[0][1].sample if references else frame.sample, target)
    rows = [{"seen": float(view.coverage.mean())} for view in views]
    if frame.truth is not None:
        truth = frame.truth(target)
        for k, (row, view, true) in enumerate(zip(rows, views, as_arrays(truth.images), strict=True)):
            if isinstance(truth, Photographs):
                valid, parts = truth.valid[k], None
            else:
                classes = truth.classes[k].numpy()
                valid, parts = classes != SceneClass.VOID, regions(classes)
            metrics_of_view = truth_metrics(view.image, true, coverage=view.coverage, classes=parts, valid=valid)
            row |= {f"true_{name}": value for name, value in metrics_of_view.items()}
    for k, (exposure, reference) in enumerate(references):
        rendered = views if k == 0 else render(reference.sample, target)
        for row, camera, view in zip(rows, mounted, rendered, strict=True):
            metrics_of_view = sparse_metrics(view.image, camera, reference.points, coverage=view.coverage) or {}
            row |= {f"{exposure}_{name}": value for name, value in metrics_of_view.items()}
    return views, rows


def regions(classes: npt.NDArray[np.uint8]) -> dict[str, BoolArray]:
    """Ground, object and sky of a synthetic view (h, w)."""
    ground, sky = np.isin(classes, [int(c) for c in GROUND_CLASSES]), classes == SceneClass.SKY
    return {"ground": ground, "sky": sky, "object": ~ground & ~sky & (classes != SceneClass.VOID)}
