"""Another world than ``SyntheticDrive``'s, by the same primitives and rays: low houses, lots and cars of cuboids."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from arbiview_aug import Rig
from arbiview_aug.datasets.drive import checked_index
from arbiview_aug.datasets.synthetic import BoxClass, SceneClass, SyntheticDrive
from arbiview_aug.datasets.synthetic.scene import (
    Light,
    Look,
    Material,
    Placed,
    Range,
    SceneBuilder,
    Street,
    Vector,
    yaw_matrix,
)
from integrations.cross_rig.cuboid_colors import CuboidRenderer, CuboidScene, Wall

_END_M, _DEPTH_M = 150.0, 90.0
_TRAFFIC_M = 70.0
_PAINTS = (
    *((0.93, 0.93, 0.90), (0.05, 0.05, 0.06), (0.90, 0.72, 0.06), (0.78, 0.30, 0.08), (0.05, 0.42, 0.44)),
    *((0.42, 0.06, 0.12), (0.10, 0.16, 0.55), (0.60, 0.75, 0.80), (0.46, 0.50, 0.28), (0.50, 0.48, 0.46)),
)
_WALLS = ((0.60, 0.28, 0.20), (0.86, 0.78, 0.62), (0.50, 0.60, 0.66), (0.80, 0.58, 0.50), (0.56, 0.55, 0.52))
_ROOFS = ((0.52, 0.20, 0.13), (0.22, 0.23, 0.27), (0.38, 0.28, 0.22))
_YARDS = ((0.36, 0.40, 0.18), (0.52, 0.46, 0.36), (0.44, 0.34, 0.26))
_CLOTHES = ((0.75, 0.20, 0.15), (0.10, 0.12, 0.20), (0.82, 0.80, 0.70), (0.15, 0.40, 0.30))
_RUBBER = (0.06, 0.06, 0.06)


class _Kind(NamedTuple):
    """Ranges in metres; the waist as a share of the height, the cabin's ends of the length, from the middle."""

    share: float
    cls: BoxClass
    length: Range
    width: Range
    height: Range
    waist: float
    cabin: Range


_KINDS = (
    _Kind(0.26, BoxClass.CAR, (3.9, 5.1), (1.60, 2.00), (1.30, 1.55), 0.60, (-0.30, 0.18)),  # saloon
    _Kind(0.24, BoxClass.CAR, (3.2, 4.2), (1.50, 1.80), (1.45, 1.75), 0.55, (-0.49, 0.16)),  # hatchback
    _Kind(0.20, BoxClass.CAR, (4.3, 5.2), (1.75, 2.05), (1.65, 2.05), 0.58, (-0.49, 0.22)),  # off-roader
    _Kind(0.08, BoxClass.CAR, (4.9, 5.8), (1.80, 2.05), (1.65, 2.00), 0.55, (-0.06, 0.24)),  # pick-up
    _Kind(0.12, BoxClass.VAN, (4.4, 6.6), (1.80, 2.15), (1.90, 2.80), 0.45, (-0.50, 0.38)),
    _Kind(0.06, BoxClass.TRUCK, (6.0, 9.5), (2.20, 2.55), (2.70, 3.80), 0.36, (0.24, 0.50)),
    _Kind(0.04, BoxClass.BUS, (9.0, 12.0), (2.45, 2.55), (2.80, 3.50), 0.40, (-0.50, 0.50)),
)


class CuboidDrive(SyntheticDrive):
    """As ``SyntheticDrive``, of this world; without two-wheelers."""

    def __init__(self, rig: Rig, **options: Any) -> None:
        super().__init__(rig, **options)
        self._renderer = CuboidRenderer(supersampling=self._renderer.supersampling)

    def scene(self, index: int) -> CuboidScene:
        return make_scene(self.seed, checked_index(index, len(self)))


@lru_cache(maxsize=4)
def make_scene(seed: int, index: int) -> CuboidScene:
    """Build scene ``index`` of the world ``seed``."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, index, 9]))
    street, ego2street = _layout(rng)
    speed_mps = rng.uniform(4, 15)
    world = _World(rng, street, ego2street)
    world.add_land()
    for side in (-1, 1):
        world.add_row(side)
        world.add_kerbside(side)
    parked = len(world.builder.boxes)
    for side in (-1, 1):
        world.add_moving(side)
    world.add_people()
    velocities = np.zeros((len(world.builder.boxes), 2))
    for row, box in enumerate(world.builder.boxes[parked:], parked):
        walks = world.builder.box_classes[row] == BoxClass.PEDESTRIAN
        pace_mps = rng.uniform(0.8, 1.7) if walks else speed_mps * rng.uniform(0.85, 1.15)
        velocities[row] = pace_mps * math.cos(box[6]), pace_mps * math.sin(box[6])
    return CuboidScene(
        speed_mps=speed_mps,
        velocities=velocities,
        ego2street=ego2street,
        street=street,
        light=_light(rng),
        salt=int(rng.integers(1 << 20)),
        cobbled=rng.random() < 0.45,
        lined=rng.random() < 0.5,
        haze_m=rng.uniform(120, 500),
        **world.builder.arrays(),
    )


def _layout(rng: np.random.Generator) -> tuple[Street, np.ndarray]:
    lanes, width = int(rng.choice([1, 1, 1, 2])), rng.uniform(2.6, 3.3)
    room = [float(rng.choice([0.4, 2.4, 5.4])) for _ in range(2)]  # none, cars along the kerb, cars across it
    street = Street(
        lanes=lanes,
        lane_width_m=width,
        half_width_m=(lanes * width + room[0], lanes * width + room[1]),
        parking=(room[0] > 1, room[1] > 1),
        sidewalk_m=(rng.uniform(1.2, 3.5), rng.uniform(1.2, 3.5)),
        verge_m=(0.0, 0.0),
        kerb_m=rng.uniform(0.03, 0.12),
        crossing_x_m=math.inf,
        crossing_half_m=0.0,
        zebra=False,
        solid_centre=False,
        yellow_centre=True,
        asphalt=rng.uniform(0.34, 0.62),
        wear=1.0,
    )
    ego2street = np.eye(4)
    ego2street[1, 3] = -(rng.integers(lanes) + 0.5) * width + rng.normal(0, 0.2)
    ego2street[:3, :3] = yaw_matrix(math.radians(np.clip(rng.normal(0, 2.5), -6, 6)))
    return street, ego2street


def _light(rng: np.random.Generator) -> Light:
    """Low, warm suns in haze; a third of the days without one."""
    azimuth, elevation = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(18, 40))
    flat = math.cos(elevation)
    horizon, zenith = (np.array(c) + rng.normal(0, 0.03, 3) for c in ((0.88, 0.80, 0.70), (0.46, 0.56, 0.68)))
    return Light(
        sun=(math.cos(azimuth) * flat, math.sin(azimuth) * flat, math.sin(elevation)),
        sun_strength=float(rng.choice([0.0, rng.uniform(0.4, 0.7), rng.uniform(0.7, 1.0)])),
        zenith=tuple(map(float, zenith)),  # type: ignore[arg-type]
        horizon=tuple(map(float, horizon)),  # type: ignore[arg-type]
        clouds=rng.uniform(0.1, 0.8),
    )


class _World:
    """A scene under construction."""

    def __init__(self, rng: np.random.Generator, street: Street, ego2street: np.ndarray) -> None:
        self.rng, self.street, self.builder = rng, street, SceneBuilder(rng)
        ego = np.stack([np.linspace(-1.5, 5, 5), np.zeros(5), np.zeros(5), np.ones(5)])
        self.taken = np.column_stack([(ego2street @ ego)[:2].T, np.full(5, 1.9)])  # discs: x, y, radius

    def claim(self, x: float, y: float, length: float, width: float, yaw: float) -> bool:
        """Whether the footprint is free; then it is taken."""
        along = np.linspace(-0.5, 0.5, 6) * max(0.0, length - width)
        discs = np.stack([x + math.cos(yaw) * along, y + math.sin(yaw) * along, np.full(6, width / 2)], 1)
        apart = np.linalg.norm(discs[:, None, :2] - self.taken[None, :, :2], axis=-1)
        free = bool((apart > discs[:, None, 2] + self.taken[None, :, 2] + 0.15).all())
        if free:
            self.taken = np.concatenate([self.taken, discs])
        return free

    def color(self, colors: tuple[Vector, ...], spread: float = 0.06) -> Vector:
        """One of the colours, a little off, in brightness more than in hue."""
        off = self.rng.normal(0, spread) + self.rng.normal(0, spread / 3, 3)
        picked = np.array(colors[self.rng.integers(len(colors))]) + off
        return tuple(map(float, picked.clip(0.03, 0.95)))  # type: ignore[return-value]

    def block(
        self, x: Range, y: Range, z: Range, cls: SceneClass, look: Look, taper: tuple[float, ...] = (0,) * 4
    ) -> None:
        """A cuboid along the street."""
        place = self.builder.place(cls)
        place.box(x, (min(y), max(y)), z, look, taper=taper)  # type: ignore[arg-type]

    def add_land(self) -> None:
        """Sidewalks, yards behind them, and what closes both ends."""
        street, ends = self.street, (-_END_M, _END_M)
        for side in (-1, 1):
            near, walk = side * street.half_width_m[side > 0], side * street.sidewalk_m[side > 0]
            tiles = Look(Material.SLAB, self.color(((0.55, 0.40, 0.34), (0.62, 0.60, 0.56))))
            self.block(ends, (near, near + walk), (-0.5, street.kerb_m), SceneClass.SIDEWALK, tiles)
            yard = Look(Material.ROUGH, self.color(_YARDS), (0.5, 0.2, 0, 0))
            far = near + walk, side * _DEPTH_M
            self.block(ends, far, (-0.5, street.kerb_m - 0.01), SceneClass.SIDEWALK, yard)
            x = side * self.rng.uniform(100, 140)
            self.add_house((x, x + 9) if side > 0 else (x - 9, x), (-40, 40))

    def add_house(self, x: Range, y: Range) -> None:
        """A low cuboid with a hipped roof, or a higher one without; walls of one of four kinds."""
        rng, tall = self.rng, self.rng.random() < 0.2
        height = rng.uniform(9, 18) if tall else rng.uniform(2.8, 7)
        param = (float(rng.integers(len(Wall))), rng.uniform(1.6, 3.4), rng.uniform(2.6, 3.1), rng.uniform(0.25, 0.7))
        self.block(x, y, (-0.1, height), SceneClass.BUILDING, Look(Material.FACADE, self.color(_WALLS), param))
        eaves = 0.0 if tall else rng.uniform(0.1, 0.5)
        rise = 0.3 if tall else rng.uniform(1.0, 3.0)
        lean = 0.0 if tall else min(x[1] - x[0], abs(y[1] - y[0])) * 0.45
        wide = (x[0] - eaves, x[1] + eaves), (min(y) - eaves, max(y) + eaves)
        roof = Look(Material.ROUGH, self.color(_ROOFS), (0.35, 0.1, 0, 0))
        self.block(*wide, (height, height + rise), SceneClass.BUILDING, roof, (lean,) * 4)

    def add_row(self, side: int) -> None:
        """Houses, lots and gardens along one side; another row of houses far behind."""
        rng, x = self.rng, -110.0
        edge = self.street.half_width_m[side > 0] + self.street.sidewalk_m[side > 0]
        while x < 110:
            width, back = rng.uniform(5, 15), edge + rng.uniform(0.5, 8)
            kind = rng.choice(["house", "lot", "garden"], p=[0.6, 0.2, 0.2])
            if kind == "house":
                self.add_house((x, x + width), (side * back, side * (back + rng.uniform(6, 12))))
            elif kind == "lot":
                for y in edge + 3.5 + 6.5 * np.arange(2):
                    for k in np.arange(x + 1.4, x + width - 1, 2.8):
                        if rng.random() < 0.6:
                            yaw = math.pi / 2 * float(rng.choice([-1, 1]))
                            self.add_vehicle(float(k), side * float(y), yaw, 0.1, self.street.kerb_m - 0.01)
            else:
                for _ in range(int(rng.integers(1, 5))):
                    self.add_tree(x + rng.uniform(0.5, width), side * (edge + rng.uniform(1, 14)))
            if rng.random() < 0.35 and kind != "lot":
                wall = Look(Material.ROUGH, self.color(_WALLS), (0.6, 0.08, 0, 0))
                fence = (side * (edge + 0.1), side * (edge + 0.3))
                self.block((x, x + width), fence, (-0.1, rng.uniform(0.6, 1.8)), SceneClass.BUILDING, wall)
            far = edge + rng.uniform(30, 45)
            self.add_house((x, x + width), (side * far, side * (far + 10)))
            x += width + rng.uniform(0.5, 5)

    def add_kerbside(self, side: int) -> None:
        """Parked cars, along or across the kerb; posts and trees behind it."""
        rng, half = self.rng, self.street.half_width_m[side > 0]
        room, density = half - self.street.lanes * self.street.lane_width_m, rng.uniform(0.2, 0.8)
        across = room > 4
        for x in np.arange(-60, 60, 2.9 if across else 6.0) if self.street.parking[side > 0] else ():
            if rng.random() < density:
                yaw = math.pi / 2 * float(rng.choice([-1, 1])) if across else math.pi * (side > 0)
                self.add_vehicle(float(x), side * (half - room / 2), yaw, 0.2 if across else 0.0)
        pitch = rng.uniform(9, 25)
        for x in np.arange(-60, 60, pitch) + rng.uniform(0, pitch):
            if rng.random() < 0.5:
                self.add_post(float(x), side * (half + 0.4))
            elif abs(x) > 6:
                self.add_tree(float(x), side * (half + 0.8))

    def add_moving(self, side: int) -> None:
        rng, street, gap = self.rng, self.street, self.rng.uniform(6, 45)
        for lane in range(street.lanes):
            x = -_TRAFFIC_M + rng.uniform(0, gap)
            while x < _TRAFFIC_M:
                y = side * (lane + 0.5) * street.lane_width_m + rng.normal(0, 0.15)
                self.add_vehicle(x, y, math.pi * (side > 0) + rng.normal(0, 0.03))  # it drives on the right
                x += 6 + gap * rng.uniform(0.4, 1.6)

    def add_vehicle(self, x: float, y: float, yaw: float, short: float = 0.0, z: float = 0.0) -> None:
        """Add a vehicle if there is room; in bays across the kerb (``short`` above 0) cars alone, turned a little."""
        rng = self.rng
        kinds = _KINDS[:4] if short else _KINDS
        shares = np.array([kind.share for kind in kinds])
        kind = kinds[int(rng.choice(len(kinds), p=shares / shares.sum()))]
        size = length, width, _ = rng.uniform(*kind.length), rng.uniform(*kind.width), rng.uniform(*kind.height)
        yaw += rng.normal(0, short / 2)
        if not self.claim(x, y, length, width, yaw):
            return
        place = self.builder.place(SceneClass.VEHICLE, (x, y, z), yaw, (kind.cls, size))
        _add_body(place, kind, size, self.color, rng)

    def add_people(self) -> None:
        rng = self.rng
        for _ in range(int(rng.integers(0, 9))):
            side, height, width = int(rng.choice([-1, 1])), rng.uniform(1.5, 1.95), rng.uniform(0.45, 0.6)
            x, y = rng.uniform(-30, 40), side * (self.street.half_width_m[side > 0] + rng.uniform(0.5, 1.1))
            if not self.claim(x, y, width, width, 0.0):
                continue
            base, yaw = self.street.kerb_m, float(rng.choice([0, math.pi]))
            label = BoxClass.PEDESTRIAN, (0.3, width, height)
            place = self.builder.place(SceneClass.PEDESTRIAN, (x, y, base), yaw, label)
            hip, neck, half = 0.48 * height, height - 0.27, width / 2
            place.box((-0.15, 0.15), (-half * 0.8, half * 0.8), (0, hip), _plain(self.color(_CLOTHES)))
            place.box((-0.13, 0.13), (-half, half), (hip, neck), _plain(self.color(_CLOTHES)))
            place.box((-0.1, 0.1), (-0.09, 0.09), (neck, height), _plain((0.70, 0.52, 0.42)))

    def add_post(self, x: float, y: float) -> None:
        height, grey = self.rng.uniform(2.5, 6), self.rng.uniform(0.1, 0.5)
        place = self.builder.place(SceneClass.POLE, (x, y, 0.0))
        place.box((-0.07, 0.07), (-0.07, 0.07), (0, height), _plain((grey, grey, grey * 0.9)))
        place.box((-0.25, 0.25), (-0.25, 0.25), (height, height + 0.35), _plain((0.85, 0.80, 0.62)))

    def add_tree(self, x: float, y: float) -> None:
        """A trunk and one crown, pointed or round, off the vehicle's own place."""
        rng = self.rng
        height, spread = rng.uniform(3, 8), rng.uniform(0.5, 1.6)
        if not self.claim(x, y, 2 * spread, 2 * spread, 0.0):
            return
        place = self.builder.place(SceneClass.VEGETATION, (x, y, 0.0))
        fork = height * rng.uniform(0.2, 0.4)
        place.box((-0.12, 0.12), (-0.12, 0.12), (0, fork * 1.3), _plain((0.24, 0.18, 0.13)))
        crown = self.color(((0.16, 0.26, 0.16), (0.42, 0.34, 0.12), (0.24, 0.34, 0.14)), 0.03)
        middle = (fork + height) / 2
        place.ellipsoid((0, 0, middle), (spread, spread, height - middle), Look(Material.LEAF, crown))


def _add_body(place: Placed, kind: _Kind, size: Vector, color: Callable[..., Vector], rng: np.random.Generator) -> None:
    """A cuboid body with a cuboid cabin on it, a load behind the cab of a lorry, and wheels, which give the width."""
    length, width, height = size
    x, y = length / 2, width / 2 - 0.02
    waist, radius = kind.waist * height, rng.uniform(0.28, 0.36) + 0.12 * (kind.cls in (BoxClass.TRUCK, BoxClass.BUS))
    paint = color(_PAINTS)
    lower, roof = (color(_PAINTS) if rng.random() < share else paint for share in (0.35, 0.35))
    body = Look(Material.PAINT, paint, (*lower, rng.uniform(0.02, 0.15)))
    place.box((-x, x), (-y, y), (0.6 * radius, waist), body)
    cabin = kind.cabin[0] * length, kind.cabin[1] * length
    inset = rng.uniform(0.0, 0.12) if kind.cls is BoxClass.CAR else 0.0
    glass = Look(Material.GLASSHOUSE, roof, (float(rng.integers(2, 4)), rng.uniform(0.06, 0.2), 0, 0))
    place.box(cabin, (-y + inset, y - inset), (waist, height), glass)
    if kind.cls is BoxClass.TRUCK:
        load = Look(Material.ROUGH, color(_PAINTS), (rng.uniform(0.3, 1.2), 0.08, 0, 0))
        place.box((-x, cabin[0] - 0.2), (-y, y), (waist, height * rng.uniform(0.75, 1.0)), load)
    for end in (-0.3, 0.3):
        for side in (-1, 1):
            center = (end * length, side * (width / 2 - 0.1), radius)
            place.cylinder(center, (radius, radius), 0.1, _plain(_RUBBER), lateral=True)


def _plain(color: Vector) -> Look:
    return Look(Material.PLAIN, color)
