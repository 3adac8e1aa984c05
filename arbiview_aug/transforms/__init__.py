"""Transforms of samples; explanations and scanners are imported where they are asked for."""

from typing import TYPE_CHECKING

from arbiview_aug.environment import lazy_names

if TYPE_CHECKING:
    from arbiview_aug.transforms.scans import RetargetedPoints as RetargetedPoints
    from arbiview_aug.transforms.scans import describe_points as describe_points
    from arbiview_aug.transforms.scans import entries_of as entries_of
    from arbiview_aug.transforms.scans import retarget_frames as retarget_frames
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
