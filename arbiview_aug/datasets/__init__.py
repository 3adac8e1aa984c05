"""Readers that give samples in this package's format, and wrappers that retarget any dataset's."""

from arbiview_aug.datasets.frame_folder import FrameFolder
from arbiview_aug.datasets.images import decode_images, reduced_camera, reduced_rig

__all__ = ["FrameFolder", "decode_images", "reduced_camera", "reduced_rig"]
