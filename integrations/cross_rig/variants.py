"""The variants of the experiment, by name."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

from arbiview_aug.choices import GeometryName
from integrations.cross_rig.variant import Geometry, Noise, Variant

NOISES: dict[Noise, str] = {
    "boxes": "boxes 10 cm and 2° off",
    "missed": "a tenth of the boxes missed",
    "late": "points and boxes 50 ms late",
    "calibration": "cameras turned by 0.2°",
}
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
        Variant(
            name="learned",
            title="true depth with 5 % noise",
            kind="retarget",
            surface="lidar",
            reads=("depth_m",),
            noise="depth",
        ),
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
        Variant(
            name="true_covered", title="auto's holes in B's own frames", kind="retarget", reads=_ALL, truth="covered"
        ),
        Variant(
            name="true_holes", title="auto, holes filled with the truth", kind="retarget", reads=_ALL, truth="holes"
        ),
        _filled(name="true_vehicles", title="auto, filled holes, no mask, true vehicles", truth="vehicles"),
        Variant(
            name="auto_neighbours",
            title="auto, near road from other frames",
            kind="retarget",
            reads=(*_ALL, "neighbours"),
        ),
        Variant(name="motion", title="depth from motion", kind="retarget", surface="motion", reads=("neighbours",)),
        Variant(
            name="motion_learned",
            title="depth from motion, and true depth with 5 % noise",
            kind="retarget",
            surface="fused",
            reads=("neighbours", "learned_depth_m"),
            noise="depth",
        ),
        *(
            _filled(name=f"auto_fill_{noise}", title=f"auto, filled holes, no mask, {title}", noise=noise)
            for noise, title in NOISES.items()
        ),
        _filled(name="auto_fill_labels", title="auto, filled holes, no mask, labels of the views", labels="views"),
        _filled(
            name="recipe", title="recipe: auto, filled, no mask, labels of the views, + raw", labels="views", mixed=True
        ),
        _AROUND_B,
        _AROUND_A,
        *(
            replace(variant, name=f"{variant.name}_priors", title=f"{variant.title}; camera maps", priors=True)
            for variant in (_RAW, _AUTO, _AROUND_B, _AROUND_A)
        ),
        Variant(name="oracle_labels", title="B's own frames, A's labels", kind="oracle", labels="A"),
        Variant(name="oracle_mixed", title="B's own frames, + raw", kind="oracle", mixed=True),
        Variant(name="oracle_scaled", title="B's own frames, scaled and cropped", kind="oracle", augmented=True),
        Variant(name="oracle", title="B's own frames", kind="oracle"),
    )
}
"""By name, in the order of tables."""
