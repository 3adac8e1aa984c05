"""One rig for several vehicles: the part of each camera's view that all of them see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import CalibrationError

LEAST_SEEN = 0.95
"""Least share of a common view that each rig must see: rigs at other heights see the lower edge differently."""

_ASPECTS = np.geomspace(0.3, 1.0, 15)  # height over width of all views, from wider than any camera's to square
_ZOOMS = np.geomspace(1.0, 4.0, 29)  # 5 % steps; four times narrower is another camera
_GRID = (15, 27)  # rays of a view, rows and columns
_DISTANCES_M, _OBJECT_HEIGHT_M = np.geomspace(5.0, 40.0, 13), 1.6  # of objects: a car's height
_FAR_M = 50.0  # rays that do not meet the road before end here: cameras are metres apart


def common_rig(rigs: Sequence[Rig]) -> Rig:
    """Propose the pinhole rig that loses least of its views when samples of all ``rigs`` are retargeted to it.

    Each rig proposes its cameras, at the mean height of all rigs and cut to one size, of several aspects. A camera's
    field of view is narrowed until every rig sees ``LEAST_SEEN`` of it; cameras that some rig does not see are left
    out. The proposal that shows most objects around the vehicle wins. Its road is at z = 0 m.

    Raises:
        CalibrationError: Fewer than two rigs, or no camera whose view all of them see.
    """
    if len(rigs) < 2:
        raise CalibrationError(f"common rig: expected two or more rigs, got {len(rigs)}")
    level = replace(rigs[0], ground_z_m=0.0)
    placed = [replace(rig, name=rig.name or f"rig {k}").in_frame_of(level) for k, rig in enumerate(rigs, 1)]
    height_m = np.mean([rig.cam2ego[:, 2, 3].mean() for rig in placed])
    best, most = list[Camera](), 0
    for rig in placed:
        lifted = rig.shifted(z_m=float(height_m - rig.cam2ego[:, 2, 3].mean()))
        bare = [replace(camera, lens="pinhole", distortion=(), mask=None) for camera in lifted]
        width_px = min(camera.width_px for camera in bare)
        for aspect in _ASPECTS:
            cut = [camera.resize((round(aspect * width_px), width_px), "crop") for camera in bare]
            narrowed = [camera for k in cut if (camera := _narrowed(k, placed)) is not None]
            shown = int(np.any([_shows(camera) for camera in narrowed], axis=0).sum())
            if shown and shown >= most:  # the tallest of equals
                best, most = narrowed, shown
    if not best:
        names = ", ".join(rig.name for rig in placed)
        raise CalibrationError(f"common rig: no view is seen by all of {names}; leave out the rig that looks elsewhere")
    return Rig(best, name="common")


def seen_shares(source: Rig, target: Rig) -> FloatArray:
    """(N,) share of each target camera's view that some camera of ``source`` sees, on the road or 50 m away."""
    rig = target.in_frame_of(source)
    return np.array([_seen(source, _ends(camera, source.ground_z_m)).mean() for camera in rig])


def _narrowed(camera: Camera, rigs: Sequence[Rig]) -> Camera | None:
    """The camera with the widest field of view that all rigs see; None if there is none."""
    for zoom in _ZOOMS:
        zoomed = replace(camera, K=camera.K * [[zoom, zoom, 1], [1, zoom, 1], [1, 1, 1]])
        ends = _ends(zoomed, 0.0)
        if all(_seen(rig, ends).mean() >= LEAST_SEEN for rig in rigs):
            return zoomed
    return None


def _shows(camera: Camera) -> BoolArray:
    """(n,) whether a camera over the road z = 0 shows objects around the vehicle from foot to top."""
    azimuth, distance_m = (part.ravel() for part in np.meshgrid(np.radians(np.arange(0, 360, 2)), _DISTANCES_M))
    feet = np.stack([distance_m * np.cos(azimuth), distance_m * np.sin(azimuth), np.zeros(azimuth.size)], axis=-1)
    ends = (camera.project(feet + np.array([0, 0, up_m])) for up_m in (0.0, _OBJECT_HEIGHT_M))
    return np.logical_and(*(valid & camera.contains(uv, 0.5) for uv, _, valid in ends))


def _ends(camera: Camera, ground_z_m: float) -> FloatArray:
    """(n, 3) where rays of a view end in the ego frame."""
    h, w = camera.size
    v, u = ((np.arange(n) + 0.5) / n * size - 0.5 for n, size in zip(_GRID, (h, w), strict=True))
    rays, _ = camera.unproject(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2))
    drop_m = camera.center_m[2] - ground_z_m
    reach_m = np.full(len(rays), _FAR_M)
    falls = -rays[:, 2] * _FAR_M > drop_m
    reach_m[falls] = drop_m / -rays[falls, 2]
    return camera.center_m + rays * reach_m[:, None]


def _seen(rig: Rig, points: FloatArray) -> BoolArray:
    """(n,) whether some camera sees points outside its mask."""
    seen = np.zeros(len(points), bool)
    for camera in rig:
        uv, _, valid = camera.project(points)
        inside = valid & camera.contains(uv, 0.5)
        if camera.mask is not None:
            column, row = np.round(uv[inside]).astype(int).clip(0, [camera.width_px - 1, camera.height_px - 1]).T
            inside[inside] = camera.mask[row, column]
        seen |= inside
    return seen
