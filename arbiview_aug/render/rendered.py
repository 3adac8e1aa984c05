"""The views of one frame, and their label maps.

Every renderer returns a ``RenderedFrame``, every filler of holes takes and returns one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.framing import Fit, framing
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError
from arbiview_aug.image_ops import Scratch, nearest_resized, resized
from arbiview_aug.render.confidence import confidence
from arbiview_aug.render.opencv_backend import render_opencv
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.torch_backend import render_torch
from arbiview_aug.render.view_plan import Paint
from arbiview_aug.sample.batching import barred, covered, framed, stacked
from arbiview_aug.sample.inputs import Frame


def render_labels(plan: RenderPlan, labels: Sequence[torch.Tensor], fill: float) -> list[torch.Tensor]:
    """Render label maps by the winning source's nearest label; ``fill`` where uncovered.

    Args:
        plan: The plan for these labels' rig.
        labels: N maps (..., H, W) of any type and device.
        fill: Value of uncovered pixels.
    """
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
class RenderedFrame:
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
        layers: (h, w) uint8 of each view as in ``ViewPlan``, or None.
        paint: That of each view as in ``ViewPlan``, or None.
        road: That of each view as in ``ViewPlan``, or None.
        certainty: (h, w) uint8 of each view as in ``ViewPlan``, for ``confidence_of``.
        seams: (h, w) float32 of each view, by how much blending changed it, for ``confidence_of``.
        curves: (M, N, 2) tone curves of each view for each source; None if exposures are as recorded.
        labels: Renders label maps; None if there are none.
    """

    images: list[torch.Tensor]
    rig: Rig
    coverage: Maps
    source_camera: Maps | None = None
    source_frame: Maps | None = None
    confidence: Maps | None = None
    generated: Maps | None = None
    layers: Sequence[npt.NDArray[np.uint8] | None] = ()
    paint: Sequence[Paint | None] = ()
    road: Sequence[npt.NDArray[np.bool_] | None] = ()
    certainty: Sequence[npt.NDArray[np.uint8] | torch.Tensor] = ()
    seams: Sequence[torch.Tensor] = ()
    curves: npt.NDArray[np.float64] | None = None
    labels: LabelRenderer | None = None

    def with_maps(self, change: Callable[[Sequence[torch.Tensor], int], Maps]) -> RenderedFrame:
        """The frame with ``change(map, value where uncovered)`` for each of its maps."""
        changed: dict[str, Any] = {}
        for key in MAP_KEYS:
            if (maps := getattr(self, key)) is not None:
                changed[key] = change(maps, -1 if key in ("source_camera", "source_frame") else 0)
        return replace(self, **changed)

    def between_bars(self, size: tuple[int, int]) -> RenderedFrame:
        """The frame with every view at ``size`` (h, w), black bars above and at both sides."""

        def with_bars(views: Sequence[torch.Tensor], empty: float) -> torch.Tensor:
            return torch.stack([barred(view, size, empty) for view in views])

        def labels(maps: Sequence[torch.Tensor], fill: LabelFill) -> list[torch.Tensor]:
            assert self.labels is not None
            return list(with_bars(self.labels(maps, fill), fill(maps[0].dtype)))

        images, rig = list(with_bars(self.images, 0)), self.rig.resized(size, "pad")
        return replace(self.with_maps(with_bars), images=images, rig=rig, labels=labels)


MAP_KEYS = ("coverage", "source_camera", "source_frame", "confidence", "generated")
"""Attributes of a ``RenderedFrame``, and keys of a retargeted sample, that hold maps."""


# --- by a plan --------------------------------------------------------------------------------------------------------
class Renderer:
    """Executes render plans.

    Args:
        backend: ``opencv`` (CPU), ``torch`` (any device, differentiable), or ``auto``: OpenCV for CPU images that
            need no gradient.
    """

    def __init__(self, backend: Backend = "auto") -> None:
        self.backend = backend
        self._scratch = Scratch()

    def render(
        self,
        plans: Sequence[RenderPlan],
        frames: Sequence[Frame],
        curves: Sequence[npt.NDArray[np.float64] | None],
        outputs: Collection[str] = (),
    ) -> list[RenderedFrame]:
        """Render frames; torch renders those that share a plan in one batch.

        Args:
            plans: One for each frame.
            frames: The frames.
            curves: For each frame the tone curves (M, N, 2) of each view for each source, or None.
            outputs: The requested of ``source_camera``, ``source_frame`` and ``confidence``.

        Raises:
            SampleError: ``backend="opencv"``, and an image is on another device or needs gradients.
        """
        with_seams = "confidence" in outputs
        rendered: dict[int, RenderedFrame] = {}
        batches: dict[int, list[int]] = {}
        for b, (plan, frame) in enumerate(zip(plans, frames, strict=True)):
            if self._uses_torch(frame.images):
                batches.setdefault(id(plan), []).append(b)
                continue
            seams: list[torch.Tensor] | None = [] if with_seams else None
            views = render_opencv(plan, frame.images, self._scratch, curves[b], seams)
            rendered[b] = _rendered(plan, views, seams or (), curves[b], outputs)
        for members in batches.values():
            plan = plans[members[0]]
            seams = [] if with_seams else None
            sources = [torch.stack(images) for images in zip(*(frames[b].images for b in members), strict=True)]
            views = render_torch(plan, sources, [curves[b] for b in members], seams)
            for k, b in enumerate(members):
                of_frame = [view[k] for view in views], [seam[k] for seam in seams or ()]
                rendered[b] = _rendered(plan, *of_frame, curves[b], outputs)
        return [rendered[b] for b in range(len(frames))]

    def views(
        self,
        plan: RenderPlan,
        images: Sequence[torch.Tensor],
        curves: npt.NDArray[np.float64] | None,
        like: Sequence[torch.Tensor],
    ) -> list[torch.Tensor]:
        """The views (3, h, w) of one frame alone, executed as the images ``like`` would be."""
        if self._uses_torch(like):
            return [view[0] for view in render_torch(plan, [image[None] for image in images], [curves])]
        return render_opencv(plan, images, self._scratch, curves)

    def _uses_torch(self, images: Sequence[torch.Tensor]) -> bool:
        needed = any(image.device.type != "cpu" or image.requires_grad for image in images)
        if self.backend == "opencv" and needed:
            raise SampleError("backend='opencv': expected CPU images without gradients; use backend='torch'")
        return self.backend == "torch" or (self.backend == "auto" and needed)


def _rendered(
    plan: RenderPlan,
    images: list[torch.Tensor],
    seams: Sequence[torch.Tensor],
    curves: npt.NDArray[np.float64] | None,
    outputs: Collection[str],
) -> RenderedFrame:
    views, on_device = plan.targets, plan.on_devices.get(images[0].device)
    winners = [view.source for view in on_device or ()] or [torch.from_numpy(view.source_camera) for view in views]
    rendered = from_winners(images, plan.target, winners, partial(render_labels, plan), outputs)
    layers, paint, road = zip(*((view.layers, view.paint, view.road) for view in views), strict=True)
    rendered = replace(rendered, layers=layers, paint=paint, road=road, curves=curves)
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
) -> RenderedFrame:
    """A frame with the maps that follow from the (h, w) int8 winning sources, copied."""
    return RenderedFrame(
        images,
        rig,
        covered(winners),
        source_camera=stacked([winner.clone() for winner in winners]) if "source_camera" in outputs else None,
        source_frame=stacked([winner.clamp(max=0) for winner in winners]) if "source_frame" in outputs else None,
        labels=lambda maps, fill: labels(maps, fill(maps[0].dtype)),
    )


def confidence_of(rendered: RenderedFrame) -> Maps:
    """Compute the confidence of a frame's views from their certainty, seams and contrast."""
    of_views = zip(rendered.images, rendered.certainty, rendered.coverage, rendered.seams, strict=True)
    return stacked([confidence(*of_view) for of_view in of_views])


# --- resized only -----------------------------------------------------------------------------------------------------
def resize_only(frame: Frame, size: tuple[int, int], fit: Fit, outputs: Collection[str] = ()) -> RenderedFrame:
    """Resize a frame to ``size`` (h, w) without retargeting it; its views are fully covered."""
    device = frame.images[0].device
    framings = [framing(camera.name, camera.size, size, fit) for camera in frame.rig]
    coverage = torch.stack([framed(torch.ones(f.scaled, dtype=torch.bool, device=device), f) for f in framings])
    current = coverage.to(torch.int8) - 1
    numbers = torch.arange(len(coverage), dtype=torch.int8, device=device)[:, None, None]
    return RenderedFrame(
        [framed(resized(image, f.scaled), f) for image, f in zip(frame.images, framings, strict=True)],
        frame.rig.resized(size, fit),
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
