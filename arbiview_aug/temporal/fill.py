"""Holes of the target views filled from neighbouring frames: real pixels before invented ones.

The current frame is never repainted. What may be filled is the near road, which stands still, unless everything is
asked for; where it lies along a target ray says the current frame's own surface. A neighbour is not read where a
labelled object stood before its camera, then or now. What no labels vouch for, and what lies beside a labelled object
that moved, is read where other frames bear it out (``merging``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.projection import ego_rays
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import ArbiviewError
from arbiview_aug.favs.config import FavsConfig
from arbiview_aug.render.plan import RenderPlan, build_plan
from arbiview_aug.render.rendered import Maps, RenderedFrame, Renderer, confidence_of
from arbiview_aug.render.tone_curve import ToneCurve
from arbiview_aug.render.view_plan import ViewPlan
from arbiview_aug.sample.neighbours import Neighbour, Warn, warn_lost
from arbiview_aug.scene.boxes import BoxSurface
from arbiview_aug.scene.scene import Scene
from arbiview_aug.scene.static import Street, plane_inverse_distance
from arbiview_aug.scene.surface import Surface
from arbiview_aug.temporal.change import ChangeRisk, change_risks
from arbiview_aug.temporal.merge import Candidate, merged

Reach = Literal["ground", "all"]
"""What neighbours may fill: the near road; or whatever the surface says."""

NEAR_M = 15.0
"""The road counts as near within this distance of a target camera, measured along the road."""

_ROAD_M = 0.15
"""What the surface has higher over the road is not the road: kerbs are lower, bumpers higher."""

_AIR_M = 0.4
"""Around labels nothing is read: contact shadows and mirrors move with them."""

_SEAM = 0.02
"""Of a view's width: so far around a hole the current frame's colours are compared with a neighbour's."""


class Hole(NamedTuple):
    """The rectangle of a target view around what may be filled.

    Attributes:
        target: Index of the target camera.
        y: First row in its view.
        x: First column.
        camera: The target camera, cut to the rectangle.
        free: (h, w) uncovered pixels that may be filled.
        seam: (h, w) covered pixels next to them that show the same kind of surface.
        inverse_distance: (h, w) of both along their rays, 1/m.
        margin_px: How wide the seam is.
    """

    target: int
    y: int
    x: int
    camera: Camera
    free: BoolArray
    seam: BoolArray
    inverse_distance: FloatArray
    margin_px: int


class Fill(NamedTuple):
    """What one neighbour adds.

    Attributes:
        neighbour: The frame.
        plan: From its rig to the cameras of the holes.
        usable: For each hole (h, w) the pixels, free or on the seam, that it shows.
        blur: For each hole (h, w) uint8, how much coarser it shows them, in half octaves; 0 where it is as sharp as
            the target.
        doubt: For each hole (h, w) uint8 ``moved.ChangeRisk`` of what it shows.
    """

    neighbour: Neighbour
    plan: RenderPlan
    usable: list[BoolArray]
    blur: list[npt.NDArray[np.uint8]]
    doubt: list[npt.NDArray[np.uint8]]


@dataclass(frozen=True, eq=False)
class Fills:
    """How the holes of a frame's views are filled.

    Attributes:
        holes: Where.
        fills: From what, the nearest neighbour first.
    """

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
        """In words, how much of the views each neighbour shows that neither the current frame nor a nearer one does."""
        pixels = sum(target.source_camera.size for target in plan.targets)
        left = [hole.free.copy() for hole in self.holes]
        lines = []
        for fill in self.fills:
            added = 0
            for free, seen in zip(left, fill.usable, strict=True):
                added += int((free & seen).sum())
                free &= ~seen
            where = f"{fill.neighbour.travel_m:.1f} m of travel"
            lines.append(f"neighbour {fill.neighbour.name}, {where}: {added / pixels:.1%} of all pixels")
        return lines


class FilledPatch(NamedTuple):
    """What was filled in of one target view.

    Attributes:
        target: Index of the target camera.
        rows: Of the rectangle in the view.
        columns: Of the rectangle.
        frame: (h, w) int8 number of the neighbour in the sample's list, -1 where nothing was filled in.
        camera: (h, w) int8 which of its cameras, -1 there.
        certainty: (h, w) uint8 as in ``ViewPlan``, 0 there; None where the plan has none.
    """

    target: int
    rows: slice
    columns: slice
    frame: torch.Tensor
    camera: torch.Tensor
    certainty: torch.Tensor | None


# --- what may be filled, and from what --------------------------------------------------------------------------------
def plan_fills(
    plan: RenderPlan, neighbours: Sequence[Neighbour], scene: Scene, surface: str, config: FavsConfig, reach: Reach
) -> Fills | None:
    """Which neighbours show what the current frame does not; None where none does.

    Args:
        plan: The current frame's.
        neighbours: Other frames, the nearest first.
        scene: What is known of the geometry now, in the current ego frame.
        surface: The name of the surface that the current frame's views are rendered over.
        config: Its settings.
        reach: What may be filled.
    """
    if not neighbours or all(target.coverage.all() for target in plan.targets):
        return None
    whole = scene.surface(surface, plan.source.ground_z_m)
    holes = [hole for k in range(len(plan.targets)) if (hole := _hole(plan, k, whole, reach)) is not None]
    if not holes:
        return None
    # Between two cameras of a neighbour nothing is blended: one of them may look at what moved.
    settings = replace(config, seam_width=0.0)
    rig = Rig([hole.camera for hole in holes], ground_z_m=plan.source.ground_z_m)
    fills = []
    for neighbour in neighbours:
        made = build_plan(neighbour.rig, rig, surface=surface, config=settings, scene=scene)
        seen = [_seen(hole, target, neighbour) for hole, target in zip(holes, made.targets, strict=True)]
        if any((hole.free & usable).any() for hole, (usable, *_) in zip(holes, seen, strict=True)):
            usable, blur, doubt = (list(maps) for maps in zip(*seen, strict=True))
            fills.append(Fill(neighbour, made, usable, blur, doubt))
    return Fills(holes, fills) if fills else None


def _hole(plan: RenderPlan, index: int, surface: Surface, reach: Reach) -> Hole | None:
    camera, covered = plan.target[index], plan.targets[index].coverage
    empty = ~covered if camera.mask is None else ~covered & camera.mask
    if not empty.any():
        return None
    margin_px = max(2, round(_SEAM * camera.width_px))
    around: Any = cv2.dilate(empty.view(np.uint8), np.ones((2 * margin_px + 1,) * 2, np.uint8))
    pixel = np.flatnonzero(around)
    directions, valid = _rays(camera, pixel)
    if reach == "ground":
        # A surface may be dear to ask: first what is certainly not near.
        road = plane_inverse_distance(camera.center_m, directions, plan.source.ground_z_m)
        valid &= np.hypot(directions[:, 0], directions[:, 1]) <= NEAR_M * road
    pixel, directions = pixel[valid], directions[valid]
    q = surface.inverse_distance(camera.center_m, directions)
    if reach == "ground":
        height_m = camera.center_m[2] + directions[:, 2] / np.maximum(q, 1e-9) - plan.source.ground_z_m
        road = (q > 0) & (np.abs(height_m) < _ROAD_M)
        pixel, q = pixel[road], q[road]
    inverse_distance = np.zeros(camera.size)
    inverse_distance.reshape(-1)[pixel] = q
    shown = np.zeros(camera.size, bool)
    shown.reshape(-1)[pixel] = True
    free = shown & empty
    if not free.any():
        return None
    rows, columns = (_with_margin(np.asarray(free.any(axis=1 - axis)), margin_px) for axis in (0, 1))
    box = (slice(*rows), slice(*columns))
    cut = camera.crop(rows[0], columns[0], (rows[1] - rows[0], columns[1] - columns[0]))
    seam = (shown & covered)[box]
    return Hole(index, rows[0], columns[0], cut, free[box], seam, inverse_distance[box], margin_px)


def _with_margin(flags: BoolArray, margin: int) -> tuple[int, int]:
    """First and last index (exclusive) of what is True, with a margin."""
    there = np.flatnonzero(flags)
    return max(int(there[0]) - margin, 0), min(int(there[-1]) + 1 + margin, len(flags))


def _rays(camera: Camera, pixel: npt.NDArray[np.int64]) -> tuple[FloatArray, BoolArray]:
    """Unit rays (n, 3) in the ego frame of pixels (n,) of the flattened view, and their validity."""
    v, u = np.divmod(pixel, camera.width_px)
    return ego_rays(camera, np.stack([u, v], -1).astype(np.float64))


def _seen(
    hole: Hole, target: ViewPlan, neighbour: Neighbour
) -> tuple[BoolArray, npt.NDArray[np.uint8], npt.NDArray[np.uint8]]:
    """What a neighbour's cameras show of a hole, no labelled object in between; how coarsely; the doubt about it."""
    seen = target.coverage & (hole.free | hole.seam)
    blur, doubt = np.zeros(seen.shape, np.uint8), np.full(seen.shape, ChangeRisk.UNLABELLED, np.uint8)
    solid = neighbour.labelled + np.array([0, 0, 0, 2 * _AIR_M, 2 * _AIR_M, 0, 0])
    objects = BoxSurface(Street(ground_z_m=neighbour.rig.ground_z_m), solid)
    for pair in target.pairs:
        pixel = np.flatnonzero(seen & (target.source_camera == pair.source))
        directions, _ = _rays(hole.camera, pixel)
        source = neighbour.rig[pair.source]
        q = np.maximum(hole.inverse_distance.reshape(-1)[pixel], 1e-6)
        offset_m = directions / q[:, None]
        away = (hole.camera.center_m - source.center_m) + offset_m
        length = np.maximum(np.linalg.norm(away, axis=1), 1e-9)
        away /= length[:, None]
        if len(solid):
            hidden = objects.occludes(source.center_m, away, 1 / length, float(1 / source.K[0, 0]))
            seen.reshape(-1)[pixel[hidden]] = False
        if neighbour.moved is not None:
            doubt.reshape(-1)[pixel] = change_risks(neighbour.moved, hole.camera.center_m + offset_m)
        # Pixels a metre of road, along the road, where they are fewest: as the sine of the incidence over the distance.
        here, there = (
            camera.K[0, 0] * np.abs(ray[:, 2]) * nearness
            for camera, ray, nearness in ((hole.camera, directions, q), (source, away, 1 / length))
        )
        octaves = np.log2(np.maximum(here, 1e-9) / np.maximum(there, 1e-9))
        blur.reshape(-1)[pixel] = np.clip(np.round(2 * octaves), 0, 255).astype(np.uint8)
    return seen, blur, doubt


# --- pixels -----------------------------------------------------------------------------------------------------------
def fill_from_neighbours(
    rendered: RenderedFrame,
    fills: Fills | None,
    images: Sequence[torch.Tensor],
    curves: Sequence[ToneCurve] | None,
    renderer: Renderer,
    warn: Warn,
) -> RenderedFrame:
    """Fill the holes of a rendered frame with what its neighbours show.

    Args:
        rendered: The frame; its maps are written into.
        fills: What is filled and from which neighbours; None for nothing.
        images: The current frame's source images.
        curves: The current frame's tone curves. A camera's exposure is that of the same camera now: fills overlap the
            current views too little to estimate their own.
        renderer: Renders the neighbours.
        warn: Says which neighbours cannot be read.
    """
    if fills is None:
        return rendered
    patched = []
    for fill in fills.fills:
        sources = neighbour_images(fill.neighbour, images, warn)
        if sources is not None:
            patched.append((fill, renderer.views(fill.plan, sources, curves, images)))
    if not patched:
        return rendered
    views, patches = fill_views(rendered.images, fills, patched)
    _put(patches, rendered.coverage, lambda patch: patch.frame >= 0)
    _put(patches, rendered.source_camera, lambda patch: patch.camera)
    _put(patches, rendered.source_frame, lambda patch: patch.frame + 1)
    rendered = replace(rendered, images=views)
    if rendered.confidence is None:
        return rendered
    certainty = [of_view.copy() for of_view in rendered.certainty]  # the plan's own are kept
    _put(patches, [torch.from_numpy(of_view) for of_view in certainty], lambda patch: patch.certainty)
    rendered = replace(rendered, certainty=certainty)
    return replace(rendered, confidence=confidence_of(rendered))


def neighbour_images(neighbour: Neighbour, like: Sequence[torch.Tensor], warn: Warn) -> tuple[torch.Tensor, ...] | None:
    """Read a neighbour's images; None, with a warning that names it, if they cannot be read."""
    try:
        return neighbour.images(like)
    except (ArbiviewError, OSError) as error:
        warn_lost(warn, neighbour.name, error)
        return None


def _put(
    patches: Sequence[FilledPatch], maps: Maps | None, value: Callable[[FilledPatch], torch.Tensor | None]
) -> None:
    """Write the patches' values into maps of the views, where there are both."""
    if maps is None:
        return
    for patch in patches:
        place, values = maps[patch.target][patch.rows, patch.columns], value(patch)
        if values is not None:
            there = patch.frame >= 0
            place[there.to(place.device)] = values[there].to(place.device)


def fill_views(
    views: Sequence[torch.Tensor], fills: Fills, rendered: Sequence[tuple[Fill, Sequence[torch.Tensor]]]
) -> tuple[list[torch.Tensor], list[FilledPatch]]:
    """The views (3, h, w) with their holes filled, and what was filled in.

    Args:
        views: As the current frame gives them; those on the CPU without gradients are written into.
        fills: The plan.
        rendered: Of each neighbour that could be read, the images (3, h, w) of the holes.
    """
    done, patches = list(views), []
    for k, hole in enumerate(fills.holes):
        view = done[hole.target]
        h, w = hole.free.shape
        rows, columns = slice(hole.y, hole.y + h), slice(hole.x, hole.x + w)
        candidates = [
            Candidate(
                images[k],
                torch.from_numpy(fill.usable[k]).to(view.device),
                torch.from_numpy(fill.blur[k]).to(view.device),
                torch.from_numpy(fill.doubt[k]).to(view.device),
                fill.neighbour.is_later,
            )
            for fill, images in rendered
        ]
        free, seam = (torch.from_numpy(mask).to(view.device) for mask in (hole.free, hole.seam))
        pixels, chosen = merged(view[:, rows, columns], free, seam, candidates, hole.margin_px)
        done[hole.target] = view if not view.requires_grad and view.device.type == "cpu" else view.clone()
        done[hole.target][:, rows, columns] = pixels
        patches.append(_patch(k, hole, (rows, columns), chosen, rendered))
    return done, patches


def _patch(
    k: int,
    hole: Hole,
    place: tuple[slice, slice],
    chosen: torch.Tensor,
    rendered: Sequence[tuple[Fill, Sequence[torch.Tensor]]],
) -> FilledPatch:
    frame = torch.full(chosen.shape, -1, dtype=torch.int8, device=chosen.device)
    camera, certainty = frame.clone(), None
    for n, (fill, _) in enumerate(rendered):
        target, taken = fill.plan.targets[k], chosen == n
        frame[taken] = fill.neighbour.number
        camera[taken] = torch.from_numpy(target.source_camera).to(chosen.device)[taken]
        if target.certainty is not None:
            certainty = torch.zeros_like(frame, dtype=torch.uint8) if certainty is None else certainty
            certainty[taken] = torch.from_numpy(target.certainty).to(chosen.device)[taken]
    return FilledPatch(hole.target, *place, frame, camera, certainty)
