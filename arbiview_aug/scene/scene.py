"""What a sample says of the geometry around the vehicle, and the surfaces that can be made of it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.scene.boxes import BoxSurface
from arbiview_aug.scene.corrected import CorrectedSurface, Correction
from arbiview_aug.scene.point_cloud import PointCloudSurface, PointCloudWithBoxes
from arbiview_aug.scene.static import Far, Ground, Street
from arbiview_aug.scene.surface import Points, StaticSurface, Surface, SurfaceName

_ROWS = 1 << 18  # hashed at once: bytes of ten million points would be another copy of them


@dataclass(frozen=True, eq=False)
class Scene:
    """Geometry that came with a sample, in the source's ego frame; an empty one knows the road alone.

    Attributes:
        boxes: (B, 7) labelled objects: centre x, y, z, length, width, height (metres), yaw (radians).
        points: (P, 3) measured points, metres.
        motion: (P, 3) points that motion between frames measured, metres; none where it was declined.
        corrections: What overlaps say of the street's distances.
    """

    boxes: FloatArray | None = None
    points: Points | None = None
    motion: Points | None = None
    corrections: tuple[Correction, ...] = ()
    _surfaces: dict[tuple[str, float], Surface] = field(default_factory=dict, init=False, repr=False)

    @property
    def is_empty(self) -> bool:
        """Whether nothing is known but the road."""
        return all(known is None for known in (self.boxes, self.points, self.motion)) and not self.corrections

    @property
    def best(self) -> SurfaceName:
        """The surface made of the best geometry that there is: what ``auto`` takes."""
        if self.points is not None and len(self.points):
            return "lidar"
        return "street" if self.boxes is None else "objects"

    @property
    def key(self) -> bytes:
        """Content hash: scenes with equal keys are the same."""
        digest = hashlib.sha256()
        for array in (self.boxes, self.points, self.motion):
            digest.update(b"none" if array is None else repr((array.shape, array.dtype.str)).encode())
            for rows in () if array is None else np.array_split(array, 1 + len(array) // _ROWS):
                digest.update(rows.tobytes())
        for correction in self.corrections:
            digest.update(correction.key)
        return digest.digest()

    def surface(self, name: str, ground_z_m: float) -> Surface:
        """A surface by name, over a road at ``ground_z_m``; kept, with what it holds of its own.

        Raises:
            ValueError: An unknown name, or geometry that the scene lacks.
        """
        key = name, ground_z_m
        if key not in self._surfaces:
            self._surfaces[key] = self._made(name, ground_z_m)
        return self._surfaces[key]

    def _made(self, name: str, ground_z_m: float) -> Surface:
        street: StaticSurface = Street(ground_z_m=ground_z_m)
        if self.corrections:
            street = CorrectedSurface(street, self.corrections)
        if name == "far":
            return Far()
        if name == "ground":
            return Ground(ground_z_m=ground_z_m)
        if name == "street":
            return street
        if name == "objects" and self.boxes is not None:
            return BoxSurface(street, self.boxes)
        points = {"lidar": self.points, "motion": self.motion}.get(name)
        if points is not None:
            some_boxes = self.boxes is not None and len(self.boxes) > 0
            if len(points) == 0:
                return self.surface("objects" if some_boxes else "street", ground_z_m)
            if self.boxes is not None and some_boxes:
                return PointCloudWithBoxes.among(street, points, self.boxes)
            return PointCloudSurface(street, points)
        raise ValueError(f"surface: {name!r} is unknown, or the scene has no geometry for it")
