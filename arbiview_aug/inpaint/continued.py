"""Default filling of holes: tops of objects painted, the background continued behind them, by a pyramid of cells."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.inpaint.inpainter import Inpainter
from arbiview_aug.inpaint.telea import GREY
from arbiview_aug.render.plan import BACKGROUND, OBJECT, Paint
from arbiview_aug.render.rendered import RenderedFrame
from arbiview_aug.sample.batching import stacked
from arbiview_aug.sample.inputs import Frame
from arbiview_aug.scene.boxes import PARTS, TOP_PART

CELLS = 64  # cells along a view's shorter side

REACH = 1 / 8
"""Share of a view's shorter side at which the nearest pixels of a column and those all around weigh the same outside
the sources' images. Synthetic streets: 92 of 255 squared, 94 without fading, 110 without columns; Telea's method 97."""

_WIDE = 2  # halvings of the columns alone: what is hidden looks like what is beside it, not above or below
_SWEEPS = 2
"""Sweeps of smoothing at each size of the cells. Synthetic streets: 0 to 0.08 dB of whole views; 4 sweeps: +0.03."""

_TOP_SHARE, _BODY_SHARE = 0.9, 0.6
"""Quantiles of what sources see of tops and of a body's side that are nearest to their paint: tops are seen at grazing
angles, sides have wheels and sills. No lamps, plates and windows: these are less than the rest, or on other pieces."""

_TOP_LIGHT, _TOP_SHINE = 1.8, 0.05
"""Light on tops over that on the brightest side in view, and reflected sky, as a share of white; in linear light. An
evenly bright sky gives 1.7; clear coat reflects 4 to 5 %. From ``integrations.benchmarks.tops``, seeds 7000, 7100."""

_SURE_SAMPLES = 6
"""Samples of a seen top that weigh as much as its sides."""

_LEAST_SAMPLES = 3
"""Samples of a body's side that suffice for its paint."""

_GAMMA = 2.2
"""Exponent of displayed colours in linear light, as sRGB's on average."""

Cells = npt.NDArray[np.float32]
"""(4, ny, nx) colours of a view's cells times their known share, and that share."""

Colour = npt.NDArray[np.float32]
"""(3,), or (n, 3) samples, in the images' unit."""


class Continue(Inpainter):
    """Continues the background behind objects, mostly along rows, and outside all source images mostly along columns.

    Unseen parts of labelled objects take their object's colour: tops that of its top as a source sees it, else of its
    sides in the frame's light. Covered pixels do not change.
    """

    outcome: ClassVar[str] = "filled in from its surroundings"
    only_mean: ClassVar[bool] = False

    def inpaint(
        self, views: Sequence[torch.Tensor], holes: Sequence[torch.Tensor], seeds: Sequence[int]
    ) -> list[torch.Tensor]:
        none = [None] * len(views)
        return fill_holes([view.clone() for view in views], [~hole for hole in holes], none, none, self.only_mean)

    def fill(self, rendered: Sequence[RenderedFrame], frames: Sequence[Frame]) -> list[RenderedFrame]:
        """Fill rendered frames, in place where possible."""
        return [self._filled(frame) for frame in rendered]

    def _filled(self, frame: RenderedFrame) -> RenderedFrame:
        images = fill_holes(frame.images, list(frame.coverage), frame.layers, frame.paint, self.only_mean)
        return replace(frame, images=images, generated=stacked([~seen for seen in frame.coverage]))


class Mean(Continue):
    """Gives holes the mean colour of the frame's views."""

    outcome = "given the mean colour of the views"
    only_mean = True


def fill_holes(
    views: Sequence[torch.Tensor],
    coverage: Sequence[torch.Tensor],
    layers: Sequence[npt.NDArray[np.uint8] | None],
    paint: Sequence[Paint | None],
    only_mean: bool = False,
) -> list[torch.Tensor]:
    """Fill uncovered pixels; covered ones are unchanged and keep their gradients.

    Args:
        views: M views (3, h, w), uint8 or float in [0, 1], black where uncovered. Those on the CPU without gradients
            are modified.
        coverage: (h, w) bool of each.
        layers: (h, w) uint8 of each as in ``ViewPlan``, or None: all uncovered pixels lie outside the images.
        paint: Of each as in ``ViewPlan``, or None.
        only_mean: Set all to the mean colour of the frame's covered pixels. Else paint tops in their objects' colours,
            and continue objects from objects, background from background.
    """
    from arbiview_aug.inpaint.kernels import paint as put_paint

    seen = [of_view.cpu().numpy() for of_view in coverage]
    if all(of_view.all() for of_view in seen):
        return list(views)
    arrays = [_as_array(view) for view in views]
    needs_mean = only_mean or not all(of_view.any() for of_view in seen)
    mean = mean_colour(arrays, seen) if needs_mean else np.zeros(3, np.float32)
    colours = object_colours(arrays, paint)
    for view, known, layer, tops in zip(arrays, seen, layers, paint, strict=True):
        if known.all():
            continue
        if only_mean:
            _put(view, ~known, mean)
            continue
        of_view = np.zeros(known.shape, np.uint8) if layer is None else layer
        _fill(view, known, of_view, mean)
        if tops is not None:
            put_paint(tops.pixel, tops.part, tops.beside, colours, known.reshape(-1), view.reshape(3, -1))
    return [_like(*of_view) for of_view in zip(arrays, views, coverage, strict=True)]


def mean_colour(views: Sequence[npt.NDArray[Any]], coverage: Sequence[npt.NDArray[Any]]) -> Colour:
    """Mean colour of the covered pixels of M views (3, h, w); grey without any. Large views are sampled."""
    total, count = np.zeros(3), 0
    for view, seen in zip(views, coverage, strict=True):
        step = _cell_px(seen.shape)
        sampled = seen[::step, ::step]
        total += (view[:, ::step, ::step].astype(np.float64) * sampled).sum((1, 2))
        count += int(sampled.sum())
    top = 255 if views[0].dtype == np.uint8 else 1
    return np.clip(total / count if count else np.full(3, top * GREY), 0, top).astype(np.float32)


def object_colours(views: Sequence[npt.NDArray[Any]], paint: Sequence[Paint | None]) -> Colour:
    """Colours (P, 3) of the parts of objects by their numbers in ``Paint``; -1 where unknown.

    Sides take the median of what sources see of all sides. Tops take the paint of the body's brightest side in the
    light that falls on tops, and what sources see of them, the more the larger the part that they see.
    """
    painted = [(view.reshape(3, -1), p) for view, p in zip(views, paint, strict=True) if p is not None]
    if not any(len(p.pixel) for _, p in painted):
        return np.zeros((0, 3), np.float32)
    colour = np.concatenate([view[:, p.sample] for view, p in painted], 1).T.astype(np.float32)
    part = np.concatenate([p.sample_part for _, p in painted])
    ends = np.bincount(part, minlength=PARTS * (part.max(initial=0) // PARTS + 1)).cumsum()
    samples = np.split(colour[np.argsort(part, kind="stable")], ends[:-1])
    colours = np.full((len(ends), 3), -1, np.float32)
    white = 255 if views[0].dtype == np.uint8 else 1
    for first in range(0, len(ends), PARTS):
        sides, tops = samples[first : first + TOP_PART], samples[first + TOP_PART]
        of_sides = np.concatenate(sides)
        if len(of_sides):
            colours[first : first + TOP_PART] = _quantile(of_sides, 0.5)
        bodies = [side for side in sides[1:] if len(side) >= _LEAST_SAMPLES] or [of_sides]
        colours[first + TOP_PART] = _top_colour(bodies, tops, white)
    return colours


def _top_colour(bodies: Sequence[Colour], tops: Colour, white: float) -> Colour:
    """Colour (3,) of an object's tops by samples (n, 3) of its body's sides, and of tops; -1 where there are none."""
    paints = [_quantile(body, _BODY_SHARE) for body in bodies if len(body)]
    if not paints and not len(tops):
        return np.full(3, -1, np.float32)
    sure = len(tops) / (len(tops) + _SURE_SAMPLES) if paints else 1.0
    light = np.zeros(3)
    if paints:
        brightest = max(paints, key=lambda paint: float(paint.sum()))
        light += (1 - sure) * (_TOP_LIGHT * (brightest / white) ** _GAMMA + _TOP_SHINE)
    if len(tops):
        light += sure * (_quantile(tops, _TOP_SHARE) / white) ** _GAMMA
    return np.asarray(white * np.minimum(light, 1) ** (1 / _GAMMA), np.float32)


def _quantile(values: Colour, share: float) -> Colour:
    """A quantile of samples (n, 3), channel by channel."""
    return np.asarray(np.sort(values, 0)[int(share * len(values))])


# --- one view ---------------------------------------------------------------------------------------------------------
def _fill(view: npt.NDArray[Any], seen: npt.NDArray[Any], layers: npt.NDArray[np.uint8], mean: Colour) -> None:
    """Continue the background: what is hidden from beside it, what lies outside the images from columns, too."""
    from arbiview_aug.inpaint.kernels import continue_columns, put_cells, sum_cells

    cell, rounding = _cell_px(seen.shape), 0.5 if view.dtype == np.uint8 else 0.0
    known = seen & (layers < OBJECT)
    sums = np.empty((4, *(-(-n // cell) for n in seen.shape)), np.float32)
    sum_cells(view, (known if known.any() else seen).view(np.uint8), cell, sums)
    background, columns = sums.copy(), np.empty_like(sums)
    _completed(background, mean, _WIDE)
    outside = ~seen & (layers == BACKGROUND)
    if outside.any():
        continue_columns(sums, background, REACH * min(seen.shape) / cell, columns)
        put_cells(columns, cell, outside.view(np.uint8), rounding, view)
    put_cells(background, cell, (~seen & (layers != BACKGROUND)).view(np.uint8), rounding, view)


def _completed(cells: Cells, mean: Colour, wide: int) -> None:
    """Complete cells in place, by the mean colour where nothing is known; the first ``wide`` steps keep the rows."""
    from arbiview_aug.inpaint.kernels import complete, halve, smooth

    ny, nx = cells.shape[1:]
    if ny == nx == 1:
        cells[:] = np.append(mean, 1)[:, None, None] if cells[3, 0, 0] == 0 else cells / cells[3]
        return
    tall = 1 if wide and nx > 1 else 2
    coarse = np.empty((4, -(-ny // tall), -(-nx // 2)), np.float32)
    halve(cells, tall, coarse)
    _completed(coarse, mean, max(wide - 1, 0))
    known = cells.copy()
    complete(coarse, tall, cells)
    smooth(known, _SWEEPS, cells)


def _cell_px(size: tuple[int, ...]) -> int:
    """Side of a cell; preferably a divisor of both sides (h, w) of the view."""
    most = max(1, min(size) // CELLS)
    return max((n for n in range(most // 2 + 1, most + 1) if not any(side % n for side in size)), default=most)


# --- arrays -----------------------------------------------------------------------------------------------------------
def _as_array(view: torch.Tensor) -> npt.NDArray[Any]:
    """A view as an array, uint8 or float32; the view's own memory where it may be written."""
    array = view.detach().cpu().contiguous()
    array = array if array.dtype == torch.uint8 else array.float()
    return (array.clone() if view.requires_grad and array.data_ptr() == view.data_ptr() else array).numpy()


def _like(array: npt.NDArray[Any], view: torch.Tensor, seen: torch.Tensor) -> torch.Tensor:
    """A filled array as its view; covered pixels are the view's own."""
    filled = torch.from_numpy(array)
    if filled.data_ptr() == view.data_ptr():
        return view
    return torch.where(seen, view, filled.to(view.device, view.dtype))


def _put(view: npt.NDArray[Any], chosen: npt.NDArray[Any], colour: Colour) -> None:
    view[:, chosen] = (colour + (0.5 if view.dtype == np.uint8 else 0.0))[:, None].astype(view.dtype)
