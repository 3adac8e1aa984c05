"""A scene as plain data: convex primitives with materials, 3D boxes, the street's layout and the light.

Everything stands in the *street frame*: x along the road, y left, z up, the road plane at z = 0. The vehicle stands on
the road at ``ego2street``. Two kinds of primitive suffice: boxes with slanted sides (six half-spaces), and quadrics
(ellipsoids and capped elliptic cylinders). All are convex, so that one interval along a ray describes each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum

import numpy as np
import numpy.typing as npt

FloatArray = npt.NDArray[np.float64]
IntArray = npt.NDArray[np.int64]


class SceneClass(IntEnum):
    """Class of a pixel. ``GROUND`` is the road plane at ``ground_z_m``; ``SIDEWALK`` is raised by the kerb."""

    VOID = 0  # the lens sees nothing here
    SKY = 1
    GROUND = 2
    SIDEWALK = 3
    BUILDING = 4
    POLE = 5
    VEGETATION = 6
    VEHICLE = 7
    PEDESTRIAN = 8


class BoxClass(IntEnum):
    """Classes of the 3D boxes."""

    CAR = 0
    VAN = 1
    TRUCK = 2
    BUS = 3
    PEDESTRIAN = 4


class Material(IntEnum):
    """Materials: one function of ``shading`` each."""

    ROAD = 0
    SLAB = 1
    FACADE = 2
    PAINT = 3
    GLASSHOUSE = 4
    COACH = 5
    PLAIN = 6
    WHEEL = 7
    SIGN = 8
    LEAF = 9
    ROUGH = 10


BOX, ELLIPSOID, CYLINDER = 0, 1, 2


@dataclass(frozen=True, kw_only=True)
class Street:
    """Layout of the road: plain numbers in the street frame, metres."""

    lanes: int
    """Lanes in each direction; traffic keeps to the right."""
    lane_width_m: float
    half_width_m: tuple[float, float]
    """Road edge to the right (y < 0) and to the left (y > 0), both positive."""
    parking: tuple[bool, bool]
    sidewalk_m: tuple[float, float]
    verge_m: tuple[float, float]
    """Width of the grass between kerb and paving; 0 for none."""
    kerb_m: float
    crossing_x_m: float
    """Centre of the crossing street, infinite where there is none."""
    crossing_half_m: float
    zebra: bool
    solid_centre: bool
    yellow_centre: bool
    asphalt: float
    """Mean grey of the asphalt, 0 to 1."""
    wear: float
    """Strength of cracks, patches and stains, about 0.5 to 1.5."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """Sun and sky: directions in the street frame, colours in display units, 0 to 1."""

    sun: tuple[float, float, float]
    sun_strength: float
    zenith: tuple[float, float, float]
    horizon: tuple[float, float, float]
    clouds: float


@dataclass(frozen=True, kw_only=True)
class Scene:
    """One street scene; depends on (seed, index) alone.

    Attributes:
        kind: (P,) BOX, ELLIPSOID or CYLINDER.
        center: (P, 3) street frame, metres.
        rotation: (P, 3, 3) local axes as columns in the street frame.
        half: (P, 3) half extents along the local axes; a cylinder's axis is its local z.
        planes: (P, 6, 4) outward half-spaces n·p <= b of boxes, street frame: front, rear, left, right, top, bottom.
        corners: (P, 8, 3) a convex hull around each primitive, street frame.
        material, cls, instance: (P,) ``Material``, ``SceneClass``, row of ``boxes`` or -1.
        color: (P, 3) display RGB, 0 to 1.
        param: (P, 4) numbers whose meaning is the material's.
        boxes: (B, 7) centre x y z, length, width, height, yaw (radians), street frame.
        box_classes: (B,) ``BoxClass``.
        velocities: (B, 2) of the boxes, m/s, street frame.
        speed_mps: Of the vehicle, straight ahead.
        ego2street: (4, 4) pose of the vehicle, its road plane at z = 0.
        salt: Seed of the textures.
    """

    kind: IntArray
    center: FloatArray
    rotation: FloatArray
    half: FloatArray
    planes: FloatArray
    corners: FloatArray
    material: IntArray
    cls: IntArray
    instance: IntArray
    color: FloatArray
    param: FloatArray
    boxes: FloatArray
    box_classes: IntArray
    velocities: FloatArray
    speed_mps: float
    ego2street: FloatArray
    street: Street
    light: Light
    salt: int

    def __len__(self) -> int:
        return len(self.kind)

    def boxes_ego(self, ground_z_m: float) -> FloatArray:
        """(B, 7) boxes in the ego frame whose road lies at ``ground_z_m``."""
        R, origin = self.ego2street[:3, :3], self.ego2street[:3, 3]
        boxes = self.boxes.copy()
        boxes[:, :3] = (boxes[:, :3] - origin) @ R
        boxes[:, 2] += ground_z_m
        yaw = boxes[:, 6] - math.atan2(R[1, 0], R[0, 0])
        boxes[:, 6] = np.arctan2(np.sin(yaw), np.cos(yaw))
        return boxes

    def after(self, seconds: float) -> Scene:
        """The scene so much later (or earlier): the vehicle and what has a velocity have moved, straight on."""
        ego2street = self.ego2street.copy()
        ego2street[:3, 3] += self.speed_mps * seconds * ego2street[:3, 0]
        moves = np.zeros((len(self.boxes) + 1, 3))  # the last one is what belongs to no box
        moves[:-1, :2] = self.velocities * seconds
        move = moves[self.instance]
        planes, boxes = self.planes.copy(), self.boxes.copy()
        planes[..., 3] += (planes[..., :3] * move[:, None]).sum(-1)
        boxes[:, :3] += moves[:-1]
        return replace(
            self,
            center=self.center + move,
            planes=planes,
            corners=self.corners + move[:, None],
            boxes=boxes,
            ego2street=ego2street,
        )


_SIGNS = np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)], dtype=np.float64)


def yaw_matrix(yaw: float) -> FloatArray:
    """(3, 3) rotation about z, radians."""
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass
class SceneBuilder:
    """Collects primitives and boxes; parts may be given relative to a placed object."""

    kind: list[int] = field(default_factory=list)
    center: list[FloatArray] = field(default_factory=list)
    rotation: list[FloatArray] = field(default_factory=list)
    half: list[FloatArray] = field(default_factory=list)
    planes: list[FloatArray] = field(default_factory=list)
    corners: list[FloatArray] = field(default_factory=list)
    material: list[int] = field(default_factory=list)
    cls: list[int] = field(default_factory=list)
    instance: list[int] = field(default_factory=list)
    color: list[tuple[float, float, float]] = field(default_factory=list)
    param: list[tuple[float, float, float, float]] = field(default_factory=list)
    boxes: list[tuple[float, ...]] = field(default_factory=list)
    box_classes: list[int] = field(default_factory=list)

    def place(self, origin: tuple[float, float, float], yaw: float, cls: SceneClass, instance: int = -1) -> Placed:
        """A frame (origin on the surface it stands on, x forward) to add parts in."""
        return Placed(self, np.array(origin, dtype=np.float64), yaw_matrix(yaw), int(cls), instance)

    def add_box(self, center: FloatArray, size: tuple[float, float, float], yaw: float, cls: BoxClass) -> int:
        """A 3D label; returns its row."""
        self.boxes.append((*map(float, center), *size, yaw))
        self.box_classes.append(int(cls))
        return len(self.boxes) - 1

    def arrays(self) -> dict[str, npt.NDArray]:
        """The collected lists in ``Scene``'s shapes."""
        integer = {"kind", "material", "cls", "instance", "box_classes"}
        out = {f.name: np.array(getattr(self, f.name)) for f in fields(self)}
        out = {k: v.astype(np.int64 if k in integer else np.float64) for k, v in out.items()}
        out["boxes"] = out["boxes"].reshape(-1, 7)
        return out


@dataclass
class Placed:
    """Adds parts of one object in the object's own frame."""

    builder: SceneBuilder
    origin: FloatArray
    rotation: FloatArray
    cls: int
    instance: int

    def box(
        self,
        x: tuple[float, float],
        y: tuple[float, float],
        z: tuple[float, float],
        material: Material,
        color: tuple[float, float, float],
        *,
        taper: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
        param: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """A box from its bounds; ``taper``: how far front, rear, left and right lean inward at the top, metres."""
        lo, hi = np.array([x[0], y[0], z[0]]), np.array([x[1], y[1], z[1]])
        half, middle = (hi - lo) / 2, (hi + lo) / 2
        hx, hy, hz = half
        kf, kr, kl, kt = taper
        normals = np.array(
            [[2 * hz, 0, kf], [-2 * hz, 0, kr], [0, 2 * hz, kl], [0, -2 * hz, kt], [0, 0, 1], [0, 0, -1]]
        )
        offsets = np.array([2 * hx - kf, 2 * hx - kr, 2 * hy - kl, 2 * hy - kt, 1, 1]) * hz
        norm = np.linalg.norm(normals, axis=1)
        normals, offsets = normals / norm[:, None], offsets / norm
        corners = _SIGNS * half
        top = corners[:, 2] > 0
        corners[:, 0] -= np.where(top, np.where(corners[:, 0] > 0, kf, -kr), 0)
        corners[:, 1] -= np.where(top, np.where(corners[:, 1] > 0, kl, -kt), 0)
        self._add(BOX, middle, np.eye(3), half, normals, offsets, corners, material, color, param)

    def ellipsoid(
        self,
        center: tuple[float, float, float],
        radii: tuple[float, float, float],
        material: Material,
        color: tuple[float, float, float],
        *,
        param: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """An ellipsoid along the object's axes."""
        half = np.array(radii)
        self._add(ELLIPSOID, np.array(center), np.eye(3), half, None, None, _SIGNS * half, material, color, param)

    def cylinder(
        self,
        center: tuple[float, float, float],
        radii: tuple[float, float],
        half_length: float,
        material: Material,
        color: tuple[float, float, float],
        *,
        lateral: bool = False,
        param: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """A capped elliptic cylinder, upright or (wheels) with its axis along the object's y."""
        half = np.array([*radii, half_length])
        axes = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]).T if lateral else np.eye(3)
        self._add(CYLINDER, np.array(center), axes, half, None, None, _SIGNS * half, material, color, param)

    def _add(
        self,
        kind: int,
        middle: FloatArray,
        axes: FloatArray,
        half: FloatArray,
        normals: FloatArray | None,
        offsets: FloatArray | None,
        corners: FloatArray,
        material: Material,
        color: tuple[float, float, float],
        param: tuple[float, float, float, float],
    ) -> None:
        b = self.builder
        rotation = self.rotation @ axes
        center = self.origin + self.rotation @ middle
        planes = np.zeros((6, 4))
        if normals is not None and offsets is not None:
            planes[:, :3] = normals @ rotation.T
            planes[:, 3] = offsets + planes[:, :3] @ center
        b.kind.append(kind)
        b.center.append(center)
        b.rotation.append(rotation)
        b.half.append(half)
        b.planes.append(planes)
        b.corners.append(center + corners @ rotation.T)
        b.material.append(int(material))
        b.cls.append(self.cls)
        b.instance.append(self.instance)
        b.color.append(color)
        b.param.append(param)
