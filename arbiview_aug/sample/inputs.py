"""The sample contract: what a sample must hold, checked once at the boundary, with messages that say how to mend it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
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
from arbiview_aug.scene.depth_maps import motion_camera, points_of_depth
from arbiview_aug.scene.point_cloud import checked_points
from arbiview_aug.scene.scene import SURFACES, Scene
from arbiview_aug.scene.surface import Points

MOTION_KEY = "motion_depth_m"
"""Depth from motion that was found offline: (N, h, w) z-depth at the size of ``arbiview_aug.temporal.plane_sweep``."""

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
    "retarget_params",
)
"""Keys that describe the source's images; they are replaced by the target's or consumed."""

MAX_CAMERAS = 128  # winning sources are int8
_OFF_CENTER = 0.2  # share of the image's size by which both coordinates of a principal point never lie off its centre


@dataclass(frozen=True)
class Frame:
    """The images and calibration of one checked sample.

    Attributes:
        images: N tensors (3, H, W): uint8, or float in [0, 1].
        rig: Their cameras.
    """

    images: tuple[torch.Tensor, ...]
    rig: Rig


def read_frames(sample: Any, source_rig: Rig | None) -> list[Frame]:
    """The frames of a sample, one for each element of its leading dimensions (one if there are none).

    Args:
        sample: The sample dict; see the contract in ``RigRetarget``.
        source_rig: The rig of every sample, where the transform was given one.

    Raises:
        SampleError: Missing calibration, mismatched counts or sizes, values out of range.
        SampleTypeError: PIL images, numpy arrays and the like, with the conversion to use.
        CalibrationError: K, cam2ego or a lens that no real camera has.
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
        of_frames = split(images, lead)
    except ValueError as error:
        raise SampleError(f"images: {error}") from None
    indices = list(np.ndindex(*lead))
    return [
        _frame(checked_images(frame), sample, source_rig, lead, index)
        for frame, index in zip(of_frames, indices, strict=True)
    ]


def read_scenes(sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...], surface: str) -> list[Scene]:
    """What each frame of a sample says of the geometry, in the source's ego frame.

    Args:
        sample: The sample dict.
        frames: Its checked frames.
        lead: Leading dimensions of its images.
        surface: The surface asked for: what it does not use is not read.

    Raises:
        SampleError: Geometry that the surface needs is missing or impossible.
    """
    row = SURFACES[surface]
    found: dict[str, list[Points]] = {}
    for name in row.reads:
        arrays = _READERS.get(name, partial(_array_of_frames, name))(sample, frames, lead)
        if arrays is not None:
            found[name] = arrays
        elif name == row.needs and name != "motion":  # neighbouring frames may still give depth from motion
            expected, keys = _NEEDED.get(name, f"{name!r} in the sample, got none"), _SAMPLE_KEYS.get(name, (name,))
            raise SampleError(f"surface={surface!r}: expected {expected}{hint(sample, keys)}")
    if not found:
        return [Scene()] * len(frames)
    scenes = []
    for k in range(len(frames)):
        further: dict[str, Any] = {name: arrays[k] for name, arrays in found.items()}
        own = {name: further.pop(name) for name in _READERS if name in further}
        scenes.append(Scene(**own, further=further))
    return scenes


def _array_of_frames(
    key: str, sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...]
) -> list[Points] | None:
    """The numbers that a key of the sample holds for each frame; None without."""
    return None if sample.get(key) is None else of_frames(key, sample[key], len(frames), lead)


def _boxes_of_frames(sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...]) -> list[Points] | None:
    """(B, 7) boxes of each frame; None without."""
    boxes = _array_of_frames("boxes_3d", sample, frames, lead)
    return None if boxes is None else [checked_boxes(array) for array in boxes]


def _motion_of_frames(sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...]) -> list[Points] | None:
    """(P, 3) points of each frame by depth from motion that was found offline; None without."""
    maps = sample.get(MOTION_KEY)
    return None if maps is None else _points_of_maps(MOTION_KEY, maps, frames, lead, motion_camera)


def _points_of_frames(sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...]) -> list[Points] | None:
    """(P, 3) measured points of each frame: its ``points``, and those of its depth maps ``depth_m``; None without."""
    points, depth_m = sample.get("points"), sample.get("depth_m")
    if points is None and depth_m is None:
        return None
    parts: list[list[np.ndarray]] = [[] for _ in frames]
    if points is not None:
        for part, of_frame in zip(parts, of_frames("points", points, len(frames), lead), strict=True):
            part.append(checked_points(of_frame))
    if depth_m is not None:
        for part, of_frame in zip(parts, _points_of_maps("depth_m", depth_m, frames, lead, lambda c: c), strict=True):
            part.append(of_frame)
    return [part[0] if len(part) == 1 else np.concatenate(part) for part in parts]


_READERS: dict[str, Callable[[Mapping[str, Any], Sequence[Frame], tuple[int, ...]], list[Points] | None]] = {
    "boxes": _boxes_of_frames,
    "points": _points_of_frames,
    "motion": _motion_of_frames,
}
"""Readers of the geometry that is more than the array of one key."""

_SAMPLE_KEYS = {"boxes": ("boxes_3d",), "points": ("points", "depth_m")}
_NEEDED = {
    "boxes": "'boxes_3d' (B, 7) in the sample, got none; an empty (0, 7) tensor says that nothing stands there",
    "points": "'points' (P, >= 3) in the ego frame, or 'depth_m' (N, H, W), z-depth of each camera in metres, in the "
    "sample, got neither",
}


def _points_of_maps(
    key: str,
    depth_m: Any,
    frames: Sequence[Frame],
    lead: tuple[int, ...],
    sized: Callable[[Camera], Camera],
) -> list[Points]:
    """(P, 3) points of each frame's depth maps, those of each camera at the size of ``sized`` of it."""
    try:
        maps = split(depth_m, lead)
    except (AttributeError, TypeError, ValueError, RuntimeError) as error:
        raise SampleError(f"{key}: expected one map (H, W) for each image ({error})") from None
    found: list[Points] = []
    for frame, of_cameras in zip(frames, maps, strict=True):
        if isinstance(of_cameras, torch.Tensor | np.ndarray):
            of_cameras = list(numbers(key, of_cameras)) if of_cameras.ndim else ()
        if not isinstance(of_cameras, list | tuple) or len(of_cameras) != len(frame.rig):
            raise SampleError(f"{key}: expected {len(frame.rig)} maps (H, W), one for each image")
        points = [
            points_of_depth(sized(camera), _numbers(key, depth, ()), key)
            for camera, depth in zip(frame.rig, of_cameras, strict=True)
        ]
        found.append(np.concatenate(points))
    return found


def names_of_frames(key: str, value: Any, count: int, lead: tuple[int, ...]) -> list[object]:
    """What an entry of the sample calls each frame, hashable: a name, or in a batch a list or tensor of names."""
    values = [value]
    if lead:
        values = list(value.reshape(count, -1)) if isinstance(value, torch.Tensor) and value.ndim else value
        if not isinstance(values, list | tuple) or len(values) != count:
            raise SampleError(f"{key}: expected a name for each of {count} frames, got {type(value).__name__}")
    if any(isinstance(v, torch.Tensor) and (v.device.type == "meta" or v.layout != torch.strided) for v in values):
        raise SampleTypeError(f"{key}: expected names, got tensors without values")
    return [str(v.tolist()) if isinstance(v, torch.Tensor) else str(v) for v in values]


def of_frames(key: str, value: Any, count: int, lead: tuple[int, ...]) -> list[Points]:
    """Numbers of each frame: a tensor with the images' leading dimensions, or a list with an entry for each frame.

    Raises:
        SampleError: Another number of frames.
        SampleTypeError: No numbers.
    """
    if not lead:
        return [_recorded(key, value)]
    try:
        frames = value if isinstance(value, list | tuple) else split(value, lead)
    except (AttributeError, TypeError, ValueError, RuntimeError):
        frames = ()
    if len(frames) != count:
        got = f"shape {tuple(value.shape)}" if hasattr(value, "shape") else type(value).__name__
        raise SampleError(f"{key}: expected a tensor {lead} + (n, ...), or a list of {count} of them, got {got}")
    return [_recorded(key, frame) for frame in frames]


# --- calibration ------------------------------------------------------------------------------------------------------
def frame_from(images: tuple[torch.Tensor, ...], entry: Mapping[str, Any], source_rig: Rig | None) -> Frame:
    """One frame of an unbatched sample, whose images are checked already.

    Raises:
        SampleError: Missing calibration, mismatched counts or sizes.
        CalibrationError: K, cam2ego or a lens that no real camera has.
    """
    return _frame(images, entry, source_rig, (), ())


def _frame(
    images: tuple[torch.Tensor, ...],
    sample: Mapping[str, Any],
    source_rig: Rig | None,
    lead: tuple[int, ...],
    index: tuple[int, ...],
) -> Frame:
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
            raise SampleError(
                f"camera {camera.name!r}: expected an image of (h, w) = {camera.size}, as calibrated, got {size}; {fix}"
            )
    return Frame(images, _without_hidden_pixels(rig, sample, lead, index))


def _rig_from_tensors(images: tuple[torch.Tensor, ...], sample: Mapping[str, Any], index: tuple[int, ...]) -> Rig:
    """A rig from the sample's K, cam2ego and, where present, lens, distortion and ground_z_m."""
    missing = [key for key in ("K", "cam2ego") if sample.get(key) is None]
    if missing:
        raise SampleError(
            f"sample: expected calibration, 'rig' or 'K' and 'cam2ego', missing {', '.join(missing)}"
            f"{hint(sample, missing)}; or pass source_rig= to the transform"
        )
    K, cam2ego = (_numbers(key, sample[key], index) for key in ("K", "cam2ego"))
    for key, array, shape in (("K", K, (3, 3)), ("cam2ego", cam2ego, (4, 4))):
        expected = (len(images), *shape)
        if array.shape != expected:
            raise SampleError(f"{key}: expected shape {expected} for {len(images)} images, got {array.shape}")
    lenses = _lenses(sample, len(images), index)
    cameras = []
    for k, image in enumerate(images):
        h, w = image.shape[-2:]
        _check_principal_point(k, K[k], (h, w))
        lens, distortion = lenses[k]
        name = f"camera {k}"
        cameras.append(
            Camera(name=name, width_px=w, height_px=h, K=K[k], cam2ego=cam2ego[k], lens=lens, distortion=distortion)
        )
    ground_z_m = sample.get("ground_z_m", 0.0)
    heights = numbers("ground_z_m", ground_z_m)
    of_frame = _numbers("ground_z_m", heights, index) if heights.ndim else heights
    if of_frame.size != 1:
        raise SampleError(f"ground_z_m: expected one height for each frame, got shape {heights.shape}")
    return Rig(cameras, ground_z_m=float(of_frame.item()))


def _check_principal_point(k: int, K: np.ndarray, size: tuple[int, int]) -> None:
    """Refuse a K that was made for another image size; NaN is left to ``Camera``."""
    h, w = size
    x, y = (K[0, 2] + 0.5) / w - 0.5, (K[1, 2] + 0.5) / h - 0.5  # from the image's centre, as a share of its size
    in_turned = max(abs((K[0, 2] + 0.5) / h - 0.5), abs((K[1, 2] + 0.5) / w - 0.5))
    outside = max(abs(x), abs(y)) > 0.5
    scaled = max(x, y) < -_OFF_CENTER or min(x, y) > _OFF_CENTER
    swapped = max(abs(x), abs(y)) > 0.12 and in_turned < 0.05
    if not (outside or scaled or swapped):
        return
    where = "inside the image" if outside else "near the middle of the image"
    fix = "height and width are swapped" if swapped else "K of another image size? Camera.resize scales K"
    raise SampleError(
        f"K[{k}]: expected a principal point {where} of (h, w) = {(h, w)}, got ({K[0, 2]:g}, {K[1, 2]:g}); "
        f"{fix}; a camera that is really so comes as rig="
    )


def _lenses(sample: Mapping[str, Any], count: int, index: tuple[int, ...]) -> list[tuple[Any, tuple[float, ...]]]:
    """Lens and coefficients of each camera; zeros that pad them to a common number are left out."""
    names, distortion = sample.get("lens"), sample.get("distortion")
    coefficients = None if distortion is None else _numbers("distortion", distortion, index)
    if names is None:
        if coefficients is not None and coefficients.any():
            known = ", ".join(LENSES)
            raise SampleError(
                f"distortion: expected 'lens' beside it, one of {known} a camera{hint(sample, ('lens',))}"
            )
        return [("pinhole", ())] * count
    if not isinstance(names, list | tuple) or len(names) != count:
        raise SampleError(f"lens: expected a list of {count} names, one a camera, got {names!r}")
    lenses = [_entry(name, index) for name in names]
    if not all(isinstance(lens, str) for lens in lenses):
        raise SampleTypeError(f"lens: expected names, one a camera, got {lenses!r}")
    lenses = [canonical_name(lens) for lens in lenses]
    if all(lens in LENSES and LENSES[lens].coefficient_counts == (0,) for lens in lenses):
        return [(lens, ()) for lens in lenses]
    if coefficients is None or coefficients.ndim != 2 or len(coefficients) != count:
        got = f"none{hint(sample, ('distortion',))}" if coefficients is None else f"shape {coefficients.shape}"
        raise SampleError(f"distortion: expected shape ({count}, up to 8) for the lenses {lenses}, got {got}")
    result = []
    for lens, row in zip(lenses, coefficients.tolist(), strict=True):
        needed = LENSES[lens].coefficient_counts[-1] if lens in LENSES else len(row)
        result.append((lens, tuple(row) if any(row[needed:]) else tuple(row[:needed])))
    return result


def _entry(name: Any, index: tuple[int, ...]) -> Any:
    """A camera's lens; ``default_collate`` makes a list of a batch's."""
    for i in index:
        if isinstance(name, str):
            break
        if not isinstance(name, list | tuple) or not i < len(name):
            raise SampleError(f"lens: expected a name for each frame of the batch, got {name!r}")
        name = name[i]
    return name


def _without_hidden_pixels(rig: Rig, sample: Mapping[str, Any], lead: tuple[int, ...], index: tuple[int, ...]) -> Rig:
    """The rig, masked where an earlier retargeting saw nothing (``coverage``) or the own car (``ignore``)."""
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
                    seen = ~pixels.cpu().numpy()
                    held = masks[k]
                    masks[k] = seen if held is None else held & seen
        except (TypeError, ValueError, AttributeError, RuntimeError) as error:  # RuntimeError: meta, sparse
            raise SampleError(
                f"{key}: expected a bool map of the size of each image, as an earlier retargeting gives it ({error}); "
                "rename the key if it is something else"
            ) from None
    if all(new is camera.mask for new, camera in zip(masks, rig, strict=True)):
        return rig
    return rig.with_cameras([replace(camera, mask=mask) for camera, mask in zip(rig, masks, strict=True)])


def numbers(key: str, value: Any) -> FloatArray:
    """An entry of a sample as a float64 array.

    Raises:
        SampleTypeError: It holds no real numbers.
    """
    return np.asarray(_recorded(key, value), np.float64)


def _recorded(key: str, value: Any) -> Points:
    """An entry of a sample as an array: float32 as it is, the same memory, anything else as float64.

    Raises:
        SampleTypeError: It holds no real numbers.
    """
    try:
        if isinstance(value, torch.Tensor):
            if value.layout != torch.strided or value.device.type == "meta":
                raise TypeError(f"{value.layout} on {value.device}")
            if value.is_complex():
                raise TypeError("complex numbers")
            value = value.detach().cpu()
            return (value if value.dtype == torch.float32 else value.double()).numpy()
        if np.iscomplexobj(value):
            raise TypeError("complex numbers")
        array = np.asarray(value)
        return array if array.dtype == np.float32 else np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # RuntimeError: quantised tensors
        why = " ".join(str(error).split())[:120]
        raise SampleTypeError(f"{key}: expected a tensor of numbers, got {type(value).__name__} ({why})") from None


def _numbers(key: str, value: Any, index: tuple[int, ...]) -> np.ndarray:
    """An entry of the calibration for one frame, float64."""
    array = numbers(key, value)
    try:
        return np.asarray(array[index])
    except IndexError:
        raise SampleError(f"{key}: expected the images' leading dimensions, got shape {array.shape}") from None
