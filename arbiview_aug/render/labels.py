"""What goes with the images: label maps rendered like them, labels in the ego frame moved, and nothing left stale."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.framing import Framing
from arbiview_aug.cameras.key_names import misnamed
from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.favs.renderer import PaperRendering, paper_labels
from arbiview_aug.image_ops import nearest_resized
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.sample.batching import barred, framed, gathered, is_readable, rewrapped, split, stacked
from arbiview_aug.sample.check import EGO_KEYS, PIXEL_BOUND_KEYS
from arbiview_aug.sample.inputs import Frame

# --- which keys are what ----------------------------------------------------------------------------------------------


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


# --- label maps -------------------------------------------------------------------------------------------------------
def target_labels(
    key: str,
    value: Any,
    frames: Sequence[Frame],
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


def _check_maps(key: str, maps: Any, frame: Frame) -> None:
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


def render_labels(plan: RenderPlan, labels: Sequence[torch.Tensor], fill: float) -> list[torch.Tensor]:
    """Label maps of the target views: the winning source's nearest label, ``fill`` where none sees.

    Args:
        plan: The plan for these labels' rig.
        labels: N maps (..., H, W) of any type and device.
        fill: Value of uncovered pixels.
    """
    rendered = []
    for target in plan.targets:
        positions = target.at.to_float()
        out = labels[0].new_full((*labels[0].shape[:-2], *target.source_camera.shape), fill)
        for pair in target.pairs:
            slot = plan.layout.slot(pair.source, pair.level)
            won = target.source_camera == pair.source
            uv = slot.to_source(positions[won])
            label = labels[pair.source]
            h, w = label.shape[-2:]
            pixel = np.floor(uv + 0.5).astype(np.int64).clip(0, (w - 1, h - 1))
            x, y = (torch.from_numpy(np.ascontiguousarray(pixel[:, k])).to(label.device) for k in (0, 1))
            out[..., torch.from_numpy(won).to(label.device)] = label[..., y, x]
        rendered.append(out)
    return rendered
