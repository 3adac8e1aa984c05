"""Pipeline step for mmdet3d and its relatives; importing this registers it with mmengine where that is installed.

In an mmengine config: ``custom_imports = dict(imports=["arbiview_aug.integrations.mmdet3d"])``.
"""

from importlib.util import find_spec

from arbiview_aug.integrations.mmdet3d.transform import RigRetargetMultiView, register

__all__ = ["RigRetargetMultiView", "register"]

if find_spec("mmengine"):
    from mmengine.registry import TRANSFORMS

    register(TRANSFORMS)
