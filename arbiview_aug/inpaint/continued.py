"""Default filling of holes: the background continued along lines of the scene, by a pyramid of cells, and by pixels.

Each hole pixel belongs to the road or to upright objects. The road continues along the ego's heading, in its plane.
Upright objects continue along the heading at equal height, and vertically. Each pixel mixes the first known pixels
along its lines with a blurred completion of its surroundings, and these with the nearest known pixels of its row and
column, so that holes have the detail of their border near it. Unseen parts of objects are painted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any, ClassVar

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.inpaint.inpainter import GREY, Inpainter
from arbiview_aug.render.plan import HoleContents, Paint
from arbiview_aug.render.rendered import Views
from arbiview_aug.sample.frame import Frame
from arbiview_aug.scene.boxes import PARTS

CELLS = 64  # cells along a view's shorter side; the pyramid starts with half as many

REACH = np.array([(0, 0), (0, 1 / 8), (1 / 2, 0), (1 / 16, 1 / 16), (1 / 4, 0)], np.float32)
"""Distance at which lines along the heading and vertical lines weigh as much as all surroundings, as a share of the
view's shorter side. Rows: nothing; upright objects and road outside the sources' images; both where occluded."""

SIDE_REACH = 1 / 4
"""Distance at which seen pixels of a body or cabin, in the row and column of an unseen one, weigh as much as the body's
colour, as a share of the view's shorter side."""

_LENS_NODES = 17  # directions of lines are interpolated between N nodes along each side; a pinhole's are linear
_MOVE = 1e-4  # step of rays along a line, as a share of their length
_STEP_PX = 4  # spacing of road nodes in views without a plan

Colour = npt.NDArray[np.float32]
"""(3,), or (n, 3) samples, in the images' unit."""


class Continue(Inpainter):
    """Continues the road along the heading, and upright objects along the heading and vertically.

    Unseen tops of labelled objects take the colours of their object's body and seen tops
    (``paint_kernels.colour_objects``); unseen sides continue their seen pixels. Covered pixels do not change.
    """

    outcome: ClassVar[str] = "filled in from its surroundings"
    needs_layers: ClassVar[bool] = True
    only_mean: ClassVar[bool] = False

    def fill(self, rendered: Sequence[Views], frames: Sequence[Frame]) -> list[Views]:
        """Fill rendered frames, own car included, in place where possible."""
        filled = []
        for frame in rendered:
            seen = frame.coverage
            holes = ~seen if isinstance(seen, torch.Tensor) else [~covered for covered in seen]
            filled.append(replace(frame, images=fill_holes(frame, self.only_mean), generated=holes))
        return filled


class Mean(Continue):
    """Gives holes the mean colour of the frame's views."""

    outcome = "given the mean colour of the views"
    needs_layers = False
    only_mean = True


def fill_holes(frame: Views, only_mean: bool = False) -> list[torch.Tensor]:
    """Fill the uncovered pixels of a frame's images; covered ones are unchanged and keep their gradients.

    Background continues background, sides of objects continue objects, and tops are painted in their objects' colours;
    with ``only_mean`` all take the mean colour of the frame's covered pixels. Without ``layers`` of a view, all of its
    holes lie outside the sources' images; without ``road``, it reaches to the horizon. Images on the CPU without
    gradients are modified.
    """
    from arbiview_aug.inpaint.kernels import fill_background
    from arbiview_aug.render.paint_kernels import paint as paint_parts

    seen = [mask.cpu().numpy() for mask in frame.coverage]
    if all(mask.all() for mask in seen):
        return list(frame.images)
    arrays, holes = [_as_array(view) for view in frame.images], frame.holes or [HoleContents()] * len(seen)
    needs_mean = only_mean or not all(mask.any() for mask in seen)
    mean = mean_colour(arrays, seen) if needs_mean else np.zeros(3, np.float32)
    colours = None if only_mean else object_colours(arrays, [contents.paint for contents in holes])
    for view, known, (layer, objects, on_road), camera in zip(arrays, seen, holes, frame.rig, strict=True):
        if known.all():
            continue
        rounding = 0.5 if view.dtype == np.uint8 else 0.0
        if only_mean:
            view[:, ~known] = (mean + rounding)[:, None].astype(view.dtype)
            continue
        side = min(known.shape)
        most = max(1, side // CELLS)
        divisors = (n for n in range(most // 2 + 1, most + 1) if not any(length % n for length in known.shape))
        cell = max(divisors, default=most)  # preferably cells fill the view
        layer = np.zeros(known.shape, np.uint8) if layer is None else layer
        on_road = _road_below_horizon(camera) if on_road is None else on_road
        lines = _line_directions(camera), REACH * np.float32(side / cell)
        fill_background(view, known, layer, on_road, *lines, mean, cell, rounding)
        if objects is not None:
            parts = objects.pixel, objects.part, objects.nearest, colours
            paint_parts(*parts, known, SIDE_REACH * side, rounding, view.reshape(3, -1))
    filled = []
    for array, original, covered in zip(map(torch.from_numpy, arrays), frame.images, frame.coverage, strict=True):
        is_in_place = array.data_ptr() == original.data_ptr()
        pixels = array.to(original.device, original.dtype)
        filled.append(original if is_in_place else torch.where(covered, original, pixels))
    return filled


def mean_colour(views: Sequence[npt.NDArray[Any]], coverage: Sequence[npt.NDArray[Any]]) -> Colour:
    """Mean colour of the covered pixels of M views (3, h, w); grey without any."""
    total, count = np.zeros(3), 0
    for view, seen in zip(views, coverage, strict=True):
        pixels = int(np.count_nonzero(seen))
        total += pixels * np.array([cv2.mean(plane, seen.view(np.uint8))[0] for plane in view])
        count += pixels
    top = 255 if views[0].dtype == np.uint8 else 1
    return np.clip(total / count if count else np.full(3, top * GREY), 0, top).astype(np.float32)


def object_colours(views: Sequence[npt.NDArray[Any]], paint: Sequence[Paint | None]) -> Colour:
    """Colours (P, 3) of the parts of objects by their numbers in ``Paint``; -1 where unknown."""
    from arbiview_aug.render.paint_kernels import colour_objects

    painted = [(view, p) for view, p in zip(views, paint, strict=True) if p is not None]
    if not any(len(p.pixel) for _, p in painted):
        return np.zeros((0, 3), np.float32)
    samples = np.concatenate([view.reshape(3, -1).take(p.sample, 1) for view, p in painted], 1).astype(np.float32)
    part = np.concatenate([p.sample_part for _, p in painted])
    colours = np.empty((PARTS * (part.max(initial=0) // PARTS + 1), 3), np.float32)
    colour_objects(samples, part, 255.0 if views[0].dtype == np.uint8 else 1.0, colours)
    return colours


# --- one view -------------------------------------------------------------------------------------------------------
@lru_cache(32)  # the cameras of a rig serve every frame
def _line_directions(camera: Camera) -> npt.NDArray[np.float32]:
    """Image directions (2, 2, n, n), x and y, of lines along the heading and of vertical lines, for kernels."""
    if camera.is_rectilinear:
        ends = (camera.K @ camera.cam2ego[:3:2, :3].T).T[..., None, None]  # vanishing points, homogeneous
        directions = ends[:, :2] - ends[:, 2:] * np.moveaxis(_places(camera.size, 2), -1, 0)
        return np.ascontiguousarray(directions, np.float32)
    rays = camera.unproject_cam(_places(camera.size, _LENS_NODES)).directions
    start = camera.project_cam(rays).uv
    moved = [camera.project_cam(rays + _MOVE * axis).uv - start for axis in camera.cam2ego[:3:2, :3]]
    return np.nan_to_num(np.moveaxis(np.stack(moved), -1, 1) / _MOVE, posinf=0, neginf=0).astype(np.float32, "C")


def _places(size: tuple[int, int], n: int) -> npt.NDArray[np.float64]:
    """(n, n, 2) pixels from edge to edge of a view (h, w)."""
    h, w = size
    return np.stack(np.meshgrid(np.linspace(-0.5, w - 0.5, n), np.linspace(-0.5, h - 0.5, n)), -1)


def _road_below_horizon(camera: Camera) -> BoolArray:
    """Nodes ``_STEP_PX`` apart of a view that look down, as in ``HoleContents.road``."""
    y, x = (np.arange(0, n + _STEP_PX, _STEP_PX, dtype=np.float64) for n in camera.size)
    return camera.unproject(np.stack(np.meshgrid(x, y), -1)).directions[..., 2] < 0


def _as_array(view: torch.Tensor) -> npt.NDArray[Any]:
    """A view as an array, uint8 or float32; the view's own memory where it may be written."""
    array = view.detach().cpu().contiguous()
    array = array if array.dtype == torch.uint8 else array.float()
    return (array.clone() if view.requires_grad and array.data_ptr() == view.data_ptr() else array).numpy()
