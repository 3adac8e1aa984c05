"""Slow float64 answers for single rays: the reference of what surfaces draw into whole images."""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import MAX_INVERSE_DISTANCE, pixel_rays
from arbiview_aug.image_ops import FRESH
from arbiview_aug.scene.boxes import BoxSurface
from arbiview_aug.scene.point_cloud import COARSE, Cells, Panorama, PointCloudSurface
from arbiview_aug.scene.scene import Scene
from arbiview_aug.scene.surface import StaticSurface, Surface


def points_and_boxes(points: np.ndarray, boxes: np.ndarray) -> Any:
    """Boxes (B, 7) among points (P, 3) on a street at 0 m."""
    return Scene(boxes, points).surface("lidar", 0.0)


def inverse_distance(
    surface: Surface, origin: np.ndarray, directions: np.ndarray, pixel_rad: float = 0.0, camera: Camera | None = None
) -> np.ndarray:
    """1/m (...,) at which unit rays (..., 3) meet a surface, as a camera of such pixels shows it."""
    if isinstance(surface, StaticSurface):
        return surface.inverse_distance(origin, directions)
    if isinstance(surface, BoxSurface):
        first, _ = solids_ahead(*surface._widened(origin, pixel_rad), origin, directions)
        shown = first > 0
        if isinstance(surface.street, PointCloudSurface):
            shown &= first >= occlusion_depth(surface.street, origin, directions, coarse=False)
        return np.where(shown, first, inverse_distance(surface.street, origin, directions))
    assert isinstance(surface, PointCloudSurface)
    view = panorama(surface, origin, directions, surface._cells(camera), camera)
    near, far, share = (layer_at(view, layer, directions) for layer in view.layers[:3])
    q = surface.street.inverse_distance(origin, directions) + np.where(share > 0.5, near, far)
    return np.clip(q, 0.0, MAX_INVERSE_DISTANCE)


def occludes(
    surface: Surface, origin: np.ndarray, directions: np.ndarray, q: np.ndarray, pixel_rad: float
) -> np.ndarray:
    """Whether something stands between a source's centre and points (...,) at inverse distances along unit rays."""
    if isinstance(surface, PointCloudSurface):
        return q < occlusion_depth(surface, origin, directions)
    assert isinstance(surface, BoxSurface)
    first, _ = solids_ahead(*surface._widened(origin, pixel_rad, lift=0.5), origin, directions)
    if surface.street.is_guess:
        return first > 0
    return (first > q * (1 + 2 * pixel_rad)) | occludes(surface.street, origin, directions, q, pixel_rad)


def occlusion_depth(
    surface: PointCloudSurface,
    origin: np.ndarray,
    directions: np.ndarray,
    coarse: bool = True,
    camera: Camera | None = None,
) -> np.ndarray:
    """Inverse distances (...,) beyond which points hide what is behind them."""
    view = panorama(surface, origin, directions, COARSE if coarse else surface._cells(camera), camera)
    return layer_at(view, view.hidden_below, directions)


def panorama(
    surface: PointCloudSurface, origin: np.ndarray, directions: np.ndarray, cells: Cells, camera: Camera | None
) -> Panorama:
    """The panorama that shows unit rays (..., 3), or the one that a camera's image is read from."""
    if camera is not None:
        return surface._locate_nodes(camera, pixel_rays(camera), cells, FRESH)[0]
    rays = directions.reshape(1, -1, 3).transpose(2, 0, 1).astype(np.float32, order="C")
    return surface.panorama(np.asarray(origin, np.float64), rays, np.eye(3), cells)[0]


def layer_at(view: Panorama, layer: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Bilinear values (...,) of a panorama's layer along unit rays (..., 3); its border beyond it."""
    row, column, _, columns, (rad, turn, halo, *_) = view.window
    first, lead, low = (column - halo) * rad, halo if columns >= turn else 0, (row - halo) * rad
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


def solids_ahead(
    boxes: np.ndarray, solids: np.ndarray, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse distance (...,) to the first piece of what boxes hold along each ray, 0 for none, and its face, or -1."""
    rays = directions.reshape(-1, 3)
    q, face = np.zeros(len(rays)), np.full(len(rays), -1)
    for row, (box, pieces) in enumerate(zip(boxes, solids, strict=True)):
        c, s = np.cos(box[6]), np.sin(box[6])
        start = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) @ (origin - box[:3])
        if (np.abs(start) <= box[3:6] / 2).all():
            continue
        for piece, planes in enumerate(pieces):
            enter, leave, number = _through(planes, origin, rays)
            nearest = np.where((leave >= enter) & (enter > 0), 1 / np.maximum(enter, 1 / MAX_INVERSE_DISTANCE), 0.0)
            first = nearest > q
            q[first], face[first] = nearest[first], 6 * (len(pieces) * row + piece) + number[first]
    return q.reshape(directions.shape[:-1]), face.reshape(directions.shape[:-1])


def _through(planes: np.ndarray, origin: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances (n,) at which rays enter and leave a piece (6, 4), and the plane they enter by."""
    before, towards = planes[:, :3] @ origin - planes[:, 3], -rays @ planes[:, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        at = before / towards
    near, far = np.where(towards > 0, at, -np.inf), np.where(towards < 0, at, np.inf)
    beside = ((towards == 0) & (before > 0)).any(axis=1)
    return near.max(axis=1), np.where(beside, -np.inf, far.min(axis=1)), near.argmax(axis=1)
