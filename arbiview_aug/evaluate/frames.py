"""Evaluation of methods on frames: the sample that a method gets, and the references that score its views.

References are true views (synthetic streets), or LiDAR points in the source cameras' colours, as recorded and with even
exposures. If a method may read points, all methods get those of alternate azimuth sectors (``lidar.lidar_split``) and
are scored on the others.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import GROUND_CLASSES, RenderedViews, SceneClass
from arbiview_aug.errors import CalibrationError, SampleError
from arbiview_aug.evaluate.agreement import OverlapScore, source_overlap, summary, target_consistency
from arbiview_aug.evaluate.images import Image, RenderedView, as_arrays, as_tensors
from arbiview_aug.evaluate.lidar import ColouredPoints, coloured_points, equalised, lidar_split, sparse_metrics
from arbiview_aug.evaluate.methods import Method
from arbiview_aug.evaluate.metrics import mean_of, truth_metrics
from arbiview_aug.sample.boxes_2d import rig_of

Render = Callable[[Mapping[str, Any], Rig], list[RenderedView]]  # a view for each of the target rig

Look = Callable[[str, "ScoredFrame", str, str, Rig, Sequence[RenderedView]], None]
"""Look at a named frame's views: by a method, for a target, whose rig comes with it."""

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

    def true_images(self, target: Rig) -> list[Image] | None:
        """The true views (h, w, 3) of a rig, if the truth is known."""
        return None if self.truth is None else as_arrays(self.truth(target).images)


def make_frame(
    sample: Mapping[str, Any],
    *,
    truth: Callable[[Rig], RenderedViews] | None = None,
    exposures: Sequence[Exposure] = EXPOSURES,
    hand_over_points: bool = False,
) -> ScoredFrame:
    """Split a sample into the part that methods get and the references.

    ``truth`` renders the true views of a rig; the last ones are cached. Without ``exposures`` points do not score. With
    ``hand_over_points`` methods get the points of the sectors that do not score, and none of neighbours.
    """
    truth = None if truth is None else lru_cache(_CACHED_TRUTHS)(truth)
    inputs = {key: value for key, value in sample.items() if key != "points"}
    points_3d = sample.get("points")
    if points_3d is None or not exposures:
        return ScoredFrame(dict(sample) if hand_over_points else inputs, truth=truth)
    rig, images = rig_of(sample), as_arrays(sample["images"])  # masked: made-up pixels colour no points
    cloud = points_3d.numpy().astype(np.float64)
    if inputs.get("neighbours"):  # their points lie in the sectors that score, too; their images stay unread
        inputs["neighbours"] = [ChainMap({"points": None}, frame) for frame in inputs["neighbours"]]
    if hand_over_points:
        inputs["points"] = points_3d[torch.from_numpy(lidar_split(cloud)[0])]
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
        shown = zip(rows, views, as_arrays(truth.images), valid_pixels(truth), strict=True)
        for k, (row, view, true, valid) in enumerate(shown):
            classes = None if isinstance(truth, Photographs) else regions(truth.classes[k].numpy())
            metrics_of_view = truth_metrics(view.image, true, coverage=view.coverage, classes=classes, valid=valid)
            row |= {f"true_{name}": value for name, value in metrics_of_view.items()}
    for k, (exposure, reference) in enumerate(references):
        rendered = views if k == 0 else render(reference.sample, target)
        for row, camera, view in zip(rows, mounted, rendered, strict=True):
            metrics_of_view = sparse_metrics(view.image, camera, reference.points, coverage=view.coverage) or {}
            row |= {f"{exposure}_{name}": value for name, value in metrics_of_view.items()}
    return views, rows


def valid_pixels(truth: RenderedViews | Photographs) -> list[BoolArray]:
    """Pixels (h, w) of each true image that score: those that the lens sees, and what photographs do not mask."""
    if isinstance(truth, Photographs):
        return list(truth.valid)
    return [classes.numpy() != SceneClass.VOID for classes in truth.classes]


def regions(classes: npt.NDArray[np.uint8]) -> dict[str, BoolArray]:
    """Ground, object and sky of a synthetic view (h, w)."""
    ground, sky = np.isin(classes, [int(c) for c in GROUND_CLASSES]), classes == SceneClass.SKY
    return {"ground": ground, "sky": sky, "object": ~ground & ~sky & (classes != SceneClass.VOID)}


# --- evaluation of methods --------------------------------------------------------------------------------------------
PHOTOGRAPHS = "photographs"
"""Name of the target whose photographs are the truth."""


@dataclass
class Evaluation:
    """Measurements as plain data, and the views of the first frame.

    ``views`` has a row for each frame, target, camera and method: metrics beside those four names. ``pairs`` has one
    for each frame, method and pair of neighbours: ``kind`` is ``overlap`` (two sources) or ``consistency`` (two views).
    """

    views: list[dict[str, Any]] = field(default_factory=list)
    pairs: list[dict[str, Any]] = field(default_factory=list)
    pictures: dict[tuple[str, str], list[RenderedView]] = field(default_factory=dict)  # of ``first``, by target, method
    targets: dict[str, Rig] = field(default_factory=dict)  # of the first frame, by name
    first: ScoredFrame | None = None
    declined: dict[str, str] = field(default_factory=dict)  # why a method could not render

    def means(self, method: str, target: str | None = None) -> dict[str, float]:
        """Mean the per-image values over cameras and frames; over all targets by default."""
        return mean_of(row for row in self.views if row["method"] == method and target in (None, row["target"]))

    def spread(self, method: str, metric: str) -> float:
        """Standard deviation over the frames of a metric's mean."""
        frames: dict[str, list[float]] = {}
        for row in self.views:
            if row["method"] == method and metric in row:
                frames.setdefault(row["frame"], []).append(row[metric])
        return float(np.std([np.mean(values) for values in frames.values()])) if frames else 0.0

    def agreement(self, method: str) -> dict[str, float]:
        """Summarize the pairs of sources (``overlap_...``) and of rendered views (``consistency_...``)."""
        row: dict[str, float] = {}
        for kind in ("overlap", "consistency"):
            pairs = [p for p in self.pairs if p["method"] == method and p["kind"] == kind]
            row |= summary(kind, [OverlapScore._make(map(pair.get, OverlapScore._fields)) for pair in pairs])
        return row


def evaluate(
    frames: Iterable[tuple[str, ScoredFrame]],
    targets: Callable[[Rig], Mapping[str, Rig]],
    methods: Sequence[Method],
    tick: Callable[[str, int], None] = lambda _, __: None,
    *,
    agreement: bool = True,
    look: Look | None = None,
) -> Evaluation:
    """Run every method on every named frame and target.

    ``targets`` maps a source rig to the rigs to render, by name, unless a frame has a ``target`` of its own. ``tick``
    is called before each step with its name and the frame's number of steps. ``agreement`` measures that of neighbours
    too. ``look`` sees all views.
    """
    done = Evaluation()
    for name, frame in frames:
        rigs = dict(targets(frame.sample["rig"])) if frame.target is None else {PHOTOGRAPHS: frame.target}
        if done.first is None:
            done.first, done.targets = frame, rigs
        steps = len(methods) * (agreement + len(rigs))
        for method in methods:
            row = {"frame": name, "method": method.name}
            try:
                if agreement:
                    tick(f"{name}: {method.name}, overlap", steps)
                    pairs = source_overlap(frame.sample, method)
                    done.pairs += [{**row, "kind": "overlap", **pair._asdict()} for pair in pairs]
                for target, rig in rigs.items():
                    tick(f"{name}: {method.name}, {target}", steps)
                    views, metrics = scores(frame, method.render, rig)
                    if frame is done.first:
                        done.pictures[target, method.name] = views
                    if look is not None:
                        look(name, frame, method.name, target, rig, views)
                    row["target"] = target
                    done.views += [{**row, "camera": c.name, **m} for c, m in zip(rig, metrics, strict=True)]
                    pairs = target_consistency(rig, views) if agreement else []
                    done.pairs += [{**row, "kind": "consistency", **pair._asdict()} for pair in pairs]
            except (CalibrationError, SampleError) as error:  # lenses, for a method of pinhole cameras
                done.declined[method.name] = f"frame {name}: {error}"
    return done
