"""The rig of a frame: from the sample's calibration and masks, or the transform's own; error messages give the fix."""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping
from dataclasses import replace
from itertools import zip_longest
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.key_names import hint
from arbiview_aug.cameras.lens import LENSES, FloatArray, canonical_name
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, SampleTypeError, one_line, shown
from arbiview_aug.scene.surface import Points

NUMBERS = ("K", "cam2ego", "distortion", "ground_z_m")
"""Keys of a calibration's arrays."""

_OFF_CENTER = 0.2  # a principal point is never off centre by this share of the image's size along both axes
_ON_CENTER = 0.05  # with K of another image size it is farther off along both axes


def read_rig(images: tuple[torch.Tensor, ...], sample: Mapping[str, Any], source: Rig | None) -> Rig:
    """Read the rig of one frame's images from its ``sample`` without leading dimensions."""
    rig = sample.get("rig")
    if rig is None:
        rig = source if source is not None else _rig_from_tensors(images, sample)
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
    return _with_masks(rig, sample)


def check_source(source: Rig, sample: Mapping[str, Any]) -> None:
    """Refuse a frame whose calibration is not that of the transform's ``source``, beyond rounding."""
    differing = []
    for key in ("K", "cam2ego", "ground_z_m"):
        given, expected = sample.get(key), np.asarray(getattr(source, key))
        is_shaped = given is None or not expected.ndim or given.shape == expected.shape
        if not is_shaped or (given is not None and not np.allclose(given, expected, 1e-4, 1e-3)):
            differing.append(key)
    if sample.get("lens") is not None or sample.get("distortion") is not None:
        for camera, (lens, coefficients) in zip(source, _lenses(sample, len(source)), strict=True):
            pairs = zip_longest(camera.distortion, coefficients, fillvalue=0.0)
            if lens != camera.lens or not all(math.isclose(*pair, rel_tol=1e-4, abs_tol=1e-6) for pair in pairs):
                differing.append("lens")
    for key in differing[:1]:
        fix = f"drop source=, or {key} from the sample"
        raise SampleError(f"{key}: expected the calibration of source=, got another; {fix}")


def _rig_from_tensors(images: tuple[torch.Tensor, ...], sample: Mapping[str, Any]) -> Rig:
    """The rig of the sample's K, cam2ego and, where present, lens, distortion and ground_z_m."""
    if missing := [key for key in ("K", "cam2ego") if sample.get(key) is None]:
        got = f"missing {', '.join(missing)}{hint(sample, missing)}; or give RigRetarget the rig as source="
        raise SampleError(f"sample: expected calibration, 'rig' or 'K' and 'cam2ego', {got}")
    K, cam2ego = sample["K"], sample["cam2ego"]
    for key, array, expected in (("K", K, (len(images), 3, 3)), ("cam2ego", cam2ego, (len(images), 4, 4))):
        if array.shape != expected:
            fix = "; pass K[..., :3, :3]" if key == "K" and array.shape[1:] in ((3, 4), (4, 4)) else ""
            raise SampleError(f"{key}: expected shape {expected} for {len(images)} images, got {array.shape}{fix}")
    cameras = []
    for k, (image, (lens, distortion)) in enumerate(zip(images, _lenses(sample, len(images)), strict=True)):
        h, w = image.shape[-2:]
        if sample.get("coverage") is None:  # rendered views are cropped as their target asks
            _check_principal_point(k, K[k], (h, w))
        calibration: dict[str, Any] = {"K": K[k], "cam2ego": cam2ego[k], "lens": lens, "distortion": distortion}
        cameras.append(Camera(name=f"camera {k}", width_px=w, height_px=h, **calibration))
    ground_z_m = np.zeros(()) if sample.get("ground_z_m") is None else sample["ground_z_m"]
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


def _lenses(sample: Mapping[str, Any], count: int) -> list[tuple[Any, tuple[float, ...]]]:
    """Lens and coefficients of each camera, without the zeros that pad them to a common number."""
    names, coefficients = sample.get("lens"), sample.get("distortion")
    if names is None:
        if coefficients is not None and coefficients.any():
            expected = f"'lens' beside it, one of {', '.join(LENSES)} for each camera"
            raise SampleError(f"distortion: expected {expected}{hint(sample, ('lens',))}")
        return [("pinhole", ())] * count
    if not isinstance(names, list | tuple) or len(names) != count:
        raise SampleError(f"lens: expected a list of {count} names, one for each camera, got {shown(names)}")
    if not all(isinstance(name, str) for name in names):
        raise SampleTypeError(f"lens: expected names, one for each camera, got {shown(names)}")
    lenses = list(map(canonical_name, names))
    if all(lens in LENSES and LENSES[lens].coefficient_counts == (0,) for lens in lenses):
        return [(lens, ()) for lens in lenses]
    if coefficients is None or coefficients.ndim != 2 or len(coefficients) != count:
        got = f"none{hint(sample, ('distortion',))}" if coefficients is None else f"shape {coefficients.shape}"
        raise SampleError(f"distortion: expected shape ({count}, up to 8) for the lenses {lenses}, got {got}")
    counts = (LENSES[lens].coefficient_counts[-1] if lens in LENSES else coefficients.shape[1] for lens in lenses)
    rows = zip(lenses, counts, coefficients.tolist(), strict=True)
    return [(lens, tuple(row if any(row[count:]) else row[:count])) for lens, count, row in rows]


def _with_masks(rig: Rig, sample: Mapping[str, Any]) -> Rig:
    """The rig, masked where an earlier retargeting saw nothing (``coverage``) or its own car (``ego_mask``)."""
    cameras = list(rig)
    for key in ("coverage", "ego_mask"):
        if sample.get(key) is None:
            continue
        try:
            for k, (camera, pixels) in enumerate(zip(cameras, sample[key], strict=True)):
                if tuple(pixels.shape) != camera.size or pixels.dtype != torch.bool:
                    raise ValueError(f"got {pixels.dtype} {tuple(pixels.shape)}")
                visible = pixels if key == "coverage" else ~pixels
                if not visible.all():
                    mask = visible.cpu().numpy()
                    cameras[k] = replace(camera, mask=mask if camera.mask is None else camera.mask & mask)
        except (TypeError, ValueError, AttributeError, RuntimeError) as error:  # RuntimeError: meta, sparse
            expected = f"a bool tensor of each image's size, as an earlier retargeting gives it ({error})"
            raise SampleError(f"{key}: expected {expected}; rename the key if it is something else") from None
    return rig if all(map(operator.is_, cameras, rig)) else rig.with_cameras(cameras)


def numbers(key: str, value: Any) -> FloatArray:
    """An entry of a sample as a float64 array."""
    return np.asarray(as_array(key, value), np.float64)


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
