"""Labelled 3D boxes on the street, which keep an object's height when cameras move, and the shapes inside them.

A car, a person or a bicycle fills its box as up to two convex pieces: tapered slabs of six planes n · x <= d. Shares of
bodies follow production cars: the glasshouse is about a third of the height, the bonnet a quarter of the length,
and a windscreen leans by 60 to 65 degrees.

A ray meets the first face of a piece, or the street where it misses all. Pixels that an object occludes in a source are
not read from that source; where no other source sees them, they are holes.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rays import CELL_PX, PixelRays, pixel_rays
from arbiview_aug.errors import SampleError, SampleTypeError, one_line
from arbiview_aug.image_ops import FRESH, Memory
from arbiview_aug.scene.surface import Layer, OcclusionMap, Points, Surface

PIECES = 2
"""Number of convex pieces of an object."""

LEAST_POINTS = 20
"""Minimum number of points to choose among profiles."""

AIR_M = 0.2
"""Distance outside an object within which points belong to it, metres."""

SIDE_CELLS = 8, 16
"""Rows and columns of displacements on each side of an object: 0.2 by 0.3 m on a car, a few scan lines at 10 m."""

SCANNER_M = 1.0, 0.0, 1.9
"""Assumed position of the scanner, over the road, metres; nuScenes' is at 0.9, 0, 1.8."""


class Piece(NamedTuple):
    """A tapered slab in shares of its box's length, width and height, from -0.5 to 0.5."""

    bottom: float
    top: float
    rear: float = -0.5  # rear, front and side of its bottom
    front: float = 0.5
    side: float = 0.5  # half its width
    rear_lean: float = 0.0  # inward lean of the rear, up to its top
    front_lean: float = 0.0
    side_lean: float = 0.0


def _car(waist: float, rear: float, rear_lean: float, *, leans: bool = True) -> tuple[Piece, Piece]:
    """A car with a body up to its waist and a cabin from ``rear`` forward; upright cars hardly lean."""
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
_KINDS: tuple[tuple[Any, tuple[float, ...], tuple[float, ...]], ...] = (
    (_CARS, (3.0, 1.3, 1.1), (5.6, 2.8, 1.95)),
    (_VANS, (3.0, 1.3, 1.1), (6.6, 2.8, 2.8)),
    (_LARGE, (3.0, 1.3, 1.95), (30.0, 3.5, 5.0)),  # lorries and buses
    (_PERSON, (0.0, 0.0, 1.2), (0.65, 0.65, 2.2)),  # in a tight box
    (_LOOSE_PERSON, (0.0, 0.0, 1.2), (1.2, 1.2, 2.2)),
    (_BARRIER, (0.3, 1.2, 0.7), (1.1, 2.6, 1.4)),
    (_CONE, (0.0, 0.0, 0.3), (0.7, 0.7, 1.2)),
    (_TWO_WHEELER, (1.4, 0.35, 0.9), (2.7, 1.1, 2.1)),
    ((_BOX,), (0.0, 0.0, 0.0), (np.inf, np.inf, np.inf)),  # all others
)
KIND_M = np.array([[least, most] for _, least, most in _KINDS]).transpose(1, 0, 2)
"""Minimum and maximum length, width and height (2, kinds, 3) of the kinds. An object has the first kind that fits."""

_NOTHING = Piece(0.5, 0.5, 0.0, 0.0, 0.0)
PROFILES = np.array([[*profile, _NOTHING][:PIECES] for kind, *_ in _KINDS for profile in kind], np.float64)
"""All profiles (K, 2, 8), kind after kind."""

_COUNTS = np.array([len(kind) for kind, *_ in _KINDS])
OF_KIND = np.cumsum(_COUNTS)[:, None] - _COUNTS[:, None] + np.minimum(np.arange(_COUNTS.max()), _COUNTS[:, None] - 1)
"""Indices (kinds, most) of each kind's profiles, padded with the last one."""


def kinds(boxes: FloatArray) -> npt.NDArray[np.int64]:
    """Kinds of boxes (B, 7) by their sizes: rows (B,) of ``KIND_M``."""
    sizes = boxes[:, None, 3:6]
    return np.asarray(((sizes >= KIND_M[0]) & (sizes <= KIND_M[1])).all(axis=-1).argmax(axis=-1))


def solids(boxes: FloatArray) -> FloatArray:
    """Planes (B, 2, 6, 4) of the shapes in boxes (B, 7): points n · x <= d of the ego frame lie in a piece.

    Planes come in the order rear, front, right, left, bottom, top. The profile is the first one that fits a box.
    """
    return _planes(boxes, PROFILES[OF_KIND[kinds(boxes), 0]])


def solids_among(boxes: FloatArray, points: Points, ground_z_m: float = 0.0) -> tuple[FloatArray, BoolArray, Layer]:
    """Fit shapes in boxes (B, 7) to the points (P, 3) in them.

    The profile whose faces lie nearest to a box's points is chosen; then cabin and faces are fitted to them. Points
    within ``AIR_M`` of a shape belong to it: mirrors, and the noise of points and labels. This close to the box's floor
    they may belong to the road.

    Returns:
        Planes as from ``solids``; the points (P,) of objects; displacements (B, 5, rows, columns) of sides, metres.
    """
    from arbiview_aug.scene.shape_kernels import fit_profiles

    boxes, points = np.ascontiguousarray(boxes), np.ascontiguousarray(points, np.float32)
    planes, is_own = np.empty((len(boxes), PIECES, 6, 4)), np.zeros(len(points), bool)
    displaced = np.zeros((len(boxes), 5, *SIDE_CELLS), np.float32)
    scanner = np.array([*SCANNER_M[:2], SCANNER_M[2] + ground_z_m])
    fitting = PROFILES, OF_KIND[kinds(boxes)], points, *points_by_box(boxes, points, AIR_M), LEAST_POINTS, AIR_M
    fit_profiles(boxes, *fitting, scanner, planes, is_own, displaced)
    return planes, is_own, displaced


def points_by_box(
    boxes: FloatArray, points: Points, air_m: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Indices (n,) of the points (P, 3) in boxes (B, 7) widened by ``air_m``, box by box; end of each box (B,)."""
    from arbiview_aug.scene.kernels import points_in

    box, point = points_in(np.ascontiguousarray(boxes), np.ascontiguousarray(points, np.float32), air_m)
    few = box.astype(np.min_scalar_type(len(boxes)))  # small numbers are sorted by radix
    return point[np.argsort(few, kind="stable")], np.cumsum(np.bincount(box, minlength=len(boxes)))


def whole(boxes: FloatArray) -> FloatArray:
    """Planes (B, 1, 6, 4) of the boxes' faces."""
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
"""Upward component of a normal above which a face is a top: windscreens have up to 0.87."""

ROOF_M2 = 2.0
"""Minimum footprint of objects whose tops are coloured separately: heads, cones and barriers continue their sides."""

PARTS, TOP_PART, RIM_PART = 7, 5, 6
"""Number of parts of an object; the part of its tops, and of the rim just below their edges, for samples of paint."""

_WIDER = np.array([1, 1, 1, 1, 0, 1])  # all planes of a piece but its floor
_UNCOUNTED = np.zeros(0, np.int64)


@dataclass(frozen=True, eq=False)
class BoxSurface(Surface):
    """Shapes of labelled objects on the street or among points.

    Pixels that show an object are mapped one by one, the others by the background. ``occlusion_map`` covers both. Among
    points a shape decides within its silhouette, but nearer measured points win. An object's points choose its shape,
    move its faces and displace them. They are left out of the panoramas, where they would blur over its outline.
    """

    street: Surface  # behind the objects: static, or made of the points of no object
    boxes: FloatArray  # (B, 7) centre x, y, z, length, width, height (metres), yaw (radians), in the ego frame
    solids: FloatArray  # (B, pieces, 6, 4) planes of their shapes
    displaced: Layer | None = None  # (B, 5, rows, columns) of their sides, as ``solids_among`` gives it
    is_layered: ClassVar[bool] = True

    @property
    def background(self) -> Surface:
        """The street."""
        return self.street

    def image(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> Layer:
        """Inverse distances (h, w) of objects and background along the rays of a camera's pixel centres, 1/m."""
        q = self.background.image(camera, rays, memory)
        objects, face = self.drawn(camera, rays, memory)
        np.copyto(q, objects, where=face >= 0)
        return q

    def occlusion_map(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> OcclusionMap:
        """Occlusion by objects and points in a source."""
        pixel_rad = float(1 / camera.K[0, 0])
        widened = self._widened(camera.center_m, pixel_rad, lift=0.5)
        scale = 1 / (1 + 2 * pixel_rad)  # a lookup's error
        onto = self.street.hidden(camera, rays, memory)
        drawn = draw_solids(camera, *widened, rays, memory, scale=scale, faces=False, onto=onto)
        before_m = self.solids[..., :3] @ camera.center_m - self.solids[..., 3]
        return OcclusionMap(*drawn, before_m.reshape(-1).astype(np.float32))

    def drawn(self, camera: Camera, rays: PixelRays, memory: Memory = FRESH) -> tuple[Layer, npt.NDArray[np.int32]]:
        """Inverse distances (h, w) of the objects' faces along a camera's rays where nothing hides them; faces, or -1.

        A face's number is 6 x its piece + its plane; ``face_parts`` gives its part.
        """
        onto = self.street.hidden(camera, rays, memory, coarse=False)
        widened = self._widened(camera.center_m, float(1 / camera.K[0, 0]))
        q, face = draw_solids(camera, *widened, rays, memory, onto=onto)
        if self.displaced is not None:
            from arbiview_aug.scene.shape_kernels import displace

            pose = np.ascontiguousarray(camera.cam2ego[:3, :3]), np.ascontiguousarray(camera.center_m)
            boxes = np.ascontiguousarray(self.boxes)
            displace(rays.planes, rays.parameters, *pose, boxes, self.solids, self.displaced, face, q)
        return q, face

    @cached_property
    def face_parts(self) -> npt.NDArray[np.int32]:
        """Part that each face (n,) shows: ``PARTS`` times its object, and ``TOP_PART`` more for roofs and bonnets.

        The sides of the lowest piece, the body under the windows, have 1 to 4 in the order of their planes. All other
        faces have 0, and all faces of small objects.
        """
        count, pieces = self.solids.shape[:2]
        is_large = (self.boxes[:, 3] * self.boxes[:, 4] > ROOF_M2)[:, None, None]
        body = np.array([[1, 2, 3, 4, 0, 0], *[[0] * 6] * (pieces - 1)])
        part = np.where(self.solids[..., 2] > TOP, TOP_PART, body) * is_large
        return np.asarray(PARTS * np.arange(count)[:, None, None] + part, np.int32).reshape(-1)

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
        error = self.street.uncertainty(origin, directions, inverse_distance)
        return UNLABELLED * error if self.street.is_guess else error


def draw_solids(
    camera: Camera,
    boxes: FloatArray,
    planes: FloatArray,
    rays: PixelRays | None = None,
    memory: Memory = FRESH,
    *,
    scale: float = 1.0,
    faces: bool = True,
    onto: Layer | None = None,
    met: npt.NDArray[np.int64] = _UNCOUNTED,
) -> tuple[Layer, npt.NDArray[np.int32]]:
    """Rasterise the pieces (B, pieces, 6, 4) of ``solids`` in boxes (B, 7).

    ``rays`` are the camera's, if known; ``scale`` is a factor of inverse distances. With ``faces`` the faces are
    numbered, 6 x piece + plane, else the pieces. Nearer pieces overwrite ``onto`` (h, w), inverse distances, 0 by
    default. ``met`` (B x pieces,) counts the pixels whose rays meet a piece, occluded or not.

    Returns:
        (h, w) inverse distances of the nearest faces, or of ``onto``; (h, w) the pieces or faces, or -1.
    """
    from arbiview_aug.scene import kernels

    rays, most = rays or pixel_rays(camera), planes.shape[0] * planes.shape[1] + 1
    q = memory.full(camera.size, 0, np.float32) if onto is None else onto
    number, numbers = memory.full(camera.size, -1, np.int32), np.empty(most, np.int64)
    boxes, planes = np.ascontiguousarray(boxes), np.ascontiguousarray(planes)
    R, center, rows = camera.cam2ego[:3, :3].copy(), camera.center_m.copy(), np.empty((most, kernels.ROW), np.float32)
    seen = slice(kernels.solid_rows(boxes, planes, center, R, rays.cone, rows, numbers))
    pieces = rows[seen], numbers[seen], rays.cones, CELL_PX
    kernels.draw_solids(rays.planes, rays.parameters, *pieces, scale, faces, q, number, met)
    return q, number


def draw_boxes(
    camera: Camera, boxes: FloatArray, met: npt.NDArray[np.int64] = _UNCOUNTED
) -> tuple[Layer, npt.NDArray[np.int32]]:
    """Rasterise whole boxes (B, 7): inverse distances (h, w) of the nearest, 0 for none; (h, w) its row, or -1.

    ``met`` (B,) counts the pixels whose rays meet a box, occluded or not.
    """
    return draw_solids(camera, boxes, whole(boxes), faces=False, met=met)


def meets(box: FloatArray, origin: FloatArray, directions: FloatArray) -> BoolArray:
    """Whether rays (..., 3) from a point outside a box (7,) meet it (slab method)."""
    rays = _in_box_frame(box, directions)
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    start, half = _in_box_frame(box, origin - box[:3]), box[3:6] / 2
    near, far = (-half - start) / rays, (half - start) / rays
    enter, leave = np.minimum(near, far).max(axis=-1), np.maximum(near, far).min(axis=-1)
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
    """Check a sample's boxes and return them as (B, 7) float64; sizes must be positive, and all numbers finite."""
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
"""Maximum motion of an object between frames: about that of a car in a second."""


def carried(points: Points, boxes: FloatArray, boxes_now: FloatArray) -> FloatArray:
    """Move points (P, >= 3) in ``boxes`` (B, 7) along with their objects to ``boxes_now`` (C, 7).

    Boxes match if they have one size, are within ``MOST_MOVED_M``, and are each other's nearest. Points that lie only
    in boxes without a match are left out.
    """
    moved, kept = points.astype(np.float64), np.ones(len(points), bool)
    apart = np.linalg.norm(boxes[:, None, :3] - boxes_now[None, :, :3], axis=-1)
    differs = np.abs(boxes[:, None, 3:6] - boxes_now[None, :, 3:6]).max(axis=-1) > SAME_SIZE_M
    apart[differs | (apart > MOST_MOVED_M)] = np.inf
    within = points_in(boxes, points, AIR_M)
    for rows in within:
        kept[rows] = False
    for k, rows in enumerate(within if len(boxes_now) else ()):
        match = int(apart[k].argmin())
        if apart[k, match] < np.inf and apart[:, match].argmin() == k:
            kept[rows] = True
            c, s = np.cos(boxes_now[match, 6]), np.sin(boxes_now[match, 6])
            to_ego = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            moved[rows, :3] = _in_box_frame(boxes[k], points[rows, :3] - boxes[k, :3]) @ to_ego + boxes_now[match, :3]
    return moved[kept]


def moved_boxes(boxes: FloatArray, neighbour_boxes: FloatArray) -> FloatArray:
    """The boxes (M, 7) of two frames that have no counterpart at the same place in the other."""
    if not len(boxes) or not len(neighbour_boxes):
        return np.concatenate([boxes, neighbour_boxes])
    apart_m = np.linalg.norm(boxes[:, None, :3] - neighbour_boxes[None, :, :3], axis=-1)
    return np.concatenate([boxes[apart_m.min(axis=1) > STAYED_M], neighbour_boxes[apart_m.min(axis=0) > STAYED_M]])
