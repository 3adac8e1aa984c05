"""The geometry of a sample, and the table ``GEOMETRIES`` of all surfaces made of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import PixelRays
from arbiview_aug.choices import GeometryName
from arbiview_aug.image_ops import Memory
from arbiview_aug.scene.boxes import BoxSurface, solids, solids_among
from arbiview_aug.scene.depth_map import Maps, forget, joined, points_of
from arbiview_aug.scene.point_cloud import PointCloudSurface, own_car
from arbiview_aug.scene.surface import (
    CorrectedSurface,
    Correction,
    Far,
    Ground,
    OcclusionMap,
    Points,
    StaticSurface,
    Street,
    Surface,
)

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
    _occlusion_maps: dict[tuple[Surface, bytes], OcclusionMap] = field(default_factory=dict, init=False, repr=False)

    @property
    def parts(self) -> dict[str, Geometry | None]:
        """Arrays and depth maps by the names in ``GeometryRow.reads``."""
        return {"boxes": self.boxes, "points": self.points, "motion": self.motion, **self.further}

    def geometry(self, name: str) -> Geometry | None:
        """The part of a name, or depth maps in place of missing points or motion; None if there is none."""
        substitute = {"points": "depth_m", "motion": "learned_depth_m"}.get(name, name)
        part = self.parts.get(name)
        return self.further.get(substitute) if part is None else part

    @property
    def is_empty(self) -> bool:
        """Whether there is no geometry."""
        return all(part is None for part in self.parts.values()) and not self.corrections

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
            row = GEOMETRIES[name]
            if row.needs is not None and self.geometry(row.needs) is None:
                raise ValueError(f"geometry={name!r}: expected a scene with {row.needs!r}, got one without")
            self._surfaces[key] = row.make(self, ground_z_m)
        return self._surfaces[key]

    def occlusion_map(self, surface: Surface, camera: Camera, rays: PixelRays, memory: Memory) -> OcclusionMap:
        """Occlusion by one of the scene's surfaces in a source; cached for the next target."""
        key = surface, camera.content_key
        if key not in self._occlusion_maps:
            self._occlusion_maps[key] = surface.occlusion_map(camera, rays, memory)
        return self._occlusion_maps[key]


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


def _measured(*reads: str, needs: str) -> GeometryRow:
    """The row of a surface of boxes among points and depth maps."""
    return GeometryRow(lambda scene, ground_z_m: _point_cloud(scene, ground_z_m, reads), ("boxes", *reads), needs)


def _point_cloud(scene: Scene, ground_z_m: float, reads: Sequence[str]) -> Surface:
    """Points of this frame and its neighbours, and depth maps, with the scene's boxes."""
    has_points = "points" in reads and scene.points is not None
    parts = (scene.points, scene.sweeps, scene.sky) if has_points else (None, None, None)
    clouds = [np.zeros((0, 3), np.float32) if part is None else part[:, :3] for part in parts]
    points, pixels = np.concatenate(clouds, dtype=np.float32), np.zeros(0, np.int32)
    points = points.compress(~own_car(points), axis=0)
    maps = joined(chain.from_iterable(part for name in reads if isinstance(part := scene.parts.get(name), tuple)))
    if maps:
        points, pixels = points_of(maps, points)
    boxes = scene.boxes if scene.boxes is not None and len(scene.boxes) else None
    if len(points) == 0:
        return scene.surface("street" if boxes is None else "boxes", ground_z_m)
    street, swept = _street(scene, ground_z_m), len(clouds[1]) > 0
    if boxes is None:
        return PointCloudSurface(street, points, len(pixels), swept, maps)
    planes, is_own, displaced = solids_among(boxes, points, ground_z_m)
    is_own_pixel = is_own[len(points) - len(pixels) :]
    forget(maps, pixels[is_own_pixel])
    mapped = int(np.count_nonzero(~is_own_pixel))
    others = PointCloudSurface(street, points.compress(~is_own, axis=0), mapped, swept, maps)
    return BoxSurface(others, boxes, planes, displaced)


GEOMETRIES: dict[str, GeometryRow] = {
    "auto": GeometryRow(
        lambda scene, z_m: scene.surface(scene.best, z_m), ("boxes", "points", "depth_m", "motion"), overlap_depth=True
    ),
    "infinity": GeometryRow(lambda scene, z_m: Far(), has_wall=False),
    "ground": GeometryRow(lambda scene, z_m: Ground(ground_z_m=z_m)),
    "street": GeometryRow(_street, overlap_depth=True),
    "boxes": GeometryRow(_boxes, ("boxes",), "boxes", overlap_depth=True),
    "lidar": _measured("points", "depth_m", needs="points"),
    "motion": _measured("motion", needs="motion"),
    "fused": _measured("points", "depth_m", "motion", "learned_depth_m", needs="motion"),
    "learned": _measured("learned_depth_m", needs="learned_depth_m"),
}
"""All surfaces by name. A new one is a class in this folder and a row here."""
