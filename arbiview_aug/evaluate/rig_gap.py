"""How far apart two rigs are for a detector that looks at single images.

It learns two cues of distance: the row where an object meets the road, and the object's size. Both belong to a rig:
read from another rig's images, they tell wrong distances.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig

OBJECT_HEIGHT_M = 1.6
_UP = np.array([0.0, 0.0, OBJECT_HEIGHT_M])  # from an object's foot to its top
_DISTANCES_M = np.geomspace(5.0, 40.0, 13)
_AZIMUTHS_DEG = np.arange(0.0, 360.0, 2.0)
_MOST = float(np.log(4.0))
"""Most that one cue counts, a log ratio: the horizon is at an infinite distance."""


class RigGap(NamedTuple):
    """The gap between a target rig and a source rig, over objects 1.6 m high all around, 5 to 40 m away.

    Attributes:
        unseen: Share of the objects in the target's images that no source camera sees.
        row: Mean |ln| of the factor by which the source's relation of rows to distances is wrong in the target's
            images; NaN where no object is in both rigs' images.
        size: The same of the relation of sizes to distances.
    """

    unseen: float
    row: float
    size: float

    def __str__(self) -> str:
        if self.unseen == 1:
            return "For a detector: the first rig sees none of the objects in the other's images; nothing to compare."
        row, size = (100 * np.expm1(value) for value in (self.row, self.size))
        return (
            f"For a detector, of objects {OBJECT_HEIGHT_M} m high, {_DISTANCES_M[0]:.0f} to {_DISTANCES_M[-1]:.0f} m "
            f"away in the other rig's images: the first rig does not see {self.unseen:.0%}. Read as the first rig's "
            f"images, distances are wrong by {row:.0f}% of the true ones by objects' rows, by {size:.0f}% by their "
            "sizes."
        )


def rig_gap(source: Rig, target: Rig) -> RigGap:
    """The gap from ``source``, which a detector was trained on, to ``target``; images are compared at equal widths."""
    target = target.in_frame_of(source)
    azimuth, distance = (part.ravel() for part in np.meshgrid(np.radians(_AZIMUTHS_DEG), _DISTANCES_M))
    road = np.full(azimuth.size, source.ground_z_m)
    feet = np.stack([distance * np.cos(azimuth), distance * np.sin(azimuth), road], axis=-1)
    before, after = _seen(source, feet), _seen(target, feet)
    both = (before >= 0) & (after >= 0)
    if not both.any():
        return RigGap(1.0, np.nan, np.nan)
    errors = []
    for a, b in {*zip(before[both].tolist(), after[both].tolist(), strict=True)}:
        here = feet[(before == a) & (after == b)]
        size = np.log(_size(target[b], here) / _size(source[a], here))
        errors.append(np.abs([_row_error(source[a], target[b], here, source.ground_z_m), size]))
    row, size = np.minimum(np.concatenate(errors, axis=1), _MOST).mean(axis=1).tolist()
    return RigGap(1 - both.sum() / (after >= 0).sum(), row, size)


def _seen(rig: Rig, feet: FloatArray) -> FloatArray:
    """For each object (n, 3), the camera nearest to whose axis its foot and its top are seen; -1: none."""
    cosines = np.full((len(rig), len(feet)), -2.0)
    for k, camera in enumerate(rig):
        rays = feet + _UP - camera.center_m
        seen = np.ones(len(feet), bool)
        for ends in (feet, feet + _UP):
            uv, _, valid = camera.project(ends)
            seen &= valid & camera.contains(uv, 0.5)
        cosines[k, seen] = ((rays @ camera.cam2ego[:3, 2]) / np.linalg.norm(rays, axis=-1))[seen]
    return np.where(cosines.max(0) > -2, cosines.argmax(0), -1)


def _size(camera: Camera, feet: FloatArray) -> FloatArray:
    """Heights of objects in the image times their distance, as a share of the image's width."""
    pixels = np.linalg.norm(camera.project(feet).uv - camera.project(feet + _UP).uv, axis=-1)
    return pixels / camera.width_px * np.linalg.norm(feet - camera.center_m, axis=-1)


def _row_error(a: Camera, b: Camera, feet: FloatArray, ground_z_m: float) -> FloatArray:
    """ln of the distance on the road that camera ``a`` has at the pixel of ``b``, over the true distance."""
    uv = b.project(feet).uv
    middle = np.array([[b.width_px - 1, b.height_px - 1], [a.width_px - 1, a.height_px - 1]]) / 2
    rays, valid = a.unproject((uv - middle[0]) * (a.width_px / b.width_px) + middle[1])
    down = np.maximum(-rays[:, 2], 1e-6)
    height_m = max(a.center_m[2] - ground_z_m, 1e-6)  # rows tell cameras below the road no distance
    told = height_m * np.hypot(rays[:, 0], rays[:, 1]) / down
    true = np.hypot(*(feet - b.center_m)[:, :2].T)
    return np.where(valid & (rays[:, 2] < 0), np.log(told / true), _MOST)
