"""Fill holes of the target views from neighbouring frames, before anything is inpainted.

Pixels that the current frame sees never change. By default only the near road is filled; its distances come from the
current frame's surface. A neighbour's pixel is rejected where a labelled object hides the point from its camera, in
either frame. Unlabelled scenes, and places beside moved objects, need the agreement of several frames.

The frames' views of one hole are merged: the sharpest static one is taken at each pixel, at the view's exposure. A
candidate is accepted by the votes of the others, as far as the labels require (``ChangeRisk``). ``NONE``: half of the
others agree. ``SHADED``: all others agree. ``BESIDE``: the same, and one confirms it. ``UNLABELLED``: the nearest
frames before and after the current one agree with it; where all frames lie on one side, at least three agree, or none
of at most two contradicts; and the current frame shows no newly arrived object beside the hole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import PixelRays, RayCache
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.image_ops import FRESH, Memory, some_of_cells
from arbiview_aug.render.plan import RenderConfig, RenderPlan, ViewPlan
from arbiview_aug.render.rendered import Maps, RenderedFrame, Renderer, confidence_of
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.sample.neighbours import BOX_MARGIN_M, ChangeRisk, Neighbour, Warn, change_risks, neighbour_images
from arbiview_aug.scene.boxes import BoxSurface, whole
from arbiview_aug.scene.scene import Scene
from arbiview_aug.scene.surface import DenseSurface, OcclusionMap, Street, Surface

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
        """(h, w) pixels that neighbours are asked for."""
        return self.free | self.seam

    @cached_property
    def near(self) -> BoolArray:
        """(ny + 1, nx + 1) corners of the cells that hold such pixels."""
        cells = np.pad(some_of_cells(self.wanted, _CELL_PX), 1)
        return np.asarray(cells[1:, 1:] | cells[1:, :-1] | cells[:-1, 1:] | cells[:-1, :-1])

    @property
    def points(self) -> FloatArray:
        """What lies at these corners, in the ego frame (n, 3)."""
        directions, q = (of[self.near] for of in self.nodes)
        return np.asarray(self.camera.center_m + directions / q[:, None])


class Fill(NamedTuple):
    """One neighbour's views of the holes."""

    neighbour: Neighbour
    plan: RenderPlan  # render plan from its rig to the cameras of the holes
    shown: list[Candidate]  # what it shows of each hole; no images yet


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
    """Known distances of the holes' pixels, hidden from a neighbour by labelled objects and by what was measured."""

    holes: Sequence[Hole]
    full: Surface  # the frame's surface
    objects: BoxSurface | None  # labelled objects of both frames
    _shadows: dict[bytes, OcclusionMap] = field(default_factory=dict, repr=False)

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
        """Labelled objects hide everything; what was measured hides what lies behind. Kept for the next hole."""
        key, full = camera.content_key, self.full.background
        if key not in self._shadows:
            before = np.zeros(camera.size, np.float32)
            if isinstance(full, DenseSurface):
                before = full.occlusion_map(camera, rays, memory).beyond.copy()
            if self.objects is not None:
                before[self.objects.occlusion_map(camera, rays, memory).solid >= 0] = np.inf
            self._shadows[key] = OcclusionMap(before, np.zeros(before.shape, np.int32))
        return self._shadows[key]

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
    maps: RayCache,
) -> Fills | None:
    """Find the holes of a frame's plan and the neighbours, nearest first, that show them; None if none does.

    ``scene`` is the current frame's, in its ego frame, and ``surface`` the one that it is rendered over. ``reach`` is
    the area that may be filled.
    """
    full = scene.surface(surface, plan.source.ground_z_m)
    shown_q = [scene.images.get((surface, camera.content_key)) for camera in plan.target]
    holes = [hole for k, q in enumerate(shown_q) if (hole := _hole(plan, k, full, q, reach, maps)) is not None]
    if not holes:
        return None
    # A neighbour's cameras are not blended: one of them may see a moved object.
    config = replace(config, seam_width=0.0, layers=False)
    rig = Rig([hole.camera for hole in holes], ground_z_m=plan.source.ground_z_m)
    wanted, points = [hole.wanted for hole in holes], [hole.points for hole in holes]
    ends, fills = np.cumsum([len(of_hole) for of_hole in points]), []
    for neighbour in neighbours:
        boxes = neighbour.labelled + np.array([0, 0, 0, 2 * BOX_MARGIN_M, 2 * BOX_MARGIN_M, 0, 0])
        objects = BoxSurface(Street(), boxes, whole(boxes)) if len(boxes) else None
        known = Scene(known=_HoleSurface(holes, full, objects))
        settings: dict[str, Any] = {"geometry": surface, "config": config, "scene": known, "maps": maps}
        views = build_plan(neighbour.rig, rig, wanted=wanted, **settings)
        risks: Sequence[Any] = [None] * len(holes)
        if neighbour.moved is not None:
            risks = np.split(change_risks(neighbour.moved, np.concatenate(points)), ends[:-1])
        shown = [_shown(*one, neighbour) for one in zip(holes, views.targets, risks, strict=True)]
        if any((hole.free & one.shows).any() for hole, one in zip(holes, shown, strict=True)):
            fills.append(Fill(neighbour, views, shown))
    return Fills(holes, fills) if fills else None


def _hole(plan: RenderPlan, index: int, surface: Surface, q: Any, reach: Reach, maps: RayCache) -> Hole | None:
    camera, covered = plan.target[index], plan.targets[index].coverage
    empty = ~covered if camera.mask is None else ~covered & camera.mask
    height_m = camera.center_m[2] - plan.source.ground_z_m
    if not empty.any() or (reach == "road" and height_m <= 0):
        return None
    margin_px = max(2, round(_SEAM_WIDTH * camera.width_px))
    rays, part = maps.rays(camera), _box(empty, margin_px)
    local = rays.at(*(np.arange(side.start, side.stop) for side in part))
    up = np.tensordot(camera.cam2ego[2, :3].astype(np.float32), local, 1)
    allowed = np.asarray(up < -1 / np.hypot(1, NEAR_M / height_m) if reach == "road" else local.any(axis=0))
    free = empty[part] & allowed
    if not free.any():
        return None
    inner = _box(free, margin_px)
    up, allowed, free = up[inner], allowed[inner], free[inner]
    rows, columns = box = _within(part[0], inner[0]), _within(part[1], inner[1])
    camera = camera.crop(rows.start, columns.start, free.shape)
    rays = maps.rays(camera, rays.crop(rows.start, columns.start, free.shape))
    q = surface.image(camera, rays) if q is None else q[box]
    if reach == "road":
        allowed &= (q > 0) & (np.abs(height_m + up / np.maximum(q, np.float32(1e-9))) < _ROAD_TOLERANCE_M)
    free &= allowed
    if not free.any():
        return None
    around = cv2.dilate(empty[box].view(np.uint8), np.ones((2 * margin_px + 1,) * 2, np.uint8)) > 0
    return Hole(index, box, camera, rays, free, around & allowed & covered[box], q, margin_px)


def _box(flags: BoolArray, margin: int) -> tuple[slice, slice]:
    """Rows and columns from the first to the last True of (h, w), with a margin."""
    ends = [np.flatnonzero(flags.any(axis=1 - axis))[[0, -1]].tolist() for axis in (0, 1)]
    top, left = (slice(max(a - margin, 0), min(b + 1 + margin, n)) for (a, b), n in zip(ends, flags.shape, strict=True))
    return top, left


def _within(outer: slice, inner: slice) -> slice:
    """A slice of a slice."""
    return slice(outer.start + inner.start, outer.start + inner.stop)


def _shown(hole: Hole, view: ViewPlan, risks: npt.NDArray[np.uint8] | None, neighbour: Neighbour) -> Candidate:
    from arbiview_aug.render.kernels import upsample_where

    usable = view.coverage & hole.wanted
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
    if risks is not None:
        corners = np.zeros(q.shape, np.uint8)
        corners[hole.near] = risks
        cells = np.maximum.reduce([corners[:-1, :-1], corners[1:, :-1], corners[:-1, 1:], corners[1:, 1:]])
        risk = _of_cells(cells, _CELL_PX, usable.shape)
    return Candidate(usable, blur, risk, neighbour.is_later)


def _of_cells(values: Any, cell: int, size: tuple[int, ...]) -> Any:
    """The pixels (h, w) of cells (ny, nx)."""
    return values.repeat(cell, axis=0).repeat(cell, axis=1)[: size[0], : size[1]]


# --- filling ----------------------------------------------------------------------------------------------------------
def fill_from_neighbours(
    rendered: RenderedFrame, fills: Fills, images: Sequence[torch.Tensor], renderer: Renderer, warn: Warn
) -> RenderedFrame:
    """Fill the holes of a rendered frame from its neighbours; ``warn`` is called for those that cannot be read.

    The frame's maps, and its images where possible, are written into. Its tone curves serve the neighbours' cameras
    too: the holes overlap the current views too little to estimate others. ``images`` are its sources.
    """
    curves = rendered.curves
    tones = None if curves is None else [curves[hole.target][:, hole.box[0]] for hole in fills.holes]
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


_AGREEMENT_LEVELS = 16.0
"""Largest difference of two frames that agree, in grey levels over a window."""

_CONTRADICTION_LEVELS = 24.0
"""The same between a frame and the current one, on a seam (``docs/drives.md``, Constants)."""

_WINDOW_PX = 5
"""Side of the window in which two frames are compared, at least 3 samples."""

_CONTRADICTION_REACH = 1.25
"""A contradiction on the seam reaches to where agreement is nearer by this factor (``docs/drives.md``, Constants)."""

_SAMPLES_PER_SEAM = 7
"""Rows or columns across a seam in which labelled frames are compared; all of narrower seams."""

_FEW_CANDIDATES = 2
"""With at most this many candidates, accept one without a confirming vote."""

_MIN_SEAM_PX = 20
"""Fewest common pixels for an exposure."""

_MAX_LOG_GAIN, _MAX_LOG_TINT = 1.3, 0.25
"""Largest logarithm of the gain between two cameras (real rigs: log 3.5), and of its spread over the channels."""

_SEAM_INLIERS, _OVERLAP_INLIERS = 0.5, 0.7
"""Share of pixels that must agree after the gain: more between two neighbours, which may both show passing traffic."""

_DARK_LEVELS = 4.0
"""Offset added to colours before taking their ratio."""

_MEAN_WEIGHT = 0.02
"""Weight of the seam's mean offset beside the local one; far from the seam it stands alone."""


Levels = npt.NDArray[np.float32]
"""An image (3, h, w) in grey levels."""


class Candidate(NamedTuple):
    """The part of a hole that one neighbour shows."""

    shows: BoolArray  # (h, w) bool, the free and seam pixels that it shows
    # (h, w) uint8, how much coarser it shows them, in half octaves; 0 for as sharp as the target
    blur: npt.NDArray[np.uint8]
    risk: npt.NDArray[np.uint8]  # (h, w) uint8 ``ChangeRisk``
    later: bool  # whether it was recorded after the current frame
    image: torch.Tensor = torch.empty(0)  # (3, h, w) of the view's type, once it is rendered

    def part(self, place: tuple[slice, slice]) -> Candidate:
        """Some of its rows and columns."""
        maps = self.shows[place], self.blur[place], self.risk[place]
        return Candidate(*maps, self.later, self.image[(..., *place)])


def merged(
    view: torch.Tensor, free: BoolArray, seam: BoolArray, candidates: Sequence[Candidate], margin_px: int
) -> tuple[torch.Tensor, npt.NDArray[np.int16]]:
    """Fill the free pixels of a view by the sharpest accepted candidate, at the view's exposure.

    Args:
        view: (3, h, w) uint8, or float in [0, 1]; gradients reach the pixels that it keeps.
        free: (h, w) bool, True where the view may be filled.
        seam: (h, w) bool, ``margin_px`` wide, True where view and candidates should agree.
        candidates: The nearest first.

    Returns:
        (3, h, w) filled view, and (h, w) int16 index of the candidate taken, -1 for none.
    """
    pixels, chosen = view.clone(), np.full(free.shape, -1, np.int16)
    shows = np.logical_or.reduce([one.shows for one in candidates])
    if (shows & free).any():
        box = _box(shows, margin_px)
        parts = view[(..., *box)], free[box], seam[box], [one.part(box) for one in candidates]
        pixels[(..., *box)], chosen[box] = _merged(*parts, margin_px)
    return pixels, chosen


def _merged(
    view: torch.Tensor, free: BoolArray, seam: BoolArray, candidates: Sequence[Candidate], margin_px: int
) -> tuple[torch.Tensor, npt.NDArray[np.int16]]:
    """As ``merged``, where any candidate shows something; exposures and votes are those of a sample of pixels."""
    # Without labels the borders of what moved must be found.
    unlabelled = any((one.risk == ChangeRisk.UNLABELLED).any() for one in candidates)
    step, n = 1 if unlabelled else max(1, margin_px // _SAMPLES_PER_SEAM), len(candidates)
    every = slice(None, None, step), slice(None, None, step)
    levels = 1.0 if view.dtype == torch.uint8 else 255.0
    samples = [one.part(every) for one in candidates]
    current, images = _levels(view[(..., *every)], levels), [_levels(one.image, levels) for one in samples]
    recorded = [image.copy() if step > 1 else image for image in images]
    gains = _tone(current, images, free[every], seam[every], samples, max(1, margin_px // 2 // step))
    shown = np.stack([one.shows & free[every] for one in samples])
    accepted = shown & _accepted(current, images, shown, seam[every], samples, max(3, _WINDOW_PX // step | 1))
    # The order breaks ties.
    rank, chosen = np.full(free.shape, 256 * n, np.uint16), np.full(free.shape, -1, np.int16)
    for k, one in enumerate(candidates):
        # Samples may miss a border.
        accepts, rejects = (_beside(flags) for flags in (accepted[k], shown[k] & ~accepted[k]))
        usable = _of_cells(accepted[k] | (accepts & ~rejects & ~shown[k]), step, free.shape) & one.shows & free
        key = one.blur * np.uint16(n) + np.uint16(k)
        better = usable & (key < rank)
        np.copyto(rank, key, where=better)
        np.copyto(chosen, np.int16(k), where=better)
    pixels = view.clone(memory_format=torch.contiguous_format)
    for k, one in enumerate(candidates):
        taken = np.flatnonzero(chosen == k)
        y, x = np.divmod(taken, free.shape[1])
        at = y // step * current.shape[2] + x // step
        colours = images[k].reshape(3, -1).take(at, 1)
        if step > 1:  # what a pixel has more than its sample
            detail = _levels(one.image, levels).reshape(3, -1).take(taken, 1) - recorded[k].reshape(3, -1).take(at, 1)
            colours += gains[k] * detail
        colours = np.clip(np.rint(colours) if levels == 1 else colours / np.float32(levels), 0, 255 / levels)
        pixels.view(3, -1).index_copy_(1, torch.from_numpy(taken).to(view.device), torch.from_numpy(colours).to(view))
    return pixels, chosen


def _beside(flags: BoolArray) -> BoolArray:
    """(h, w) True on True pixels and those next to them."""
    return np.asarray(cv2.dilate(flags.view(np.uint8), np.ones((3, 3), np.uint8)) > 0)


def _levels(image: torch.Tensor, levels: float) -> Levels:
    grey = image.detach().cpu().to(torch.float32, memory_format=torch.contiguous_format, copy=True)
    return np.asarray((grey.mul_(levels) if levels != 1 else grey).numpy())


# --- votes ------------------------------------------------------------------------------------------------------------
def _accepted(
    current: Levels,
    toned: Sequence[Levels],
    shown: BoolArray,
    seam: BoolArray,
    candidates: Sequence[Candidate],
    window: int,
) -> BoolArray:
    """(n, h, w) whether each candidate shows what stands there now."""
    votes, nearest = np.zeros(shown.shape, np.uint8), np.full((2, *seam.shape), -1, np.int16)
    for k, one in enumerate(candidates):
        side = nearest[int(one.later)]
        np.copyto(side, np.int16(k), where=shown[k] & (side < 0))
    static = shown.copy()  # as far as the nearest frames before and after the current one agree
    for pair in combinations(range(len(candidates)), 2):
        both = shown[pair[0]] & shown[pair[1]]
        agree = _agreeing(toned[pair[0]], toned[pair[1]], both, _AGREEMENT_LEVELS, window)
        for i, j in (pair, pair[::-1]):
            votes[i] += agree
            static[i] &= ~both | agree | (nearest[int(candidates[j].later)] != j)
    others = shown.sum(axis=0, dtype=np.uint8) - np.uint8(1)
    risk, few = np.stack([one.risk for one in candidates]), len(candidates) <= _FEW_CANDIDATES
    unanimous = votes == others
    accepted = unanimous | ((risk < ChangeRisk.SHADED) & (2 * votes >= others))
    accepted &= (risk < ChangeRisk.BESIDE) | (votes >= (0 if few else 1))
    unlabelled = risk == ChangeRisk.UNLABELLED
    if unlabelled.any():
        on_both_sides = (nearest[0] >= 0) & (nearest[1] >= 0)
        static = (static & on_both_sides) | (unanimous & (votes >= (0 if few else 2)) & ~on_both_sides)
        if len(candidates) > 1:  # a single candidate may itself show the moving object
            static &= ~_arrived(current, toned, seam, candidates, window)
        accepted = (static & unlabelled) | (accepted & ~unlabelled)
    return np.asarray(accepted)


def _arrived(
    current: Levels, toned: Sequence[Levels], seam: BoolArray, candidates: Sequence[Candidate], window: int
) -> BoolArray:
    """(h, w) where a hole continues what the current frame alone shows on the seam."""
    known, agree = np.zeros_like(seam), np.zeros_like(seam)
    for image, one in zip(toned, candidates, strict=True):
        both = seam & one.shows
        known |= both
        agree |= _agreeing(image, current, both, _CONTRADICTION_LEVELS, window)
    contradicts = known & ~agree
    if not contradicts.any():
        return contradicts
    away, near = (
        np.asarray(cv2.distanceTransform((~places).view(np.uint8), cv2.DIST_L2, 5)) for places in (contradicts, agree)
    )
    return np.asarray(away / _CONTRADICTION_REACH < near)


def _agreeing(one: Levels, two: Levels, where: BoolArray, limit: float, window: int) -> BoolArray:
    """(h, w) where two images differ by less than a limit: means over the channels and a window's valid pixels."""
    apart = np.asarray(cv2.absdiff(one.reshape(-1, one.shape[2]), two.reshape(-1, one.shape[2]))).reshape(one.shape)
    valid = where.astype(np.float32)
    total, count = (
        np.asarray(cv2.boxFilter(part, -1, (window, window), normalize=False, borderType=cv2.BORDER_CONSTANT))
        for part in ((apart[0] + apart[1] + apart[2]) * valid, valid)
    )
    return np.asarray(where & (total < 3 * limit * count))


# --- exposure ---------------------------------------------------------------------------------------------------------
def _tone(
    view: Levels,
    images: list[Levels],
    free: BoolArray,
    seam: BoolArray,
    candidates: Sequence[Candidate],
    cell: int,
) -> list[Levels]:
    """Bring the candidates to the view's exposure, in place; return their gains (3, 1).

    Candidates with too little of the seam are matched to those with enough. Their offsets are of cells of pixels.
    """
    unmatched, gains = [], [np.ones((3, 1), np.float32)] * len(candidates)
    for k, one in enumerate(candidates):
        match = _expose(images[k], view, seam & one.shows, _SEAM_INLIERS)
        if match is None:
            unmatched.append(k)
        else:
            gains[k] = match[0]
            images[k] += _offset(*match[1:], seam.shape, cell)
    if not unmatched:
        return gains
    reference, known = view.copy(), seam.copy()
    for k in sorted(range(len(candidates)), key=unmatched.__contains__):
        shows = free & candidates[k].shows
        if k in unmatched:
            match = _expose(images[k], reference, shows & known, _OVERLAP_INLIERS)
            if match is None:
                continue
            gains[k] = match[0]
        np.copyto(reference, images[k], where=shows & ~known)
        known |= shows
    return gains


def _expose(
    image: Levels, reference: Levels, where: BoolArray, min_inliers: float
) -> tuple[Levels, npt.NDArray[np.int64], Levels] | None:
    """Give an image the gain of a reference, in place; None if it is implausible.

    Returns:
        The gain (3, 1), pixels (n,) that then agree, and what they lack (3, n).
    """
    pixel = np.flatnonzero(where)
    if len(pixel) < _MIN_SEAM_PX:
        return None
    ours, theirs = (part.reshape(3, -1).take(pixel, 1) + np.float32(_DARK_LEVELS) for part in (reference, image))
    middle = (len(pixel) - 1) // 2
    gain = np.partition(ours / theirs, middle, axis=1)[:, middle, None]
    logs = np.log(gain)
    if abs(logs.mean()) > _MAX_LOG_GAIN or np.ptp(logs) > _MAX_LOG_TINT:
        return None
    error = ours - gain * theirs
    agree = np.flatnonzero((np.abs(error) < _AGREEMENT_LEVELS).all(axis=0))
    if len(agree) < min_inliers * len(pixel):
        return None
    image *= gain[:, :, None]
    image += np.float32(_DARK_LEVELS) * (gain[:, :, None] - 1)
    return gain, pixel[agree], error.take(agree, 1)


def _offset(pixel: npt.NDArray[np.int64], error: Levels, size: tuple[int, ...], cell: int) -> Levels:
    """(3, h, w) smooth offset of a candidate: the local error near the seam, its mean farther away."""
    h, w = (-(-n // cell) for n in size)
    y, x = np.divmod(pixel, size[1])
    sums = [np.bincount(y // cell * w + x // cell, part, h * w) for part in (*error, np.ones(len(pixel)))]
    around: Any = np.stack(sums, axis=-1).reshape(h, w, 4) / cell**2
    for _ in range(2):
        around = cv2.blur(around, (5, 5), borderType=cv2.BORDER_CONSTANT)
    coarse = (around[..., :3] + _MEAN_WEIGHT * error.mean(axis=1)) / (around[..., 3:] + _MEAN_WEIGHT)
    fine = [cv2.resize(part, (w * cell, h * cell)) for part in np.moveaxis(coarse, -1, 0).astype(np.float32, order="C")]
    return np.stack(fine)[:, : size[0], : size[1]]
