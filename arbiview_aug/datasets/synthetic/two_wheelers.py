"""Bicycles and motorcycles, ridden or parked; each touches all six sides of its 3D box."""

from __future__ import annotations

import math

import numpy as np

from arbiview_aug.datasets.synthetic.objects import DARK, PAINTS, TIRE, add_head, add_trunk, pick, pick_clothes
from arbiview_aug.datasets.synthetic.scene import BoxClass, Material, Placed, Range, SceneBuilder, SceneClass, Vector

# Metres: length, width at the bars, height with a rider and without one, as adults and production models have them.
_SIZES: dict[BoxClass, tuple[Range, Range, Range, Range]] = {
    BoxClass.BICYCLE: ((1.60, 1.90), (0.52, 0.68), (1.62, 1.85), (0.95, 1.10)),
    BoxClass.MOTORCYCLE: ((1.90, 2.30), (0.70, 0.90), (1.55, 1.72), (1.00, 1.15)),
}
_METAL = (0.45, 0.46, 0.48)


def two_wheeler_size(rng: np.random.Generator, cls: BoxClass, *, ridden: bool) -> Vector:
    """Length, width and height in metres."""
    length, width, *height = _SIZES[cls]
    return rng.uniform(*length), rng.uniform(*width), rng.uniform(*height[not ridden])


def add_two_wheeler(
    builder: SceneBuilder,
    rng: np.random.Generator,
    cls: BoxClass,
    size: Vector,
    xyz: Vector,
    yaw: float,
    *,
    ridden: bool,
) -> None:
    """A bicycle or motorcycle on the surface at ``xyz``, and its box."""
    length, width, height = size
    row = builder.add_box(np.array([*xyz[:2], xyz[2] + height / 2]), size, yaw, cls)
    place = builder.place(xyz, yaw, SceneClass.TWO_WHEELER, row)
    if cls is BoxClass.BICYCLE:
        bars, radius = 0.58 * height if ridden else height, rng.uniform(0.31, 0.35)
        axle = length / 2 - radius
        _add_bicycle(place, rng, axle, radius, bars)
        seat, grip, turn = (-0.42 * axle, bars - 0.10), 0.72 * axle, rng.uniform(0, 2 * math.pi)
        pedals = [(-0.1 * axle + 0.17 * math.cos(t), 0.28 + 0.17 * math.sin(t)) for t in (turn, turn + math.pi)]
        aside, helmet = 0.10, (0.13, 0.105, 0.085) if rng.random() < 0.6 else None
    else:
        bars, radius = 0.65 * height if ridden else height, 0.31
        axle = length / 2 - radius
        _add_motorcycle(place, rng, axle, radius, bars)
        seat, grip, pedals = (-0.30 * axle, 0.78), 0.58 * axle, [(-0.05, 0.30)] * 2
        aside, helmet = 0.20, (0.14, 0.12, 0.14)
    place.cylinder((grip, 0, bars - 0.02), (0.02, 0.02), width / 2, Material.PLAIN, DARK, lateral=True)
    if ridden:
        _add_rider(place, rng, height, seat, (grip, width / 2 - 0.07, bars), pedals, aside, helmet)


def _add_wheels(place: Placed, axle: float, radius: float, half_width: float) -> None:
    for x in (-axle, axle):
        place.cylinder((x, 0, radius), (radius, radius), half_width, Material.WHEEL, TIRE, lateral=True)


def _add_bicycle(place: Placed, rng: np.random.Generator, axle: float, radius: float, bars: float) -> None:
    _add_wheels(place, axle, radius, 0.022)
    paint = pick(rng, PAINTS)
    rear, crank, seat = (-axle, radius), (-0.1 * axle, 0.28), (-0.42 * axle, bars - 0.12)
    head, stem = (0.70 * axle, bars - 0.20), (0.66 * axle, bars - 0.02)
    low_seat = (-0.37 * axle, bars - 0.26)
    for start, end in ((rear, crank), (crank, seat), (crank, head), (low_seat, head), (rear, low_seat)):
        place.tube((start[0], 0, start[1]), (end[0], 0, end[1]), 0.02, Material.PLAIN, paint)
    place.tube((axle, 0, radius), (stem[0], 0, stem[1]), 0.022, Material.PLAIN, paint)
    place.cylinder((crank[0], 0, crank[1]), (0.09, 0.09), 0.05, Material.PLAIN, _METAL, lateral=True)
    place.box((seat[0] - 0.14, seat[0] + 0.12), (-0.07, 0.07), (seat[1] - 0.03, seat[1] + 0.03), Material.PLAIN, DARK)


def _add_motorcycle(place: Placed, rng: np.random.Generator, axle: float, radius: float, bars: float) -> None:
    _add_wheels(place, axle, radius, 0.06)
    paint = pick(rng, PAINTS)
    place.box((-0.42 * axle, 0.45 * axle), (-0.15, 0.15), (0.20, 0.62), Material.PLAIN, DARK, taper=(0.12, 0, 0, 0))
    place.ellipsoid((0.22 * axle, 0, 0.78), (0.36 * axle, 0.16, 0.16), Material.PLAIN, paint)
    place.box((-1.15 * axle, -0.05 * axle), (-0.14, 0.14), (0.70, 0.78), Material.PLAIN, DARK, taper=(0, 0.06, 0, 0))
    place.box((-1.25 * axle, -0.35 * axle), (-0.11, 0.11), (0.58, 0.70), Material.PLAIN, paint)
    place.ellipsoid((0.70 * axle, 0, 0.86), (0.11, 0.11, 0.11), Material.PLAIN, (0.80, 0.80, 0.76))
    for side in (-0.09, 0.09):
        place.tube((axle, side, radius), (0.56 * axle, side, bars - 0.03), 0.03, Material.PLAIN, _METAL)
        place.tube((-axle, side, radius), (-0.2 * axle, side, 0.40), 0.03, Material.PLAIN, _METAL)
    place.tube((0.2 * axle, -0.17, 0.26), (-1.15 * axle, -0.19, 0.36), 0.045, Material.PLAIN, _METAL)


def _add_rider(
    place: Placed,
    rng: np.random.Generator,
    top: float,
    seat: Range,
    grip: Vector,
    pedals: list[Range],
    aside: float,
    helmet: Vector | None,
) -> None:
    """A person up to ``top`` who leans forward to the grips.

    ``seat`` and ``pedals`` are x and z, the right pedal first. ``grip`` is the left one. Feet are ``aside`` of the
    middle.
    """
    wears, width = pick_clothes(rng), rng.uniform(0.44, 0.50)
    hip, shoulder_z = (seat[0], seat[1] + 0.08), top - 0.29
    rise = shoulder_z - hip[1]
    shoulder_x = hip[0] + math.sqrt(max((0.32 * top) ** 2 - rise**2, 0.05**2))
    trunk, length = place.along((hip[0], 0, hip[1]), (shoulder_x, 0, shoulder_z))
    add_trunk(trunk, -0.04, length, width, wears)
    leg = 0.52 * max(math.dist(hip, pedal) for pedal in pedals)  # of thigh and shank
    for side, (x, z) in zip((-1, 1), pedals, strict=True):
        foot = (x - 0.04, z + 0.05)
        half = math.dist(hip, foot) / 2
        bent = math.sqrt(max(leg**2 - half**2, 0)) / (2 * half)
        knee = (
            (hip[0] + foot[0]) / 2 + bent * (hip[1] - foot[1]),
            side * (aside + 0.03),
            (hip[1] + foot[1]) / 2 + bent * (foot[0] - hip[0]),
        )
        place.tube((hip[0], side * 0.09, hip[1]), knee, 0.075, Material.PLAIN, wears.trousers)
        place.tube(knee, (foot[0], side * aside, foot[1]), 0.055, Material.PLAIN, wears.trousers)
        ends = sorted((side * (aside - 0.045), side * (aside + 0.045)))
        place.box((x - 0.10, x + 0.15), (ends[0], ends[1]), (z, z + 0.08), Material.PLAIN, DARK)
        arm = (shoulder_x, side * (width / 2 - 0.055), shoulder_z - 0.04)
        place.tube(arm, (grip[0], side * grip[1], grip[2]), 0.05, Material.PLAIN, wears.sleeve)
        place.ellipsoid((grip[0], side * grip[1], grip[2]), (0.045, 0.045, 0.045), Material.PLAIN, wears.skin)
    add_head(place, shoulder_x + 0.07, top, wears.skin)
    if helmet is not None:
        center = (shoulder_x + 0.07, 0.0, top - helmet[2])
        place.ellipsoid(center, helmet, Material.PLAIN, pick(rng, PAINTS))
