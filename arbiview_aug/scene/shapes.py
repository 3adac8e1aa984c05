"""Solids inside labelled boxes: what a car, a person or a bicycle fills of its box, as up to two convex pieces.

A piece is a tapered slab of six planes n · x <= d. Shares of bodies are those of production cars: the glasshouse is
about a third of the height, the bonnet a quarter of the length, and a windscreen leans by 60 to 65 degrees.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.scene.surface import Points

PIECES = 2
"""Pieces of an object."""

LEAST_POINTS = 20
"""Points that suffice to choose among profiles."""

AIR_M = 0.2
"""Distance outside an object within which points count as its own, m."""


class Piece(NamedTuple):
    """A tapered slab in shares of its box's length, width and height, from -0.5 to 0.5.

    Attributes:
        bottom: Height.
        top: Height.
        rear: At its bottom.
        front: At its bottom.
        side: Half its width at its bottom.
        rear_lean: How far the rear leans in, up to its top.
        front_lean: The front.
        side_lean: Each side.
    """

    bottom: float
    top: float
    rear: float = -0.5
    front: float = 0.5
    side: float = 0.5
    rear_lean: float = 0.0
    front_lean: float = 0.0
    side_lean: float = 0.0


def _car(waist: float, rear: float, rear_lean: float) -> tuple[Piece, Piece]:
    """A car with a body up to its waist, and a cabin from ``rear`` on."""
    body = Piece(-0.5, waist, rear_lean=min(0.5 + rear, 0.03), front_lean=0.02, side_lean=0.03)
    return body, Piece(waist, 0.5, rear, 0.25, 0.47, rear_lean, 0.18, 0.09)


_BOX = (Piece(-0.5, 0.5),)
_CARS = tuple(
    _car(waist, *rear)
    for waist in (0.10, 0.03)
    for rear in ((-0.47, 0.12), (-0.38, 0.18), (-0.49, 0.05))  # hatchback, saloon, estate
)
_VANS = ((Piece(-0.5, 0.0, front_lean=0.02), Piece(0.0, 0.5, -0.5, 0.37, 0.5, 0.01, 0.08, 0.05)), _BOX)
_LARGE = ((Piece(-0.5, 0.5, front_lean=0.015, rear_lean=0.005, side_lean=0.01),), _BOX)
_PERSON = ((Piece(-0.5, 0.33, -0.35, 0.35, 0.38), Piece(0.33, 0.5, -0.25, 0.25, 0.2, 0.05, 0.05, 0.05)),)
_LOOSE_PERSON = (
    (Piece(-0.5, 0.33, -0.32, 0.32, 0.27, 0.12, 0.12, 0.04), Piece(0.33, 0.5, -0.16, 0.16, 0.16, 0.03, 0.03, 0.03)),
)
_BARRIER = ((Piece(-0.5, -0.2, -0.35, 0.35, 0.5, 0.17, 0.17), Piece(-0.2, 0.48, -0.18, 0.18, 0.5, 0.1, 0.1)),)
_CONE = ((Piece(-0.5, 0.5, rear_lean=0.4, front_lean=0.4, side_lean=0.4),),)
_TWO_WHEELER = (
    (Piece(-0.5, 0.04, side=0.2, rear_lean=0.1, front_lean=0.1), Piece(0.04, 0.5, -0.2, 0.25, 0.4, 0.02, 0.1, 0.25)),
)
_KINDS = (_CARS, _VANS, _LARGE, _PERSON, _LOOSE_PERSON, _BARRIER, _CONE, _TWO_WHEELER, (_BOX,))
_FROM_M = (
    *((3.0, 1.3, 1.1), (3.0, 1.3, 1.1), (3.0, 1.3, 1.95)),
    *((0.0, 0.0, 1.2), (0.0, 0.0, 1.2), (0.3, 1.2, 0.7), (0.0, 0.0, 0.3), (1.4, 0.35, 0.9)),
    (0.0, 0.0, 0.0),
)
_TO_M = (
    *((5.6, 2.8, 1.95), (6.6, 2.8, 2.8), (30.0, 3.5, 5.0)),
    *((0.65, 0.65, 2.2), (1.2, 1.2, 2.2), (1.1, 2.6, 1.4), (0.7, 0.7, 1.2), (2.7, 1.1, 2.1)),
    (np.inf,) * 3,
)
KIND_M = np.array([_FROM_M, _TO_M])
"""Least and largest length, width and height (2, kinds, 3) of cars, vans, lorries and buses, people in tight boxes and
in loose ones, barriers, cones, bicycles and motorcycles, and others. An object is of the first kind that it fits."""

_NOTHING = Piece(0.5, 0.5, 0.0, 0.0, 0.0)
PROFILES = np.array([[*one, _NOTHING][:PIECES] for kind in _KINDS for one in kind], np.float64)
"""All profiles (K, 2, 8), kind after kind."""

_COUNTS = np.array([len(kind) for kind in _KINDS])
OF_KIND = np.cumsum(_COUNTS)[:, None] - _COUNTS[:, None] + np.minimum(np.arange(_COUNTS.max()), _COUNTS[:, None] - 1)
"""Numbers (kinds, most) of each kind's profiles, the last again where it has fewer."""


def kinds(boxes: FloatArray) -> npt.NDArray[np.int64]:
    """Shapes that boxes (B, 7) may hold, by their sizes: rows (B,) of ``KIND_M``."""
    sizes = boxes[:, None, 3:6]
    return np.asarray(((sizes >= KIND_M[0]) & (sizes <= KIND_M[1])).all(axis=-1).argmax(axis=-1))


def solids(boxes: FloatArray) -> FloatArray:
    """Planes (B, 2, 6, 4) of what boxes (B, 7) hold: points n · x <= d of the ego frame lie in a piece.

    Planes are those of the rear, the front, the right, the left, the bottom and the top. Of the profiles that fit a
    box, it is the first.
    """
    return _planes(boxes, PROFILES[OF_KIND[kinds(boxes), 0]])


def solids_among(boxes: FloatArray, points: Points) -> tuple[FloatArray, BoolArray]:
    """Shapes in boxes (B, 7), as ``solids`` gives it, by the points (P, 3) in them; which points (P,) are theirs.

    Of the profiles that fit a box it is the one whose faces lie nearest to its points. Points within ``AIR_M`` of it
    are its own: mirrors, and the noise of points and labels. This far over the box's floor they may be the road's.
    """
    from arbiview_aug.scene.kernels import fit_profiles

    boxes = np.ascontiguousarray(boxes)
    planes_and_own = np.empty((len(boxes), PIECES, 6, 4)), np.zeros(len(points), bool)
    points = np.ascontiguousarray(points, np.float32)
    within = points_by_box(boxes, points, AIR_M)
    fit_profiles(boxes, PROFILES, OF_KIND[kinds(boxes)], points, *within, LEAST_POINTS, AIR_M, *planes_and_own)
    return planes_and_own


def points_by_box(
    boxes: FloatArray, points: Points, air_m: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Indices (n,) of the points (P, 3) in boxes (B, 7) widened by ``air_m``, box by box; where each box ends (B,)."""
    from arbiview_aug.scene.kernels import points_in

    box, point = points_in(np.ascontiguousarray(boxes), np.ascontiguousarray(points, np.float32), air_m)
    return point[np.argsort(box, kind="stable")], np.cumsum(np.bincount(box, minlength=len(boxes)))


def whole(boxes: FloatArray) -> FloatArray:
    """Planes (B, 1, 6, 4) of the boxes' own faces."""
    return _planes(boxes, np.tile(np.array([_BOX], np.float64), (len(boxes), 1, 1)))


def _planes(boxes: FloatArray, profiles: FloatArray) -> FloatArray:
    from arbiview_aug.scene.kernels import planes_of

    planes = np.empty((*profiles.shape[:2], 6, 4))
    for box, profile, out in zip(boxes, profiles, planes, strict=True):
        planes_of(box, profile, out)
    return planes
