"""The variants of the experiment: ways to train a detector for vehicle B on A's frames, and their images."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import cv2
import numpy as np
import torch

from arbiview_aug import RandomRig, Rig, RigRetarget, SampleKeys
from arbiview_aug.choices import GeometryName

Arrays = dict[str, np.ndarray]

RANDOM: dict[str, dict[str, Any]] = {
    "B": {"yaw_deg": 5.0, "pitch_deg": 2.0, "height_m": 0.2, "focal_scale": 0.1},
    "A": {"yaw_deg": 15.0, "pitch_deg": 5.0, "height_m": 0.8, "lateral_m": 0.3, "focal_scale": 0.4},
}
"""Half-widths of random rigs. Around B: a mounting tolerance well beyond real ones, less than the changes. Around A, by
those who do not know B: as wide as the changes."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to train."""

    name: str  # on the command line and in files
    title: str  # in tables
    kind: Literal["raw", "oracle", "retarget"] = "retarget"  # A's images as recorded, B's own, or A's re-rendered
    geometry: GeometryName = "auto"
    reads: tuple[Literal["points", "boxes_3d"], ...] = ("points", "boxes_3d")  # what it is given besides images
    mixed: bool = False  # half of the frames drawn are raw ones
    augmented: bool = False  # frames are scaled and cropped at random as they are drawn
    random: Literal["A", "B"] | None = None  # one target a frame, drawn around B, or around A where B is unknown

    @property
    def renders(self) -> bool:
        """Whether it has a training set on disk, and the labels of A's frames."""
        return self.kind == "retarget"

    @property
    def knows_target(self) -> bool:
        """Whether its training depends on B; otherwise one serves every change."""
        return self.kind != "raw" and self.random != "A"

    def views_spec(self) -> dict[str, Any]:
        """Settings that change its images: variants that differ in how they draw share them."""
        return {"geometry": self.geometry, "reads": self.reads, "random": self.random}


_street = partial(Variant, geometry="street", reads=())

VARIANTS: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        Variant(name="raw", title="raw A", kind="raw"),
        Variant(name="scale_crop", title="raw A, scaled and cropped", kind="raw", augmented=True),
        Variant(name="auto_fill", title="auto, filled holes, no mask"),
        Variant(name="auto_fill_mixed", title="auto, filled holes, no mask, + raw", mixed=True),
        _street(name="street_fill", title="street, filled holes, no mask"),
        _street(name="street_fill_mixed", title="street, filled holes, no mask, + raw", mixed=True),
        Variant(name="objects_fill", title="objects, filled holes, no mask", geometry="boxes", reads=("boxes_3d",)),
        Variant(name="auto_fill_random", title="RandomRig around B, auto, filled holes, no mask", random="B"),
        Variant(name="random_a", title="random rigs around A, auto, filled holes, no mask", random="A"),
        Variant(name="oracle", title="B's own frames", kind="oracle"),
    )
}
"""By name, in the order of tables."""


SCALE = (0.75, 1.35)
"""Zooms of ``scaled_and_cropped``: up to 65° → 50°, well beyond the ±8 % of LSS and BEVDet, so that it is a fair rival
under a change of focal length."""


def view_maker(variant: Variant, source: Rig, target: Rig) -> Callable[[int, Mapping[str, Any]], Arrays]:
    """Function that renders A's samples as a variant has them; a draw of the target depends on the index alone.

    ``target`` is in A's ego frame; ``source`` is for samples without a rig.
    """
    random = RandomRig(target, **RANDOM[variant.random]) if variant.random else None
    keys = SampleKeys(points="source")
    retarget = RigRetarget(random or target, source=source, geometry=variant.geometry, keys=keys)

    def make(index: int, sample: Mapping[str, Any]) -> Arrays:
        given = {key: sample[key] for key in ("images", "rig", *variant.reads) if key in sample}
        drawn = None if random is None else random.draw(torch.Generator().manual_seed(index))
        return arrays_of(retarget(given, drawn))

    return make


def arrays_of(sample: Mapping[str, Any]) -> Arrays:
    """Images and calibration of a retargeted sample."""
    K, cam2ego = (sample[key].numpy().astype(np.float32) for key in ("K", "cam2ego"))
    return {"images": sample["images"].numpy(), "K": K, "cam2ego": cam2ego}


def scaled_and_cropped(
    images: np.ndarray, K: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Zoom images (N, 3, h, w) uint8 once and move them to one window; returns them, coverage (N, h, w) bool, and K."""
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
