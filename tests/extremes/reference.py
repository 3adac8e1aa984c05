"""Slow float64 truth, from the conventions of docs/formats.md alone: rays, lenses, surfaces, boxes and who sees what.

Nothing here is shared with the package's renderer, and nothing is fast: every pixel is evaluated, lenses are inverted
by bisection or by OpenCV, boxes are met one by one.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np

from arbiview_aug import Camera
from arbiview_aug.cameras.rays import MAX_INVERSE_DISTANCE
from arbiview_aug.render.plan import Slot
from arbiview_aug.scene.surface import SHARPNESS, WALL_CENTER_M, Ground, Street

LEAST_DEPTH = 1e-6  # of unit directions, for lenses that see less than half a turn


class Seen(NamedTuple):
    """Pixels (h, w) of a target that a source sees."""

    uv: np.ndarray  # (h, w, 2) source pixels; NaN where there is none
    valid: np.ndarray  # the point lies in front of the source and on its lens's rising branch
    point_m: np.ndarray  # (h, w, 3) scene points, NaN at infinity
    unsure: np.ndarray  # no ray is known: OpenCV's iteration does not settle close to the fold of a radtan lens


WIDE = ("fisheye", "ftheta", "ftheta_backward", "double_sphere", "eucm")
"""Lenses that may see behind, whose radius is a function of the angle."""


def wide_radius(camera: Camera, theta: np.ndarray) -> np.ndarray:
    """Distance from the axis in the normalised image, by the angle off it; NaN past what the lens sees."""
    if camera.lens == "fisheye":
        k1, k2, k3, k4 = camera.distortion
        return theta + k1 * theta**3 + k2 * theta**5 + k3 * theta**7 + k4 * theta**9
    if camera.lens.startswith("ftheta"):
        k2, k3, k4, k5 = camera.distortion
        if camera.lens == "ftheta":
            return theta + k2 * theta**2 + k3 * theta**3 + k4 * theta**4 + k5 * theta**5
        return np.interp(theta, *backward_table(camera.distortion), right=np.nan)
    xi, alpha, beta = (*camera.distortion, 1.0) if camera.lens == "double_sphere" else (0.0, *camera.distortion)
    moved = xi + np.cos(theta)
    divisor = alpha * np.sqrt(beta * np.sin(theta) ** 2 + moved**2) + (1 - alpha) * moved
    return np.where(divisor > 0, np.sin(theta) / divisor, np.nan)


@lru_cache(maxsize=16)
def backward_table(distortion: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Angles and radii of ``ftheta_backward``, scanned as far as the angle rises."""
    k2, k3, k4, k5 = distortion
    scan = np.linspace(0, 20, 2_000_001)
    angles = scan + k2 * scan**2 + k3 * scan**3 + k4 * scan**4 + k5 * scan**5
    flat = np.flatnonzero(np.diff(angles) < 0.1 * (scan[1] - scan[0]))
    end = flat[0] if len(flat) else len(scan)
    return angles[:end], scan[:end]


@lru_cache(maxsize=16)
def fold(camera: Camera) -> float:
    """The point at which the lens's radius stops rising, scanned: an angle for wide lenses, its tangent for radtan."""
    if camera.lens in WIDE:
        scan = np.linspace(0, np.pi, 200_001)
        radius = wide_radius(camera, scan)
    else:
        k1, k2, _, _, k3, k4, k5, k6 = (*camera.distortion, *(0.0,) * (8 - len(camera.distortion)))
        scan = np.linspace(0, 20, 200_001)
        bottom = 1 + k4 * scan**2 + k5 * scan**4 + k6 * scan**6
        radius = scan * (1 + k1 * scan**2 + k2 * scan**4 + k3 * scan**6) / np.where(bottom > 0, bottom, np.nan)
    falls = np.flatnonzero(~(np.diff(radius) > 0))
    return float(scan[falls[0]] if len(falls) else scan[-1])


def project(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (..., 2) of camera-frame points or directions (..., 3), NaN where there is none, and where there is."""
    x, y, z = np.moveaxis(points / np.linalg.norm(points, axis=-1, keepdims=True), -1, 0)
    with np.errstate(all="ignore"):
        if camera.lens in WIDE:
            r = np.hypot(x, y)
            theta = np.arctan2(r, z)
            valid = theta <= fold(camera)
            scale = np.where(r > 0, wide_radius(camera, theta) / r, 1.0)
            a, b = x * scale, y * scale
        else:
            valid = z > LEAST_DEPTH
            a, b = x / z, y / z
            if camera.lens == "radtan":
                valid &= np.hypot(a, b) <= fold(camera)
                k1, k2, p1, p2, k3, k4, k5, k6 = (*camera.distortion, *(0.0,) * (8 - len(camera.distortion)))
                r2 = a**2 + b**2
                radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
                a, b = (
                    a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a**2),
                    b * radial + p1 * (r2 + 2 * b**2) + 2 * p2 * a * b,
                )
        uv = np.stack([a, b, np.ones_like(a)], -1) @ camera.K[:2].T
    uv[~valid] = np.nan
    return uv, valid


def rays(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Unit ego directions (h, w, 3) of all pixels, and where they are certain."""
    v, u = np.mgrid[0.0 : camera.height_px, 0.0 : camera.width_px]
    pixels = np.stack([u, v, np.ones_like(u)], -1)
    a, b = np.moveaxis(np.linalg.solve(camera.K, pixels.reshape(-1, 3).T).T.reshape(pixels.shape)[..., :2], -1, 0)
    if camera.lens in WIDE:
        radius = np.hypot(a, b)
        low, high = np.zeros(radius.shape), np.full(radius.shape, fold(camera))
        for _ in range(60):
            middle = (low + high) / 2
            above = wide_radius(camera, middle) > radius
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        scale = np.where(radius > 0, np.sin(low) / np.where(radius > 0, radius, 1), 1.0)
        directions = np.stack([a * scale, b * scale, np.cos(low)], -1)
    else:
        if camera.lens == "radtan":
            criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, 1e-14)
            flat = np.stack([a, b], -1).reshape(-1, 1, 2)
            flat = cv2.undistortPoints(flat, np.eye(3), np.array(camera.distortion), None, None, None, criteria)
            a, b = np.moveaxis(flat.reshape(*a.shape, 2), -1, 0)
        directions = np.stack([a, b, np.ones_like(a)], -1)
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        certain = np.abs(project(camera, directions)[0] - pixels[..., :2]).max(-1) < 1e-7
    return directions @ camera.cam2ego[:3, :3].T, certain


def inverse_distance(surface: str, origin: np.ndarray, directions: np.ndarray, ground_z_m: float) -> np.ndarray:
    """1/m (...,) at which unit rays meet the road, the wall, or both."""
    if surface == "infinity":
        return np.zeros(directions.shape[:-1])
    height = origin[2] - ground_z_m
    road = np.maximum(-directions[..., 2] / height, 0) if height > 0 else np.zeros(directions.shape[:-1])
    street = Ground() if surface == "ground" else Street()
    size = street.half_length_m, street.half_width_m
    o, d = (origin[:2] - WALL_CENTER_M) / size, directions[..., :2] / size
    a, b, c = (d * d).sum(-1), (d * o).sum(-1), o @ o - 1
    with np.errstate(all="ignore"):
        farther = (-b + np.sqrt(b * b - a * c)) / a
        wall = np.where(farther > 0, 1 / farther, 0.0)  # NaN, a miss, compares as False
    k = np.inf if surface == "ground" else SHARPNESS
    joined = np.linalg.norm(np.stack([road, wall]), k, axis=0)
    return np.minimum(joined, MAX_INVERSE_DISTANCE)


def box_distance(box: np.ndarray, origin: np.ndarray, directions: np.ndarray, shrink_m: float = 0.0) -> np.ndarray:
    """Metres (...,) along unit rays to a box (7,), infinity where they miss it."""
    c, s = np.cos(box[6]), np.sin(box[6])
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])  # ego to the box's own axes
    o, d = turn @ (origin - box[:3]), directions @ turn.T
    half = np.maximum(box[3:6] / 2 - shrink_m, 0)
    with np.errstate(all="ignore"):
        one, two = (-half - o) / d, (half - o) / d
    enter, leave = np.fmax.reduce(np.fmin(one, two), -1), np.fmin.reduce(np.fmax(one, two), -1)
    return np.where((enter <= leave) & (enter > 0), enter, np.inf)


def seen(source: Camera, target: Camera, surface: str, ground_z_m: float, boxes: np.ndarray | None = None) -> Seen:
    """Positions of the target's pixels in the source; ``valid`` says nothing of image bounds, masks or obstacles."""
    directions, certain = rays(target)
    q = inverse_distance("street" if boxes is not None else surface, target.center_m, directions, ground_z_m)
    if boxes is not None:  # a labelled box wins over the guessed street, even where it stands a little below the road
        # The view shows it with the pixels on its border, which mix colours: half a pixel wider. Its floor stays.
        more_m = np.linalg.norm(boxes[:, :3] - target.center_m, axis=1, keepdims=True) / target.K[0, 0] / 2
        wider = boxes + more_m * np.array([0, 0, 0.5, 2, 2, 1, 0])
        box = np.minimum.reduce([box_distance(box, target.center_m, directions) for box in wider])
        q = np.where(np.isfinite(box), 1 / box, q)
    with np.errstate(all="ignore"):
        point = np.where(q[..., None] > 1e-9, target.center_m + directions / q[..., None], np.nan)
    ahead = np.where(np.isnan(point), directions, point - source.center_m)
    uv, valid = project(source, ahead @ source.cam2ego[:3, :3])
    return Seen(uv, valid & certain, point, ~certain & (target.lens == "radtan"))


def atlas_position(slot: Slot, uv: np.ndarray) -> np.ndarray:
    """Positions of an image's pixels (..., 2) once it is halved and has its place in an atlas.

    Outer edges stay, -0.5 is -0.5. The outer half pixel of the full image is read at the halved one's border.
    """
    halved = (uv + 0.5) / 2**slot.level - 0.5
    return np.array([slot.x, slot.y]) + np.clip(halved, 0, np.array(slot.size[::-1]) - 1)


def hidden(source: Camera, point_m: np.ndarray, boxes: np.ndarray, shrink_m: float) -> np.ndarray:
    """Whether a box, a little shrunk, stands between the source and scene points (n, 3)."""
    away = point_m - source.center_m
    distance = np.linalg.norm(away, axis=-1)
    nearest = [box_distance(box, source.center_m, away / distance[..., None], shrink_m) for box in boxes]
    return np.minimum.reduce(nearest) < distance
