"""Mistakes of single cameras that images show: points on them, neighbours that disagree, the own car."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, islice, pairwise
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import Finding, likely_poses, pose_doubt
from arbiview_aug.scene.surface import Points

Gray = npt.NDArray[np.float32]

# --- points on images -------------------------------------------------------------------------------------------------
EDGE_WIDTH_PX, _NEARER, _LEAST_EDGES = 160, 0.2, 50
"""Width of the images that points are compared with; least step of the logarithm of depth, over two pixels, at edges of
objects; least number of such pixels. Levinson and Thrun (2013) calibrate online by the same evidence."""

CLEAR_FIT, FIT_GAIN = 0.1, 0.05
"""Fit of points that are right, and the least gain of a better reading: between those of right points and of mirrored
or turned ones on real frames and synthetic streets."""


class EdgeFit(NamedTuple):
    """How well edges of objects in the points lie on edges of an image."""

    gain: float  # mean rank of the image's gradient at edges of the points, less that at other points: -0.5 to 0.5
    edges: int  # number of pixels with edges

    def beats(self, other: EdgeFit) -> bool:
        """Whether it is clearly better: by ``FIT_GAIN`` and four standard errors of uniform ranks."""
        gain, edges = other if other.edges >= _LEAST_EDGES else (0.0, self.edges)  # it sees too few
        error = 0.29 * np.sqrt(1 / max(self.edges, 1) + 1 / max(edges, 1))
        least = _LEAST_EDGES if other.edges >= _LEAST_EDGES else 2 * _LEAST_EDGES
        return self.edges >= least and self.gain > max(CLEAR_FIT, gain + max(FIT_GAIN, 4 * error))


def gray(camera: Camera, image: torch.Tensor, width_px: int) -> tuple[Camera, Gray]:
    """The camera and its image (3, H, W) in grey levels, both at a width."""
    pixels = image.detach().cpu().float().mean(dim=0).numpy() * (1 if image.dtype == torch.uint8 else 255)
    scale = min(1.0, width_px / camera.width_px)
    size = max(1, round(camera.height_px * scale)), max(1, round(camera.width_px * scale))
    return camera.resize(size), np.asarray(cv2.resize(pixels, size[::-1], interpolation=cv2.INTER_AREA), np.float32)


def edge_ranks(pixels: Gray) -> Gray:
    """Rank in [0, 1] of each pixel's horizontal gradient."""
    gradient = np.abs(cv2.Sobel(pixels, cv2.CV_32F, 1, 0)).ravel()
    return (gradient.argsort().argsort() / gradient.size).reshape(pixels.shape).astype(np.float32)


def edge_fit(camera: Camera, ranks: Gray, points: Points) -> EdgeFit:
    """Compare points with an image of the camera's size by ``edge_ranks``."""
    seen = camera.project(points)
    inside = seen.valid & camera.contains(seen.uv)
    x, y = np.round(seen.uv[inside]).astype(int).T
    depth = np.full(camera.size, np.inf, np.float32)
    np.minimum.at(depth, (y, x), np.log(np.linalg.norm(points[inside] - camera.center_m, axis=1)))
    nearest = cv2.erode(depth, np.ones((3, 3)))
    sides = np.roll(nearest, 2, axis=1), np.roll(nearest, -2, axis=1)
    known = np.isfinite(depth) & np.isfinite(sides[0]) & np.isfinite(sides[1])
    known[:, :3] = known[:, -3:] = False
    edges = known & (np.maximum(*sides) - np.where(known, nearest, 0) > _NEARER)
    if camera.mask is not None:
        edges, known = edges & camera.mask, known & camera.mask
    if not edges.any() or (known == edges).all():
        return EdgeFit(0.0, 0)
    return EdgeFit(float(ranks[edges].mean() - ranks[known & ~edges].mean()), int(edges.sum()))


def total(fits: Sequence[EdgeFit]) -> EdgeFit:
    """The mean fit of several images, by their edges."""
    edges = sum(fit.edges for fit in fits)
    return EdgeFit(sum(fit.gain * fit.edges for fit in fits) / max(edges, 1), edges)


def fit_findings(rig: Rig, views: Sequence[tuple[Camera, Gray]], points: Points) -> Iterator[Finding]:
    """Cameras that points misfit although they fit others, if another pose or image is clearly better."""
    fits = [edge_fit(camera, ranks, points) for camera, ranks in views]
    for k, (camera, ranks) in enumerate(views):
        rest = total(fits[:k] + fits[k + 1 :])
        if pose_doubt(camera, True) is not None or fits[k].gain > CLEAR_FIT or rest.gain < CLEAR_FIT:
            continue
        where, expected = f"camera {camera.name!r}", "points on the edges of its image"
        order = "are the images in another order?"
        tries = [(where, f"they fit that of {other.name!r}", order, camera, image) for other, image in views]
        tries = [way for way in tries if way[-1] is not ranks and way[-1].shape == ranks.shape]
        for pose, found, fix in likely_poses(camera, rig.ground_z_m, True):
            tries.append((f"{where}: cam2ego", found, fix, replace(camera, cam2ego=pose), ranks))
        better = (way for way in tries if edge_fit(*way[3:], points).beats(fits[k]))
        yield from (Finding(at, expected, found, fix) for at, found, fix, *_ in islice(better, 1))


# --- neighbouring cameras ---------------------------------------------------------------------------------------------
DISAGREE_DEG, _LEAST_MATCHES = 1.0, 15
"""Angle of a mistake, above that of cameras that fire apart while the car moves; least number of matches."""

_VIEW_PX, _RATIO, _NEAREST_M, _FALSE_DEG = 800, 0.8, 2.0, 10.0
"""Size of the common view; Lowe's ratio; the nearest scene; matches farther apart are false."""


def neighbour_errors(rig: Rig, images: Sequence[torch.Tensor]) -> dict[tuple[str, str], FloatArray]:
    """Angles in degrees by which matches in the overlap of two cameras miss each other at any distance of the scene."""
    errors = {}
    for first, second in combinations(zip(rig, images, strict=True), 2):
        view = _common_view(first[0], second[0])
        if view is not None and len(found := _match_errors(view, first, second)) >= _LEAST_MATCHES:
            errors[first[0].name, second[0].name] = found
    return errors


def _common_view(camera: Camera, other: Camera) -> Camera | None:
    """An upright pinhole camera that looks at what both see far away; None without overlap."""
    u, v = np.meshgrid(np.linspace(0, camera.width_px - 1, 24), np.linspace(0, camera.height_px - 1, 24))
    rays = camera.unproject(np.stack([u, v], axis=-1).reshape(-1, 2))
    directions = rays.directions[rays.valid]
    seen = other.project(other.center_m + directions)
    directions = directions[seen.valid & other.contains(seen.uv)]
    if len(directions) < 8:
        return None
    x, y, z = directions.mean(axis=0)
    azimuth, elevation = np.degrees([np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))])
    size: dict[str, Any] = {"width_px": 8, "height_px": 8, "horizontal_fov_deg": 90}
    view = Camera.looking(name="view", azimuth_deg=azimuth, elevation_deg=elevation, **size)
    x, y, z = (directions @ view.cam2ego[:3, :3]).T
    ahead = z > 0.3
    if not ahead.any():
        return None
    half = np.minimum([np.abs(x[ahead] / z[ahead]).max(), np.abs(y[ahead] / z[ahead]).max()], 1.1) * 1.1
    f = min(camera.K[0, 0], other.K[0, 0], *(_VIEW_PX / 2 / half))
    w, h = np.maximum(2 * half * f, 16).astype(int)
    K = np.array([[f, 0, w / 2 - 0.5], [0, f, h / 2 - 0.5], [0, 0, 1]])
    return replace(view, width_px=int(w), height_px=int(h), K=K)


def _match_errors(view: Camera, *pair: tuple[Camera, torch.Tensor]) -> FloatArray:
    """Errors in degrees of mutual matches of SIFT features in both images, as turned into the view."""
    sift, matcher = cv2.SIFT.create(1000), cv2.BFMatcher()
    keys, features = [], []
    directions = view.unproject(view.pixel_grid()).directions
    for camera, image in pair:
        camera, pixels = gray(camera, image, camera.width_px)
        seen = camera.project(camera.center_m + directions)
        valid = seen.valid & camera.contains(seen.uv)
        u, v = np.moveaxis(np.where(valid[..., None], seen.uv, -9).astype(np.float32), -1, 0)
        turned = cv2.remap(pixels.astype(np.uint8), u, v, cv2.INTER_LINEAR)
        if camera.mask is not None:
            valid &= cv2.remap(camera.mask.astype(np.uint8), u, v, cv2.INTER_NEAREST) > 0
        points, found = sift.detectAndCompute(turned, cv2.erode(valid.astype(np.uint8) * 255, np.ones((9, 9))))
        if len(points) < 2:
            return np.zeros(0)
        keys.append(np.array([point.pt for point in points]))
        features.append(found)
    ways = []
    for a, b in (features, features[::-1]):
        matches = (best for best, other in matcher.knnMatch(a, b, k=2) if best.distance < _RATIO * other.distance)
        ways.append({(match.queryIdx, match.trainIdx) for match in matches})
    both = [(a, b) for a, b in ways[0] if (b, a) in ways[1]]
    if not both:
        return np.zeros(0)
    rows = map(list, zip(*both, strict=True))
    first, second = (view.unproject(points[row]).directions for points, row in zip(keys, rows, strict=True))
    apart = pair[1][0].center_m - pair[0][0].center_m
    at = first - np.linspace(0, 1 / _NEAREST_M, 40)[:, None, None] * apart
    cosine = (at / np.linalg.norm(at, axis=-1, keepdims=True) * second).sum(axis=-1)
    errors = np.degrees(np.arccos(np.clip(cosine, -1, 1))).min(axis=0)
    return errors[errors < _FALSE_DEG] if (errors < _FALSE_DEG).mean() > 0.6 else np.zeros(0)


def neighbour_findings(errors: dict[tuple[str, str], FloatArray]) -> Iterator[Finding]:
    """Pairs of cameras whose matches disagree alike by more than ``DISAGREE_DEG``."""
    for (name, other), angles in errors.items():
        middle = float(np.median(angles))
        if middle > DISAGREE_DEG and ((angles > middle / 2) & (angles < 2 * middle)).mean() > 0.6:
            found = f"{middle:.1f} degrees apart in the median of {len(angles)} matches"
            fix = "calibrate them again; or were the images taken at different times while the car turned?"
            yield Finding(f"cameras {name!r} and {other!r}", "the same directions in their overlap", found, fix)


# --- the own car ------------------------------------------------------------------------------------------------------
_ROAD_AHEAD_M, _FLOW_PX, _GRADIENT, _STEADY = 12.0, 3.0, 3.0, 0.85
"""Edges of the own car are in all frames. The road there is nearer than the first and would have moved across the edge
by the second. The edge's mean gradient is at least the third, in grey levels a pixel, and at least the fourth of the
mean of the frames' gradients."""

_LEAST_WIDTH = 0.2
"""Least length of such an edge as a share of the width, above that of edges in moving traffic."""


def own_car_share(
    camera: Camera, images: Sequence[torch.Tensor], ego2world: Sequence[FloatArray], ground_z_m: float
) -> float:
    """Share of the images below edges of the own car; 0 without edges."""
    small = [gray(camera, image, EDGE_WIDTH_PX) for image in images]
    camera = small[0][0]
    gradients = np.stack([np.stack([cv2.Sobel(p, cv2.CV_32F, *d) / 8 for d in ((1, 0), (0, 1))], -1) for _, p in small])
    mean = gradients.mean(axis=0)
    strength = np.linalg.norm(mean, axis=-1)
    across = mean / np.maximum(strength, 1e-6)[..., None]
    stays = (strength > _GRADIENT) & ((gradients * across).sum(axis=-1).min(axis=0) > strength / 2)
    stays &= strength > _STEADY * np.linalg.norm(gradients, axis=-1).mean(axis=0)
    pixels = camera.pixel_grid()
    rays = camera.unproject(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        away_m = (ground_z_m - camera.center_m[2]) / rays.directions[..., 2]
    stays &= rays.valid & (away_m > 0) & (away_m < _ROAD_AHEAD_M)
    road = camera.center_m + away_m[stays][:, None] * rays.directions[stays]
    flow = np.zeros(len(road))
    for before, after in pairwise(ego2world):
        pose = np.linalg.inv(after) @ before
        moved = camera.project(road @ pose[:3, :3].T + pose[:3, 3])
        past = np.abs(((moved.uv - pixels[stays]) * across[stays]).sum(axis=-1))
        flow = np.maximum(flow, np.where(moved.valid, past, np.inf))
    edges = np.zeros(camera.size, np.uint8)
    edges[stays] = flow > _FLOW_PX
    _, labels, stats, _ = cv2.connectedComponentsWithStats(cv2.dilate(edges, np.ones((3, 3))), connectivity=8)
    longest = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) >= _LEAST_WIDTH * camera.width_px
    longest[0] = False
    below = np.maximum.accumulate(longest[labels] & (edges > 0), axis=0)
    return float(below.mean())
