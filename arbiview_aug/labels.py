"""What goes with the images: label maps rendered like them, labels in the ego frame moved, and nothing left stale."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.favs.paper import PaperRendering, paper_labels
from arbiview_aug.favs.synthesis import render_labels
from arbiview_aug.framing import Framing
from arbiview_aug.keys import misnamed
from arbiview_aug.plan import RenderPlan
from arbiview_aug.sample import CALIBRATION_KEYS, SourceFrame
from arbiview_aug.tensors import barred, framed, gathered, is_readable, nearest_resized, rewrapped, split, stacked

PIXEL_BOUND_KEYS = (
    "boxes_2d",
    "labels_2d",
    "detections",
    "centers_2d",
    "depths",
    "depth",
    "depth_m",
    "keypoints_2d",
    "source_camera",
    "source_frame",
    "confidence",
    "generated",
    "sources",
)
"""Keys known to speak of the source's pixels: dropped, because they would be stale in the target's views."""

EGO_KEYS = ("points", "boxes_3d", "ego2world")
"""Keys known to be in the ego frame: they pass, or move with ``label_frame="target"``."""

_MOST_NESTED = 64  # entries of a list that are looked at: longer lists are tokens or numbers


# --- which keys are what ----------------------------------------------------------------------------------------------
def check_other_keys(
    sample: Mapping[str, Any],
    sizes: Sequence[tuple[int, ...]],
    label_keys: Sequence[str],
    pass_keys: Sequence[str],
) -> list[str]:
    """Which keys hold label maps; refuses whatever else may speak of the source's pixels.

    Args:
        sample: The sample dict.
        sizes: The (h, w) of its images.
        label_keys: Named by the user as label maps.
        pass_keys: Named by the user as harmless.

    Raises:
        SampleError: A tensor of the images' height and width, or a torchvision tv_tensor, that nobody named.
    """
    absent = [key for key in label_keys if key not in sample]
    if absent:
        raise SampleError(f"label_keys: expected {', '.join(absent)} in the sample, got {', '.join(map(str, sample))}")
    labels = list(label_keys)
    for key, value in sample.items():
        if key in (*CALIBRATION_KEYS, *PIXEL_BOUND_KEYS, *EGO_KEYS, *labels, *pass_keys):
            continue
        first = value[0] if isinstance(value, list | tuple) and value else value
        if _tv_tensor(first) == "Mask":
            labels.append(key)
            continue
        for leaf in _leaves(value):
            if kind := _tv_tensor(leaf):
                raise SampleError(
                    f"{key}: a tv_tensors.{kind} speaks of the source's pixels and would be stale; "
                    f"drop it, or name it in pass_keys=({key!r},)"
                )
            shape = tuple(getattr(leaf, "shape", ()))
            if any(pair in sizes for pair in pairwise(shape)):
                raise SampleError(
                    f"{key}: shape {shape} looks like a map over the source's pixels and would be stale; name it in "
                    f"label_keys=({key!r},) to render it, or in pass_keys=({key!r},) to keep it as it is"
                )
    return labels


def warn_of_misnamed(
    sample: Mapping[str, Any],
    calibrated: bool,
    static: bool,
    named: Sequence[str],
    warn: Callable[[str, str], None],
) -> None:
    """Say which keys go unread because they are probably called something else here.

    Args:
        sample: The sample dict.
        calibrated: A rig says what its ``lens``, ``distortion`` and ``ground_z_m`` would.
        static: Nothing in the ego frame is read or moved.
        named: Keys that the user named: they are as they should be.
        warn: Takes a topic and words.
    """
    lenses = () if calibrated else ("distortion", "lens", "ground_z_m")
    geometry = () if static else (*EGO_KEYS, "depth_m")
    for found, meant in misnamed(sample, ("neighbours", *lenses, *geometry)).items():
        if found not in (*named, *PIXEL_BOUND_KEYS):  # it is said of these that they are dropped
            words = f"the sample's {found!r} is not read; did you mean {meant!r}?"
            warn(f"key {found}", f"{words} Rename it, in the form that RigRetarget documents, or name it in pass_keys")


def _tv_tensor(value: Any) -> str:
    kind = type(value)
    return kind.__name__ if kind.__module__.startswith("torchvision.tv_tensors") else ""


def _leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, Mapping):
        for entry in value.values():
            yield from _leaves(entry)
    elif isinstance(value, list | tuple):
        for entry in value[:_MOST_NESTED]:
            yield from _leaves(entry)
    else:
        yield value


# --- label maps -------------------------------------------------------------------------------------------------------
def target_labels(
    key: str,
    value: Any,
    frames: Sequence[SourceFrame],
    lead: tuple[int, ...],
    views: Sequence[RenderPlan | PaperRendering | list[Framing]],
    fill: float,
    size: tuple[int, int] | None = None,
) -> Any:
    """The label maps (..., N, H, W) of a sample in the target's views.

    Args:
        key: Named in error messages.
        value: A tensor, or a list of one (..., Hi, Wi) tensor a camera.
        frames: The frames of the sample.
        lead: Its leading dimensions.
        views: The plan of each frame, or its rendering by ``quality="paper"``; or, where the frame keeps its cameras,
            how each comes to its new size.
        fill: Value of pixels that no source sees (False for bool maps).
        size: (h, w) of the maps, where rendered views stand between bars.

    Raises:
        SampleError: Maps that do not belong to the images, or a fill that their type cannot hold.
        SampleTypeError: Maps that are no tensors.
    """
    maps_given = value if isinstance(value, list | tuple) else [value]
    if not all(map(is_readable, maps_given)):
        got = type(value).__name__
        raise SampleTypeError(f"{key}: expected label maps as tensors, got {got}; use torch.as_tensor")
    if isinstance(value, torch.Tensor) and value.ndim < len(lead) + 3:
        raise SampleError(f"{key}: expected label maps of shape (..., N, H, W), got {tuple(value.shape)}")
    try:
        of_frames = split(value, lead)
    except ValueError as error:
        raise SampleError(f"{key}: {error}") from None
    rendered = []
    for frame, view, maps in zip(frames, views, of_frames, strict=True):
        _check_maps(key, maps, frame)
        plain = [label.as_subclass(torch.Tensor) for label in maps]
        empty = partial(_checked_fill, key, fill, plain[0].dtype)
        if isinstance(view, list):
            found = [
                framed(nearest_resized(label, f.scaled), f, empty() if f.has_bars else 0)
                for label, f in zip(plain, view, strict=True)
            ]
        else:
            render = paper_labels if isinstance(view, PaperRendering) else render_labels
            found = render(view, plain, empty())  # type: ignore[arg-type, operator]
            if size is not None:
                found = [barred(label, size, empty()) for label in found]
        rendered.append(stacked(found))
    return rewrapped(gathered(rendered, lead), value)


def _check_maps(key: str, maps: Any, frame: SourceFrame) -> None:
    if len(maps) != len(frame.images):
        raise SampleError(f"{key}: expected {len(frame.images)} label maps, one an image, got {len(maps)}")
    for camera, label in zip(frame.rig, maps, strict=True):
        size = tuple(label.shape[-2:])
        if size != camera.size:
            raise SampleError(f"{key}: camera {camera.name!r}: expected a map of (h, w) = {camera.size}, got {size}")


def _checked_fill(key: str, fill: float, dtype: torch.dtype) -> float:
    if dtype == torch.bool:
        return False
    if not dtype.is_floating_point:
        limits = torch.iinfo(dtype)
        if not limits.min <= fill <= limits.max or fill != int(fill):  # NaN fails the first
            raise SampleError(f"{key}: label_fill: expected a value of {dtype}, got {fill!r}")
    return fill


# --- labels in the ego frame ------------------------------------------------------------------------------------------
def move_to_target(out: dict[str, Any], ego2ego: torch.Tensor, lead: tuple[int, ...]) -> None:
    """Poses, points and boxes of an output sample into the target's ego frame, which differs by a translation.

    Args:
        out: The output; its entries are replaced, never written to.
        ego2ego: (*lead, 4, 4) source's ego frame to target's.
        lead: Leading dimensions.
    """
    # Sums, no products of matrices: those autocast, or TF32, would round to bfloat16's metres in a thousand.
    out["ego2ego"], offset_m = ego2ego.to(out["cam2ego"].device), ego2ego[..., :3, 3]
    out["cam2ego"] = out["cam2ego"].clone()
    out["cam2ego"][..., :3, 3] += offset_m[..., None, :].to(out["cam2ego"])
    for key in ("points", "boxes_3d"):
        if out.get(key) is not None:
            out[key] = _translated(key, out[key], offset_m, lead)
    if out.get("ego2world") is not None:
        pose = out["ego2world"]
        if tuple(getattr(pose, "shape", (4, 4)))[-2:] != (4, 4):
            raise SampleError(f"ego2world: label_frame='target': expected shape (..., 4, 4), got {pose.shape}")
        if isinstance(pose, np.ndarray) and pose.dtype.kind in "fiu":
            out["ego2world"] = _before_move(torch.from_numpy(pose.astype(np.float64)), offset_m).numpy()
        elif is_readable(pose) and pose.is_floating_point():
            out["ego2world"] = _before_move(pose, offset_m)
        else:
            kind = pose.dtype if isinstance(pose, torch.Tensor) else type(pose).__name__
            raise SampleTypeError(f"ego2world: label_frame='target': expected a float tensor, got {kind}")


def _before_move(pose: torch.Tensor, offset_m: torch.Tensor) -> torch.Tensor:
    """Poses (*lead, 4, 4) of an ego frame as those of one that lies (*lead, 3) behind it."""
    try:
        lead = torch.broadcast_shapes(pose.shape[:-2], offset_m.shape[:-1])
    except RuntimeError:
        expected = (*offset_m.shape[:-1], 4, 4)
        raise SampleError(f"ego2world: expected shape {tuple(expected)}, got {tuple(pose.shape)}") from None
    moved = pose.expand(*lead, 4, 4).clone()
    moved[..., :3, 3] -= (pose[..., :3, :3] * offset_m[..., None, :].to(pose)).sum(-1)
    return moved


def _translated(key: str, value: Any, offset_m: torch.Tensor, lead: tuple[int, ...]) -> Any:
    """Points or boxes (*lead, P, C) moved by (*lead, 3); lists have an entry for each frame."""
    if isinstance(value, list | tuple):
        offsets = offset_m.reshape(-1, 3).expand(len(value) if not lead else -1, 3)
        if len(offsets) != len(value):
            raise SampleError(f"{key}: expected {len(offsets)} entries, one a frame, got {len(value)}")
        return [_translated(key, v, o, ()) for v, o in zip(value, offsets, strict=True)]
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        return _translated(key, torch.tensor(value), offset_m, lead).numpy()
    if not is_readable(value) or not value.is_floating_point():
        kind = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
        raise SampleTypeError(f"{key}: label_frame='target': expected a float tensor, got {kind}")
    if not value.numel():  # in any shape nothing stands there
        return value.clone()
    if value.ndim < len(lead) + 1 or value.shape[-1] < 3 or tuple(value.shape[: len(lead)]) != lead:
        expected = ", ".join((*map(str, lead), "count", ">=3"))
        raise SampleError(f"{key}: expected shape ({expected}), got {tuple(value.shape)}")
    moved = value.clone()
    moved[..., :3] += offset_m.reshape(*lead, *(1,) * (value.ndim - len(lead) - 1), 3).to(moved)
    return moved
