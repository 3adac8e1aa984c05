"""Estimate a neighbour's pose error from the residuals that depth cannot explain.

A wrong distance moves a pixel along its epipolar line, a wrong pose moves it off the line too. The images, aligned by
the estimated distances, are compared where contrast runs across the lines. A Gauss-Newton step for all cameras together
gives the turn and the sideways shift of the neighbour that minimise the photometric residual.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.projection import project_rays
from arbiview_aug.scene.panorama import Layer
from arbiview_aug.temporal.plane_sweep import SweptImage

CORRECTED_PX = 0.15
"""Mean displacement in matched images above which a pose is corrected; exact poses measure 0.02 to 0.1."""

MAX_ERROR_PX = 0.4
"""Largest displacement left after the corrections, a tenth of a degree at 400 px; above it depth is declined."""

MAX_CORRECTIONS = 2
"""One correction reduces a third of a degree to a quarter; half a degree needs two."""

_ACROSS = 0.3
"""Largest share of a gradient along the epipolar line."""

_CONTRAST_LEVELS = 2.0  # per pixel; fainter gradients are noise

_MIN_PIXELS = 500  # for the five parameters

_TURN_DEG, _SHIFT_M = 0.1, 0.02  # steps of the derivatives

_REWEIGHTINGS = 5  # of iteratively reweighted least squares, against moving objects


class PoseSamples(NamedTuple):
    """Correspondences of one camera's pixels in a neighbour's image.

    Attributes:
        image: The camera's image.
        other: The neighbour's.
        inverse_distance: (h, w) along the camera's rays, 1/m.
        valid: (h, w) bool.
    """

    image: SweptImage
    other: SweptImage
    inverse_distance: Layer
    valid: BoolArray


@dataclass(frozen=True, eq=False)
class PoseError:
    """Error of a neighbour's pose.

    Attributes:
        error_px: Mean displacement of pixels.
        turn_deg: (3,) correcting turn about the current ego frame's axes.
        shift_m: (2,) correcting shift along its y and z; a shift along x cannot be told from scale.
    """

    error_px: float
    turn_deg: FloatArray
    shift_m: FloatArray

    @property
    def correction(self) -> FloatArray:
        """(4, 4) motion of the neighbour's cameras to their estimated poses, in the current ego frame."""
        return _pose(np.concatenate([self.turn_deg, self.shift_m]))

    def __str__(self) -> str:
        degrees, metres = float(np.linalg.norm(self.turn_deg)), float(np.linalg.norm(self.shift_m))
        return f"{self.error_px:.2f} px ({degrees:.2f} degrees, {metres:.2f} m)"


def pose_error(samples: Sequence[PoseSamples]) -> PoseError | None:
    """Estimate the error of one neighbour's pose from all its cameras; None if too few pixels match."""
    parts = [equations for sample in samples if (equations := _equations(sample)) is not None]
    if sum(len(b) for _, b, _ in parts) < _MIN_PIXELS:
        return None
    A, b, J = (np.concatenate(part) for part in zip(*parts, strict=True))
    x = np.zeros(5)
    for _ in range(_REWEIGHTINGS):
        residual = b - A @ x
        scale = 1.5 * np.median(np.abs(residual)) + 1e-9
        weighted = A * (1 / (1 + (residual / scale) ** 2))[:, None]
        x = np.linalg.lstsq(weighted.T @ A + 1e-9 * np.eye(5), weighted.T @ b, rcond=None)[0]
    return PoseError(float(np.linalg.norm(J @ x, axis=-1).mean()), x[:3], x[3:])


def _equations(sample: PoseSamples) -> tuple[FloatArray, FloatArray, FloatArray] | None:
    """Linear equations A x = b, (n, 5) and (n,), and the motion J of pixels (n, 2, 5); None without usable pixels.

    x holds turns about the ego's axes in degrees and shifts along its y and z in metres. Images are compared at their
    local mean and contrast, as in the sweep's correlation.
    """
    at = sample.image.positions(sample.other.camera, sample.inverse_distance)
    warped: Any = cv2.remap(sample.other.grey, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    one, two = _normalised(sample.image.grey), _normalised(warped)
    mean = (sample.image.grey + warped) / 2
    # Gradients of the warped image stand for those of the neighbour's: the warp is close to the identity.
    gx, gy = (cv2.Sobel((one + two) / 2, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1)))
    contrast = np.hypot(*(cv2.Sobel(mean, cv2.CV_32F, *d, ksize=3, scale=1 / 8) for d in ((1, 0), (0, 1))))
    shift = sample.image.shift(sample.other.camera, sample.inverse_distance)
    length = np.maximum(np.hypot(shift[..., 0], shift[..., 1]), 1e-9)
    ex, ey = shift[..., 0] / length, shift[..., 1] / length
    across = np.abs(gx * ex + gy * ey) <= _ACROSS * np.hypot(gx, gy)
    use = sample.valid & (contrast > _CONTRAST_LEVELS) & across
    if not use.any():
        return None
    motion = _motion(sample, use, at[use])
    normal = np.stack([-ey[use], ex[use]], -1)
    off_line = np.einsum("nk,nkp->np", normal, motion)  # [n, 5] px per unit
    gradient = gx[use] * normal[:, 0] + gy[use] * normal[:, 1]
    # Pixels read by the erroneous pose are displaced by its error: two(x) = one(x - off_line).
    return gradient[:, None] * off_line, (one - two)[use], motion


def _normalised(image: Layer) -> Layer:
    mean = cv2.blur(image, (15, 15))
    spread = np.sqrt(np.maximum(cv2.blur(image * image, (15, 15)) - mean * mean, 0) + 4)
    return np.asarray((image - mean) / spread)


def _motion(sample: PoseSamples, use: BoolArray, at: Layer) -> FloatArray:
    """(n, 2, 5) motion of the corresponding pixels per unit of turn and shift of the neighbour."""
    image, source = sample.image, sample.other.camera
    directions, q = image.directions[use], sample.inverse_distance[use].astype(np.float64)
    columns = []
    for axis in range(5):
        step = _TURN_DEG if axis < 3 else _SHIFT_M
        moved = source.moved(_pose(step * np.eye(5)[axis]))
        uv, _ = project_rays(moved, directions, q, image.camera.center_m - moved.center_m)
        columns.append((uv - at) / step)
    return np.stack(columns, -1)


def _pose(x: FloatArray) -> FloatArray:
    """(4, 4) of turns about x, y, z in degrees and shifts along y and z in metres."""
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.radians(x[:3]))[0]
    pose[1:3, 3] = x[3:]
    return pose
