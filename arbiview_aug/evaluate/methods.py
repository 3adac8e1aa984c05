"""Named methods: whatever renders a sample for a target rig, so that tables can compare them.

A method gets the whole sample and may use what is in it; what it must not see is left out before (``frames``).
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.baselines import BASELINES, Renderer
from arbiview_aug.evaluate.images import Image, RenderedView, as_arrays
from arbiview_aug.favs.config import FavsConfig, PaperConfig, Quality, favs_config
from arbiview_aug.generator import Generator
from arbiview_aug.generator.generator import has_shipped
from arbiview_aug.render.harmonise import Harmonise, Harmoniser
from arbiview_aug.render.overlap_depth import OverlapDepth, overlap_depth
from arbiview_aug.render.refinement import RefinementCache
from arbiview_aug.sample.inputs import read_frames, read_scenes
from arbiview_aug.scene.scene import SURFACES, Scene
from arbiview_aug.scene.surface import SurfaceName
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.settings import RenderPath

Sample = Mapping[str, Any]

OURS: tuple[Quality, ...] = ("draft", "fast", "accurate")
"""The presets that are not the published method."""

INPAINTED, GENERATED = "fast, inpainted", "generator"
"""Rows of ``fast`` with its holes filled: by Telea's inpainting, and by the weights that ship with the package."""

_HELD_TRANSFORMS = 8  # as many as a set of targets has; full-size plans take 50 MB each


@dataclass(frozen=True)
class Method:
    """A row of a table.

    Attributes:
        name: Shown in tables.
        render: Sample with ``rig``, target rig (in its own ego frame): one view for each target camera.
        reads_points: Whether it may use the sample's ``points``: then only a part of them can score it.
        render_alone: Sample, index of a source camera, one-camera target rig: the view from that source alone, but
            with what the method knows of the scene from all; None where it knows nothing but what each camera shows.
        plans: Whether a first call takes longer than the next, because it plans.
    """

    name: str
    render: Callable[[Sample, Rig], list[RenderedView]]
    reads_points: bool = False
    render_alone: Callable[[Sample, int, Rig], RenderedView] | None = None
    plans: bool = True

    def alone(self, sample: Sample, camera: int, target: Rig) -> RenderedView:
        """A one-camera target from one source camera alone."""
        if self.render_alone is not None:
            return self.render_alone(sample, camera, target)
        (view,) = self.render(one_camera(sample, camera), target)
        return view


def retargeting(
    quality: Quality | FavsConfig | PaperConfig,
    surface: SurfaceName = "auto",
    name: str = "",
    *,
    outputs: Sequence[str] = (),
    harmonise: Harmonise = None,
    refinement: RefinementCache | None = None,
    path: RenderPath = "favs",
    generator: Generator | None = None,
    steps: int | None = None,
    transforms: int = _HELD_TRANSFORMS,
) -> Method:
    """``RigRetarget`` as a method; a transform, with its last plan, for each of the last target rigs.

    With ``path="favs"`` holes stay black: scores are of what was seen.

    Args:
        quality: As for ``RigRetarget``.
        surface: As for ``RigRetarget``.
        name: For tables; by default made of both.
        outputs: Further outputs, ``confidence`` where there is to be one.
        harmonise: As for ``RigRetarget``.
        refinement: As for ``RigRetarget``.
        path: As for ``RigRetarget``; a source camera alone is never completed.
        generator: As for ``RigRetarget``.
        steps: As for ``RigRetarget``.
        transforms: Target rigs whose transforms are cached.
    """
    completes = path != "favs"
    if path == "diffusion" and generator is None:
        generator = Generator.shipped()  # once, not for each target

    @lru_cache(transforms)
    def transform(target: Rig) -> RigRetarget:
        return RigRetarget(
            target,
            quality=quality,
            surface=surface,
            outputs=outputs,
            harmonise=harmonise,
            refinement=refinement,
            path=path,
            generator=generator,
            steps=steps,
            cache_bytes=0,
            holes="fill" if completes else "black",
        )

    def render(sample: Sample, target: Rig) -> list[RenderedView]:
        return views_of(transform(target)(sample))

    def render_alone(sample: Sample, camera: int, target: Rig) -> RenderedView:
        """With the depth and the gain that all cameras' overlaps gave, as if they had been found before."""
        given, (depth, gains) = one_camera(sample, camera), overlaps.get(sample)
        held = None
        if depth is not None:
            held, found = RefinementCache(), depth
            held.get((given["rig"].content_key, None), lambda: found)
        gain = None if gains is None else gains[camera : camera + 1]
        retarget = RigRetarget(
            target, quality=quality, surface=surface, harmonise=gain, refinement=held, cache_bytes=0, holes="black"
        )
        (view,) = views_of(retarget(given))
        return view

    config = favs_config(quality)
    label = name or (f"{quality}, {surface}" if isinstance(quality, str) else f"{type(quality).__name__}, {surface}")
    if not name and path != "favs":
        label += f", {path}" + (f" {steps}" if steps else "")
    learns = isinstance(config, FavsConfig) and config.overlap_depth
    overlaps = _LastOverlaps(surface if learns else None, Harmoniser(harmonise))
    reads_points = "points" in SURFACES[surface].reads and not isinstance(config, PaperConfig)
    alone = render_alone if overlaps.tell or completes else None
    return Method(label, render, reads_points, alone, plans=not isinstance(config, PaperConfig))


class _LastOverlaps:
    """What the overlaps of the last sample tell: a dozen views of it are rendered in a row.

    Args:
        surface: The surface whose distances they correct; None where depth is not asked for.
        harmoniser: Gives the gains.
    """

    def __init__(self, surface: SurfaceName | None, harmoniser: Harmoniser) -> None:
        self._surface, self._harmoniser = surface, harmoniser
        self._last: tuple[Sample, tuple[OverlapDepth | None, Sequence[float] | None]] | None = None

    @property
    def tell(self) -> bool:
        """Whether anything is asked of them."""
        return self._surface is not None or self._harmoniser.is_on

    def get(self, sample: Sample) -> tuple[OverlapDepth | None, Sequence[float] | None]:
        """Depth and gains, each where it is asked for."""
        if self._last is None or self._last[0] is not sample:
            rig, images = sample["rig"], list(sample["images"])
            gains = self._harmoniser.report(rig, images).gains if self._harmoniser.is_on else None
            self._last = sample, (self._depth(sample, rig, images), gains)
        return self._last[1]

    def _depth(self, sample: Sample, rig: Rig, images: list[torch.Tensor]) -> OverlapDepth | None:
        if self._surface is None:
            return None
        (scene,) = read_scenes(sample, read_frames(sample, None), (), self._surface) or [Scene()]
        row = SURFACES[scene.best if self._surface == "auto" else self._surface]
        boxes = scene.boxes if row.overlap_depth and "boxes" in row.reads else None
        return overlap_depth(rig, images, boxes)  # as ``FramePlanner`` measures it


def one_camera(sample: Sample, camera: int) -> dict[str, Any]:
    """A sample as if it had one camera; what its ego frame holds stays."""
    rig: Rig = sample["rig"]
    given = {key: value for key, value in sample.items() if key not in ("K", "cam2ego", "detections")}
    return {**given, "images": [sample["images"][camera]], "rig": rig.with_cameras([rig[camera]])}


def views_of(out: Sample) -> list[RenderedView]:
    """A retargeted sample's views."""
    images, coverage = as_arrays(out["images"]), [mask.cpu().numpy() for mask in out["coverage"]]
    confidence = [c.float().cpu().numpy() for c in out["confidence"]] if "confidence" in out else [None] * len(images)
    generated = [g.cpu().numpy() for g in out["generated"]] if "generated" in out else [None] * len(images)
    return [RenderedView(*parts) for parts in zip(images, coverage, confidence, generated, strict=True)]


def baseline(name: str) -> Method:
    """One of ``baselines.BASELINES``."""
    renderer: Renderer = BASELINES[name]

    def render(sample: Sample, target: Rig) -> list[RenderedView]:
        rig: Rig = sample["rig"]
        images: list[Image] = as_arrays(sample["images"])
        return renderer(rig, images, target.in_frame_of(rig))

    return Method(name, render)


def paper_stages() -> dict[str, PaperConfig]:
    """``paper`` whole, and with each stage switched off: what each is worth.

    Without stage 4 the fused image is the plain mean of all sources that see a pixel.
    """
    whole = PaperConfig()
    return {
        "paper": whole,
        "paper without stage 2, matching": replace(whole, use_feature_matching=False),
        "paper without stage 3, objects": replace(whole, use_object_alignment=False),
        "paper without stages 2 and 3": replace(whole, use_feature_matching=False, use_object_alignment=False),
        "paper without stage 4, weights": replace(
            whole,
            use_distance_weight=False,
            use_gradient_weight=False,
            use_quality_weight=False,
            use_primary_weight=False,
        ),
    }


def study_methods() -> list[Method]:
    """The rows of the paper's tables and ours, from images and poses alone: no LiDAR, no boxes.

    The generator's is there where diffusers is: ``fast``, its holes by the weights that ship with the package.
    """
    published = [retargeting(config, "auto", name) for name, config in paper_stages().items()]
    return [
        *map(baseline, BASELINES),
        *published,
        *(retargeting(quality, "street", quality) for quality in OURS),
        retargeting("fast", "street", INPAINTED, path="inpaint"),
        *([retargeting("fast", "street", GENERATED, path="diffusion")] if has_generator() else []),
    ]


def has_generator() -> bool:
    """Whether the weights of the package are there, and the packages that they need."""
    return importlib.util.find_spec("diffusers") is not None and has_shipped()
