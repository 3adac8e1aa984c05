"""SyntheticDrive: procedural streets, ray-cast for any rig and lens; depth, classes, boxes, LiDAR-like points."""

from arbiview_aug.datasets.synthetic.dataset import GROUND_CLASSES as GROUND_CLASSES
from arbiview_aug.datasets.synthetic.dataset import RenderedViews as RenderedViews
from arbiview_aug.datasets.synthetic.dataset import SyntheticDrive as SyntheticDrive
from arbiview_aug.datasets.synthetic.dataset import demo_source_rig as demo_source_rig
from arbiview_aug.datasets.synthetic.dataset import demo_target_rig as demo_target_rig
from arbiview_aug.datasets.synthetic.scene import BoxClass as BoxClass
from arbiview_aug.datasets.synthetic.scene import Scene as Scene
from arbiview_aug.datasets.synthetic.scene import SceneClass as SceneClass
from arbiview_aug.datasets.synthetic.street import make_scene as make_scene
