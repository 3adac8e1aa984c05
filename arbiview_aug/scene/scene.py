"""The geometry of a sample, and the table ``GEOMETRIES`` of all surfaces made of it; points of depth maps."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.validation import MOST_M
from arbiview_aug.choices import GeometryName
from arbiview_aug.errors import SampleError
from arbiview_aug.scene.boxes import BoxSurface, solids
from arbiview_aug.scene.panorama import CELL_RAD
from arbiview_aug.scene.point_cloud import PointCloudSurface, PointCloudWithBoxes
from arbiview_aug.scene.surface import CorrectedSurface, Correction, Far, Ground, Points, StaticSurface, Street, Surface

MOTION_WIDTH_PX = 450
"""Images are halved until their width is nearest to this, by ratio: to 318 to 636 px."""

ANCHOR_RAD = math.radians(1.0)
"""Distance over which a depth map follows points, as a Gaussian's sigma: with 32 scan lines 0.5 to 1 degree are as
good, 2 lose 1 dB."""

ANCHOR_SHARE = 0.25
"""Points and a map that differ by more than this share show different things: one is hidden, moved, or wrong."""

_UNANCHORED = 0.1  # points to the square of ``ANCHOR_RAD``, below which a map is believed more than they


def motion_camera(camera: Camera) -> Camera:
    """The camera of an image halved to ``MOTION_WIDTH_PX``, without odd rows and columns."""
    level = halvings(camera)
    if level == 0:
        return camera
    h, w = (side >> level for side in camera.size)
    return camera.crop(0, 0, (h << level, w << level)).resize((h, w))


def halvings(camera: Camera) -> int:
    """Number of halvings of a camera's images."""
    return max(0, round(math.log2(camera.width_px / MOTION_WIDTH_PX)))


def anchored(camera: Camera, depth_m: FloatArray, points: Points) -> FloatArray:
    """A camera's depth map (H, W), 0 where unknown, fused with points (P, 3) in the ego frame; its outlines stay.

    The logarithm of what the map says over what the points say is averaged around each pixel. A pixel is unknown where
    the map contradicts most of the points around it.
    """
    h, w = camera.size
    uv, z, valid = camera.project(points)
    x, y = np.rint(np.where(valid[:, None], uv, -1)).T
    valid &= (x >= 0) & (x < w) & (y >= 0) & (y < h) & (z > 0)
    at = y[valid].astype(np.int64) * w + x[valid].astype(np.int64)
    ratio = depth_m.reshape(-1)[at] / z[valid]
    agrees = (ratio > 1 - ANCHOR_SHARE) & (ratio < 1 / (1 - ANCHOR_SHARE))
    logarithm = np.log(np.where(agrees, ratio, 1))
    sigma = min(ANCHOR_RAD * float(camera.K[0, 0]), max(h, w))  # the blur's time grows with it
    total, agreeing, others = (
        cv2.GaussianBlur(np.bincount(at, weights, h * w).astype(float).reshape(h, w), (0, 0), sigma)
        for weights in (logarithm, agrees.astype(float), (~agrees & (ratio > 0)).astype(float))
    )
    scale = np.exp(total / (agreeing + _UNANCHORED / (2 * math.pi * sigma**2)))
    return np.asarray(np.where(others > agreeing, 0, depth_m / scale))


def believed(depth_m: FloatArray, network_m: FloatArray) -> FloatArray:
    """Depth from motion (H, W), 0 where a network's depth (H, W) contradicts it: moving things have wrong distances."""
    if depth_m.shape != network_m.shape:
        return depth_m
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = depth_m / np.where(np.isfinite(network_m) & (network_m > 0), network_m, depth_m)
    return np.where((ratio < 1 - ANCHOR_SHARE) | (ratio > 1 / (1 - ANCHOR_SHARE)), 0, depth_m)


def points_of_depth(
    camera: Camera, depth_m: FloatArray, key: str = "depth_m", anchors: Points | None = None
) -> FloatArray:
    """(P, 3) ego-frame points of a depth map (H, W): z along the optical axis, metres; 0, NaN and inf are unknown.

    Pixels closer together than a panorama's cells are skipped, as are masked ones. The map is brought to ``anchors``
    (P, 3) if there are any.
    """
    if depth_m.shape != camera.size:
        raise SampleError(f"{key}: camera {camera.name!r}: expected a map of {camera.size}, got {depth_m.shape}")
    if anchors is not None and len(anchors):
        depth_m = anchored(camera, np.where(np.isfinite(depth_m), depth_m, 0), anchors)
    step = max(1, int(CELL_RAD * float(camera.K[0, 0])))
    pixels = camera.pixel_grid()[::step, ::step]
    depth = depth_m[::step, ::step]
    known = (depth > 0) & (depth <= MOST_M)
    if camera.mask is not None:
        known &= camera.mask[::step, ::step]
    rays, valid = camera.unproject_cam(pixels[known])
    ahead = valid & (rays[:, 2] > 1e-6)
    local = rays[ahead] * (depth[known][ahead] / rays[ahead, 2])[:, None]
    return local @ camera.cam2ego[:3, :3].T + camera.center_m


_ROWS = 1 << 18  # hashed at once, to avoid a copy of all points


@dataclass(frozen=True, eq=False)
class Scene:
    """The geometry of a sample, in the source's ego frame.

    Attributes:
        boxes: (B, 7) labelled objects: centre x, y, z, length, width, height (metres), yaw (radians).
        points: (P, 3) measured points, metres.
        motion: (P, 3) points of depth from motion, metres.
        sweeps: (P, 3) points of neighbouring frames beside ``points``, metres.
        further: Arrays of other sample keys that a row of ``GEOMETRIES`` reads.
        corrections: Corrections of the street's distances by depth from overlap.
        known: Surface whose distances are known, in place of all others but ``far``.
    """

    boxes: FloatArray | None = None
    points: Points | None = None
    motion: Points | None = None
    sweeps: Points | None = None
    further: Mapping[str, Points] = field(default_factory=dict)
    corrections: tuple[Correction, ...] = ()
    known: Surface | None = None
    _surfaces: dict[tuple[str, float], Surface] = field(default_factory=dict, init=False, repr=False)

    def geometry(self, name: str) -> Points | None:
        """The array of a name in ``GeometryRow.reads``; None if there is none."""
        other = {"points": "depth_m", "motion": "learned_depth_m"}.get(name)  # what may stand in its place
        if other is not None and getattr(self, name) is None:
            return self.further.get(other)
        return getattr(self, name) if name in ("boxes", "points", "motion") else self.further.get(name)

    @cached_property
    def is_empty(self) -> bool:
        """Whether there is no geometry."""
        arrays = self.boxes, self.points, self.motion
        return all(array is None for array in arrays) and not self.further and not self.corrections

    @property
    def words(self) -> str:
        """How much of which geometry there is; empty without any."""
        arrays = {"boxes": self.boxes, "points": self.points, "points of depth from motion": self.motion}
        arrays["points of neighbouring frames"] = self.sweeps
        arrays |= {f"points of {key}": array for key, array in self.further.items() if array.ndim == 2}
        return ", ".join(f"{len(array)} {name}" for name, array in arrays.items() if array is not None and len(array))

    @cached_property
    def best(self) -> GeometryName:
        """The surface that ``auto`` uses: made of the most accurate geometry."""
        motion = self.motion is not None and len(self.motion) > 0
        if any(array is not None and len(array) for array in (self.points, self.further.get("depth_m"))):
            return "fused" if motion else "lidar"
        return "motion" if motion else "street" if self.boxes is None else "boxes"

    @property
    def key(self) -> bytes:
        """Content hash."""
        digest = hashlib.sha256(repr(sorted(self.further)).encode())
        parts = self.boxes, self.points, self.motion, self.sweeps
        for array in (*parts, *(self.further[key] for key in sorted(self.further))):
            digest.update(b"none" if array is None else repr((array.shape, array.dtype.str)).encode())
            for rows in () if array is None else np.array_split(array, 1 + len(array) // _ROWS):
                digest.update(rows.tobytes())
        for correction in self.corrections:
            digest.update(correction.key)
        return digest.digest()

    def surface(self, name: str, ground_z_m: float) -> Surface:
        """A surface by name, over a road at ``ground_z_m``; cached."""
        if self.known is not None and name != "infinity":
            return self.known
        key = name, ground_z_m
        if key not in self._surfaces:
            row = GEOMETRIES.get(name)
            if row is None or (row.needs is not None and self.geometry(row.needs) is None):
                raise ValueError(f"surface: {name!r} is unknown, or the scene has no geometry for it")
            self._surfaces[key] = row.make(self, ground_z_m)
        return self._surfaces[key]


@dataclass(frozen=True)
class GeometryRow:
    """A row of ``GEOMETRIES``.

    Attributes:
        make: Makes the surface of a scene, over a road at a height in metres.
        reads: The geometry that it uses: ``boxes``, ``points``, ``motion``, or any other key of the sample.
        needs: The geometry that it cannot be made without.
        overlap_depth: Whether depth from overlap may correct it.
        has_wall: Whether it ends in the far wall, which has edges when seen from outside.
    """

    make: Callable[[Scene, float], Surface]
    reads: tuple[str, ...] = ()
    needs: str | None = None
    overlap_depth: bool = False
    has_wall: bool = True

    @cached_property
    def is_static(self) -> bool:
        """Whether it uses no geometry of the sample, so that its plans depend on the calibration alone."""
        return not self.reads


def _street(scene: Scene, ground_z_m: float) -> StaticSurface:
    street = Street(ground_z_m=ground_z_m)
    return CorrectedSurface(street, scene.corrections) if scene.corrections else street


def _boxes(scene: Scene, ground_z_m: float) -> Surface:
    assert scene.boxes is not None
    return BoxSurface(_street(scene, ground_z_m), scene.boxes, solids(scene.boxes))


def _point_cloud(scene: Scene, ground_z_m: float, points: Points | None, *maps: Points | None) -> Surface:
    """Points with those of neighbouring frames, and those of depth maps, with the scene's boxes."""
    boxes = scene.boxes if scene.boxes is not None and len(scene.boxes) else None
    sweeps = None if points is None else scene.sweeps
    parts = [np.zeros((0, 3), np.float32) if part is None else part[:, :3] for part in (points, sweeps, *maps)]
    # One type and layout: kernels are compiled for each.
    street, together = _street(scene, ground_z_m), np.ascontiguousarray(np.concatenate(parts), np.float32)
    if len(together) == 0:
        return scene.surface("street" if boxes is None else "boxes", ground_z_m)
    mapped, swept = len(together) - len(parts[0]) - len(parts[1]), len(parts[1]) > 0
    if boxes is None:
        return PointCloudSurface(street, together, mapped, swept)
    return PointCloudWithBoxes.among(street, together, boxes, mapped, swept)


GEOMETRIES: dict[str, GeometryRow] = {
    "auto": GeometryRow(
        lambda scene, z_m: scene.surface(scene.best, z_m), ("boxes", "points", "depth_m", "motion"), overlap_depth=True
    ),
    "infinity": GeometryRow(lambda scene, z_m: Far(), has_wall=False),
    "ground": GeometryRow(lambda scene, z_m: Ground(ground_z_m=z_m)),
    "street": GeometryRow(_street, overlap_depth=True),
    "boxes": GeometryRow(_boxes, ("boxes",), "boxes", overlap_depth=True),
    "lidar": GeometryRow(
        lambda scene, z_m: _point_cloud(scene, z_m, scene.points, scene.further.get("depth_m")),
        ("boxes", "points", "depth_m"),
        "points",
    ),
    "motion": GeometryRow(
        lambda scene, z_m: _point_cloud(scene, z_m, None, scene.motion), ("boxes", "motion"), "motion"
    ),
    "fused": GeometryRow(
        lambda scene, z_m: _point_cloud(
            scene, z_m, scene.points, *map(scene.further.get, ("depth_m", "learned_depth_m")), scene.motion
        ),
        ("boxes", "points", "depth_m", "motion", "learned_depth_m"),
        "motion",
    ),
    "learned": GeometryRow(
        lambda scene, z_m: _point_cloud(scene, z_m, None, scene.further["learned_depth_m"]),
        ("boxes", "learned_depth_m"),
        "learned_depth_m",
    ),
}
"""All surfaces by name. A new one is a class in this folder and a row here."""
