"""How a rig is rendered: which sources see each target view, over which surface, and who wins each pixel.

Compiled code evaluates every pixel (``arbiview_aug.render.kernels``), fast enough for calibrations or geometry that
change with every frame.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray, LensName
from arbiview_aug.cameras.rays import (
    CELL_PX,
    MAX_INVERSE_DISTANCE,
    RayCache,
    look_apart,
    relative_pose,
    source_pixels,
)
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.environment import compilation_announced
from arbiview_aug.image_ops import at_level, level_size, some_of_cells
from arbiview_aug.render.confidence import certainty
from arbiview_aug.render.plan import (
    GRID_STEP_PX,
    ROAD_M,
    AtlasLayout,
    FixedMap,
    RenderConfig,
    RenderPlan,
    SourceUse,
    ViewPlan,
)
from arbiview_aug.render.requirements import SAME_CENTER_M
from arbiview_aug.render.weights import SecondBest, seam_weights, source_weight
from arbiview_aug.scene.boxes import BOX_ERROR
from arbiview_aug.scene.point_cloud import occlusion_level
from arbiview_aug.scene.scene import GEOMETRIES, Scene
from arbiview_aug.scene.surface import FAR_PARALLAX_PX, OcclusionMap, is_within_wall, worst_parallax_px

SMALL_SIDE_PX = 64  # weights of targets with a shorter side are evaluated at every pixel
_NO_PARTS = np.zeros(0, np.int32)
_SLACK_PX, _ROUNDING = 1e-3, 5e-7  # a pixel on the very border must not drop out by a rounding of float32
MAGNIFIED = 0.8
"""A view is read by cubics where it has at most this many source pixels per pixel, and is mostly read at its own
centre: docs/benchmarks.md (Ablation)."""


@dataclass(frozen=True)
class _Geometry:
    """A surface as a target sees it.

    Attributes:
        surface: The surface.
        q: (h, w) float32 inverse distances along the pixels' rays, 1/m.
        face: (h, w) int32 faces of solids in front of the background, -1 elsewhere; (0, 0) without any.
        on_nodes: (ny + 1, nx + 1) ``q`` on the nodes.
        face_on_nodes: (ny + 1, nx + 1) ``face`` there.
        behind: (ny + 1, nx + 1) float32 inverse distances of the background on the nodes.
        nearest: (ny, nx) float32 largest inverse distance in each cell.
        farthest: (ny, nx) float32 least inverse distance in each cell.
        uncertainty: (ny + 1, nx + 1) expected error of the inverse distance on the nodes, 1/m.
        apart: Whether each source looks elsewhere.
        is_guess: Whether its background was not measured.
    """

    surface: Any
    q: npt.NDArray[np.float32]
    face: npt.NDArray[np.int32]
    on_nodes: npt.NDArray[np.float32]
    face_on_nodes: npt.NDArray[np.int32]
    behind: npt.NDArray[np.float32]
    nearest: npt.NDArray[np.float32]
    farthest: npt.NDArray[np.float32]
    uncertainty: FloatArray
    apart: list[bool]
    is_guess: bool


@dataclass
class _Region:
    """Contribution of one source to one target; all arrays on the nodes (ny + 1, nx + 1)."""

    source: int
    level: int
    surface: str
    reason: str
    baseline_m: float
    geometry: _Geometry
    columns: npt.NDArray[np.int64]  # (ny, 2) first and last (exclusive) cell in view of each row of cells
    kernel: tuple[Any, ...]
    hides: bool  # whether occluders or a mask may hide what lies in the source's image
    score: npt.NDArray[np.float32]  # stage-4 weight, 0 where not visible
    parallax: npt.NDArray[np.float32]  # expected displacement, target pixels
    border_px: npt.NDArray[np.float32]  # distance to the border of what the source sees, target pixels
    fineness: float  # median of the pixels, as they are read, per target pixel
    certainty: npt.NDArray[np.float32] | None  # in 255ths, if asked for


class ViewPlanner:
    """Builds one target's plan in two steps: what each source sees, then who wins and where ``seams`` are blended.

    Positions, visibility and winners are evaluated at every pixel (``kernels``). Weights are smooth: they are known on
    nodes ``GRID_STEP_PX`` apart, which lie on pixel centres, and interpolated between.
    """

    def __init__(
        self,
        source: Rig,
        order: list[int],
        camera: Camera,
        surface: str,
        scene: Scene,
        config: RenderConfig,
        maps: RayCache,
        wanted: BoolArray | None = None,
    ) -> None:
        self.sources, self.camera, self.surface, self.config = source.cameras, camera, surface, config
        self.scene, self.ground_z_m, self.maps = scene, source.ground_z_m, maps
        self.baselines_m = [math.dist(camera.center_m, one.center_m) for one in self.sources]
        self.parallax_px = worst_parallax_px(np.array(self.baselines_m), float(camera.K[0, 0]))
        self.rays = maps.rays(camera)
        # From outside, the far wall is a narrow strip with edges, which cells could step over.
        coarse = min(camera.size) >= SMALL_SIDE_PX
        coarse &= is_within_wall(camera.center_m) or not GEOMETRIES[surface].has_wall
        self.step = GRID_STEP_PX if coarse else 1
        corners, self.nodes = nodes_of(camera.size, self.step)
        y, x = self.nodes
        self.at_nodes = y[:, None], x[None]
        self.corner_rays, self.node_rays = maps.of_lens(
            camera, self.step, lambda: np.stack([continued(self.rays.at(*corners)), self.rays.at(y, x)])
        )
        self._geometries: dict[str, _Geometry] = {}
        # Cells that sources elsewhere may change: none without a ray.
        self._open = _whole_cells(self.corner_rays.any(axis=0))
        self._wanted = None if wanted is None else some_of_cells(wanted, self.step)
        exact = {k: self._region(k) for k in order if self.baselines_m[k] < SAME_CENTER_M}
        for one in filter(None, exact.values()):
            self._open = self._open & self._around_unseen(one)
        if any(exact.values()):  # however far the scene is
            near, far = (np.full(self._open.shape, q, np.float32) for q in (MAX_INVERSE_DISTANCE, 0))
            seen, cells = np.zeros_like(self._open), np.arange(self._open.shape[1])
            for k in set(order) - set(exact):
                first, last = self._in_view(self.sources[k], self._projection(self.sources[k]), near, far).T
                seen |= (first[:, None] <= cells) & (cells < last[:, None])
            self._open = seen
        regions = exact | {k: self._region(k) for k in order if k not in exact}
        # In content order, so that ties never depend on the order of the source list.
        self.regions = [region for k in order if (region := regions[k]) is not None]

    # --- what a source sees -------------------------------------------------------------------------------------------
    def _choose_surface(self, index: int) -> tuple[str, str]:
        baseline_m, worst = self.baselines_m[index], self.parallax_px[index]
        if baseline_m < SAME_CENTER_M:
            return "infinity", "centres coincide: exact"
        if self.surface != "auto":
            return self.surface, "asked for"
        if worst < FAR_PARALLAX_PX:
            return "infinity", f"worst-case parallax {worst:.2f} px"
        return self.scene.best, f"centres {baseline_m:.2f} m apart"

    def _around_unseen(self, region: _Region) -> BoolArray:
        """Cells (ny, nx) that an exact source does not certainly win, and those around them that seams may reach."""
        from arbiview_aug.render.kernels import clear_unseen, depth_range

        whole = _whole_cells(region.score > 1)  # no weight of a source elsewhere exceeds 1
        # Borders, masks and image circles may lie between nodes.
        visible = self.maps.memory.full(self.camera.size, 1, np.float32)
        clear_unseen(*self._target(region), region.kernel, visible)
        most, least = np.empty((2, *whole.shape), np.float32)
        depth_range(visible, self.step, most, least)
        whole &= least > 0
        unseen = (~whole).astype(np.uint8)
        side = 2 * (2 * self._seam_radius + 1) + 1  # two passes of a box, and a node
        return cv2.dilate(unseen, np.ones((side, side), np.uint8)) > 0

    @property
    def _seam_radius(self) -> int:
        """Half the width of a seam, in nodes."""
        return max(1, round(self.config.seam_width * self.camera.width_px / self.step / 2))

    @cached_property
    def _directions(self) -> FloatArray:
        """Rays of the nodes in the ego frame, float64."""
        rays = self.node_rays.astype(np.float64)
        return np.moveaxis((self.camera.cam2ego[:3, :3] @ rays.reshape(3, -1)).reshape(rays.shape), 0, -1)

    def _geometry(self, name: str) -> _Geometry:
        """A surface where sources elsewhere may matter, infinity beyond; all of it where holes show it."""
        if name in self._geometries:
            return self._geometries[name]
        from arbiview_aug.render.kernels import depth_range

        surface: Any = self.scene.surface(name, self.ground_z_m)
        background = surface.background
        center, memory = self.camera.center_m, self.maps.memory
        size = np.repeat(self.camera.size, 2)
        rows, columns = (np.flatnonzero((self._open | self.config.layers).any(axis)) for axis in (1, 0))
        cells = np.array([rows[0], rows[-1] + 1, columns[0], columns[-1] + 1])
        y0, y1, x0, x1 = np.minimum(cells * self.step + np.array([0, 1, 0, 1]), size).tolist()  # with the last nodes
        window = y0, x0, (y1 - y0, x1 - x0)
        is_whole = window[2] == self.camera.size
        camera, rays = self.camera if is_whole else self.camera.crop(*window), self.rays.crop(*window)

        def widened(image: Any, outside: float) -> Any:
            if is_whole:
                return image
            wide = memory.full(self.camera.size, outside, image.dtype)
            wide[y0:y1, x0:x1] = image
            return wide

        q = np.ascontiguousarray(widened(background.image(camera, rays, memory), 0))  # kernels know no other order
        behind = q[self.at_nodes]
        face = np.zeros((0, 0), np.int32)
        if surface.is_layered:
            solid, face = (widened(*one) for one in zip(surface.drawn(camera, rays, memory), (0, -1), strict=True))
            shown = face >= 0
            np.copyto(q, solid, where=shown)
            face = face if shown.any() else np.zeros((0, 0), np.int32)
        at_nodes = q[self.at_nodes], face[self.at_nodes] if face.size else face
        uncertainty = surface.uncertainty(center, self._directions, at_nodes[0])
        if face.size:
            uncertainty = np.where(at_nodes[1] >= 0, BOX_ERROR * at_nodes[0], uncertainty)
        nearest, farthest = np.empty((2, *self._open.shape), np.float32)
        depth_range(q, self.step, nearest, farthest)
        apart = look_apart(self.camera, self.sources, float(nearest.max()))
        if is_whole and (surface.is_layered or surface.is_dense):
            self.scene.images[name, self.camera.content_key] = q
        measured = q, face, *at_nodes, behind, nearest, farthest, uncertainty
        self._geometries[name] = _Geometry(surface, *measured, apart, background.is_guess)
        return self._geometries[name]

    def _projection(self, source: Camera) -> tuple[Any, ...]:
        """Relative pose (2 arrays), lens and parameters of a source, as kernels read them."""
        from arbiview_aug.cameras.kernels import LENS_CODES

        return *relative_pose(self.camera, source), LENS_CODES.get(source.lens, -1), source.parameters

    def _in_view(
        self, source: Camera, projection: tuple[Any, ...], nearest: Any, farthest: Any
    ) -> npt.NDArray[np.int64]:
        """First and last (exclusive) open cell (ny, 2) of each row that a source may see, by ``_Geometry``'s depths."""
        from arbiview_aug.render.kernels import cells_in_view

        size, columns = np.array(source.size, np.float32), np.empty((len(self._open), 2), np.int64)
        cells = self._open if self._wanted is None else self._open & self._wanted
        cells_in_view(self.corner_rays, nearest, farthest, *projection, size, source.cone_rad, cells, columns)
        return columns

    def _region(self, index: int) -> _Region | None:
        from arbiview_aug.cameras.kernels import FAR_AWAY_PX
        from arbiview_aug.render.kernels import clear_unseen, measure_nodes

        if not self._open.any():
            return None
        source = self.sources[index]
        baseline_m, focal_px = self.baselines_m[index], float(self.camera.K[0, 0])
        name, reason = self._choose_surface(index)
        geometry = self._geometry(name)
        if geometry.apart[index]:
            return None
        A, o, kind, P = projection = self._projection(source)
        columns = self._in_view(source, projection, geometry.nearest, geometry.farthest)
        if not columns.any():
            return None
        uv, rounded = np.empty((2, 2, *geometry.behind.shape), np.float32)
        u, v = uv
        if kind < 0:
            u, v = source_pixels(self.camera, self.node_rays, geometry.behind, source)
        measured = np.empty((3, *u.shape))
        resolution, edge_px, parallax = measured
        offset_m = (self.camera.center_m - source.center_m) @ self.camera.cam2ego[:3, :3]
        measure_nodes(
            self.node_rays, geometry.behind, A, o, kind, P, *self.nodes, source.size, self.maps.to_mask(source),
            CELL_PX, offset_m, geometry.uncertainty, focal_px, u, v, measured, rounded,
        )  # fmt: skip
        most = np.sort(resolution[edge_px > 0][::4])  # pixels that it cannot project lie far outside
        level = halvings(most[len(most) // 5], source.size) if self.config.antialias and len(most) else 0
        kernel, hides = self._kernel(source, level, geometry, A, o, P)
        positions = np.ascontiguousarray(kernel[-1][(slice(None), *self.at_nodes)]) if kind < 0 else kernel[-1]
        is_primary = baseline_m < SAME_CENTER_M
        score = source_weight(edge_px, min(source.size) / 2, parallax, resolution, is_primary).astype(np.float32)
        on_nodes = self.node_rays, self.rays.parameters, geometry.on_nodes, geometry.face_on_nodes
        clear_unseen(*on_nodes, (*kernel[:-1], positions), score)
        certain = 255 * certainty(parallax / focal_px, resolution) if self.config.certainty else None
        return _Region(
            source=index,
            level=level,
            surface=name,
            reason=reason,
            baseline_m=baseline_m,
            geometry=geometry,
            columns=columns,
            kernel=kernel,
            hides=hides,
            score=score,
            parallax=rounded[0],
            border_px=rounded[1],
            fineness=float(most[len(most) // 2]) / 2**level if len(most) else 1.0,
            certainty=None if certain is None else _filled(certain, np.abs(u) < 0.9 * FAR_AWAY_PX),
        )

    def _kernel(
        self, source: Camera, level: int, geometry: _Geometry, A: Any, o: Any, P: Any
    ) -> tuple[tuple[Any, ...], bool]:
        """The source as ``kernels.put_source`` reads it, halved ``level`` times, and whether it has what hides."""
        from arbiview_aug.cameras.kernels import LENS_CODES

        kind, surface = LENS_CODES.get(source.lens, -1), geometry.surface
        positions = np.zeros((2, 0, 0), np.float32)
        if kind < 0:
            u, v = source_pixels(self.camera, self.rays.at(*map(np.arange, self.camera.size)), geometry.q, source)
            positions = at_level(np.stack([u, v]), level).astype(np.float32)
        occluders = OcclusionMap(np.zeros((0, 0), np.float32), np.zeros((0, 0), np.int32))
        shadow_scale = 1.0
        if surface.is_layered or surface.is_dense:
            # Points hide by cells: a pixel for each is enough. Silhouettes of objects are sharper.
            coarser = level if surface.is_layered else max(level, occlusion_level(source))
            half = halved_camera(source, coarser) if coarser else source
            occluders = surface.occlusion_map(half, self.maps.rays(half), self.maps.memory)
            shadow_scale = 0.5 ** (coarser - level)
        clean = self.maps.clean_pixels(source, level)
        kernel = (
            A,
            o,
            kind,
            source.parameters_at(0.5**level) if level else P,
            np.array([*source_bounds(source.size, level), shadow_scale], np.float32),
            clean,
            occluders.before_m,
            occluders.beyond,
            np.ascontiguousarray(occluders.solid),
            geometry.is_guess,
            positions,
        )
        return kernel, bool(clean.size or occluders.beyond.size)

    # --- who wins -----------------------------------------------------------------------------------------------------
    def finish(self, layout: AtlasLayout) -> ViewPlan:
        """Winners, maps into the atlas, and blended bands."""
        from arbiview_aug.render.kernels import put_source, upsample_where
        from arbiview_aug.render.paint_kernels import find_paint

        size, memory = self.camera.size, self.maps.memory
        fixed = FixedMap.outside(size, memory)
        packed = fixed.packed
        winner = memory.full(size, -1, np.int8)
        hides = any(region.hides for region in self.regions)
        in_image = memory.full(size if hides else (0, 0), 0, np.uint8)
        best = memory.full(size, -1, np.float32)  # a source that sees a pixel beats none, even with a weight of 0
        weights = self._weights()
        seconds = SecondBest(weights if self.config.seam_width else weights[:0], self.step, size, memory)
        for region, weight in zip(self.regions, weights, strict=True):
            slot = layout.slot(region.source, region.level)
            put_source(
                *self._target(region), region.kernel, (region.source, slot.x, slot.y), weight, self.step,
                region.columns, seconds.shared, best, winner, packed, fixed.frac, in_image, *seconds.images,
            )  # fmt: skip
        won_px = Counter({r.source: int(np.count_nonzero(winner == r.source)) for r in self.regions})
        bands = tuple(seconds.blend_regions([region.source for region in self.regions], best))
        certain = None
        if self.config.certainty:
            certain = memory.full(size, 0, np.uint8)
            for region in self.regions:
                upsample_where(region.certainty, self.step, winner, region.source, certain)
        interpolation = self._interpolation(won_px)
        if interpolation == "nearest":
            fixed, bands = fixed.rounded(), tuple(replace(band, at=band.at.rounded()) for band in bands)
        edge = self._edge(fixed, winner, layout) if interpolation == "cubic" else None
        reports = tuple(self._reports(winner, won_px))
        if not self.config.layers or sum(won_px.values()) == winner.size:
            return ViewPlan(fixed, winner, bands, reports, interpolation, certain, edge)
        layers = ((winner < 0) & (in_image > 0)).view(np.uint8) if hides else np.zeros(size, np.uint8)
        # The asked geometry only if a source needed it: else the scene may not have it.
        name = self.surface if self.surface in self._geometries else self.scene.best
        paint = road = None
        if name != "infinity":
            geometry = self._geometry(name)
            road = self._road(geometry.behind)
            if geometry.face.size or layers.any():
                parts = geometry.surface.face_parts if geometry.face.size else _NO_PARTS
                paint = find_paint(geometry.q, geometry.face, parts, winner, self.step, layers)
        marked = layers if layers.any() else None
        return ViewPlan(fixed, winner, bands, reports, interpolation, certain, edge, marked, paint, road)

    def _road(self, behind: npt.NDArray[np.float32]) -> BoolArray:
        """The nodes (ny + 1, nx + 1) behind which the road lies, by inverse distances of the background."""
        down = self._directions[..., 2] / np.maximum(behind, np.float32(1e-9))
        height_m = self.camera.center_m[2] - self.ground_z_m + down
        return np.asarray((height_m < ROAD_M) & (behind > 0))

    def _weights(self) -> npt.NDArray[np.float32]:
        """Weights (K, ny + 1, nx + 1) of the sources: their scores, for one source or hard seams."""
        from arbiview_aug.render.kernels import win_nodes

        width_px = self.config.seam_width * self.camera.width_px
        scores = np.array([region.score for region in self.regions], np.float32).reshape(-1, *self.node_rays.shape[1:])
        if width_px == 0 or len(scores) < 2:
            return scores
        parallax, border_px = (
            np.array([getattr(region, name) for region in self.regions]) for name in ("parallax", "border_px")
        )
        labelled = self.scene.boxes if "boxes" in GEOMETRIES[self.surface].reads else None
        boxes = np.zeros((0, 7)) if labelled is None else labelled[:, :7]
        near_last = np.argsort(-np.linalg.norm(boxes[:, :3] - self.camera.center_m, axis=-1), kind="stable")
        pose = np.ascontiguousarray(self.camera.center_m), np.ascontiguousarray(self.camera.cam2ego[:3, :3])
        node_rad, winner = self.step / float(self.camera.K[0, 0]), np.empty(scores.shape[1:], np.int8)
        win_nodes(scores, parallax, boxes[near_last], *pose, self.node_rays, self.rays.cone, node_rad, winner)
        return seam_weights(winner, border_px, self._seam_radius, width_px)

    def _target(self, region: _Region) -> tuple[Any, Any, Any, Any]:
        return self.rays.planes, self.rays.parameters, region.geometry.q, region.geometry.face

    def _interpolation(self, won_px: Counter[int]) -> str:
        """Cubic where it is asked for and the view magnifies, by ``MAGNIFIED``, what lies at its own centre."""
        if self.config.interpolation != "cubic":
            return self.config.interpolation
        exact = [region for region in self.regions if region.baseline_m < SAME_CENTER_M]
        won = sum(won_px[region.source] for region in exact)
        total = sum(region.fineness * won_px[region.source] for region in exact)
        most = 2 * won > sum(won_px.values())
        return "cubic" if most and total <= MAGNIFIED * won else "linear"

    def _edge(self, fixed: FixedMap, winner: npt.NDArray[np.int8], layout: AtlasLayout) -> npt.NDArray[np.int64]:
        """The pixels whose cubics, 4 x 4 pixels from one before ``fixed.xy``, leave the source or touch its mask."""
        edge = np.zeros(winner.shape, np.uint8)
        for region in self.regions:
            slot = layout.slot(region.source, region.level)
            (h, w), source = slot.size, self.sources[region.source]
            own_pixels: Any = cv2.inRange(winner, region.source, region.source)  # type: ignore[call-overload]
            low, high = (slot.x + 1, slot.y + 1), (slot.x + w - 3, slot.y + h - 3)
            inside: Any = cv2.inRange(fixed.xy, low, high)  # type: ignore[call-overload]
            clean = self.maps.clean_pixels(source, region.level)
            if clean.size:
                clean = np.asarray(cv2.erode(clean, np.ones((4, 4), np.uint8), anchor=(1, 1)), np.uint8)
                at = fixed.xy - np.array([slot.x, slot.y], np.int16)
                inside &= cv2.remap(clean, at, None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
            cv2.bitwise_or(edge, cv2.bitwise_and(own_pixels, cv2.bitwise_not(inside)), dst=edge)
        return np.flatnonzero(edge)

    def _reports(self, winner: npt.NDArray[np.int8], won_px: Counter[int]) -> Iterator[SourceUse]:
        """Summaries of the sources that win any pixel, largest share first."""
        on_nodes = winner[self.at_nodes]
        for region in sorted(self.regions, key=lambda r: -won_px[r.source]):
            if won_px[region.source] == 0:
                continue
            won = np.sort(region.parallax[on_nodes == region.source])
            middle_px = float(won[(won.size - 1) // 2] + won[won.size // 2]) / 2 if won.size else 0.0
            yield SourceUse(
                source=region.source,
                surface=region.surface,
                reason=region.reason,
                baseline_m=region.baseline_m,
                parallax_px=middle_px,
                share=won_px[region.source] / winner.size,
                level=region.level,
            )


@lru_cache(32)
def nodes_of(size: tuple[int, int], step: int) -> tuple[list[npt.NDArray[np.int64]], list[npt.NDArray[np.int64]]]:
    """Rows and columns of the corners of cells in an image (h, w), the last ones its last; and of nodes.

    The outermost nodes lie half a cell inside: a magnified source does not see the outermost pixels.
    """
    corners, inset = [np.minimum(np.arange(0, n + step, step), n - 1) for n in size], step // 2
    return corners, [corner.clip(inset, n - 1 - inset) for corner, n in zip(corners, size, strict=True)]


def _whole_cells(on_nodes: BoolArray) -> BoolArray:
    """Cells (ny, nx) of which all four nodes (ny + 1, nx + 1) are True."""
    return on_nodes[1:, 1:] & on_nodes[1:, :-1] & on_nodes[:-1, 1:] & on_nodes[:-1, :-1]


def halvings(resolution: float, size: tuple[int, int]) -> int:
    """How many times an image of (h, w) that is minified by ``resolution`` is halved: at least 2 pixels remain."""
    # 2 % of tolerance: a target of exactly half size must read the halved source.
    level = int(max(0, math.floor(math.log2(max(1.02 * resolution, 1e-6)))))
    while level and min(level_size(size, level)) < 2:
        level -= 1
    return level


@lru_cache(32)
def source_bounds(full: tuple[int, int], level: int) -> tuple[float, ...]:
    """Least and largest columns and rows of what an image (h, w) halved ``level`` times shows; its last ones, or -1."""
    (h, w), scale = level_size(full, level), 0.5**level
    slack_px = _SLACK_PX + _ROUNDING * max(full)
    first, *last = ((side + 0.5) * scale - 0.5 for side in (-slack_px, full[1] - 1 + slack_px, full[0] - 1 + slack_px))
    # Halving leaves out the last row or column of an odd size: nothing is known there.
    right, bottom = min(last[0], w - 0.5), min(last[1], h - 0.5)
    return first, first, right, bottom, *((w - 1, h - 1) if level else (-1, -1))


@lru_cache(32)  # all targets ask for the same ones
def halved_camera(camera: Camera, level: int) -> Camera:
    """The camera of an image that was halved ``level`` times, at least once."""
    h, w = level_size(camera.size, level)
    return camera.crop(0, 0, (h << level, w << level)).resize((h, w))


def continued(rays: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Rays (3, ny, nx) of nodes, those up to two nodes outside a lens's image circle as if it went on.

    Lenses turn fast at their rim: rays go on four times as fast, and the cells there hold all of their pixels' rays.
    """
    (ny, nx), known = rays.shape[1:], rays.any(axis=0)
    for _ in range(0 if known.all() else 2):
        wide, further = np.pad(rays, ((0, 0), (2, 2), (2, 2))), np.zeros_like(rays)
        for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            one, two = (wide[:, 2 + k * dy : 2 + k * dy + ny, 2 + k * dx : 2 + k * dx + nx] for k in (1, 2))
            further += one.any(axis=0) * np.where(two.any(axis=0), 5 * one - 4 * two, one)
        length = np.linalg.norm(further, axis=0)
        rays = np.where(rays.any(axis=0), rays, further / np.maximum(length, np.float32(1e-30)))
    return rays


def _filled(values: FloatArray, valid: BoolArray) -> npt.NDArray[np.float32]:
    """Values on the nodes; those that are not valid take the mean of those around them."""
    if valid.all():
        return values.astype(np.float32)
    known = np.where(valid, values, 0).astype(np.float32)
    total, count = (cv2.blur(p, (5, 5), borderType=cv2.BORDER_REPLICATE) for p in (known, valid.astype(np.float32)))
    return np.where(valid, known, total / np.maximum(count, np.float32(1e-6)))


# --- all views of a rig -----------------------------------------------------------------------------------------------
def plan_key(source: Rig, target: Rig, surface: str, config: RenderConfig, scene: Scene | None = None) -> bytes:
    """Content key of a plan: calibrations with names, which ``explain`` shows, scene, surface and settings."""
    settings = tuple(getattr(config, f.name) for f in fields(config))
    geometry = (scene or Scene()).key
    return hashlib.sha256(repr((source.named_key, target.named_key, surface, settings, geometry)).encode()).digest()


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
        wanted: (h, w) pixels of each target that must be planned, in place of all.

    Returns:
        The plan. Targets that no source sees have zero coverage.
    """
    with compilation_announced():
        config, scene, maps = config or RenderConfig(), scene or Scene(), maps or RayCache()
        target = target.in_frame_of(source)
        return _built(source, target, geometry, config, scene, maps, wanted or [None] * len(target))


def warm_up() -> None:
    """Compile the kernels of cameras and of plans over objects, or load them from numba's cache."""
    from arbiview_aug.render.kernels import read_ahead

    # A lens without and one with an array of rays: kernels are compiled once for all lenses.
    lenses: tuple[tuple[LensName, tuple[float, ...]], ...] = ("pinhole", ()), ("fisheye", (0.0,) * 4)
    views = [
        Camera.looking(
            name=f"{lens} {side}", azimuth_deg=20 * side, position_m=(0, 0.3 * side, 1.5), width_px=32, height_px=32,
            horizontal_fov_deg=90, lens=lens, distortion=distortion,
        )
        for lens, distortion in lenses for side in (-1, 0, 1)
    ]  # fmt: skip
    boxes = np.array([[8.5, 0, 1, 1, 4, 2, 0], [5, 3, 1, 1, 1, 2, 0]])
    source = Rig(
        [replace(camera, mask=np.eye(32, dtype=bool) < 1) for camera in views if not camera.name.endswith("0")]
    )
    target = Rig([camera for camera in views if camera.name.endswith("0")])
    scene, config = Scene(boxes=boxes), RenderConfig(certainty=True)
    for surface in ("ground", "boxes"):
        plan = build_plan(source, target, geometry=surface, config=config, scene=scene)
    read_ahead(np.zeros((1, 3), np.uint8), 3, plan.targets[0].at.packed, plan.targets[0].source_camera)


def _built(
    source: Rig,
    target: Rig,
    surface: str,
    config: RenderConfig,
    scene: Scene,
    maps: RayCache,
    wanted: Sequence[BoolArray | None],
) -> RenderPlan:
    order = content_order(source.cameras)
    # Targets at one centre share panoramas: their order must not tell which of them makes one.
    by_target = {
        k: ViewPlanner(source, order, target[k], surface, scene, config, maps, wanted[k])
        for k in content_order(target.cameras)
    }
    planners = [by_target[k] for k in range(len(target))]
    used = [(region.source, region.level) for planner in planners for region in planner.regions]
    layout = AtlasLayout.for_sources(source.sizes, used)
    targets = tuple(planner.finish(layout) for planner in planners)
    read = set[tuple[int, int]]()
    for planner, view in zip(planners, targets, strict=True):
        sources = view.sources
        read |= {(region.source, region.level) for region in planner.regions if region.source in sources}
    # The same places for what is read: images that win no pixel are not copied.
    layout = AtlasLayout(tuple(slot for slot in layout.slots if (slot.source, slot.level) in read))
    return RenderPlan(source, target, layout, targets, config)
