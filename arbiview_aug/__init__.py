"""Re-render the labelled camera samples of one vehicle as the cameras of another would have seen them."""

from typing import TYPE_CHECKING

from arbiview_aug.environment import lazy_names

if TYPE_CHECKING:
    from arbiview_aug.cameras.camera import Camera as Camera
    from arbiview_aug.cameras.lidar import Lidar as Lidar
    from arbiview_aug.cameras.random_rig import RandomRig as RandomRig
    from arbiview_aug.cameras.rig import Rig as Rig
    from arbiview_aug.cameras.rig import load_rig as load_rig
    from arbiview_aug.cameras.shipped import shipped_rigs as shipped_rigs
    from arbiview_aug.cameras.validation import Finding as Finding
    from arbiview_aug.datasets.wrappers import MixedDataset as MixedDataset
    from arbiview_aug.datasets.wrappers import RetargetedDataset as RetargetedDataset
    from arbiview_aug.datasets.wrappers import RetargetedIterable as RetargetedIterable
    from arbiview_aug.errors import ArbiviewError as ArbiviewError
    from arbiview_aug.errors import CalibrationError as CalibrationError
    from arbiview_aug.errors import DataError as DataError
    from arbiview_aug.errors import GeometryWarning as GeometryWarning
    from arbiview_aug.errors import SampleError as SampleError
    from arbiview_aug.errors import SampleTypeError as SampleTypeError
    from arbiview_aug.evaluate.report.pictures import show as show
    from arbiview_aug.favs.config import PaperConfig as PaperConfig
    from arbiview_aug.render.export import export_plan as export_plan
    from arbiview_aug.render.plan import RenderConfig as RenderConfig
    from arbiview_aug.sample.boxes_2d import ImageBoxes as ImageBoxes
    from arbiview_aug.sample.boxes_2d import project_boxes_3d as project_boxes_3d
    from arbiview_aug.sample.mistakes import CheckReport as CheckReport
    from arbiview_aug.sample.mistakes import check as check
    from arbiview_aug.sample.training import collate as collate
    from arbiview_aug.sample.training import depth_maps as depth_maps
    from arbiview_aug.transforms.rig_retarget import RigRetarget as RigRetarget
    from arbiview_aug.transforms.scans import retarget_points as retarget_points
    from arbiview_aug.transforms.settings import PlanCache as PlanCache
    from arbiview_aug.transforms.settings import SampleKeys as SampleKeys
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)

__version__ = "0.4.0"
