"""Depth from other frames of a drive; imported where a geometry needs it."""

from typing import TYPE_CHECKING

from arbiview_aug.environment import lazy_names

if TYPE_CHECKING:
    from arbiview_aug.temporal.motion_depth import MotionDepth as MotionDepth
    from arbiview_aug.temporal.motion_depth import brings_motion as brings_motion
    from arbiview_aug.temporal.motion_depth import estimate_motion as estimate_motion
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
