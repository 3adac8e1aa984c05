"""Re-render the labelled camera samples of one vehicle as the cameras of another would have seen them."""

from arbiview_aug.boxes_2d import ImageBoxes, project_boxes_3d
from arbiview_aug.camera import Camera
from arbiview_aug.datasets.wrappers import MixedDataset, RetargetedDataset, RetargetedIterable
from arbiview_aug.errors import ArbiviewError, CalibrationError, DataError, SampleError, SampleTypeError
from arbiview_aug.favs.config import FavsConfig, PaperConfig
from arbiview_aug.favs.refinement import RefinementCache
from arbiview_aug.random_rig import RandomRig
from arbiview_aug.resizing import CropRig, ResizeRig
from arbiview_aug.rig import Rig, load_rig, shipped_rigs
from arbiview_aug.transforms import RigRetarget

__all__ = [
    "ArbiviewError",
    "CalibrationError",
    "Camera",
    "CropRig",
    "DataError",
    "FavsConfig",
    "ImageBoxes",
    "MixedDataset",
    "PaperConfig",
    "RandomRig",
    "RefinementCache",
    "ResizeRig",
    "RetargetedDataset",
    "RetargetedIterable",
    "Rig",
    "RigRetarget",
    "SampleError",
    "SampleTypeError",
    "load_rig",
    "project_boxes_3d",
    "shipped_rigs",
]
