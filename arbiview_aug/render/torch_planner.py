"""Plans made on a device: the steps of ``ViewPlanner`` as tensor code, for a batch of frames of any calibrations.

Views of one size and surface are planned together; the only loop is over the sources of a view. A few numbers for each
view are read back, which decide what is read and how: images, points and maps stay on the device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.kernels import FAR_AWAY_PX, LENS_CODES, camera_parameters
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.projection import look_apart
from arbiview_aug.cameras.rays import CELL_PX, CameraMaps, clean_pixels, distance_to_mask
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.cameras.torch_rays import TINY, length, on_device, pixel_rays, projected, turned
from arbiview_aug.favs.config import FavsConfig
from arbiview_aug.image_ops import level_size
from arbiview_aug.render.atlas import OUTSIDE, AtlasLayout
from arbiview_aug.render.confidence import DECORRELATION_RAD, RESOLUTION_POWER
from arbiview_aug.render.kernels import LEAST_INCIDENCE, MAP_LIMIT_PX, SAME_OBJECT_M, WHOLE
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.requirements import SAME_CENTER_M
from arbiview_aug.render.seams import LEAST_SHARE
from arbiview_aug.render.torch_backend import Blend, ViewMaps
from arbiview_aug.render.view_plan import NEARER, OBJECT, Paint, nearer_cells
from arbiview_aug.render.view_planner import (
    MAGNIFIED,
    SMALL_SIDE_PX,
    halved_camera,
    halvings,
    source_bounds,
)
from arbiview_aug.scene.boxes import BOX_ERROR, UNLABELLED, BoxSurface
from arbiview_aug.scene.point_cloud import COARSE, MEASURED_SPREAD, Cells, occlusion_level
from arbiview_aug.scene.scene import SURFACES, Scene
from arbiview_aug.scene.shapes import PIECES
from arbiview_aug.scene.static import Far, is_within_wall, worst_parallax_px
from arbiview_aug.scene.torch_points import PanoramaViews, upsampled
from arbiview_aug.scene.torch_surface import (
    Poses,
    before_faces,
    candidates,
    draw_solids,
    fit_profiles,
    static_image,
    static_uncertainty,
    widened,
)

_MOST_PIXELS = 1 << 24  # of views planned at once: 64 MiB for each map
_FAR_UNCERTAINTY = 1 / 20  # of ``Surface``
_pad, _pool = torch.nn.functional.pad, torch.nn.functional.avg_pool2d


class Request(NamedTuple):
    """A frame to plan."""

    source: Rig
    target: Rig  # in the source's ego frame
    scene: Scene  # boxes and points may lie on the device, padded by rows of zeros and of NaN


def build_plans(
    requests: Sequence[Request], surface: str, config: FavsConfig, device: torch.device, maps: CameraMaps
) -> list[RenderPlan]:
    """Plan frames as ``plan.build_plan`` does, on a device: ``targets`` are empty, the maps lie there.

    Args:
        requests: The frames.
        surface: ``auto`` or a name in ``SURFACES`` that is planned on a device.
        config: Settings.
        device: Where their images lie.
        maps: Rays and masks of cameras, to be reused by later plans.
    """
    # Inference tensors could not take part in a later backward pass.
    with torch.inference_mode(False), torch.no_grad():
        groups: dict[Any, list[tuple[int, int]]] = {}
        for f, request in enumerate(requests):
            name = request.scene.best if surface == "auto" else surface
            if name == "lidar" and not len(request.scene.points):  # type: ignore[arg-type]
                name = "objects" if has_boxes(request.scene) else "street"
            with_boxes = name == "lidar" and has_boxes(request.scene)
            for m, camera in enumerate(request.target):
                coarse = min(camera.size) >= SMALL_SIDE_PX
                coarse &= is_within_wall(camera.center_m) or not SURFACES[surface].has_wall
                step = config.grid_step_px if coarse else 1
                groups.setdefault((camera.size, Cells.for_camera(camera), step, name, with_boxes), []).append((f, m))
        batches = []
        for (size, _, step, name, _), views in groups.items():
            count = max(1, _MOST_PIXELS // math.prod(size))
            for first in range(0, len(views), count):
                some = views[first : first + count]
                batches.append(_ViewBatch(requests, some, step, name, surface == "auto", config, device, maps))
        read: list[set[tuple[int, int]]] = [set() for _ in requests]
        for batch in batches:
            batch.find_winners()
            for f, pairs in zip(batch.frames, batch.read, strict=True):
                read[f].update(pairs)
        layouts = [AtlasLayout.for_sources(r.source.sizes, list(of)) for r, of in zip(requests, read, strict=True)]
        found = {view: of_view for batch in batches for view, of_view in batch.maps_into(layouts)}
        plans = []
        for f, (request, layout) in enumerate(zip(requests, layouts, strict=True)):
            plans.append(RenderPlan(request.source, request.target, layout, ()))
            plans[-1].on_devices[device] = tuple(found[f, m] for m in range(len(request.target)))
        return plans


def has_boxes(scene: Scene) -> bool:
    """Whether a scene has labelled boxes."""
    return scene.boxes is not None and len(scene.boxes) > 0


class _Bank:
    """Images of many sizes in one tensor, looked up by the sources of views (V, K).

    Args:
        images: (h, w) of each entry; None for one pixel of ``empty``.
        index: (V, K) which entry a source has.
        empty: Of the type of the images.
        device: Where they lie.
    """

    def __init__(
        self, images: Sequence[torch.Tensor | None], index: Any, empty: torch.Tensor, device: torch.device
    ) -> None:
        parts = [empty.view(1, 1).to(device) if image is None else image for image in images]
        self.is_empty = all(image is None for image in images)
        self._flat = torch.cat([part.reshape(-1) for part in parts])
        first = np.cumsum([0] + [part.numel() for part in parts[:-1]])
        rows = np.array([(n, *part.shape) for n, part in zip(first, parts, strict=True)])[index]
        self._first, self._h, self._w = on_device(rows, device)[..., None, None].unbind(2)

    def at(self, y: torch.Tensor, x: torch.Tensor, k: int | slice) -> torch.Tensor:
        """Values (..., h, w) of the sources ``k`` at their pixels nearest to y, x: whole numbers."""
        y, x = (torch.minimum(p.clamp(min=0).long(), n[:, k] - 1) for p, n in ((y, self._h), (x, self._w)))
        return self._flat[self._first[:, k] + y * self._w[:, k] + x]

    def between(self, y: torch.Tensor, x: torch.Tensor, k: int | slice) -> torch.Tensor:
        """Bilinear values (..., h, w) of the sources ``k``; their border beyond it."""
        y, x = (torch.minimum(p.clamp(min=0), n[:, k] - 1.0) for p, n in ((y, self._h), (x, self._w)))
        s, t = y - y.floor(), x - x.floor()
        above, below = (self.at(r, x, k) * (1 - t) + self.at(r, x + 1, k) * t for r in (y, y + 1))
        return above * (1 - s) + below * s


class _ViewBatch:
    """Views of one size over one surface: as ``ViewPlanner``, V at once. Node values are float64."""

    def __init__(
        self,
        requests: Sequence[Request],
        views: Sequence[tuple[int, int]],
        step: int,
        name: str,
        auto: bool,
        config: FavsConfig,
        device: torch.device,
        maps: CameraMaps,
    ) -> None:
        self.requests, self.views, self.step, self.name, self.auto = requests, views, step, name, auto
        self.config, self.device, self.maps = config, device, maps
        self.frames = [f for f, _ in views]
        self.cameras = [requests[f].target[m] for f, m in views]
        self.size = self.cameras[0].size
        inset = step // 2
        corners = [np.minimum(np.arange(0, n + step, step), n - 1) for n in self.size]
        self.nodes = [c.clip(inset, n - 1 - inset) for c, n in zip(corners, self.size, strict=True)]
        self._y, self._x = (on_device(n, device) for n in self.nodes)
        self.rays, self.poses = pixel_rays(self.cameras, maps, device), Poses.of(self.cameras, device)
        self.directions = torch.stack(turned(self._on_nodes(self.rays).double(), self.poses.R), 1)
        scenes = {f: requests[f].scene for f in self.frames}
        self.has_points = name == "lidar"
        layered = name == "objects" or (self.has_points and has_boxes(scenes[self.frames[0]]))
        self.boxes = self._boxes(scenes) if layered else None
        self.solids = {f: candidates(boxes)[:, 0] for f, boxes in (self.boxes or {}).items()}
        if self.has_points:
            self._split_points(scenes)
        self._find_surface()
        self._find_sources()

    def _on_nodes(self, image: torch.Tensor) -> torch.Tensor:
        """Pixels (..., h, w) on the nodes (..., ny + 1, nx + 1)."""
        return image[..., self._y[:, None], self._x]

    # --- the surface --------------------------------------------------------------------------------------------------
    def _boxes(self, scenes: dict[int, Scene]) -> dict[int, torch.Tensor]:
        """(B, 7) float64 boxes of each frame, padded by zeros to one number; one row at least."""
        given = {f: torch.as_tensor(scene.boxes)[:, :7] for f, scene in scenes.items()}
        most = max(1, *map(len, given.values()))
        return {f: _pad(b.to(self.device, torch.float64), (0, 0, 0, most - len(b))) for f, b in given.items()}

    def _split_points(self, scenes: dict[int, Scene]) -> None:
        """Points of all frames, padded by NaN, and which are a box's."""
        given = {f: torch.as_tensor(scene.points)[:, :3].to(self.device, torch.float64) for f, scene in scenes.items()}
        most = max(map(len, given.values()))
        self.points = {f: _pad(p, (0, 0, 0, most - len(p)), value=math.nan) for f, p in given.items()}
        for f, boxes in (self.boxes or {}).items():
            self.solids[f], self.points[f] = fit_profiles(boxes, candidates(boxes), self.points[f])

    def _point_views(self, frames: Sequence[int], cameras: Sequence[Camera], cells: Cells) -> PanoramaViews:
        """What the points say around cameras of frames."""
        ground_z_m = np.array([self.requests[f].source.ground_z_m for f in frames])
        return PanoramaViews(cameras, cells, self.maps, torch.stack([self.points[f] for f in frames]), ground_z_m)

    def _pixel_rad(self, cameras: Sequence[Camera]) -> torch.Tensor:
        return on_device(np.array([1 / camera.K[0, 0] for camera in cameras]), self.device)

    def _drawn_solids(
        self, frames: Sequence[int], cameras: Sequence[Camera], rays: torch.Tensor, poses: Poses, lift: float = 0.0
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Inverse distances of the objects, and faces or -1."""
        objects = widened(poses, *self._objects_of(frames), self._pixel_rad(cameras), lift)
        return draw_solids(rays, poses, *objects)

    def _objects_of(self, frames: Sequence[int]) -> tuple[torch.Tensor, torch.Tensor]:
        """Boxes (n, B, 7) of frames, and planes (n, B, pieces, 6, 4) of what they hold."""
        assert self.boxes is not None
        return torch.stack([self.boxes[f] for f in frames]), torch.stack([self.solids[f] for f in frames])

    def _find_surface(self) -> None:
        """Inverse distances at all pixels, faces of solids, and the expected error on the nodes."""
        self.face: torch.Tensor | None = None
        if self.name == "far":
            self.q = self.behind = torch.zeros((len(self.views), *self.size), device=self.device)
            self.uncertainty = torch.full_like(self.directions[:, 0], _FAR_UNCERTAINTY)
            return
        centers_m = np.stack([camera.center_m for camera in self.cameras])
        ground_z_m = np.array([self.requests[f].source.ground_z_m for f in self.frames])
        ego = torch.stack(turned(self.rays, self.poses.R.float()), 1)
        self.q = self.behind = static_image(self.name != "ground", ego, centers_m, ground_z_m)
        on_street = self._on_nodes(self.behind)
        if self.has_points:
            cells = Cells.for_camera(self.cameras[0])  # batches have equal ones
            views = self._point_views(self.frames, self.cameras, cells)
            self.q = self.behind = views.image(ego, self.q)
        if self.boxes is not None:
            solid, self.face = self._drawn_solids(self.frames, self.cameras, self.rays, self.poses)
            if self.has_points:
                self.face = torch.where(solid < views.hidden(ego), -1, self.face)
            self.q = torch.where(self.face >= 0, solid, self.behind)
        on_nodes = self._on_nodes(self.q)
        self.uncertainty = static_uncertainty(self.directions, on_nodes.double(), centers_m)
        if self.has_points:
            (near,) = views.read((views.measured,), self._on_nodes(ego))
            self.uncertainty = torch.where(near > 0.5, MEASURED_SPREAD * on_nodes, self.uncertainty)
        elif self.boxes is not None:
            self.uncertainty = torch.where(on_nodes <= on_street, UNLABELLED * self.uncertainty, BOX_ERROR * on_nodes)

    # --- what sources see ---------------------------------------------------------------------------------------------
    def _find_sources(self) -> None:
        """Which sources (V, K) may see each view, their poses, and how many times each is halved."""
        nearest = self.q.amax((1, 2)).cpu().tolist()
        chosen = []
        for f, camera, q in zip(self.frames, self.cameras, nearest, strict=True):
            sources = self.requests[f].source
            order = content_order(sources.cameras)
            chosen.append(
                [k for k in order if not look_apart(camera, sources[k], q * self._is_near(camera, sources[k]))]
            )
        count = max(1, *map(len, chosen))
        self.numbers = np.array([row + [-1] * (count - len(row)) for row in chosen])
        self.levels = np.zeros_like(self.numbers)
        self.pairs: list[list[Any]] = [
            [None if k < 0 else self.requests[f].source[k] for k in row]
            for f, row in zip(self.frames, self.numbers.tolist(), strict=True)
        ]
        # A missing source is never who wins: -1 is for none.
        number = np.where(self.numbers < 0, -2, self.numbers).astype(np.int8)[..., None, None]
        self.number = on_device(number, self.device)
        self.offset_m = self._table(lambda camera, source: camera.center_m - source.center_m, np.zeros(3))
        self.baseline_m = np.linalg.norm(self.offset_m, axis=-1)
        self.is_near = self._table(self._is_near, False)
        to_source = self._table(lambda _, source: source.cam2ego[:3, :3].T, np.eye(3))
        targets = np.stack([camera.cam2ego[:3, :3] for camera in self.cameras])
        o = (to_source @ self.offset_m[..., None])[..., 0]
        self.near, self.A, self.o = (
            on_device(p, self.device, torch.float32)
            for p in (self.is_near[..., None, None], to_source @ targets[:, None], o[..., None, None])
        )
        kinds = self._table(lambda _, source: LENS_CODES[source.lens], -1)
        self.kind, self.kinds = on_device(kinds, self.device), sorted({int(k) for k in kinds.flat if k >= 0})
        self._set_bounds()
        u, v, _ = self._points(self._on_nodes(self.rays)[:, None], self._on_nodes(self.behind)[:, None], slice(None))
        self.valid = u.abs() < 0.9 * float(FAR_AWAY_PX)
        u, v = u.double(), v.double()
        self.resolution, self.edge_px = self._resolution(u, v), self._edge_distance(u, v)
        self.seen = self.valid & (self.edge_px > 0)
        fourth = self.seen.flatten(2) & (self.seen.flatten(2).cumsum(-1) % 4 == 1)
        ranked = torch.stack([_ranked(self.resolution.flatten(2), fourth, part) for part in (5, 2)]).cpu().numpy()
        usual, self.fineness = np.where(np.isfinite(ranked), ranked, 1.0)
        for row, k in zip(*np.nonzero(self.numbers >= 0), strict=True):
            if self.config.antialias:
                self.levels[row, k] = halvings(usual[row, k], self.pairs[row][k].size)
        self._set_bounds()

    def _is_near(self, camera: Camera, source: Camera) -> bool:
        """Whether a source is read over the surface, not the far one: ``ViewPlanner._choose_surface``."""
        baseline_m = float(np.linalg.norm(camera.center_m - source.center_m))
        if baseline_m < SAME_CENTER_M or self.name == "far":
            return False
        return not self.auto or worst_parallax_px(baseline_m, float(camera.K[0, 0])) >= self.config.far_parallax_px

    def _table(self, of_pair: Callable[[Camera, Any], Any], missing: Any) -> Any:
        """A number or array for each view and source (V, K, ...)."""
        rows = zip(self.cameras, self.pairs, strict=True)
        return np.array([[missing if s is None else of_pair(camera, s) for s in row] for camera, row in rows])

    def _set_bounds(self) -> None:
        """Parameters and bounds of the sources at their levels, as ``ViewPlanner._kernel`` gives them."""
        P, bounds = np.zeros((*self.levels.shape, 14), np.float32), np.zeros((*self.levels.shape, 6))
        bounds[..., :2] = 1  # a missing source holds nothing
        for row, k in zip(*np.nonzero(self.numbers >= 0), strict=True):
            source, level = self.pairs[row][k], int(self.levels[row, k])
            P[row, k], bounds[row, k] = camera_parameters(source, 0.5**level), source_bounds(source, level)
        self.P, self.bounds = (on_device(part, self.device, torch.float32) for part in (P, bounds[..., None, None]))

    def _points(
        self, rays: torch.Tensor, q: torch.Tensor, k: int | slice
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Positions u, v in sources ``k``, as they are read, of points on rays, and the points' inverse distances."""
        q = q * self.near[:, k]
        x, y, z = (p + o * q for p, o in zip(turned(rays, self.A[:, k]), self.o[:, k].unbind(-3), strict=True))
        return *projected(x, y, z, self.P[:, k], self.kind[:, k], self.kinds), q / length(x, y, z).clamp(min=TINY)

    def _bank(self, make: Callable[[int, int], Any], empty: torch.Tensor) -> _Bank:
        """Images of the sources at their levels, made for a view and one of its sources; None for none."""
        entries: dict[Any, int] = {None: 0}
        images, index = [None], np.zeros_like(self.numbers)
        for row, k in zip(*np.nonzero(self.numbers >= 0), strict=True):
            key = self._key(row, k)
            if key not in entries:
                entries[key] = len(entries)
                images.append(make(row, k))
            index[row, k] = entries[key]
        return _Bank(images, index, empty, self.device)

    def _key(self, row: int, k: int) -> tuple[Any, ...]:
        """A view's source as it is read: the same for views of one frame."""
        return self.frames[row], int(self.numbers[row, k]), int(self.levels[row, k]), bool(self.is_near[row, k])

    def _of_mask(self, row: int, k: int, what: Any, make: Callable[[BoolArray, int], Any]) -> torch.Tensor | None:
        """What ``make`` gives of a source's mask and level; None without a mask."""
        source, level = self.pairs[row][k], int(self.levels[row, k])
        if source.mask is None or source.mask.all():
            return None
        key = source.mask_key, what, level
        return self.maps.copy_on(self.device, key, lambda: np.ascontiguousarray(make(source.mask, level)))

    def _edge_distance(self, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """As ``rays.edge_distance``."""
        sizes = self._table(lambda _, source: source.size, (0, 0))
        high_v, high_u = on_device(sizes - 1, self.device)[..., None, None].unbind(2)
        edge = torch.minimum(torch.minimum(u, high_u - u), torch.minimum(v, high_v - v)) + 0.5
        bank = self._bank(
            lambda row, k: self._of_mask(row, k, "distance", lambda mask, _: distance_to_mask(mask).astype(np.float32)),
            torch.tensor(1e9),
        )
        if bank.is_empty:
            return edge
        return torch.where(edge >= 0, torch.minimum(edge, bank.at(v / CELL_PX, u / CELL_PX, slice(None))), edge)

    def _resolution(self, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        """As ``kernels.measure_nodes``."""
        if min(self.size) < 2:
            return torch.ones_like(u)
        parts = []
        for axis, nodes in ((-1, self.nodes[1]), (-2, self.nodes[0])):
            spacing = on_device(np.maximum(np.diff(nodes), 1), self.device)
            # The last nodes may coincide: their difference says nothing.
            last = len(spacing) - 1 - (len(spacing) > 1 and nodes[-1] == nodes[-2])
            index = torch.arange(len(nodes), device=self.device).clamp(max=last)
            per = spacing if axis == -1 else spacing[:, None]
            parts += [(p.diff(dim=axis) / per).index_select(axis, index) for p in (u, v)]
        a, c, b, d = parts
        half_sum, determinant = (a * a + b * b + c * c + d * d) / 2, a * d - b * c
        return (half_sum - (half_sum**2 - determinant**2).clamp(min=0).sqrt()).clamp(min=0).sqrt()

    # --- occlusion ----------------------------------------------------------------------------------------------------
    def _find_occluders(self) -> None:
        """Masks and occlusion maps of the sources at their levels."""
        full = torch.tensor(255, dtype=torch.uint8)
        self.clean = self._bank(lambda row, k: self._of_mask(row, k, "clean", clean_pixels), full)
        self.is_solid = self.boxes is not None or self.has_points
        if not self.is_solid:
            return
        scale = np.ones(self.numbers.shape)
        sizes: dict[tuple[int, int], dict[Any, Camera]] = {}
        for row, k in zip(*np.nonzero(self.is_near), strict=True):
            source, level = self.pairs[row][k], int(self.levels[row, k])
            coarser = level if self.boxes is not None else max(level, occlusion_level(source))
            scale[row, k] = 0.5 ** (coarser - level)
            half = halved_camera(source, coarser)
            sizes.setdefault(half.size, {})[self._key(row, k)] = half
        self.scale = on_device(scale, self.device, torch.float32)[..., None, None]
        drawn: dict[Any, Any] = {}
        for of_size in sizes.values():
            drawn.update(zip(of_size, self._drawn([key[0] for key in of_size], list(of_size.values())), strict=True))
        none = None, None
        self.shadow = self._bank(lambda row, k: drawn.get(self._key(row, k), none)[0], torch.tensor(0.0))
        self.solid = self._bank(lambda row, k: drawn.get(self._key(row, k), none)[1], torch.tensor(-1).int())
        if self.boxes is not None:
            centers_m = self.poses.center_m[:, None] - on_device(self.offset_m, self.device)
            self.before_m = before_faces(self._objects_of(self.frames)[1][:, None], centers_m)

    def _drawn(self, frames: Sequence[int], cameras: Sequence[Camera]) -> Iterator[tuple[Any, Any]]:
        """What hides from cameras of one size, inverse distances (h, w), and the boxes' rows; None for none."""
        rays, poses = pixel_rays(cameras, self.maps, self.device), Poses.of(cameras, self.device)
        beyond = number = None
        if self.has_points:
            ego = torch.stack(turned(rays, poses.R.float()), 1)
            beyond = self._point_views(frames, cameras, COARSE).hidden(ego)
        if self.boxes is not None:
            q, number = self._drawn_solids(frames, cameras, rays, poses, lift=0.5)
            q = q / (1 + 2 * self._pixel_rad(cameras)).float()[:, None, None]
            number = torch.div(number, 6, rounding_mode="floor").int()
            number = number if beyond is None else torch.where(q > beyond, number, -1)
            beyond = q if beyond is None else torch.maximum(q, beyond)
        assert beyond is not None
        yield from zip(beyond, [None] * len(frames) if number is None else number, strict=True)

    def _evaluate(self, rays: torch.Tensor, q: torch.Tensor, face: torch.Tensor | None, k: int | slice) -> Any:
        """As ``kernels._evaluate_row``: columns and rows in sources ``k`` in 32nds, int32, inside, and seen."""
        u, v, nearness = self._points(rays, q, k)
        low_u, low_v, high_u, high_v, right, bottom = self.bounds[:, k].unbind(-3)
        seen = inside = (u >= low_u) & (u <= high_u) & (v >= low_v) & (v <= high_v)
        if self.is_solid:
            seen = inside & ~self._hidden(u, v, nearness, face, k)
        # The outer half pixel of a full image lies outside the halved one: its border pixel is read.
        limit = float(MAP_LIMIT_PX)
        fu, fv = (
            (torch.where(n >= 0, torch.minimum(p.clamp(min=0), n), p).clamp(-limit, limit) * 32).round().int()
            for p, n in ((u, right), (v, bottom))
        )
        if not self.clean.is_empty:  # no tap of the interpolation may lie on the own car
            for more_v, more_u in ((0, 0), (0, 31), (31, 0), (31, 31)):
                seen = seen & (self.clean.at((fv + more_v) >> 5, (fu + more_u) >> 5, k) > 0)
        return fu, fv, inside, seen

    def _hidden(
        self, u: torch.Tensor, v: torch.Tensor, nearness: torch.Tensor, face: torch.Tensor | None, k: int | slice
    ) -> torch.Tensor:
        """Whether something hides points from sources, or their face is turned away: ``kernels._occlude_row``."""
        u, v = (p * self.scale[:, k] + (self.scale[:, k] - 1) * 0.5 for p in (u, v))
        if face is None:
            return self.shadow.between(v, u, k) > nearness
        face = torch.where(self.near[:, k] > 0, face, -1)
        before_m = self.before_m[:, k].gather(-1, face.clamp(min=0).long().flatten(-2)).view(face.shape)
        away = (before_m <= 0) | (before_m * nearness < float(LEAST_INCIDENCE))
        hides, by = self.shadow.at(v.round(), u.round(), k), self.solid.at(v.round(), u.round(), k)
        piece, whole = (torch.div(face, n, rounding_mode="floor") for n in (6, 6 * PIECES))
        same = torch.div(by, PIECES, rounding_mode="floor") == whole
        least = torch.where(same, nearness / (1 - float(SAME_OBJECT_M) * nearness).clamp(min=TINY), nearness)
        hidden = (hides > least) & (by != piece) | away
        behind = hides > (nearness if self.has_points else 0)
        if self.has_points:  # what was measured hides smoothly, solids do not
            behind = torch.where(by < 0, self.shadow.between(v, u, k) > nearness, behind)
        return torch.where(face < 0, behind, hidden)

    # --- who wins -----------------------------------------------------------------------------------------------------
    def find_winners(self) -> None:
        """Each pixel's winning and second source and where they are read, and what is read of each view."""
        (V, K), config = self.numbers.shape, self.config
        self._find_occluders()
        weights, certain = self._weights()
        best = torch.full((V, *self.size), -1.0, device=self.device)  # a source beats none even with a weight of 0
        share, in_image = torch.zeros_like(best), torch.zeros_like(best, dtype=torch.bool)
        winner, second = (torch.full_like(best, -1, dtype=torch.int8) for _ in range(2))
        at, at_second = (
            torch.full((V, 2, *self.size), OUTSIDE * 32, dtype=torch.int32, device=self.device) for _ in range(2)
        )
        certainty = torch.zeros_like(best, dtype=torch.uint8) if config.certainty else None
        for k in range(K):
            fu, fv, inside, seen = self._evaluate(self.rays, self.q, self.face, k)
            weight = torch.where(seen, upsampled(weights[:, k], self.step, self.size), -2.0)
            here, better = torch.stack([fu, fv], 1), weight > best
            if K > 1 and config.seam_width:
                also = ~better & (weight > share)
                second = torch.where(better, winner, torch.where(also, self.number[:, k], second))
                at_second = torch.where(better[:, None], at, torch.where(also[:, None], here, at_second))
                share = torch.where(better, best.clamp(min=0), torch.maximum(share, weight))
            winner, at = torch.where(better, self.number[:, k], winner), torch.where(better[:, None], here, at)
            best, in_image = torch.maximum(best, weight), in_image | inside
            if certain is not None and certainty is not None:
                certainty = torch.where(
                    better, upsampled(certain[:, k], self.step, self.size).round().to(torch.uint8), certainty
                )
        share = share / (best + share).clamp(min=TINY)
        share = torch.where((share >= LEAST_SHARE) & (second >= 0), share, 0.0)
        second = torch.where(share > 0, second, -1)
        counts = [
            torch.stack([(who == self.number[:, k]).sum((1, 2)) for k in range(K)], 1) for who in (winner, second)
        ]
        self.won_px, added_px = torch.stack(counts).cpu().numpy()
        self.read = [
            [(int(row[k]), int(levels[k])) for k in np.argsort(-won, kind="stable") if won[k] or added[k]]
            for row, levels, won, added in zip(self.numbers, self.levels, self.won_px, added_px, strict=True)
        ]
        self.winner, self.second, self.at, self.at_second = winner, second, at, at_second
        self.share, self.certainty, self.layers = share, certainty, self._layers(in_image & (winner < 0))

    def _layers(self, occluded: torch.Tensor) -> torch.Tensor:
        """The views' layers (V, h, w) uint8: ``kernels.mark_objects``."""
        step, (h, w), reach = self.step, self.size, nearer_cells(self.size, self.step)
        layers = occluded.to(torch.uint8)
        behind = occluded & (self.q > 0)
        behind = behind if self.face is None else behind & (self.face < 0)
        nearness = torch.where(behind, -self.q, -math.inf)
        cells = _pad(nearness, (0, -w % step, 0, -h % step), value=-math.inf)
        cells = torch.nn.functional.max_pool2d(cells[:, None], step)
        cells = torch.nn.functional.max_pool2d(cells, 2 * reach + 1, 1, reach)[:, 0]
        limit = -NEARER * cells.repeat_interleave(step, 1).repeat_interleave(step, 2)[:, :h, :w]
        layers[(self.winner >= 0) & (self.q > limit)] = OBJECT
        if self.face is not None:
            layers[self.face >= 0] = OBJECT
        used = on_device(self.is_near.any(1), self.device) & occluded.any(2).any(1)
        return torch.where(used[:, None, None], layers, occluded.byte())

    def _paint(self, row: int) -> Callable[[], Paint | None]:
        """Makes a view's paint once it is asked for."""
        if self.face is None or not self.is_near[row].any():
            return lambda: None
        (boxes,), (solids,) = self._objects_of([self.frames[row]])
        on_view = boxes, solids, self.face[row], self.winner[row]

        def made() -> Paint:
            boxes, solids, face, winner = (part.cpu().numpy() for part in on_view)
            return Paint.of(face, winner, BoxSurface(Far(), boxes, solids).face_parts)

        return cache(made)

    def maps_into(self, layouts: Sequence[AtlasLayout]) -> Iterator[tuple[tuple[int, int], ViewMaps]]:
        """The maps of each view into its frame's atlas."""
        slots = [[layouts[f].slot(*pair) for pair in pairs] for f, pairs in zip(self.frames, self.read, strict=True)]
        first = np.zeros((*self.numbers.shape, 2), np.int32)
        for row, of_view in enumerate(slots):
            for slot in of_view:
                first[row, self.numbers[row] == slot.source] = slot.x, slot.y
        first_32 = on_device(first * 32, self.device)[..., None, None]
        ways = [self._interpolation(row) for row in range(len(slots))]
        edges = self._edges() if "cubic" in ways else None
        at, at_second = (
            torch.where(who[:, None] < 0, OUTSIDE * 32, at + self._of_source(first_32, who))
            for who, at in ((self.winner, self.at), (self.second, self.at_second))
        )
        if "nearest" in ways:
            at = ((at + 16) >> 5) << 5
        size = on_device(np.array([layouts[f].size[::-1] for f in self.frames]), self.device, torch.float64)
        scale = 32 * (size - 1).clamp(min=1)
        grid = at.movedim(1, -1).double().div(scale[:, None, None]).mul(2).sub(1).float()
        blends, certainty = self._blends(at_second, scale), self.certainty
        for row, view in enumerate(self.views):
            edge = None
            if edges is not None and ways[row] == "cubic":
                pixel = edges[row].flatten().nonzero()[:, 0]
                edge = pixel, grid[row].view(1, -1, 2)[:, pixel]
            certain = None if certainty is None else certainty[row]
            covered, used = float(self.won_px[row].sum()) / math.prod(self.size), tuple(slots[row])
            parts = (
                grid[row],
                self.winner[row],
                blends[row],
                edge,
                ways[row],
                certain,
                self.layers[row],
                self._paint(row),
                used,
                covered,
            )
            yield view, ViewMaps(*parts)

    def _weights(self) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Seam weights and certainties in 255ths of all sources (V, K, ny + 1, nx + 1)."""
        config, q = self.config, self._on_nodes(self.q)[:, None]
        face = None
        if self.face is not None:
            face = self._on_nodes(self.face)[:, None].expand(-1, self.numbers.shape[1], -1, -1)
        visible = self._evaluate(self._on_nodes(self.rays)[:, None], q, face, slice(None))[3]
        offset_m = on_device(self.offset_m, self.device)[..., None, None]
        along_m = (offset_m * self.directions[:, None]).sum(2)
        across_m = (offset_m.square().sum(2) - along_m.square()).clamp(min=0).sqrt()
        spread = torch.where(self.near > 0, self.uncertainty[:, None], _FAR_UNCERTAINTY)
        focal = self._table(lambda camera, _: camera.K[0, 0], 1.0)
        half = self._table(lambda _, source: min(source.size) / 2, 1.0)
        bonus = np.where(self.baseline_m < SAME_CENTER_M, config.primary_bonus, 1.0)
        focal_, half_, bonus_ = (on_device(part, self.device)[..., None, None] for part in (focal, half, bonus))
        score = (self.edge_px / half_).clamp(0, 1) ** config.distance_gamma
        parallax = focal_ * across_m * spread
        score = score * (self.resolution.clamp(0.05, 1) / (1 + parallax)) * bonus_
        score = torch.where(visible & (self.edge_px > 0), score, 0.0).float()
        if not config.certainty:
            return self._seam_weights(score, parallax), None
        ratio = self.resolution.clamp(1e-3, 1e3)
        detail = torch.minimum(ratio, 1 / ratio) ** RESOLUTION_POWER
        certain = 255 * torch.exp(-across_m * spread / DECORRELATION_RAD) * detail
        known = torch.where(self.valid, certain, 0.0).float()
        around = _blurred(known, 2) / _blurred(self.valid.float(), 2).clamp(min=1e-6)
        return self._seam_weights(score, parallax), torch.where(self.valid, known, around)

    def _seam_weights(self, score: torch.Tensor, parallax: torch.Tensor) -> torch.Tensor:
        """As ``seams.seam_weights``."""
        width_px = self.config.seam_width * self.size[1]
        if width_px == 0 or score.shape[1] < 2:
            return score
        best, label = score.max(1, keepdim=True)
        numbers = torch.arange(score.shape[1], device=self.device)[:, None, None]
        soft = ((label == numbers) & (best > 0)).float()
        if self.boxes is not None:
            label = self._read_whole(soft.flatten(2), score.flatten(2), parallax.float().flatten(2)).view_as(label)
            soft = ((label == numbers) & (best > 0)).float()
        for _ in range(2):
            soft = _blurred(soft, max(1, round(width_px / self.step / 2)))
        return soft * ((self.edge_px / self.resolution.clamp(min=1e-3)).float() / width_px).clamp(0, 1)

    def _read_whole(self, won: torch.Tensor, score: torch.Tensor, parallax: torch.Tensor) -> torch.Tensor:
        """As ``kernels.node_winners``, of nodes (V, K, N) as one-hot vectors; the winners (V, N)."""
        boxes, rays = self._objects_of(self.frames)[0], self.directions.flatten(2).float()
        away, yaw = boxes[..., :3] - self.poses.center_m[:, None], boxes[..., 6]
        far = away.norm(dim=-1)
        margin = self.step * self._pixel_rad(self.cameras)[:, None] * far
        c, s, zero = yaw.cos(), yaw.sin(), torch.zeros_like(yaw)
        turn = torch.stack([c, s, zero, -s, c, zero, zero, zero, zero + 1], -1).unflatten(-1, (3, 3))
        along = turn.flatten(1, 2).float() @ rays
        inverse = 1 / torch.where(along.abs() < TINY, TINY, along).unflatten(1, (-1, 3))
        middle = (turn @ away[..., None]).float() * inverse

        def meets(half: torch.Tensor) -> torch.Tensor:
            reach = half.float()[..., None] * inverse.abs()
            enter = (middle - reach).amax(2)
            return ((middle + reach).amin(2) >= enter) & (enter > 0)

        inside, around = meets(boxes[..., 3:6] / 2), meets(boxes[..., 3:6] / 2 + margin[..., None])
        own = inside.mT.float()
        count = (score > 0).float() @ own
        most = count.amax(1)
        one = torch.where(count >= WHOLE * most[:, None], parallax @ own, math.inf).argmin(1)
        exact = (score.amax(1, keepdim=True) > 1).float() @ own > 0
        mixed = ((won @ around.mT.float() > 0).sum(1) > 1) & (most > 0) & ~exact[:, 0]
        may = around & mixed[..., None] & (score > 0).gather(1, one[..., None].expand(-1, -1, score.shape[2]))
        nearest, box = torch.where(may, far[..., None], math.inf).min(1)
        return torch.where(nearest.isfinite(), one.gather(1, box), won.argmax(1))

    def _interpolation(self, row: int) -> str:
        """As ``ViewPlanner._interpolation``."""
        if self.config.interpolation != "cubic":
            return self.config.interpolation
        exact, won_px = self.baseline_m[row] < SAME_CENTER_M, self.won_px[row]
        won = won_px[exact].sum()
        fineness = self.fineness[row] / 2.0 ** self.levels[row]
        return "cubic" if 2 * won > won_px.sum() and (fineness * won_px)[exact].sum() <= MAGNIFIED * won else "linear"

    def _of_source(self, values: torch.Tensor, number: torch.Tensor) -> torch.Tensor:
        """Values (V, c, h, w) of each pixel's source (V, h, w), of those (V, K, c, 1, 1) of all sources."""
        k = (number[:, None] == self.number).byte().argmax(1).flatten(1)
        values = values[..., 0, 0].transpose(1, 2)
        return values.gather(2, k[:, None].expand(-1, values.shape[1], -1)).unflatten(2, self.size)

    def _edges(self) -> torch.Tensor:
        """Pixels (V, h, w) whose cubics leave the source or touch its mask."""
        x, y = (self.at >> 5).unbind(1)
        sizes = [
            [level_size(s.size, level) if s else (0, 0) for s, level in zip(*row, strict=True)]
            for row in zip(self.pairs, self.levels.tolist(), strict=True)
        ]
        h, w = self._of_source(on_device(sizes, self.device)[..., None, None], self.winner).unbind(1)
        inside = (x > 0) & (x <= w - 3) & (y > 0) & (y <= h - 3)
        taps = self._bank(
            lambda row, k: self._of_mask(row, k, "taps", _cubic_taps), torch.tensor(255, dtype=torch.uint8)
        )
        for k in range(self.numbers.shape[1] * (not taps.is_empty)):
            inside &= (self.winner != self.number[:, k]) | (taps.at(y, x, k) > 0)
        return ~inside & (self.winner >= 0)

    def _blends(self, at: torch.Tensor, scale: torch.Tensor) -> list[Blend | None]:
        """The pixels of each view into which a second source is blended."""
        view, pixel = self.share.flatten(1).nonzero(as_tuple=True)
        counts = torch.bincount(view, minlength=len(self.views)).tolist()
        grid = (at.flatten(2)[view, :, pixel].double() / scale[view] * 2 - 1).float()
        parts = pixel, grid, self.share.flatten(1)[view, pixel], self.second.flatten(1)[view, pixel].long()
        split = zip(*(part.split(counts) for part in parts), strict=True)
        return [Blend(p, g[None], s, k) if len(p) else None for p, g, s, k in split]


def _ranked(values: torch.Tensor, chosen: torch.Tensor, part: int) -> torch.Tensor:
    """Value (...,) at one ``part`` of those (..., n) that are chosen, ascending; infinity where none is."""
    ordered, count = torch.where(chosen, values, math.inf).sort(-1).values, chosen.sum(-1, keepdim=True)
    return ordered.gather(-1, count // part)[..., 0]


def _blurred(image: torch.Tensor, radius: int) -> torch.Tensor:
    """Means (..., h, w) over squares, borders repeated."""
    return _pool(_pad(image, [radius] * 4, mode="replicate"), 2 * radius + 1, stride=1)


def _cubic_taps(mask: BoolArray, level: int) -> Any:
    """255 (h, w) where no tap of a cubic lies on the own car."""
    return cv2.erode(clean_pixels(mask, level), np.ones((4, 4), np.uint8), anchor=(1, 1))
