"""The variants of the experiment: ways to train a detector for vehicle B on A's frames."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

from arbiview_aug.choices import GeometryName

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
        kind: Source of its images: A's as recorded, B's own, or A's re-rendered, with holes filled.
        geometry: Geometry of ``RigRetarget``.
        reads: The frame's geometry that it is given, in addition to the images.
        mixed: Half of the frames drawn are raw ones.
        augmented: Frames are scaled and cropped at random as they are drawn.
        random: Targets are drawn around B, or around A by those who do not know B, one for each frame.
    """

    name: str
    title: str
    kind: Literal["raw", "oracle", "retarget"] = "retarget"
    geometry: GeometryName = "auto"
    reads: tuple[Literal["points", "boxes_3d"], ...] = ("points", "boxes_3d")
    mixed: bool = False
    augmented: bool = False
    random: Literal["A", "B"] | None = None

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
