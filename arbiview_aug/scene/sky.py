"""Sky in photographs: where no scan line returned, colours separate sky from objects that continue above the lines."""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rays import RayCache
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.image_ops import nearest_resized, resized
from arbiview_aug.scene.surface import Layer, Points

FAR_M = 250.0
"""Distance of sky, beyond returns: half a pixel of parallax at most."""

SIDE_RAD = math.radians(0.8)
"""Side of the cells of photographs that are classified: finer cells cost more than they gain."""

SPARSE_RAD = math.radians(8.0)
"""Elevation above which scan lines are too sparse for a direction without return to be far."""

_LEAST_CELLS, _LEAST_SHARE = 12, 0.03  # minimum cells of certain sky in a view, and their share of a patch of sky
_FLAT = 20  # grey levels between neighbouring cells of certain sky
_CLEARER, _UNLIKELY = 2.0, 12.0  # log density of sky above that of returns, and below its largest


def sky_points(rig: Rig, images: Sequence[torch.Tensor], points: Points, cache: RayCache) -> Points:
    """Points (Q, 3) on the sky of N images (3, H, W), and on objects between the highest scan lines and the sky."""
    lowest, found = min(camera.center_m[2] for camera in rig), [np.zeros((0, 3), np.float32)]
    cloud = points[points[:, 2] > lowest, :3].astype(np.float32)
    for camera, image in zip(rig, images, strict=True):
        if abs(camera.cam2ego[2, 0]) < 0.5:  # upright objects continue along columns
            found += _points_of(camera, image, cloud, cache)
    return np.concatenate(found)


def _points_of(camera: Camera, image: torch.Tensor, cloud: Layer, cache: RayCache) -> list[Layer]:
    """Points on the sky and below it by one image."""
    step = max(1, round(SIDE_RAD * float(camera.K[0, 0])))
    (h, w), R, origin = (n // step for n in camera.size), camera.cam2ego[:3, :3].astype(np.float32), camera.center_m
    local = cache.rays(camera).at(*(np.arange(n) * step + step // 2 for n in (h, w)))
    rays, origin = (R @ local.reshape(3, -1)).reshape(3, h, w), origin.astype(np.float32)
    h = int(np.flatnonzero((rays[2] > 0).any(1)).max(initial=-1)) + 1  # rows above the horizon
    if h * w == 0:
        return []
    rays, mask = rays[:, :h], camera.mask
    small = resized(image.detach()[:, : step * h], (h, w)).numpy(force=True).transpose(1, 2, 0)
    colours = np.ascontiguousarray(small if small.dtype == np.uint8 else (255 * small).astype(np.uint8))
    shows = (
        np.ones((h, w), bool) if mask is None else nearest_resized(torch.from_numpy(mask[: step * h]), (h, w)).numpy()
    )
    ahead = cloud[(cloud @ R[:, 2] > origin @ R[:, 2]) & (cloud[:, 2] > origin[2])]
    uv, _, valid = camera.project(ahead)
    inside = valid & camera.contains(uv)
    column, row = np.minimum(((uv[inside] + 0.5) / step).astype(int), (w, h)).T
    away = np.full((h + 1, w + 1), np.inf, np.float32)  # horizontal distances; the last ones are beyond the cells
    np.minimum.at(away, (row, column), np.hypot(*(ahead[inside, :2] - origin[:2]).T))
    away = np.where(shows, away[:h, :w], np.float32(np.inf))
    sky = _find_sky(colours, away, rays[2], shows)
    if not sky.any():
        return []
    top = np.isfinite(away).argmax(0)  # each column's highest return
    above = np.arange(h)[:, None] < np.where(rays[2, top, np.arange(w)] > math.sin(SPARSE_RAD), top, 0)
    above &= ~np.maximum.accumulate((sky & above)[::-1], 0)[::-1] & shows
    upright = rays[:, above]
    upright *= np.broadcast_to(away[top, np.arange(w)], (h, w))[above] / np.hypot(upright[0], upright[1])
    inner = cv2.erode(sky.view(np.uint8), np.ones((3, 3))) > 0
    return [origin + FAR_M * rays[:, inner].T, origin + upright.T]


def _find_sky(colours: np.ndarray, away: Layer, up: Layer, shows: BoolArray) -> BoolArray:
    """Cells (h, w) that look more like cells above all returns than like cells with returns.

    ``colours`` (h, w, 3) uint8; ``away`` is infinite without a return; ``up`` are sines of elevations.
    """
    hit = np.isfinite(away)
    sky, returned = np.zeros_like(hit), (hit & (up > 0.02)).reshape(-1)
    if np.count_nonzero(returned) < _LEAST_CELLS:
        return sky
    contrast = cv2.morphologyEx(cv2.cvtColor(colours, cv2.COLOR_RGB2GRAY), cv2.MORPH_GRADIENT, np.ones((3, 3)))
    features = np.concatenate([colours.transpose(2, 0, 1), 16 * np.log1p(contrast, dtype=np.float32)[None]])
    features, flags = features.reshape(4, -1), hit.view(np.uint8)
    highest = np.sort(up[hit])[-max(1, hit.shape[1] // 50)]  # the highest scan line, but for stray returns
    around = cv2.dilate(flags, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5)))
    below_hit = np.maximum.accumulate(cv2.dilate(flags, np.ones((1, 3))), 0)
    certain = (around == 0) & (below_hit == 0) & shows & (up > 0.02) & (up < highest + 0.017) & (contrast < _FLAT)
    bright = features[:3].sum(0)
    certain = certain.reshape(-1) & (bright > bright[returned].mean())
    solid, _ = _log_density(features[:, returned], features)
    for _ in range(2):
        if np.count_nonzero(certain) < _LEAST_CELLS:
            return sky
        density, below = _log_density(features[:, certain], features)
        certain &= density > solid
    maybe = ((density > solid + _CLEARER) & (below < _UNLIKELY)).reshape(hit.shape) & shows & ~hit & (up > 0.01)
    count, labels = cv2.connectedComponents(maybe.view(np.uint8), connectivity=4)
    sizes, sure = (np.bincount(part, minlength=count) for part in (labels.reshape(-1), labels.reshape(-1)[certain]))
    sizes[0] = 0
    return np.asarray(((sure >= _LEAST_SHARE * sizes) & (sizes >= _LEAST_CELLS))[labels])


def _log_density(sample: Layer, features: Layer) -> tuple[Layer, Layer]:
    """Log normal density (n,) of features (4, n) by a sample (4, m), up to a constant, and its gap to the peak."""
    mean = sample.mean(1, keepdims=True)
    covariance = (sample - mean) @ (sample - mean).T / sample.shape[1] + 4 * np.eye(4)  # widened by two grey levels
    whitening = np.linalg.inv(np.linalg.cholesky(covariance)).astype(np.float32)
    below = 0.5 * np.square(whitening @ (features - mean)).sum(0)
    return np.log(np.diag(whitening)).sum() - below, below
