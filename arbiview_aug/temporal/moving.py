"""Traffic that moves without labels, in depth from motion: it is put upright on the road where its foot is.

Two images show a thing that moves along with the vehicle, or against it, as a copy that is scaled about the camera: it
stays on its epipolar lines, and both neighbours agree. A copy that is too near hangs above the road: below it, the
images match the road that lies beyond it. The place where matching changes from the thing to the road is its foot, and
the foot's distance is its own. A copy that is too far lies below the road, where nothing is; it moves less than the
road that it hides. What crosses leaves its epipolar lines. ``docs/drives.md`` (Constants) says how the constants were
chosen.
"""

from __future__ import annotations

import math

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.temporal.plane_sweep import SweptImage

SLOPE_DEG = 1.0
"""Pitch of the vehicle against its road, and of the road against a plane: a foot that is so far off may stand."""

UPRIGHT = 1.05
"""Inverse distance over the road's, of pixels that are no road."""

MOST_SCALED = 0.3
"""Least scale of a copy: traffic that comes at twice the vehicle's speed."""

EVIDENCE = 5.0
"""Sums of differences of correlation, over pixels, that tell a foot: a fifth over the 49 of a window."""

STANDING = 0.1
TALLEST_M = 4.5
"""Shares of a thing's columns that must show the same foot, and that may show it to reach down to the road."""


def stand_on_road(
    image: SweptImage, costs: npt.NDArray[np.uint16], spacing: float, q: Layer, valid: BoolArray
) -> tuple[Layer, BoolArray]:
    """Move things that hang above the road to the distance at which their foot touches it.

    Args:
        image: The image.
        costs: (K, h, w) of walls at multiples of ``spacing``, 1/m; the first is the road alone.
        q: (h, w) inverse distances that were found, 1/m.
        valid: (h, w) whether they are believed; outlines are not.

    Returns:
        Inverse distances and validity with the things moved, and the road below their feet.
    """
    from arbiview_aug.temporal.kernels import RADIUS_PX, find_feet

    count, labels, boxes, _ = cv2.connectedComponentsWithStats(
        (valid & (q > UPRIGHT * image.road)).astype(np.uint8), connectivity=4
    )
    least_gap_px = RADIUS_PX + math.tan(math.radians(SLOPE_DEG)) * float(image.camera.K[1, 1])
    q, valid = q.copy(), valid.copy()
    find_feet(
        labels, boxes[:count], image.horizontal, image.road, (image.directions[..., 2] / np.maximum(image.horizontal, 1e-6)).astype(np.float32), costs, spacing, least_gap_px,
        (MOST_SCALED, EVIDENCE, STANDING, float(image.camera.center_m[2]) - image.ground_z_m, TALLEST_M), q, valid,
    )  # fmt: skip
    return q, valid


def lowest_road(image: SweptImage) -> Layer:
    """(h, w) inverse distance to the farthest road that slopes or a pitching vehicle may show, 1/m."""
    height_m = max(float(image.camera.center_m[2]) - image.ground_z_m, 1e-3)
    slope = np.float32(math.tan(math.radians(SLOPE_DEG)) / height_m)
    return np.maximum(image.road - slope * image.horizontal, 0)


def off_road_flow(image: SweptImage, other: SweptImage, road: Layer) -> tuple[Layer, BoolArray, Layer]:
    """Optical flow (h, w, 2) to a neighbour beyond that of a road (h, w), px, and where the neighbour sees that road.

    The first component goes along the epipolar line towards nearer places, the second across it.
    """
    at = image.positions(other.camera, road)
    seen = cv2.remap(other.unmasked, at, None, cv2.INTER_NEAREST) > 0  # type: ignore[call-overload]
    warped = cv2.remap(other.grey, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    one, two = (np.rint(grey).astype(np.uint8) for grey in (image.grey, np.where(seen, warped, image.grey)))
    flow = _FLOW(one, two)
    x, y = np.moveaxis(image.camera.pixel_grid().astype(np.float32) + flow, -1, 0)
    there = cv2.remap(at, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    moved = there - at
    line = image.shift(other.camera, np.maximum(road, np.float32(1e-3)))
    line /= np.maximum(np.hypot(line[..., 0], line[..., 1]), 1e-9)[..., None]
    along = (moved * line).sum(-1)
    return np.stack([along, moved[..., 1] * line[..., 0] - moved[..., 0] * line[..., 1]], -1), seen, there


def _FLOW(one, two):
    return cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM).calc(one, two, None)


def zncc(image, warped, S):
    from arbiview_aug.temporal.kernels import NOISE_LEVELS
    one, two = image.grey[S], warped
    b = lambda a: cv2.blur(a, (7, 7), borderType=cv2.BORDER_REPLICATE)
    m1, m2 = b(one), b(two)
    v1, v2 = np.maximum(b(one * one) - m1 * m1, 0) + NOISE_LEVELS**2, np.maximum(b(two * two) - m2 * m2, 0) + NOISE_LEVELS**2
    return (b(one * two) - m1 * m2) / np.sqrt(v1 * v2)


def moving_off_road(image: SweptImage, others, q: Layer, valid: BoolArray, costs, spacing):
    chosen = np.where(q > image.road * 1.0001, q / image.horizontal / spacing, 0)
    chosen = np.take_along_axis(costs, np.rint(chosen).astype(int).clip(0, len(costs) - 1)[None], 0)[0]
    chosen = 1 - chosen.astype(np.float32) / 2500
    road = lowest_road(image)
    flows, seens, ats = [], [], []
    for other in others:
        flow, seen, at = off_road_flow(image, other, road)
        flows.append(flow)
        seens.append(seen)
        ats.append(at)
    F, S = np.stack(flows), np.stack(seens)
    three = np.stack([-F[..., 0], F[..., 1], -F[..., 1]])
    ok = ((three > FLOW_PX) | ~S).all(1).any(0) & S.any(0)
    size = np.where(S, np.hypot(F[..., 0], F[..., 1]), np.inf).min(0)
    if len(others) == 2:
        differ = np.hypot(*np.moveaxis(F[0] - F[1], -1, 0))
        ok &= (differ < FLOW_PX + SAME * size) | ~S.all(0)
    standing = valid & (q > UPRIGHT * image.road)
    mask = ok & ~standing & (road > 0)
    count, labels, boxes, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    q, valid = q.copy(), valid.copy()
    h, w = q.shape
    for k in range(1, count):
        x, y, ww, hh, area = boxes[k]
        if area < 49:
            continue
        inside = labels[y : y + hh, x : x + ww] == k
        strong = inside & (size[y : y + hh, x : x + ww] >= 0.5 * np.median(size[y : y + hh, x : x + ww][inside]))
        columns = strong.any(0)
        low = y + hh - 1 - strong[::-1].argmax(0)
        xs = np.arange(x, x + ww)[columns]
        low = np.maximum(low[columns] - HALO, y)
        wall = np.quantile(image.road[low, xs] / image.horizontal[low, xs], FOOT_Q)
        top = max(0, min(y, int(np.median(low)) - int(1.5 * ww)))
        ROI = np.s_[top : y + hh, x : x + ww]
        thing = np.zeros((y + hh - top, ww), np.uint8)
        thing[y - top :] = strong
        # match
        rows, cols = np.nonzero(strong)
        A = np.stack([cols + x, rows + y, np.ones(len(rows))], -1).astype(float)
        corr, corr_road = [], []
        yy, xx = np.mgrid[top : y + hh, x : x + ww]
        for at, seen, other in zip(ats, seens, others):
            p = at[rows + y, cols + x]
            T = np.linalg.lstsq(A, p, rcond=None)[0]
            pos = (np.stack([xx, yy, np.ones_like(xx)], -1) @ T).astype(np.float32)
            corr.append(zncc(image, cv2.remap(other.grey, pos, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), ROI))
            pos = image.positions(other.camera, image.road)[ROI]
            corr_road.append(zncc(image, cv2.remap(other.grey, pos, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), ROI))
        st = thing > 0
        info = [c[st].mean() for c in corr], [c[st].mean() for c in corr_road], [chosen[y : y + hh, x : x + ww][strong].mean()]
        thing = cv2.morphologyEx(thing, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8))
        free = ~valid[ROI]
        # upwards through what is unknown
        for r in range(len(thing) - 2, -1, -1):
            thing[r] |= thing[r + 1] & free[r]
        thing = thing > 0
        below = (image.road[ROI] / np.maximum(image.horizontal[ROI], 1e-6)) > wall
        thing &= ~below
        LOG.append((k, x, y, ww, hh, area, 1 / wall, thing, info))
        merged = 0.75 * np.max(info[0]) + 0.25 * np.min(info[0])
        if min(info[0]) < CORR or merged < info[2][0]:
            continue
        q[ROI] = np.where(thing, wall * image.horizontal[ROI], q[ROI])
        valid[ROI] |= thing
    return q, valid


LOG: list = []
FLOW_PX = 0.5
FOOT_Q = 0.75
SAME = 0.5
HALO = 4
CORR = 0.5
