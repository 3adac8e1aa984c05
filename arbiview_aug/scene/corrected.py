"""A static surface corrected by depth from overlapping cameras.

A correction maps the pixels of a view between two cameras to relative changes of inverse distance. The point that a ray
meets is projected into these views, and the change found there is applied along the ray.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.scene.surface import MAX_INVERSE_DISTANCE, StaticSurface

_STEPS = 2  # fixed-point iterations; a third one changes two real frames by at most 0.02 dB
_ROW = 4096  # remap's sizes must stay below 32767


@dataclass(frozen=True, eq=False)
class Correction:
    """The distance corrections of one pair of cameras; read-only.

    Attributes:
        view: The view between the two, in the ego frame.
        change: (h, w) float32 relative change of the surface's inverse distance, > -1.
        share: (h, w) float32 weight in [0, 1], which fades to 0 towards the borders of the view.
    """

    view: Camera
    change: npt.NDArray[np.float32]
    share: npt.NDArray[np.float32]

    @cached_property
    def key(self) -> bytes:
        """Content hash."""
        return hashlib.sha256(self.view.content_key + self.change.tobytes() + self.share.tobytes()).digest()

    @cached_property
    def planes(self) -> npt.NDArray[np.float32]:
        """(h, w, 2): change times share, and share."""
        return np.dstack([self.change * self.share, self.share])

    @property
    def nbytes(self) -> int:
        """Memory of the arrays."""
        return 2 * (self.change.nbytes + self.share.nbytes)


@dataclass(frozen=True)
class CorrectedSurface(StaticSurface):
    """A static surface ``base`` with the corrections found over it; where several apply, their weighted mean."""

    base: StaticSurface
    corrections: tuple[Correction, ...]

    def inverse_distance(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Inverse distance of the base times one plus the change, 1/m (...,)."""
        base = self.base.inverse_distance(origin, directions)
        q = base
        for _ in range(_STEPS):
            q = np.minimum(base * (1 + self._change(origin, directions, q)), MAX_INVERSE_DISTANCE)
        return q

    def _change(self, origin: FloatArray, directions: FloatArray, q: FloatArray) -> FloatArray:
        """Relative change (...,) at the points on rays."""
        rays, inverse = np.moveaxis(directions, -1, 0).reshape(3, -1), q.reshape(-1)
        total = np.zeros((inverse.size, 2), np.float32)
        for correction in self.corrections:
            view = correction.view
            P = view.K @ view.cam2ego[:3, :3].T
            x, y, z = P @ rays + np.outer(P @ (origin - view.center_m), inverse)  # homogeneous: views are pinholes
            h, w = view.size
            inside = np.flatnonzero((z > 0) & (x >= 0) & (x <= (w - 1) * z) & (y >= 0) & (y <= (h - 1) * z))
            uv = np.stack([x[inside], y[inside]], axis=-1) / z[inside, None]
            total[inside] += _read(correction.planes, uv)
        return (total[:, 0] / np.maximum(total[:, 1], 1)).astype(np.float64).reshape(q.shape)


def _read(planes: npt.NDArray[np.float32], uv: FloatArray) -> npt.NDArray[np.float32]:
    """Bilinear samples (n, 2) of (h, w, 2) at pixels (n, 2)."""
    padded = np.pad(uv.astype(np.float32), ((0, -len(uv) % _ROW), (0, 0))).reshape(-1, _ROW, 2)
    if not len(padded):
        return np.zeros((0, 2), np.float32)
    samples = cv2.remap(planes, padded, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    return np.asarray(samples, np.float32).reshape(-1, 2)[: len(uv)]
