"""What solids and dense surfaces hide from a source: its shadow images, read for coarse cells and for single pixels."""

from __future__ import annotations

from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.coarse_grid import Box, Grid
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.projection import CORNERS, source_points
from arbiview_aug.image_ops import level_size
from arbiview_aug.render.pixel_projection import Layer
from arbiview_aug.render.target_rays import TargetRays
from arbiview_aug.scene.surface import LayeredSurface, OcclusionMap

_SHADOW_TILE_PX = 8

_LEAST_INCIDENCE = 0.05
"""Sine of the flattest angle at which a source may look along a face: that of the road 30 m from a car's cameras."""


class VisibleFragments(NamedTuple):
    """The pixels showing faces that are turned to a source and project into its image, hidden by others or not.

    Attributes:
        pixels: (n, 2) target pixels, row by row.
        uv: (n, 2) source pixels.
        inverse_distance: (n,) from the source, 1/m.
        solid: (n,) which one.
    """

    pixels: npt.NDArray[np.int64]
    uv: FloatArray
    inverse_distance: FloatArray
    solid: npt.NDArray[np.int32]

    @classmethod
    def of(cls, rays: TargetRays, source: Camera, surface: LayeredSurface) -> VisibleFragments:
        _, pixels, directions, q, face = rays.solids(surface)
        offset_m = rays.camera.center_m - source.center_m
        solid, before_m = surface.facing(source.center_m, face)
        turned = before_m > 0
        if source.is_rectilinear:
            # Most solids lie beside most sources: two half-spaces are cheaper than a projection.
            K, to_source = source.K, source.cam2ego[:3, :3].T
            sides = np.stack([K[0], (source.width_px - 1) * K[2] - K[0]]) @ to_source
            left, right = sides @ directions.T + np.outer(sides @ offset_m, q)
            turned &= (left >= -1e-6) & (right >= -1e-6)
        some = np.flatnonzero(turned)
        pixels, directions, q, solid, before_m = pixels[some], directions[some], q[some], solid[some], before_m[some]
        points = source_points(source, directions, q, offset_m)
        uv, _, valid = source.project_cam(points)
        q /= np.maximum(np.sqrt((points * points).sum(-1)), 1e-300)
        inside = np.flatnonzero(valid & source.contains(uv) & (before_m * q >= _LEAST_INCIDENCE))
        return cls(pixels[inside], uv[inside], q[inside], solid[inside])

    def lit(self, shadows: OcclusionMap, at: FloatArray) -> BoolArray:
        """Which of them no other solid hides, by their positions (n, 2) in the shadow images."""
        pixel, inside = nearest_pixel(shadows.beyond, at)
        nearer = shadows.beyond[pixel] > self.inverse_distance
        return ~(inside & nearer & (shadows.solid[pixel] != self.solid))

    def nodes(self, grid: Grid) -> Box | None:
        """The nodes around all of them."""
        if len(self.pixels) == 0:
            return None
        first = round(grid.offset + 0.5) if grid.step > 1 else 0
        low = (self.pixels.min(axis=0) - first) // grid.step
        high = (self.pixels.max(axis=0) - first) // grid.step + (grid.step > 1)
        return int(low[1]), int(high[1]), int(low[0]), int(high[0])


def halved_camera(camera: Camera, level: int) -> Camera:
    """The camera of an image that was halved ``level`` times."""
    h, w = level_size(camera.size, level)
    return camera.crop(0, 0, (h << level, w << level)).resize((h, w)) if level else camera


def cells_near_shadow(shadow: npt.NDArray[np.float32], uv: FloatArray) -> BoolArray:
    """Cells (ny - 1, nx - 1) whose corners (ny, nx, 2) span a part of a shadow image that is not free of shadow."""
    tile = _SHADOW_TILE_PX
    h, w = shadow.shape
    rows, columns = -(-h // tile), -(-w // tile)
    dark = np.zeros((rows * tile, columns * tile), np.uint8)
    dark[:h, :w] = np.uint8(255) * (shadow > 0)
    count = cv2.integral((cv2.resize(dark, (columns, rows), interpolation=cv2.INTER_AREA) > 0).astype(np.uint8))
    (x0, x1), (y0, y1) = (_tiles_between(uv[..., k], n) for k, n in enumerate((columns, rows)))
    return np.asarray(count[y1, x1] - count[y0, x1] - count[y1, x0] + count[y0, x0] > 0)


def _tiles_between(position: FloatArray, count: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """First and last (exclusive) tile along one axis that a cell's corners span, a pixel of slack included: maps bulge
    between the corners, and positions are rounded."""
    scaled = np.clip(position / _SHADOW_TILE_PX, -2, count + 2)
    slack = 1 / _SHADOW_TILE_PX
    corners = [scaled[c] for c in CORNERS]
    low, high = (f(f(corners[0], corners[1]), f(corners[2], corners[3])) for f in (np.minimum, np.maximum))
    first, last = np.floor(low - slack), np.floor(high + slack) + 1
    return first.clip(0, count).astype(np.int64), last.clip(0, count).astype(np.int64)


def read_nearest(image: Layer, at: Layer) -> Any:
    """Values (h, w) of a source's image at the pixels nearest to positions (h, w, 2), 0 outside it."""
    return cv2.remap(image, at, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)  # type: ignore[call-overload]


def nearest_pixel(image: npt.NDArray[Any], at: FloatArray) -> tuple[tuple[Any, Any], BoolArray]:
    """Rows and columns (...,) nearest to positions (..., 2), and where those lie in the image; elsewhere they are 0."""
    h, w = image.shape
    u, v = np.rint(at[..., 0]), np.rint(at[..., 1])
    inside = (u >= 0) & (u < w) & (v >= 0) & (v < h)
    return (np.where(inside, v, 0).astype(np.int64), np.where(inside, u, 0).astype(np.int64)), inside
