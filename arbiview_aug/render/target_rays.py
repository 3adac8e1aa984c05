"""A target camera's viewing rays, and what they meet: evaluated once, whichever sources see it."""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.coarse_grid import Box, Grid, around
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.projection import ego_rays
from arbiview_aug.render.pixel_projection import Layer, Planes, cropped, pixel_rays
from arbiview_aug.scene.surface import DenseSurface, LayeredSurface, Surface


class SolidPixels(NamedTuple):
    """The pixels of an image that show solids of a ``LayeredSurface`` surface, row by row.

    Attributes:
        free: (h, w) uint8, 255 at all other pixels.
        pixels: (n, 2) int64.
        directions: (n, 3) unit rays in the ego frame.
        inverse_distance: (n,) 1/m.
        face: (n,) as in ``Drawn``.
    """

    free: npt.NDArray[np.uint8]
    pixels: npt.NDArray[np.int64]
    directions: FloatArray
    inverse_distance: FloatArray
    face: npt.NDArray[np.int32]


class TargetRays:
    """A target camera's viewing rays on the nodes of its grid, and where they meet each surface asked for.

    ``sparse`` holds every fourth node, for a first glance at each source.
    """

    def __init__(self, camera: Camera, step: int, counters: Counter[str]) -> None:
        self.camera, self.counters = camera, counters
        self.grid = Grid.for_size(camera.size, step)
        self.nodes = self.grid.nodes()
        self.directions, self.valid = ego_rays(camera, self.nodes)
        self._inverse: dict[Surface, FloatArray] = {}
        self._uncertainty: dict[Surface, FloatArray] = {}
        self._solids: dict[LayeredSurface, SolidPixels] = {}
        self._dense: dict[DenseSurface, Layer] = {}
        self._asked: dict[DenseSurface, Box] = {}
        ny, nx = self.grid.shape
        self.sparse_index = np.ix_(np.unique(np.r_[0:ny:4, ny - 1]), np.unique(np.r_[0:nx:4, nx - 1]))
        planes = np.ascontiguousarray(np.moveaxis(self.directions[self.sparse_index], -1, 0))
        self.sparse = np.moveaxis(planes, 0, -1), self.valid[self.sparse_index]

    def inverse_distance(self, surface: Surface) -> FloatArray:
        """(ny, nx) on the nodes; evaluated once for each surface."""
        if surface not in self._inverse:
            self._inverse[surface] = self._evaluated(surface)
            self.counters[f"surface_{type(surface).__name__.lower()}"] += 1
        return self._inverse[surface]

    def uncertainty(self, surface: Surface) -> FloatArray:
        """(ny, nx) of the inverse distances; evaluated once for each surface."""
        if surface not in self._uncertainty:
            q = self.inverse_distance(surface)
            self._uncertainty[surface] = surface.uncertainty(self.camera.center_m, self.directions, q)
        return self._uncertainty[surface]

    def _evaluated(self, surface: Surface) -> FloatArray:
        if not isinstance(surface, LayeredSurface):
            return surface.inverse_distance(self.camera.center_m, self.directions)
        # Solids are drawn at pixel centres; what a node between pixels shows is read at the one above and left of it.
        background, solids = self.inverse_distance(surface.background), self.solids(surface)
        near = np.zeros(self.camera.size)
        near[solids.pixels[:, 1], solids.pixels[:, 0]] = solids.inverse_distance
        return np.maximum(background, self.at_nodes(near))

    def at_nodes(self, image: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values (ny, nx) of the image's type at the pixel nearest to each node, 0 or False outside the image."""
        h, w = self.camera.size
        x, y = (np.floor(self.nodes[..., k]).astype(np.int64) for k in (0, 1))
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        return np.where(inside, image[y.clip(0, h - 1), x.clip(0, w - 1)], image.dtype.type(0))

    def solids(self, surface: LayeredSurface) -> SolidPixels:
        """The target's pixels that show solids; drawn once for each surface."""
        if surface not in self._solids:
            index, inverse_distance, face = surface.drawn(self.camera)
            y, x = np.divmod(index, self.camera.width_px)
            pixels = np.stack([x, y], axis=-1)
            directions, _ = ego_rays(self.camera, pixels.astype(np.float64))
            free = np.full(self.camera.size, 255, np.uint8)
            free.reshape(-1)[index] = 0
            self._solids[surface] = SolidPixels(free, pixels, directions, inverse_distance, face)
            self.counters["solid_pixels"] += len(pixels)
        return self._solids[surface]

    @cached_property
    def planes(self) -> Planes:
        """Rays of all pixels."""
        return pixel_rays(self.camera)

    def ask(self, surface: DenseSurface, nodes: Box) -> None:
        """Say that the pixels between some nodes will be asked for, before any are: no others are evaluated."""
        held = self._asked.get(surface, nodes)
        self._asked[surface] = around(held, nodes)

    def dense(self, surface: DenseSurface) -> Layer:
        """Inverse distances (h, w) along ``planes``, in their lengths; evaluated once for each surface, where asked."""
        if surface not in self._dense:
            q = np.zeros(self.camera.size, np.float32)
            y0, y1, x0, x1 = box = self.grid.pixels(self._asked[surface])
            x, y, z = cropped(self.planes, box)
            part = self.camera.crop(y0, x0, (y1 - y0, x1 - x0))
            q[y0:y1, x0:x1] = surface.image(part) * np.sqrt(x * x + (y * y + z * z))
            self._dense[surface] = q
            self.counters["dense_pixels"] += (y1 - y0) * (x1 - x0)
        return self._dense[surface]
