"""Labelled 3D boxes on the street, which keep an object's height when cameras move, and the shapes inside them.

A car, a person or a bicycle fills its box as up to two convex pieces: tapered slabs of six planes n · x <= d. Shares of
bodies are those of production cars: the glasshouse is about a third of the height, the bonnet a quarter of the length,
and a windscreen leans by 60 to 65 degrees.

A ray meets the first face of a piece, or the street where it misses all. Pixels that an object occludes in a source are
not read from that source; where no other source sees them, they are holes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import CELL_PX, PixelRays, pixel_rays
from arbiview_aug.errors import SampleError, SampleTypeError, one_line
from arbiview_aug.image_ops import FRESH, Memory
from arbiview_aug.scene.surface import LayeredSurface, OcclusionMap, Points, Surface

PIECES = 2
"""Pieces of an object."""

LEAST_POINTS = 20
"""Points that suffice to choose among profiles."""

AIR_M = 0.2
"""Distance outside an object within which points count as its own, m."""

SIDE_CELLS = 8, 16
"""Rows and columns of displacements on each side of an object: 0.2 by 0.3 m on a car, a few scan lines at 10 m."""

SCANNER_M = 1.0, 0.0, 1.9
"""A place of scanners on roofs, over the road, from which points were seen; nuScenes' is at 0.9, 0, 1.8."""


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


def _car(waist: float, rear: float, rear_lean: float, *, leans: bool = True) -> tuple[Piece, Piece]:
    """A car with a body up to its waist, and a cabin from ``rear`` on, which leans or hardly does."""
    if leans:
        body = Piece(-0.5, waist, rear_lean=min(0.5 + rear, 0.03), front_lean=0.02, side_lean=0.03)
        return body, Piece(waist, 0.5, rear, 0.25, 0.47, rear_lean, 0.18, 0.09)
    body = Piece(-0.5, waist, rear_lean=0.01, front_lean=0.01, side_lean=0.01)
    return body, Piece(waist, 0.5, rear, 0.2, 0.48, rear_lean, 0.04, 0.03)


_BOX = (Piece(-0.5, 0.5),)
_WAISTS = 0.10, 0.03
_LEANING = tuple(
    _car(waist, *rear)
    for waist in _WAISTS
    for rear in ((-0.47, 0.12), (-0.38, 0.18), (-0.49, 0.05))  # hatchback, saloon, estate
)
_UPRIGHT = tuple(
    _car(waist, *rear, leans=False)
    for waist in _WAISTS
    for rear in ((-0.49, 0.02), (-0.33, 0.04), (-0.15, 0.02))  # off-roader, old saloon, pick-up
)
_CARS = *_LEANING, *_UPRIGHT
_VANS = (Piece(-0.5, 0.0, front_lean=0.02), Piece(0.0, 0.5, -0.5, 0.37, 0.5, 0.01, 0.08, 0.05)), _BOX, *_UPRIGHT
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

    Planes are those of the rear, the front, the right, the left, the bottom and the top. The profile is the
    first one that fits a box.
    """
    return _planes(boxes, PROFILES[OF_KIND[kinds(boxes), 0]])


ByBox = tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]


def solids_among(
    boxes: FloatArray, points: Points, ground_z_m: float = 0.0
) -> tuple[FloatArray, BoolArray, npt.NDArray[np.float32]]:
    """Shapes in boxes (B, 7), as ``solids`` gives it, by the points (P, 3) in them; which points (P,) are theirs; how
    far their sides (B, 5, rows, columns) lie off the shapes, metres.

    Of the profiles that fit a box it is the one whose faces lie nearest to its points; then cabin and faces fit these.
    Points within ``AIR_M`` of it are its own: mirrors, and the noise of points and labels. This far over the box's
    floor they may be the road's.
    """
    from arbiview_aug.scene.shape_kernels import fit_profiles

    boxes, points = np.ascontiguousarray(boxes), np.ascontiguousarray(points, np.float32)
    planes, is_own = np.empty((len(boxes), PIECES, 6, 4)), np.zeros(len(points), bool)
    displaced = np.zeros((len(boxes), 5, *SIDE_CELLS), np.float32)
    scanner = np.array([*SCANNER_M[:2], SCANNER_M[2] + ground_z_m])
    fitting = PROFILES, OF_KIND[kinds(boxes)], points, *points_by_box(boxes, points, AIR_M), LEAST_POINTS, AIR_M
    fit_profiles(boxes, *fitting, scanner, planes, is_own, displaced)
    return planes, is_own, displaced


def points_by_box(boxes: FloatArray, points: Points, air_m: float) -> ByBox:
    """Indices (n,) of the points (P, 3) in boxes (B, 7) widened by ``air_m``, box by box; where each box ends (B,)."""
    from arbiview_aug.scene.kernels import points_in

    box, point = points_in(np.ascontiguousarray(boxes), np.ascontiguousarray(points, np.float32), air_m)
    return point[np.argsort(box, kind="stable")], np.cumsum(np.bincount(box, minlength=len(boxes)))


def whole(boxes: FloatArray) -> FloatArray:
    """Planes (B, 1, 6, 4) of the boxes' own faces."""
    return _planes(boxes, np.tile(np.array([_BOX], np.float64), (len(boxes), 1, 1)))


def _planes(boxes: FloatArray, profiles: FloatArray) -> FloatArray:
    from arbiview_aug.scene.shape_kernels import planes_of

    planes = np.empty((*profiles.shape[:2], 6, 4))
    for box, profile, out in zip(boxes, profiles, planes, strict=True):
        planes_of(box, profile, out)
    return planes


UNLABELLED = 0.45
"""Share of the street's uncertainty due to unlabelled objects. Fitted on synthetic streets, seeds 100 to 105."""

BOX_ERROR = 0.08
"""Mean relative error of a box face's inverse distance. Fitted on synthetic streets, seeds 100 to 105."""

TOP = 0.9
"""Upward part of a face's normal, above which it is a top: windscreens have up to 0.87."""

ROOF_M2 = 2.0
"""Least footprint of objects whose tops have a colour of their own: heads, cones and barriers go on as their sides."""

PARTS, TOP_PART, RIM_PART = 7, 5, 6
"""Parts of an object; those that are its tops, and what lies just below their edges: samples of paint alone."""

_WIDER = np.array([1, 1, 1, 1, 0, 1])  # all planes of a piece but its floor


@dataclass(frozen=True, eq=False)
class BoxSurface(LayeredSurface):
    """Labelled objects standing on the street: what their boxes hold.

    Attributes:
        street: The surface behind the objects.
        boxes: (B, 7) centre x, y, z, length, width, height (metres), yaw (radians), in the ego frame.
        solids: (B, pieces, 6, 4) planes of what they hold.
    """

    street: Surface
    boxes: FloatArray
    solids: FloatArray
    _shadows: dict[bytes, OcclusionMap] = field(default_factory=dict, repr=False)

    @property
    def background(self) -> Surface:
        """The street."""
        return self.street

    # --- images -------------------------------------------------------------------------------------------------------
    def occlusion_map(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> OcclusionMap:
        """Find what objects hide from a source; kept for the next target."""
        key = camera.content_key
        if key not in self._shadows:
            pixel_rad = float(1 / camera.K[0, 0])
            scale = 1 / (1 + 2 * pixel_rad)  # a lookup's error
            onto = self._hidden(camera, rays, memory, coarse=True)
            widened = self._widened(camera.center_m, pixel_rad, lift=0.5)
            drawn = draw_solids(camera, *widened, rays, memory, scale=scale, faces=False, onto=onto)
            before_m = self.before_faces(camera.center_m).astype(np.float32)
            self._shadows[key] = OcclusionMap(*drawn, before_m)
        return self._shadows[key]

    def drawn(
        self, camera: Camera, rays: PixelRays, memory: Memory = FRESH
    ) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
        """Inverse distances (h, w) of the objects' faces along a camera's rays where nothing hides them; faces, or -1.

        A face's number is 6 x its piece + that of its plane; ``face_objects`` and ``face_is_top`` tell what it is.
        """
        onto = self._hidden(camera, rays, memory, coarse=False)
        widened = self._widened(camera.center_m, float(1 / camera.K[0, 0]))
        return draw_solids(camera, *widened, rays, memory, onto=onto)

    def _hidden(self, camera: Camera, rays: PixelRays, memory: Memory, *, coarse: bool) -> npt.NDArray[np.float32]:
        """Inverse distances (h, w) beyond which something else hides, 0 where nothing does."""
        return np.asarray(memory.full(camera.size, 0, np.float32))

    def before_faces(self, origin: FloatArray) -> FloatArray:
        """By how many metres a point lies before the planes of all faces (n,)."""
        return np.asarray((self.solids[..., :3] @ origin - self.solids[..., 3]).reshape(-1))

    @property
    def face_objects(self) -> npt.NDArray[np.int64]:
        """Rows (n,) of the boxes that the faces belong to."""
        return np.repeat(np.arange(len(self.boxes)), 6 * self.solids.shape[1])

    @property
    def face_is_top(self) -> BoolArray:
        """Whether faces (n,) are roofs and bonnets, which look upwards."""
        is_large = self.boxes[:, 3] * self.boxes[:, 4] > ROOF_M2
        return np.asarray((self.solids[..., 2] > TOP) & is_large[:, None, None]).reshape(-1)

    @cached_property
    def face_parts(self) -> npt.NDArray[np.int32]:
        """Part that each face (n,) shows: ``PARTS`` times its object, and ``TOP_PART`` more for tops.

        The sides of the lowest piece, the body under the windows, have 1 to 4 in the order of their planes. All else
        has 0, also small objects.
        """
        pieces = self.solids.shape[1]
        body = np.tile([1, 2, 3, 4, 0, 0] + [0] * 6 * (pieces - 1), len(self.boxes))
        is_large = np.repeat(self.boxes[:, 3] * self.boxes[:, 4] > ROOF_M2, 6 * pieces)
        part = np.where(self.face_is_top, TOP_PART, body * is_large)
        return np.asarray(PARTS * self.face_objects + part, np.int32)

    def _widened(self, origin: FloatArray, pixel_rad: float, lift: float = 0.0) -> tuple[FloatArray, FloatArray]:
        """Boxes and planes half a pixel wider, as border pixels mix colours; floors ``lift`` pixels higher."""
        pixel_m = pixel_rad * np.linalg.norm(self.boxes[:, :3] - origin, axis=-1)
        boxes, planes = self.boxes.copy(), self.solids.copy()
        boxes[:, 3:6] += pixel_m[:, None]
        planes[..., 3] += pixel_m[:, None, None] / 2 * _WIDER
        planes[:, 0, 4, 3] -= pixel_m * lift
        return boxes, planes

    def uncertainty(self, origin: FloatArray, directions: FloatArray, inverse_distance: FloatArray) -> FloatArray:
        """Expected error (...,) in 1/m of the street because of unlabelled objects; faces have ``BOX_ERROR``."""
        return UNLABELLED * self.street.uncertainty(origin, directions, inverse_distance)


def solid_rows(
    camera: Camera, boxes: FloatArray, planes: FloatArray, rays: PixelRays
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int64]]:
    """Pieces (B, pieces, 6, 4) that a camera may see as ``kernels.draw_solids`` reads them, and their numbers (n,)."""
    from arbiview_aug.scene.kernels import ROW
    from arbiview_aug.scene.kernels import solid_rows as describe

    most = planes.shape[0] * planes.shape[1] + 1
    rows, numbers = np.empty((most, ROW), np.float32), np.empty(most, np.int64)
    pose = np.ascontiguousarray(camera.cam2ego[:3, :3]), np.ascontiguousarray(camera.center_m)
    boxes, planes = np.ascontiguousarray(boxes), np.ascontiguousarray(planes)
    count = describe(boxes, planes, pose[1], pose[0], rays.cone, rows, numbers)
    return rows[:count], numbers[:count]


def draw_solids(
    camera: Camera,
    boxes: FloatArray,
    planes: FloatArray,
    rays: PixelRays | None = None,
    memory: Memory = FRESH,
    *,
    scale: float = 1.0,
    faces: bool = True,
    onto: npt.NDArray[np.float32] | None = None,
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    """Rasterise the pieces (B, pieces, 6, 4) of what boxes (B, 7) hold.

    Args:
        camera: The camera.
        boxes: (B, 7).
        planes: (B, pieces, 6, 4) as ``solids`` gives them.
        rays: The camera's rays, if they are known.
        memory: Memory of the images.
        scale: Factor of the inverse distances.
        faces: Number the faces: 6 x piece + plane; else the pieces.
        onto: (h, w) inverse distances that stand there, drawn over by what is nearer; 0 by default.

    Returns:
        (h, w) inverse distances of the nearest faces, or of what stands there; (h, w) the pieces or faces, or -1.
    """
    from arbiview_aug.scene.kernels import draw_solids as draw

    rays = rays or pixel_rays(camera)
    q = memory.full(camera.size, 0, np.float32) if onto is None else onto
    number, rows = memory.full(camera.size, -1, np.int32), solid_rows(camera, boxes, planes, rays)
    draw(rays.planes, rays.parameters, *rows, rays.cones, CELL_PX, scale, faces, q, number)
    return q, number


def draw_boxes(camera: Camera, boxes: FloatArray) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.int32]]:
    """Rasterise whole boxes (B, 7): inverse distances (h, w) of the nearest, 0 for none; (h, w) its row, or -1."""
    return draw_solids(camera, boxes, whole(boxes), faces=False)


def silhouette_sums(camera: Camera, boxes: FloatArray, weight: FloatArray) -> FloatArray:
    """Sums (B,) of weights (h, w) over the pixels whose rays meet each box, whatever stands before it."""
    from arbiview_aug.scene.kernels import sum_silhouettes

    rays, sums = pixel_rays(camera), np.zeros(len(boxes))
    rows = solid_rows(camera, boxes, whole(boxes), rays)
    sum_silhouettes(rays.planes, rays.parameters, *rows, rays.cones, CELL_PX, weight, sums)
    return sums


def meets(box: FloatArray, origin: FloatArray, directions: FloatArray) -> BoolArray:
    """Whether rays (..., 3) from a point outside a box (7,) meet it (slab method)."""
    rays = _in_box_frame(box, directions)
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    start, half = _in_box_frame(box, origin - box[:3]), box[3:6] / 2
    one, two = (-half - start) / rays, (half - start) / rays
    enter, leave = np.minimum(one, two).max(axis=-1), np.maximum(one, two).min(axis=-1)
    return np.asarray((leave >= enter) & (enter > 0))


def points_in(boxes: FloatArray, points: Points, air_m: float = 0.0) -> list[npt.NDArray[np.int64]]:
    """For each box (B, 7) the indices of the points (P, 3) in it, widened by ``air_m`` on all sides."""
    point, ends = points_by_box(boxes, points, air_m)
    return [point[end - count : end] for end, count in zip(ends, np.diff(ends, prepend=0), strict=True)]


def is_over(box: FloatArray, point: FloatArray) -> bool:
    """Whether a point (3,) is within the footprint of a box (7,)."""
    return bool((np.abs(_in_box_frame(box, point - box[:3]))[:2] <= box[3:5] / 2).all())


def _in_box_frame(box: FloatArray, vectors: FloatArray) -> FloatArray:
    """Ego-frame vectors (..., 3) along the box's length, width and height."""
    c, s = np.cos(box[6]), np.sin(box[6])
    return vectors @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def checked_boxes(boxes: Any) -> FloatArray:
    """(B, 7) float64 boxes of a sample; refuse other shapes, numbers that are not finite, and sizes up to 0."""
    try:
        array = np.asarray(boxes.detach().cpu() if hasattr(boxes, "detach") else boxes, dtype=np.float64)
    except (TypeError, ValueError) as error:
        got = f"{type(boxes).__name__} ({one_line(error, 120)})"
        raise SampleTypeError(f"boxes_3d: expected rows of numbers, of one frame, got {got}") from None
    if array.shape == (0,):
        return np.zeros((0, 7))
    if array.ndim != 2 or array.shape[1] < 7:
        raise SampleError(f"boxes_3d: expected shape (B, >= 7): x y z, length, width, height, yaw, got {array.shape}")
    array = array[:, :7]
    valid = np.isfinite(array).all(axis=1) & (array[:, 3:6] > 0).all(axis=1)
    if not valid.all():
        bad = int(valid.argmin())
        fix = "" if np.nan_to_num(array[bad]).any() else "; leave out rows that pad: a batch takes a list of boxes"
        got = f"{array[bad].tolist()}{fix}"
        raise SampleError(f"boxes_3d[{bad}]: expected finite numbers and positive sizes, got {got}")
    return array


def moved_by(boxes: Any, pose: FloatArray) -> Any:
    """Boxes (B, >=7) in the upright frame that a pose (4, 4) leads to; columns 7 and 8, if there, are velocities."""
    moved = np.array(boxes)
    moved[:, :3] = moved[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    moved[:, 6] += np.arctan2(pose[1, 0], pose[0, 0])
    if moved.shape[1] >= 9:
        moved[:, 7:9] = moved[:, 7:9] @ pose[:2, :2].T
    return moved


STAYED_M = 0.4
"""Largest label motion of a parked vehicle: labels jitter by decimetres."""

SAME_SIZE_M = 0.2
"""Largest difference of one object's labelled sizes from frame to frame."""

MOST_MOVED_M = 40.0
"""Largest way of one object from frame to frame: that of a car in a second."""


def carried(points: Points, one: FloatArray, two: FloatArray) -> FloatArray:
    """The points (P, >= 3), those in boxes ``one`` (B, 7) moved to where the same objects are in ``two`` (C, 7).

    The same are boxes of one size within ``MOST_MOVED_M`` that are each other's nearest. Points that are in other boxes
    alone are left out.
    """
    moved, kept = points.astype(np.float64), np.ones(len(points), bool)
    apart = np.linalg.norm(one[:, None, :3] - two[None, :, :3], axis=-1)
    differs = np.abs(one[:, None, 3:6] - two[None, :, 3:6]).max(axis=-1) > SAME_SIZE_M
    apart[differs | (apart > MOST_MOVED_M)] = np.inf
    within = points_in(one, points, AIR_M)
    for rows in within:
        kept[rows] = False
    for k, rows in enumerate(within if len(two) else ()):
        match = int(apart[k].argmin())
        if apart[k, match] < np.inf and apart[:, match].argmin() == k:
            kept[rows] = True
            c, s = np.cos(two[match, 6]), np.sin(two[match, 6])
            to_ego = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            moved[rows, :3] = _in_box_frame(one[k], points[rows, :3] - one[k, :3]) @ to_ego + two[match, :3]
    return moved[kept]


def moved_boxes(one: FloatArray, two: FloatArray) -> FloatArray:
    """The boxes (M, 7) of two frames that have no counterpart at the same place in the other."""
    if not len(one) or not len(two):
        return np.concatenate([one, two])
    apart_m = np.linalg.norm(one[:, None, :3] - two[None, :, :3], axis=-1)
    return np.concatenate([one[apart_m.min(axis=1) > STAYED_M], two[apart_m.min(axis=0) > STAYED_M]])
