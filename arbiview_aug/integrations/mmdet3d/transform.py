"""``RigRetargetMultiView``: a pipeline step for mmdet3d and its relatives, of one frame or of several; BEVDet's form.

BEVDet's images in ``img_inputs`` are resized, cropped, perhaps flipped, turned, and normalised already.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arbiview_aug import CalibrationError, RandomRig, Rig, RigRetarget, SampleError, SampleKeys
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.random_rig import Epochs, names_in, sequence_rng
from arbiview_aug.cameras.rotations import poses_from, quaternion_from_rotation
from arbiview_aug.cameras.validation import checked_array
from arbiview_aug.choices import is_number
from arbiview_aug.integrations.mmdet3d.matrices import ResultCameras, padded, upper_triangular
from arbiview_aug.integrations.mmdet3d.results import (
    check_no_lenses,
    geometry,
    retarget_results,
    scanned,
    source_rig,
    target_outputs,
    target_views,
    without_stale,
)

Norm = tuple[Sequence[float], Sequence[float]]
"""Three means and three standard deviations: normalised images are (grey level − mean) / std."""

MEAN_STD: Norm = ((123.675, 116.28, 103.53), (58.395, 57.12, 57.375))
"""Mean and deviation of BEVDet's ``mmlabNormalize``, in the order of the channels it leaves."""


class RigRetargetMultiView:
    """Re-renders the images of a ``results`` dict as another vehicle's cameras, and rewrites all that describes them.

    Points become those of the target's scanners, if it has any; ``keys=dict(points="source")`` keeps them.

    Place it right after the steps that load images, and points and annotations, if any (they are the geometry), before
    resizing, cropping, flipping, and steps that turn points and boxes. Several frames in one dict (BEVDet4D) share one
    draw of ``p`` and of a ``RandomRig``. If each frame of a drive passes the pipeline separately (BEVFormer,
    StreamPETR, Sparse4D), set ``sequence_key`` for that.

    Args:
        target: A rig's name, file, ``Rig`` or ``RandomRig``; of pinhole cameras (``Rig.undistorted()``).
        lidar2ego: (4, 4) the LiDAR's pose, where the dataset does not give it (DETR3D, PETR).
        ground_z_m: Height of the road in the source's ego frame: 0 in nuScenes and Waymo, -0.33 in Argoverse 2.
        img_norm: Means and standard deviations (three each) of BEVDet's normalisation.
        sequence_key: Names the drive in the results (``scene_token``; Sparse4D: ``aug_config``): frames where it is
            equal share one draw, in all workers of a DataLoader's epoch. By default that of a
            ``RandomRig(per="sequence")``; else each dict is drawn separately. The training loop calls ``set_epoch``
            before each epoch without workers or with persistent ones: else every epoch repeats the draws.
        settings: Any of ``RigRetarget``'s: ``size``, ``geometry``, ``quality``, ``p``, ``match_exposure``,
            ``holes``, ``keys`` (a dict of ``SampleKeys``' values in a config file).

    Raises:
        CalibrationError: A target with lenses, or that cannot be loaded; a pose of another shape.
        ValueError: Values that are not numbers, or unknown keys.
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
        chosen = self.retarget.target
        rig = chosen.base if isinstance(chosen, RandomRig) else chosen
        if self._refuses_lenses:
            check_no_lenses([camera.lens for camera in rig])
        self.names = rig.names
        self.lidar2ego = lidar2ego
        self.ground_z_m = float(ground_z_m)
        expected = "three means and three positive stds"
        norm = checked_array("", "img_norm", img_norm, (2, 3), expected, lambda numbers: (numbers[1] > 0).all())
        self.img_norm = tuple(norm.tolist())
        by_target = chosen.sequence_key if isinstance(chosen, RandomRig) and chosen.per == "sequence" else None
        self.sequence_key = sequence_key or by_target
        self._epochs = chosen if isinstance(chosen, RandomRig) else Epochs()

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


def register(registry: Any) -> None:
    """Register the step with mmengine's ``TRANSFORMS`` or mmdet 2's ``PIPELINES``; registering twice is allowed."""
    registry.register_module(name="RigRetargetMultiView", force=True, module=RigRetargetMultiView)


# --- BEVDet's form ----------------------------------------------------------------------------------------------------
_ROUNDING = 0.01
"""Grey levels of 255 by which a pixel that was normalised in float32 may miss a whole number."""

_KEY_CAMERA = "CAM_FRONT"
_FORM = "(imgs, sensor2egos, ego2globals, intrins, post_rots, post_trans[, bda])"


def retarget_img_inputs(
    results: Mapping[str, Any],
    retarget: Callable[[dict[str, Any], Mapping[str, float]], dict[str, Any]],
    params: Mapping[str, float],
    *,
    names: Sequence[str],
    ground_z_m: float = 0.0,
    mean_std: Norm = MEAN_STD,
) -> dict[str, Any]:
    """Re-render ``img_inputs`` of one frame (BEVDet) or several (BEVDet4D, BEVStereo4D), and what belongs to it.

    ``results`` are as ``PrepareImageInputs`` leaves them, the current frame first: images by camera, then by frame; all
    else by frame, then by camera. The source cameras are those of the augmented images: resizing, cropping, flipping
    and turning are part of their K and pose. The target's images are not augmented: ``post_rots`` are ones,
    ``post_trans`` zeros. ``ann_infos`` are read as geometry and stay; ``points`` become those of the target's scanners.

    Poses of target cameras are those at ``CAM_FRONT``'s time (the first camera's, without one of that name): that is
    the ego frame of BEVDet's boxes, and ``ego2globals[0]`` becomes its key ego frame. With the LiDAR's pose, boxes of a
    moving vehicle would be off by its motion in between.
    """
    inputs = results["img_inputs"]
    tensors = _checked(inputs)
    infos = [results.get("curr"), *(results.get("adjacent") or ())]
    total = len(tensors[0])
    in_source = list(results.get("cam_names") or [f"camera {k}" for k in range(total // len(infos))])
    if not in_source or not total or total % len(in_source):
        raise SampleError(f"img_inputs: expected {len(in_source)} images a frame, as 'cam_names' says, got {total}")
    count = total // len(in_source)
    size = tensors[0].shape[-2], tensors[0].shape[-1]
    key = in_source.index(_KEY_CAMERA) if _KEY_CAMERA in in_source else 0
    outputs: list[list[torch.Tensor]] = []
    outs: list[Mapping[str, Any]] = []
    changed = without_stale(results, silently="canvas")  # the images before they were normalised, for people
    for t in range(count):
        rows = slice(t * len(in_source), (t + 1) * len(in_source))
        images, *frame = tensors[0][t::count], *(tensor[rows] for tensor in tensors[1:])
        info = infos[t] if t < len(infos) else None
        key2global = frame[1][key].double().numpy()
        try:
            mirrored, source = _as_recorded(frame, in_source, key2global, size[1])
        except np.linalg.LinAlgError:
            matrices = "sensor2egos, ego2globals, intrins and post_rots"
            raise SampleError(f"img_inputs: expected {matrices} that can be inverted, got a singular one") from None
        grey = levels(images, mean_std)
        views = [image.flip(-1) if flip else image for image, flip in zip(grey, mirrored, strict=True)]
        sample = {"images": torch.stack(views), "rig": source_rig(source, views, ground_z_m)}
        lidar2key = _lidar2key(info, key2global) if t == 0 else None
        points = {} if lidar2key is None else geometry({"points": results.get("points")}, lidar2key)
        out = retarget(sample | points | _boxes(results if t == 0 else info), params)
        target = target_views(out, source, names)
        if lidar2key is not None:
            changed |= scanned(changed, out, lidar2key)
        outputs.append(_entries(out["images"], target, [images, *frame], mean_std))
        outs.append(out)
        if isinstance(info, Mapping) and "cams" in info:
            infos[t] = {**info, "cams": _infos(target, key2global)}
    images = torch.stack([entries[0] for entries in outputs], dim=1).flatten(0, 1)
    rest = [torch.cat(frames) for frames in zip(*(entries[1:] for entries in outputs), strict=True)]
    changed["img_inputs"] = type(inputs)([images, *rest, *inputs[6:]])
    if "cam_names" in results:
        changed["cam_names"] = list(target.names)
    changed |= {key: info for key, info in (("curr", infos[0]), ("adjacent", infos[1:])) if key in results}
    return changed | target_outputs(outs)


def _entries(
    images: torch.Tensor, target: ResultCameras, like: Sequence[torch.Tensor], mean_std: Norm
) -> list[torch.Tensor]:
    """The six entries of a frame of target cameras, in the types of the source's; nothing is augmented."""
    count = len(target.names)
    values = (
        normalised(images, mean_std),
        torch.from_numpy(target.cam2ego),
        torch.from_numpy(target.ego2global).expand(count, -1, -1).clone(),
        torch.from_numpy(target.K),
        torch.eye(3).expand(count, -1, -1).clone(),
        torch.zeros(count, 3),
    )
    return [value.to(source) for value, source in zip(values, like, strict=True)]


def _checked(inputs: Any) -> list[torch.Tensor]:
    if not isinstance(inputs, list | tuple) or len(inputs) not in (6, 7):
        got = len(inputs) if isinstance(inputs, list | tuple) else type(inputs).__name__
        raise SampleError(f"img_inputs: expected {_FORM}, got {got} entries")
    tensors = list(inputs[:6])
    count = len(tensors[0])
    shapes = [tuple(tensor.shape[1:]) for tensor in tensors]
    if shapes[1:] != [(4, 4), (4, 4), (3, 3), (3, 3), (3,)] or len(shapes[0]) != 3:
        raise SampleError(f"img_inputs: expected {_FORM} for each camera, got shapes {shapes}")
    if any(len(tensor) != count for tensor in tensors):
        raise SampleError(f"img_inputs: expected {count} cameras in each entry, got {[len(t) for t in tensors]}")
    return tensors


def _as_recorded(
    frame: Sequence[torch.Tensor], names: Sequence[str], key2global: FloatArray, width_px: int
) -> tuple[list[bool], ResultCameras]:
    """Flags of mirrored images, and the cameras of all images with these mirrored back."""
    sensor2ego, ego2global, intrinsics, post_rots, post_trans = (entry.double().numpy() for entry in frame)
    moved = np.tile(np.eye(3), (len(names), 1, 1))
    moved[:, :2, :2], moved[:, :2, 2] = post_rots[:, :2, :2], post_trans[:, :2]
    # They move pixels as PIL does, whose outer edges are 0 and w; those of ``Camera`` are -0.5 and w - 0.5.
    half = np.eye(3)
    half[:2, 2] = 0.5
    moved = np.linalg.inv(half) @ moved @ half
    mirrored = np.linalg.det(moved[:, :2, :2]) < 0
    moved[mirrored] = np.array([[-1.0, 0, width_px - 1], [0, 1, 0], [0, 0, 1]]) @ moved[mirrored]
    K, turned = upper_triangular(moved @ intrinsics)
    cam2ego = (np.linalg.inv(key2global) @ ego2global) @ sensor2ego @ np.linalg.inv(padded(turned))
    return mirrored.tolist(), ResultCameras(names, K / K[:, 2:, 2:], cam2ego, np.eye(4), key2global)


def _boxes(info: Any) -> dict[str, torch.Tensor]:
    """``boxes_3d`` of ``ann_infos``, (B, 9): gravity centre, length, width, height, yaw, in the key ego frame."""
    annotated = info.get("ann_infos") if isinstance(info, Mapping) else None
    if not isinstance(annotated, list | tuple) or len(annotated) != 2:
        return {}
    boxes = np.asarray(annotated[0], np.float64).reshape(len(annotated[0]), -1)[:, :7]
    return {"boxes_3d": torch.from_numpy(boxes.reshape(-1, 7)).float()}


def _lidar2key(info: Any, key2global: FloatArray) -> FloatArray | None:
    """(4, 4) from the LiDAR's frame to the key ego frame; None where the frame's info does not pose it."""
    poses = ("ego2global", "lidar2ego")
    if not isinstance(info, Mapping) or not all(f"{name}_rotation" in info for name in poses):
        return None
    key2ego = np.linalg.inv(key2global)
    ego2global, lidar2ego = (
        poses_from(np.array([*info[f"{name}_translation"], *info[f"{name}_rotation"]], np.float64)) for name in poses
    )
    return np.asarray(key2ego @ ego2global @ lidar2ego)


def _infos(target: ResultCameras, key2global: FloatArray) -> dict[str, dict[str, Any]]:
    """Entries of ``curr["cams"]`` that ``PointToMultiViewDepth`` reads."""

    def pose(prefix: str, matrix: FloatArray) -> dict[str, Any]:
        quaternion = quaternion_from_rotation(matrix[:3, :3])
        return {f"{prefix}_rotation": quaternion.tolist(), f"{prefix}_translation": matrix[:3, 3].tolist()}

    ego_pose = pose("ego2global", key2global)
    return {
        name: {"data_path": name, "cam_intrinsic": K, **pose("sensor2ego", cam2ego), **ego_pose}
        for name, K, cam2ego in zip(target.names, target.K, target.cam2ego, strict=True)
    }


# --- grey levels ------------------------------------------------------------------------------------------------------
def levels(images: torch.Tensor, norm: Norm) -> torch.Tensor:
    """Normalised images (..., 3, h, w) as uint8; SampleError for what was not 8 bit images normalised so."""
    mean, std = (torch.tensor(numbers, dtype=torch.float64)[:, None, None] for numbers in norm)
    grey = images.double() * std + mean
    whole = grey.round()
    off = float((grey - whole).abs().max())
    if not (off <= _ROUNDING and whole.min() >= 0 and whole.max() <= 255):  # NaN too
        raise SampleError(
            f"img_inputs: expected 8 bit images normalised by mean and std {norm}, got grey levels {off:.2g} off whole "
            f"numbers, from {grey.min():.1f} to {grey.max():.1f}; pass img_norm=(mean, std), and retarget before "
            "photometric distortion"
        )
    return whole.to(torch.uint8)


def normalised(images: torch.Tensor, norm: Norm) -> torch.Tensor:
    """Images (..., 3, h, w) uint8 as (grey level − mean) / std, float32."""
    mean, std = (torch.tensor(numbers, dtype=torch.float32)[:, None, None] for numbers in norm)
    return (images.float() - mean) / std
