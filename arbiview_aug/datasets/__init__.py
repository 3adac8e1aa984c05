"""Readers that give samples in this package's format, and wrappers that retarget any dataset's."""

from typing import TYPE_CHECKING

from arbiview_aug.environment import lazy_names

if TYPE_CHECKING:
    from arbiview_aug.datasets.depth_folder import WithDepth as WithDepth
    from arbiview_aug.datasets.drive import LazyFrame as LazyFrame
    from arbiview_aug.datasets.drive import Neighbours as Neighbours
    from arbiview_aug.datasets.frame_folder import FrameFolder as FrameFolder
    from arbiview_aug.datasets.image_io import decode_images as decode_images
    from arbiview_aug.datasets.image_io import reduced_camera as reduced_camera
    from arbiview_aug.datasets.image_io import reduced_rig as reduced_rig
    from arbiview_aug.datasets.nuscenes.reader import NuScenesDataset as NuScenesDataset
    from arbiview_aug.datasets.py123d import Py123dDataset as Py123dDataset
    from arbiview_aug.datasets.registry import open_data as open_data
    from arbiview_aug.datasets.wrappers import MixedDataset as MixedDataset
    from arbiview_aug.datasets.wrappers import RetargetedDataset as RetargetedDataset
    from arbiview_aug.datasets.wrappers import RetargetedIterable as RetargetedIterable
    from arbiview_aug.sample.masks import cleaned_rig as cleaned_rig
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
