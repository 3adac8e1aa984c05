"""Objects built from primitives: vehicles, people, trees, lamp posts, signs, buildings.

Every labelled object touches all six sides of its 3D box.
"""

from __future__ import annotations

import math
from itertools import product

import numpy as np

from arbiview_aug.datasets.synthetic.scene import BoxClass, Look, Material, Range, SceneBuilder, SceneClass, Vector

# Length, width and height in metres: published sizes of production vehicles, from small cars to city buses.
VEHICLE_SIZES: dict[BoxClass, tuple[Range, Range, Range]] = {
    BoxClass.CAR: ((3.6, 4.95), (1.66, 1.95), (1.40, 1.80)),
    BoxClass.VAN: ((4.8, 6.4), (1.90, 2.10), (1.95, 2.75)),
    BoxClass.TRUCK: ((6.2, 9.0), (2.20, 2.50), (2.80, 3.60)),
    BoxClass.BUS: ((9.0, 12.0), (2.50, 2.55), (2.95, 3.40)),
}
PAINTS: tuple[Vector, ...] = (
    (0.85, 0.85, 0.86), (0.80, 0.81, 0.83), (0.62, 0.64, 0.66), (0.40, 0.42, 0.44), (0.16, 0.17, 0.19),
    (0.10, 0.10, 0.12), (0.55, 0.10, 0.10), (0.12, 0.20, 0.42), (0.18, 0.32, 0.24), (0.72, 0.58, 0.22),
    (0.45, 0.36, 0.28), (0.30, 0.44, 0.58),
)  # fmt: skip
_CLOTHES: tuple[Vector, ...] = (
    (0.15, 0.17, 0.25), (0.55, 0.14, 0.16), (0.78, 0.77, 0.72), (0.20, 0.35, 0.50), (0.70, 0.55, 0.15),
    (0.12, 0.12, 0.13), (0.35, 0.45, 0.30), (0.60, 0.40, 0.50),
)  # fmt: skip
_TROUSERS: tuple[Vector, ...] = (
    (0.13, 0.17, 0.28), (0.10, 0.10, 0.11), (0.38, 0.33, 0.26), (0.28, 0.29, 0.31), (0.20, 0.16, 0.14)
)  # fmt: skip
WALLS: tuple[Vector, ...] = (
    (0.62, 0.55, 0.46), (0.55, 0.33, 0.26), (0.70, 0.68, 0.63), (0.48, 0.47, 0.46), (0.66, 0.60, 0.42),
    (0.40, 0.30, 0.26), (0.58, 0.62, 0.64), (0.74, 0.66, 0.58), (0.36, 0.38, 0.42),
)  # fmt: skip
TIRE: Vector = (0.09, 0.09, 0.095)
DARK: Vector = (0.11, 0.11, 0.12)


def pick(rng: np.random.Generator, colors: tuple[Vector, ...], spread: float = 0.05) -> Vector:
    """One of the colours, a little off: brightness varies more than hue."""
    base = np.array(colors[int(rng.integers(len(colors)))]) + rng.normal(0, spread) + rng.normal(0, spread / 4, 3)
    return tuple(float(c) for c in base.clip(0.05, 0.92))  # type: ignore[return-value]


def plain(color: Vector) -> Look:
    """One colour without a pattern."""
    return Look(Material.PLAIN, color)


def add_vehicle(builder: SceneBuilder, cls: BoxClass, size: Vector, xy: Range, yaw: float) -> None:
    """Add a vehicle on the road plane and its box."""
    rng, (length, width, height) = builder.rng, size
    place = builder.place(SceneClass.VEHICLE, (*xy, 0.0), yaw, (cls, size))
    paint = pick(rng, PAINTS)
    x, y = length / 2, width / 2 - 0.02  # wheels stand out by 2 cm and give the width
    radius = min(0.25 + 0.05 * height, 0.48)
    reach = (0.68 if cls is BoxClass.TRUCK else 0.62) * x
    arch = (reach, radius, 0.0, 0.0)
    if cls is BoxClass.CAR:
        waist = rng.uniform(0.52, 0.60) * height
        place.box((-x, x), (-y, y), (0.20, waist), Look(Material.PAINT, paint, arch), taper=(0.10, 0.06, 0.03, 0.03))
        rear = float(rng.choice([0.06, 0.3, 0.55])) * length / 2  # estate, hatchback, saloon
        cabin = (-x + 0.08 + rear * 0.55, 0.22 * length), (-y + 0.03, y - 0.03), (waist, height)
        taper = (0.16 * length, 0.08 + rear * 0.45, 0.16, 0.16)
        place.box(*cabin, Look(Material.GLASSHOUSE, paint, (1.0, 0, 0, 0)), taper=taper)
    elif cls is BoxClass.VAN:
        waist = 0.48 * height
        place.box((-x, x), (-y, y), (0.24, waist), Look(Material.PAINT, paint, arch), taper=(0.08, 0, 0, 0))
        cabin, glazed = ((-x, x - 0.75), (-y, y), (waist, height)), 0.35 if rng.random() < 0.5 else 1.0
        place.box(*cabin, Look(Material.GLASSHOUSE, paint, (glazed, 0, 0, 0)), taper=(0.40, 0.03, 0.10, 0.10))
    elif cls is BoxClass.TRUCK:
        cab, top, cab_color = rng.uniform(1.7, 2.2), height * rng.uniform(0.72, 0.9), pick(rng, PAINTS)
        place.box((x - cab, x), (-y + 0.05, y - 0.05), (0.45, 1.35), Look(Material.PAINT, cab_color))
        cabin = (x - cab, x), (-y + 0.05, y - 0.05), (1.35, top)
        place.box(*cabin, Look(Material.GLASSHOUSE, cab_color, (1.0, 0, 0, 0)), taper=(0.22, 0, 0.04, 0.04))
        place.box((-x, x - cab - 0.15), (-y, y), (0.95, height), Look(Material.ROUGH, paint, (0.5, 0.05, 0, 0)))
        place.box((-x + 0.1, x - cab), (-0.45, 0.45), (0.5, 0.95), plain(DARK))
    else:
        place.box((-x, x), (-y, y), (0.32, height), Look(Material.COACH, paint), taper=(0.10, 0.02, 0.02, 0.02))
    for side, end in product((-1, 1), repeat=2):
        center = (end * reach, side * (width / 2 - 0.11), radius)
        place.cylinder(center, (radius, radius), 0.11, Look(Material.WHEEL, TIRE), lateral=True)


def add_pedestrian(builder: SceneBuilder, xyz: Vector, yaw: float) -> None:
    """Add a standing or walking person and their box."""
    rng = builder.rng
    height, length, width = (rng.uniform(*ends) for ends in ((1.5, 1.92), (0.34, 0.52), (0.46, 0.60)))
    place = builder.place(SceneClass.PEDESTRIAN, xyz, yaw, (BoxClass.PEDESTRIAN, (length, width, height)))
    trousers, jacket = pick(rng, _TROUSERS), pick(rng, _CLOTHES)
    skin = pick(rng, ((0.80, 0.62, 0.52), (0.55, 0.38, 0.28), (0.35, 0.24, 0.18)), 0.02)
    sleeve: Vector = (jacket[0] * 0.85, jacket[1] * 0.85, jacket[2] * 0.85)
    hip, shoulder = 0.48 * height, 0.83 * height
    stride = length / 2 - 0.075
    for side in (-1, 1):
        place.cylinder((side * stride * 0.9, side * width * 0.17, hip / 2), (0.075, 0.07), hip / 2, plain(trousers))
    torso, radii = Look(Material.ROUGH, jacket, (0.1, 0.06, 0, 0)), (0.14 * 0.9, (width / 2 - 0.08) * 0.88)
    place.cylinder((0.0, 0.0, (hip + shoulder) / 2), radii, (shoulder - hip) / 2, torso)
    place.ellipsoid((0, 0, shoulder - 0.03), (0.085, width / 2 - 0.03, 0.075), plain(sleeve))
    place.cylinder((0, 0, shoulder + 0.04), (0.055, 0.055), 0.09, plain(skin))
    for side in (-1, 1):
        # The swinging arms carry the box's length and width.
        arm = (-side * (length / 2 - 0.055), side * (width / 2 - 0.055), (hip + shoulder) / 2)
        place.cylinder(arm, (0.055, 0.055), (shoulder - hip) / 2 * 0.92, plain(sleeve))
        place.ellipsoid((arm[0], arm[1], hip - 0.03), (0.045, 0.045, 0.08), plain(skin))
    place.ellipsoid((0, 0, height - 0.115), (0.10, 0.085, 0.115), plain(skin))


def add_tree(builder: SceneBuilder, xyz: Vector, *, reach_m: float = math.inf) -> None:
    """Trunk and a crown of several ellipsoids, which reaches out at most ``reach_m`` from the trunk."""
    rng = builder.rng
    place = builder.place(SceneClass.VEGETATION, xyz, rng.uniform(0, 6.28))
    height, trunk = rng.uniform(4.5, 10), rng.uniform(0.09, 0.22)
    fork = height * rng.uniform(0.35, 0.5)
    bark = pick(rng, ((0.30, 0.25, 0.20), (0.36, 0.33, 0.29)), 0.03)
    place.cylinder((0, 0, fork * 0.6), (trunk, trunk), fork * 0.6, Look(Material.ROUGH, bark, (0.12, 0.12, 0, 0)))
    # No lump reaches further than (0.8 + 0.58) spreads.
    spread = min((height - fork) * rng.uniform(0.38, 0.55), reach_m / 1.38)
    green = pick(rng, ((0.22, 0.31, 0.13), (0.17, 0.26, 0.11), (0.30, 0.33, 0.14), (0.36, 0.28, 0.12)), 0.02)
    for k in range(int(rng.integers(7, 11))):
        # The golden angle spreads the lumps evenly around the trunk.
        turn, out = 2.4 * k, spread * rng.uniform(0.35, 0.8) * (k > 0)
        radius = spread * rng.uniform(0.36, 0.58) * (1.25 if k == 0 else 1.0)
        z = fork + (height - fork) * rng.uniform(0.18, 0.80)
        radii = (radius, radius, radius * rng.uniform(0.65, 0.95))
        place.ellipsoid((out * np.cos(turn), out * np.sin(turn), z), radii, Look(Material.LEAF, green))


def add_bush(builder: SceneBuilder, xyz: Vector, *, scale: float = 1.0) -> None:
    """Add low ellipsoids of leaves."""
    rng = builder.rng
    place = builder.place(SceneClass.VEGETATION, xyz, rng.uniform(0, 6.28))
    green = pick(rng, ((0.20, 0.28, 0.13), (0.26, 0.30, 0.15)), 0.02)
    for _ in range(4):
        x, y = rng.normal(0, 0.4 * scale, 2)
        r, height = scale * rng.uniform(0.35, 0.65), scale * rng.uniform(0.35, 0.75)
        place.ellipsoid((float(x), float(y), height * 0.6), (r, r * 0.9, height), Look(Material.LEAF, green))


def add_building(builder: SceneBuilder, x: Range, y: Range, z: Range, *, detailed: bool = True) -> None:
    """A block with windows; detailed ones have a cornice, now and then bays or an awning over the ground floor."""
    rng, place, (base_m, height) = builder.rng, builder.place(SceneClass.BUILDING), z
    wall = pick(rng, WALLS)
    bay, storey = rng.uniform(2.2, 4.2), rng.uniform(2.9, 3.6)
    # bay width, storey height, share of the wall that is glass, whether the ground floor is shops
    param = (bay, storey, rng.uniform(0.42, 0.72), float(rng.random() < 0.55))
    place.box(x, y, (base_m - 0.05, height), Look(Material.FACADE, wall, param))
    if not detailed:
        return
    trim = Look(Material.ROUGH, (wall[0] * 0.8, wall[1] * 0.8, wall[2] * 0.8), (0.8, 0.08, 0, 0))
    place.box((x[0] - 0.25, x[1] + 0.25), (y[0] - 0.25, y[1] + 0.25), (height, height + 0.4), trim)
    front, outward = (y[0], -1.0) if y[0] > 0 else (y[1], 1.0)
    if param[3] and rng.random() < 0.6:  # an awning
        cloth = pick(rng, _CLOTHES)
        a = rng.uniform(x[0] + 0.3, (x[0] + x[1]) / 2)
        b = min(a + rng.uniform(3, 7), x[1] - 0.2)
        reach = front, front + outward * rng.uniform(0.8, 1.3)
        place.box((a, b), reach, (2.75, 3.0), Look(Material.ROUGH, cloth, (0.4, 0.1, 0, 0)))
    if height > 9 and rng.random() < 0.4:
        for _ in range(int(rng.integers(1, 3))):
            a = rng.uniform(x[0] + 0.5, max(x[0] + 0.6, x[1] - 3.5))
            bounds = (a, min(a + 2.6, x[1])), (front, front + outward * 0.7), (storey, height * 0.85)
            place.box(*bounds, Look(Material.FACADE, wall, (2.6, storey, 0.7, 0.0)))
