"""Cameras that keep their height where nothing is known of what stands on the street, and only heights differ.

Seen from another height over a static surface, an object's foot lands right and its top is painted onto the road or the
house behind it. A detector that was trained on such views alone was worse than one trained on untouched images, by 3.2
points of IoU for cameras 0.7 m higher and by 3.6 on a Waymo-like rig; with half of the frames untouched it was better,
by 1.0 and 1.2 (``integrations/cross_rig``). So cameras move where samples are mixed. Where they are not, and the target
is the source but for the heights, the source's heights make it the source again, and nothing is lost. Where the layout
differs too that does not help: 6.3 points below untouched images at the source's heights.
"""

from __future__ import annotations

import numpy as np

from arbiview_aug.camera import Camera
from arbiview_aug.rig import Rig

MOVED_M = 0.2
"""A target camera farther than this from every source matters where only the static street is known: what stands 10 m
away shifts by more than a degree, and the street does not know that it stands there."""

_TURNED_DEG = 3.0
"""Between axes of one camera on two vehicles of one layout: what mounting varies by."""


def only_heights_differ(source: Rig, target: Rig) -> bool:
    """Whether the target's cameras are the source's, each over one of its own, but for heights and what lenses see.

    Args:
        source: The rig that recorded the images.
        target: The rig to render, in its own ego frame.
    """
    level = at_source_heights(source, target)
    twins = [most_alike(source, camera) for camera in level]
    cosines = [float(one.cam2ego[:3, 2] @ two.cam2ego[:3, 2]) for one, two in zip(level, twins, strict=True)]
    apart_m = [float(np.linalg.norm(one.center_m - two.center_m)) for one, two in zip(level, twins, strict=True)]
    return max(apart_m) <= MOVED_M and min(cosines) >= np.cos(np.radians(_TURNED_DEG))


def at_source_heights(source: Rig, target: Rig) -> Rig:
    """The target with its cameras at the height of the source's, where theirs differs by more than ``MOVED_M``.

    Each takes the height of the source camera that looks most alike.

    Args:
        source: The rig that recorded the images.
        target: The rig to render, in its own ego frame.

    Returns:
        A rig in the source's ego frame.
    """
    target = target.in_frame_of(source)
    cameras = []
    for camera in target:
        lift_m = float(camera.center_m[2] - most_alike(source, camera).center_m[2])
        cameras.append(camera.shifted(z_m=-lift_m) if abs(lift_m) > MOVED_M else camera)
    return target.with_cameras(cameras)


def most_alike(rig: Rig, camera: Camera) -> Camera:
    """The camera of a rig whose optical axis is nearest to that of another one, both in one ego frame."""
    return max(rig, key=lambda one: float(one.cam2ego[:3, 2] @ camera.cam2ego[:3, 2]))


def lifts_m(asked: Rig, rendered: Rig) -> list[float]:
    """By how much each camera was asked for higher than it is rendered, metres.

    Args:
        asked: A target rig, in its own ego frame.
        rendered: The same in a source's ego frame.
    """
    asked = asked.in_frame_of(rendered)
    return [float(a.center_m[2] - r.center_m[2]) for a, r in zip(asked, rendered, strict=True)]
