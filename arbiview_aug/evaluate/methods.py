"""Named methods that render a sample for a target rig, as rows of tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName, Holes, Quality
from arbiview_aug.errors import WarnOnce
from arbiview_aug.evaluate.images import RenderedView, as_arrays
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.inpaint.inpainter import Black, Inpainter
from arbiview_aug.render.overlap_depth import OverlapDepth, overlap_depth
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.sample.inputs import DEPTH_KEYS, MOTION_KEY, read_frames, read_scene
from arbiview_aug.scene.scene import GEOMETRIES
from arbiview_aug.temporal.motion_depth import brings_motion, estimate_motion
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.settings import PlanCache, SampleKeys, inpainter_of, render_config

Sample = Mapping[str, Any]

_CACHED_TRANSFORMS = 8  # the targets of a set; full-size plans take 50 MB each


@dataclass(frozen=True)
class Method:
    """A row of a table.

    ``render`` maps a sample with ``rig`` and a target rig (in its own ego frame) to one view per target camera.
    ``render_alone`` maps a sample, the index of a source camera and a one-camera target rig to the view from it
    alone, with the scene estimated from all cameras; None if nothing is estimated from several.
    """

    name: str
    render: Callable[[Sample, Rig], list[RenderedView]]
    reads_points: bool = False  # may use the sample's ``points``, so that only a part of them can score it
    render_alone: Callable[[Sample, int, Rig], RenderedView] | None = None

    def alone(self, sample: Sample, camera: int, target: Rig) -> RenderedView:
        """Render a one-camera target from one source camera alone."""
        if self.render_alone is not None:
            return self.render_alone(sample, camera, target)
        (view,) = self.render(one_camera(sample, camera), target)
        return view


def retargeting(
    quality: Quality | RenderConfig | PaperConfig,
    geometry: GeometryName = "auto",
    name: str = "",
    *,
    holes: Holes | Inpainter = "black",
    **settings: Any,
) -> Method:
    """Wrap ``RigRetarget`` as a method, with its arguments.

    Exposures stay as recorded: metrics compare with them. The name is by default made of quality, geometry and what
    fills holes. A source camera alone is never completed.
    """
    inpainter = inpainter_of(holes)  # once, not for each target
    fills = not isinstance(inpainter, Black)
    settings = dict[str, Any](cache=PlanCache(max_bytes=0)) | settings
    images_alone = replace(settings.get("keys", SampleKeys()), points="source")
    settings |= {"holes": inpainter, "match_exposure": False, "keys": images_alone}

    @lru_cache(_CACHED_TRANSFORMS)
    def transform(target: Rig) -> RigRetarget:
        return RigRetarget(target, quality=quality, geometry=geometry, **settings)

    def render(sample: Sample, target: Rig) -> list[RenderedView]:
        return views_of(transform(target)(sample))

    def render_alone(sample: Sample, camera: int, target: Rig) -> RenderedView:
        """Render with the depth estimated from all cameras, their overlaps and their neighbours."""
        if not estimates or estimates[0][0] is not sample:  # several views of a sample are rendered in a row
            known = _with_motion(sample, geometry) if from_motion else sample
            estimates[:] = [(sample, known, _overlap_depth(sample, geometry) if learns else None)]
        _, known, depth = estimates[0]
        alone = one_camera(known, camera)
        retarget = RigRetarget(
            target,
            quality=quality,
            geometry=geometry,
            match_exposure=False,
            cache=PlanCache(share_overlap=depth is not None, max_bytes=0),
            holes="black",
            keys=SampleKeys(points="source"),
        )
        if depth is not None and retarget.renderer.overlaps is not None:
            retarget.renderer.overlaps.get((alone["rig"].named_key, None), lambda: depth)
        (view,) = views_of(retarget(alone))
        return view

    config = render_config(quality)
    label = name or ", ".join([quality if isinstance(quality, str) else type(quality).__name__, geometry])
    if not name and fills:
        steps = getattr(inpainter, "steps", None)
        label += f", {holes if isinstance(holes, str) else type(holes).__name__}" + (f" {steps}" if steps else "")
    is_paper = not isinstance(config, RenderConfig)
    learns = not is_paper and config.overlap_depth
    from_motion = not is_paper and GEOMETRIES[geometry].needs == "motion"
    estimates: list[tuple[Sample, Sample, OverlapDepth | None]] = []
    reads_points = "points" in GEOMETRIES[geometry].reads and not is_paper
    alone = render_alone if learns or from_motion or fills else None
    return Method(label, render, reads_points, alone)


def _overlap_depth(sample: Sample, geometry: GeometryName) -> OverlapDepth:
    """Depth from a sample's overlaps, as ``estimate_overlap`` measures it."""
    scene = read_scene(read_frames(sample, None, geometry)[0], geometry)
    row = GEOMETRIES[scene.best if geometry == "auto" else geometry]
    boxes = scene.boxes if row.overlap_depth and "boxes" in row.reads else None
    return overlap_depth(sample["rig"], list(sample["images"]), boxes)


def _with_motion(sample: Sample, geometry: GeometryName) -> Sample:
    """The sample with its depth from motion, where that must be estimated."""
    warn = WarnOnce()
    frame = read_frames(sample, None, geometry, further=("neighbours",), warn=warn)[0]
    if brings_motion(frame, geometry):
        return sample
    motion = estimate_motion(frame, read_scene(frame, geometry).boxes, warn)
    return {**sample, MOTION_KEY: list(map(torch.from_numpy, motion.depth_m))}


def one_camera(sample: Sample, camera: int) -> dict[str, Any]:
    """Reduce a sample to one camera, its depth and masks; geometry in the ego frame stays, neighbours do not."""
    rig: Rig = sample["rig"]
    kept = {key: value for key, value in sample.items() if key not in ("K", "cam2ego", "detections", "neighbours")}
    of_cameras = (*DEPTH_KEYS, "coverage", "ego_mask")
    kept |= {key: kept[key][camera : camera + 1] for key in of_cameras if kept.get(key) is not None}
    return {**kept, "images": [sample["images"][camera]], "rig": rig.with_cameras([rig[camera]])}


def views_of(out: Sample) -> list[RenderedView]:
    images, coverage = as_arrays(out["images"]), [mask.cpu().numpy() for mask in out["coverage"]]
    confidence = [c.float().cpu().numpy() for c in out["confidence"]] if "confidence" in out else [None] * len(images)
    generated = [g.cpu().numpy() for g in out["generated"]] if "generated" in out else [None] * len(images)
    return [RenderedView(*parts) for parts in zip(images, coverage, confidence, generated, strict=True)]
