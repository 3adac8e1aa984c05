"""Evaluation of methods on frames: renderers, the samples that they get, and the references that score their views.

References are true images (of synthetic streets, or photographs), or LiDAR points in the source cameras' colours, as
recorded and with even exposures. If a method may read points, all methods get those of alternate azimuth sectors
(``lidar.lidar_split``) and are scored on the others.
"""

from __future__ import annotations

from collections import ChainMap
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, Literal, NamedTuple

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName, Holes, Quality
from arbiview_aug.datasets.synthetic import GROUND_CLASSES, RenderedViews, SceneClass
from arbiview_aug.errors import CalibrationError, DataError, SampleError
from arbiview_aug.evaluate.lidar import ColouredPoints, coloured_points, equalised, lidar_split, sparse_metrics
from arbiview_aug.evaluate.metrics import Image, RenderedView, as_arrays, as_tensors, mean_of, truth_metrics
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.inpaint.inpainter import Black, Inpainter
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.sample.boxes_2d import rig_of
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.settings import PlanCache, SampleKeys, inpainter_of, render_config

Sample = Mapping[str, Any]

_CACHED_TRANSFORMS = 8  # targets of a study; full-size plans take 50 MB each

Render = Callable[[Mapping[str, Any], Rig], list[RenderedView]]  # a view for each of the target rig

Look = Callable[["ScoredFrame", str, Rig, Sequence[RenderedView]], None]
"""Look at a frame's views for a rig, by the method of a name."""

Exposure = Literal["raw", "even"]
EXPOSURES: tuple[Exposure, ...] = ("raw", "even")  # exposures as recorded, and made even


@dataclass(frozen=True)
class Method:
    """A row of a table."""

    name: str
    render: Callable[[Sample, Rig], list[RenderedView]]  # of a sample with ``rig``, for a rig in its own ego frame
    reads_points: bool = False  # may use the sample's ``points``, so that only a part of them can score it


def retargeting(
    quality: Quality | RenderConfig | PaperConfig,
    geometry: GeometryName = "auto",
    name: str = "",
    *,
    holes: Holes | Inpainter = "black",
    **settings: Any,
) -> Method:
    """Wrap ``RigRetarget`` as a method, with its arguments; exposures stay as recorded, for the metrics."""
    inpainter = inpainter_of(holes)  # once, not for each target
    settings = dict[str, Any](cache=PlanCache(max_bytes=0)) | settings
    images_alone = replace(settings.get("keys", SampleKeys()), points="source")
    settings |= {"holes": inpainter, "match_exposure": False, "keys": images_alone}

    transform = lru_cache(_CACHED_TRANSFORMS)(partial(RigRetarget, quality=quality, geometry=geometry, **settings))
    label = name or ", ".join([quality if isinstance(quality, str) else type(quality).__name__, geometry])
    if not name and not isinstance(inpainter, Black):
        steps = getattr(inpainter, "steps", None)
        label += f", {holes if isinstance(holes, str) else type(holes).__name__}" + (f" {steps}" if steps else "")
    reads_points = isinstance(render_config(quality), RenderConfig) and "points" in GEOMETRIES[geometry].reads
    return Method(label, lambda sample, target: views_of(transform(target)(sample)), reads_points)


def own_index(source: Rig, camera: Camera) -> int:
    """Index of the source camera of the same name, or else of the nearest direction."""
    nearest = int(np.argmax(source.cam2ego[:, :3, 2] @ camera.cam2ego[:3, 2]))
    return source.names.index(camera.name) if camera.name in source.names else nearest


def views_of(out: Sample) -> list[RenderedView]:
    images, coverage = as_arrays(out["images"]), [mask.cpu().numpy() for mask in out["coverage"]]
    confidence = [c.float().cpu().numpy() for c in out["confidence"]] if "confidence" in out else [None] * len(images)
    generated = [g.cpu().numpy() for g in out["generated"]] if "generated" in out else [None] * len(images)
    return [RenderedView(*parts) for parts in zip(images, coverage, confidence, generated, strict=True)]


# --- frames and their references --------------------------------------------------------------------------------------
class LidarReference(NamedTuple):
    sample: Mapping[str, Any]  # at one exposure
    points: ColouredPoints  # the scoring ones, in its colours


class Truth(NamedTuple):
    images: Sequence[Image]
    valid: Sequence[BoolArray]  # (h, w) pixels that score
    regions: Sequence[Mapping[str, BoolArray]] = ()  # (h, w) parts of each image that have a score by name, if known


@dataclass(frozen=True)
class ScoredFrame:
    sample: Mapping[str, Any]  # ``rig``, ``images`` and other keys that methods may use
    lidar: Mapping[Exposure, LidarReference] = field(default_factory=dict)  # by exposure; empty without points
    held_out: bool = False  # whether ``sample`` has points, and others score
    truth: Callable[[Rig], Truth] | None = None  # the truth of a rig; None if unknown
    target: Rig | None = None  # the rig that alone has a truth, that of photographs; None for any rig

    def true_images(self, target: Rig) -> Sequence[Image] | None:
        """The true views (h, w, 3) of a rig, if the truth is known."""
        return None if self.truth is None else self.truth(target).images


def photographed(
    sample: Mapping[str, Any], camera: Camera, photograph: Image, ground_z_m: float, *regions: Mapping[str, BoolArray]
) -> ScoredFrame:
    """Frame whose truth is a camera's photograph, outside of its mask; ``regions`` as of ``Truth``."""
    truth, target = Truth([photograph], [scene_mask(camera)], regions), replace(camera, mask=None)
    rig = Rig([target], name=camera.name, ground_z_m=ground_z_m)
    return ScoredFrame(sample, truth=lambda _: truth, target=rig)


def scene_mask(camera: Camera) -> BoolArray:
    """(h, w) pixels of a camera that show no car body."""
    return np.ones(camera.size, bool) if camera.mask is None else camera.mask


def without_masks(rig: Rig) -> Rig:
    """The same rig without car-body masks."""
    return rig.with_cameras([replace(camera, mask=None) for camera in rig])


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
    true = None if truth is None else lru_cache(1)(lambda rig: _street_truth(truth(rig)))
    inputs = {key: value for key, value in sample.items() if key != "points"}
    points_3d = sample.get("points")
    if points_3d is None or not exposures:
        return ScoredFrame(dict(sample) if hand_over_points else inputs, truth=true)
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
    return ScoredFrame(inputs, lidar, hand_over_points, true)


def _street_truth(views: RenderedViews) -> Truth:
    valid, regions = [], []
    for classes in map(np.asarray, views.classes):
        valid.append(classes != SceneClass.VOID)
        ground, sky = np.isin(classes, [int(c) for c in GROUND_CLASSES]), classes == SceneClass.SKY
        regions.append({"ground": ground, "sky": sky, "object": ~ground & ~sky & valid[-1]})
    return Truth(as_arrays(views.images), valid, regions)


def scores(
    frame: ScoredFrame, render: Render, target: Rig, exposures: Sequence[Exposure] = EXPOSURES
) -> tuple[list[RenderedView], list[dict[str, float]]]:
    """Render a frame for a rig in its own ego frame, and score each view at the exposures that the frame has.

    Returns the views at the first exposure, and one row of metrics each: ``seen``, the share of covered pixels;
    ``true_...`` if the truth is known (``truth_metrics``); ``raw_...`` and ``even_...`` if there are points
    (``sparse_metrics``).
    """
    mounted = target.in_frame_of(frame.sample["rig"])
    references = [(exposure, frame.lidar[exposure]) for exposure in exposures if exposure in frame.lidar]
    views = render(references[0][1].sample if references else frame.sample, target)
    rows = [{"seen": float(view.coverage.mean())} for view in views]
    if frame.truth is not None:
        truth = frame.truth(target)
        classes = truth.regions or [{}] * len(views)
        for row, view, true, valid, parts in zip(rows, views, truth.images, truth.valid, classes, strict=True):
            metrics = truth_metrics(view.image, true, coverage=view.coverage, classes=parts, valid=valid)
            row |= {f"true_{name}": value for name, value in metrics.items()}
    for k, (exposure, reference) in enumerate(references):
        rendered = views if k == 0 else render(reference.sample, target)
        for row, camera, view in zip(rows, mounted, rendered, strict=True):
            metrics = sparse_metrics(view.image, camera, reference.points, coverage=view.coverage) or {}
            row |= {f"{exposure}_{name}": value for name, value in metrics.items()}
    return views, rows


# --- evaluation of methods --------------------------------------------------------------------------------------------
@dataclass
class Evaluation:
    """Measurements as plain data, and the views of the first frame."""

    first: ScoredFrame
    target: Rig  # that of the first frame
    label: str  # name of the target
    views: list[dict[str, Any]] = field(default_factory=list)  # metrics by frame, target, camera and method
    pictures: dict[str, list[RenderedView]] = field(default_factory=dict)  # views of ``first`` by method
    declined: dict[str, str] = field(default_factory=dict)  # why a method could not render

    def means(self, method: str) -> dict[str, float]:
        """Means of the per-image values over cameras and frames."""
        return mean_of(row for row in self.views if row["method"] == method)


def evaluate(
    frames: Iterable[tuple[str, ScoredFrame]],
    target: Callable[[Rig], Rig],
    methods: Sequence[Method],
    tick: Callable[[str, int], None] = lambda _, __: None,
    look: Look | None = None,
    compare: Callable[[str, ScoredFrame, Mapping[str, Sequence[RenderedView]]], list[dict[str, Any]]] | None = None,
) -> Evaluation:
    """Run every method on every named frame, for its ``target`` or that of its rig; DataError without frames.

    ``tick`` is called before each step with its name and the frame's number of steps. ``look`` sees all views.
    ``compare`` gives the rows of a frame's views by all methods, in place of ``scores`` of each method.
    """
    done: Evaluation | None = None
    for name, frame in frames:
        rig = frame.target or target(frame.sample["rig"])
        label = name if frame.target is None else f"{name}: {rig.name}"
        if done is None:
            done = Evaluation(frame, rig, rig.name or "target" if frame.target is None else "photographs")
        shown: dict[str, list[RenderedView]] = {}
        for method in methods:
            tick(f"{label}: {method.name}", len(methods))
            try:
                if compare is None:
                    shown[method.name], rows = scores(frame, method.render, rig)
                    where = {"frame": name, "method": method.name, "target": done.label}
                    done.views += [{**where, "camera": c.name, **row} for c, row in zip(rig, rows, strict=True)]
                else:
                    shown[method.name] = method.render(frame.sample, rig)
            except (CalibrationError, SampleError) as error:  # lenses, for a method of pinhole cameras
                done.declined[method.name] = f"frame {label}: {error}"
                continue
            if look is not None:
                look(frame, method.name, rig, shown[method.name])
        if compare is not None and shown:
            done.views += compare(name, frame, shown)
        if frame is done.first:
            done.pictures = shown
    if done is None:
        raise DataError("expected a frame to evaluate, found none")
    return done
