"""Named methods that render a sample for a target rig, as rows of tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName, Holes, Quality
from arbiview_aug.evaluate.images import RenderedView, as_arrays
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.inpaint.inpainter import Black, Inpainter
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.settings import PlanCache, SampleKeys, inpainter_of, render_config

Sample = Mapping[str, Any]

_CACHED_TRANSFORMS = 8  # targets of a study; full-size plans take 50 MB each


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
    """Wrap ``RigRetarget`` as a method, with its arguments; exposures stay as recorded: metrics compare with them."""
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


def _copy(sample: Sample, target: Rig) -> list[RenderedView]:
    images, views = as_arrays(sample["images"]), []
    for camera in target:
        image = images[own_index(sample["rig"], camera)]
        resized: Any = cv2.resize(image, camera.size[::-1], interpolation=cv2.INTER_AREA)
        views.append(RenderedView(resized, np.ones(camera.size, bool)))
    return views


COPY = Method("copy", _copy)
"""The source image of the same name, else of the nearest direction."""


def own_index(source: Rig, camera: Camera) -> int:
    """Index of the source camera of the same name, or else of the nearest direction."""
    nearest = int(np.argmax(source.cam2ego[:, :3, 2] @ camera.cam2ego[:3, 2]))
    return source.names.index(camera.name) if camera.name in source.names else nearest


def views_of(out: Sample) -> list[RenderedView]:
    images, coverage = as_arrays(out["images"]), [mask.cpu().numpy() for mask in out["coverage"]]
    confidence = [c.float().cpu().numpy() for c in out["confidence"]] if "confidence" in out else [None] * len(images)
    generated = [g.cpu().numpy() for g in out["generated"]] if "generated" in out else [None] * len(images)
    return [RenderedView(*parts) for parts in zip(images, coverage, confidence, generated, strict=True)]
