"""Adjacent cameras of a rig, and the view half-way between two of them, where overlaps are measured."""

from __future__ import annotations

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig

VIEW_SIZE = (450, 800)
"""(h, w) of the half-way view."""

TILE_PX = 32
"""Side of the chessboard's tiles in that view."""


def adjacent_pairs(rig: Rig) -> list[tuple[int, int]]:
    """Pairs of cameras that are neighbours in azimuth and whose horizontal fields of view overlap."""
    order = sorted(range(len(rig)), key=lambda k: (rig[k].azimuth_deg, k))
    pairs = []
    for here, there in zip(order, order[1:] + order[:1], strict=True):
        gap = (rig[there].azimuth_deg - rig[here].azimuth_deg) % 360
        if here != there and gap < (rig[here].fov_deg[0] + rig[there].fov_deg[0]) / 2:
            pairs.append((min(here, there), max(here, there)))
    return sorted(set(pairs))


def half_way_view(a: Camera, b: Camera, size: tuple[int, int] = VIEW_SIZE) -> Camera:
    """The pinhole camera between two: mean centre, half-way rotation, the narrower camera's K scaled to ``size``."""
    between = a.cam2ego[:3, :3].T @ b.cam2ego[:3, :3]
    cam2ego = np.eye(4)
    cam2ego[:3, :3] = a.cam2ego[:3, :3] @ cv2.Rodrigues(cv2.Rodrigues(between)[0] / 2)[0]
    cam2ego[:3, 3] = (a.center_m + b.center_m) / 2
    narrower = max((a, b), key=lambda c: c.K[0, 0] / c.width_px)
    scale = np.diag([size[1] / narrower.width_px, size[0] / narrower.height_px, 1.0])  # by protocol, no half pixel
    return Camera(name=f"{a.name}+{b.name}", width_px=size[1], height_px=size[0], K=scale @ narrower.K, cam2ego=cam2ego)


def odd_tiles(size: tuple[int, int], tile_px: int = TILE_PX) -> BoolArray:
    """(h, w) bool chessboard: True on the tiles used for scores, False on those used for fitting."""
    row, column = np.indices(size)
    return np.asarray((column // tile_px + row // tile_px) % 2 == 1)
