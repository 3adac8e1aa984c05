"""Whether poses are right enough for depth: what is left over once distances have explained all that they can.

A wrong distance moves a pixel along its epipolar line; a wrong pose moves it off the line too. So the images, read over
the distances found, are compared where contrast runs across the lines: the photometric residual there, as a function of
a small turn and a small sideways shift of the neighbour, is least at the pose's own error (one Gauss-Newton step for
all cameras together).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.projection import project_rays
from arbiview_aug.render.pixel_projection import Layer
from arbiview_aug.temporal.plane_sweep import SweptSurface

CORRECTED_PX = 0.15
"""Mean displacement, in pixels of the images that are matched, from which on a pose is mended and they are matched
again: 0.04 degrees at 400 px. Exact poses seem to err by 0.02 to 0.1."""

MOST_ERROR_PX = 0.4
"""What is left after ``MENDS`` must be less, or depth is declined: a tenth of a degree."""

MENDS = 2
"""One step finds a third of a degree to a quarter; half a degree needs two."""

_ACROSS = 0.3
"""Contrast counts where so little of it, or less, runs along the epipolar line."""

_CONTRAST_LEVELS = 2.0  # a pixel; fainter gradients are noise

_FEW = 500  # pixels that a pose's five numbers are read off

_TURN_DEG, _SHIFT_M = 0.1, 0.02  # steps of the derivatives


class PoseSamples(NamedTuple):
    """A neighbour's image as one camera's pixels read it.

    Attributes:
        family: Of the camera.
        source: The neighbour's camera.
        grey: (h, w) the camera's image.
        other: (h', w') the neighbour's.
        inverse_distance: (h, w) along the camera's rays, 1/m.
        kept: (h, w) where it is believed.
        at: (h, w, 2) where the neighbour is read.
        shift: (h, w, 2) by how much that moves if the inverse distance grows by a tenth: along the epipolar line.
    """

    family: SweptSurface
    source: Camera
    grey: Layer
    other: Layer
    inverse_distance: Layer
    kept: BoolArray
    at: FloatArray
    shift: FloatArray


@dataclass(frozen=True, eq=False)
class PoseError:
    """What a neighbour's pose seems to be wrong by.

    Attributes:
        error_px: By how much pixels are displaced, on average.
        turn_deg: (3,) about the current ego frame's axes: the turn that mends it.
        shift_m: (2,) along its y and z; along the motion nothing can be told from scale.
    """

    error_px: float
    turn_deg: FloatArray
    shift_m: FloatArray

    @property
    def mended(self) -> FloatArray:
        """(4, 4) what moves the neighbour's cameras to where they seem to be, in the current ego frame."""
        return _move(np.concatenate([self.turn_deg, self.shift_m]))

    def __str__(self) -> str:
        degrees, metres = float(np.linalg.norm(self.turn_deg)), float(np.linalg.norm(self.shift_m))
        return f"{self.error_px:.2f} px ({degrees:.2f} degrees, {metres:.2f} m)"


def pose_error(reads: Sequence[PoseSamples]) -> PoseError | None:
    """The error of one neighbour's pose, from all its cameras; None where too little is alike to tell."""
    parts = [equations for read in reads if (equations := _equations(read)) is not None]
    if sum(len(rest) for _, rest, _ in parts) < _FEW:
        return None
    A, b, J = (np.concatenate(part) for part in zip(*parts, strict=True))
    x = np.zeros(5)
    for _ in range(_ROUNDS):
        rest = b - A @ x
        scale = 1.5 * np.median(np.abs(rest)) + 1e-9
        weighted = A * (1 / (1 + (rest / scale) ** 2))[:, None]
        x = np.linalg.lstsq(weighted.T @ A + 1e-9 * np.eye(5), weighted.T @ b, rcond=None)[0]
    return PoseError(float(np.linalg.norm(J @ x, axis=-1).mean()), x[:3], x[3:])


_ROUNDS = 5  # of reweighting: what moved by itself must not decide


def _equations(read: PoseSamples) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """(n, 5) and (n,): contrast across the epipolar line times motion off it = difference; and the motion (n, 2, 5).

    The five: turns about the ego's axes in degrees, shifts along its y and z in metres. Images are compared as the
    windows' correlation does, each to its own mean and contrast.
    """
    at = read.at.astype(np.float32)
    warped: Any = cv2.remap(read.other, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    one, two = _normalised(read.grey), _normalised(warped)
    mean = (read.grey + warped) / 2
    # In the neighbour's pixels the image moves as the read positions do: their Jacobian is close to the identity, a
    # metre apart.
    gx, gy = (cv2.Sobel((one + two) / 2, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1)))
    raw = np.hypot(*(cv2.Sobel(mean, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1))))
    length = np.maximum(np.hypot(read.shift[..., 0], read.shift[..., 1]), 1e-9)
    ex, ey = read.shift[..., 0] / length, read.shift[..., 1] / length
    along, steep = np.abs(gx * ex + gy * ey), np.hypot(gx, gy)
    use = read.kept & (raw > _CONTRAST_LEVELS) & (along <= _ACROSS * steep)
    if not use.any():
        return None
    motion = _motion(read, use)
    normal = np.stack([-ey[use], ex[use]], -1)
    off = np.einsum("nk,nkp->np", normal, motion)  # [n, 5] px off the line for each unit
    across = gx[use] * normal[:, 0] + gy[use] * normal[:, 1]
    # What is read with the pose as it is lies off by the pose's error: two(x) = one(x - off).
    return across[:, None] * off, (one - two)[use], motion


def _normalised(image: Layer) -> Layer:
    mean = cv2.GaussianBlur(image, (0, 0), 5)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur(image * image, (0, 0), 5) - mean * mean, 0) + 4)
    return np.asarray((image - mean) / spread)


def _motion(read: PoseSamples, use: BoolArray) -> FloatArray:
    """(n, 2, 5) by how much the read positions move for each unit of turn and shift of the neighbour."""
    family, source = read.family, read.source
    directions, q = family.directions[use], read.inverse_distance[use].astype(np.float64)
    found = []
    for axis in range(5):
        step = _TURN_DEG if axis < 3 else _SHIFT_M
        moved = source.moved(_move(step * np.eye(5)[axis]))
        uv, _ = project_rays(moved, directions, q, family.camera.center_m - moved.center_m)
        found.append((uv - read.at[use]) / step)
    return np.stack(found, -1)


def _move(five: FloatArray) -> FloatArray:
    """(4, 4) of turns about x, y, z in degrees and shifts along y and z in metres."""
    move = np.eye(4)
    move[:3, :3] = cv2.Rodrigues(np.radians(five[:3]))[0]
    move[1:3, 3] = five[3:]
    return move
