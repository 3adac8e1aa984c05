"""The procedural street: a scene from (seed, index), independent of any rig."""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from arbiview_aug.cameras.rotations import yaw_matrix
from arbiview_aug.datasets.synthetic import objects
from arbiview_aug.datasets.synthetic.scene import Light, Look, Material, Range, Scene, SceneBuilder, SceneClass, Street

CLEAR_X_M, CLEAR_Y_M = (-3.0, 6.5), 2.2  # of the ego frame without objects: no camera of a sensible rig is inside one
END_M = 260.0
_PARKED_REACH_M = 75.0
_MOVING_REACH_M = 95.0
_MOVING_SHARES = (0.62, 0.18, 0.14, 0.06)  # of the kinds of ``objects.VEHICLE_SIZES``
_PARKED_SHARES = (0.76, 0.19, 0.05, 0.0)
_SIGNS = ((0.78, 0.12, 0.12), (0.10, 0.25, 0.62), (0.85, 0.72, 0.10), (0.90, 0.90, 0.90))


def make_scene(seed: int, index: int) -> Scene:
    """Build scene ``index`` of the world ``seed``; the same arguments give the same scene on any machine."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, index]))
    street, ego2street = _layout(rng)
    world = _World(rng, street, ego2street)
    world.add_buildings()
    world.add_background()
    world.add_parked()
    parked = len(world.boxes)
    world.add_moving()
    world.add_furniture()
    world.add_pedestrians()
    # Traffic in the vehicle's direction keeps about its speed, so that it stays off the place before and behind it.
    motion = np.random.default_rng(np.random.SeedSequence([seed, index, 2]))
    speed_mps = motion.uniform(6.0, 14.0)
    velocities = np.zeros((len(world.boxes), 2))
    for row, (box, cls) in enumerate(zip(world.boxes, world.box_classes, strict=True)):
        walks = cls not in objects.VEHICLE_SIZES
        own_mps = motion.uniform(0.8, 1.7) if walks else speed_mps * motion.uniform(0.9, 1.1)
        waits = motion.random() < 0.2 and math.cos(box[6]) < 0.5  # some people, some traffic in other directions
        if row >= parked and not waits:
            velocities[row] = own_mps * math.cos(box[6]), own_mps * math.sin(box[6])
    return Scene(
        speed_mps=speed_mps,
        velocities=velocities,
        ego2street=ego2street,
        street=street,
        light=_light(rng),
        salt=int(rng.integers(1 << 20)),
        **world.arrays(),
    )


def _layout(rng: np.random.Generator) -> tuple[Street, np.ndarray]:
    lanes = int(rng.choice([1, 1, 2]))
    lane_width = rng.uniform(3.0, 3.6)
    parking = (rng.random() < 0.65, rng.random() < 0.65)
    right, left = (lanes * lane_width + (2.3 if parks else rng.uniform(0.3, 0.8)) for parks in parking)
    crossing = float(rng.uniform(17, 50) * rng.choice([1, 1, -1])) if rng.random() < 0.55 else math.inf
    street = Street(
        lanes=lanes,
        lane_width_m=lane_width,
        half_width_m=(right, left),
        parking=parking,
        sidewalk_m=(rng.uniform(2.6, 5.5), rng.uniform(2.6, 5.5)),
        verge_m=tuple(rng.uniform(0.9, 1.5) if rng.random() < 0.4 else 0.0 for _ in range(2)),  # type: ignore[arg-type]
        kerb_m=rng.uniform(0.10, 0.14),
        crossing_x_m=crossing,
        crossing_half_m=rng.uniform(4, 7.5),
        zebra=rng.random() < 0.7,
        solid_centre=rng.random() < 0.5,
        yellow_centre=rng.random() < 0.25,
        asphalt=rng.uniform(0.30, 0.46),
        wear=rng.uniform(0.6, 1.4),
    )
    lane = int(rng.integers(lanes))
    ego2street = np.eye(4)
    ego2street[1, 3] = -(lane + 0.5) * lane_width + rng.uniform(-0.25, 0.25)
    ego2street[:3, :3] = yaw_matrix(math.radians(np.clip(rng.normal(0, 2), -5, 5)))
    return street, ego2street


def _light(rng: np.random.Generator) -> Light:
    azimuth, elevation = rng.uniform(0, 2 * math.pi), math.radians(rng.uniform(32, 65))
    flat = math.cos(elevation)
    strength = float(rng.choice([0.0, rng.uniform(0.2, 0.5), rng.uniform(0.5, 0.9)]))
    grey = np.array([0.74, 0.77, 0.80]) + rng.normal(0, 0.02, 3)
    blue = np.array([0.30, 0.48, 0.78]) + rng.normal(0, 0.03, 3)
    clear = min(1.0, 0.15 + strength)
    zenith = (grey * (1 - clear) + blue * clear).clip(0, 1)
    horizon = (grey * 0.35 + np.array([0.80, 0.85, 0.90]) * 0.65).clip(0, 1)
    return Light(
        sun=(math.cos(azimuth) * flat, math.sin(azimuth) * flat, math.sin(elevation)),
        sun_strength=strength,
        zenith=tuple(map(float, zenith)),  # type: ignore[arg-type]
        horizon=tuple(map(float, horizon)),  # type: ignore[arg-type]
        clouds=rng.uniform(0.3, 1.0),
    )


class _World(SceneBuilder):
    """A scene under construction; all methods draw from one generator, in a fixed order.

    A side is -1, right of the road, where traffic heads along x, or 1, left, where it heads against x.
    """

    def __init__(self, rng: np.random.Generator, street: Street, ego2street: np.ndarray) -> None:
        super().__init__(rng)
        self.street, self.ego2street = street, ego2street
        self.taken: list[tuple[float, float, float]] = []  # x, y, radius of vehicles
        x, half = street.crossing_x_m, street.crossing_half_m
        self.blocks = [(-END_M, END_M)] if math.isinf(x) else [(-END_M, x - half), (x + half, END_M)]
        land = self.place(SceneClass.SIDEWALK)  # kerb, verge, paving, yards
        for side, block in product((-1, 1), self.blocks):
            y = self.side_y(side, 0), side * 140.0
            land.box(block, y, (-0.5, street.kerb_m), Look(Material.SLAB, (0.52, 0.51, 0.49)))

    def is_clear(self, x: float, y: float, length: float, width: float, yaw: float) -> bool:
        """True if a footprint overlaps neither the ego vehicle nor another one."""
        c, s = math.cos(yaw), math.sin(yaw)
        offsets = [(a, b) for a in (-length / 2, 0, length / 2) for b in (-width / 2, width / 2)]
        ends = [(x + c * a - s * b, y + s * a + c * b) for a, b in offsets]
        ego = (np.array(ends) - self.ego2street[:2, 3]) @ self.ego2street[:2, :2]
        lo, hi = ego.min(0), ego.max(0)
        if hi[0] > CLEAR_X_M[0] and lo[0] < CLEAR_X_M[1] and hi[1] > -CLEAR_Y_M and lo[1] < CLEAR_Y_M:
            return False
        discs = _discs(x, y, length, width, yaw)
        return all(math.hypot(x - u, y - v) > r + q + 0.12 for x, y, r in discs for u, v, q in self.taken)

    def add_vehicle(self, shares: tuple[float, ...], x: float, y: float, yaw: float) -> float:
        """Add a vehicle if there is room; returns its length either way."""
        cls, sizes = list(objects.VEHICLE_SIZES.items())[self.rng.choice(len(shares), p=shares)]
        # The height is independent, so that a detector cannot infer it from the footprint.
        length, width, height = (self.rng.uniform(*bounds) for bounds in sizes)
        if self.is_clear(x, y, length, width, yaw):
            objects.add_vehicle(self, cls, (length, width, height), (x, y), yaw)
            self.taken += _discs(x, y, length, width, yaw)
        return length

    def at_crossing(self, x: float, margin: float) -> bool:
        """True if x lies on the crossing street or within ``margin`` of it."""
        return abs(x - self.street.crossing_x_m) < self.street.crossing_half_m + margin

    def side_y(self, side: int, from_kerb: float) -> float:
        """y at a distance behind the kerb of the right (-1) or left (1) side."""
        return side * (self.street.half_width_m[side > 0] + from_kerb)

    def band_y(self, side: int, start: float, end: float) -> Range:
        """y range between two distances behind the kerb."""
        y = self.side_y(side, start), self.side_y(side, end)
        return min(y), max(y)

    def add_buildings(self) -> None:
        rng, base = self.rng, self.street.kerb_m
        for side, (start, end) in product((-1, 1), self.blocks):
            walk = self.street.sidewalk_m[side > 0]
            x = max(start + walk, -170.0)
            while x < min(end - walk - 7, 170.0):
                width = min(rng.uniform(8, 26), end - walk - x)
                setback = walk + float(rng.choice([rng.uniform(0, 0.8), rng.uniform(1.5, 7)]))
                height = float(rng.choice([rng.uniform(5, 10), rng.uniform(10, 18), rng.uniform(18, 38)]))
                depth = rng.uniform(9, 16)
                built, xs = rng.random() < 0.88, (x, x + width)
                if built:
                    objects.add_building(self, xs, self.band_y(side, setback, setback + depth), (base, height))
                if rng.random() < 0.35:
                    y, z = self.band_y(side, setback + 22, setback + 40), (base, rng.uniform(25, 60))
                    objects.add_building(self, xs, y, z)
                gap = float(rng.choice([0.05, 0.05, rng.uniform(2, 9)]))
                if not built or (gap > 1 and rng.random() < 0.7):
                    y = self.band_y(side, walk + 0.3, walk + 0.8)
                    span = (x + width if built else x, min(x + width + gap, end - walk))
                    hedge = rng.random() < 0.5
                    if span[1] > span[0] + 0.3:
                        top = base + rng.uniform(0.9, 1.4 if hedge else 2.0)
                        cls = SceneClass.VEGETATION if hedge else SceneClass.BUILDING
                        leaves = Look(Material.LEAF, objects.pick(rng, ((0.19, 0.27, 0.12),), 0.02)) if hedge else None
                        look = leaves or Look(Material.ROUGH, objects.pick(rng, objects.WALLS), (1.2, 0.08, 0, 0))
                        self.place(cls).box(span, y, (base - 0.05, top), look)
                x += width + gap

    def add_background(self) -> None:
        """A closed row of houses or trees far behind, and tall buildings where the street ends."""
        rng, base = self.rng, self.street.kerb_m
        for side, (start, end) in product((-1, 1), self.blocks):
            x = max(start + 3, -200.0)
            while x < min(end - 10, 200.0):
                width = min(rng.uniform(14, 34), end - 3 - x)
                distance = rng.uniform(44, 62)
                if rng.random() < 0.7:
                    y, z = self.band_y(side, distance, distance + 14), (base, rng.uniform(7, 24))
                    objects.add_building(self, (x, x + width), y, z, detailed=False)
                else:
                    for k in range(int(width / 6)):
                        xyz = (x + 6 * k, self.side_y(side, distance - rng.uniform(0, 6)), base)
                        objects.add_bush(self, xyz, scale=rng.uniform(4, 8))
                x += width + 0.1
        for direction in (-1, 1):
            if rng.random() < 0.7:
                near = rng.uniform(185, 240)
                xs = (near, 258.0) if direction > 0 else (-258.0, -near)
                objects.add_building(self, xs, (-60, 60), (0.0, rng.uniform(14, 45)))

    def add_parked(self) -> None:
        for side in (-1, 1):
            if not self.street.parking[side > 0]:
                continue
            density, x = self.rng.uniform(0.35, 0.9), -_PARKED_REACH_M
            while x < _PARKED_REACH_M:
                step, length = self.rng.uniform(0.7, 1.6), 5.0
                if self.rng.random() < density and not self.at_crossing(x, 9):
                    yaw = math.pi * (side > 0) + math.radians(self.rng.normal(0, 1))
                    y = self.side_y(side, -1.15 + self.rng.normal(0, 0.06))
                    length = self.add_vehicle(_PARKED_SHARES, x + 2.5, y, yaw)
                x += (length + 5.0) / 2 + step

    def add_moving(self) -> None:
        street = self.street
        for side, lane in product((-1, 1), range(street.lanes)):
            gap = self.rng.uniform(8, 30)
            x = -_MOVING_REACH_M + self.rng.uniform(0, 20)
            while x < _MOVING_REACH_M:
                y = side * (lane + 0.5) * street.lane_width_m + self.rng.normal(0, 0.15)
                yaw = math.pi * (side > 0) + math.radians(self.rng.normal(0, 1.2))
                length = 0.0 if self.at_crossing(x, 3) else self.add_vehicle(_MOVING_SHARES, x, y, yaw)
                x += length + gap * self.rng.uniform(0.6, 1.8) + 3

        if math.isinf(street.crossing_x_m):
            return
        for direction in (-1, 1):  # on the crossing street, and sometimes in the junction
            x = street.crossing_x_m + direction * street.crossing_half_m / 2
            y = -45.0 + self.rng.uniform(0, 20)
            while y < 45:
                inside = -street.half_width_m[0] - 3 < y < street.half_width_m[1] + 3
                if not inside or self.rng.random() < 0.3:
                    yaw = direction * math.pi / 2 + math.radians(self.rng.normal(0, 2))
                    self.add_vehicle(_MOVING_SHARES, x, y, yaw)
                y += self.rng.uniform(8, 25)

    def add_furniture(self) -> None:
        rng, base = self.rng, self.street.kerb_m
        for side in (-1, 1):
            lamps, trees = rng.uniform(18, 32), rng.uniform(7, 15)
            planted = rng.random() < 0.65
            offset = rng.uniform(0, lamps)
            for k in range(-5, 6):
                x = offset + k * lamps
                if abs(x) < 90 and not self.at_crossing(x, 1):
                    post = self.place(SceneClass.POLE, (x, self.side_y(side, 0.45), base), -side * math.pi / 2)
                    height, grey = rng.uniform(5.5, 8.5), rng.uniform(0.25, 0.55)
                    metal = objects.plain((grey, grey, grey * 1.03))
                    post.cylinder((0, 0, height / 2), (0.075, 0.075), height / 2, metal)
                    post.cylinder((0, 0, 0.5), (0.12, 0.12), 0.5, metal)
                    post.box((0, 1.7), (-0.04, 0.04), (height - 0.1, height), metal)  # an arm over the road
                    lamp = objects.plain((0.75, 0.74, 0.68))
                    post.box((1.2, 1.9), (-0.12, 0.12), (height - 0.16, height - 0.02), lamp)
            for k in range(-8, 9):
                x = k * trees + rng.normal(0, 0.5)
                on_lamp = abs((x - offset + lamps / 2) % lamps - lamps / 2) < 1.5
                if planted and rng.random() < 0.8 and abs(x) < 85 and not (self.at_crossing(x, 4) or on_lamp):
                    # Crowns stay off the vehicle's own place: its cameras would be inside the leaves.
                    y = self.side_y(side, 1.0)
                    reach = abs(y - float(self.ego2street[1, 3])) - 2.0 if abs(x) < 10 else math.inf
                    objects.add_tree(self, (x, y, base), reach_m=max(reach, 0.5))
            for _ in range(int(rng.integers(2, 6))):
                x = rng.uniform(-45, 60)
                if not self.at_crossing(x, 1):
                    yaw = math.pi * (side > 0) + rng.normal(0, 0.1)
                    post = self.place(SceneClass.POLE, (x, self.side_y(side, 0.3), base), yaw)
                    height = rng.uniform(2.3, 3.0)
                    post.cylinder((0, 0, height / 2), (0.035, 0.035), height / 2, objects.plain((0.52, 0.53, 0.54)))
                    for k in range(int(rng.integers(1, 3))):  # plates that face the traffic
                        w, z = rng.uniform(0.25, 0.36), height - 0.35 - 0.7 * k
                        plate = Look(Material.SIGN, objects.pick(rng, _SIGNS, 0.02))
                        post.box((-0.06, -0.04), (-w, w), (z - 0.3, z + 0.3), plate)
            for _ in range(int(rng.integers(0, 6))):
                x = rng.uniform(-60, 70)
                if not self.at_crossing(x, 3):
                    behind = self.street.sidewalk_m[side > 0] - 0.6
                    objects.add_bush(self, (x, self.side_y(side, behind), base))
            if not math.isinf(self.street.crossing_x_m):
                x = self.street.crossing_x_m + side * (self.street.crossing_half_m + 0.5)
                post = self.place(SceneClass.POLE, (x, self.side_y(side, 0.5), base), math.pi * (side > 0))
                post.cylinder((0, 0, 1.7), (0.06, 0.06), 1.7, objects.plain((0.25, 0.26, 0.26)))
                post.box((-0.28, -0.07), (-0.16, 0.16), (2.5, 3.4), Look(Material.SIGN, objects.DARK, (1.0, 0, 0, 0)))

    def add_pedestrians(self) -> None:
        """People on the sidewalks, at the zebra crossing and now and then between the lanes."""
        rng, street = self.rng, self.street
        for _ in range(int(rng.integers(6, 18))):
            side = int(rng.choice([-1, 1]))
            x = rng.uniform(-35, 55)
            y = self.side_y(side, rng.uniform(1.4, street.sidewalk_m[side > 0] - 0.4))
            if not self.at_crossing(x, 0.5):
                yaw = float(rng.choice([0, math.pi])) + rng.normal(0, 0.2)
                objects.add_pedestrian(self, (x, y, street.kerb_m), yaw)
        if not math.isinf(street.crossing_x_m):
            for _ in range(int(rng.integers(0, 5))):
                side = int(rng.choice([-1, 1]))
                x = street.crossing_x_m + side * (street.crossing_half_m - 1.5) + rng.normal(0, 0.5)
                y = rng.uniform(-street.half_width_m[0], street.half_width_m[1])
                if self.is_clear(x, y, 0.6, 0.6, 0.0):
                    objects.add_pedestrian(self, (x, y, 0.0), math.pi / 2 * float(rng.choice([-1, 1])))
                    self.taken.append((x, y, 0.35))


def _discs(x: float, y: float, length: float, width: float, yaw: float) -> list[tuple[float, float, float]]:
    """x, y and radius of discs along a footprint, close enough for lanes side by side."""
    c, s = math.cos(yaw), math.sin(yaw)
    return [(x + c * a, y + s * a, width / 2) for a in np.linspace(-0.5, 0.5, 5) * max(0.0, length - width)]
