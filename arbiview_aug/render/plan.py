"""The render plan: everything about a (source rig, target rig) pair that does not depend on image content.

For every target camera (``arbiview_aug.render.view_planner``): which sources see it, over which surface and why, where
each pixel is read, which source wins it, and the narrow bands along seams that are blended. Executing a plan is reading
images at maps (``arbiview_aug.render.atlas``); building one is cheap enough for calibrations that change with every
frame: maps are evaluated in float64 on a coarse grid and interpolated wherever that is exact to ``map_tolerance_px``,
and pixel by pixel elsewhere (``arbiview_aug.render.warp_maps``).
"""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, field, fields
from functools import partial
from typing import Any

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.favs.config import FavsConfig
from arbiview_aug.image_ops import Scratch
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.atlas import AtlasLayout
from arbiview_aug.render.view_plan import ViewPlan
from arbiview_aug.render.view_planner import ViewPlanner
from arbiview_aug.scene.scene import Scene


@dataclass(frozen=True)
class RenderPlan:
    """Everything needed to render a target rig from a source rig's images; plain data, picklable.

    Attributes:
        source: The source rig.
        target: The target rig in the source's ego frame, on the source's road.
        layout: Where the sources lie in the atlas.
        targets: One plan for each target camera.
        counters: What was evaluated while building: pairs by surface, cells interpolated and exact, bands.
        on_devices: The maps as tensors, by device, where they were asked for (``device_maps``); not pickled.
    """

    source: Rig
    target: Rig
    layout: AtlasLayout
    targets: tuple[ViewPlan, ...]
    counters: dict[str, int] = field(default_factory=dict)
    on_devices: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "on_devices": {}}

    @property
    def nbytes(self) -> int:
        """Memory held by the maps, on devices too."""
        on_devices = list(self.on_devices.values())
        return sum(t.nbytes for t in self.targets) + sum(view.nbytes for views in on_devices for view in views)

    @property
    def coverage(self) -> list[BoolArray]:
        """(h, w) for each target camera."""
        return [t.coverage for t in self.targets]


class PlanCache(LRUCache[bytes, RenderPlan]):
    """Plans by content key, the least recently used dropped once ``max_bytes`` are held. Pickles as empty."""

    def __init__(self, max_bytes: int = 512 * 2**20) -> None:
        super().__init__(max_bytes, lambda plan: plan.nbytes)

    @property
    def max_bytes(self) -> int:
        """Memory for plans."""
        return self.limit

    @property
    def nbytes(self) -> int:
        """Memory held by all plans."""
        return self.size

    def __reduce__(self) -> tuple[type[PlanCache], tuple[int]]:
        return PlanCache, (self.max_bytes,)


def plan_key(source: Rig, target: Rig, surface: str, config: FavsConfig, scene: Scene | None = None) -> bytes:
    """Content key of a plan: the calibrations, the scene, the surface and the settings, no names."""
    settings = tuple(getattr(config, f.name) for f in fields(config))
    geometry = (scene or Scene()).key
    return hashlib.sha256(repr((source.content_key, target.content_key, surface, settings, geometry)).encode()).digest()


def build_plan(
    source: Rig,
    target: Rig,
    *,
    surface: str = "auto",
    config: FavsConfig | None = None,
    scene: Scene | None = None,
) -> RenderPlan:
    """Plan how ``target`` is rendered from ``source``'s images.

    Args:
        source: The rig that recorded the images.
        target: The rig to render, in its own ego frame: the two roads are made to coincide.
        surface: ``far``, ``ground``, ``street``, ``objects`` (needs boxes), ``lidar`` (needs points); or ``auto``: for
            each pair of target and source camera, ``far`` where their centres coincide or the worst-case parallax is
            below ``config.far_parallax_px``, else the scene's best.
        config: Settings; the ``fast`` preset by default.
        scene: What is known of the geometry, in the source's ego frame.

    Returns:
        The plan. Targets that no source sees have zero coverage.
    """
    config = config or FavsConfig()
    target = target.in_frame_of(source)
    counters: Counter[str] = Counter()
    order = content_order(source.cameras)
    known = scene or Scene()
    by_name = partial(known.surface, ground_z_m=source.ground_z_m)
    drafts = [ViewPlanner(source, order, camera, surface, known.best, by_name, config, counters) for camera in target]
    used = [(region.source, region.level) for draft in drafts for region in draft.regions]
    layout = AtlasLayout.for_sources(source.sizes, used)
    scratch = Scratch()
    targets = tuple(draft.finish(layout, scratch) for draft in drafts)
    read = {
        (region.source, region.level)
        for draft, target in zip(drafts, targets, strict=True)
        for region in draft.regions
        if region.source in target.sources
    }
    layout = layout.without_others(read)
    counters["bands"] = sum(len(t.bands) for t in targets)
    return RenderPlan(source, target, layout, targets, dict(counters))
