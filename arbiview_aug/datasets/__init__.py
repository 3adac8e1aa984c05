"""Readers that give samples in this package's format, and wrappers that retarget any dataset's."""

from arbiview_aug.datasets.depth_folder import WithDepth, WithMotionDepth
from arbiview_aug.datasets.drive import LazyFrame, Neighbours
from arbiview_aug.datasets.frame_folder import FrameFolder
from arbiview_aug.datasets.image_io import decode_images, reduced_camera, reduced_rig
from arbiview_aug.datasets.nuscenes.reader import NuScenesDataset
from arbiview_aug.datasets.py123d import Py123dDataset
from arbiview_aug.datasets.registry import open_data
from arbiview_aug.datasets.wrappers import MixedDataset, RetargetedDataset, RetargetedIterable
from arbiview_aug.sample.masks import cleaned_rig

__all__ = [
    "FrameFolder",
    "LazyFrame",
    "MixedDataset",
    "Neighbours",
    "NuScenesDataset",
    "Py123dDataset",
    "RetargetedDataset",
    "RetargetedIterable",
    "WithDepth",
    "WithMotionDepth",
    "cleaned_rig",
    "decode_images",
    "open_data",
    "reduced_camera",
    "reduced_rig",
]
