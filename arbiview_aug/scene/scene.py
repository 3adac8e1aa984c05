"""The geometry of a sample, and the table ``GEOMETRIES`` of all surfaces made of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.choices import GeometryName
from arbiview_aug.scene.boxes import BoxSurface, solids, solids_among
from arbiview_aug.scene.depth_map import Maps, forget, joined, points_of
from arbiview_aug.scene.point_cloud import PointCloudSurface, own_car
from arbiview_aug.scene.surface import CorrectedSurface, Correction, Far, Ground, Points, StaticSurface, Street, Surface

Geometry = Points | Maps


@dataclass(frozen=True, eq=False)
class Scene:
    """The geometry of a sample, in the source's ego frame."""

    boxes: FloatArray | None = None  # (B, 7) centre x, y, z, length, width, height (metres), yaw (radians)
    points: Points | None = None  # (P, 3) measured points, metres
    motion: Maps | None = None  # depth maps from motion
    sweeps: Points | None = None  # (P, 3) points of neighbouring frames beyond ``points``, metres
    sky: Points | None = None  # (P, 3) points by photographs where no scan line returned, metres
    # depth maps and arrays of other sample keys that a row of ``GEOMETRIES`` reads
    further: Mapping[str, Geometry] = field(default_factory=dict)
    corrections: tuple[Correction, ...] = ()  # of the street's distances by depth from overlap
    known: Surface | None = None  # surface whose distances are known, in place of all others but ``far``
    _surfaces: dict[tuple[str, float], Surface] = field(default_factory=dict, init=False, repr=False)

    def geometry(self, name: str) -> Geometry | None:
        """The arrays or depth maps of a name in ``GeometryRow.reads``; None if there is none."""
        substitute = {"points": "depth_m", "motion": "learned_depth_m"}.get(name)
        if substitute is not None and getattr(self, name) is None:
            return self.further.get(substitute)
        return getattr(self, name) if name in ("boxes", "points", "motion") else self.further.get(name)

    @property
    def is_empty(self) -> bool:
        """Whether there is no geometry."""
        arrays = self.boxes, self.points, self.motion
        return all(array is None for array in arrays) and not self.further and not self.corrections

    @cached_property
    def best(self) -> GeometryName:
        """The geometry of ``auto`` in this scene: the surface made of the most accurate data."""
        motion = self.motion is not None and len(self.motion) > 0
        if any(array is not None and len(array) for array in (self.points, self.further.get("depth_m"))):
            return "fused" if motion else "lidar"
        return "motion" if motion else "street" if self.boxes is None else "boxes"

    def surface(self, name: str, ground_z_m: float) -> Surface:
        """A surface by name, over a road at ``ground_z_m``; cached."""
        if self.known is not None and name != "infinity":
            return self.known
        key = name, ground_z_m
        if key not in self._surfaces:
            row = GEOMETRIES.get(name)
            if row is None:
                raise ValueError(f"geometry: expected one of {', '.join(GEOMETRIES)}, got {name!r}")
            if row.needs is not None and self.geometry(row.needs) is None:
                raise ValueError(f"geometry={name!r}: expected a scene with {row.needs!r}, got one without")
            self._surfaces[key] = row.make(self, ground_z_m)
        return self._surfaces[key]


@dataclass(frozen=True)
class GeometryRow:
    """A row of ``GEOMETRIES``."""

    make: Callable[[Scene, float], Surface]  # the surface of a scene, over a road at a height in metres
    reads: tuple[str, ...] = ()  # geometry that it uses: ``boxes``, ``points``, ``motion``, or other keys of the sample
    needs: str | None = None  # the geometry that it cannot be made without
    overlap_depth: bool = False  # whether depth from overlap may correct it
    has_wall: bool = True  # whether it ends in the far wall, which has edges when seen from outside

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


def _point_cloud(scene: Scene, ground_z_m: float, points: Points | None, *maps: Geometry | None) -> Surface:
    """Points of this frame and its neighbours, and depth maps, with the scene's boxes."""
    from arbiview_aug.scene.kernels import close_gaps

    boxes = scene.boxes if scene.boxes is not None and len(scene.boxes) else None
    further = (None, None) if points is None else (scene.sweeps, scene.sky)
    parts = [np.zeros((0, 3), np.float32) if part is None else part[:, :3] for part in (points, *further)]
    together = np.concatenate(parts, dtype=np.float32)
    together = together[: close_gaps(together, np.concatenate([own_car(part) for part in parts]))]
    known, pixels = [], np.zeros(0, np.int32)
    if depth_maps := [part for part in maps if isinstance(part, tuple) and part]:
        known = joined(chain.from_iterable(depth_maps))
        together, pixels = points_of(known, together)
    street = _street(scene, ground_z_m)
    if len(together) == 0:
        return scene.surface("street" if boxes is None else "boxes", ground_z_m)
    swept = len(parts[1]) > 0
    if boxes is None:
        return PointCloudSurface(street, together, len(pixels), swept, known)
    planes, is_own, displaced = solids_among(boxes, together, ground_z_m)
    is_own_pixel = is_own[len(together) - len(pixels) :]
    if known:
        forget(known, pixels[is_own_pixel])
    others = together[: close_gaps(together, is_own)], int(np.count_nonzero(~is_own_pixel))
    return BoxSurface(PointCloudSurface(street, *others, swept, known), boxes, planes, displaced)


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
