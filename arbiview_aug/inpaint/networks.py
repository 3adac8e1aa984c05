"""Pretrained inpainting networks: diffusers' pipelines and TorchScript files.

They see windows around the holes, at the view's resolution and aspect; seen pixels are unchanged. Small windows share a
canvas. Large and bent holes are cut into parts, and each part sees the pixels filled before it. Cracks are inpainted by
Telea's method.
"""

from __future__ import annotations

import warnings
from abc import abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Iterator, Sequence
from functools import partial
from itertools import groupby, zip_longest
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.choices import is_whole
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import GeneratorError, one_line
from arbiview_aug.files import check_regular, open_regular
from arbiview_aug.image_ops import bounding_box
from arbiview_aug.inpaint.inpainter import Inpainter, Tensors, check_device, checked_settings, telea

NARROW_PX = 5  # holes narrower than this are inpainted by Telea's method
_SEED = 2**31
_JOINED_PX = 8  # holes nearer than this to each other are one
_CONTEXT_PX = (12, 64)
"""Minimum and maximum context around a hole, pixels; in between, half of its shorter side."""

_WORTH = 0.8  # maximum share of the pixels in the windows of both parts, for a hole to be cut


class NetworkInpainter(Inpainter, torch.nn.Module):
    """A network that inpaints images.

    Args:
        network: Moves with this module.
        size: Longest side of an image that it sees, pixels; a multiple of ``multiple``.
        multiple: Sides that it sees are multiples of it.
        batch: Images that it sees at once.
        min_confidence: As for every ``Inpainter``, like ``seed``.
    """

    is_random = True

    def __init__(
        self,
        network: torch.nn.Module,
        size: int,
        multiple: int,
        batch: int,
        *,
        min_confidence: float = 0.0,
        seed: int = 0,
    ) -> None:
        super().__init__()
        self.min_confidence, self.seed = checked_settings(min_confidence, seed)
        if not all(is_whole(value, 1) for value in (size, multiple, batch)) or size % multiple:
            raise ValueError(
                "size, multiple, batch: expected whole numbers from 1, size a multiple of multiple, "
                f"got {size!r}, {multiple!r} and {batch!r}"
            )
        self.network = network.eval()
        for parameter in network.parameters():  # a script's module has no requires_grad_
            parameter.requires_grad_(False)
        self.size, self.multiple, self.batch = size, multiple, batch

    def train(self, mode: bool = True) -> NetworkInpainter:
        """Leave the network in evaluation mode: a transform in a model that trains still inpaints."""
        super().train(mode)
        self.network.eval()
        return self

    @property
    def device(self) -> torch.device:
        """Device of the network's weights."""
        return next((tensor.device for tensor in self.network.state_dict().values()), torch.device("cpu"))

    @abstractmethod
    def run(self, images: torch.Tensor, holes: torch.Tensor, seeds: Sequence[int]) -> torch.Tensor:
        """Inpaint images (B, 3, h, w) in [0, 1], black in their holes (B, h, w) bool; the same shape comes back."""

    def inpaint(self, views: Tensors, holes: Tensors, seeds: Sequence[int]) -> list[torch.Tensor]:
        """Fill the holes of one frame's views in windows around them; pixels outside the holes do not change."""
        return self._inpaint(views, holes, seeds, [len(views)])

    @torch.no_grad()
    def _inpaint(
        self, views: Tensors, holes: Tensors, seeds: Sequence[int], counts: Sequence[int]
    ) -> list[torch.Tensor]:
        check_device(self)
        tops = [255.0 if view.dtype == torch.uint8 else 1.0 for view in views]
        # The network sees narrow holes inpainted, and they stay so.
        pixels = [(telea(v, hole).float() / top).cpu().numpy() for v, hole, top in zip(views, holes, tops, strict=True)]
        # The remaining holes hold squares of NARROW_PX; the others are cracks and edges.
        masks, square = [hole.cpu().numpy().astype(np.uint8) for hole in holes], np.ones((NARROW_PX,) * 2, np.uint8)
        border: Any = {"borderType": cv2.BORDER_CONSTANT, "borderValue": 0}  # by default all outside a view is a hole
        left = [cv2.morphologyEx(mask, cv2.MORPH_OPEN, square, **border).astype(bool) for mask in masks]
        frame_of = np.repeat(np.arange(len(counts)), counts)
        for together in windows(left, self.size):
            alike: dict[tuple[int, ...], list[tuple[Canvas, npt.NDArray[np.float32]]]] = defaultdict(list)
            # Frames share calls, but no canvas: a network sees all of it.
            for _, parts in groupby(together, lambda window: frame_of[window.view]):
                for canvas in packed(parts, self.size):
                    drawing = drawn(canvas, pixels, left, self.multiple)
                    alike[drawing.shape].append((canvas, drawing))
            for group in alike.values():
                for start in range(0, len(group), self.batch):
                    self._fill(group[start : start + self.batch], pixels, left, seeds)
        filled = []
        for view, hole, view_pixels, top in zip(views, holes, pixels, tops, strict=True):
            values = torch.from_numpy(view_pixels * top).to(view.device)
            values = values.round() if view.dtype == torch.uint8 else values
            filled.append(torch.where(hole, values.to(view.dtype), view))
        return filled

    def _fill(self, group: Any, pixels: Any, left: Any, seeds: Sequence[int]) -> None:
        """Inpaint drawn canvases of one size, and put their pixels where they belong; their holes are left no more."""
        canvases, drawings = zip(*group, strict=True)
        drawing = torch.from_numpy(np.stack(drawings)).to(self.device)
        images, holes = drawing[:, :3].contiguous(), drawing[:, 3] > 0
        outputs = self.run(images, holes, [seeds[canvas[0][0].view] for canvas in canvases])
        if not isinstance(outputs, torch.Tensor) or outputs.shape != images.shape:
            got = tuple(getattr(outputs, "shape", ())) or type(outputs).__name__
            raise GeneratorError(f"inpainting: expected images {tuple(images.shape)}, got {got}")
        if not bool(torch.isfinite(outputs).all()):
            raise GeneratorError("inpainting: expected finite images, got NaN or infinity; try float32")
        painted = outputs.float().clamp(0, 1).cpu().numpy()
        for canvas, image in zip(canvases, painted, strict=True):
            for window, top, at in canvas:
                h, w = window.fills.shape
                window.of(pixels[window.view])[:, window.fills] = image[:, top : top + h, at : at + w][:, window.fills]
                window.of(left[window.view])[window.fills] = False


class PipelineInpainter(NetworkInpainter):
    """One of diffusers' inpainting pipelines: Stable Diffusion, SDXL, Flux and others.

    Args:
        pipeline: Its folder or hub id in diffusers' layout, or a pipeline of ``AutoPipelineForInpainting``, for example
            one loaded in half precision.
        size: Longest side of an image that it sees; None: the pipeline's own.
        batch: Images that it sees at once.
        prompt: Text prompt for the holes.
        steps: Steps of the pipeline; None: its own.
        guidance: Guidance of the pipeline; None: its own.
        min_confidence: As for every ``Inpainter``, like ``seed``.

    Raises:
        ImportError: diffusers or transformers are missing.
        GeneratorError: No such pipeline.
        ValueError: Something else than a pipeline, or impossible settings.
    """

    def __init__(
        self,
        pipeline: Any,
        *,
        size: int | None = None,
        batch: int = 4,
        prompt: str = "",
        steps: int | None = None,
        guidance: float | None = None,
        min_confidence: float = 0.0,
        seed: int = 0,
    ) -> None:
        checked_settings(min_confidence, seed, steps, guidance)
        if isinstance(pipeline, str | Path):
            diffusers, where = optional_package("diffusers", "generator"), pipeline
            optional_package("transformers", "generator")
            try:
                check_regular(where)
                pipeline = diffusers.AutoPipelineForInpainting.from_pretrained(where)
            except (OSError, ValueError, RuntimeError, AttributeError) as error:
                expected = "expected an inpainting pipeline of diffusers"
                raise GeneratorError(f"{where}: {expected}: {one_line(error)}") from None
        if not hasattr(pipeline, "components"):
            got = type(pipeline).__name__
            raise ValueError(f"pipeline: expected one of diffusers, its folder or hub id, got {got}")
        parts = {name: part for name, part in pipeline.components.items() if isinstance(part, torch.nn.Module)}
        multiple = int(pipeline.vae_scale_factor)
        core = getattr(pipeline, "unet", None) or pipeline.transformer
        native_px = int(getattr(core.config, "sample_size", None) or 64) * multiple
        size, network = native_px if size is None else size, torch.nn.ModuleDict(parts)
        super().__init__(network, size, multiple, batch, min_confidence=min_confidence, seed=seed)
        self.pipeline, self.prompt, self.steps, self.guidance = pipeline, prompt, steps, guidance
        pipeline.set_progress_bar_config(disable=True)

    def run(self, images: torch.Tensor, holes: torch.Tensor, seeds: Sequence[int]) -> torch.Tensor:
        h, w = images.shape[-2:]
        settings = {"num_inference_steps": self.steps, "guidance_scale": self.guidance}
        done = self.pipeline(
            prompt=[self.prompt] * len(images),
            image=images,
            mask_image=holes[:, None].float(),
            height=h,
            width=w,
            generator=[torch.Generator().manual_seed(seed % _SEED) for seed in seeds],
            output_type="pt",
            **{name: value for name, value in settings.items() if value is not None},
        )
        return done.images


class TorchScriptInpainter(NetworkInpainter):
    """A TorchScript file of LaMa's kind.

    It takes images (B, 3, h, w) in [0, 1] and masks (B, 1, h, w), 1 in holes, and returns images.

    Args:
        path: The file. TorchScript runs code: load files that you trust.
        size: Longest side of an image that it sees.
        multiple: Number that divides both sides.
        batch: Images that it sees at once.
        min_confidence: As for every ``Inpainter``.

    Raises:
        GeneratorError: No such file, or no TorchScript.
    """

    is_random = False

    def __init__(
        self,
        path: str | Path,
        *,
        size: int = 512,
        multiple: int = 8,
        batch: int = 4,
        min_confidence: float = 0.0,
    ) -> None:
        try:
            with warnings.catch_warnings(), open_regular(path) as file:
                warnings.simplefilter("ignore", FutureWarning)  # advice of torch 2.14 for authors of such files
                network = torch.jit.load(file, map_location="cpu")
        except (RuntimeError, ValueError, OSError) as error:
            raise GeneratorError(f"{path}: expected a TorchScript file: {one_line(error)}") from None
        super().__init__(network, size, multiple, batch, min_confidence=min_confidence)
        self.path = path

    def __reduce__(self) -> tuple[Any, ...]:
        settings = {name: getattr(self, name) for name in ("size", "multiple", "batch", "min_confidence")}
        return partial(type(self), self.path, **settings), (), self.device  # scripts do not pickle: the file is read

    def __setstate__(self, device: torch.device) -> None:
        self.to(device)

    def run(self, images: torch.Tensor, holes: torch.Tensor, seeds: Sequence[int]) -> torch.Tensor:
        try:
            return self.network(images, holes[:, None].to(images.dtype))
        except RuntimeError as error:
            raise GeneratorError(
                f"inpainting: the TorchScript file failed on images and masks: {one_line(error)}"
            ) from None


# --- windows and canvases ---------------------------------------------------------------------------------------------
class Window(NamedTuple):
    """A rectangle of a view, and the pixels in it that it fills."""

    view: int  # index of the view
    top: int  # first row and column
    left: int
    fills: BoolArray  # (h, w) of the rectangle's size

    def of(self, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """This part of an array (..., h, w) of the view."""
        h, w = self.fills.shape
        return array[..., self.top : self.top + h, self.left : self.left + w]


Canvas = list[tuple[Window, int, int]]
"""Windows that a network sees in one image, with the row and the column of each in it, in order of these."""


def windows(holes: Sequence[BoolArray], size: int) -> list[list[Window]]:
    """Windows of sides up to ``size`` that cover all holes (h, w) of the views, in rounds.

    Parts of one hole come in different rounds, so that a later one can see an earlier one's pixels. No pixel is filled
    twice.
    """
    by_hole: list[list[Window]] = []
    for view, hole in enumerate(holes):
        joined = cv2.dilate(hole.astype(np.uint8), np.ones((_JOINED_PX + 1, _JOINED_PX + 1), np.uint8))
        count, labels, boxes, _ = cv2.connectedComponentsWithStats(joined)
        for label in range(1, count):
            x, y, w, h, _ = boxes[label].tolist()
            part = (labels[y : y + h, x : x + w] == label) & hole[y : y + h, x : x + w]
            by_hole.append(list(_parts(Window(view, y, x, part), hole.shape, size)))
    return [[window for window in together if window is not None] for together in zip_longest(*by_hole)]


def _parts(hole: Window, shape: tuple[int, ...], size: int) -> Iterator[Window]:
    """Cut a hole of a view (h, w) in halves until its windows fit, and while halves are small together."""
    rows, columns = bounding_box(hole.fills)
    part, top, left = hole.fills[rows, columns], hole.top + rows.start, hole.left + columns.start
    context = min(int(np.clip(min(part.shape) // 2, *_CONTEXT_PX)), size // 4)
    margins = [
        (min(context, low), min(context, side - low - length))
        for low, length, side in zip((top, left), part.shape, shape, strict=True)
    ]
    sides = [length + sum(margin) for length, margin in zip(part.shape, margins, strict=True)]
    axis = int(np.argmax(part.shape))
    at = part.shape[axis] // 2
    halves = np.split(part, [at], axis)
    if at and (max(sides) > size or sum(_area(half, context) for half in halves) < _WORTH * _area(part, context)):
        yield from _parts(Window(hole.view, top, left, halves[0]), shape, size)
        yield from _parts(Window(hole.view, top + at * (axis == 0), left + at * axis, halves[1]), shape, size)
    else:
        yield Window(hole.view, top - margins[0][0], left - margins[1][0], np.pad(part, margins))


def _area(hole: BoolArray, context: int) -> int:
    """Number of pixels in the window of a hole (h, w)."""
    return int(np.prod([np.ptp(at) + 1 + 2 * context for at in hole.nonzero()]))


def packed(parts: Iterable[Window], size: int) -> list[Canvas]:
    """Pack windows on canvases of at most ``size`` by ``size``: in rows from left to right, tallest windows first."""
    canvases, top, left, height = list[Canvas](), 0, size, size
    for window in sorted(parts, key=lambda item: item.fills.shape, reverse=True):
        h, w = window.fills.shape
        if left + w > size:  # the next row, whose first window is its tallest
            top, left, height = top + height, 0, h
            if top + h > size:
                canvases.append([])
                top = 0
        canvases[-1].append((window, top, left))
        left += w
    return canvases


def drawn(
    canvas: Canvas, views: Sequence[npt.NDArray[np.float32]], holes: Sequence[BoolArray], multiple: int
) -> npt.NDArray[np.float32]:
    """A canvas's pixels, its holes black, and where they are (4, h, w); its sides are multiples of ``multiple``.

    The rest repeats the windows' borders, so that the canvas has no artificial edges.
    """
    ends = [(top + window.fills.shape[0], left + window.fills.shape[1]) for window, top, left in canvas]
    h, w = (-(-max(end) // multiple) * multiple for end in zip(*ends, strict=True))
    pixels, marks = np.zeros((3, h, w), np.float32), np.zeros((1, h, w), bool)
    for (window, top, left), (bottom, right) in zip(canvas, ends, strict=True):
        # To the canvas's far corner; later windows, to the right and below, draw over it.
        beyond = (0, 0), (0, h - bottom), (0, w - right)
        pixels[:, top:, left:] = np.pad(window.of(views[window.view]), beyond, mode="edge")
        marks[:, top:, left:] = False
        marks[:, top:bottom, left:right] = window.of(holes[window.view])
    return np.concatenate([pixels * ~marks, marks], dtype=np.float32)
