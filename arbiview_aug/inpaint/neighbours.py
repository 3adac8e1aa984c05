"""Fill holes of the target views from neighbouring frames, before inpainting.

Pixels that the current frame sees never change. By default only the near road is filled; its distances come from the
current frame's surface. A neighbour's pixel is rejected where a labelled object hides the point from its camera, in
either frame. ``merging`` joins the frames' views of one hole.
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
from arbiview_aug.cameras.rays import PixelRays, RayCache
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.image_ops import FRESH, Memory, bounding_box, of_cells
from arbiview_aug.inpaint.merging import Candidate, merged
from arbiview_aug.render.plan import RenderConfig, RenderPlan, ViewPlan
from arbiview_aug.render.rendered import Maps, Renderer, Views, confidence_of
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.sample.frame import Neighbour
from arbiview_aug.sample.neighbours import BOX_MARGIN_M, ChangeRisk, Warn, change_risks, neighbour_images
from arbiview_aug.scene.boxes import BoxSurface, whole
from arbiview_aug.scene.scene import Scene
from arbiview_aug.scene.surface import Street, Surface

Reach = Literal["road", "all"]
"""Area that neighbours may fill: the near road, or everything that the surface covers."""

NEAR_M = 15.0
"""Radius of the near road around a target camera, measured along the road."""

_ROAD_TOLERANCE_M = 0.15
"""Largest height of road pixels: kerbs are lower, bumpers higher."""

_SEAM_WIDTH = 0.02
"""Colour-matching margin around a hole, as a fraction of the view's width."""

_CELL_PX = 8
"""Side of the cells in which blur and risks are evaluated, pixels."""


@dataclass(frozen=True, eq=False)
class Hole:
    """Rectangle of a target view around the pixels to fill."""

    target: int  # index of the target camera
    box: tuple[slice, slice]  # its rows and columns in the view
    camera: Camera  # the target camera, cropped to the rectangle
    rays: PixelRays  # of its pixels
    free: BoolArray  # (h, w) bool, uncovered pixels that may be filled
    seam: BoolArray  # (h, w) bool, covered pixels next to them, on the same kind of surface
    inverse_distance: npt.NDArray[np.float32]  # (h, w) float32 along the rays, 1/m
    margin_px: int  # width of the seam

    @cached_property
    def nodes(self) -> tuple[FloatArray, FloatArray]:
        """Ego-frame rays (ny + 1, nx + 1, 3) and inverse distances at the corners of cells."""
        y, x = (np.minimum(np.arange(0, n + _CELL_PX, _CELL_PX), n - 1) for n in self.camera.size)
        directions = np.moveaxis(np.tensordot(self.camera.cam2ego[:3, :3], self.rays.at(y, x), 1), 0, -1)
        return directions, np.maximum(self.inverse_distance[np.ix_(y, x)].astype(np.float64), 1e-6)

    @cached_property
    def wanted(self) -> BoolArray:
        """Pixels (h, w) to plan in neighbours."""
        return self.free | self.seam


class Fill(NamedTuple):
    """One neighbour's views of the holes."""

    neighbour: Neighbour
    plan: RenderPlan  # render plan from its rig to the cameras of the holes
    shown: list[Candidate]  # its part of each hole; no images yet


@dataclass(frozen=True, eq=False)
class Fills:
    """The holes of a frame's views and the neighbours that fill them, the nearest first."""

    holes: list[Hole]
    fills: list[Fill]

    def shares(self, plan: RenderPlan) -> tuple[list[float], list[str]]:
        """The share of each target camera's pixels that neighbours alone show, and a line for each neighbour.

        The line says how many of all pixels neither the current frame nor a nearer one shows.
        """
        sizes = [target.source_camera.size for target in plan.targets]
        missing, added, lines = [hole.free for hole in self.holes], np.zeros(len(sizes), int), []
        for fill in self.fills:
            before = added.copy()
            for k, (hole, candidate) in enumerate(zip(self.holes, fill.shown, strict=True)):
                added[hole.target] += np.count_nonzero(missing[k] & candidate.shows)
                missing[k] = missing[k] & ~candidate.shows
            new, neighbour = (added - before).sum() / sum(sizes), fill.neighbour
            lines.append(f"neighbour {neighbour.name}, {neighbour.travel_m:.1f} m of travel: {new:.1%} of all pixels")
        return (added / sizes).tolist(), lines


# --- planning ---------------------------------------------------------------------------------------------------------
@dataclass(frozen=True, eq=False)
class _HoleSurface(Surface):
    """Known distances of the holes' pixels, hidden from a neighbour by labelled objects and measured points."""

    holes: Sequence[Hole]
    full: Surface  # the frame's surface
    objects: BoxSurface | None  # labelled objects of both frames

    @property
    def is_guess(self) -> bool:  # type: ignore[override]
        """Whether nothing hides the holes' pixels."""
        return self.objects is None and self.full.background.is_guess

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> npt.NDArray[np.float32]:
        """Inverse distances (h, w) of the hole with this camera's name; the camera may be a window of it."""
        hole = next(hole for hole in self.holes if hole.camera.name == camera.name)
        left, top = np.rint(hole.camera.K[:2, 2] - camera.K[:2, 2]).astype(int)
        return hole.inverse_distance[top : top + camera.height_px, left : left + camera.width_px]

    def hidden(
        self, camera: Camera, rays: PixelRays, memory: Memory = FRESH, *, coarse: bool = True
    ) -> npt.NDArray[np.float32]:
        """Labelled objects hide everything, measured points hide points behind them."""
        before = self.full.background.hidden(camera, rays, memory, coarse=coarse)
        if self.objects is not None:
            before[self.objects.occlusion_map(camera, rays, memory).solid >= 0] = np.inf
        return before

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Uncertainty of the full surface."""
        return self.full.uncertainty(origin, directions, inverse_distance)


def plan_fills(
    plan: RenderPlan,
    neighbours: Sequence[Neighbour],
    scene: Scene,
    surface: str,
    config: RenderConfig,
    reach: Reach,
    maps: RayCache,
) -> Fills | None:
    """Find the holes of a frame's plan and the neighbours, nearest first, that show them; None if none does.

    ``scene`` is the current frame's, in its ego frame; ``surface`` names the surface it is rendered over. ``reach`` is
    the area that may be filled.
    """
    full = scene.surface(surface, plan.source.ground_z_m)
    holes = [hole for k in range(len(plan.target)) if (hole := _hole(plan, k, full, reach, maps)) is not None]
    if not holes:
        return None
    # A neighbour's cameras are not blended: one of them may see a moved object.
    config = replace(config, seam_width=0.0, layers=False)
    rig = Rig([hole.camera for hole in holes], ground_z_m=plan.source.ground_z_m)
    wanted, fills = [hole.wanted for hole in holes], []
    for neighbour in neighbours:
        boxes = neighbour.labelled + np.array([0, 0, 0, 2 * BOX_MARGIN_M, 2 * BOX_MARGIN_M, 0, 0])
        objects = BoxSurface(Street(), boxes, whole(boxes)) if len(boxes) else None
        known = Scene(known=_HoleSurface(holes, full, objects))
        settings: dict[str, Any] = {"geometry": surface, "config": config, "scene": known, "maps": maps}
        views = build_plan(neighbour.rig, rig, wanted=wanted, **settings)
        shown = [_shown(hole, view, neighbour) for hole, view in zip(holes, views.targets, strict=True)]
        if any((hole.free & candidate.shows).any() for hole, candidate in zip(holes, shown, strict=True)):
            fills.append(Fill(neighbour, views, shown))
    return Fills(holes, fills) if fills else None


def _hole(plan: RenderPlan, index: int, surface: Surface, reach: Reach, maps: RayCache) -> Hole | None:
    camera, covered, q = plan.target[index], plan.targets[index].coverage, plan.targets[index].measured
    empty = ~covered if camera.mask is None else ~covered & camera.mask
    height_m = camera.center_m[2] - plan.source.ground_z_m
    if not empty.any() or (reach == "road" and height_m <= 0):
        return None
    margin_px = max(2, round(_SEAM_WIDTH * camera.width_px))
    rays, part = maps.rays(camera), bounding_box(empty, margin_px)
    local = rays.at(*(np.arange(side.start, side.stop) for side in part))
    up = np.tensordot(camera.cam2ego[2, :3].astype(np.float32), local, 1)
    allowed = np.asarray(up < -1 / np.hypot(1, NEAR_M / height_m) if reach == "road" else local.any(axis=0))
    free = empty[part] & allowed
    if not free.any():
        return None
    inner = bounding_box(free, margin_px)
    up, allowed, free = up[inner], allowed[inner], free[inner]
    top, left = part[0].start + inner[0].start, part[1].start + inner[1].start
    box = slice(top, top + len(free)), slice(left, left + free.shape[1])
    camera = camera.crop(top, left, free.shape)
    rays = maps.rays(camera, rays.crop(top, left, free.shape))
    q = surface.image(camera, rays) if q is None else q[box]
    if reach == "road":
        allowed &= (q > 0) & (np.abs(height_m + up / np.maximum(q, np.float32(1e-9))) < _ROAD_TOLERANCE_M)
    free &= allowed
    if not free.any():
        return None
    around = cv2.dilate(empty[box].view(np.uint8), np.ones((2 * margin_px + 1,) * 2, np.uint8)) > 0
    return Hole(index, box, camera, rays, free, around & allowed & covered[box], q, margin_px)


def _shown(hole: Hole, view: ViewPlan, neighbour: Neighbour) -> Candidate:
    """The part of a hole that a neighbour shows."""
    from arbiview_aug.scene.kernels import upsample_where

    usable = view.coverage & hole.wanted
    blur, risk = np.zeros(usable.shape, np.uint8), np.full(usable.shape, ChangeRisk.UNLABELLED, np.uint8)
    directions, q = hole.nodes
    for pair in view.pairs:
        source = neighbour.rig.cameras[pair.source]
        # Pixels per metre along the road, which is the coarser axis: proportional to sin(incidence) / distance.
        from_source = (hole.camera.center_m - source.center_m) * q[..., None] + directions
        relative = np.maximum((from_source**2).sum(axis=-1), 1e-9)
        source_z, target_z = (np.maximum(np.abs(rays[..., 2]), 1e-9) for rays in (from_source, directions))
        halves = np.clip(2 * np.log2(hole.camera.K[0, 0] * target_z * relative / (source.K[0, 0] * source_z)), 0, 255)
        upsample_where(halves.astype(np.float32), _CELL_PX, view.source_camera, pair.source, blur)
    if neighbour.moved is not None:
        points = hole.camera.center_m + directions / q[..., None]
        corners = change_risks(neighbour.moved, points.reshape(-1, 3)).reshape(q.shape)
        cells = np.maximum.reduce([corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:]])
        risk = of_cells(cells, _CELL_PX, usable.shape)
    return Candidate(usable, blur, risk, neighbour.is_later)


# --- filling ----------------------------------------------------------------------------------------------------------
def fill_from_neighbours(
    rendered: Views, fills: Fills, images: Sequence[torch.Tensor], renderer: Renderer, warn: Warn
) -> Views:
    """Fill the holes of a rendered frame from its neighbours; ``warn`` is called for unreadable ones.

    The frame's maps, and its images where possible, are written into. Its tone curves serve the neighbours' cameras
    too: the holes overlap the current views too little to estimate others. ``images`` are its sources.
    """
    curves = rendered.curves
    tones = None if curves is None else [curves[hole.target][:, hole.box[0]] for hole in fills.holes]
    neighbours = [
        (fill, renderer.views(fill.plan, sources, tones, images))
        for fill in fills.fills
        if (sources := neighbour_images(fill.neighbour, images, warn)) is not None
    ]
    if not neighbours:
        return rendered
    views = list(rendered.images)
    certain = [torch.as_tensor(certainty).clone() for certainty in rendered.certainty]  # the plan keeps its own
    for k, hole in enumerate(fills.holes):
        view, place = views[hole.target], (slice(None), *hole.box)
        candidates = [fill.shown[k]._replace(image=of_holes[k]) for fill, of_holes in neighbours]
        pixels, chosen = merged(view[place], hole.free, hole.seam, candidates, hole.margin_px)
        if view.requires_grad or view.device.type != "cpu":
            views[hole.target] = view.clone()
        views[hole.target][place] = pixels
        _write(rendered.coverage, hole, chosen >= 0, np.True_)
        for n, (fill, _) in enumerate(neighbours):
            taken, target = chosen == n, fill.plan.targets[k]
            _write(rendered.source_camera, hole, taken, target.source_camera)
            _write(rendered.source_frame, hole, taken, np.int8(fill.neighbour.number + 1))
            _write(certain if target.certainty is not None else None, hole, taken, target.certainty)
    rendered = replace(rendered, images=views, certainty=certain)
    return rendered if rendered.confidence is None else replace(rendered, confidence=confidence_of(rendered))


def _write(maps: Maps | None, hole: Hole, where: BoolArray, value: Any) -> None:
    """Write a value, or a map (h, w), into a hole of a view's map."""
    if maps is not None:
        place = maps[hole.target][hole.box]
        values = torch.from_numpy(np.broadcast_to(value, where.shape).copy()).to(place)
        place.copy_(torch.where(torch.from_numpy(where).to(place.device), values, place))
