"""Scene points of all pixels of a target, projected into a source: in float32, three planes of numbers at a time.

For surfaces that step anywhere nothing can be interpolated between coarse nodes, so every pixel is projected. A
pinhole's rays need no memory: their planes are a row and a column that broadcast. Those of a lens are inverted on a
coarse grid and interpolated, where that is precise. Positions in images of 1600 px are within 1/500 px of float64, with
interpolated rays within 1/200.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.coarse_grid import Box, Grid
from arbiview_aug.cameras.projection import FAR_AWAY_PX
from arbiview_aug.render.atlas import Slot

Layer = npt.NDArray[np.float32]

Planes = tuple[Layer, Layer, Layer]
"""x, y and z (h, w) in a camera's frame, or what broadcasts to (h, w)."""


def pixel_rays(camera: Camera) -> Planes:
    """Rays of all pixels: a pinhole's have z = 1, those of lenses unit length; 0 where there is none."""
    h, w = camera.size
    if not camera.is_rectilinear:
        planes = _interpolated_rays(camera)
        if planes is None:
            rays, valid = camera.unproject_cam(camera.pixel_grid())
            planes = tuple(np.where(valid, rays[..., k], 0).astype(np.float32) for k in range(3))
        x, y, z = planes
        return x, y, z
    K = camera.K
    v = ((np.arange(h) - K[1, 2]) / K[1, 1])[:, None]
    u = ((np.arange(w) - K[0, 2]) / K[0, 0])[None]
    x = u - K[0, 1] / K[0, 0] * v if K[0, 1] else u
    return x.astype(np.float32), v.astype(np.float32), np.ones((1, 1), np.float32)


def _interpolated_rays(camera: Camera) -> tuple[Layer, ...] | None:
    """Unit rays of all pixels from those on coarse nodes; None where a lens bends too much for that, or has no rays."""
    grid = Grid(camera.size, _STEP_PX)
    rays, valid = camera.unproject_cam(grid.nodes())
    # What Grid leaves: cubic between the nodes, bilinear over a quarter of their spacing.
    error = 0.0
    for axis in (0, 1):
        for order, share in ((2, 1 / 8 / 16), (4, 3 / 128)):
            error += share * float(np.abs(np.diff(rays, order, axis=axis)).max(initial=0.0))
    if not valid.all() or not error * float(camera.K[0, 0]) <= _RAY_PX:
        return None
    ny, nx = grid.shape
    nodes = 0, ny - 1, 0, nx - 1
    pairs = [np.ascontiguousarray(rays[..., pair], np.float32) for pair in ([0, 1], [2, 2])]
    (x, y), (z, _) = (cv2.split(grid.upsample_refined(grid.refined(pair, nodes), nodes, (0, ny - 1))) for pair in pairs)
    return x, y, z


_STEP_PX = 8
"""As plans: 25 times as fast as every pixel."""

_RAY_PX = 1 / 128
"""Half of what plans may interpolate by, as a bound; radial lenses of vehicles stay below 1/300 px, fisheyes near
their fold do not."""


def cropped(planes: Planes, box: Box) -> Planes:
    """The planes of a box of pixels."""
    y0, y1, x0, x1 = box

    def part(p: Layer) -> Layer:
        rows = slice(y0, y1) if len(p) > 1 else slice(None)
        return p[rows, x0:x1] if p.shape[1] > 1 else p[rows]

    x, y, z = map(part, planes)
    return x, y, z


def project_pixels(
    planes: Planes, inverse_distance: Layer, target: Camera, source: Camera, slot: Slot
) -> tuple[Layer, Layer]:
    """Where a source sees scene points.

    Args:
        planes: Rays of the target's pixels, (h, w).
        inverse_distance: (h, w) along them, in their lengths per metre: infinity is 0.
        target: The camera whose pixels they are.
        source: The camera that recorded the image.
        slot: Where its image lies in the atlas.

    Returns:
        Atlas positions (h, w, 2), far away where the source cannot project a point, and inverse distances (h, w) of the
        points from the source, 1/m.
    """
    q = inverse_distance
    to_source = source.cam2ego[:3, :3].T
    turn = (to_source @ target.cam2ego[:3, :3]).astype(np.float32)
    offset = (to_source @ (target.center_m - source.center_m)).astype(np.float32)
    a, b, c = planes
    work = np.empty_like(q)  # one plane of scratch memory: fresh ones cost as much as the arithmetic
    # The points times q.
    x, y, z = (turn[k, 0] * a + (turn[k, 1] * b + turn[k, 2] * c) for k in range(3))
    for axis, shift in zip((x, y, z), offset, strict=True):
        axis += np.multiply(shift, q, out=work)
    from_source = x * x
    from_source += np.multiply(y, y, out=work)
    from_source += np.multiply(z, z, out=work)
    np.maximum(np.sqrt(from_source, out=from_source), np.float32(1e-30), out=from_source)
    np.divide(q, from_source, out=from_source)
    if source.is_rectilinear:
        invalid = z <= 1e-6
        K, shrink, first = source.K.astype(np.float32), 2.0**-slot.level, slot.from_source(source.K[:2, 2])
        np.copyto(z, np.float32(1), where=invalid)
        scale = np.divide(np.float32(shrink), z, out=z)
        x *= K[0, 0]
        if K[0, 1]:
            x += np.multiply(K[0, 1], y, out=work)
        y *= K[1, 1]
        for axis, centre in ((x, first[0]), (y, first[1])):
            axis *= scale
            axis += np.float32(centre)
            np.clip(axis, -FAR_AWAY_PX, FAR_AWAY_PX, out=axis)
            np.copyto(axis, np.float32(-FAR_AWAY_PX), where=invalid)
    else:
        uv, _, valid = source.project_cam(np.stack([x, y, z], -1).astype(np.float64))
        positions = np.clip(slot.from_source(uv), -FAR_AWAY_PX, FAR_AWAY_PX)
        x, y = (np.where(valid, positions[..., k], -FAR_AWAY_PX).astype(np.float32) for k in range(2))
    at: Any = cv2.merge([x, y])
    return at, from_source
