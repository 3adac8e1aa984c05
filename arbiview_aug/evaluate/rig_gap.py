"""How far apart two rigs are for a detector: what it learned on one, told by the images of the other.

A detector that looks at single images learns two cues of distance: the row where an object meets the road, and the
object's size. Both belong to a rig. Read from another rig's images, they tell wrong distances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig

OBJECT_HEIGHT_M = 1.6
_DISTANCES_M = np.geomspace(5.0, 40.0, 13)
_AZIMUTHS_DEG = np.arange(0.0, 360.0, 2.0)
_MOST = float(np.log(4.0))
"""Most that one cue counts, a log ratio: the horizon is at an infinite distance."""


@dataclass(frozen=True)
class RigGap:
    """The gap between a target rig and a source rig, over objects 1.6 m high all around, 5 to 40 m away.

    Attributes:
        unseen: Share of the objects in the target's images that no source camera sees.
        row: Mean |ln| of the factor by which the source's relation of rows to distances is wrong in the target's
            images.
        size: The same of the relation of sizes to distances.
        parallax_deg: Mean angle between the directions in which both see an object. These three are NaN where no
            object is in both rigs' images.
    """

    unseen: float
    row: float
    size: float
    parallax_deg: float

    def __str__(self) -> str:
        if self.unseen == 1:
            return "For a detector: the first rig sees none of the objects in the other's images; nothing to compare."
        row, size = (100 * np.expm1(value) for value in (self.row, self.size))
        return (
            f"For a detector, of objects {OBJECT_HEIGHT_M} m high, {_DISTANCES_M[0]:.0f} to {_DISTANCES_M[-1]:.0f} m "
            f"away in the other rig's images: the first rig does not see {self.unseen:.0%}. Read as the first rig's "
            f"images, distances are wrong by {row:.0f}% of the true ones by objects' rows, by {size:.0f}% by their "
            f"sizes; objects are seen from directions {self.parallax_deg:.1f} deg apart."
        )


def rig_gap(source: Rig, target: Rig) -> RigGap:
    """The gap from ``source``, which a detector was trained on, to ``target``; images are compared at equal widths."""
    target = target.in_frame_of(source)
    azimuth, distance = np.meshgrid(np.radians(_AZIMUTHS_DEG), _DISTANCES_M)
    road = np.full(azimuth.size, source.ground_z_m)
    feet = np.stack([distance.ravel() * np.cos(azimuth.ravel()), distance.ravel() * np.sin(azimuth.ravel()), road], -1)
    before, after = _seen(source, feet), _seen(target, feet)
    both = (before >= 0) & (after >= 0)
    rows, sizes, angles = [], [], []
    for a, b in {(int(a), int(b)) for a, b in zip(before[both], after[both], strict=True)}:
        here = feet[(before == a) & (after == b)]
        rows.append(_row_error(source[a], target[b], here, source.ground_z_m))
        sizes.append(np.log(_size(target[b], here) / _size(source[a], here)))
        angles.append(_angle(source[a], target[b], here))
    seen = int((after >= 0).sum())
    return RigGap(
        unseen=1 - int(both.sum()) / seen if seen else 1.0,
        row=_mean(rows),
        size=_mean(sizes),
        parallax_deg=float(np.degrees(_mean(angles))),
    )


def _mean(parts: list[FloatArray]) -> float:
    """Mean of absolute values, cut."""
    return float(np.minimum(np.abs(np.concatenate(parts)), _MOST).mean()) if parts else float("nan")


def _seen(rig: Rig, feet: FloatArray) -> FloatArray:
    """For each object (n, 3), the camera nearest to whose axis its foot and its top are seen; -1: none."""
    cosines = np.full((len(rig), len(feet)), -2.0)
    for k, camera in enumerate(rig):
        rays = _tops(feet) - camera.center_m
        seen = _inside(camera, feet) & _inside(camera, _tops(feet))
        cosines[k, seen] = ((rays @ camera.cam2ego[:3, 2]) / np.linalg.norm(rays, axis=-1))[seen]
    return np.where(cosines.max(0) > -2, cosines.argmax(0), -1)


def _tops(feet: FloatArray) -> FloatArray:
    return feet + np.array([0.0, 0.0, OBJECT_HEIGHT_M])


def _inside(camera: Camera, points: FloatArray) -> BoolArray:
    uv, _, valid = camera.project(points)
    return np.asarray(valid & camera.contains(uv, 0.5))


def _size(camera: Camera, feet: FloatArray) -> FloatArray:
    """Heights of objects in the image times their distance, as a share of the image's width."""
    pixels = np.linalg.norm(camera.project(feet).uv - camera.project(_tops(feet)).uv, axis=-1)
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


def _angle(a: Camera, b: Camera, feet: FloatArray) -> FloatArray:
    """Radians between the directions in which two cameras see objects' middles."""
    middles = (feet + _tops(feet)) / 2
    one, two = ((middles - c.center_m) for c in (a, b))
    cosine = (one * two).sum(-1) / (np.linalg.norm(one, axis=-1) * np.linalg.norm(two, axis=-1))
    return np.arccos(np.clip(cosine, -1, 1))
