"""Where a target camera's pixels lie in a source image, over a surface: cheaply, and to a stated precision.

Maps are evaluated in float64 on the nodes of a coarse grid and interpolated (``arbiview_aug.cameras.coarse_grid``).
Cells whose error bound exceeds the tolerance, and cells on the border of what can be projected, are evaluated pixel by
pixel. Surfaces that step anywhere (``DenseSurface``) are evaluated once at every pixel of a target, and every pixel is
projected, in float32 (positions are precise to 1/1000 px). Directions are held plane by plane, (3, ny, nx) in memory:
three times faster.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cached_property
from typing import Any, cast

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.coarse_grid import HALVINGS, Box, around, runs
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.projection import (
    CORNERS,
    FAR_AWAY_PX,
    beyond_image,
    clean_pixels,
    ego_rays,
    larger,
    look_apart,
    mask_at,
    project_rays,
    source_points,
)
from arbiview_aug.image_ops import at_level
from arbiview_aug.render.atlas import Slot
from arbiview_aug.render.occlusion import (
    VisibleFragments,
    cells_near_shadow,
    halved_camera,
    nearest_pixel,
    read_nearest,
)
from arbiview_aug.render.pixel_projection import cropped, project_pixels
from arbiview_aug.render.target_rays import TargetRays
from arbiview_aug.scene.surface import OcclusionMap, Surface

_SLACK_PX = 1e-3  # a pixel on the very border must not drop out by a rounding, of float32 at most
_SAFETY = 1.25  # curvature between the nodes may exceed what the nodes show

_UNRESOLVED = 8 * 5 / 1024
"""Weight of sixth differences in the error of interpolation, eight times their own term. What is as narrow as the
nodes' spacing, like the street's join of road and wall in small images, makes all differences alike, and where they
change sign a bound by the fourth alone is too low: by three times in 1 cell of 6000 at 12 % of the shipped rigs' sizes.
Over all pairs of them, street and far, at 5, 8, 12 and 30 %, no cell is missed with this and the safety above; with 6
times, three are at 5 %. Against the fourth alone, taken twice, a fifth more cells are evaluated pixel by pixel over the
street and two fifths fewer over the far surface: plans take 3 % longer in the mean of eight pairs, 17 % at worst."""

_MORE_NODES = 2
"""Between nodes a dense surface may be nearer than on any: a source may see a post, and nothing of what is around it.
16 px are the parallax for a metre between 20 and 50 m at a focal length of 530."""


class WarpMap:
    """Where one source sees one target.

    Attributes:
        uv: (ny, nx, 2) source pixels on the nodes, float64.
        valid: (ny, nx) bool.
        nodes: The nodes around everything that the source may see, or None if it sees nothing.
    """

    def __init__(self, rays: TargetRays, source: Camera, surface: Surface) -> None:
        self.rays, self.source = rays, source
        # Any: attributes, not types, say what a surface offers.
        self.whole_surface = cast(Any, surface)
        self.surface = cast(Any, surface).background
        self.offset_m = rays.camera.center_m - source.center_m
        self.nodes: Box | None = None
        if self._look_apart():
            return
        self.solids = VisibleFragments.of(rays, source, self.whole_surface) if surface.is_layered else None
        seen_solids = self.solids.nodes(rays.grid) if self.solids is not None else None
        if rays.grid.step > 1 and seen_solids is None and not self._glance():
            return
        q = rays.inverse_distance(self.surface)
        points = source_points(source, rays.directions, q, self.offset_m)
        self.uv, _, self.valid = source.project_cam(points)
        self.valid &= rays.valid
        self._shaded = self.surface.is_dense or self.solids is not None
        self._exact = np.zeros((0, 0), bool)
        self._use: BoolArray | None = None
        self._whole: BoolArray | None = None
        self._fine: tuple[Slot, npt.NDArray[np.float32]] | None = None
        self._near_shadow: BoolArray | None = None
        self._clean: dict[int, npt.NDArray[np.uint8]] = {}
        self._light: dict[int, tuple[OcclusionMap, BoolArray]] = {}
        if self._shaded and not self.surface.is_guess:
            self._from_source_q = (q / np.maximum(np.sqrt((points * points).sum(-1)), 1e-300)).astype(np.float32)
        if rays.grid.step == 1:
            self.nodes = _bounds(self.valid & source.contains(self.uv, _SLACK_PX), 0)
        else:
            self.nodes = self._classify(points)
            if self.surface.is_dense:
                self._every_pixel()
        if seen_solids is not None:
            self.nodes = seen_solids if self.nodes is None else around(self.nodes, seen_solids)
        if self.surface.is_dense and self.nodes is not None:
            rays.ask(self.surface, self.nodes)

    def _look_apart(self) -> bool:
        """Whether the two cameras certainly have nothing in common."""
        nearest = float(self.rays.inverse_distance(self.whole_surface).max())
        if self.whole_surface.is_layered:
            nearest = max(nearest, float(self.rays.solids(self.whole_surface).inverse_distance.max(initial=0.0)))
        return look_apart(self.rays.camera, self.source, nearest)

    def _glance(self) -> bool:
        """Whether any cell four times as large may hold a pixel of the source."""
        directions, valid = self.rays.sparse
        q = self.rays.inverse_distance(self.surface)[self.rays.sparse_index]
        points = source_points(self.source, directions, q, self.offset_m)
        uv, _, projected = self.source.project_cam(points)
        whole, border = self._cells_that_may_see(points, uv, projected & valid)
        return bool(whole.any() or border.any())

    def _classify(self, points: FloatArray) -> Box | None:
        """Sort the cells: seeing nothing, whole, on a border of validity. Returns the nodes around those in use."""
        self._whole, border = self._cells_that_may_see(points, self.uv, self.valid)
        use = self._whole | border
        # Invalid nodes hold placeholders that may lie inside the image.
        self._use = None if self.valid.all() else use
        self._exact = border
        return _bounds(use, 1)

    def _every_pixel(self) -> None:
        """Interpolate nothing; look a little farther: between nodes the surface may come nearer than it is on them."""
        self._whole = self._use = None
        self._exact = np.zeros_like(self._exact)
        if self.nodes is not None:
            (j0, j1, i0, i1), (ny, nx), more = self.nodes, self.rays.grid.shape, _MORE_NODES
            self.nodes = max(j0 - more, 0), min(j1 + more, ny - 1), max(i0 - more, 0), min(i1 + more, nx - 1)

    def set_tolerance(self, tolerance_px: float) -> None:
        """Mark the cells whose interpolation may be off by more than this, in source pixels, for exact evaluation."""
        if self._whole is None or self.nodes is None:
            return
        curved = self._too_curved(self.nodes, tolerance_px)
        self._exact = self._exact | (self._whole & curved)
        if self._use is None and (curved & ~self._whole).any():
            self._use = self._whole  # interpolation may overshoot into the image
        counters, exact = self.rays.counters, int(np.count_nonzero(self._exact))
        counters["cells_exact"] += exact
        counters["cells_interpolated"] += int(np.count_nonzero(self._whole & ~self._exact))

    def _cells_that_may_see(self, points: FloatArray, uv: FloatArray, valid: BoolArray) -> tuple[BoolArray, BoolArray]:
        """Cells whose corners are valid and not all beyond one side of the image; such cells with an invalid corner."""
        beyond = beyond_image(self.source, points, uv, valid)
        sides = [beyond[c] for c in CORNERS]
        use = (sides[0] & sides[1] & sides[2] & sides[3]) == 0
        if valid.all():
            return use, np.zeros(use.shape, bool)
        corners = [valid[c] for c in CORNERS]
        all_valid = corners[0] & corners[1] & corners[2] & corners[3]
        touched = (corners[0] | corners[1] | corners[2] | corners[3]).astype(np.uint8)
        near = cv2.dilate(touched, np.ones((3, 3), np.uint8)) > 0
        if not self.source.is_rectilinear:
            near |= self._cells_near_lens(points)
        return use & all_valid, use & ~all_valid & near

    def _cells_near_lens(self, points: FloatArray) -> BoolArray:
        """Cells that may reach into the cone of the lens's image, although no corner of theirs may lie in it."""
        unit = points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-300)
        off_axis = np.arccos(np.clip(unit[..., 2], -1, 1))
        nearest = np.minimum.reduce([off_axis[c] for c in CORNERS])
        first, second, third, fourth = (unit[c] for c in CORNERS)
        widest = np.minimum((first * fourth).sum(-1), (second * third).sum(-1))
        return np.asarray(nearest <= self.source.cone_rad + np.arccos(np.clip(widest, -1, 1)))

    def _too_curved(self, box: Box, tolerance_px: float) -> BoolArray:
        """Cells whose interpolation may be off by more than the tolerance.

        Bilinear interpolation over a spacing s errs by at most (|f_xx| + |f_yy|) s² / 8; the cubic mid-point by
        3/128 of the fourth difference, less 5/1024 of the sixth, and so on: all are read off the nodes. Where the
        surface has creases the refinement earns nothing, and the cells' centres are evaluated too: a crease shows
        there with at least half its largest error, which the cubic may double. What reaches an invalid node, which
        holds a placeholder, cannot be interpolated at all.
        """
        bound = np.zeros(tuple(n - 1 for n in self.uv.shape[:2]))
        j0, j1, i0, i1 = box
        m0, n0 = max(j0 - 3, 0), max(i0 - 3, 0)
        around = self.uv[m0 : j1 + 4, n0 : i1 + 4]
        error = np.zeros(around.shape[:2])
        linear = _SAFETY / 8 / (4**HALVINGS if self.surface.smooth else 1)
        for axis in (0, 1):
            difference = around
            for lost, weight in enumerate((linear, _SAFETY * 3 / 128, _UNRESOLVED), start=1):
                if difference.shape[axis] < 3:
                    break
                difference = np.diff(difference, 2, axis=axis)
                beside = (lost, lost, 0, 0) if axis == 0 else (0, 0, lost, lost)
                error += weight * cv2.copyMakeBorder(larger(difference), *beside, cv2.BORDER_REPLICATE)
        cell = cv2.dilate(error, np.ones((2, 2), np.uint8), anchor=(0, 0))[j0 - m0 : j1 - m0, i0 - n0 : i1 - n0]
        if not self.surface.smooth:
            half = self.rays.grid.step / 2
            centre, _ = self._evaluate(self.rays.nodes[j0:j1, i0:i1] + half)
            uv = self.uv[j0 : j1 + 1, i0 : i1 + 1]
            mean = sum(uv[c] for c in CORNERS) / 4
            cell = np.maximum(cell, 4 * larger(mean - centre))
        bound[j0:j1, i0:i1] = cell
        curved = bound > tolerance_px
        if not self.valid.all():
            side = 2 * HALVINGS + 2
            unknown = cv2.dilate((~self.valid).view(np.uint8), np.ones((side, side), np.uint8), anchor=(HALVINGS,) * 2)
            curved |= unknown[:-1, :-1] > 0
        return np.asarray(curved)

    def _evaluate(self, pixels: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Source pixels of target pixels (..., 2) in float64, and where they are valid."""
        directions, ray_valid = ego_rays(self.rays.camera, pixels)
        q = self.surface.inverse_distance(self.rays.camera.center_m, directions)
        uv, valid = project_rays(self.source, directions, q, self.offset_m)
        return uv, valid & ray_valid

    def visible_nodes(self, level: int) -> BoolArray:
        """Nodes (ny, nx) whose scene point the source sees when its image is halved ``level`` times."""
        if not self._shaded:
            return self.valid
        shadows, lit = self._in_light(level)
        pixel, inside = nearest_pixel(shadows.beyond, at_level(self.uv, level))
        beyond = 0 if self.surface.is_guess else self._from_source_q
        free = self.valid & ~(inside & (shadows.beyond[pixel] > beyond))
        if self.solids is None:
            return free
        on_solid = self.rays.at_nodes(255 - self.rays.solids(self.whole_surface).free) > 0
        seen = np.zeros(self.rays.camera.size, bool)
        px, py = self.solids.pixels.T
        seen[py, px] = lit
        return np.where(on_solid, self.rays.at_nodes(seen), free)

    def _in_light(self, level: int) -> tuple[OcclusionMap, BoolArray]:
        """The source's shadow images when it is halved ``level`` times, and which of ``solids`` (n,) it sees."""
        if level not in self._light:
            shadows = self.whole_surface.occlusion_map(halved_camera(self.source, level))
            lit = np.zeros(0, bool)
            if self.solids is not None:
                lit = self.solids.lit(shadows, at_level(self.solids.uv, level))
            self._light[level] = shadows, lit
        return self._light[level]

    def full_resolution(
        self, slot: Slot, rows: tuple[int, int]
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.uint8], npt.NDArray[np.uint8] | None]:
        """Positions in the source and visibility over the pixels between some rows of the nodes in use.

        Args:
            slot: The source at the level it is read at, alone (``Slot.alone``). Its affine change of coordinates is
                applied to the nodes, where it is exact and costs nothing.
            rows: First and last row of nodes.

        Returns:
            (h, w, 2) float32 positions; (h, w) uint8, 255 where the source sees the pixel; (h, w) uint8, 255 where the
            pixel lies in its image, seen or not, None where these are the same. What an object shows counts where the
            background behind it does, too.
        """
        assert self.nodes is not None
        grid, source = self.rays.grid, self.source
        nodes = (*rows, *self.nodes[2:])
        if grid.step == 1:
            y0, y1, x0, x1 = grid.pixels(nodes)
            at = slot.from_source(self.uv[y0:y1, x0:x1]).astype(np.float32)
            at[~self.valid[y0:y1, x0:x1]] = -FAR_AWAY_PX
            q = self._from_source_q[y0:y1, x0:x1] if self.surface.is_dense else None
        elif self.surface.is_dense:
            box = grid.pixels(nodes)
            known = self.rays.dense(self.surface)[box[0] : box[1], box[2] : box[3]]
            at, q = project_pixels(cropped(self.rays.planes, box), known, self.rays.camera, source, slot)
        else:
            q = None
            if self._fine is None or self._fine[0] != slot:
                self._fine = slot, grid.refined(slot.from_source(self.uv).astype(np.float32), self.nodes)
            at = grid.upsample_refined(self._fine[1], self.nodes, rows)
            self._patch_exact(at, nodes, slot)
        low = slot.from_source(np.array([-_SLACK_PX, -_SLACK_PX]))
        high = slot.from_source(np.array([source.width_px - 1 + _SLACK_PX, source.height_px - 1 + _SLACK_PX]))
        # Halving leaves out the last row or column of an odd size: nothing is known there.
        high = np.minimum(high, np.array([slot.x + slot.size[1], slot.y + slot.size[0]]) - 0.5)
        visible: Any = cv2.inRange(at, tuple(low), tuple(high))
        if self._use is not None:
            visible &= grid.cells_to_pixels(self._use, nodes)
        is_masked = source.mask is not None and not source.mask.all()
        in_image = visible.copy() if q is not None or self.solids is not None or is_masked else None
        if q is not None:
            beyond = self._in_light(slot.level)[0].beyond
            visible &= cv2.compare(read_nearest(beyond, at), q, cv2.CMP_LE).astype(np.uint8)
        if self.solids is not None:
            self._put_solids(at, visible, nodes, slot)
            in_image |= visible
        if is_masked:
            if slot.level not in self._clean:
                self._clean[slot.level] = clean_pixels(source, slot.level)
            visible &= mask_at(self._clean[slot.level], at)
        if slot.level:
            # The outer half pixel of the full image lies outside the halved one: read its border pixel.
            h, w = slot.size
            at = np.clip(at, (slot.x, slot.y), (slot.x + w - 1, slot.y + h - 1), dtype=np.float32)
        return at, visible, in_image

    def _put_solids(self, at: npt.NDArray[np.float32], visible: npt.NDArray[np.uint8], nodes: Box, slot: Slot) -> None:
        """What lies in the shadow of solids is not seen; then the pixels that show solids."""
        assert self.solids is not None
        grid = self.rays.grid
        y0, y1, x0, x1 = grid.pixels(nodes)
        shadows, lit = self._in_light(slot.level)
        for part in self._parts_near_shadow(shadows.beyond, nodes, slot.level):
            t, b, le, r = grid.pixels(part)
            here = slice(t - y0, b - y0), slice(le - x0, r - x0)
            first = read_nearest(shadows.beyond, at[here])
            beyond: Any = 0 if self.surface.is_guess else grid.upsample(self._from_source_q, part)
            visible[here] *= first <= beyond  # not cv2.compare: to it a part of one or four pixels is a scalar
        visible &= self.rays.solids(self.whole_surface).free[y0:y1, x0:x1]
        solids = self.solids
        strip = slice(*np.searchsorted(solids.pixels[:, 1], [y0, y1]).tolist())
        px, py = solids.pixels[strip].T
        exact: Any = slot.from_source(solids.uv[strip])
        at[py - y0, px - x0] = exact
        visible[py - y0, px - x0] = lit[strip] * np.uint8(255)

    def _parts_near_shadow(self, shadow: npt.NDArray[np.float32], nodes: Box, level: int) -> Iterator[Box]:
        """The parts of a strip, between its rows of nodes, whose background may be read in a shadow."""
        if self.surface.is_dense:
            return  # shaded already
        if self.rays.grid.step == 1:
            yield nodes
            return
        if self._near_shadow is None:
            self._near_shadow = cells_near_shadow(shadow, at_level(self.uv, level))
        j0, j1, i0, i1 = nodes
        near: BoolArray = np.logical_or.reduce(self._near_shadow[j0:j1, i0:i1])
        for first, last in runs(near):
            part = j0, j1, i0 + first, i0 + last + 1
            _, _, x0, x1 = self.rays.grid.pixels(part)
            if x1 > x0:  # nodes lie beyond the image too
                yield part

    @cached_property
    def _exact_pixels(self) -> tuple[npt.NDArray[np.int64], FloatArray, BoolArray]:
        """Pixels (n, 2) of the cells that cannot be interpolated, in rows of cells; their source pixels; validity."""
        grid = self.rays.grid
        j, i = np.nonzero(self._exact)
        steps = np.arange(grid.step)
        first = round(grid.offset + 0.5)
        py = (first + grid.step * j)[:, None, None] + steps[None, :, None]  # [cells, step, 1]
        px = (first + grid.step * i)[:, None, None] + steps[None, None, :]
        py, px = np.broadcast_arrays(py, px)
        pixels = np.stack([px.ravel(), py.ravel()], -1)
        uv, valid = self._evaluate(pixels.astype(np.float64))
        return pixels, uv, valid

    def _patch_exact(self, at: npt.NDArray[np.float32], nodes: Box, slot: Slot) -> None:
        """Put the exactly evaluated pixels into their places."""
        j0, j1 = nodes[:2]
        if not self._exact[j0:j1].any():
            return
        y0, y1, x0, x1 = self.rays.grid.pixels(nodes)
        pixels, uv, valid = self._exact_pixels
        step, first = self.rays.grid.step, round(self.rays.grid.offset + 0.5)
        start, stop = np.searchsorted(pixels[:: step**2, 1], [first + step * j0, first + step * j1]) * step**2
        px, py = pixels[start:stop].T
        inside = (py >= y0) & (py < y1) & (px >= x0) & (px < x1)
        exact = np.clip(slot.from_source(uv[start:stop][inside]), -FAR_AWAY_PX, FAR_AWAY_PX)
        exact = np.where(valid[start:stop][inside, None], exact, -FAR_AWAY_PX)
        at[py[inside] - y0, px[inside] - x0] = exact


def _bounds(use: BoolArray, extra: int) -> Box | None:
    """First and last row and column of True entries; ``extra`` more at the end (nodes around cells)."""
    rows, columns = np.flatnonzero(use.any(axis=1)), np.flatnonzero(use.any(axis=0))
    if len(rows) == 0:
        return None
    return int(rows[0]), int(rows[-1]) + extra, int(columns[0]), int(columns[-1]) + extra
