"""Slow float64 answers for single rays: the reference of what surfaces draw into whole images."""

from __future__ import annotations

import numpy as np

from arbiview_aug.scene.boxes import BoxSurface, meets
from arbiview_aug.scene.panorama import SIDE_RAD
from arbiview_aug.scene.point_cloud import COARSE, Panorama, PointCloudSurface, PointCloudWithBoxes
from arbiview_aug.scene.scanned_objects import BOX_AIR_M, RASTER_RAD, ScannedObject
from arbiview_aug.scene.surface import MAX_INVERSE_DISTANCE, StaticSurface, Surface


def inverse_distance(surface: Surface, origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """1/m (...,) at which unit rays (..., 3) meet a surface."""
    if isinstance(surface, StaticSurface):
        return surface.inverse_distance(origin, directions)
    if isinstance(surface, BoxSurface):
        first, _ = boxes_ahead(surface.boxes, origin, directions)
        shown = first > 0
        if isinstance(surface, PointCloudWithBoxes):
            shown &= first >= occlusion_depth(surface.street, origin, directions, widened=False)
        return np.where(shown, first, inverse_distance(surface.street, origin, directions))
    assert isinstance(surface, PointCloudSurface)
    view = surface.view(np.asarray(origin, np.float64), directions)
    near, far, share = (layer_at(view, layer, directions) for layer in view.layers[:3])
    q = surface.street.inverse_distance(origin, directions) + np.where(share > 0.5, near, far)
    flat = q.reshape(-1)
    for met, own, behind in _objects_on(surface, origin, directions):
        shown = (own > 0) & (flat[met] < behind)
        flat[met[shown]] = own[shown]
    return np.clip(q, 0.0, MAX_INVERSE_DISTANCE)


def occludes(
    surface: Surface, origin: np.ndarray, directions: np.ndarray, q: np.ndarray, pixel_rad: float
) -> np.ndarray:
    """Whether something stands between a source's centre and points (...,) at inverse distances along unit rays."""
    if isinstance(surface, PointCloudSurface):
        return q < occlusion_depth(surface, origin, directions)
    assert isinstance(surface, BoxSurface)
    first, _ = boxes_ahead(surface._enlarged(origin, pixel_rad), origin, directions)
    if surface.street.is_guess:
        return first > 0
    return (first > q * (1 + 2 * pixel_rad)) | occludes(surface.street, origin, directions, q, pixel_rad)


def occlusion_depth(
    surface: PointCloudSurface, origin: np.ndarray, directions: np.ndarray, widened: bool = True
) -> np.ndarray:
    """Inverse distances (...,) beyond which points hide what is behind them."""
    view = surface.view(np.asarray(origin, np.float64), directions, COARSE if widened else None)
    depth = layer_at(view, view.hidden_below, directions)
    flat = depth.reshape(-1)
    for met, own, behind in _objects_on(surface, origin, directions):
        flat[met] = np.maximum(flat[met], behind if widened else np.where(own > 0, behind, 0))
    return depth


def layer_at(view: Panorama, layer: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Bilinear values (...,) of a panorama's layer along unit rays (..., 3); its border beyond it."""
    (first, lead, low), rad = view.window.place[:3].astype(np.float64), view.window.cells.rad
    azimuth, elevation = (
        np.arctan2(directions[..., 1], directions[..., 0]),
        np.arcsin(np.clip(directions[..., 2], -1, 1)),
    )
    column = lead + ((azimuth - first) / rad - lead) % (2 * np.pi / rad)
    at = [np.clip(a, 0, n - 1) for a, n in zip(((elevation - low) / rad, column), layer.shape, strict=True)]
    (r, c), (s, t) = (a.astype(int) for a in at), (a % 1 for a in at)
    r1, c1 = (np.minimum(a + 1, n - 1) for a, n in zip((r, c), layer.shape, strict=True))
    above, below = layer[r, c] * (1 - t) + layer[r, c1] * t, layer[r1, c] * (1 - t) + layer[r1, c1] * t
    return np.asarray(above * (1 - s) + below * s)


def boxes_ahead(boxes: np.ndarray, origin: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse distance (...,) to the first box along each ray, 0 for none, and the face's number, -1 for none."""
    rays = directions.reshape(-1, 3)
    q, face = np.zeros(len(rays)), np.full(len(rays), -1)
    for row, box in enumerate(boxes):
        enter, leave, number, holds = _through(box, origin, rays)
        nearest = np.where((leave >= enter) & (enter > 0), 1 / np.maximum(enter, 1 / MAX_INVERSE_DISTANCE), 0.0)
        first = (nearest > q) & (not holds)
        q[first], face[first] = nearest[first], 6 * row + number[first]
    return q.reshape(directions.shape[:-1]), face.reshape(directions.shape[:-1])


def _through(box: np.ndarray, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, bool]:
    """Distances (n,) at which rays enter and leave a box, the face they enter by, and whether it holds the origin."""
    c, s = np.cos(box[6]), np.sin(box[6])
    to_box = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    start, half, local = to_box @ (origin - box[:3]), box[3:6] / 2, rays @ to_box.T
    local = np.where(np.abs(local) < 1e-12, 1e-12, local)
    one, two = (-half - start) / local, (half - start) / local
    near, far = np.minimum(one, two), np.maximum(one, two)
    axis = near.argmax(axis=-1)
    number = 2 * axis + (np.take_along_axis(local, axis[:, None], axis=-1)[:, 0] < 0)
    return near.max(axis=-1), far.min(axis=-1), number, bool((np.abs(start) <= half).all())


def _objects_on(
    surface: PointCloudSurface, origin: np.ndarray, directions: np.ndarray
) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """For each scanned object the rays that meet its box, its inverse distances, and those at which they leave it."""
    rays = directions.reshape(-1, 3)
    found = []
    for one in surface.objects:
        met = np.flatnonzero(meets(one.box, origin, rays))
        found.append((met, *_scanned(one, origin, rays[met])))
    return found


def _scanned(one: ScannedObject, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    place, nearest, top = one.raster(np.asarray(origin, np.float64))
    if not nearest.size or not len(rays):
        return np.zeros(len(rays)), np.zeros(len(rays))
    azimuth, elevation = np.arctan2(rays[:, 1], rays[:, 0]), np.arcsin(np.clip(rays[:, 2], -1, 1))
    column = ((azimuth - place[0] + np.pi) % (2 * np.pi) - np.pi) / RASTER_RAD
    height = (elevation - place[2]) / RASTER_RAD
    h, w = nearest.shape
    # Its outline runs half a cell beyond the outermost points.
    across = (column >= -0.5) & (column <= w - 0.5)
    highest = np.interp(column, np.arange(w), top)
    row = np.clip(np.round(height), 0, h - 1).astype(np.intp)
    own = nearest[row, np.clip(np.round(column), 0, w - 1).astype(np.intp)]
    wide = one.box + 2 * BOX_AIR_M * np.array([0, 0, 0, 1, 1, 1, 0])
    behind = 1 / np.maximum(_through(wide, origin, rays)[1], 1 / MAX_INVERSE_DISTANCE)
    hides = across & (height <= highest + SIDE_RAD / RASTER_RAD)
    return np.where(across & (height <= highest), own, 0.0), np.where(hides, behind, 0.0)
