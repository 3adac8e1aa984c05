"""``show``: a sample's images as a figure, for notebooks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from typing import TYPE_CHECKING, Any

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.evaluate.images import Image, as_arrays
from arbiview_aug.evaluate.report.pictures import Picture, draw_labels
from arbiview_aug.sample.batching import leading_shape
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.scene.boxes import checked_boxes

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_COLUMNS, _WIDTH_IN = 3, 12.0
_DIMMED = 0.35  # brightness of what is no evidence


def show(sample: Mapping[str, Any]) -> Figure:
    """Draw a sample's images in a grid, with its boxes and their headings; show the figure in notebooks.

    What ``coverage`` or a mask leaves out is dimmed: no source camera saw it, or it is the own car.

    Args:
        sample: A sample that ``RigRetarget`` takes or returns; of a batch, each frame.

    Returns:
        A matplotlib figure; ``savefig(path)`` writes it.

    Raises:
        SampleError: As ``RigRetarget`` raises it.
    """
    drawn: list[tuple[str, Picture]] = []
    frames = read_frames(sample, None, further=("boxes_3d",))
    for number, frame in enumerate(frames):
        boxes = None if frame.boxes is None else checked_boxes(as_array("boxes_3d", frame.boxes))
        of_frame = f"frame {number}, " if leading_shape(sample["images"]) else ""
        for camera, image in zip(frame.rig, as_arrays(frame.images), strict=True):
            drawn.append((of_frame + camera.name, draw_labels(*_dimmed(camera, image), None, boxes)))
    columns = min(_COLUMNS, len(drawn))
    rows = math.ceil(len(drawn) / columns)
    aspect = max(picture.shape[0] / picture.shape[1] for _, picture in drawn)
    height_in = rows * (_WIDTH_IN / columns * aspect + 0.35)
    figure = _notebook_figure((_WIDTH_IN, height_in))
    for axes in figure.subplots(rows, columns, squeeze=False).flat:
        axes.set_axis_off()
    for axes, (title, picture) in zip(figure.axes, drawn, strict=False):
        axes.imshow(picture)
        axes.set_title(title, fontsize="medium")
    return figure


def _dimmed(camera: Camera, image: Image) -> tuple[Camera, Image]:
    """The camera without its mask, and its image (h, w, 3) darker where that is False."""
    if camera.mask is None:
        return camera, image
    return replace(camera, mask=None), image * (_DIMMED + (1 - _DIMMED) * camera.mask[..., None])


def _notebook_figure(size_in: tuple[float, float]) -> Figure:
    """An empty figure that notebooks show without pyplot and its global state."""
    from matplotlib.figure import Figure

    class NotebookFigure(Figure):
        def _repr_png_(self) -> bytes:
            png = BytesIO()
            self.savefig(png, format="png")
            return png.getvalue()

    return NotebookFigure(figsize=size_in, layout="constrained")
