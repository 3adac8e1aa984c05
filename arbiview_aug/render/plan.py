"""The render plan: everything about a (source rig, target rig) pair that does not depend on image content.

For every target camera (``arbiview_aug.render.view_planner``): the sources that see it, the surface of each, the
position of every pixel, its winning source, and the bands along seams that are blended. Compiled code evaluates every
pixel (``arbiview_aug.render.kernels``), fast enough for calibrations or geometry that change with every frame.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from dataclasses import dataclass, field, fields, replace
from typing import Any, cast

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import LENSES, BoolArray, LensName
from arbiview_aug.cameras.rays import CameraMaps
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.environment import compilation_announced
from arbiview_aug.render.atlas import AtlasLayout
from arbiview_aug.render.config import RenderConfig
from arbiview_aug.render.view_plan import ViewPlan
from arbiview_aug.render.view_planner import ViewPlanner
from arbiview_aug.scene.point_cloud import seen_through
from arbiview_aug.scene.scene import Scene


@dataclass(frozen=True)
class RenderPlan:
    """Everything needed to render a target rig from a source rig's images; plain data, picklable."""

    source: Rig
    target: Rig  # in the source's ego frame, on the source's road
    layout: AtlasLayout  # the sources' places in the atlas
    targets: tuple[ViewPlan, ...]  # one plan for each target camera
    counters: dict[str, int] = field(default_factory=dict)  # pairs by surface, cells, pixels of solids, bands
    # The maps as tensors, by device (``torch_backend.maps_on``); not pickled.
    on_devices: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "on_devices": {}}

    @property
    def nbytes(self) -> int:
        """Memory of the maps in bytes, on devices too."""
        on_devices = list(self.on_devices.values())
        return sum(t.nbytes for t in self.targets) + sum(view.nbytes for views in on_devices for view in views)

    @property
    def coverage(self) -> list[BoolArray]:
        """(h, w) for each target camera."""
        return [t.coverage for t in self.targets]


def plan_key(source: Rig, target: Rig, surface: str, config: RenderConfig, scene: Scene | None = None) -> bytes:
    """Content key of a plan: calibrations, scene, surface and settings, without names."""
    settings = tuple(getattr(config, f.name) for f in fields(config))
    geometry = (scene or Scene()).key
    return hashlib.sha256(repr((source.content_key, target.content_key, surface, settings, geometry)).encode()).digest()


def build_plan(
    source: Rig,
    target: Rig,
    *,
    geometry: str = "auto",
    config: RenderConfig | None = None,
    scene: Scene | None = None,
    maps: CameraMaps | None = None,
) -> RenderPlan:
    """Plan how ``target`` is rendered from ``source``'s images.

    Args:
        source: The rig that recorded the images.
        target: The rig to render, in its own ego frame: the two roads are made to coincide.
        geometry: A name in ``GEOMETRIES``; ``auto``: for each pair of cameras ``infinity`` where their centres
            coincide or the worst-case parallax is below
            ``config.far_parallax_px``, else the scene's best.
        config: Settings; the ``fast`` preset by default.
        scene: Known geometry, in the source's ego frame.
        maps: Rays and masks of cameras, to be reused by later plans.

    Returns:
        The plan. Targets that no source sees have zero coverage.
    """
    with compilation_announced():
        return _built(source, target.in_frame_of(source), geometry, config or RenderConfig(), scene or Scene(), maps)


def warm_up() -> None:
    """Compile the kernels of cameras, scenes and plans, or load them from numba's cache."""
    from arbiview_aug.render.kernels import read_ahead

    views = [
        Camera.looking(
            name=f"{name} {side}", azimuth_deg=20 * side, position_m=(0, 0.3 * side, 1.5), width_px=32, height_px=32,
            horizontal_fov_deg=90, lens=cast(LensName, name), distortion=(0.0,) * lens.coefficient_counts[0],
        )
        for name, lens in LENSES.items() for side in (-1, 0, 1)
    ]  # fmt: skip
    wall = np.stack(np.meshgrid(8.0, np.linspace(-2, 2, 20), np.linspace(0.3, 1.5, 10)), -1).reshape(-1, 3)
    boxes = np.array([[8.5, 0, 1, 1, 4, 2, 0], [5, 3, 1, 1, 1, 2, 0]])
    source = Rig(
        [replace(camera, mask=np.eye(32, dtype=bool) < 1) for camera in views if not camera.name.endswith("0")]
    )
    target = Rig([camera for camera in views if camera.name.endswith("0")])
    scene, config = Scene(boxes=boxes, points=wall), RenderConfig(certainty=True)
    seen_through(wall, wall, target[0].center_m)
    for surface in ("ground", "boxes", "lidar"):
        plan = build_plan(source, target, geometry=surface, config=config, scene=scene)
    read_ahead(np.zeros((1, 3), np.uint8), 3, plan.targets[0].at.packed, plan.targets[0].source_camera)


def _built(
    source: Rig, target: Rig, surface: str, config: RenderConfig, scene: Scene, maps: CameraMaps | None
) -> RenderPlan:
    counters: Counter[str] = Counter()
    order = content_order(source.cameras)
    maps = maps or CameraMaps()
    planners = [ViewPlanner(source, order, camera, surface, scene, config, counters, maps) for camera in target]
    used = [(region.source, region.level) for planner in planners for region in planner.regions]
    layout = AtlasLayout.for_sources(source.sizes, used)
    targets = tuple(planner.finish(layout) for planner in planners)
    read = set[tuple[int, int]]()
    for planner, view in zip(planners, targets, strict=True):
        sources = view.sources
        read |= {(region.source, region.level) for region in planner.regions if region.source in sources}
    layout = layout.without_others(read)
    counters["bands"] = sum(len(t.bands) for t in targets)
    return RenderPlan(source, target, layout, targets, dict(counters))
