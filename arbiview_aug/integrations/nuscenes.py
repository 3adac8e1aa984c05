"""All that training from a nuScenes root takes: the reader, the retargeting wrapper, 2D labels for the new views."""

from arbiview_aug.datasets.nuscenes.reader import NuScenesDataset
from arbiview_aug.datasets.wrappers import RetargetedDataset
from arbiview_aug.sample.boxes_2d import project_boxes_3d

__all__ = ["NuScenesDataset", "RetargetedDataset", "project_boxes_3d"]
