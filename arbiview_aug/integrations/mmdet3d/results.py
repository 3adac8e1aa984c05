"""The core: a ``results`` dict of one frame in, the same dict of the target's cameras out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.rotations import rotation_from_quaternion
from arbiview_aug.errors import CalibrationError, SampleError, SampleTypeError, warn
from arbiview_aug.integrations.mmdet3d.matrices import (
    MATRICES,
    ResultCameras,
    entry,
    is_transposed,
    like_array,
    like_given,
    padded,
    read_views,
    stacked,
)
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.scene.surface import Points
from arbiview_aug.transforms.scans import COUNTS_KEY, RINGS_KEY

STALE_KEYS = (
    *("cam_instances", "gt_bboxes", "gt_bboxes_labels", "bboxes", "bboxes_ignore", "bboxes2d", "labels2d"),
    *("centers_2d", "centers2d", "depths", "depth_map", "depth_maps", "gt_depth", "canvas"),
    *("gt_masks", "gt_semantic_seg", "gt_seg_map", "seg_label"),
)
"""Keys, also in ``ann_info``, bound to the source's pixels: dropped (``project_boxes_3d`` makes new 2D boxes)."""

FILE_KEYS = ("filename", "img_path", "img_filename", "image_paths")
"""Lists of image files: no file holds the new images, so they become the cameras' names."""

SHAPE_KEYS = ("img_shape", "ori_shape", "pad_shape")

_AS_RECORDED: dict[str, Any] = {
    **dict.fromkeys(("img_aug_matrix", "lidar_aug_matrix", "global_aug_matrix", "bev_flip_matrix"), np.eye(4)),
    **dict.fromkeys(("flip", "pcd_horizontal_flip", "pcd_vertical_flip", "pcd_trans"), 0.0),
    **dict.fromkeys(("flip_x", "flip_y", "noise_rot", "noise_translate"), 0.0),
    **dict.fromkeys(("scale_factor", "pcd_scale_factor", "noise_scale"), 1.0),
    "pcd_rotation": np.eye(3),
}
"""Keys that augmentations write (mmdet3d's, Autoware-ML's, OpenPCDet's), and what they hold where nothing was
augmented: loading steps write that too."""

TARGET_OUTPUTS = ("coverage", "ego_mask", "confidence", "generated", "source_camera", "source_frame", "retarget_params")
"""Entries of a retargeted sample that are added to the results, as arrays."""


def retarget_results(
    results: Mapping[str, Any],
    retarget: Callable[[dict[str, Any]], dict[str, Any]],
    *,
    names: Sequence[str],
    lidar2ego: Any = None,
    ground_z_m: float = 0.0,
) -> dict[str, Any]:
    """Re-render the images of a ``results`` dict, as the loading transforms leave it, and rewrite what describes them.

    All keys of ``MATRICES`` in the dict are rewritten in their container, type and shape, at the top and in ``images``:
    the form is never guessed. Poses of target cameras are those at the LiDAR's time. ``points`` (LiDAR frame) and
    ``gt_bboxes_3d`` are read as geometry. Boxes stay. Points become what the target's scanners would have measured, if
    it has any, in the frame of the LiDAR that recorded.

    Raises:
        SampleTypeError: Images of another form.
        SampleError: Matrices that are missing, contradictory or already augmented; normalised images; target images of
            several sizes.
        CalibrationError: A target with lenses.
    """
    if results.get("img") is None:
        raise SampleError(f"results: expected 'img', loaded images, got {', '.join(map(str, results))}")
    images = to_tensors(results["img"])
    check_as_recorded(results)
    count, infos = len(images), results.get("images")
    by_name: Mapping[str, Any] = infos if isinstance(infos, Mapping) and len(infos) == count else {}
    camera_names = [*map(str, by_name)] or [f"camera {k}" for k in range(count)]
    matrices: dict[str, Any] = {}  # of all cameras: at the top, else gathered from ``images``
    for key in MATRICES:
        if results.get(key) is not None and not _is_of_one(results[key]):
            matrices[key] = results[key]
        elif by_name and all(isinstance(info, Mapping) and key in info for info in by_name.values()):
            matrices[key] = [info[key] for info in by_name.values()]
    source = read_views(matrices, count, camera_names, _lidar2ego(results, lidar2ego))
    for k, info in enumerate(by_name.values()):  # mmdet3d pads images of several sizes to the largest
        if isinstance(info, Mapping) and info.get("height") and info.get("width"):
            with entry("images", "height and width in pixels"):
                images[k] = images[k][:, : int(info["height"]), : int(info["width"])]
    out = retarget(
        {"images": images, "rig": source_rig(source, images, ground_z_m), **geometry(results, source.lidar2ego)}
    )
    views = target_views(out, source, names)
    kept = without_stale(results)
    kept["img"] = images_like(results["img"], out["images"])
    _write_numbers(kept, views, out["images"])
    if isinstance(infos, Mapping):
        kept["images"] = _infos(infos, views, out["images"])
        for name, info in by_name.items() if _is_skipped(out) else ():
            if isinstance(info, Mapping):
                kept["images"][str(name)] |= {key: info[key] for key in FILE_KEYS if key in info}
    for key in () if _is_skipped(out) else FILE_KEYS:
        if isinstance(kept.get(key), list | tuple):
            kept[key] = list(views.names)
    if np.ndim(kept.get("img_timestamp", 0.0)) == 1:  # PETR's: all views are of the LiDAR's time
        times_s, time_s = kept["img_timestamp"], kept.get("timestamp")
        with entry("img_timestamp", "seconds"):
            time_s = float(np.mean(np.asarray(times_s)) if time_s is None else time_s)
            kept["img_timestamp"] = like_array(times_s, [time_s] * len(views.names))
    if "num_views" in kept:
        kept["num_views"] = len(views.names)
    return kept | scanned(kept, out, source.lidar2ego) | target_outputs([out])


# --- source -----------------------------------------------------------------------------------------------------------
def _is_of_one(value: Any) -> bool:
    """Whether it is the one matrix that mmdet3d's datasets keep of their ``default_cam_key``."""
    if isinstance(value, list | tuple):
        return len(value) in (3, 4) and np.ndim(value[0]) == 1
    return getattr(value, "ndim", None) == 2


def _lidar2ego(results: Mapping[str, Any], matrix: Any) -> FloatArray:
    for holder in (results.get("lidar_points"), results):
        if isinstance(holder, Mapping) and holder.get("lidar2ego") is not None:
            return stacked("lidar2ego", [holder["lidar2ego"]], 1)[0]
    if "lidar2ego_rotation" in results and "lidar2ego_translation" in results:  # BEVFormer, Sparse4D
        with entry("lidar2ego_rotation, lidar2ego_translation", "a quaternion or (3, 3), and x y z"):
            rotation = np.asarray(results["lidar2ego_rotation"], np.float64)
            lidar2ego = padded((rotation_from_quaternion(rotation) if rotation.shape == (4,) else rotation)[None])[0]
            lidar2ego[:3, 3] = results["lidar2ego_translation"]
        return lidar2ego
    if matrix is None:
        raise SampleError(
            "lidar2ego: expected the LiDAR's pose (4, 4) in results['lidar_points'] or results['lidar2ego'], or "
            "'lidar2ego_rotation' and 'lidar2ego_translation', found none; pass lidar2ego= to the transform"
        )
    return stacked("lidar2ego", [matrix], 1)[0]


def check_as_recorded(results: Mapping[str, Any]) -> None:
    """Refuse frames that are augmented already: SampleError with the key that says so."""
    for key, neutral in _AS_RECORDED.items():
        if results.get(key) is None:
            continue
        with entry(key, f"numbers of shape {neutral.shape}" if isinstance(neutral, np.ndarray) else "numbers"):
            off = np.abs(np.asarray(results[key], np.float64) - neutral).max()
        if not off <= 1e-6:  # NaN too
            fix = "retarget right after loading, before augmentations"
            raise SampleError(f"{key}: expected a frame as it was recorded, got an augmented one; {fix}")


def to_tensors(images: Any) -> list[torch.Tensor]:
    """N tensors (3, H, W) uint8, channels in their order, of N arrays (H, W, 3), tensors (3, H, W) or PIL images.

    Floats are grey levels of 0 to 255, as ``to_float32=True`` loads them, and are rounded.
    """
    if not isinstance(images, list | tuple | np.ndarray | torch.Tensor) or not len(images):
        raise SampleTypeError(f"img: expected a list of (H, W, 3) arrays or PIL images, got {type(images).__name__}")
    tensors = []
    for k, image in enumerate(images):
        if isinstance(image, torch.Tensor) and image.ndim == 3:
            image = image.permute(1, 2, 0).cpu().numpy()
        array = image if isinstance(image, np.ndarray) else np.array(image)  # PIL's own memory is read-only
        if array.ndim != 3 or array.shape[2] != 3 or array.dtype.kind not in "uf":
            fix = "; retarget each frame of a queue in its pipeline, with sequence_key" if array.ndim == 4 else ""
            raise SampleTypeError(f"img[{k}]: expected (H, W, 3), 8 bit or float, got {array.dtype} {array.shape}{fix}")
        if array.dtype != np.uint8:
            low, high = float(array.min()), float(array.max())
            if not (low > -0.5 and high < 255.5):
                raise SampleError(
                    f"img[{k}]: expected grey levels from 0 to 255, got {low:g} to {high:g}; retarget right after "
                    "loading, before photometric distortion and normalisation"
                )
            array = np.rint(array).astype(np.uint8)
        tensors.append(torch.from_numpy(np.ascontiguousarray(array)).permute(2, 0, 1))
    return tensors


def source_rig(views: ResultCameras, images: Sequence[torch.Tensor], ground_z_m: float) -> Rig:
    """The cameras of images (3, H, W)."""
    cameras = [
        Camera(name=name, width_px=image.shape[2], height_px=image.shape[1], K=K, cam2ego=cam2ego)
        for name, K, cam2ego, image in zip(views.names, views.K, views.cam2ego, images, strict=True)
    ]
    return Rig(cameras, ground_z_m=ground_z_m)


def geometry(results: Mapping[str, Any], lidar2ego: FloatArray) -> dict[str, torch.Tensor]:
    """The sample's ``points`` and ``boxes_3d`` in the ego frame, of what the results hold in the LiDAR's.

    Boxes are read by their corners, as the meaning of their numbers differs between mmdet3d's versions. Plain numbers
    (Sparse4D) are gravity centre, length, width, height and yaw. Other shapes are a ``SampleError``.
    """
    values = {}
    points = results.get("points")
    if points is not None:
        values["points"] = moved_points(_rows("points", getattr(points, "tensor", points), 3), lidar2ego)
    annotated = results.get("ann_info")
    boxes = results.get("gt_bboxes_3d", annotated.get("gt_bboxes_3d") if isinstance(annotated, Mapping) else None)
    tensor, rotation = getattr(boxes, "tensor", None), lidar2ego[:3, :3]
    if boxes is None:
        return values
    if tensor is not None and not len(tensor):  # mmdet3d before 1.0 asserts that there are corners
        return values | {"boxes_3d": torch.zeros(0, 7)}
    corners = getattr(boxes, "corners", None)
    if corners is None:
        rows = _rows("gt_bboxes_3d", boxes, 7)
        centres, sizes, yaw = rows[:, :3], rows[:, 3:6].T, rows[:, 6]
        along = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    else:
        # In both conventions corner 1 is above 0. From 1.0 on corner 4 is ahead of 0, at the yaw, and 3 to its left.
        x = np.asarray(corners, np.float64).reshape(-1, 8, 3)
        centres, along, aside = x.mean(axis=1), x[:, 4] - x[:, 0], x[:, 3] - x[:, 0]
        if tensor is not None:  # before 1.0 the x axes, of the width, are at minus the yaw
            yaw, angles = np.asarray(tensor[:, 6], np.float64), np.arctan2(along[:, 1], along[:, 0])
            if np.cos(angles + yaw).sum() > np.cos(angles - yaw).sum() + 1e-6:
                along, aside = -aside, along
        sizes = np.linalg.norm([along, aside, x[:, 1] - x[:, 0]], axis=-1)
    along = along @ rotation.T
    columns = [*(centres @ rotation.T + lidar2ego[:3, 3]).T, *sizes, np.arctan2(along[:, 1], along[:, 0])]
    return values | {"boxes_3d": torch.from_numpy(np.stack(columns, axis=1)).float()}


def _rows(key: str, value: Any, least: int) -> Points:
    array = as_array(key, value)
    if array.shape == (0,):
        array = array.reshape(0, least)
    if array.ndim != 2 or array.shape[1] < least:
        raise SampleError(f"{key}: expected rows of at least {least} numbers, got shape {array.shape}")
    return array


def moved_points(points: Any, pose: FloatArray) -> torch.Tensor:
    """(P, C) float32 of points (P, C), whose first three columns are moved by a pose (4, 4)."""
    moved = np.asarray(points, np.float64).copy()
    moved[:, :3] = moved[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    return torch.from_numpy(moved).float()


# --- target -----------------------------------------------------------------------------------------------------------
def target_views(out: Mapping[str, Any], source: ResultCameras, names: Sequence[str]) -> ResultCameras:
    """The cameras of a retargeted sample, of one size, without lenses, in the source's ego frame."""
    if not isinstance(out["images"], torch.Tensor):
        raise SampleError("target: expected images of one size, got several; pass size=(h, w) to the transform")
    if "ego2ego" in out:
        raise SampleError("SampleKeys.frame: expected 'source', since points and boxes stay in the LiDAR's frame")
    check_no_lenses(out.get("lens", ()))
    return ResultCameras(
        list(source.names if _is_skipped(out) else names),
        out["K"].double().numpy(),
        out["cam2ego"].double().numpy(),
        source.lidar2ego,
        source.ego2global,
    )


def _is_skipped(out: Mapping[str, Any]) -> bool:
    return bool(out.get("retarget_params", {}).get("skipped"))


def scanned(results: Mapping[str, Any], out: Mapping[str, Any], lidar2ego: FloatArray) -> dict[str, Any]:
    """``points`` as the target's scanners measured them, of the given type, and ``num_lidar_pts`` of each box.

    Empty where the target has none, or the sample was skipped. Numbers are written in ``ann_info`` and ``instances``,
    where they are there for the same boxes. ``lidar2ego`` (4, 4) leads to the frame of the sample's points.
    """
    if RINGS_KEY not in out or _is_skipped(out):
        return {}
    given, points = results["points"], moved_points(out["points"], np.asarray(np.linalg.inv(lidar2ego)))
    changed = {"points": given.new_point(points) if hasattr(given, "new_point") else like_array(given, points)}
    counts = out[COUNTS_KEY].numpy() if COUNTS_KEY in out else np.zeros(0, np.int64)
    if isinstance(annotated := results.get("ann_info"), Mapping):
        given_counts = annotated.get("num_lidar_pts")
        if given_counts is not None and len(given_counts) == len(counts) > 0:
            changed["ann_info"] = {**annotated, "num_lidar_pts": like_array(given_counts, counts)}
    instances = results.get("instances")
    if isinstance(instances, list) and len(instances) == len(counts):
        changed["instances"] = [
            {**box, "num_lidar_pts": count} if "num_lidar_pts" in box else box
            for box, count in zip(instances, counts.tolist(), strict=True)
        ]
    return changed


def check_no_lenses(lenses: Sequence[str]) -> None:
    """Refuse lenses, which the frameworks' matrices cannot say."""
    if any(lens != "pinhole" for lens in lenses):
        raise CalibrationError(
            f"target: expected pinhole cameras, which is all that these frameworks know, got {', '.join(lenses)}; "
            "pass load_rig(...).undistorted(), or a file that it was saved to"
        )


def target_outputs(outs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Coverage, and what else was asked for, as arrays (views, h, w); of several frames (frames, views, h, w)."""
    outputs: dict[str, Any] = {}
    for key in TARGET_OUTPUTS:
        if key in outs[0]:
            values = [out[key].numpy() if isinstance(out[key], torch.Tensor) else out[key] for out in outs]
            is_map = len(values) > 1 and isinstance(values[0], np.ndarray)
            outputs[key] = np.stack(values) if is_map else values[0]  # one draw for all frames
    return outputs


def _write_numbers(out: dict[str, Any], views: ResultCameras, images: torch.Tensor) -> None:
    """Write matrices, and the images' shapes."""
    for key, kind in MATRICES.items():
        if out.get(key) is not None:
            matrices = out.pop(key)
            if not _is_of_one(matrices):
                with entry(key, "a matrix of each image"):
                    out[key] = _as_written(matrices, views.matrices(kind))
    h, w = images.shape[-2:]
    # (h, w), (h, w, 3), (h, w, 3, views) as given; (w, h) where images are PIL's.
    full = (h, w, 3, len(images)) if isinstance(out["img"][0], np.ndarray | torch.Tensor) else (w, h)
    for key in SHAPE_KEYS:
        if isinstance(shape := out.get(key), tuple | list) and shape:
            is_list = isinstance(shape[0], tuple | list)
            out[key] = [full[: len(shape[0])]] * len(images) if is_list else full[: len(shape)]


def images_like(original: Sequence[Any], images: torch.Tensor) -> Any:
    """Images (M, 3, h, w) uint8 as the given ones are: PIL, or arrays or tensors of their type, listed or stacked."""
    first = original[0]
    if isinstance(first, torch.Tensor):
        typed_tensors = images.to(first)
        return typed_tensors if isinstance(original, torch.Tensor) else list(typed_tensors)
    arrays = [np.ascontiguousarray(image.permute(1, 2, 0).numpy()) for image in images]
    if not isinstance(first, np.ndarray):
        from PIL import Image

        return [Image.fromarray(array) for array in arrays]
    typed = [array.astype(first.dtype, copy=False) for array in arrays]
    return np.stack(typed) if isinstance(original, np.ndarray) else typed


def _as_written(original: Any, matrices: FloatArray) -> Any:
    """Matrices in the form of the given ones; transposed where those are."""
    if np.shape(original[0]) == (4, 4) and is_transposed(np.stack([np.asarray(m, np.float64) for m in original])):
        matrices = matrices.transpose(0, 2, 1)
    return like_given(original, matrices)


def _infos(infos: Mapping[str, Any], views: ResultCameras, images: torch.Tensor) -> dict[str, Any]:
    """``images``: an entry for each target camera with those keys of the source's that are known for it."""
    first: Mapping[str, Any] = next((info for info in infos.values() if isinstance(info, Mapping)), {})
    columns = {
        key: _as_written([first[key]], views.matrices(kind))
        for key, kind in MATRICES.items()
        if first.get(key) is not None and (kind != "cam2global" or views.ego2global is not None)
    }
    by_camera = {}
    for k, name in enumerate(views.names):
        by_camera[name] = {key: column[k] for key, column in columns.items()}
        if "img_path" in first:
            by_camera[name]["img_path"] = name
        if "height" in first and "width" in first:
            by_camera[name] |= {"height": images.shape[-2], "width": images.shape[-1]}
    return by_camera


def without_stale(results: Mapping[str, Any], *, silently: str = "") -> dict[str, Any]:
    """Drop ``STALE_KEYS``, also in ``ann_info``, with a warning except for the ``silently`` dropped key."""
    kept = {key: value for key, value in results.items() if key not in STALE_KEYS}
    dropped = {*results} - {*kept, silently}
    if isinstance(annotated := kept.get("ann_info"), Mapping):
        kept["ann_info"] = {key: value for key, value in annotated.items() if key not in STALE_KEYS}
        dropped |= {*annotated} - {*kept["ann_info"]}
    if dropped:
        warn(f"retarget: drops {', '.join(sorted(dropped))}: they speak of the source's pixels")
    return kept
