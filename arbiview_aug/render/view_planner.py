"""Planning of views: which sources see each target view, over which surface, and which one wins each pixel.

The scene becomes images first: inverse distances of each view, and its occlusion in each source. Compiled code
(``node_kernels``, ``kernels``) then evaluates nodes and pixels, fast enough for calibrations or geometry that change
with every frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import RayCache, edge_distance, look_apart
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.environment import compilation_announced
from arbiview_aug.image_ops import level_size, some_of_cells
from arbiview_aug.render.confidence import certainty
from arbiview_aug.render.plan import (
    GRID_STEP_PX,
    ROAD_M,
    AtlasLayout,
    FixedMap,
    HoleContents,
    RenderConfig,
    RenderPlan,
    Seam,
    SourceUse,
    ViewPlan,
)
from arbiview_aug.render.requirements import SAME_CENTER_M, RigPair, source_bounds
from arbiview_aug.render.structures import Images, Nodes, Occluders, Pixels, Sources, Surfaces, View
from arbiview_aug.scene.boxes import BOX_ERROR
from arbiview_aug.scene.point_cloud import occlusion_level
from arbiview_aug.scene.scene import GEOMETRIES, Scene
from arbiview_aug.scene.surface import FAR_PARALLAX_PX, OcclusionMap, is_within_wall, worst_parallax_px

SMALL_SIDE_PX = 64  # weights of targets with a shorter side are evaluated at every pixel
PRIMARY_BONUS = 1e6
"""w_primary of a source at the target's own centre (paper, FAVS Stage 4). It is exact and wins where it sees, down to
the border of an image of 32767 px, where its other weights are at least 1.5e-6. Weights of other sources are at most 1.
"""

MAGNIFIED = 0.8
"""A view is read by cubics where it has at most this many source pixels per pixel, and is mostly read at its own
centre: docs/decisions.md."""

_NO_IMAGE, _NO_FACES, _NO_PARTS = np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int32), np.zeros(0, np.int32)


class ViewPlanner:
    """Plans one view in two steps: visibility in each source, then winners of pixels and blended seams.

    Positions, visibility and winners are evaluated at every pixel. Weights are smooth: they are known on nodes
    ``GRID_STEP_PX`` apart, which lie on pixel centres, and interpolated between.
    """

    def __init__(
        self, pair: RigPair, index: int, scene: Scene, maps: RayCache, wanted: BoolArray | None = None
    ) -> None:
        self.pair, self.index, self.camera = pair, index, pair.target.cameras[index]
        self.config, self.scene, self.maps = pair.config, scene, maps
        self.name = scene.best if pair.geometry == "auto" else pair.geometry
        # From outside, the far wall is a narrow strip with edges, which cells could step over.
        coarse = min(self.camera.size) >= SMALL_SIDE_PX
        coarse &= is_within_wall(self.camera.center_m) or not GEOMETRIES[pair.geometry].has_wall
        step = GRID_STEP_PX if coarse else 1
        y, x = nodes_of(self.camera.size, step)
        self.rays = self.maps.rays(self.camera)
        rays = self.maps.of_lens(self.camera, step, lambda: self.rays.at(y, x))
        pose = self.camera.cam2ego[:3, :3].copy(), self.camera.center_m.copy()
        self.view = View(self.rays.planes, self.rays.parameters, *pose, self.rays.cone, y, x, rays, step)
        self.wanted = np.zeros((0, 0), bool) if wanted is None else some_of_cells(wanted, step)
        self._surfaces: dict[str, Surfaces] = {}
        self._alive = list[Any]()  # arrays that kernels read by their addresses
        self._measure()

    # --- the scene as images ------------------------------------------------------------------------------------------
    @cached_property
    def _directions(self) -> FloatArray:
        """Rays (ny, nx, 3) of the nodes in the ego frame."""
        rays = self.view.rays.astype(np.float64)
        return np.moveaxis((self.view.R @ rays.reshape(3, -1)).reshape(rays.shape), 0, -1)

    def _surface(self, name: str) -> Any:
        """The scene's surface of a name."""
        return self.scene.surface(name, self.pair.source.ground_z_m)

    def _seen(self, name: str) -> Surfaces:
        """A surface as the view sees it, cached by name."""
        if name in self._surfaces:
            return self._surfaces[name]
        surface = self._surface(name)
        camera, rays, memory, face = self.camera, self.rays, self.maps.memory, _NO_FACES
        if name == "infinity":
            q = memory.full(camera.size, 0, np.float32)
        else:
            q = np.ascontiguousarray(surface.background.image(camera, rays, memory))
        behind = on_nodes = q[self.view.y][:, self.view.x]
        if surface.is_layered:
            solid, face = surface.drawn(camera, rays, memory)
            shown = face >= 0
            np.copyto(q, solid, where=shown)
            face = np.ascontiguousarray(face) if shown.any() else _NO_FACES
            on_nodes = q[self.view.y][:, self.view.x]
        uncertainty = surface.uncertainty(camera.center_m, self._directions, on_nodes)
        if face.size:
            uncertainty = np.where(face[self.view.y][:, self.view.x] >= 0, BOX_ERROR * on_nodes, uncertainty)
        self._surfaces[name] = Surfaces(q, face, behind, uncertainty.astype(np.float32))
        return self._surfaces[name]

    def _occluders(self) -> Occluders:
        """Occluders of the scene for each source."""
        surface = self._surface(self.seen_name)
        occlusions, scales = [], []
        for k, level in self.used:
            hiding, coarser, source = OcclusionMap(_NO_IMAGE), level, self.pair.source.cameras[k]
            if not surface.is_guess and not self.is_far[k]:
                # Points hide by cells: a pixel for each is enough. Silhouettes of objects are sharper.
                coarser = level if surface.is_layered else max(level, occlusion_level(source))
                half = halved_camera(source, coarser) if coarser else source
                hiding = self.scene.occlusion_map(surface, half, self.maps.rays(half), self.maps.memory)
            occlusions.append(hiding)
            scales.append(0.5 ** (coarser - level))
        faces = max((len(hiding.before_m) for hiding in occlusions), default=0)
        before_m = np.zeros((len(occlusions), faces), np.float32)
        for row, hiding in zip(before_m, occlusions, strict=True):
            row[: len(hiding.before_m)] = hiding.before_m
        beyond = self._images([hiding.beyond for hiding in occlusions])
        solid = self._images([hiding.solid for hiding in occlusions])
        return Occluders(beyond, solid, np.array(scales, np.float32), before_m, bool(surface.background.is_guess))

    def _images(self, arrays: Sequence[npt.NDArray[Any]]) -> Images:
        """Arrays as ``Images``."""
        address, size = np.zeros(len(arrays), np.int64), np.zeros((len(arrays), 2), np.int64)
        for k, array in enumerate(arrays):
            if array.size:
                array = np.ascontiguousarray(array)
                self._alive.append(array)
                address[k], size[k] = array.__array_interface__["data"][0], array.shape
        return Images(address, size)

    # --- what sources see ---------------------------------------------------------------------------------------------
    def _measure(self) -> None:
        """Choose the sources that may see the view, and weigh them on its nodes."""
        from arbiview_aug.render.node_kernels import measure_nodes

        pair, m = self.pair, self.index
        asked = pair.is_exact[m] if pair.is_served[m] else np.ones(len(pair.source), bool)
        self.seen_name = "infinity" if pair.is_far[m][asked].all() else self.name
        self.is_far = pair.is_far[m] | (self.seen_name == "infinity")
        surfaces = self._seen(self.seen_name)
        asked = asked & ~look_apart(pair.gaps[m], pair.baselines_m[m], float(surfaces.q.max()))
        # In content order, so that ties never depend on the order of the source list.
        self.sources = [k for k in pair.order if asked[k]]
        self._read = self._read_sources()
        shape = len(self.sources), *surfaces.behind.shape
        score, border, parallax, resolution = np.empty((4, *shape), np.float32)
        self.nodes = Nodes(score, border, parallax, resolution, np.empty(shape, bool), np.empty(shape[0], np.int64))
        measure_nodes(self.view, self._read, surfaces, self.config.antialias, self.nodes)
        seen = np.flatnonzero(self.nodes.halvings >= 0)
        if len(seen) < len(self.sources):
            self.nodes, self._read = _at(self.nodes, seen), _at(self._read, seen)
            self.sources = [self.sources[i] for i in seen]
        self.levels = self.nodes.halvings.tolist()

    @property
    def used(self) -> list[tuple[int, int]]:
        """Numbers of the sources that may see the view, in content order, and halvings of their images."""
        return list(zip(self.sources, self.levels, strict=True))

    def _read_sources(self) -> Sources:
        """The sources at full size as ``Sources``, without places in an atlas."""
        pair, m, k = self.pair, self.index, np.array(self.sources, np.int64)
        A, o, offset_m = (part[m, k] for part in pair.poses)
        o *= ~self.is_far[k][:, None]
        bonus = np.where(pair.is_exact[m, k], PRIMARY_BONUS, 1).astype(np.float32)
        none = Images(np.zeros(len(k), np.int64), np.zeros((len(k), 2), np.int64))
        to_mask = self._images([self.maps.to_mask(pair.source.cameras[i]) for i in self.sources])
        (kind, parameters, size, bounds), slots = (part[k] for part in pair.lenses), np.zeros((len(k), 3), np.int32)
        return Sources(A, o, kind, parameters, size, bounds, offset_m, bonus, slots, to_mask, none)

    def _placed_sources(self, layout: AtlasLayout) -> Sources:
        """The sources as they are read: some halved, and with their places in an atlas."""
        read, clean = self._read, list[npt.NDArray[Any]]()
        for i, (k, level) in enumerate(self.used):
            camera, slot = self.pair.source.cameras[k], layout.slot(k, level)
            read.slot[i] = slot.source, slot.x, slot.y
            clean.append(self.maps.clean_pixels(camera, level))
            if level:
                read.P[i], read.bounds[i] = camera.parameters_at(0.5**level), source_bounds(camera.size, level)
        return read._replace(clean=self._images(clean))

    # --- who wins -----------------------------------------------------------------------------------------------------
    def finish(self, layout: AtlasLayout) -> ViewPlan:
        """Winners, maps into the atlas, and blended pixels."""
        from arbiview_aug.render.kernels import BLOCK_PX, FLOAT_ROWS, INT_ROWS, plan_pixels, see_nodes
        from arbiview_aug.render.paint_kernels import find_paint

        size, memory, view, surfaces = self.camera.size, self.maps.memory, self.view, self._seen(self.seen_name)
        sources, occluders = self._placed_sources(layout), self._occluders()
        most = max(size[1], view.step * BLOCK_PX, len(view.x))
        scratch = np.empty((FLOAT_ROWS, most), np.float32), np.empty((INT_ROWS, most), np.int32)
        hides = bool(sources.clean.size.any() or occluders.beyond.size.any())
        if hides:
            see_nodes(view, sources, surfaces, occluders, self.nodes, *scratch)
        xy, frac, winner = memory.empties(size, np.int32, np.uint16, np.int8)
        at = FixedMap(xy.view(np.int16).reshape(*size, 2), frac)
        most_blended = winner.size if self.config.seam_width and len(self.sources) > 1 else 0
        seconds = memory.empties((most_blended,), np.int64, np.int32, np.float32, np.uint16, np.int8)
        in_image, won_px = memory.empty(size if hides else (0, 0), np.uint8), np.zeros(128, np.int64)
        outputs: list[Any] = [winner, xy, frac, np.zeros(1, np.int64), *seconds, in_image, won_px]
        pixels = Pixels(*outputs)
        sets = np.empty((2, len(view.x) - 1), np.int64)
        weights = self._weights(), self.nodes.near
        plan_pixels(view, sources, surfaces, occluders, *weights, self.wanted, pixels, *scratch, sets)
        pixel, to_xy, weight, to_frac, number = (part[: int(pixels.count[0])].copy() for part in seconds)
        seam = Seam(pixel, number, FixedMap(to_xy.view(np.int16).reshape(1, -1, 2), to_frac[None]), weight)
        certain = self._certainty(winner) if self.config.certainty else None
        interpolation = self._interpolation(won_px)
        if interpolation == "nearest":
            at, seam = at.rounded(), replace(seam, at=seam.at.rounded())
        edge = self._edge(at, winner, layout) if interpolation == "cubic" else None
        measured = None
        if self.name in self._surfaces and not self._surface(self.name).is_guess:
            measured = self._seen(self.name).q
        reports = tuple(self._reports(winner, won_px))
        plan = ViewPlan(at, winner, seam, reports, interpolation, certain, edge, measured=measured)
        if not self.config.layers or won_px.sum() == winner.size:
            return plan
        layers = ((winner < 0) & (in_image > 0)).view(np.uint8) if hides else np.zeros(size, np.uint8)
        # The asked geometry only if a source needed it: else the scene may not have it.
        name = self.name if self.name in self._surfaces else self.scene.best
        paint = road = None
        if name != "infinity":
            surfaces = self._seen(name)
            down = self._directions[..., 2] / np.maximum(surfaces.behind, np.float32(1e-9))
            height_m = self.camera.center_m[2] - self.pair.source.ground_z_m + down
            road = np.asarray((height_m < ROAD_M) & (surfaces.behind > 0))
            if surfaces.face.size or layers.any():
                parts = self._surface(name).face_parts if surfaces.face.size else _NO_PARTS
                paint = find_paint(surfaces.q, surfaces.face, parts, winner, view.step, layers)
        return replace(plan, holes=HoleContents(layers if layers.any() else None, paint, road))

    def _weights(self) -> npt.NDArray[np.float32]:
        """Weights (K, ny, nx) of the sources: their scores, for one source or hard seams.

        A seam blends each source over its weight around the area that it wins, which fades at its own border.
        """
        from arbiview_aug.render.node_kernels import win_nodes

        width_px, view, nodes = self.config.seam_width * self.camera.width_px, self.view, self.nodes
        if width_px == 0 or len(self.sources) < 2:
            return nodes.score
        labelled = self.scene.boxes if "boxes" in GEOMETRIES[self.pair.geometry].reads else None
        boxes = np.zeros((0, 7)) if labelled is None else labelled[:, :7]
        near_last = np.argsort(-((boxes[:, :3] - view.center_m) ** 2).sum(axis=-1), kind="stable")
        winner, side = np.empty(nodes.score.shape[1:], np.int8), 2 * max(1, round(width_px / view.step / 2)) + 1
        win_nodes(view, nodes, boxes[near_last], winner)
        weights = np.clip(nodes.border / np.float32(width_px), 0, 1)
        for k, weight in enumerate(weights):
            soft = (winner == k).astype(np.float32)
            for _ in range(2):  # two passes of a box make a smooth ramp
                soft = cv2.blur(soft, (side, side), borderType=cv2.BORDER_REPLICATE)
            weight *= soft
        return weights

    def _certainty(self, winner: npt.NDArray[np.int8]) -> npt.NDArray[np.uint8]:
        """``confidence.certainty`` (h, w) of the winning sources in 255ths."""
        from arbiview_aug.scene.kernels import upsample_where

        certain, nodes = self.maps.memory.full(winner.shape, 0, np.uint8), self.nodes
        share = 255 * certainty(nodes.parallax / float(self.camera.K[0, 0]), nodes.resolution)
        for i, k in enumerate(self.sources):
            upsample_where(_filled(share[i], nodes.near[i]), self.view.step, winner, k, certain)
        return certain

    def _interpolation(self, won_px: npt.NDArray[np.int64]) -> str:
        """Cubic if requested and if the view magnifies, by ``MAGNIFIED``, sources at its own centre."""
        if self.config.interpolation != "cubic":
            return self.config.interpolation
        won, total = 0, 0.0
        for i, k in enumerate(self.sources):
            if self.pair.is_exact[self.index, k] and won_px[k]:
                resolution = np.sort(self.nodes.resolution[i][self.nodes.border[i] > 0])
                fineness = resolution[len(resolution) // 2] / 2 ** self.levels[i] if len(resolution) else 1.0
                won, total = won + won_px[k], total + fineness * won_px[k]
        most = 2 * won > won_px.sum()
        return "cubic" if most and total <= MAGNIFIED * won else "linear"

    def _edge(self, fixed: FixedMap, winner: npt.NDArray[np.int8], layout: AtlasLayout) -> npt.NDArray[np.int64]:
        """Pixels whose 4 x 4 cubic taps, from one pixel before ``fixed.xy``, leave the source or touch its mask."""
        edge = np.zeros(winner.shape, np.uint8)
        for k, level in self.used:
            slot = layout.slot(k, level)
            h, w = slot.size
            won: Any = cv2.inRange(winner, k, k)  # type: ignore[call-overload]
            low, high = (slot.x + 1, slot.y + 1), (slot.x + w - 3, slot.y + h - 3)
            inside: Any = cv2.inRange(fixed.xy, low, high)  # type: ignore[call-overload]
            clean = self.maps.clean_pixels(self.pair.source.cameras[k], level)
            if clean.size:
                clean = np.asarray(cv2.erode(clean, np.ones((4, 4), np.uint8), anchor=(1, 1)), np.uint8)
                at = fixed.xy - np.array([slot.x, slot.y], np.int16)
                inside &= cv2.remap(clean, at, None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
            cv2.bitwise_or(edge, cv2.bitwise_and(won, cv2.bitwise_not(inside)), dst=edge)
        return np.flatnonzero(edge)

    def _reports(self, winner: npt.NDArray[np.int8], won_px: npt.NDArray[np.int64]) -> Iterator[SourceUse]:
        """Summaries of the sources that win any pixel, largest share first."""
        some, baselines_m = 2 if self.view.step > 1 else 1, self.pair.baselines_m[self.index]  # of the nodes
        on_nodes = winner[self.view.y[::some]][:, self.view.x[::some]]
        for i in sorted(range(len(self.sources)), key=lambda i: -won_px[self.sources[i]]):
            k = self.sources[i]
            if won_px[k] == 0:
                continue
            won = np.sort(self.nodes.parallax[i, ::some, ::some][on_nodes == k])
            middle_px = float(won[(won.size - 1) // 2] + won[won.size // 2]) / 2 if won.size else 0.0
            yield SourceUse(
                source=k,
                surface="infinity" if self.is_far[k] else self.name,
                reason=self._reason(baselines_m[k]),
                baseline_m=float(baselines_m[k]),
                parallax_px=middle_px,
                share=int(won_px[k]) / winner.size,
                level=self.levels[i],
            )

    def _reason(self, baseline_m: float) -> str:
        """Why a source at this distance is read over its surface."""
        worst_px = worst_parallax_px(baseline_m, float(self.camera.K[0, 0]))
        if baseline_m < SAME_CENTER_M:
            return "centres coincide: exact"
        if self.pair.geometry != "auto":
            return "asked for"
        if worst_px < FAR_PARALLAX_PX:
            return f"worst-case parallax {worst_px:.2f} px"
        return f"centres {baseline_m:.2f} m apart"


@lru_cache(32)
def nodes_of(size: tuple[int, int], step: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Rows (ny,) and columns (nx,) of the nodes in an image (h, w): the corners of its cells.

    The outermost nodes lie half a cell inside: a magnified source does not see the outermost pixels.
    """
    inset = step // 2
    y, x = (np.arange(0, n + step, step).clip(inset, n - 1 - inset) for n in size)
    return y, x


@lru_cache(32)  # all targets need the same cameras
def halved_camera(camera: Camera, level: int) -> Camera:
    """The camera of an image that was halved ``level`` times, at least once."""
    h, w = level_size(camera.size, level)
    return camera.crop(0, 0, (h << level, w << level)).resize((h, w))


def _at(rows: Any, k: npt.NDArray[np.int64]) -> Any:
    """Rows k of all arrays in a structure of arrays."""
    return type(rows)(*(_at(part, k) if isinstance(part, tuple) else part[k] for part in rows))


def _filled(values: FloatArray, valid: BoolArray) -> npt.NDArray[np.float32]:
    """Values on the nodes; invalid ones take the mean of their neighbours."""
    if valid.all():
        return values.astype(np.float32)
    known = np.where(valid, values, 0).astype(np.float32)
    total, count = (cv2.blur(p, (5, 5), borderType=cv2.BORDER_REPLICATE) for p in (known, valid.astype(np.float32)))
    return np.where(valid, known, total / np.maximum(count, np.float32(1e-6)))


# --- all views of a rig -----------------------------------------------------------------------------------------------
def build_plan(
    source: Rig,
    target: Rig,
    *,
    geometry: str = "auto",
    config: RenderConfig | None = None,
    scene: Scene | None = None,
    maps: RayCache | None = None,
    wanted: Sequence[BoolArray | None] | None = None,
) -> RenderPlan:
    """Plan how ``target`` is rendered from ``source``'s images.

    Args:
        source: The rig that recorded the images.
        target: The rig to render, in its own ego frame: the two roads are made to coincide.
        geometry: A name in ``GEOMETRIES``; ``auto``: for each pair of cameras ``infinity`` where their centres
            coincide or the worst-case parallax is below ``FAR_PARALLAX_PX``, else the scene's best.
        config: Settings; the ``fast`` preset by default.
        scene: Known geometry, in the source's ego frame.
        maps: Rays and masks of cameras, to be reused by later plans.
        wanted: (h, w) pixels of each target to plan; all by default.

    Returns:
        The plan. Targets that no source sees have zero coverage.
    """
    pair = RigPair(source, target.in_frame_of(source), geometry, config or RenderConfig())
    return plan_pair(pair, scene or Scene(), maps or RayCache(), wanted)


def plan_pair(
    pair: RigPair, scene: Scene, maps: RayCache, wanted: Sequence[BoolArray | None] | None = None
) -> RenderPlan:
    """As ``build_plan``, for a pair of rigs in one ego frame."""
    with compilation_announced():
        # Cameras at one centre share panoramas: content order keeps results independent of the targets' order.
        order = content_order(pair.target.cameras)
        planners = {k: ViewPlanner(pair, k, scene, maps, None if wanted is None else wanted[k]) for k in order}
        used = {(k, source) for k, planner in planners.items() for source in planner.used}
        layout = AtlasLayout.for_sources(pair.source.sizes, [source for _, source in used])
        views = {k: planner.finish(layout) for k, planner in planners.items()}
        # Images that win no pixel are not copied; the others keep their places.
        read = {source for k, source in used if source[0] in views[k].sources}
        layout = AtlasLayout(tuple(slot for slot in layout.slots if (slot.source, slot.level) in read))
        return RenderPlan(pair.source, pair.target, layout, tuple(views[k] for k in range(len(views))), pair.config)


def warm_up() -> None:
    """Compile the kernels of cameras and of plans over objects, or load them from numba's cache."""
    from arbiview_aug.render.photometry_kernels import read_ahead

    left, middle, right = (
        Camera.looking(
            name=f"{side}", azimuth_deg=20 * side, position_m=(0, 0.3 * side, 1.5), width_px=32, height_px=32,
            horizontal_fov_deg=90, lens="fisheye", distortion=(0.0,) * 4,
        )
        for side in (-1, 0, 1)
    )  # fmt: skip
    boxes = np.array([[8.5, 0, 1, 1, 4, 2, 0], [5, 3, 1, 1, 1, 2, 0]])
    source = Rig([replace(camera, mask=np.eye(32, dtype=bool) < 1) for camera in (left, right)])
    target = Rig([middle])
    scene, config = Scene(boxes=boxes), RenderConfig(certainty=True)
    for surface in ("ground", "boxes"):
        plan = build_plan(source, target, geometry=surface, config=config, scene=scene)
    read_ahead(np.zeros((1, 3), np.uint8), 3, plan.targets[0].at.packed, plan.targets[0].source_camera)
    edge_distance(middle, np.zeros((1, 2)))
