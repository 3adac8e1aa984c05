"""A scene as plain data: convex primitives with materials, 3D boxes, the street's layout and the light.

The *street frame* has x along the road, y left, z up, and the road plane at z = 0. Primitives are boxes with slanted
sides (six half-spaces), ellipsoids and capped elliptic cylinders: one interval along a ray describes each.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rotations import yaw_matrix

IntArray = npt.NDArray[np.int64]
Range = tuple[float, float]
Vector = tuple[float, float, float]
Param = tuple[float, float, float, float]


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
    """Class of a 3D box."""

    CAR, VAN, TRUCK, BUS, PEDESTRIAN = range(5)


class Material(IntEnum):
    """Materials: one function of ``materials`` each."""

    SLAB, FACADE, PAINT, GLASSHOUSE, COACH, PLAIN, WHEEL, SIGN, LEAF, ROUGH = range(1, 11)


BOX, ELLIPSOID, CYLINDER = 0, 1, 2
SKY_ID, GROUND_ID = -1, -2  # in place of the row of a primitive


@dataclass(frozen=True, kw_only=True)
class Street:
    """Layout of the road: plain numbers in the street frame, metres."""

    lanes: int  # lanes in each direction; traffic keeps to the right
    lane_width_m: float
    half_width_m: Range  # road edge to the right (y < 0) and to the left (y > 0), both positive
    parking: tuple[bool, bool]
    sidewalk_m: Range
    verge_m: Range  # width of the grass between kerb and paving; 0 without grass
    kerb_m: float
    crossing_x_m: float  # centre of the crossing street; infinite without one
    crossing_half_m: float
    zebra: bool
    solid_centre: bool
    yellow_centre: bool
    asphalt: float  # mean grey of the asphalt, 0 to 1
    wear: float  # strength of cracks, patches and stains, about 0.5 to 1.5


@dataclass(frozen=True, kw_only=True)
class Light:
    """Sun and sky: directions in the street frame, colours in display units, 0 to 1."""

    sun: Vector
    sun_strength: float
    zenith: Vector
    horizon: Vector
    clouds: float


@dataclass(frozen=True, kw_only=True, eq=False)
class Scene:
    """One street scene; P primitives and B labelled boxes in the street frame."""

    kind: IntArray  # (P,) BOX, ELLIPSOID or CYLINDER
    center: FloatArray  # (P, 3) metres
    rotation: FloatArray  # (P, 3, 3) local axes as columns
    half: FloatArray  # (P, 3) half extents along the local axes; a cylinder's axis is its local z
    planes: FloatArray  # (P, 6, 4) outward half-spaces n·p <= b of boxes: front, rear, left, right, top, bottom
    corners: FloatArray  # (P, 8, 3) a convex hull around each primitive
    material: IntArray  # (P,) ``Material``
    cls: IntArray  # (P,) ``SceneClass``
    instance: IntArray  # (P,) row of ``boxes``, or -1
    color: FloatArray  # (P, 3) display RGB, 0 to 1
    param: FloatArray  # (P, 4) numbers whose meaning is the material's
    boxes: FloatArray  # (B, 7) centre x y z, length, width, height, yaw (radians)
    box_classes: IntArray  # (B,) ``BoxClass``
    velocities: FloatArray  # (B, 2) of the boxes, m/s
    speed_mps: float  # of the vehicle, straight ahead
    ego2street: FloatArray  # (4, 4) pose of the vehicle, its road plane at z = 0
    street: Street
    light: Light
    salt: int  # seed of the textures

    def __post_init__(self) -> None:
        for value in vars(self).values():
            if isinstance(value, np.ndarray):
                value.setflags(write=False)  # drives share their streets

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
        """The scene at a later (or earlier) time: the vehicle and everything with a velocity moved straight on."""
        ego2street = self.ego2street.copy()
        ego2street[:3, 3] += self.speed_mps * seconds * ego2street[:3, 0]
        moves = np.zeros((len(self.boxes) + 1, 3))  # the last row serves primitives without a box
        moves[:-1, :2] = self.velocities * seconds
        move, planes, boxes = moves[self.instance], self.planes.copy(), self.boxes.copy()
        planes[..., 3] += (planes[..., :3] * move[:, None]).sum(-1)
        boxes[:, :3] += moves[:-1]
        center, corners = self.center + move, self.corners + move[:, None]
        return replace(self, center=center, planes=planes, corners=corners, boxes=boxes, ego2street=ego2street)


Label = tuple[BoxClass, Vector]  # of a 3D box: class and size
_ZEROS = (0.0, 0.0, 0.0, 0.0)
_NO_TURN = np.eye(3)
_SIGNS = np.array([[x, y, z] for x in (1, -1) for y in (1, -1) for z in (1, -1)], dtype=np.float64)


class SceneBuilder:
    """Collects primitives and boxes; parts are given relative to a placed object. All objects draw from ``rng``."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.primitives: list[dict[str, Any]] = []
        self.boxes: list[tuple[float, ...]] = []
        self.box_classes: list[int] = []

    def place(self, cls: SceneClass, origin: Vector = (0, 0, 0), yaw: float = 0, label: Label | None = None) -> Placed:
        """A frame to add parts in: origin on the surface below, x forward; class and size of its 3D box, if any."""
        if label is not None:
            x, y, z = map(float, origin)
            self.boxes.append((x, y, z + label[1][2] / 2, *label[1], yaw))
            self.box_classes.append(label[0])
        instance = -1 if label is None else len(self.boxes) - 1
        return Placed(self, np.array(origin, dtype=np.float64), yaw_matrix(yaw), cls, instance)

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """The collected rows in ``Scene``'s shapes."""
        arrays = {name: np.array([row[name] for row in self.primitives]) for name in self.primitives[0]}
        arrays = {name: a.astype(np.int64 if a.dtype.kind == "i" else np.float64) for name, a in arrays.items()}
        boxes, classes = np.array(self.boxes, np.float64).reshape(-1, 7), np.array(self.box_classes, np.int64)
        return {**arrays, "boxes": boxes, "box_classes": classes}


class Look(NamedTuple):
    """The looks of a part; the meaning of ``param`` is the material's."""

    material: Material
    color: Vector
    param: Param = _ZEROS


@dataclass
class Placed:
    """Adds parts of one object in the object's frame."""

    builder: SceneBuilder
    origin: FloatArray
    rotation: FloatArray
    cls: SceneClass
    instance: int

    def box(self, x: Range, y: Range, z: Range, look: Look, *, taper: Param = _ZEROS) -> None:
        """Add a box from bounds in any order; front, rear, left and right lean in by ``taper`` metres at the top."""
        lo, hi = np.sort([x, y, z]).T
        hx, hy, hz = half = (hi - lo) / 2
        front, rear, left, right = taper
        ends, sides = [[2 * hz, 0, front], [-2 * hz, 0, rear]], [[0, 2 * hz, left], [0, -2 * hz, right]]
        normals = np.array([*ends, *sides, [0, 0, 1], [0, 0, -1]])
        offsets = np.array([2 * hx - front, 2 * hx - rear, 2 * hy - left, 2 * hy - right, 1, 1]) * hz
        norm = np.linalg.norm(normals, axis=1)
        corners = _SIGNS * half
        top = corners[:, 2] > 0
        corners[:, 0] -= np.where(top, np.where(corners[:, 0] > 0, front, -rear), 0)
        corners[:, 1] -= np.where(top, np.where(corners[:, 1] > 0, left, -right), 0)
        planes = np.column_stack([normals, offsets]) / norm[:, None]
        self._add(BOX, (hi + lo) / 2, half, look, hull=(corners, planes))

    def ellipsoid(self, center: Vector, radii: Vector, look: Look) -> None:
        """Add an ellipsoid along the object's axes."""
        self._add(ELLIPSOID, center, radii, look)

    def cylinder(self, center: Vector, radii: Range, half_length: float, look: Look, *, lateral: bool = False) -> None:
        """Add a capped elliptic cylinder, upright or (wheels) with its axis along the object's y."""
        axes = np.array([[1.0, 0, 0], [0, 0, 1.0], [0, -1.0, 0]]) if lateral else _NO_TURN
        self._add(CYLINDER, center, (*radii, half_length), look, axes)

    def _add(self, kind: int, middle: Any, half: Any, look: Look, axes: Any = _NO_TURN, hull: Any = None) -> None:
        half = np.array(half)
        corners, planes = hull or (_SIGNS * half, np.zeros((6, 4)))
        rotation, center = self.rotation @ axes, self.origin + self.rotation @ middle
        normals = planes[:, :3] @ rotation.T
        row = {"kind": kind, "center": center, "rotation": rotation, "half": half, **look._asdict()}
        row["planes"] = np.column_stack([normals, planes[:, 3] + normals @ center])
        row["corners"] = center + corners @ rotation.T
        self.builder.primitives.append({**row, "cls": self.cls, "instance": self.instance})
