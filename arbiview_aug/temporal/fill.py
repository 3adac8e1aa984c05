"""Fill holes of the target views from neighbouring frames, before anything is inpainted.

Pixels that the current frame sees never change. By default only the near road is filled; its distances come from the
current frame's surface. A neighbour's pixel is rejected where a labelled object hides the point from its camera, in
either frame. Unlabelled scenes, and places beside moved objects, need the agreement of several frames
(``arbiview_aug.temporal.merge``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.projection import ego_rays, project_rays
from arbiview_aug.cameras.rays import pixel_rays
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import ArbiviewError
from arbiview_aug.favs.config import FavsConfig
from arbiview_aug.render.plan import RenderPlan, build_plan
from arbiview_aug.render.rendered import Maps, RenderedFrame, Renderer, confidence_of
from arbiview_aug.render.tone_curve import ToneCurve
from arbiview_aug.render.view_plan import ViewPlan
from arbiview_aug.render.view_planner import halved_camera
from arbiview_aug.sample.neighbours import Neighbour, Warn, warn_lost
from arbiview_aug.scene.boxes import BoxSurface
from arbiview_aug.scene.scene import Scene
from arbiview_aug.scene.static import Street, plane_inverse_distance
from arbiview_aug.scene.surface import Surface
from arbiview_aug.temporal.change import BOX_MARGIN_M, ChangeRisk, change_risks
from arbiview_aug.temporal.merge import Candidate, merged

Reach = Literal["ground", "all"]
"""Area that neighbours may fill: the near road, or everything that the surface covers."""

NEAR_M = 15.0
"""Radius of the near road around a target camera, measured along the road."""

_ROAD_TOLERANCE_M = 0.15
"""Largest height of road pixels: kerbs are lower, bumpers higher."""

_SEAM_WIDTH = 0.02
"""Colour-matching margin around a hole, as a fraction of the view's width."""


class Hole(NamedTuple):
    """Rectangle of a target view around the pixels to fill.

    Attributes:
        target: Index of the target camera.
        box: Its rows and columns in the view.
        camera: The target camera, cropped to the rectangle.
        free: (h, w) bool, uncovered pixels that may be filled.
        seam: (h, w) bool, covered pixels next to them, on the same kind of surface.
        inverse_distance: (h, w) along the rays of both, 1/m.
        margin_px: Width of the seam.
    """

    target: int
    box: tuple[slice, slice]
    camera: Camera
    free: BoolArray
    seam: BoolArray
    inverse_distance: FloatArray
    margin_px: int


class Fill(NamedTuple):
    """One neighbour's views of the holes.

    Attributes:
        neighbour: The frame.
        plan: Render plan from its rig to the cameras of the holes.
        usable: For each hole (h, w) bool, the free and seam pixels that it shows.
        blur: For each hole (h, w) uint8, how much coarser it shows them, in half octaves; 0 for as sharp as the target.
        risk: For each hole (h, w) uint8 ``ChangeRisk``.
    """

    neighbour: Neighbour
    plan: RenderPlan
    usable: list[BoolArray]
    blur: list[npt.NDArray[np.uint8]]
    risk: list[npt.NDArray[np.uint8]]


@dataclass(frozen=True, eq=False)
class Fills:
    """The holes of a frame's views and the neighbours that fill them, the nearest first."""

    holes: list[Hole]
    fills: list[Fill]

    def shares(self, plan: RenderPlan) -> list[float]:
        """For each target camera, the share of its pixels that neighbours show and the current frame does not."""
        shares = [0.0] * len(plan.targets)
        for k, hole in enumerate(self.holes):
            seen = np.logical_or.reduce([fill.usable[k] for fill in self.fills])
            shares[hole.target] = float((hole.free & seen).sum() / plan.targets[hole.target].source_camera.size)
        return shares

    def lines(self, plan: RenderPlan) -> list[str]:
        """One line for each neighbour: the share of pixels that neither the current frame nor a nearer one shows."""
        pixels = sum(target.source_camera.size for target in plan.targets)
        missing = [hole.free.copy() for hole in self.holes]
        lines = []
        for fill in self.fills:
            added = 0
            for free, seen in zip(missing, fill.usable, strict=True):
                added += int((free & seen).sum())
                free &= ~seen
            where = f"{fill.neighbour.travel_m:.1f} m of travel"
            lines.append(f"neighbour {fill.neighbour.name}, {where}: {added / pixels:.1%} of all pixels")
        return lines


# --- planning ---------------------------------------------------------------------------------------------------------
def plan_fills(
    plan: RenderPlan, neighbours: Sequence[Neighbour], scene: Scene, surface: str, config: FavsConfig, reach: Reach
) -> Fills | None:
    """Find the holes of a frame and the neighbours that show them; None if none does.

    Args:
        plan: The current frame's plan.
        neighbours: Other frames, the nearest first.
        scene: Geometry of the current frame, in its ego frame.
        surface: Name of the surface that the current frame is rendered over.
        config: Its settings.
        reach: Area that may be filled.
    """
    if not neighbours or all(target.coverage.all() for target in plan.targets):
        return None
    full = scene.surface(surface, plan.source.ground_z_m)
    holes = [hole for k in range(len(plan.targets)) if (hole := _hole(plan, k, full, reach)) is not None]
    if not holes:
        return None
    # A neighbour's cameras are not blended: one of them may see a moved object.
    config = replace(config, seam_width=0.0)
    rig = Rig([hole.camera for hole in holes], ground_z_m=plan.source.ground_z_m)
    fills = []
    for neighbour in neighbours:
        views = build_plan(neighbour.rig, rig, surface=surface, config=config, scene=scene)
        seen = [_seen(hole, view, neighbour) for hole, view in zip(holes, views.targets, strict=True)]
        if any((hole.free & usable).any() for hole, (usable, *_) in zip(holes, seen, strict=True)):
            usable, blur, risk = (list(maps) for maps in zip(*seen, strict=True))
            fills.append(Fill(neighbour, views, usable, blur, risk))
    return Fills(holes, fills) if fills else None


def _hole(plan: RenderPlan, index: int, surface: Surface, reach: Reach) -> Hole | None:
    camera, covered = plan.target[index], plan.targets[index].coverage
    empty = ~covered if camera.mask is None else ~covered & camera.mask
    if not empty.any():
        return None
    margin_px = max(2, round(_SEAM_WIDTH * camera.width_px))
    around: Any = cv2.dilate(empty.view(np.uint8), np.ones((2 * margin_px + 1,) * 2, np.uint8))
    pixel = np.flatnonzero(around)
    directions, valid = _rays(camera, pixel)
    if reach == "ground":
        road = plane_inverse_distance(camera.center_m, directions, plan.source.ground_z_m)
        valid &= np.hypot(directions[:, 0], directions[:, 1]) <= NEAR_M * road
    pixel, directions = pixel[valid], directions[valid]
    if not len(pixel):
        return None
    q = surface.image(camera, pixel_rays(camera)).reshape(-1)[pixel].astype(np.float64)
    if reach == "ground":
        height_m = camera.center_m[2] + directions[:, 2] / np.maximum(q, 1e-9) - plan.source.ground_z_m
        road = (q > 0) & (np.abs(height_m) < _ROAD_TOLERANCE_M)
        pixel, q = pixel[road], q[road]
    inverse_distance, allowed = np.zeros(camera.size), np.zeros(camera.size, bool)
    inverse_distance.reshape(-1)[pixel], allowed.reshape(-1)[pixel] = q, True
    free = allowed & empty
    if not free.any():
        return None
    rows, columns = (_with_margin(np.asarray(free.any(axis=1 - axis)), margin_px) for axis in (0, 1))
    box = rows, columns
    cropped = camera.crop(rows.start, columns.start, (rows.stop - rows.start, columns.stop - columns.start))
    return Hole(index, box, cropped, free[box], (allowed & covered)[box], inverse_distance[box], margin_px)


def _with_margin(flags: BoolArray, margin: int) -> slice:
    """From the first to the last True, with a margin."""
    indices = np.flatnonzero(flags)
    return slice(max(int(indices[0]) - margin, 0), min(int(indices[-1]) + 1 + margin, len(flags)))


def _rays(camera: Camera, pixel: npt.NDArray[np.int64]) -> tuple[FloatArray, BoolArray]:
    """Unit rays (n, 3) in the ego frame of pixels (n,) of the flattened view, and their validity."""
    v, u = np.divmod(pixel, camera.width_px)
    return ego_rays(camera, np.stack([u, v], -1).astype(np.float64))


def _seen(
    hole: Hole, view: ViewPlan, neighbour: Neighbour
) -> tuple[BoolArray, npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """``usable``, ``blur`` and ``risk`` of ``Fill`` for one hole."""
    usable = view.coverage & (hole.free | hole.seam)
    blur, risk = np.zeros(usable.shape, np.uint8), np.full(usable.shape, ChangeRisk.UNLABELLED, np.uint8)
    boxes = neighbour.labelled + np.array([0, 0, 0, 2 * BOX_MARGIN_M, 2 * BOX_MARGIN_M, 0, 0])
    objects = BoxSurface(Street(ground_z_m=neighbour.rig.ground_z_m), boxes)
    for pair in view.pairs:
        pixel = np.flatnonzero(usable & (view.source_camera == pair.source))
        directions, _ = _rays(hole.camera, pixel)
        source = neighbour.rig[pair.source]
        q = np.maximum(hole.inverse_distance.reshape(-1)[pixel], 1e-6)
        offset_m = directions / q[:, None]
        from_source = (hole.camera.center_m - source.center_m) + offset_m
        length = np.maximum(np.linalg.norm(from_source, axis=1), 1e-9)
        from_source /= length[:, None]
        if len(boxes):
            # Half the size is enough: silhouettes are widened by half of its pixels.
            half = halved_camera(source, 1) if min(source.size) > 1 else source
            uv, ahead = project_rays(half, directions, q, hole.camera.center_m - source.center_m)
            x, y = np.clip(np.rint(uv), 0, np.array(half.size[::-1]) - 1).astype(np.int64).T
            hidden = ahead & (objects.occlusion_map(half, pixel_rays(half)).beyond[y, x] > 0)
            usable.reshape(-1)[pixel[hidden]] = False
        if neighbour.moved is not None:
            risk.reshape(-1)[pixel] = change_risks(neighbour.moved, hole.camera.center_m + offset_m)
        # Pixels per metre along the road, which is the coarser axis: proportional to sin(incidence) / distance.
        own, other = (
            camera.K[0, 0] * np.abs(ray[:, 2]) * inverse_m
            for camera, ray, inverse_m in ((hole.camera, directions, q), (source, from_source, 1 / length))
        )
        octaves = np.log2(np.maximum(own, 1e-9) / np.maximum(other, 1e-9))
        blur.reshape(-1)[pixel] = np.clip(np.round(2 * octaves), 0, 255).astype(np.uint8)
    return usable, blur, risk


# --- filling ----------------------------------------------------------------------------------------------------------
def fill_from_neighbours(
    rendered: RenderedFrame,
    fills: Fills | None,
    images: Sequence[torch.Tensor],
    curves: Sequence[ToneCurve] | None,
    renderer: Renderer,
    warn: Warn,
) -> RenderedFrame:
    """Fill the holes of a rendered frame from its neighbours.

    Args:
        rendered: The frame; its maps, and its images where possible, are written into.
        fills: The planned fills; None for none.
        images: The current frame's source images.
        curves: The current frame's tone curves, which serve the neighbours' cameras too: the holes overlap the current
            views too little to estimate others.
        renderer: Renders the neighbours.
        warn: Called for neighbours that cannot be read.
    """
    if fills is None:
        return rendered
    neighbours = []
    for fill in fills.fills:
        sources = neighbour_images(fill.neighbour, images, warn)
        if sources is not None:
            neighbours.append((fill, renderer.views(fill.plan, sources, curves, images)))
    if not neighbours:
        return rendered
    views, certainty = (
        list(rendered.images),
        [torch.as_tensor(of_view).clone() for of_view in rendered.certainty],
    )  # a plan owns those
    for k, hole in enumerate(fills.holes):
        view, place = views[hole.target], (slice(None), *hole.box)
        free, seam = (torch.from_numpy(mask).to(view.device) for mask in (hole.free, hole.seam))
        candidates = [_candidate(fill, k, of_holes[k], view.device) for fill, of_holes in neighbours]
        pixels, chosen = merged(view[place], free, seam, candidates, hole.margin_px)
        if view.requires_grad or view.device.type != "cpu":
            views[hole.target] = view.clone()
        views[hole.target][place] = pixels
        for n, (fill, _) in enumerate(neighbours):
            taken, target = chosen == n, fill.plan.targets[k]
            _write(rendered.coverage, hole, taken, torch.tensor(True))
            _write(rendered.source_camera, hole, taken, torch.from_numpy(target.source_camera))
            _write(rendered.source_frame, hole, taken, torch.tensor(fill.neighbour.number + 1, dtype=torch.int8))
            if certainty and target.certainty is not None:
                _write(certainty, hole, taken, torch.from_numpy(target.certainty))
    rendered = replace(rendered, images=views, certainty=certainty)
    return rendered if rendered.confidence is None else replace(rendered, confidence=confidence_of(rendered))


def neighbour_images(neighbour: Neighbour, like: Sequence[torch.Tensor], warn: Warn) -> tuple[torch.Tensor, ...] | None:
    """Read a neighbour's images; None, with a warning that names it, if they cannot be read."""
    try:
        return neighbour.images(like)
    except (ArbiviewError, OSError) as error:
        warn_lost(warn, neighbour.name, error)
        return None


def _candidate(fill: Fill, k: int, image: torch.Tensor, device: torch.device) -> Candidate:
    usable, blur, risk = (torch.from_numpy(maps[k]).to(device) for maps in (fill.usable, fill.blur, fill.risk))
    return Candidate(image, usable, blur, risk, fill.neighbour.is_later)


def _write(maps: Maps | None, hole: Hole, where: torch.Tensor, value: torch.Tensor) -> None:
    """Write a value, or those of a map (h, w), into a hole of a view's map."""
    if maps is not None:
        place = maps[hole.target][hole.box]
        where = where.to(place.device)
        place[where] = value.to(place.device).expand(where.shape)[where]
