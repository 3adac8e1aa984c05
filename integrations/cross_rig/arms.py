"""The arms of the experiment, by name."""

from __future__ import annotations

from collections.abc import Sequence

from integrations.cross_rig.arm import Arm, Geometry

_ALL: tuple[Geometry, ...] = ("points", "boxes_3d")
ARMS: dict[str, Arm] = {
    arm.name: arm
    for arm in (
        Arm(name="raw", title="raw A", kind="raw"),
        Arm(name="scale_crop", title="raw A, scaled and cropped", kind="raw", augmented=True),
        Arm(name="row_split", title="row split", kind="row_split"),
        Arm(name="far", title="far", kind="retarget", surface="far"),
        Arm(name="street", title="street", kind="retarget", surface="street"),
        Arm(name="objects", title="objects", kind="retarget", surface="objects", reads=("boxes_3d",)),
        Arm(name="points", title="lidar, no boxes", kind="retarget", surface="lidar", reads=("points",)),
        Arm(name="auto", title="auto: LiDAR, boxes", kind="retarget", surface="auto", reads=_ALL),
        Arm(name="same_height", title="street at A's heights", kind="retarget", surface="street", stays="height"),
        Arm(
            name="same_height_mixed",
            title="street at A's heights, + raw",
            kind="retarget",
            surface="street",
            stays="height",
            mixed=True,
        ),
        Arm(name="same_centre", title="street at A's centres", kind="retarget", surface="street", stays="centre"),
        Arm(name="far_mixed", title="far + raw", kind="retarget", surface="far", mixed=True),
        Arm(name="depth", title="true depth", kind="retarget", surface="lidar", reads=("depth_m",)),
        Arm(name="street_mixed", title="street + raw", kind="retarget", surface="street", mixed=True),
        Arm(
            name="objects_mixed",
            title="objects + raw",
            kind="retarget",
            surface="objects",
            reads=("boxes_3d",),
            mixed=True,
        ),
        Arm(name="auto_mixed", title="auto + raw", kind="retarget", reads=_ALL, mixed=True),
        Arm(name="auto_black", title="auto, black holes, no mask", kind="retarget", reads=_ALL, masked=False),
        Arm(
            name="auto_fill",
            title="auto, filled holes, no mask",
            kind="retarget",
            reads=_ALL,
            holes="fill",
            masked=False,
        ),
        Arm(
            name="auto_fill_mixed",
            title="auto, filled holes, no mask, + raw",
            kind="retarget",
            reads=_ALL,
            holes="fill",
            masked=False,
            mixed=True,
        ),
        Arm(
            name="auto_generated",
            title="auto, generator, no mask",
            kind="retarget",
            reads=_ALL,
            holes="generator",
            masked=False,
        ),
        Arm(name="true_covered", title="auto's holes in B's own frames", kind="retarget", reads=_ALL, truth="covered"),
        Arm(name="true_holes", title="auto, holes filled with the truth", kind="retarget", reads=_ALL, truth="holes"),
        Arm(
            name="auto_neighbours",
            title="auto, near road from other frames",
            kind="retarget",
            reads=(*_ALL, "neighbours"),
        ),
        Arm(name="motion", title="depth from motion", kind="retarget", surface="motion", reads=("neighbours",)),
        Arm(
            name="motion_mixed",
            title="depth from motion, + raw",
            kind="retarget",
            surface="motion",
            reads=("neighbours",),
            mixed=True,
        ),
        Arm(name="random", title="RandomRig around B, auto", kind="retarget", reads=_ALL, random=True),
        Arm(name="oracle", title="B's own frames", kind="oracle"),
    )
}
"""By name, in the order of tables."""


def named_arms(names: Sequence[str]) -> list[Arm]:
    """Arms by name, in the order of ``ARMS``.

    Raises:
        ValueError: An unknown name.
    """
    unknown = [name for name in names if name not in ARMS]
    if unknown:
        raise ValueError(f"arms: expected some of {', '.join(ARMS)}, got {', '.join(unknown)}")
    return [arm for arm in ARMS.values() if arm.name in names]
