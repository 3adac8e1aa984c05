"""SyntheticDrive: procedural streets, ray-cast for any rig and lens; depth, classes, boxes, LiDAR-like points."""

from arbiview_aug.datasets.synthetic.dataset import (
    GROUND_CLASSES,
    RenderedViews,
    SyntheticDrive,
    demo_source_rig,
    demo_target_rig,
)
from arbiview_aug.datasets.synthetic.scene import BoxClass, Scene, SceneClass
from arbiview_aug.datasets.synthetic.street import make_scene

__all__ = [
    "GROUND_CLASSES",
    "BoxClass",
    "RenderedViews",
    "Scene",
    "SceneClass",
    "SyntheticDrive",
    "demo_source_rig",
    "demo_target_rig",
    "make_scene",
]
