"""The views of one frame, and their label maps: plans executed by OpenCV or torch, and images that are only resized.

Every renderer returns a ``Views``, every filler of holes takes and returns one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.framing import Fit, framing
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError
from arbiview_aug.image_ops import FRESH, Memory, interleaved, nearest_resized, resized, write_halved
from arbiview_aug.render.confidence import confidence
from arbiview_aug.render.harmonise import LEVELS, SHARES, Curves
from arbiview_aug.render.plan import AtlasLayout, FixedMap, HoleContents, RenderPlan
from arbiview_aug.render.torch_backend import render_torch
from arbiview_aug.sample.batching import barred, covered, framed, stacked
from arbiview_aug.sample.frame import Frame

_REMAP_COLUMNS = 32000  # cv2.remap needs sizes below 32767
_STRIP_ROWS = 32  # rows that are read together: they stay in the CPU's cache
_FLAGS = {"nearest": cv2.INTER_NEAREST, "linear": cv2.INTER_LINEAR, "cubic": cv2.INTER_CUBIC}


def render_opencv(
    plan: RenderPlan,
    images: Sequence[torch.Tensor],
    curves: Curves | None = None,
    seams: list[torch.Tensor] | None = None,
    memory: Memory = FRESH,
) -> list[torch.Tensor]:
    """Render the target views of one frame with ``cv2.remap``; not differentiable.

    Args:
        plan: The plan for these images' rig.
        images: N images (3, H, W) on the CPU: uint8, or float in [0, 1].
        curves: Tone curves of each view for the pixels of each image.
        seams: A list to append to, for each view, (h, w) float32: the change of the winner's colour by blending a
            second source, mean over the channels, in the images' unit.
        memory: Memory to reuse between calls.

    Returns:
        M views (3, h, w) of the images' type, black where no source sees; slices of one block where sizes agree.
    """
    from arbiview_aug.render.photometry_kernels import blend, read_ahead, tone, tone_pixels

    dtype = images[0].dtype
    work = torch.uint8 if dtype == torch.uint8 else torch.float32
    atlas = _fill_atlas(plan.layout, [image.detach().to(work) for image in images], memory)
    rows_of_bytes = atlas.view(np.uint8).reshape(len(atlas), -1)
    sizes = [target.source_camera.shape for target in plan.targets]
    if len(set(sizes)) == 1:
        views = list(torch.empty((len(sizes), 3, *sizes[0]), dtype=work))
    else:
        views = [torch.empty((3, *size), dtype=work) for size in sizes]
    scale = LEVELS if work == torch.uint8 else SHARES
    pixels = memory.empty((max(target.source_camera.size for target in plan.targets), 3), atlas.dtype)
    for number, (target, view) in enumerate(zip(plan.targets, views, strict=True)):
        (h, w), at, seam = target.source_camera.shape, target.at, target.seam
        change = np.zeros(h * w if seams is not None else 0, np.float32)
        if seams is not None:
            seams.append(torch.from_numpy(change.reshape(h, w)))
        if not target.pairs:
            view.zero_()
            continue
        flat = pixels[: h * w]
        buffer = flat.reshape(h, w, 3)
        for y in range(0, h, _STRIP_ROWS):
            rows = slice(y, y + _STRIP_ROWS)
            read_ahead(rows_of_bytes, 3 * atlas.itemsize, at.packed[rows], target.source_camera[rows])
            _remap(atlas, at.xy[rows], at.frac[rows], target.interpolation, dst=buffer[rows])
        if target.edge is not None:
            if work != torch.uint8:
                np.clip(buffer, 0, 1, out=buffer)  # cubics overshoot
            edge = FixedMap(at.xy.reshape(1, -1, 2)[:, target.edge], at.frac.reshape(1, -1)[:, target.edge])
            flat[target.edge] = _read_pixels(atlas, edge, "linear")
        second = _read_pixels(atlas, seam.at, target.seam_interpolation)
        # Tone the views, not the sources: these have more pixels, and would have to be copied.
        if curves is not None:
            tones = np.ascontiguousarray(curves[number], np.float32)  # another layout would be compiled, too
            tones = tones if tones.ndim == 3 else tones[:, None].repeat(h, 1)
            tone(buffer.reshape(h, -1), target.runs, tones, *scale)
            tone_pixels(second, seam.source, seam.pixel // w, tones, *scale)
        if seams is not None:
            change[seam.pixel] = np.abs(flat[seam.pixel].astype(np.float32) - second).mean(-1) * seam.weight
        blend(flat, seam.pixel, second, seam.weight, scale[1])
        cv2.split(buffer, list(view.numpy()))
    return [view.to(dtype) for view in views]


def _read_pixels(atlas: np.ndarray, at: FixedMap, interpolation: str) -> np.ndarray:
    """The colours (n, 3) of the atlas at a map (1, n)."""
    colours = np.empty((1, at.xy.shape[1], 3), atlas.dtype)
    for first in range(0, colours.shape[1], _REMAP_COLUMNS):
        some = np.s_[:, first : first + _REMAP_COLUMNS]
        _remap(atlas, at.xy[some], at.frac[some], interpolation, dst=colours[some])
    return colours[0]


def _fill_atlas(layout: AtlasLayout, images: Sequence[torch.Tensor], memory: Memory) -> np.ndarray:
    """The atlas (rows, columns, 3) of (3, H, W) uint8 or float32 images; a channels-last block is used uncopied."""
    block = _stacked_block(layout, images)
    if block is not None:
        return block
    atlas = memory.empty((*layout.size, 3), images[0].numpy().dtype)
    if atlas.dtype != np.uint8:
        atlas.fill(0)  # between slots too: a tap of weight 0 times NaN is NaN
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
        alike = image.shape == images[0].shape and image.stride() == images[0].stride()
        if not alike or image.data_ptr() != images[0].data_ptr() + k * step:
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


def render_labels(plan: RenderPlan, labels: Sequence[torch.Tensor], fill: float) -> list[torch.Tensor]:
    """Render N label maps (..., H, W) of any type by the winning source's nearest label; ``fill`` where uncovered."""
    rendered, device = [], labels[0].device
    for target in plan.targets:
        at, winner = (torch.from_numpy(a).to(device) for a in (target.at.to_float(), target.source_camera))
        out = labels[0].new_full((*labels[0].shape[:-2], *winner.shape), fill)
        for slot in [plan.layout.slot(pair.source, pair.level) for pair in target.pairs]:
            won, label = winner == slot.source, labels[slot.source]
            x, y = (
                ((at[..., k][won] - first + 0.5) * 2**slot.level).floor().long().clamp(0, n - 1)
                for k, (first, n) in enumerate(zip((slot.x, slot.y), label.shape[:-3:-1], strict=True))
            )
            out[..., won] = label[..., y, x]
        rendered.append(out)
    return rendered


Backend = Literal["auto", "opencv", "torch"]

Maps = torch.Tensor | list[torch.Tensor]
"""Maps of M views: (M, h, w) where their sizes agree, else a list of (h, w)."""

LabelFill = Callable[[torch.dtype], float]
"""Gives the value of uncovered label pixels; raises SampleError if a type cannot hold it."""

LabelRenderer = Callable[[Sequence[torch.Tensor], LabelFill], list[torch.Tensor]]
"""Renders N label maps (..., H, W) of the sources as M maps (..., h, w) of the views."""


@dataclass(frozen=True, eq=False)
class Views:
    """The M views of one frame. It owns the memory of its maps; fillers may write into them.

    Attributes:
        images: M views (3, h, w), uint8 or float in [0, 1], black where uncovered; slices of one block where sizes
            agree.
        rig: Their cameras, in the source's ego frame.
        coverage: Bool, True where some source sees the pixel.
        source_camera: Int8 index of the winning source, -1 where uncovered; None unless requested, like the next two.
        source_frame: Int8, 0 for the current frame, n + 1 for number n of its neighbours, -1 where uncovered.
        confidence: Float32 in [0, 1], 0 where uncovered.
        generated: Bool, True where a filler made up the pixel; None before filling.
        holes: ``ViewPlan.holes`` of each view.
        certainty: (h, w) uint8 of each view as in ``ViewPlan``, for ``confidence_of``.
        seams: (h, w) float32 change of each view by blending, for ``confidence_of``.
        curves: Tone curves of each view for each source; None if exposures are as recorded.
        labels: Renders label maps; None if there are none.
    """

    images: list[torch.Tensor]
    rig: Rig
    coverage: Maps
    source_camera: Maps | None = None
    source_frame: Maps | None = None
    confidence: Maps | None = None
    generated: Maps | None = None
    holes: Sequence[HoleContents] = ()
    certainty: Sequence[npt.NDArray[np.uint8] | torch.Tensor] = ()
    seams: Sequence[torch.Tensor] = ()
    curves: Curves | None = None
    labels: LabelRenderer | None = None

    def with_maps(self, change: Callable[[Sequence[torch.Tensor], int], Maps]) -> Views:
        """The frame with ``change(map, value where uncovered)`` for each of its maps."""
        changed: dict[str, Any] = {}
        for key in MAP_KEYS:
            if (maps := getattr(self, key)) is not None:
                changed[key] = change(maps, -1 if key in ("source_camera", "source_frame") else 0)
        return replace(self, **changed)

    def between_bars(self, size: tuple[int, int]) -> Views:
        """The frame with every view at ``size`` (h, w), with black bars above and at both sides."""

        def with_bars(views: Sequence[torch.Tensor], empty: float) -> torch.Tensor:
            return torch.stack([barred(view, size, empty) for view in views])

        def labels(maps: Sequence[torch.Tensor], fill: LabelFill) -> list[torch.Tensor]:
            assert self.labels is not None
            return list(with_bars(self.labels(maps, fill), fill(maps[0].dtype)))

        images, rig = list(with_bars(self.images, 0)), self.rig.resized(size, "pad")
        return replace(self.with_maps(with_bars), images=images, rig=rig, labels=labels)


MAP_KEYS = ("coverage", "source_camera", "source_frame", "confidence", "generated")
"""Attributes of a ``Views``, and keys of a retargeted sample, that hold maps."""


# --- by a plan --------------------------------------------------------------------------------------------------------
class Renderer:
    """Executes render plans.

    Args:
        backend: ``opencv`` (CPU), ``torch`` (any device, differentiable), or ``auto``: OpenCV for CPU images that
            need no gradient.
    """

    def __init__(self, backend: Backend = "auto") -> None:
        self.backend = backend
        self._memory = Memory()

    def render(
        self,
        plans: Sequence[RenderPlan],
        frames: Sequence[Frame],
        curves: Sequence[Curves | None],
        outputs: Collection[str] = (),
    ) -> list[Views]:
        """Render frames by a plan each; torch renders frames that share a plan in one batch.

        ``curves`` are each frame's tone curves, or None; ``outputs`` are the requested keys among ``source_camera``,
        ``source_frame`` and ``confidence``. SampleError for ``backend="opencv"`` and an image on another device or with
        gradients.
        """
        with_seams = "confidence" in outputs
        rendered: dict[int, Views] = {}
        batches: dict[int, list[int]] = {}
        for b, (plan, frame) in enumerate(zip(plans, frames, strict=True)):
            if self._uses_torch(frame.images):
                batches.setdefault(id(plan), []).append(b)
                continue
            seams: list[torch.Tensor] | None = [] if with_seams else None
            views = render_opencv(plan, frame.images, curves[b], seams, self._memory)
            rendered[b] = _make_views(plan, views, seams or (), curves[b], outputs)
        for members in batches.values():
            plan = plans[members[0]]
            seams = [] if with_seams else None
            sources = [torch.stack(batch) for batch in zip(*(frames[b].images for b in members), strict=True)]
            views = render_torch(plan, sources, [curves[b] for b in members], seams)
            for k, b in enumerate(members):
                images, changes = [view[k] for view in views], [seam[k] for seam in seams or ()]
                rendered[b] = _make_views(plan, images, changes, curves[b], outputs)
        return [rendered[b] for b in range(len(frames))]

    def views(
        self,
        plan: RenderPlan,
        images: Sequence[torch.Tensor],
        curves: Curves | None,
        like: Sequence[torch.Tensor],
    ) -> list[torch.Tensor]:
        """The views (3, h, w) of one frame alone, executed as the images ``like`` would be."""
        if self._uses_torch(like):
            return [view[0] for view in render_torch(plan, [image[None] for image in images], [curves])]
        return render_opencv(plan, images, curves, memory=self._memory)

    def _uses_torch(self, images: Sequence[torch.Tensor]) -> bool:
        needed = any(image.device.type != "cpu" or image.requires_grad for image in images)
        if self.backend == "opencv" and needed:
            raise SampleError("backend='opencv': expected CPU images without gradients; use backend='torch'")
        return self.backend == "torch" or (self.backend == "auto" and needed)


def _make_views(
    plan: RenderPlan,
    images: list[torch.Tensor],
    seams: Sequence[torch.Tensor],
    curves: Curves | None,
    outputs: Collection[str],
) -> Views:
    views, on_device = plan.targets, plan.on_devices.get(images[0].device)
    winners = [view.source for view in on_device or ()] or [torch.from_numpy(view.source_camera) for view in views]
    rendered = from_winners(images, plan.target, winners, partial(render_labels, plan), outputs)
    rendered = replace(rendered, holes=[view.holes for view in views], curves=curves)
    if "confidence" not in outputs:
        return rendered
    certainty = [view.certainty for view in on_device or views if view.certainty is not None]
    rendered = replace(rendered, certainty=certainty, seams=seams)
    return replace(rendered, confidence=confidence_of(rendered))


def from_winners(
    images: list[torch.Tensor],
    rig: Rig,
    winners: Sequence[torch.Tensor],
    labels: Callable[[Sequence[torch.Tensor], float], list[torch.Tensor]],
    outputs: Collection[str],
) -> Views:
    """A frame with the maps that follow from the (h, w) int8 winning sources, copied."""
    return Views(
        images,
        rig,
        covered(winners),
        source_camera=stacked([winner.clone() for winner in winners]) if "source_camera" in outputs else None,
        source_frame=stacked([winner.clamp(max=0) for winner in winners]) if "source_frame" in outputs else None,
        labels=lambda maps, fill: labels(maps, fill(maps[0].dtype)),
    )


def confidence_of(rendered: Views) -> Maps:
    """Compute the confidence of a frame's views from their certainty, seams and contrast."""
    views = zip(rendered.images, rendered.certainty, rendered.coverage, rendered.seams, strict=True)
    return stacked([confidence(*view) for view in views])


# --- resized only -----------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Resizer:
    """Resizes the images of frames without retargeting them to ``size`` (h, w); all but bars is covered."""

    size: tuple[int, int] | None
    fit: Fit
    outputs: Collection[str] = ()

    def plan(self, frame: Frame, target: Rig) -> Frame:
        """The frame itself."""
        return frame

    def render(self, plans: Sequence[Frame]) -> list[Views]:
        """Resize frames."""
        return list(map(self._resize, plans))

    def _resize(self, frame: Frame) -> Views:
        size, outputs, device = self.size, self.outputs, frame.images[0].device
        assert size is not None
        framings = [framing(camera.name, camera.size, size, self.fit) for camera in frame.rig]
        coverage = torch.stack([framed(torch.ones(f.scaled, dtype=torch.bool, device=device), f) for f in framings])
        current = coverage.to(torch.int8) - 1
        numbers = torch.arange(len(coverage), dtype=torch.int8, device=device)[:, None, None]
        return Views(
            [framed(resized(image, f.scaled), f) for image, f in zip(frame.images, framings, strict=True)],
            frame.rig.resized(size, self.fit),
            coverage,
            source_camera=torch.where(coverage, numbers, current) if "source_camera" in outputs else None,
            source_frame=current if "source_frame" in outputs else None,
            confidence=coverage.float() if "confidence" in outputs else None,
            generated=torch.zeros_like(coverage),
            labels=lambda maps, fill: [
                framed(nearest_resized(label, f.scaled), f, fill(label.dtype) if f.has_bars else 0)
                for label, f in zip(maps, framings, strict=True)
            ],
        )
