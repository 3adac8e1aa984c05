"""How a training set for vehicle B comes out of A's frames: an arm of the experiment, and what renders its views.

The arms themselves stand in ``arms``, apart: a new one must not make the others' frames and trainings anew.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
import torch

from arbiview_aug import RandomRig, Rig, RigRetarget
from arbiview_aug.evaluate.baselines import row_split
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.surface import SurfaceName
from integrations.cross_rig.cache import Arrays

Kind = Literal["raw", "oracle", "row_split", "retarget"]
Geometry = Literal["points", "boxes_3d", "depth_m"]

_TELEA_RADIUS_PX = 3
"""OpenCV's own example; holes are filled from their border inwards whatever it is."""

RANDOM: dict[str, Any] = {"yaw_deg": 5.0, "pitch_deg": 2.0, "height_m": 0.2, "focal_scale": 0.1}
"""Half-widths of the random rigs around B: a mounting tolerance well beyond real ones, less than the changes."""


@dataclass(frozen=True, kw_only=True)
class Arm:
    """One way to train.

    Attributes:
        name: On the command line and in files.
        title: In tables.
        kind: Where its images come from: A's as they are, B's own, or A's re-rendered.
        surface: Of ``RigRetarget``.
        reads: Which of the frame's geometry it is given, besides the images.
        mixed: Half of the frames drawn are raw ones.
        augmented: Frames are scaled and cropped at random as they are drawn.
        filled: What no camera saw is inpainted, and counts as seen.
        random: Targets are drawn around B, one for each frame.
    """

    name: str
    title: str
    kind: Kind
    surface: SurfaceName = "auto"
    reads: tuple[Geometry, ...] = ()
    mixed: bool = False
    augmented: bool = False
    filled: bool = False
    random: bool = False

    @property
    def renders(self) -> bool:
        """Whether it has a training set of its own on disk."""
        return self.kind in ("row_split", "retarget")

    def views_spec(self) -> dict[str, Any]:
        """What its images depend on, besides rigs and code: arms that differ in how they draw share them."""
        settings = {"kind": self.kind, "surface": self.surface, "reads": list(self.reads), "filled": self.filled}
        return settings | ({"random": RANDOM} if self.random else {})


class ViewMaker:
    """Renders A's frames as an arm has them.

    Args:
        arm: One that renders.
        source: Vehicle A.
        target: Vehicle B, in A's ego frame.
    """

    def __init__(self, arm: Arm, source: Rig, target: Rig) -> None:
        self.arm, self.source, self.target = arm, source, target
        self.random = RandomRig(target, **RANDOM) if arm.random else None
        self.retarget = RigRetarget(self.random or target, source_rig=source, surface=arm.surface)

    def __call__(self, index: int, frame: Mapping[str, Any]) -> Arrays:
        """The arrays of a retargeted frame.

        Args:
            index: Of the frame: its draw depends on it alone.
            frame: ``images`` (N, 3, h, w) uint8 and the geometry that the arm reads.

        Returns:
            ``images`` (M, 3, h, w), ``coverage`` (M, h, w / 8) packed bits, ``K``, ``cam2ego`` float32 and ``cpu_s``:
            CPU seconds that the arm's work took.
        """
        start = time.process_time()
        if self.arm.kind == "row_split":
            views = row_split(self.source, as_arrays(frame["images"]), self.target)
            images = np.stack([view.image for view in views]).astype(np.uint8).transpose(0, 3, 1, 2)
            coverage = np.stack([view.coverage for view in views])
            K, cam2ego = self.target.K, self.target.cam2ego
        else:
            given = {key: frame[key] for key in ("images", *self.arm.reads)}
            drawn = None if self.random is None else self.random.draw(torch.Generator().manual_seed(index))
            out = self.retarget(given, drawn)
            images, coverage = out["images"].numpy(), out["coverage"].numpy()
            K, cam2ego = out["K"].numpy(), out["cam2ego"].numpy()
        if self.arm.filled:
            images = np.stack([_filled(*view) for view in zip(images, coverage, strict=True)])
            coverage = np.ones_like(coverage)
        seconds = time.process_time() - start
        return {
            "images": images,
            "coverage": np.packbits(coverage, axis=-1),
            "K": K.astype(np.float32),
            "cam2ego": cam2ego.astype(np.float32),
            "cpu_s": np.array(seconds, np.float32),
        }


def _filled(image: np.ndarray, coverage: np.ndarray) -> np.ndarray:
    """(3, h, w) with what is not covered inpainted (Telea)."""
    if not coverage.any():  # nothing to start from
        return image
    picture = np.ascontiguousarray(image.transpose(1, 2, 0))
    done = cv2.inpaint(picture, (~coverage).astype(np.uint8), _TELEA_RADIUS_PX, cv2.INPAINT_TELEA)
    return np.asarray(done).transpose(2, 0, 1)


SCALE = (0.75, 1.35)
"""Zooms of ``scaled_and_cropped``: up to 65° → 50°, well beyond the ±8 % of LSS and BEVDet, so that it is a fair rival
under a change of focal length."""


def scaled_and_cropped(
    images: np.ndarray, K: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The usual augmentation: one zoom and one window a frame, with the calibration that goes with them.

    Args:
        images: (N, 3, h, w) uint8.
        K: (N, 3, 3).
        rng: Draws.

    Returns:
        Images of the same size, coverage (N, h, w) bool, K.
    """
    h, w = images.shape[-2:]
    s = float(np.exp(rng.uniform(*np.log(SCALE))))
    # The zoomed image slides over the window's edges no further than it reaches (or than the window does).
    ty, tx = (float(rng.uniform(*sorted((0.0, n - s * n)))) for n in (h, w))
    # Pixel centres are integers: (x + 0.5) s - 0.5 + tx.
    T = np.array([[s, 0, 0.5 * s - 0.5 + tx], [0, s, 0.5 * s - 0.5 + ty], [0, 0, 1]])
    moved = [
        cv2.warpAffine(np.ascontiguousarray(image.transpose(1, 2, 0)), T[:2], (w, h), borderMode=cv2.BORDER_CONSTANT)
        for image in images
    ]
    seen = cv2.warpAffine(np.ones((h, w), np.uint8), T[:2], (w, h), flags=cv2.INTER_NEAREST) > 0
    out = np.stack(moved).transpose(0, 3, 1, 2)
    return out, np.broadcast_to(seen, (len(images), h, w)), (T @ K).astype(np.float32)
