"""``RigRetargetMultiView``: a pipeline step for mmdet3d, BEVFusion, BEVDet, DETR3D and PETR."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from arbiview_aug import RandomRig, Rig, RigRetarget
from arbiview_aug.integrations.mmdet3d.bevdet import MEAN_STD, retarget_img_inputs
from arbiview_aug.integrations.mmdet3d.results import check_no_lenses, retarget_results


class RigRetargetMultiView:
    """Re-renders the images of a ``results`` dict as another vehicle's cameras, and rewrites all that describes them.

    It stands right after what loads images (and points and annotations, where they are loaded: geometry), before
    resizing, cropping, flipping and whatever turns points and boxes.

    Args:
        target: A rig's name, file, ``Rig`` or ``RandomRig``; of pinhole cameras (``Rig.undistorted()``).
        lidar2ego: (4, 4) the LiDAR's pose, where the dataset does not give it (DETR3D, PETR).
        ground_z_m: Height of the road in the source's ego frame: 0 in nuScenes and Waymo, -0.33 in Argoverse 2.
        img_norm: Means and standard deviations (three each) of BEVDet's normalisation.
        settings: Any of ``RigRetarget``'s: ``size``, ``surface``, ``quality``, ``p``, ``harmonise``, ``holes``,
            ``outputs``.

    Raises:
        CalibrationError: A target with lenses, or that cannot be loaded.
    """

    def __init__(
        self,
        target: str | Path | Rig | RandomRig,
        *,
        lidar2ego: Any = None,
        ground_z_m: float = 0.0,
        img_norm: tuple[Sequence[float], Sequence[float]] = MEAN_STD,
        **settings: Any,
    ) -> None:
        self.retarget = RigRetarget(target, **settings)
        held = self.retarget.target
        rig = held.base if isinstance(held, RandomRig) else held
        check_no_lenses([camera.lens for camera in rig])
        self.names = rig.names
        self.lidar2ego, self.ground_z_m, self.img_norm = lidar2ego, float(ground_z_m), img_norm

    def __call__(self, results: Mapping[str, Any]) -> dict[str, Any]:
        """A new ``results`` dict: see ``retarget_results`` and, with ``img_inputs``, ``retarget_img_inputs``."""
        if "img_inputs" in results:
            return retarget_img_inputs(
                results, self.retarget, names=self.names, ground_z_m=self.ground_z_m, mean_std=self.img_norm
            )
        return retarget_results(
            results, self.retarget, names=self.names, lidar2ego=self.lidar2ego, ground_z_m=self.ground_z_m
        )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.retarget.extra_repr()})"


def register(registry: Any) -> None:
    """Make the step known to a registry: mmengine's ``TRANSFORMS``, or ``PIPELINES`` of mmdet 2.

    Registering twice, as when a config is loaded again, is allowed.
    """
    registry.register_module(name="RigRetargetMultiView", force=True, module=RigRetargetMultiView)
