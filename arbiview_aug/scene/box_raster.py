"""Boxes drawn into a pinhole camera: where the ray of every pixel centre meets the nearest face, without casting it.

The inverse depth of a plane is linear in the pixel, and a face of a box is where four such functions are positive: in
each row of pixels that is one interval. All of it is evaluated in float64.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.scene.surface import MAX_INVERSE_DISTANCE, Fragments

_TOUCHES_M = 1e-9
"""A camera this close to a face's plane does not see the face."""

_ROUNDING_PX = 1e-6

_SIGNS = np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])


class _Faces(NamedTuple):
    """The F faces that are turned towards a camera and may lie in its image; functions of (u, v, 1).

    Attributes:
        inverse_depth: (F, 3) of the face's plane.
        sides: (F, 4, 3), all positive where a pixel shows the face.
        bounds: (F, 4) int, pixels x0, x1, y0, y1 that may show it; the last exclusive.
        number: (F,) 6 x the box's row + 2 x the axis across the face + 1 for the one further along that axis.
    """

    inverse_depth: FloatArray
    sides: FloatArray
    bounds: npt.NDArray[np.int64]
    number: npt.NDArray[np.int64]


def draw_boxes(camera: Camera, boxes: FloatArray) -> Fragments:
    """Inverse distance along a pinhole camera's rays to the nearest box.

    Args:
        camera: The camera; a box that holds it is not seen.
        boxes: (B, 7) centre x, y, z, length, width, height (metres), yaw (radians), in the ego frame.
    """
    nearest, shown_face = np.zeros(camera.size, np.float32), np.zeros(camera.size, np.int32)
    for here, inside, face, number in _face_images(camera, boxes):
        first = inside & (face > nearest[here])
        np.copyto(nearest[here], face, where=first)
        np.copyto(shown_face[here], number, where=first)
    index = np.flatnonzero(nearest != 0)  # faster than of floats
    v, u = np.divmod(index, camera.width_px)
    y = (v - camera.K[1, 2]) / camera.K[1, 1]
    x = (u - camera.K[0, 2] - camera.K[0, 1] * y) / camera.K[0, 0]
    distance = nearest.reshape(-1)[index] / np.sqrt(x * x + y * y + 1)
    return Fragments(index, np.minimum(distance, MAX_INVERSE_DISTANCE), shown_face.reshape(-1)[index])


def silhouettes(camera: Camera, boxes: FloatArray) -> list[npt.NDArray[np.int64]]:
    """For each box (B, 7) the pixels of a pinhole camera, into the flattened image, whose rays meet it: none is hidden.

    A box that holds the camera is not seen; a pixel on an edge may come twice.
    """
    found: list[list[npt.NDArray[np.int64]]] = [[np.zeros(0, np.int64)] for _ in boxes]
    for (rows, columns), inside, _, number in _face_images(camera, boxes):
        v, u = np.nonzero(inside)
        found[number // 6].append((v + rows.start) * camera.width_px + u + columns.start)
    return [np.concatenate(parts) for parts in found]


def _face_images(
    camera: Camera, boxes: FloatArray
) -> Iterator[tuple[tuple[slice, slice], BoolArray, npt.NDArray[np.float32], int]]:
    """For each face in the image: rows and columns around it, which pixels show it, inverse depths, its number."""
    columns = np.arange(camera.width_px, dtype=np.float64)
    for plane, sides, (x0, x1, y0, y1), number in zip(*_faces(camera, boxes), strict=True):
        rows = np.arange(y0, y1, dtype=np.float64)
        rest, slope = sides[:, 1:2] * rows + sides[:, 2:], sides[:, :1]  # [4, rows], [4, 1]
        with np.errstate(divide="ignore", invalid="ignore"):
            root = -rest / slope
        low = np.where(slope > 0, root, -np.inf).max(axis=0)
        high = np.where(slope < 0, root, np.inf).min(axis=0)
        high[((slope == 0) & (rest < 0)).any(axis=0)] = -np.inf
        shown = np.flatnonzero((high >= np.maximum(low, x0)) & (low <= x1 - 1))
        if len(shown) == 0:
            continue
        top, bottom = int(shown[0]), int(shown[-1]) + 1
        left = int(np.ceil(max(low[shown].min(), x0)))
        right = int(np.floor(min(high[shown].max(), x1 - 1))) + 1
        u, here = columns[left:right], (slice(y0 + top, y0 + bottom), slice(left, right))
        face = ((plane[0] * u)[None] + (plane[1] * rows[top:bottom] + plane[2])[:, None]).astype(np.float32)
        yield here, (u >= low[top:bottom, None]) & (u <= high[top:bottom, None]), face, int(number)


def _faces(camera: Camera, boxes: FloatArray) -> _Faces:
    """Which faces a camera may see, and where."""
    c, s, o, one = np.cos(boxes[:, 6]), np.sin(boxes[:, 6]), np.zeros(len(boxes)), np.ones(len(boxes))
    to_box = np.stack([c, s, o, -s, c, o, o, o, one], axis=-1).reshape(-1, 3, 3)
    half, camera2ego = boxes[:, 3:6] / 2, camera.cam2ego[:3, :3]
    start = np.einsum("bij,bj->bi", to_box, camera.center_m - boxes[:, :3])
    rays = to_box @ (camera2ego @ np.linalg.inv(camera.K))  # of pixels (u, v, 1) at depth 1, in the box's frame
    b, axis = np.nonzero(np.abs(start) > half + _TOUCHES_M)
    across = np.stack([(axis + 1) % 3, (axis + 2) % 3], axis=-1)  # [F, 2]
    side = np.sign(start[b, axis])
    # The face's corners in the camera's frame.
    corners = np.zeros((len(b), 4, 3))
    np.put_along_axis(corners, axis[:, None, None], (side * half[b, axis])[:, None, None], axis=2)
    for k in range(2):
        values = _SIGNS[:, k] * half[b, across[:, k], None]
        np.put_along_axis(corners, across[:, None, None, k], values[..., None], axis=2)
    seen = (corners - start[b, None]) @ to_box[b] @ camera2ego  # [F, 4, 3]
    pixels: FloatArray = seen @ camera.K.T
    h, w = camera.size
    x, y, z = pixels[..., 0], pixels[..., 1], pixels[..., 2]
    beyond = np.stack([x < 0, x > (w - 1) * z, y < 0, y > (h - 1) * z, z < 0]).all(axis=2).any(axis=0)
    shown = np.flatnonzero(~beyond)
    b, axis, across, side, pixels = b[shown], axis[shown], across[shown], side[shown], pixels[shown]
    plane = rays[b, axis] / (side * half[b, axis] - start[b, axis])[:, None]
    sides = np.empty((len(b), 4, 3))
    for k in range(2):
        e = across[:, k]
        sides[:, 2 * k] = (half[b, e] - start[b, e])[:, None] * plane - rays[b, e]
        sides[:, 2 * k + 1] = (half[b, e] + start[b, e])[:, None] * plane + rays[b, e]
    bounds = _pixel_bounds(pixels, camera.size)
    some = (bounds[:, 1] > bounds[:, 0]) & (bounds[:, 3] > bounds[:, 2])  # others lie between pixel centres
    return _Faces(plane[some], sides[some], bounds[some], (6 * b + 2 * axis + (side > 0))[some])


def _pixel_bounds(corners: FloatArray, size: tuple[int, int]) -> npt.NDArray[np.int64]:
    """x0, x1, y0, y1 (F, 4) around homogeneous pixels (F, 4, 3); the whole image where one lies behind the camera."""
    z = corners[..., 2:]
    ahead = (z > 0).all(axis=1)  # [F, 1]
    uv = corners[..., :2] / np.where(z > 0, z, 1.0)
    limit = np.array(size[::-1])
    low = np.where(ahead, np.ceil(uv.min(axis=1).clip(0, limit) - _ROUNDING_PX), 0)
    high = np.where(ahead, np.floor(uv.max(axis=1).clip(-1, limit - 1) + _ROUNDING_PX) + 1, limit)
    return np.stack([low, high], axis=-1).reshape(-1, 4).astype(np.int64)
