"""The output sample: rendered views with their calibration, label maps, and labels in the ego frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from arbiview_aug import transforms
from arbiview_aug.cameras.key_names import hint
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, SampleTypeError, shown
from arbiview_aug.inpaint.inpainter import SOURCES_KEY
from arbiview_aug.render.rendered import MAP_KEYS, Views
from arbiview_aug.sample.batching import (
    gathered,
    is_readable,
    leading_shape,
    lens_names,
    like,
    rewrapped,
    split,
    stacked,
)
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import CALIBRATION_KEYS, CAMERA_KEYS, PIXEL_BOUND_KEYS
from arbiview_aug.transforms.settings import SampleKeys

_MATRICES = ("K", "cam2ego")


# --- one sample -------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class SampleWriter:
    """Writes rendered frames as a sample of the form that they were read from."""

    keys: SampleKeys
    generated: bool  # whether to write ``generated``
    lenses: bool  # ``lens`` and ``distortion``
    masks: bool  # ``ego_mask``
    warn: Callable[[str, str], None]  # takes a topic and a message

    def write(
        self,
        sample: Mapping[str, Any],
        frames: Sequence[Frame],
        rendered: Sequence[Views],
        labels: Sequence[str],
        target: Rig,
        params: Mapping[str, float],
        points: Sequence[transforms.RetargetedPoints] = (),
    ) -> dict[str, Any]:
        """Write the output sample of a ``sample`` and its frames; the input is not changed.

        ``labels`` are the sample's keys of label maps; ``target`` is in its own ego frame; ``points`` are what its
        scanners measured.
        """
        lead = leading_shape(sample["images"])
        # Entries that do not depend on the images pass as the same objects.
        named = (*labels, *self.keys.keep)
        stale = [key for key in sample if key in (*PIXEL_BOUND_KEYS, *CAMERA_KEYS) and key not in named]
        # The coverage of an earlier retargeting already masks what it generated.
        dropped = [key for key in stale if key not in (*self.keys.extra, "generated", "depth_m")]
        if dropped:
            meant = "" if "depth_m" in sample else hint(dropped, ("depth_m",))
            message = f"RigRetarget drops {', '.join(dropped)}: they speak of the source's pixels or cameras{meant}"
            self.warn(f"dropped {dropped}", message)
        kept = ("images", "K", "cam2ego", *named)  # the first three are replaced in their places in the dict
        out = {k: v for k, v in sample.items() if k in kept or k not in (*CALIBRATION_KEYS, *stale)}
        out |= transforms.entries_of(points, lead) if points else {}
        out["images"] = rewrapped(gathered([stacked(frame.images) for frame in rendered], lead), sample["images"])
        rigs, device = [frame.rig for frame in rendered], rendered[0].images[0].device
        entries = calibration_entries(rigs, device, lead, lenses=self.lenses, masks=self.masks)
        entries |= {key: like(entries[key], sample.get(key)) for key in _MATRICES}
        entries |= {key: entries[key].to(entries["K"].device) for key in ("ground_z_m", "distortion") if key in entries}
        out |= entries | {"ground_z_m": entries["ground_z_m"] if lead else rigs[0].ground_z_m}
        out["coverage"] = gathered([frame.coverage for frame in rendered], lead)
        for key in ("generated", *self.keys.extra) if self.generated else self.keys.extra:
            if key in MAP_KEYS:
                out[key] = gathered([getattr(frame, key) for frame in rendered], lead)
        if SOURCES_KEY in self.keys.extra:
            entries = calibration_entries([frame.rig for frame in frames], frames[0].images[0].device, lead)
            out[SOURCES_KEY] = {"images": sample["images"], **entries}
        for key in labels:
            out[key] = target_labels(key, sample[key], frames, lead, rendered, self.keys.ignore_index)
        if params:
            out["retarget_params"] = params
        if self.keys.frame == "target":
            moves = [torch.from_numpy(frame.rig.ego2ego(target)) for frame in frames]
            move_to_target(out, gathered(moves, lead), lead)
            out["ground_z_m"] = torch.full_like(out["ground_z_m"], target.ground_z_m) if lead else target.ground_z_m
        return out


# --- calibration ------------------------------------------------------------------------------------------------------
def calibration_entries(
    rigs: Sequence[Rig], device: torch.device, lead: tuple[int, ...], *, lenses: bool = True, masks: bool = True
) -> dict[str, Any]:
    """``K``, ``cam2ego``, ``ground_z_m``, ``distortion``, ``lens`` of frames' rigs; ``ego_mask`` on the device."""
    parts: dict[str, list[Any]] = {key: [torch.from_numpy(getattr(rig, key)) for rig in rigs] for key in _MATRICES}
    if lenses:
        padded = [[(*c.distortion, *(0.0,) * (8 - len(c.distortion))) for c in rig] for rig in rigs]
        parts["distortion"] = [torch.tensor(coefficients, dtype=torch.float64) for coefficients in padded]
    if masks:
        ignored = [[np.zeros(c.size, bool) if c.mask is None else ~c.mask for c in rig] for rig in rigs]
        parts["ego_mask"] = [stacked([torch.from_numpy(mask).to(device) for mask in row]) for row in ignored]
    entries = {key: gathered(values, lead) for key, values in parts.items()}
    if lenses:
        entries["lens"] = lens_names([[c.lens for c in rig] for rig in rigs], lead)
    grounds = torch.tensor([rig.ground_z_m for rig in rigs], dtype=torch.float64)
    return entries | {"ground_z_m": grounds.reshape(lead)}


# --- label maps -------------------------------------------------------------------------------------------------------
def target_labels(
    key: str, value: Any, frames: Sequence[Frame], lead: tuple[int, ...], rendered: Sequence[Views], fill: float
) -> Any:
    """Render label maps in the target's views; SampleError for maps or a fill value that do not fit."""

    def checked_fill(dtype: torch.dtype) -> float:
        if dtype == torch.bool:
            return False
        limits: Any = torch.finfo(dtype) if dtype.is_floating_point else torch.iinfo(dtype)
        is_held = limits.min <= fill <= limits.max  # not NaN
        if dtype.is_floating_point:
            is_held |= not math.isfinite(fill)
        else:
            is_held = is_held and fill == int(fill)
        if not is_held:
            fix = "give SampleKeys another ignore_index, or the map another type"
            raise SampleError(f"{key}: SampleKeys.ignore_index: expected a value of {dtype}, got {shown(fill)}; {fix}")
        return fill

    outputs = []
    for views, maps in zip(rendered, label_maps(key, value, frames, lead), strict=True):
        assert views.labels is not None
        if (dtype := maps[0].dtype) in (torch.uint16, torch.uint32, torch.uint64):  # torch cannot index them by masks
            raise SampleTypeError(f"{key}: expected uint8 or signed label maps, got {dtype}; use .to(torch.int32)")
        outputs.append(stacked(views.labels([label.as_subclass(torch.Tensor) for label in maps], checked_fill)))
    return rewrapped(gathered(outputs, lead), value)


def label_maps(key: str, value: Any, frames: Sequence[Frame], lead: tuple[int, ...]) -> list[Any]:
    """Label maps of each frame, from (*lead, N, ..., H, W) or a list by camera; SampleError if images do not fit."""
    if not all(map(is_readable, value if isinstance(value, list | tuple) else [value])):
        got = type(value).__name__
        raise SampleTypeError(f"{key}: expected label maps as tensors, got {got}; use torch.as_tensor")
    if isinstance(value, torch.Tensor) and value.ndim < len(lead) + 3:
        raise SampleError(f"{key}: expected label maps of shape (..., N, H, W), got {tuple(value.shape)}")
    frame_maps = split(key, value, lead)
    for frame, maps in zip(frames, frame_maps, strict=True):
        if len(maps) != len(frame.images):
            raise SampleError(f"{key}: expected {len(frame.images)} label maps, one an image, got {len(maps)}")
        for camera, label in zip(frame.rig, maps, strict=True):
            where, size = f"{key}: camera {camera.name!r}", tuple(label.shape[-2:])
            if size != camera.size:
                raise SampleError(f"{where}: expected a map of (h, w) = {camera.size}, got {size}")
            if (label.shape[:-2], label.dtype) != (maps[0].shape[:-2], maps[0].dtype):
                first, this = ((str(m.dtype), *m.shape[:-2], "H", "W") for m in (maps[0], label))
                fix = "merge masks of instances into one map of their numbers"
                raise SampleError(f"{where}: expected {first} as of the first, got {this}; {fix}")
    return frame_maps


# --- labels in the ego frame ------------------------------------------------------------------------------------------
def move_to_target(out: dict[str, Any], ego2ego: torch.Tensor, lead: tuple[int, ...]) -> None:
    """Move an output sample's poses, points and boxes by the translation of ``ego2ego`` (*lead, 4, 4); copies them."""
    # Sums instead of matrix products, which autocast and TF32 would round.
    out["ego2ego"], offset_m = ego2ego.to(out["cam2ego"].device), ego2ego[..., :3, 3]
    out["cam2ego"] = out["cam2ego"].clone()
    out["cam2ego"][..., :3, 3] += offset_m[..., None, :].to(out["cam2ego"])
    for key in ("points", "boxes_3d"):
        if out.get(key) is not None:
            out[key] = _translated(key, out[key], offset_m, lead)
    if (pose := out.get("ego2world")) is not None:
        where = "ego2world: SampleKeys.frame='target'"
        if tuple(getattr(pose, "shape", (4, 4)))[-2:] != (4, 4):
            raise SampleError(f"{where}: expected shape (..., 4, 4), got {pose.shape}")
        is_array = isinstance(pose, np.ndarray) and pose.dtype.kind in "fiu"
        if not is_array and not (is_readable(pose) and pose.is_floating_point()):
            kind = pose.dtype if isinstance(pose, torch.Tensor) else type(pose).__name__
            raise SampleTypeError(f"{where}: expected a float tensor, got {kind}")
        moved = torch.from_numpy(pose.astype(np.float64)) if is_array else pose
        try:
            batch_shape = torch.broadcast_shapes(moved.shape[:-2], offset_m.shape[:-1])
        except RuntimeError:
            expected = (*offset_m.shape[:-1], 4, 4)
            raise SampleError(f"ego2world: expected shape {expected}, got {tuple(pose.shape)}") from None
        moved = moved.expand(*batch_shape, 4, 4).clone()
        moved[..., :3, 3] -= (moved[..., :3, :3] * offset_m[..., None, :].to(moved)).sum(-1)
        out["ego2world"] = moved.numpy() if is_array else moved


def _translated(key: str, value: Any, offset_m: torch.Tensor, lead: tuple[int, ...]) -> Any:
    """Points or boxes (*lead, P, C), or a list of them for each frame, moved by (*lead, 3)."""
    if isinstance(value, list | tuple):
        offsets = offset_m.reshape(-1, 3).expand(len(value) if not lead else -1, 3)
        if len(offsets) != len(value):
            raise SampleError(f"{key}: expected {len(offsets)} entries, one a frame, got {len(value)}")
        return [_translated(key, v, o, ()) for v, o in zip(value, offsets, strict=True)]
    if isinstance(value, np.ndarray) and value.dtype.kind == "f":
        native = value.astype(value.dtype.newbyteorder("="))  # torch reads no other byte order
        return _translated(key, torch.from_numpy(native), offset_m, lead).numpy()
    if not is_readable(value) or not value.is_floating_point():
        kind = value.dtype if isinstance(value, torch.Tensor) else type(value).__name__
        raise SampleTypeError(f"{key}: SampleKeys.frame='target': expected a float tensor, got {kind}")
    if not value.numel():  # empty, in any shape
        return value.clone()
    if value.ndim < len(lead) + 1 or value.shape[-1] < 3 or tuple(value.shape[: len(lead)]) != lead:
        expected = ", ".join((*map(str, lead), "count", ">=3"))
        raise SampleError(f"{key}: expected shape ({expected}), got {tuple(value.shape)}")
    moved = value.clone()
    moved[..., :3] += offset_m.reshape(*lead, *(1,) * (value.ndim - len(lead) - 1), 3).to(moved)
    return moved
