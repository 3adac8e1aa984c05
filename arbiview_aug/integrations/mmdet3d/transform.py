"""``RigRetargetMultiView``: a pipeline step for mmdet3d and its relatives, of one frame or of several."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arbiview_aug import CalibrationError, RandomRig, Rig, RigRetarget, SampleError, SampleKeys
from arbiview_aug.cameras.random_rig import Epochs, names_in, sequence_rng
from arbiview_aug.choices import is_number
from arbiview_aug.integrations.mmdet3d.bevdet import MEAN_STD, Norm, checked_norm, retarget_img_inputs
from arbiview_aug.integrations.mmdet3d.results import check_no_lenses, retarget_results


class RigRetargetMultiView:
    """Re-renders the images of a ``results`` dict as another vehicle's cameras, and rewrites all that describes them.

    Points become those of the target's scanners, if it has any; ``keys=dict(points="source")`` keeps them.

    It stands right after what loads images (and points and annotations, where they are loaded: geometry), before
    resizing, cropping, flipping and whatever turns points and boxes. Several frames in one dict (BEVDet4D) share one
    draw of ``p`` and of a ``RandomRig``. If each frame of a drive passes the pipeline by itself (BEVFormer,
    StreamPETR, Sparse4D), ``sequence_key`` does that.

    Args:
        target: A rig's name, file, ``Rig`` or ``RandomRig``; of pinhole cameras (``Rig.undistorted()``).
        lidar2ego: (4, 4) the LiDAR's pose, where the dataset does not give it (DETR3D, PETR).
        ground_z_m: Height of the road in the source's ego frame: 0 in nuScenes and Waymo, -0.33 in Argoverse 2.
        img_norm: Means and standard deviations (three each) of BEVDet's normalisation.
        sequence_key: Names the drive in the results (``scene_token``; Sparse4D: ``aug_config``): frames where it is
            equal share one draw, in all workers of a DataLoader's epoch. By default that of a
            ``RandomRig(per="sequence")``; else each dict has its own draw. The training loop calls ``set_epoch``
            before each epoch without workers or with persistent ones: else every epoch repeats the draws.
        settings: Any of ``RigRetarget``'s: ``size``, ``geometry``, ``quality``, ``p``, ``match_exposure``,
            ``holes``, ``keys`` (a dict of ``SampleKeys``' values in a config file).

    Raises:
        CalibrationError: A target with lenses, or that cannot be loaded; a pose of another shape.
        ValueError: Numbers or keys that are none.
    """

    _refuses_lenses = True  # at once, not with the first images

    def __init__(
        self,
        target: str | Path | Rig | RandomRig,
        *,
        lidar2ego: Any = None,
        ground_z_m: float = 0.0,
        img_norm: Norm = MEAN_STD,
        sequence_key: str | None = None,
        **settings: Any,
    ) -> None:
        if isinstance(keys := settings.get("keys"), Mapping):
            if unknown := {*keys} - {*SampleKeys.__dataclass_fields__}:
                raise ValueError(f"keys: expected values of SampleKeys, got {', '.join(map(str, unknown))}")
            settings["keys"] = SampleKeys(**keys)
        if not is_number(ground_z_m):
            raise ValueError(f"ground_z_m: expected a height in metres, got {ground_z_m!r}")
        if lidar2ego is not None and np.shape(lidar2ego) != (4, 4):
            raise CalibrationError(f"lidar2ego: expected a pose (4, 4), got shape {np.shape(lidar2ego)}")
        self.retarget = RigRetarget(target, **settings)
        held = self.retarget.target
        rig = held.base if isinstance(held, RandomRig) else held
        if self._refuses_lenses:
            check_no_lenses([camera.lens for camera in rig])
        self.names = rig.names
        self.lidar2ego = lidar2ego
        self.ground_z_m = float(ground_z_m)
        self.img_norm = checked_norm(img_norm)
        by_target = held.sequence_key if isinstance(held, RandomRig) and held.per == "sequence" else None
        self.sequence_key = sequence_key or by_target
        self._epochs = held if isinstance(held, RandomRig) else Epochs()

    def set_epoch(self, epoch: int) -> None:
        """Change the draws by ``sequence_key``, also in running workers; as ``RandomRig.set_epoch``."""
        self._epochs.set_epoch(epoch)

    def __call__(self, results: Mapping[str, Any]) -> dict[str, Any]:
        """A new ``results`` dict: see ``retarget_results`` and ``retarget_img_inputs``."""
        options: dict[str, Any] = {"names": self.names, "ground_z_m": self.ground_z_m}
        if "img_inputs" in results:
            params = self.draw({**(results.get("curr") or {}), **results})
            return retarget_img_inputs(results, self.retarget, params, mean_std=self.img_norm, **options)
        retarget = partial(self.retarget, params=self.draw(results))
        return retarget_results(results, retarget, lidar2ego=self.lidar2ego, **options)

    def rng(self, frame: Mapping[str, Any], use: str = "") -> torch.Generator | None:
        """A generator that is the same for all frames of a sequence; None without ``sequence_key``.

        Raises:
            SampleError: The frame does not name its sequence.
        """
        key = self.sequence_key
        if key is None:
            return None
        if key not in frame:
            raise SampleError(f"sequence_key: expected {key!r} in the results, got {', '.join(map(str, frame))}")
        return sequence_rng(f"{', '.join(map(str, names_in(key, frame[key])))}{use}", self._epochs.epoch)

    def draw(self, frame: Mapping[str, Any]) -> dict[str, float]:
        """``retarget_params`` of a frame; those of all frames of its sequence with ``sequence_key``."""
        return self.retarget.draw(self.rng(frame))

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.retarget.extra_repr()})"


def register(registry: Any) -> None:
    """Make the step known to a registry: mmengine's ``TRANSFORMS``, or ``PIPELINES`` of mmdet 2.

    Registering twice, as when a config is loaded again, is allowed.
    """
    registry.register_module(name="RigRetargetMultiView", force=True, module=RigRetargetMultiView)
