"""The sample contract: what a sample must hold, checked once at the boundary, with messages that say how to mend it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from arbiview_aug.camera import Camera
from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.rig import Rig

CALIBRATION_KEYS = ("images", "rig", "K", "cam2ego", "distortion", "lens", "ground_z_m")
"""Keys that describe the source's cameras; they are replaced by the target's or consumed."""

PIXEL_BOUND_KEYS = ("boxes_2d", "labels_2d", "centers_2d", "depths", "depth", "keypoints_2d", "neighbours")
"""Keys known to speak of the source's pixels: dropped, because they would be stale in the target's views."""


@dataclass(frozen=True)
class SourceFrame:
    """The images and calibration of one checked sample.

    Attributes:
        images: N tensors (3, H, W): uint8, or float in [0, 1].
        rig: Their cameras.
    """

    images: tuple[torch.Tensor, ...]
    rig: Rig


def check_inputs(sample: Any, source_rig: Rig | None) -> list[SourceFrame]:
    """The frames of a sample, one for each element of its leading dimensions (one if there are none).

    Args:
        sample: The sample dict; see DESIGN's contract in ``RigRetarget``.
        source_rig: The rig of every sample, where the transform was given one.

    Raises:
        SampleError: Missing calibration, mismatched counts or sizes, values out of range.
        SampleTypeError: PIL images, numpy arrays and the like, with the conversion to use.
    """
    if not isinstance(sample, Mapping):
        raise SampleTypeError(f"sample: expected a dict, got {type(sample).__name__}")
    if "images" not in sample:
        raise SampleError(f"sample: expected a key 'images', got {', '.join(map(str, sample)) or 'an empty dict'}")
    images = sample["images"]
    lead = leading_shape(images)
    if not lead:
        return [_frame(_image_tuple(images), sample, source_rig, None)]
    flat = images.reshape(-1, *images.shape[-4:])
    return [
        _frame(_image_tuple(flat[b]), sample, source_rig, np.unravel_index(b, lead)) for b in range(flat.shape[0])
    ]


def leading_shape(images: Any) -> tuple[int, ...]:
    """Batch dimensions of (..., N, 3, H, W) images; none for lists."""
    return tuple(images.shape[:-4]) if isinstance(images, torch.Tensor) and images.ndim > 4 else ()


def _image_tuple(images: Any) -> tuple[torch.Tensor, ...]:
    if isinstance(images, torch.Tensor):
        if images.ndim != 4:
            raise SampleError(f"images: expected shape (..., N, 3, H, W), got {tuple(images.shape)}")
    elif isinstance(images, Sequence) and not isinstance(images, str | bytes):
        for k, image in enumerate(images):
            if not isinstance(image, torch.Tensor):
                raise _not_a_tensor(f"images[{k}]", image)
    else:
        raise _not_a_tensor("images", images)
    if len(images) == 0:
        raise SampleError("images: expected at least one image, got none")
    for k, image in enumerate(images):
        _check_image(k, image)
    if len({image.dtype for image in images}) > 1 or len({image.device for image in images}) > 1:
        raise SampleError("images: expected one dtype and device, got several; convert them alike")
    return tuple(images)


def _not_a_tensor(what: str, value: Any) -> SampleTypeError:
    kind = type(value).__name__
    if isinstance(value, np.ndarray):
        fix = "torch.from_numpy(array).permute(2, 0, 1) for an (H, W, 3) RGB array"
    elif "PIL" in type(value).__module__:
        fix = "torchvision.transforms.v2.functional.pil_to_tensor(image)"
    else:
        fix = "a (N, 3, H, W) tensor, or a list of (3, H, W) tensors"
    return SampleTypeError(f"{what}: expected torch tensors, got {kind}; use {fix}")


def _check_image(k: int, image: torch.Tensor) -> None:
    if image.ndim != 3 or image.shape[0] != 3:
        shape = tuple(image.shape)
        fix = ""
        if image.ndim == 3 and shape[-1] in (1, 3, 4):
            fix = "; permute(2, 0, 1) puts the channels first"
        elif (image.ndim == 3 and shape[0] == 1) or image.ndim == 2:
            fix = "; expand grey images to three channels: image.expand(3, -1, -1)"
        elif image.ndim == 3 and shape[0] == 4:
            fix = "; drop the alpha channel: image[:3]"
        raise SampleError(f"images[{k}]: expected an RGB image (3, H, W), got shape {shape}{fix}")
    if 0 in image.shape:
        raise SampleError(f"images[{k}]: expected pixels, got shape {tuple(image.shape)}")
    if image.dtype == torch.uint8:
        return
    if not image.dtype.is_floating_point:
        raise SampleTypeError(f"images[{k}]: expected uint8 or float, got {image.dtype}; convert with .to(torch.uint8)")
    low, high = (float(x) for x in image.detach().aminmax())
    if not (low >= -1e-3 and high <= 1 + 1e-3):  # also catches NaN
        fix = "divide by 255" if high > 1.5 and low >= 0 else "normalise after retargeting, not before"
        raise SampleError(f"images[{k}]: expected floats in [0, 1], got {low:g} to {high:g}; {fix}")


def _frame(
    images: tuple[torch.Tensor, ...], sample: Mapping[str, Any], source_rig: Rig | None, index: Any
) -> SourceFrame:
    rig = sample.get("rig")
    if rig is None:
        rig = source_rig if source_rig is not None else _rig_from_tensors(images, sample, index)
    if not isinstance(rig, Rig):
        raise SampleTypeError(f"rig: expected an arbiview_aug.Rig, got {type(rig).__name__}; use load_rig(path)")
    if len(rig) != len(images):
        raise SampleError(f"images: expected {len(rig)} images for cameras {', '.join(rig.names)}, got {len(images)}")
    for camera, image in zip(rig, images, strict=True):
        size = tuple(image.shape[-2:])
        if size != camera.size:
            fix = "height and width are swapped" if size == camera.size[::-1] else "use rig.resized((h, w)) or crop"
            raise SampleError(
                f"camera {camera.name!r}: expected an image of (h, w) = {camera.size}, as calibrated, got {size}; {fix}"
            )
    return SourceFrame(images, rig)


def _rig_from_tensors(images: tuple[torch.Tensor, ...], sample: Mapping[str, Any], index: Any) -> Rig:
    """A rig from the sample's K, cam2ego and, where present, lens, distortion and ground_z_m."""
    missing = [key for key in ("K", "cam2ego") if sample.get(key) is None]
    if missing:
        raise SampleError(
            f"sample: expected calibration, 'rig' or 'K' and 'cam2ego', missing {', '.join(missing)}; "
            "or pass source_rig= to the transform"
        )
    K, cam2ego = (_as_array(key, sample[key], index) for key in ("K", "cam2ego"))
    for key, array, shape in (("K", K, (3, 3)), ("cam2ego", cam2ego, (4, 4))):
        if array.shape != (len(images), *shape):
            raise SampleError(f"{key}: expected shape {(len(images), *shape)} for {len(images)} images, got {array.shape}")
    lenses = sample.get("lens") or ["pinhole"] * len(images)
    cameras = []
    for k, image in enumerate(images):
        h, w = image.shape[-2:]
        name = f"camera {k}"
        if not (-0.5 <= K[k, 0, 2] <= w - 0.5 and -0.5 <= K[k, 1, 2] <= h - 0.5):
            raise SampleError(
                f"K[{k}]: expected a principal point inside the image of (h, w) = {(h, w)}, got "
                f"({K[k, 0, 2]:g}, {K[k, 1, 2]:g}); K of another image size? (Camera.resize scales K; a camera that is "
                "really so comes as rig=)"
            )
        coefficients: tuple[float, ...] = ()
        if lenses[k] != "pinhole":
            coefficients = tuple(_as_array("distortion", sample["distortion"], index)[k].tolist())
            coefficients = coefficients[:4] if lenses[k] == "fisheye" else coefficients
        cameras.append(
            Camera(
                name=name, width_px=w, height_px=h, K=K[k], cam2ego=cam2ego[k], lens=lenses[k], distortion=coefficients
            )
        )
    return Rig(cameras, ground_z_m=float(sample.get("ground_z_m", 0.0)))


def _as_array(key: str, value: Any, index: Any) -> np.ndarray:
    try:
        array = np.asarray(value.detach().cpu() if isinstance(value, torch.Tensor) else value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise SampleTypeError(f"{key}: expected a tensor of numbers, got {type(value).__name__} ({error})") from None
    if index is None:
        return array
    try:
        return array[tuple(index)]
    except IndexError:
        raise SampleError(f"{key}: expected the images' leading dimensions, got shape {array.shape}") from None


def check_other_keys(
    sample: Mapping[str, Any], sizes: Sequence[tuple[int, int]], label_keys: Sequence[str], pass_keys: Sequence[str]
) -> list[str]:
    """Which keys hold label maps; refuses whatever else may speak of the source's pixels.

    Raises:
        SampleError: A tensor of the images' height and width, or a torchvision tv_tensor, that nobody named.
    """
    absent = [key for key in label_keys if key not in sample]
    if absent:
        raise SampleError(f"label_keys: expected {', '.join(absent)} in the sample, got {', '.join(map(str, sample))}")
    labels = list(label_keys)
    for key, value in sample.items():
        if key in CALIBRATION_KEYS or key in PIXEL_BOUND_KEYS or key in labels or key in pass_keys:
            continue
        first = value[0] if isinstance(value, list | tuple) and value else value
        if type(first).__module__.startswith("torchvision.tv_tensors"):
            if type(first).__name__ == "Mask":
                labels.append(key)
                continue
            raise SampleError(
                f"{key}: a tv_tensors.{type(first).__name__} speaks of the source's pixels and would be stale; "
                f"drop it, or name it in pass_keys=({key!r},)"
            )
        shape = tuple(getattr(first, "shape", ()))
        if len(shape) >= 2 and shape[-2:] in sizes:
            raise SampleError(
                f"{key}: shape {shape} looks like a map over the source's pixels and would be stale; name it in "
                f"label_keys=({key!r},) to render it, or in pass_keys=({key!r},) to keep it as it is"
            )
    return labels
