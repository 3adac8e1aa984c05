"""The rig of a frame: from the sample's calibration and masks, or the transform's own; error messages give the fix."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.key_names import hint
from arbiview_aug.cameras.lens import LENSES, BoolArray, FloatArray, canonical_name
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, SampleTypeError, one_line, shown
from arbiview_aug.sample.batching import entry
from arbiview_aug.scene.surface import Points

CHECKED_KEYS = frozenset(("K", "cam2ego", "lens", "distortion", "ground_z_m"))
"""Keys that are compared with the transform's ``source``."""

_OFF_CENTER = 0.2  # a principal point is never off centre by this share of the image's size along both axes
_ON_CENTER = 0.05  # with K of another image size it is farther off along both axes


def read_rig(
    images: tuple[torch.Tensor, ...],
    sample: Mapping[str, Any],
    source: Rig | None,
    lead: tuple[int, ...] = (),
    index: tuple[int, ...] = (),
) -> Rig:
    """Read the rig of one frame's images, at an ``index`` into the sample's leading dimensions."""
    rig = sample.get("rig")
    if rig is None:
        rig = source if source is not None else _rig_from_tensors(images, sample, index)
    if not isinstance(rig, Rig):
        raise SampleTypeError(f"rig: expected an arbiview_aug.Rig, got {type(rig).__name__}; use load_rig(path)")
    if len(rig) != len(images):
        raise SampleError(f"images: expected {len(rig)} images for cameras {', '.join(rig.names)}, got {len(images)}")
    for camera, image in zip(rig, images, strict=True):
        size = tuple(image.shape[-2:])
        if size != camera.size:
            fix = "height and width are swapped" if size == camera.size[::-1] else "use rig.resized((h, w)) or crop"
            expected = f"an image of (h, w) = {camera.size}, as calibrated"
            raise SampleError(f"camera {camera.name!r}: expected {expected}, got {size}; {fix}")
    return _with_masks(rig, sample, lead, index)


def differing_keys(source: Rig, sample: Mapping[str, Any], lead: tuple[int, ...]) -> Iterator[str]:
    """Calibration keys of a sample that are not those of the transform's ``source``, beyond rounding."""
    for key, expected in (("K", source.K), ("cam2ego", source.cam2ego), ("ground_z_m", np.array(source.ground_z_m))):
        got = expected if sample.get(key) is None else numbers(key, sample[key])
        is_shaped = expected.ndim == 0 or got.shape in (expected.shape, (*lead, *expected.shape))
        if not is_shaped or not np.allclose(got, expected, 1e-4, 1e-3):
            yield key
    if sample.get("lens") is not None or sample.get("distortion") is not None:
        for index in np.ndindex(*lead):
            for camera, (lens, coefficients) in zip(source, _lenses(sample, len(source), index), strict=True):
                pairs = zip_longest(camera.distortion, coefficients, fillvalue=0.0)
                if lens != camera.lens or not all(math.isclose(*pair, rel_tol=1e-4, abs_tol=1e-6) for pair in pairs):
                    yield "lens"


def _rig_from_tensors(images: tuple[torch.Tensor, ...], sample: Mapping[str, Any], index: tuple[int, ...]) -> Rig:
    """The rig of the sample's K, cam2ego and, where present, lens, distortion and ground_z_m."""
    if missing := [key for key in ("K", "cam2ego") if sample.get(key) is None]:
        got = f"missing {', '.join(missing)}{hint(sample, missing)}; or give RigRetarget the rig as source="
        raise SampleError(f"sample: expected calibration, 'rig' or 'K' and 'cam2ego', {got}")
    K, cam2ego = (numbers(key, sample[key], index) for key in ("K", "cam2ego"))
    for key, array, expected in (("K", K, (len(images), 3, 3)), ("cam2ego", cam2ego, (len(images), 4, 4))):
        if array.shape != expected:
            fix = "; pass K[..., :3, :3]" if key == "K" and array.shape[1:] in ((3, 4), (4, 4)) else ""
            got = f"{array.shape}{' in a frame of the batch' if index else ''}{fix}"
            raise SampleError(f"{key}: expected shape {expected} for {len(images)} images, got {got}")
    cameras = []
    for k, (image, (lens, distortion)) in enumerate(zip(images, _lenses(sample, len(images), index), strict=True)):
        h, w = image.shape[-2:]
        if sample.get("coverage") is None:  # rendered views are cropped as their target asks
            _check_principal_point(k, K[k], (h, w))
        calibration: dict[str, Any] = {"K": K[k], "cam2ego": cam2ego[k], "lens": lens, "distortion": distortion}
        cameras.append(Camera(name=f"camera {k}", width_px=w, height_px=h, **calibration))
    given = sample.get("ground_z_m")
    ground_z_m = numbers("ground_z_m", 0.0 if given is None else given, index)
    if ground_z_m.size != 1:
        raise SampleError(f"ground_z_m: expected one height for each frame, got shape {ground_z_m.shape}")
    return Rig(cameras, ground_z_m=float(ground_z_m.item()))


def _check_principal_point(k: int, K: np.ndarray, size: tuple[int, int]) -> None:
    """Refuse a K that was made for another image size; ``Camera`` refuses NaN."""
    x, y = (K[:2, 2] + 0.5) / size[::-1] - 0.5  # from the image's centre, as a share of its size
    off_swapped = np.abs((K[:2, 2] + 0.5) / size - 0.5).max()
    outside = max(abs(x), abs(y)) > 0.5 and min(abs(x), abs(y)) > _ON_CENTER  # crops may leave it out on one side
    scaled = max(x, y) < -_OFF_CENTER or min(x, y) > _OFF_CENTER
    swapped = max(abs(x), abs(y)) > 0.12 and off_swapped < 0.05
    if not (outside or scaled or swapped):
        return
    where = "inside the image" if outside else "near the middle of the image"
    fix = "height and width are swapped" if swapped else "K of another image size? Camera.resize scales K"
    got = f"({K[0, 2]:g}, {K[1, 2]:g}); {fix}; pass rig= if the camera is really like this"
    raise SampleError(f"K[{k}]: expected a principal point {where} of (h, w) = {size}, got {got}")


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
        raise SampleError(f"lens: expected a list of {count} names, one for each camera, got {shown(names)}")
    lenses = [_lens(name, index) for name in names]
    if all(lens in LENSES and LENSES[lens].coefficient_counts == (0,) for lens in lenses):
        return [(lens, ()) for lens in lenses]
    if coefficients is None or coefficients.ndim != 2 or len(coefficients) != count:
        got = f"none{hint(sample, ('distortion',))}" if coefficients is None else f"shape {coefficients.shape}"
        raise SampleError(f"distortion: expected shape ({count}, up to 8) for the lenses {lenses}, got {got}")
    counts = (LENSES[lens].coefficient_counts[-1] if lens in LENSES else coefficients.shape[1] for lens in lenses)
    rows = zip(lenses, counts, coefficients.tolist(), strict=True)
    return [(lens, tuple(row if any(row[count:]) else row[:count])) for lens, count, row in rows]


def _lens(name: Any, index: tuple[int, ...]) -> str:
    """The lens of a camera in one frame: ``default_collate`` makes lists of a batch's names."""
    for i in index:
        if isinstance(name, str):
            break
        if not isinstance(name, list | tuple) or not i < len(name):
            raise SampleError(f"lens: expected a name for each frame of the batch, got {shown(name)}")
        name = name[i]
    if not isinstance(name, str):
        raise SampleTypeError(f"lens: expected names, one for each camera, got {shown(name)}")
    return canonical_name(name)


def _with_masks(rig: Rig, sample: Mapping[str, Any], lead: tuple[int, ...], index: tuple[int, ...]) -> Rig:
    """The rig, masked where an earlier retargeting saw nothing (``coverage``) or its own car (``ego_mask``)."""
    masks: list[BoolArray | None] = [camera.mask for camera in rig]
    for key in ("coverage", "ego_mask"):
        if sample.get(key) is None:
            continue
        try:
            maps = entry(sample[key], lead, index)
            hidden = [~m if key == "coverage" else m for m in maps]
            for k, (camera, pixels) in enumerate(zip(rig, hidden, strict=True)):
                if tuple(pixels.shape) != camera.size or pixels.dtype != torch.bool:
                    raise ValueError(f"got {pixels.dtype} {tuple(pixels.shape)}")
                if pixels.any():
                    visible, mask = ~pixels.cpu().numpy(), masks[k]
                    masks[k] = visible if mask is None else mask & visible
        except (TypeError, ValueError, AttributeError, RuntimeError) as error:  # RuntimeError: meta, sparse
            expected = f"a bool tensor of each image's size, as an earlier retargeting gives it ({error})"
            raise SampleError(f"{key}: expected {expected}; rename the key if it is something else") from None
    if all(mask is camera.mask for mask, camera in zip(masks, rig, strict=True)):
        return rig
    return rig.with_cameras([replace(camera, mask=mask) for camera, mask in zip(rig, masks, strict=True)])


def numbers(key: str, value: Any, index: tuple[int, ...] = ()) -> FloatArray:
    """An entry of a sample as a float64 array, at an ``index`` into its leading dimensions; scalars hold for all."""
    array = np.asarray(as_array(key, value), np.float64)
    try:
        return np.asarray(array[index]) if array.ndim else array
    except IndexError:
        raise SampleError(f"{key}: expected the images' leading dimensions, got shape {array.shape}") from None


def as_array(key: str, value: Any) -> Points:
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
        got = f"{type(value).__name__} ({one_line(error, 120)})"
        raise SampleTypeError(f"{key}: expected a tensor of numbers, got {got}") from None
