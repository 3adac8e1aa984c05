"""Re-render the labelled camera samples of one vehicle as the cameras of another would have seen them."""

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.random_rig import RandomRig
from arbiview_aug.cameras.rig import Rig, load_rig, shipped_rigs
from arbiview_aug.datasets.wrappers import MixedDataset, RetargetedDataset, RetargetedIterable
from arbiview_aug.errors import ArbiviewError, CalibrationError, DataError, SampleError, SampleTypeError
from arbiview_aug.favs.config import FavsConfig, PaperConfig
from arbiview_aug.render.refinement import RefinementCache
from arbiview_aug.sample.boxes_2d import ImageBoxes, project_boxes_3d
from arbiview_aug.sample.collate import collate
from arbiview_aug.sample.mistakes import CheckReport, Finding, check
from arbiview_aug.sample.training import lift_mask, visible_boxes
from arbiview_aug.transforms.resize import CropRig, ResizeRig
from arbiview_aug.transforms.rig_retarget import RigRetarget

__version__ = "0.2.0"
__all__ = [
    "ArbiviewError",
    "CalibrationError",
    "Camera",
    "CheckReport",
    "CropRig",
    "DataError",
    "FavsConfig",
    "Finding",
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
    "check",
    "collate",
    "lift_mask",
    "load_rig",
    "project_boxes_3d",
    "shipped_rigs",
    "visible_boxes",
]
