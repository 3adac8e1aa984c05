"""The variants of the experiment, by name."""

from __future__ import annotations

from functools import partial

from arbiview_aug.choices import GeometryName
from integrations.cross_rig.variant import Geometry, Variant

_LESS: tuple[tuple[str, str, GeometryName, tuple[Geometry, ...]], ...] = (
    ("street", "street", "street", ()),
    ("objects", "objects", "boxes", ("boxes_3d",)),
)
"""Names, titles, surfaces and what they read, where samples have no LiDAR."""
_ALL: tuple[Geometry, ...] = ("points", "boxes_3d")
_filled = partial(Variant, kind="retarget", reads=_ALL, holes="fill", masked=False)
"""``auto`` for a network that lifts every pixel."""
_RAW = Variant(name="raw", title="raw A", kind="raw")
_AUTO = _filled(name="auto_fill", title="auto, filled holes, no mask")
_AROUND_B = _filled(name="auto_fill_random", title="RandomRig around B, auto, filled holes, no mask", random="B")
_AROUND_A = _filled(name="random_a", title="random rigs around A, auto, filled holes, no mask", random="A")

VARIANTS: dict[str, Variant] = {
    variant.name: variant
    for variant in (
        _RAW,
        Variant(name="scale_crop", title="raw A, scaled and cropped", kind="raw", augmented=True),
        Variant(name="auto", title="auto: LiDAR, boxes", kind="retarget", surface="auto", reads=_ALL),
        Variant(name="auto_black", title="auto, black holes, no mask", kind="retarget", reads=_ALL, masked=False),
        _AUTO,
        _filled(name="auto_fill_mixed", title="auto, filled holes, no mask, + raw", mixed=True),
        *(
            _filled(
                name=f"{name}_fill{'_mixed' * mixed}",
                title=f"{title}, filled holes, no mask{', + raw' * mixed}",
                surface=surface,
                reads=reads,
                mixed=mixed,
            )
            for name, title, surface, reads in _LESS
            for mixed in (False, True)
        ),
        _AROUND_B,
        _AROUND_A,
        Variant(name="oracle", title="B's own frames", kind="oracle"),
    )
}
"""By name, in the order of tables."""
