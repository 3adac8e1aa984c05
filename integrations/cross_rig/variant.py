"""A variant of the experiment: one way to train a detector for vehicle B on A's frames; ``variants`` lists them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

from arbiview_aug.choices import GeometryName

Kind = Literal["raw", "oracle", "retarget"]
Geometry = Literal["points", "boxes_3d"]


RANDOM: dict[str, dict[str, Any]] = {
    "B": {"yaw_deg": 5.0, "pitch_deg": 2.0, "height_m": 0.2, "focal_scale": 0.1},
    "A": {"yaw_deg": 15.0, "pitch_deg": 5.0, "height_m": 0.8, "lateral_m": 0.3, "focal_scale": 0.4},
}
"""Half-widths of random rigs. Around B: a mounting tolerance well beyond real ones, less than the changes. Around A, by
those who do not know B: as wide as the changes."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """One way to train.

    Attributes:
        name: On the command line and in files.
        title: In tables.
        kind: Source of its images: A's as they are, B's own, or A's re-rendered.
        surface: Surface of ``RigRetarget``.
        reads: The frame's geometry that it is given, in addition to the images.
        mixed: Half of the frames drawn are raw ones.
        augmented: Frames are scaled and cropped at random as they are drawn.
        holes: Pixels that no camera saw are black, or filled as ``RigRetarget`` does by default.
        masked: The network masks them by ``coverage``. Otherwise every pixel counts as seen, as in stock detectors.
        random: Targets are drawn around B, or around A by those who do not know B, one for each frame.
    """

    name: str
    title: str
    kind: Kind
    surface: GeometryName = "auto"
    reads: tuple[Geometry, ...] = ()
    mixed: bool = False
    augmented: bool = False
    holes: Literal["black", "fill"] = "black"
    masked: bool = True
    random: Literal["A", "B"] | None = None

    @property
    def renders(self) -> bool:
        """Whether it has a training set of its own on disk."""
        return self.kind == "retarget"

    @property
    def knows_target(self) -> bool:
        """Whether its training depends on B; otherwise one serves every change."""
        return self.kind != "raw" and self.random != "A"

    @property
    def labels_of_a(self) -> bool:
        """Whether vehicles that A does not see count for nothing."""
        return self.renders

    def views_spec(self) -> dict[str, Any]:
        """Settings that change its images, besides rigs and code: variants that differ in how they draw share them."""
        settings = {"kind": self.kind, "surface": self.surface, "reads": list(self.reads), "holes": self.holes}
        return settings | ({"random": RANDOM[self.random]} if self.random else {})
