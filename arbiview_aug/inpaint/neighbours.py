"""Fill holes of the target views from neighbouring frames, before anything is inpainted.

Pixels that the current frame sees never change. By default only the near road is filled; its distances come from the
current frame's surface. A neighbour's pixel is rejected where a labelled object hides the point from its camera, in
either frame. Unlabelled scenes, and places beside moved objects, need the agreement of several frames
(``arbiview_aug.inpaint.merge``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import CameraMaps, PixelRays
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.image_ops import FRESH, Memory
from arbiview_aug.inpaint.merge import Candidate, merged
from arbiview_aug.render.config import RenderConfig
from arbiview_aug.render.plan import RenderPlan, build_plan
from arbiview_aug.render.rendered import Maps, RenderedFrame, Renderer, confidence_of
from arbiview_aug.render.view_plan import ViewPlan
from arbiview_aug.sample.neighbours import Neighbour, Warn, neighbour_images
from arbiview_aug.scene.boxes import BoxSurface
from arbiview_aug.scene.scene import Scene
from arbiview_aug.scene.shapes import whole
from arbiview_aug.scene.static import Street
from arbiview_aug.scene.surface import DenseSurface, OcclusionMap, Surface
from arbiview_aug.temporal.change import BOX_MARGIN_M, ChangeRisk, change_risks

Reach = Literal["road", "all"]
"""Area that neighbours may fill: the near road, or everything that the surface covers."""

NEAR_M = 15.0
"""Radius of the near road around a target camera, measured along the road."""

_ROAD_TOLERANCE_M = 0.15
"""Largest height of road pixels: kerbs are lower, bumpers higher."""

_SEAM_WIDTH = 0.02
"""Colour-matching margin around a hole, as a fraction of the view's width."""

_CELL_PX = 8
"""Side of the cells in which blur and risks are known."""


@dataclass(frozen=True, eq=False)
class Hole:
    """Rectangle of a target view around the pixels to fill.

    Attributes:
        target: Index of the target camera.
        box: Its rows and columns in the view.
        camera: The target camera, cropped to the rectangle.
        rays: Of its pixels.
        free: (h, w) bool, uncovered pixels that may be filled.
        seam: (h, w) bool, covered pixels next to them, on the same kind of surface.
        inverse_distance: (h, w) float32 along the rays, 1/m.
        margin_px: Width of the seam.
    """

    target: int
    box: tuple[slice, slice]
    camera: Camera
    rays: PixelRays
    free: BoolArray
    seam: BoolArray
    inverse_distance: npt.NDArray[np.float32]
    margin_px: int

    @cached_property
    def nodes(self) -> tuple[FloatArray, FloatArray]:
        """Ego-frame rays (ny + 1, nx + 1, 3) and inverse distances at the corners of cells."""
        y, x = (np.minimum(np.arange(0, n + _CELL_PX, _CELL_PX), n - 1) for n in self.camera.size)
        directions = np.moveaxis(np.tensordot(self.camera.cam2ego[:3, :3], self.rays.at(y, x), 1), 0, -1)
        return directions, np.maximum(self.inverse_distance[np.ix_(y, x)].astype(np.float64), 1e-6)


class Fill(NamedTuple):
    """One neighbour's views of the holes.

    Attributes:
        neighbour: The frame.
        plan: Render plan from its rig to the cameras of the holes.
        shown: What it shows of each hole; no images yet.
    """

    neighbour: Neighbour
    plan: RenderPlan
    shown: list[Candidate]


@dataclass(frozen=True, eq=False)
class Fills:
    """The holes of a frame's views and the neighbours that fill them, the nearest first."""

    holes: list[Hole]
    fills: list[Fill]

    def shares(self, plan: RenderPlan) -> list[float]:
        """For each target camera, the share of its pixels that neighbours show and the current frame does not."""
        shares = [0.0] * len(plan.targets)
        for k, hole in enumerate(self.holes):
            seen = np.logical_or.reduce([fill.shown[k].shows for fill in self.fills])
            shares[hole.target] = float((hole.free & seen).sum() / plan.targets[hole.target].source_camera.size)
        return shares

    def lines(self, plan: RenderPlan) -> list[str]:
        """One line for each neighbour: the share of pixels that neither the current frame nor a nearer one shows."""
        pixels = sum(target.source_camera.size for target in plan.targets)
        missing = [hole.free for hole in self.holes]
        lines = []
        for fill in self.fills:
            new = [free & one.shows for free, one in zip(missing, fill.shown, strict=True)]
            missing = [free & ~of_hole for free, of_hole in zip(missing, new, strict=True)]
            added = sum(map(np.count_nonzero, new))
            where = f"{fill.neighbour.travel_m:.1f} m of travel"
            lines.append(f"neighbour {fill.neighbour.name}, {where}: {added / pixels:.1%} of all pixels")
        return lines


# --- planning ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _HoleSurface(DenseSurface):
    """Known distances of the holes' pixels, hidden from a neighbour by labelled objects and by what was measured.

    Attributes:
        holes: The holes.
        full: The frame's surface.
        objects: Labelled objects of both frames.
    """

    holes: Sequence[Hole]
    full: Surface
    objects: BoxSurface | None

    @property
    def is_dense(self) -> bool:  # type: ignore[override]
        """Whether anything hides them."""
        return self.objects is not None or self.full.background.is_dense

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> npt.NDArray[np.float32]:
        """Those of the hole with this camera's name, of which it may be a window."""
        hole = next(hole for hole in self.holes if hole.camera.name == camera.name)
        left, top = np.rint(hole.camera.K[:2, 2] - camera.K[:2, 2]).astype(int)
        return hole.inverse_distance[top : top + camera.height_px, left : left + camera.width_px]

    def occlusion_map(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> OcclusionMap:
        """Labelled objects hide everything; what was measured hides what lies behind."""
        before, full = memory.full(camera.size, 0, np.float32), self.full.background
        if isinstance(full, DenseSurface):
            before = full.occlusion_map(camera, rays, memory).beyond
        if self.objects is not None:
            before = np.where(self.objects.occlusion_map(camera, rays, memory).beyond > 0, np.float32(np.inf), before)
        return OcclusionMap(before, np.zeros(before.shape, np.int32))

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """The full surface's."""
        return self.full.uncertainty(origin, directions, inverse_distance)


def plan_fills(
    plan: RenderPlan,
    neighbours: Sequence[Neighbour],
    scene: Scene,
    surface: str,
    config: RenderConfig,
    reach: Reach,
    maps: CameraMaps,
) -> Fills | None:
    """Find the holes of a frame and the neighbours that show them; None if none does.

    Args:
        plan: The current frame's plan.
        neighbours: Other frames, the nearest first.
        scene: Geometry of the current frame, in its ego frame.
        surface: Name of the surface that the current frame is rendered over.
        config: Its settings.
        reach: Area that may be filled.
        maps: Rays and masks of cameras.
    """
    full = scene.surface(surface, plan.source.ground_z_m)
    holes = [hole for k in range(len(plan.targets)) if (hole := _hole(plan, k, full, reach, maps)) is not None]
    if not holes:
        return None
    # A neighbour's cameras are not blended: one of them may see a moved object.
    config = replace(config, seam_width=0.0)
    rig = Rig([hole.camera for hole in holes], ground_z_m=plan.source.ground_z_m)
    fills = []
    for neighbour in neighbours:
        boxes = neighbour.labelled + np.array([0, 0, 0, 2 * BOX_MARGIN_M, 2 * BOX_MARGIN_M, 0, 0])
        objects = BoxSurface(Street(), boxes, whole(boxes)) if len(boxes) else None
        known = Scene(known=_HoleSurface(holes, full, objects))
        views = build_plan(neighbour.rig, rig, geometry=surface, config=config, scene=known, maps=maps)
        shown = [_shown(hole, view, neighbour) for hole, view in zip(holes, views.targets, strict=True)]
        if any((hole.free & one.shows).any() for hole, one in zip(holes, shown, strict=True)):
            fills.append(Fill(neighbour, views, shown))
    return Fills(holes, fills) if fills else None


def _hole(plan: RenderPlan, index: int, surface: Surface, reach: Reach, maps: CameraMaps) -> Hole | None:
    camera, covered = plan.target[index], plan.targets[index].coverage
    empty = ~covered if camera.mask is None else ~covered & camera.mask
    height_m = camera.center_m[2] - plan.source.ground_z_m
    if not empty.any() or (reach == "road" and height_m <= 0):
        return None
    rays = maps.rays(camera)
    local = rays.at(*map(np.arange, camera.size))
    up = np.tensordot(camera.cam2ego[2, :3].astype(np.float32), local, 1)
    allowed = np.asarray(up < -1 / np.hypot(1, NEAR_M / height_m) if reach == "road" else local.any(axis=0))
    free = empty & allowed
    if not free.any():
        return None
    margin_px = max(2, round(_SEAM_WIDTH * camera.width_px))
    rows, columns = (_with_margin(np.asarray(free.any(axis=1 - axis)), margin_px) for axis in (0, 1))
    box, size = (rows, columns), (rows.stop - rows.start, columns.stop - columns.start)
    camera = camera.crop(rows.start, columns.start, size)
    rays = maps.rays(camera, rays.crop(rows.start, columns.start, size))
    q, allowed = surface.image(camera, rays), allowed[box]
    if reach == "road":
        allowed &= (q > 0) & (np.abs(height_m + up[box] / np.maximum(q, np.float32(1e-9))) < _ROAD_TOLERANCE_M)
    free = free[box] & allowed
    if not free.any():
        return None
    around = cv2.dilate(empty[box].view(np.uint8), np.ones((2 * margin_px + 1,) * 2, np.uint8)) > 0
    return Hole(index, box, camera, rays, free, around & allowed & covered[box], q, margin_px)


def _with_margin(flags: BoolArray, margin: int) -> slice:
    """From the first to the last True, with a margin."""
    first, last = np.flatnonzero(flags)[[0, -1]].tolist()
    return slice(max(first - margin, 0), min(last + 1 + margin, len(flags)))


def _shown(hole: Hole, view: ViewPlan, neighbour: Neighbour) -> Candidate:
    from arbiview_aug.render.kernels import upsample_where

    usable = view.coverage & (hole.free | hole.seam)
    blur, risk = np.zeros(usable.shape, np.uint8), np.full(usable.shape, ChangeRisk.UNLABELLED, np.uint8)
    directions, q = hole.nodes
    for pair in view.pairs:
        source = neighbour.rig.cameras[pair.source]
        # Pixels per metre along the road, which is the coarser axis: proportional to sin(incidence) / distance.
        from_source = (hole.camera.center_m - source.center_m) * q[..., None] + directions
        relative = np.maximum((from_source**2).sum(axis=-1), 1e-9)
        other, own_z = (np.maximum(np.abs(rays[..., 2]), 1e-9) for rays in (from_source, directions))
        halves = np.clip(2 * np.log2(hole.camera.K[0, 0] * own_z * relative / (source.K[0, 0] * other)), 0, 255)
        upsample_where(halves.astype(np.float32), _CELL_PX, view.source_camera, pair.source, blur)
    if neighbour.moved is not None:
        points = hole.camera.center_m + directions / q[..., None]
        corners = change_risks(neighbour.moved, points.reshape(-1, 3)).reshape(q.shape)
        cells = np.maximum.reduce([corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:]])
        risk = cells.repeat(_CELL_PX, axis=0).repeat(_CELL_PX, axis=1)[: usable.shape[0], : usable.shape[1]]
    return Candidate(usable, blur, risk, neighbour.is_later)


# --- filling ----------------------------------------------------------------------------------------------------------
def fill_from_neighbours(
    rendered: RenderedFrame,
    fills: Fills,
    images: Sequence[torch.Tensor],
    renderer: Renderer,
    warn: Warn,
) -> RenderedFrame:
    """Fill the holes of a rendered frame from its neighbours.

    Args:
        rendered: The frame; its maps, and its images where possible, are written into. Its tone curves serve the
            neighbours' cameras too: the holes overlap the current views too little to estimate others.
        fills: The planned fills.
        images: The current frame's source images.
        renderer: Renders the neighbours.
        warn: Called for neighbours that cannot be read.
    """
    tones = None if rendered.curves is None else rendered.curves[[hole.target for hole in fills.holes]]
    neighbours = []
    for fill in fills.fills:
        sources = neighbour_images(fill.neighbour, images, warn)
        if sources is not None:
            neighbours.append((fill, renderer.views(fill.plan, sources, tones, images)))
    if not neighbours:
        return rendered
    views, certain = list(rendered.images), [torch.as_tensor(one).clone() for one in rendered.certainty]  # a plan's
    for k, hole in enumerate(fills.holes):
        view, place = views[hole.target], (slice(None), *hole.box)
        candidates = [fill.shown[k]._replace(image=of_holes[k]) for fill, of_holes in neighbours]
        pixels, chosen = merged(view[place], hole.free, hole.seam, candidates, hole.margin_px)
        if view.requires_grad or view.device.type != "cpu":
            views[hole.target] = view.clone()
        views[hole.target][place] = pixels
        for n, (fill, _) in enumerate(neighbours):
            taken, target = chosen == n, fill.plan.targets[k]
            _write(rendered.coverage, hole, taken, np.True_)
            _write(rendered.source_camera, hole, taken, target.source_camera)
            _write(rendered.source_frame, hole, taken, np.int8(fill.neighbour.number + 1))
            _write(certain if target.certainty is not None else None, hole, taken, target.certainty)
    rendered = replace(rendered, images=views, certainty=certain)
    return rendered if rendered.confidence is None else replace(rendered, confidence=confidence_of(rendered))


def _write(maps: Maps | None, hole: Hole, where: BoolArray, value: Any) -> None:
    """Write a value, or those of a map (h, w), into a hole of a view's map."""
    if maps is not None:
        place = maps[hole.target][hole.box]
        values = torch.from_numpy(np.broadcast_to(value, where.shape).copy()).to(place)
        place.copy_(torch.where(torch.from_numpy(where).to(place.device), values, place))
