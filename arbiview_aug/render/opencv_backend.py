"""Render plans executed by OpenCV, for images on the CPU."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.image_ops import Scratch, interleaved, write_halved
from arbiview_aug.render.atlas import AtlasLayout
from arbiview_aug.render.harmonise import LEVELS, SHARES
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.view_plan import BilinearFallback

_REMAP_COLUMNS = 32000  # cv2.remap needs sizes below 32767
_STRIP_ROWS = 32  # are read together: they stay in the CPU's cache
_FLAGS = {"nearest": cv2.INTER_NEAREST, "linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC}


def render_opencv(
    plan: RenderPlan,
    images: Sequence[torch.Tensor],
    scratch: Scratch | None = None,
    curves: npt.NDArray[np.float64] | None = None,
    seams: list[torch.Tensor] | None = None,
) -> list[torch.Tensor]:
    """Render the target views of one frame with ``cv2.remap``; not differentiable.

    Args:
        plan: The plan for these images' rig.
        images: N images (3, H, W) on the CPU: uint8, or float in [0, 1].
        scratch: Buffers to reuse between calls.
        curves: (M, N, 2) tone curves of each view for the pixels of each image.
        seams: A list to append to, for each view, (h, w) float32: by how much blending a second source changed the
            winner's colour, mean over the channels, in the images' unit.

    Returns:
        M views (3, h, w) of the images' type, black where no source sees; slices of one (M, 3, h, w) block where all
        targets have one size.
    """
    from arbiview_aug.render.kernels import read_ahead
    from arbiview_aug.render.photometry_kernels import tone

    scratch = scratch or Scratch()
    dtype = images[0].dtype
    work = torch.uint8 if dtype == torch.uint8 else torch.float32
    atlas = _fill_atlas(plan.layout, [image.detach().to(work) for image in images], scratch)
    rows_of_bytes = atlas.view(np.uint8).reshape(len(atlas), -1)
    views = _empty_views(plan, work)
    scale = LEVELS if work == torch.uint8 else SHARES
    sizes = {target.source_camera.shape for target in plan.targets}
    buffers = {size: scratch.get(f"view {size}", (*size, 3), atlas.dtype) for size in sizes}
    for number, (target, view) in enumerate(zip(plan.targets, views, strict=True)):
        tones = None if curves is None else curves[number].astype(np.float32)
        h, w = target.source_camera.shape
        change = np.zeros((h, w), np.float32) if seams is not None else None
        if seams is not None:
            seams.append(torch.from_numpy(change))
        if not target.pairs:
            view.zero_()
            continue
        buffer = buffers[h, w]
        for y in range(0, h, _STRIP_ROWS):
            rows = slice(y, y + _STRIP_ROWS)
            strip = buffer[rows]
            xy = target.at.xy[rows]
            read_ahead(rows_of_bytes, 3 * atlas.itemsize, xy.view(np.int32)[..., 0], target.source_camera[rows])
            _remap(atlas, xy, target.at.frac[rows], target.interpolation, dst=strip)
            if target.edge is not None:
                _put_edge(target.edge.rows(y, y + _STRIP_ROWS, w), atlas, strip)
        # Tone the views, not the sources: these have more pixels, and would have to be copied.
        if tones is not None:
            tone(buffer.reshape(-1), target.runs, tones, *scale)
        for band in target.bands:
            bh, bw = band.weight.shape
            part = buffer[band.y : band.y + bh, band.x : band.x + bw]
            second = _remap(atlas, band.at.xy, band.at.frac, target.seam_interpolation)
            if tones is not None and tones[band.source, 0] != 1:
                tone(second.reshape(-1), np.array([[0, bh * bw, band.source]]), tones, *scale)
            if change is not None:
                difference = np.abs(part.astype(np.float32) - second).mean(-1)
                change[band.y : band.y + bh, band.x : band.x + bw] += difference * band.weight
            part[...] = cv2.blendLinear(part, second, 1 - band.weight, band.weight)
        cv2.split(buffer, list(view.numpy()))
    return [view.to(dtype) for view in views]


def _put_edge(edge: BilinearFallback, atlas: np.ndarray, strip: np.ndarray) -> None:
    """Read bilinearly where cubics would reach too far, and clip what cubics overshot in float images."""
    if strip.dtype != np.uint8:
        np.clip(strip, 0, 1, out=strip)
    flat = strip.reshape(-1, 3)
    for first in range(0, len(edge.pixel), _REMAP_COLUMNS):
        some = slice(first, first + _REMAP_COLUMNS)
        flat[edge.pixel[some]] = _remap(atlas, edge.at.xy[:, some], edge.at.frac[:, some], "linear")[0]


def _empty_views(plan: RenderPlan, dtype: torch.dtype) -> list[torch.Tensor]:
    sizes = [target.source_camera.shape for target in plan.targets]
    if len(set(sizes)) == 1:
        return list(torch.empty((len(sizes), 3, *sizes[0]), dtype=dtype))
    return [torch.empty((3, *size), dtype=dtype) for size in sizes]


def _fill_atlas(layout: AtlasLayout, images: Sequence[torch.Tensor], scratch: Scratch) -> np.ndarray:
    """The atlas (rows, columns, 3) of (3, H, W) uint8 or float32 images; a channels-last block is used as it is."""
    block = _stacked_block(layout, images)
    if block is not None:
        return block
    dtype = np.uint8 if images[0].dtype == torch.uint8 else np.float32
    atlas = scratch.get("atlas", (*layout.size, 3), dtype)
    for slot in layout.slots:
        h, w = slot.size
        write_halved(images[slot.source], slot.level, atlas[slot.y : slot.y + h, slot.x : slot.x + w])
    return atlas


def _stacked_block(layout: AtlasLayout, images: Sequence[torch.Tensor]) -> np.ndarray | None:
    """The images' own memory as the atlas, if they lie below each other in one channels-last block."""
    if not layout.is_stack:
        return None
    first = interleaved(images[0])
    if first is None:
        return None
    step, storage = first.nbytes, images[0].untyped_storage()
    for k, image in enumerate(images):
        if image.data_ptr() != images[0].data_ptr() + k * step or image.stride() != images[0].stride():
            return None
        if image.untyped_storage().data_ptr() != storage.data_ptr():
            return None  # neighbours in memory by chance, or slices of one numpy array
    h, w = images[0].shape[1:]
    stack = torch.as_strided(images[0], (len(images) * h, w, 3), (w * 3, 3, 1))
    return stack.numpy()


def _remap(
    atlas: np.ndarray,
    xy: npt.NDArray[np.int16],
    frac: npt.NDArray[np.uint16],
    interpolation: str,
    dst: np.ndarray | None = None,
) -> np.ndarray:
    """Read the atlas at a fixed-point map, (h, w, 3); ``OUTSIDE`` is black. ``nearest`` wants a ``rounded`` map."""
    fractions = None if interpolation == "nearest" else frac
    return cv2.remap(atlas, xy, fractions, _FLAGS[interpolation], dst=dst)  # type: ignore[call-overload,arg-type]
