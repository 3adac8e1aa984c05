"""Checked frames and scenes of a sample dict; error messages give the fix."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.key_names import hint
from arbiview_aug.cameras.lens import LENSES, BoolArray, FloatArray, canonical_name
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.sample.batching import leading_shape, split
from arbiview_aug.sample.images import check_container, checked_images
from arbiview_aug.scene.boxes import checked_boxes
from arbiview_aug.scene.depth_maps import believed, motion_camera, points_of_depth
from arbiview_aug.scene.point_cloud import checked_points
from arbiview_aug.scene.scene import SURFACES, Scene
from arbiview_aug.scene.surface import Points

MOTION_KEY, LEARNED_KEY = "motion_depth_m", "learned_depth_m"
"""(N, h, w) z-depth computed offline, at the size of ``motion_camera``."""

LEARNED_WORDS_KEY = "learned_depth_words"  # the model and how it was fitted, for ``explain``

CALIBRATION_KEYS = (
    "images",
    "rig",
    "K",
    "cam2ego",
    "distortion",
    "lens",
    "ground_z_m",
    "coverage",
    "ignore",
    "neighbours",
    MOTION_KEY,
    LEARNED_KEY,
    LEARNED_WORDS_KEY,
    "retarget_params",
)
"""Keys that describe the source's images; they are replaced by the target's or consumed."""

MAX_CAMERAS = 128  # winning sources are int8
_OFF_CENTER = 0.2  # a principal point is never off centre by this share of the image's size along both axes


@dataclass(frozen=True)
class Frame:
    """One checked frame: N images (3, H, W), uint8 or float in [0, 1], and their cameras."""

    images: tuple[torch.Tensor, ...]
    rig: Rig


def read_frames(sample: Any, source_rig: Rig | None) -> list[Frame]:
    """Read and check the frames of a sample, one for each element of its leading dimensions.

    Args:
        sample: The sample dict; see ``RigRetarget``.
        source_rig: The rig of all samples, if the transform has one.

    Raises:
        SampleError: Missing calibration, mismatched counts or sizes, values out of range.
        SampleTypeError: PIL images, numpy arrays and the like, with the conversion to use.
        CalibrationError: Impossible K, cam2ego or lens.
    """
    if not isinstance(sample, Mapping):
        raise SampleTypeError(f"sample: expected a dict, got {type(sample).__name__}")
    if "images" not in sample:
        got = ", ".join(map(str, sample)) or "an empty dict"
        raise SampleError(f"sample: expected a key 'images', got {got}{hint(sample, ('images',))}")
    images = sample["images"]
    check_container(images)
    lead = leading_shape(images)
    if 0 in lead:
        raise SampleError(f"images: expected at least one frame, got the leading dimensions {lead}")
    try:
        frames = split(images, lead)
    except ValueError as error:
        raise SampleError(f"images: {error}") from None
    return [
        frame_from(checked_images(frame), sample, source_rig, lead, index)
        for frame, index in zip(frames, np.ndindex(*lead), strict=True)
    ]


def read_scenes(sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...], surface: str) -> list[Scene]:
    """Read the scene geometry that a surface uses for each frame, in the source's ego frame; [] without any."""
    row = SURFACES[surface]
    found: dict[str, list[Points]] = {}
    for name in row.reads:
        doubted = name == "motion" and LEARNED_KEY in row.reads
        arrays = _geometry(name, sample, frames, lead, found, sample.get(LEARNED_KEY) if doubted else None)
        if arrays is not None:
            found[name] = arrays
        elif name == row.needs and name != "motion" and (name != "points" or sample.get("depth_m") is None):
            # Neighbouring frames may still give depth from motion.
            expected, keys = _EXPECTED.get(name, f"{name!r} in the sample, got none"), _SAMPLE_KEYS.get(name, (name,))
            raise SampleError(f"surface={surface!r}: expected {expected}{hint(sample, keys)}")
    if not found:
        return []
    scenes = []
    for k in range(len(frames)):
        further: dict[str, Any] = {name: arrays[k] for name, arrays in found.items()}
        own = {name: further.pop(name) for name in _SAMPLE_KEYS if name in further}
        scenes.append(Scene(**own, further=further))
    return scenes


DEPTH_KEYS = ("depth_m", MOTION_KEY, LEARNED_KEY)
_SAMPLE_KEYS = {"boxes": ("boxes_3d",), "points": ("points",), "motion": (MOTION_KEY,)}
"""Sample keys of the geometry that has a field in ``Scene``; others are read under their own name."""

_EXPECTED = {
    "boxes": "'boxes_3d' (B, 7) in the sample, got none; pass an empty (0, 7) tensor if there are no objects",
    "points": "'points' (P, >= 3) in the ego frame, or 'depth_m' (N, H, W), z-depth of each camera in metres, in the "
    "sample, got neither",
    LEARNED_KEY: f"{LEARNED_KEY!r} in the sample, got none; make it with depth --model, and read it with WithDepth",
}
_CHECKS: dict[str, Callable[[Points], Points]] = {"boxes_3d": checked_boxes, "points": checked_points}


def _geometry(
    name: str,
    sample: Mapping[str, Any],
    frames: Sequence[Frame],
    lead: tuple[int, ...],
    found: Mapping[str, Sequence[Points]],
    network_m: Any = None,
) -> list[Points] | None:
    """The array of each frame for a name in ``SurfaceRow.reads``, beside those ``found`` before; None without any.

    Depth from motion is believed where a network's maps, if given, do not contradict it.
    """
    parts: list[list[Points]] = []
    for key in _SAMPLE_KEYS.get(name, (name,)):
        value = sample.get(key)
        if value is None:
            continue
        if key in DEPTH_KEYS:
            measured = [found[one] for one in ("points", "depth_m", "motion") if one in found and key != "depth_m"]
            none = [np.zeros((0, 3))] * len(frames)
            anchors = [np.concatenate(arrays) for arrays in zip(none, *measured, strict=True)]
            parts.append(_points_of_maps(key, value, frames, lead, anchors, network_m))
            continue
        arrays = of_frames(key, value, len(frames), lead)
        parts.append([_CHECKS[key](array) for array in arrays] if key in _CHECKS else arrays)
    if not parts:
        return None
    return [arrays[0] if len(arrays) == 1 else np.concatenate(arrays) for arrays in zip(*parts, strict=True)]


def _points_of_maps(
    key: str,
    depth_m: Any,
    frames: Sequence[Frame],
    lead: tuple[int, ...],
    anchors: Sequence[Points],
    network_m: Any = None,
) -> list[Points]:
    """(P, 3) points of each frame's depth maps, brought to ``anchors`` (P, 3) if there are any."""
    maps = _maps_of_frames(key, depth_m, frames, lead)
    doubts = maps if network_m is None else _maps_of_frames(LEARNED_KEY, network_m, frames, lead)
    found: list[Points] = []
    for frame, of_cameras, of_network, anchor in zip(frames, maps, doubts, anchors, strict=True):
        cameras = [camera if key == "depth_m" else motion_camera(camera) for camera in frame.rig]
        kept = of_cameras if network_m is None else map(believed, of_cameras, of_network)
        pairs = zip(cameras, kept, strict=True)
        found.append(np.concatenate([points_of_depth(c, depth, key, anchor) for c, depth in pairs]))
    return found


def _maps_of_frames(key: str, depth_m: Any, frames: Sequence[Frame], lead: tuple[int, ...]) -> list[list[Any]]:
    """The depth maps (H, W) of each frame's cameras."""
    try:
        maps = split(depth_m, lead)
    except (AttributeError, TypeError, ValueError, RuntimeError) as error:
        raise SampleError(f"{key}: expected one map (H, W) for each image ({error})") from None
    found = []
    for frame, of_cameras in zip(frames, maps, strict=True):
        if isinstance(of_cameras, torch.Tensor | np.ndarray):
            of_cameras = list(numbers(key, of_cameras)) if of_cameras.ndim else ()
        if not isinstance(of_cameras, list | tuple) or len(of_cameras) != len(frame.rig):
            raise SampleError(f"{key}: expected {len(frame.rig)} maps (H, W), one for each image")
        found.append([numbers(key, depth) for depth in of_cameras])
    return found


def names_of_frames(key: str, value: Any, count: int, lead: tuple[int, ...]) -> list[object]:
    """Hashable names of each frame: from one name, or in a batch a list or tensor of names."""
    values = [value]
    if lead:
        values = list(value.reshape(count, -1)) if isinstance(value, torch.Tensor) and value.ndim else value
        if not isinstance(values, list | tuple) or len(values) != count:
            raise SampleError(f"{key}: expected a name for each of {count} frames, got {type(value).__name__}")
    if any(isinstance(v, torch.Tensor) and (v.device.type == "meta" or v.layout != torch.strided) for v in values):
        raise SampleTypeError(f"{key}: expected names, got tensors without values")
    return [str(v.tolist()) if isinstance(v, torch.Tensor) else str(v) for v in values]


def of_frames(key: str, value: Any, count: int, lead: tuple[int, ...]) -> list[Points]:
    """The array of each frame: from a tensor with the images' leading dimensions, or a list with one per frame."""
    if not lead:
        return [_array(key, value)]
    try:
        frames = value if isinstance(value, list | tuple) else split(value, lead)
    except (AttributeError, TypeError, ValueError, RuntimeError):
        frames = ()
    if len(frames) != count:
        got = f"shape {tuple(value.shape)}" if hasattr(value, "shape") else type(value).__name__
        raise SampleError(f"{key}: expected a tensor {lead} + (n, ...), or a list of {count} of them, got {got}")
    return [_array(key, frame) for frame in frames]


# --- calibration ------------------------------------------------------------------------------------------------------
def frame_from(
    images: tuple[torch.Tensor, ...],
    sample: Mapping[str, Any],
    source_rig: Rig | None,
    lead: tuple[int, ...] = (),
    index: tuple[int, ...] = (),
) -> Frame:
    """One frame of a sample, at an ``index`` into its leading dimensions, whose images are checked already."""
    rig = sample.get("rig")
    if rig is None:
        rig = source_rig if source_rig is not None else _rig_from_tensors(images, sample, index)
    if not isinstance(rig, Rig):
        raise SampleTypeError(f"rig: expected an arbiview_aug.Rig, got {type(rig).__name__}; use load_rig(path)")
    if len(rig) > MAX_CAMERAS:
        raise SampleError(f"images: expected at most {MAX_CAMERAS} cameras, got {len(rig)}")
    if len(rig) != len(images):
        raise SampleError(f"images: expected {len(rig)} images for cameras {', '.join(rig.names)}, got {len(images)}")
    for camera, image in zip(rig, images, strict=True):
        size = tuple(image.shape[-2:])
        if size != camera.size:
            fix = "height and width are swapped" if size == camera.size[::-1] else "use rig.resized((h, w)) or crop"
            expected = f"an image of (h, w) = {camera.size}, as calibrated"
            raise SampleError(f"camera {camera.name!r}: expected {expected}, got {size}; {fix}")
    return Frame(images, _with_masks(rig, sample, lead, index))


def _rig_from_tensors(images: tuple[torch.Tensor, ...], sample: Mapping[str, Any], index: tuple[int, ...]) -> Rig:
    """The rig of the sample's K, cam2ego and, where present, lens, distortion and ground_z_m."""
    missing = [key for key in ("K", "cam2ego") if sample.get(key) is None]
    if missing:
        raise SampleError(
            f"sample: expected calibration, 'rig' or 'K' and 'cam2ego', missing {', '.join(missing)}"
            f"{hint(sample, missing)}; or pass source_rig= to the transform"
        )
    K, cam2ego = (numbers(key, sample[key], index) for key in ("K", "cam2ego"))
    for key, array, expected in (("K", K, (len(images), 3, 3)), ("cam2ego", cam2ego, (len(images), 4, 4))):
        if array.shape != expected:
            raise SampleError(f"{key}: expected shape {expected} for {len(images)} images, got {array.shape}")
    cameras = []
    for k, (image, (lens, distortion)) in enumerate(zip(images, _lenses(sample, len(images), index), strict=True)):
        h, w = image.shape[-2:]
        _check_principal_point(k, K[k], (h, w))
        calibration: dict[str, Any] = {"K": K[k], "cam2ego": cam2ego[k], "lens": lens, "distortion": distortion}
        cameras.append(Camera(name=f"camera {k}", width_px=w, height_px=h, **calibration))
    ground_z_m = numbers("ground_z_m", sample.get("ground_z_m", 0.0), index)
    if ground_z_m.size != 1:
        raise SampleError(f"ground_z_m: expected one height for each frame, got shape {ground_z_m.shape}")
    return Rig(cameras, ground_z_m=float(ground_z_m.item()))


def _check_principal_point(k: int, K: np.ndarray, size: tuple[int, int]) -> None:
    """Refuse a K that was made for another image size; ``Camera`` refuses NaN."""
    h, w = size
    x, y = (K[0, 2] + 0.5) / w - 0.5, (K[1, 2] + 0.5) / h - 0.5  # from the image's centre, as a share of its size
    off_swapped = max(abs((K[0, 2] + 0.5) / h - 0.5), abs((K[1, 2] + 0.5) / w - 0.5))
    outside = max(abs(x), abs(y)) > 0.5
    scaled = max(x, y) < -_OFF_CENTER or min(x, y) > _OFF_CENTER
    swapped = max(abs(x), abs(y)) > 0.12 and off_swapped < 0.05
    if not (outside or scaled or swapped):
        return
    where = "inside the image" if outside else "near the middle of the image"
    fix = "height and width are swapped" if swapped else "K of another image size? Camera.resize scales K"
    raise SampleError(
        f"K[{k}]: expected a principal point {where} of (h, w) = {(h, w)}, got ({K[0, 2]:g}, {K[1, 2]:g}); "
        f"{fix}; pass rig= if the camera is really like this"
    )


def _lenses(sample: Mapping[str, Any], count: int, index: tuple[int, ...]) -> list[tuple[Any, tuple[float, ...]]]:
    """Lens and coefficients of each camera, without the zeros that pad them to a common number."""
    names, distortion = sample.get("lens"), sample.get("distortion")
    coefficients = None if distortion is None else numbers("distortion", distortion, index)
    if names is None:
        if coefficients is not None and coefficients.any():
            expected = f"'lens' beside it, one of {', '.join(LENSES)} for each camera"
            raise SampleError(f"distortion: expected {expected}{hint(sample, ('lens',))}")
        return [("pinhole", ())] * count
    if not isinstance(names, list | tuple) or len(names) != count:
        raise SampleError(f"lens: expected a list of {count} names, one for each camera, got {names!r}")
    lenses = [_lens(name, index) for name in names]
    if all(lens in LENSES and LENSES[lens].coefficient_counts == (0,) for lens in lenses):
        return [(lens, ()) for lens in lenses]
    if coefficients is None or coefficients.ndim != 2 or len(coefficients) != count:
        got = f"none{hint(sample, ('distortion',))}" if coefficients is None else f"shape {coefficients.shape}"
        raise SampleError(f"distortion: expected shape ({count}, up to 8) for the lenses {lenses}, got {got}")
    result = []
    for lens, row in zip(lenses, coefficients.tolist(), strict=True):
        size = LENSES[lens].coefficient_counts[-1] if lens in LENSES else len(row)
        result.append((lens, tuple(row) if any(row[size:]) else tuple(row[:size])))
    return result


def _lens(name: Any, index: tuple[int, ...]) -> str:
    """The lens of a camera in one frame: ``default_collate`` makes lists of a batch's names."""
    for i in index:
        if isinstance(name, str):
            break
        if not isinstance(name, list | tuple) or not i < len(name):
            raise SampleError(f"lens: expected a name for each frame of the batch, got {name!r}")
        name = name[i]
    if not isinstance(name, str):
        raise SampleTypeError(f"lens: expected names, one for each camera, got {name!r}")
    return canonical_name(name)


def _with_masks(rig: Rig, sample: Mapping[str, Any], lead: tuple[int, ...], index: tuple[int, ...]) -> Rig:
    """The rig, masked where an earlier retargeting saw nothing (``coverage``) or its own car (``ignore``)."""
    masks: list[BoolArray | None] = [camera.mask for camera in rig]
    for key in ("coverage", "ignore"):
        if sample.get(key) is None:
            continue
        try:
            maps = split(sample[key], lead)[np.ravel_multi_index(index, lead) if lead else 0]
            hidden = [~m if key == "coverage" else m for m in maps]
            for k, (camera, pixels) in enumerate(zip(rig, hidden, strict=True)):
                if tuple(pixels.shape) != camera.size or pixels.dtype != torch.bool:
                    raise ValueError(f"got {pixels.dtype} {tuple(pixels.shape)}")
                if pixels.any():
                    visible, mask = ~pixels.cpu().numpy(), masks[k]
                    masks[k] = visible if mask is None else mask & visible
        except (TypeError, ValueError, AttributeError, RuntimeError) as error:  # RuntimeError: meta, sparse
            raise SampleError(
                f"{key}: expected a bool map of the size of each image, as an earlier retargeting gives it ({error}); "
                "rename the key if it is something else"
            ) from None
    if all(mask is camera.mask for mask, camera in zip(masks, rig, strict=True)):
        return rig
    return rig.with_cameras([replace(camera, mask=mask) for camera, mask in zip(rig, masks, strict=True)])


def numbers(key: str, value: Any, index: tuple[int, ...] = ()) -> FloatArray:
    """An entry of a sample as a float64 array, at an ``index`` into its leading dimensions; scalars hold for all."""
    array = np.asarray(_array(key, value), np.float64)
    try:
        return np.asarray(array[index]) if array.ndim else array
    except IndexError:
        raise SampleError(f"{key}: expected the images' leading dimensions, got shape {array.shape}") from None


def _array(key: str, value: Any) -> Points:
    """An entry of a sample as an array: float32 in the same memory, anything else as float64."""
    try:
        if isinstance(value, torch.Tensor):
            value = value.detach().cpu()
            value = (value if value.dtype == torch.float32 or value.is_complex() else value.double()).numpy()
        if np.iscomplexobj(value):
            raise TypeError("complex numbers")
        array = np.asarray(value)
        return array if array.dtype == np.float32 else np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # RuntimeError: quantised and meta tensors
        why = " ".join(str(error).split())[:120]
        raise SampleTypeError(f"{key}: expected a tensor of numbers, got {type(value).__name__} ({why})") from None
