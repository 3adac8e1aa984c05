"""Importing this registers ``RigRetargetMultiView``: for ``custom_imports`` of an mmengine config."""

from mmengine.registry import TRANSFORMS

from integrations.mmdet3d.transform import register

register(TRANSFORMS)
