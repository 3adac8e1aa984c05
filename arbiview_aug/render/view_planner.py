"""How one target view is rendered: which sources see it, over which surface, who wins each pixel, blended seams."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.coarse_grid import Box, runs
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.projection import clean_pixels, edge_distance, resolution
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.favs.config import FavsConfig
from arbiview_aug.favs.stage4_fusion import distance_weight, primary_weight, quality_weight
from arbiview_aug.image_ops import Scratch, level_size
from arbiview_aug.render.atlas import AtlasLayout, FixedMap
from arbiview_aug.render.confidence import certainty
from arbiview_aug.render.requirements import SAME_CENTER_M, covers_target_exactly
from arbiview_aug.render.target_rays import TargetRays
from arbiview_aug.render.view_plan import BilinearFallback, BlendRegion, SourceUse, ViewPlan
from arbiview_aug.render.warp_maps import WarpMap
from arbiview_aug.scene.scene import SURFACES
from arbiview_aug.scene.static import is_within_wall, worst_parallax_px
from arbiview_aug.scene.surface import Surface

_STRIP_PX = 128  # rows worked on at once: they fit a cache, and slanted seams make narrow rectangles
MAGNIFIED = 0.8
"""A view is read by cubics where it has this few source pixels per pixel, or fewer, and most of it is read at its own
centre: it is sharper for it, and a cubic costs 2.6 to 4.7 times as much. On synthetic streets, dB over bilinear by
source pixels per pixel: 0.57 +0.6, 0.73 +0.7 (there a detector recovers 91 instead of 77 % of the gap), 0.94 +0.5, 1.06
+0.1, 1.3 -0.2. Real frames turned by up to 35 degrees, 0.8 to 1, gain nothing: -0.04 dB on DDAD. Nor do other centres,
where the surface is what errs: 0.7 m higher -0.1 dB, and the detector 75 instead of 77 %."""

_LEAST_SHARE = 1 / 256  # a source that adds less than this to a pixel cannot change a grey level


@dataclass
class _Region:
    """What one source contributes to one target."""

    source: int
    level: int
    surface: str
    reason: str
    baseline_m: float
    pair: WarpMap
    score: npt.NDArray[np.float32]  # [ny, nx] stage-4 weight on the nodes, 0 where not visible
    parallax: npt.NDArray[np.float32]  # [ny, nx] expected displacement, target pixels
    border_px: npt.NDArray[np.float32]  # [ny, nx] distance to the border of what the source sees, target pixels
    fineness: float  # median of the pixels, as they are read, per target pixel
    certainty: npt.NDArray[np.float32] | None  # [ny, nx] in 255ths, if asked for


@dataclass(frozen=True)
class _Visible:
    """A strip of a region at full resolution."""

    source: int
    box: Box  # y0, y1, x0, x1
    at: FixedMap  # [box h, box w] atlas positions
    visible: npt.NDArray[np.uint8]  # [box h, box w] 255 where the source sees the pixel
    in_image: npt.NDArray[np.uint8] | None  # [box h, box w] 255 where its image contains the pixel, if that differs
    weight: npt.NDArray[np.float32]  # [box h, box w] seam weight
    certainty: npt.NDArray[np.uint8] | None  # [box h, box w]


class ViewPlanner:
    """Builds one target's plan in two steps: what each source sees, then who wins and where seams are blended."""

    def __init__(
        self,
        source: Rig,
        order: list[int],
        camera: Camera,
        surface: str,
        best: str,
        surface_by_name: Callable[[str], Surface],
        config: FavsConfig,
        counters: Counter[str],
    ) -> None:
        self.source, self.camera, self.surface, self.config = source, camera, surface, config
        self.best, self.surface_by_name = best, surface_by_name
        self.counters = counters
        # From outside, the far wall is a narrow strip with edges, which a coarse grid could step over.
        coarse = is_within_wall(camera.center_m) or not SURFACES[surface].has_wall
        step = config.grid_step_px if coarse else 1
        self.rays = TargetRays(camera, step, counters)
        self.grid = self.rays.grid
        # In content order, so that ties never depend on the order of the source list.
        self.regions = [region for k in self._required(order) if (region := self._region(k)) is not None]

    # --- what a source sees -------------------------------------------------------------------------------------------
    def _required(self, order: list[int]) -> list[int]:
        """The sources that can win a pixel: where one serves the target alone, those at its centre."""
        if not any(covers_target_exactly(self.source[k], self.camera, self.config) for k in order):
            return order
        self.counters["served_alone"] += 1
        return [k for k in order if self._baseline_m(k) < SAME_CENTER_M]

    def _baseline_m(self, index: int) -> float:
        return float(np.linalg.norm(self.camera.center_m - self.source[index].center_m))

    def _choose_surface(self, baseline_m: float, focal_px: float) -> tuple[str, str]:
        if baseline_m < SAME_CENTER_M:
            return "far", "centres coincide: exact"
        if self.surface != "auto":
            return self.surface, "asked for"
        worst = worst_parallax_px(baseline_m, focal_px)
        if worst < self.config.far_parallax_px:
            return "far", f"worst-case parallax {worst:.2f} px"
        return self.best, f"centres {baseline_m:.2f} m apart"

    def _region(self, index: int) -> _Region | None:
        source = self.source[index]
        offset_m = self.camera.center_m - source.center_m
        baseline_m = self._baseline_m(index)
        focal_px = float(self.camera.K[0, 0])
        name, reason = self._choose_surface(baseline_m, focal_px)
        surface = self.surface_by_name(name)
        pair = WarpMap(self.rays, source, surface)
        if pair.nodes is None:
            return None
        self.counters[f"pairs_{name}"] += 1
        pixels_per_pixel = resolution(pair.uv, self.grid.step)
        edge_px = edge_distance(source, pair.uv)
        seen = pair.valid & (edge_px > 0)
        level = self._level(pixels_per_pixel[seen], source.size) if self.config.antialias else 0
        pair.set_tolerance(self.config.map_tolerance_px * 2**level * pair.surface.tolerance_scale)
        seen = pair.visible_nodes(level) & (edge_px > 0)
        parallax = self._expected_parallax(offset_m, focal_px, surface)
        score = (
            distance_weight(edge_px, min(source.size) / 2, self.config.distance_gamma)
            * quality_weight(parallax, pixels_per_pixel)
            * primary_weight(baseline_m < SAME_CENTER_M, self.config.primary_bonus)
        )
        return _Region(
            source=index,
            level=level,
            surface=name,
            reason=reason,
            baseline_m=baseline_m,
            pair=pair,
            score=self.grid.extended(np.where(seen, score, 0).astype(np.float32)),
            parallax=parallax.astype(np.float32),
            border_px=(edge_px / np.maximum(pixels_per_pixel, 1e-3)).astype(np.float32),
            fineness=float(np.median(pixels_per_pixel[seen])) / 2**level if seen.any() else 1.0,
            certainty=self._certainty(pair, parallax / focal_px, pixels_per_pixel) if self.config.certainty else None,
        )

    def _certainty(
        self, pair: WarpMap, parallax_rad: FloatArray, pixels_per_pixel: FloatArray
    ) -> npt.NDArray[np.float32]:
        """Certainty on the nodes in 255ths; nodes that the source cannot see take the mean of those around them."""
        valid = pair.valid.astype(np.float32)
        known = np.where(pair.valid, 255 * certainty(parallax_rad, pixels_per_pixel), 0).astype(np.float32)
        if pair.valid.all():
            return self.grid.extended(known)
        total, count = (cv2.blur(part, (5, 5), borderType=cv2.BORDER_REPLICATE) for part in (known, valid))
        return self.grid.extended(np.where(pair.valid, known, total / np.maximum(count, 1e-6)))

    def _expected_parallax(self, offset_m: FloatArray, focal_px: float, surface: Surface) -> FloatArray:
        """Displacement (target px) that unknown depth around a surface may cause: offset across the ray x spread."""
        along_m = self.rays.directions @ offset_m
        across_m = np.sqrt(np.maximum(offset_m @ offset_m - along_m**2, 0))
        return focal_px * across_m * self.rays.uncertainty(surface)

    @staticmethod
    def _level(resolution: FloatArray, size: tuple[int, int]) -> int:
        """Halvings: the largest power of two not above the minification, of most of what is seen."""
        if resolution.size == 0:
            return 0
        # 2 % of tolerance: a target of exactly half size must read the halved source.
        level = int(max(0, math.floor(math.log2(max(1.02 * float(np.quantile(resolution[::4], 0.2)), 1e-6)))))
        while level and min(level_size(size, level)) < 2:
            level -= 1
        return level

    # --- who wins -----------------------------------------------------------------------------------------------------
    def finish(self, layout: AtlasLayout, scratch: Scratch) -> ViewPlan:
        """Winners, maps into the atlas, and blended bands; strip by strip, so that the work stays in the cache."""
        h, w = self.camera.size
        fixed = FixedMap.outside((h, w))
        winner = np.full((h, w), -1, np.int8)
        in_image: npt.NDArray[np.uint8] | None = None
        certain = np.zeros((h, w), np.uint8) if self.config.certainty else None
        weights = self._seam_weights()
        shared = np.count_nonzero([weight > 0 for weight in weights], axis=0) > 1
        bands: list[BlendRegion] = []
        won_px: Counter[int] = Counter()
        for rows in self.grid.strips(_STRIP_PX):
            y0, y1, _, _ = self.grid.pixels((*rows, 0, 0))
            best = scratch.get("best", (y1 - y0, w), np.float32)
            best.fill(-1)  # a source that sees a pixel beats none, even with a weight of 0
            seen = []
            for region, weight in zip(self.regions, weights, strict=True):
                part = self._visible(region, weight, rows, layout)
                if part is None:
                    continue
                seen.append(part)
                top, bottom, left, right = part.box
                held = best[top - y0 : bottom - y0, left:right]
                wins: Any = cv2.bitwise_and(part.visible, cv2.compare(part.weight, held, cv2.CMP_GT))
                cv2.copyTo(part.weight, wins, held)
                fixed.part(slice(top, bottom), slice(left, right)).put(part.at, wins)
                own = np.full(wins.shape, region.source, np.int8)
                cv2.copyTo(own, wins, winner[top:bottom, left:right])
                if part.in_image is not None:
                    in_image = np.zeros((h, w), np.uint8) if in_image is None else in_image
                    in_image[top:bottom, left:right] |= part.in_image
                if certain is not None and part.certainty is not None:
                    cv2.copyTo(part.certainty, wins, certain[top:bottom, left:right])
            for part in seen:
                won = cv2.inRange(winner[y0:y1], part.source, part.source)  # type: ignore[call-overload]
                won_px[part.source] += cv2.countNonZero(won)
            if len(seen) > 1 and self.config.seam_width > 0:
                bands.extend(self._bands(seen, winner, shared, rows))
        interpolation = self._interpolation(won_px)
        if interpolation == "nearest":
            fixed = fixed.rounded()
        edge = self._edge(fixed, winner, layout) if interpolation == "cubic" else None
        reports = tuple(self._reports(winner, won_px))
        return ViewPlan(fixed, winner, tuple(bands), reports, interpolation, certain, edge, _occluded(winner, in_image))

    def _interpolation(self, won_px: Counter[int]) -> str:
        """Cubic where it is asked for and the view magnifies, by ``MAGNIFIED``, what lies at its own centre."""
        if self.config.interpolation != "cubic":
            return self.config.interpolation
        exact = [region for region in self.regions if region.baseline_m < SAME_CENTER_M]
        won = sum(won_px[region.source] for region in exact)
        total = sum(region.fineness * won_px[region.source] for region in exact)
        most = 2 * won > sum(won_px.values())
        return "cubic" if most and total <= MAGNIFIED * won else "linear"

    def _edge(self, fixed: FixedMap, winner: npt.NDArray[np.int8], layout: AtlasLayout) -> BilinearFallback:
        """The pixels whose cubics, 4 x 4 pixels from one before ``fixed.xy``, leave the source or touch its mask."""
        edge = np.zeros(winner.shape, np.uint8)
        for region in self.regions:
            slot = layout.slot(region.source, region.level)
            (h, w), source = slot.size, self.source[region.source]
            own: Any = cv2.inRange(winner, region.source, region.source)  # type: ignore[call-overload]
            low, high = (slot.x + 1, slot.y + 1), (slot.x + w - 3, slot.y + h - 3)
            inside: Any = cv2.inRange(fixed.xy, low, high)  # type: ignore[call-overload]
            if source.mask is not None and not source.mask.all():
                clean = cv2.erode(clean_pixels(source, region.level), np.ones((4, 4), np.uint8), anchor=(1, 1))
                at = fixed.xy - np.array([slot.x, slot.y], np.int16)
                inside &= cv2.remap(clean, at, None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
            cv2.bitwise_or(edge, cv2.bitwise_and(own, cv2.bitwise_not(inside)), dst=edge)
        y, x = np.nonzero(edge)
        there = FixedMap(fixed.xy[y, x][None], fixed.frac[y, x][None])
        return BilinearFallback(y.astype(np.int64) * winner.shape[1] + x, there)

    def _visible(
        self, region: _Region, weight: npt.NDArray[np.float32], rows: tuple[int, int], layout: AtlasLayout
    ) -> _Visible | None:
        """One strip of a region at full resolution, or nothing."""
        assert region.pair.nodes is not None
        j0, j1, i0, i1 = region.pair.nodes
        nodes = (max(j0, rows[0]), min(j1, rows[1]), i0, i1)
        box = self.grid.pixels(nodes)
        if box[1] <= box[0] or box[3] <= box[2]:
            return None
        slot = layout.slot(region.source, region.level)
        at, visible, in_image = region.pair.full_resolution(slot.alone(), nodes[:2])
        certain = None
        if region.certainty is not None:
            certain = np.round(self.grid.upsample(region.certainty, nodes)).astype(np.uint8)
        fixed = FixedMap.in_slot(at, slot)
        return _Visible(region.source, box, fixed, visible, in_image, self.grid.upsample(weight, nodes), certain)

    def _seam_weights(self) -> list[npt.NDArray[np.float32]]:
        """Weights on the nodes: each source's winning area, softened over the seam width, fading at its own border."""
        scores = [region.score for region in self.regions]
        width_px = self.config.seam_width * self.camera.width_px
        if width_px == 0 or len(scores) < 2:
            return scores
        best = np.maximum.reduce(scores)
        radius = max(1, round(width_px / self.grid.step / 2))
        weights: list[npt.NDArray[np.float32]] = []
        taken = np.zeros(best.shape, bool)
        for region, score in zip(self.regions, scores, strict=True):
            label = (score == best) & (score > 0) & ~taken
            taken |= label
            # Two passes of a box make a smooth ramp.
            soft = label.astype(np.float32)
            for _ in range(2):
                soft = cv2.blur(soft, (2 * radius + 1, 2 * radius + 1), borderType=cv2.BORDER_REPLICATE)
            weights.append(soft * np.clip(region.border_px / width_px, 0, 1))
        return weights

    def _bands(
        self, seen: list[_Visible], winner: npt.NDArray[np.int8], shared: BoolArray, rows: tuple[int, int]
    ) -> Iterator[BlendRegion]:
        """The blended rectangles of one strip: runs of node columns where two sources have weight."""
        # Pixels lie between nodes: one node more on each side.
        columns = np.logical_or.reduce(shared[max(rows[0] - 1, 0) : rows[1] + 2])
        columns[1:] |= columns[:-1].copy()
        columns[:-1] |= columns[1:].copy()
        for i0, i1 in runs(columns):
            yield from self._bands_in(self.grid.pixels((*rows, i0, i1)), seen, winner)

    def _bands_in(self, box: Box, seen: list[_Visible], winner: npt.NDArray[np.int8]) -> Iterator[BlendRegion]:
        """The second sources within one rectangle of pixels."""
        y0, y1, x0, x1 = box
        local = [(s, common) for s in seen if (common := _overlap(box, s.box)) is not None]
        if y1 <= y0 or x1 <= x0 or len(local) < 2:
            return
        weight = np.zeros((len(local), y1 - y0, x1 - x0), np.float32)
        for k, (s, common) in enumerate(local):
            mine, here = _within(s.box, common), _within(box, common)
            weight[k][here] = np.where(s.visible[mine] > 0, s.weight[mine], 0)
        index = np.array([s.source for s, _ in local])
        is_winner = winner[None, y0:y1, x0:x1] == index[:, None, None]
        first = np.where(is_winner, weight, 0).max(axis=0)
        others = np.where(is_winner, 0, weight)
        second, second_weight = others.argmax(axis=0), others.max(axis=0)
        share = second_weight / np.maximum(first + second_weight, 1e-30)
        for k, (s, common) in enumerate(local):
            adds = (second == k) & (share >= _LEAST_SHARE)
            if not adds.any():
                continue
            ys, xs = np.flatnonzero(adds.any(axis=1)), np.flatnonzero(adds.any(axis=0))
            tight = (slice(ys[0], ys[-1] + 1), slice(xs[0], xs[-1] + 1))
            # Where this source adds nothing its positions may lie in a neighbour in the atlas: read nothing there.
            positions = FixedMap.outside(adds.shape)
            here = _within(box, common)
            positions.part(*here).put(s.at.part(*_within(s.box, common)), adds[here].view(np.uint8))
            part = np.where(adds, share, 0).astype(np.float32)[tight]
            yield BlendRegion(y0 + int(ys[0]), x0 + int(xs[0]), s.source, positions.part(*tight).copy(), part)

    def _reports(self, winner: npt.NDArray[np.int8], won_px: Counter[int]) -> Iterator[SourceUse]:
        """What each source that wins any pixel does, largest share first."""
        # Node values are read at the pixel nearest to each node: precise enough for a report.
        pixel = np.round(self.rays.nodes[:, :1, 1]), np.round(self.rays.nodes[:1, :, 0])
        y, x = (p.astype(np.int64).clip(0, n - 1) for p, n in zip(pixel, self.camera.size, strict=True))
        on_nodes = winner[y, x]
        for region in sorted(self.regions, key=lambda r: -won_px[r.source]):
            if won_px[region.source] == 0:
                continue
            won = region.parallax[on_nodes == region.source]
            yield SourceUse(
                source=region.source,
                surface=region.surface,
                reason=region.reason,
                baseline_m=region.baseline_m,
                parallax_px=float(np.median(won)) if won.size else 0.0,
                share=won_px[region.source] / winner.size,
                level=region.level,
            )


def _occluded(winner: npt.NDArray[np.int8], in_image: npt.NDArray[np.uint8] | None) -> BoolArray | None:
    """Pixels (h, w) without a winner that lie in some source's image; None where there are none."""
    if in_image is None:
        return None
    occluded = (winner < 0) & (in_image > 0)
    return occluded if occluded.any() else None


def _within(box: Box, part: Box) -> tuple[slice, slice]:
    """Rows and columns of a part of a pixel box, counted in the box."""
    return slice(part[0] - box[0], part[1] - box[0]), slice(part[2] - box[2], part[3] - box[2])


def _overlap(one: Box, two: Box) -> Box | None:
    """The common part of two pixel boxes, or nothing."""
    y0, y1, x0, x1 = max(one[0], two[0]), min(one[1], two[1]), max(one[2], two[2]), min(one[3], two[3])
    return (y0, y1, x0, x1) if y1 > y0 and x1 > x0 else None
