"""Contact sheets, also of a whole retargeted frame, and drawings of samples and rigs, (h, w, 3) uint8 RGB."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.atomic_io import write_whole
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.image_io import encoded
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.lidar import visible_points
from arbiview_aug.evaluate.metrics import Image, RenderedView, as_arrays, to_bytes
from arbiview_aug.sample.batching import leading_shape
from arbiview_aug.sample.boxes_2d import edge_points
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.scene.boxes import checked_boxes

Picture = npt.NDArray[np.uint8]
INK, PAPER = (40, 40, 40), (255, 255, 255)
HOLE = (255, 0, 160)  # colour of uncovered regions; rare on streets
BOX = (0, 230, 255)
_FARTHEST_M = 80.0  # points there, and beyond, are blue

RIG_COLOURS = ("#1f64c8", "#d65414", "#1e8c3c", "#8c3caa", "#966e14")  # of rigs, in their order

_DOT = {"marker": "o", "linestyle": "", "color": "#00a0a0", "markersize": 7, "markeredgecolor": "white", "zorder": 3}
"""Style of scanners."""

_GAP_PX = 6
_CAPTION, _TITLE = 0.5, 0.65  # OpenCV's scales of text on sheets up to ``_TEXT_SHEET_PX`` wide; wider ones have larger
_TEXT_SHEET_PX = 900
_LINE_PX = 40  # height of a line of text at scale 1
_FONT = cv2.FONT_HERSHEY_SIMPLEX


def contact_sheet(rows: Sequence[tuple[str, Sequence[Image], Sequence[str]]], *, width_px: int = 1800) -> Picture:
    """Lay out rows of a title, images (h, w, 3), scale 0-255, and captions, which are cut where too long."""
    zoom = max(1.0, width_px / _TEXT_SHEET_PX)
    strips = []
    for title, images, captions in rows:
        if title:
            strips.append(_line_of_text([(title, _GAP_PX, width_px - _GAP_PX)], width_px, _TITLE * zoom))
        strips += _row(images, captions, width_px, _CAPTION * zoom)
    return np.concatenate([*strips, np.full((_GAP_PX, width_px, 3), PAPER, np.uint8)])


def _row(images: Sequence[Image], captions: Sequence[str], width_px: int, scale: float) -> list[Picture]:
    """Strips of a row's images, and of their captions."""
    aspects = [image.shape[1] / image.shape[0] for image in images]
    # A row of few images would otherwise be taller than the rest of the sheet.
    height = max(1, round(min((width_px - _GAP_PX * (len(images) + 1)) / sum(aspects), 0.3 * width_px)))
    strip = np.full((_GAP_PX + height, width_px, 3), PAPER, np.uint8)
    x, texts = _GAP_PX, []
    for image, aspect, caption in zip(images, aspects, captions, strict=True):
        w = max(1, min(round(aspect * height), width_px - x))
        interpolation = cv2.INTER_AREA if image.shape[0] > height else cv2.INTER_LINEAR
        strip[_GAP_PX:, x : x + w] = cv2.resize(to_bytes(image), (w, height), interpolation=interpolation)
        texts.append((caption, x, w))
        x += w + _GAP_PX
    return [strip, _line_of_text(texts, width_px, scale)]


def _line_of_text(texts: Sequence[tuple[str, int, int]], width_px: int, scale: float) -> Picture:
    """Strip with texts, each from its x on and at most as wide as it says."""
    height, thickness = round(_LINE_PX * scale), max(1, round(scale))
    strip = np.full((height, width_px, 3), PAPER, np.uint8)
    for text, x, w in texts:
        # OpenCV's fonts print '?' for all other characters.
        shown = text.replace("−", "-").replace("°", " deg").encode("ascii", "replace").decode()
        while cv2.getTextSize(shown, _FONT, scale, thickness)[0][0] > w:
            shown = shown[:-1]
        cv2.putText(strip, shown, (x, round(0.7 * height)), _FONT, scale, INK, thickness, cv2.LINE_AA)
    return strip


def outline_coverage(image: Image, coverage: BoolArray) -> Picture:
    """Hatch and outline the holes of an image (h, w, 3) on the scale 0-255, given its coverage (h, w)."""
    picture = to_bytes(image).copy()
    hole = ~coverage
    if not hole.any():
        return picture
    h, w = coverage.shape
    spacing = max(8, h // 30)
    row, column = np.indices((h, w), sparse=True)
    hatch = hole & ((row + column) % spacing < max(1, spacing // 5))
    picture[hatch] = HOLE
    contours = cv2.findContours(hole.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_SIMPLE)[0]
    cv2.drawContours(picture, contours, -1, HOLE, max(1, h // 200), cv2.LINE_AA)
    return picture


def draw_labels(camera: Camera, image: Image, points: FloatArray | None, boxes: FloatArray | None) -> Picture:
    """Draw points (P, >=3) by depth and boxes (B, 7) into an image (h, w, 3), 0-255; masked pixels are hatched."""
    picture = to_bytes(image).copy() if camera.mask is None else outline_coverage(image, camera.mask)
    h, w = camera.size
    width_px = max(1, h // 400)
    if points is not None and len(points):
        seen = visible_points(camera, points)
        far_first = np.argsort(-seen.depth_m)
        colours = coloured(1 - np.log(seen.depth_m[far_first].clip(1)) / np.log(_FARTHEST_M))
        column, row = np.round(seen.uv[far_first]).astype(int).T
        for dx, dy in np.ndindex(width_px + 1, width_px + 1):
            picture[np.minimum(row + dy, h - 1), np.minimum(column + dx, w - 1)] = colours
    for box in np.zeros((0, 7)) if boxes is None else boxes:
        for segments, colour in box_lines(camera, box):
            for start, end in np.round(segments).astype(int).tolist():
                cv2.line(picture, start, end, colour, width_px, cv2.LINE_AA)
    return picture


def box_lines(camera: Camera, box: FloatArray) -> list[tuple[FloatArray, tuple[int, int, int]]]:
    """Segments (n, 2, 2) in a camera's image, bent by its lens, of a box's (7,) edges and heading, with colours."""
    ahead = np.array([np.cos(box[6]), np.sin(box[6]), 0.0]) * box[3]
    heading = box[:3] + np.linspace(0.5, 1.0, 9)[:, None, None] * ahead
    heading = (heading - camera.center_m) @ camera.cam2ego[:3, :3]
    return [(_segments(camera, edge_points(camera, box)), BOX), (_segments(camera, heading), HOLE)]


def _segments(camera: Camera, lines: FloatArray) -> FloatArray:
    """Segments (n, 2, 2) in the image along lines (steps, lines, 3) in the camera's frame."""
    uv, depth, valid = camera.project_cam(lines)  # [steps, lines, 2]
    valid &= (np.abs(uv) < 4 * max(camera.size)).all(axis=-1) & (camera.lens_model.sees_behind | (depth > 0.1))
    return np.stack([uv[:-1], uv[1:]], axis=-2)[valid[:-1] & valid[1:]]


def coloured(values: FloatArray) -> Picture:
    """(n, 3) colours of values (n,): blue at 0 to red at 1."""
    levels = np.rint(255 * np.clip(values, 0, 1)).astype(np.uint8)
    if not len(levels):  # OpenCV gives none
        return np.zeros((0, 3), np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(levels[:, None], cv2.COLORMAP_TURBO)[:, 0, ::-1])


def save_picture(path: str | Path, picture: Picture) -> Path:
    """Write a picture as PNG or JPEG, by its suffix, and create its folder."""
    path = Path(path)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise DataError(f"picture {path}: expected a name ending in .png or .jpg, got {path.name!r}")
    write_whole({path: encoded(np.ascontiguousarray(picture[..., ::-1]), path.suffix)})
    return path


_RING_START_DEG = 200.0  # from the left over the front to the right; cameras that look back come last


def frame_sheet(
    source: Rig,
    images: Sequence[Image],
    target: Rig,
    views: Sequence[RenderedView],
    truth: Sequence[Image] | None = None,
    *,
    width_px: int = 1800,
) -> Picture:
    """Lay out source images, target views, holes and (if given) the truth, cameras from left to right."""
    names, vehicle = target.names, target.name or "the target"
    unseen = [1 - float(view.coverage.mean()) for view in views]
    rendered: list[Image] = [view.image for view in views]
    rows: list[tuple[str, Rig, Sequence[Image], Sequence[str]]] = [
        (f"What {source.name or 'the source'} recorded: {len(source)} cameras", source, images, source.names),
        (f"The same moment, retargeted to {vehicle}: {len(names)} cameras", target, rendered, names),
    ]
    if any(unseen):
        # At the size of the sheet, since finer hatching would blur.
        height = round(width_px / sum(image.shape[1] / image.shape[0] for image in rendered))
        hatched = [hatched_view(view, height) for view in views]
        captions = [f"{share:.1%} unseen" for share in unseen]
        rows.append((f"Hatched: what no source camera saw, {np.mean(unseen):.1%}", target, hatched, captions))
    if truth is not None:
        rows.append((f"The truth: what {vehicle} would have seen", target, truth, names))
    ordered = [
        (title, [pictures[k] for k in left_to_right(rig)], [captions[k] for k in left_to_right(rig)])
        for title, rig, pictures, captions in rows
    ]
    return contact_sheet(ordered, width_px=width_px)


def hatched_view(view: RenderedView, height_px: int) -> Picture:
    """View with hatched holes, reduced to a height."""
    small = shrunk(view.image, height_px)
    h, w = small.shape[:2]
    seen = cv2.resize(view.coverage.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST) > 0
    return outline_coverage(small, np.asarray(seen))


def shrunk(image: Image, height_px: int) -> Picture:
    """Image reduced to a height; smaller ones keep their size."""
    scale = min(1.0, height_px / image.shape[0])
    size = max(1, round(image.shape[1] * scale)), max(1, round(image.shape[0] * scale))
    return np.asarray(cv2.resize(to_bytes(image), size, interpolation=cv2.INTER_AREA), np.uint8)


def left_to_right(rig: Rig) -> list[int]:
    """Indices of the cameras in the order of a panorama."""
    return sorted(range(len(rig)), key=lambda k: -((rig[k].azimuth_deg + _RING_START_DEG) % 360))


_COLUMNS = 3
_DIMMED = 0.35  # brightness of pixels that no camera saw


def show(sample: Mapping[str, Any]) -> Any:
    """Draw a sample's images in rows, with its boxes and their headings; a notebook shows the result.

    Pixels outside of ``coverage`` or a mask are dimmed: no source camera saw them, or they show the ego car.

    Args:
        sample: A sample that ``RigRetarget`` takes or returns; of a batch, each frame.

    Returns:
        An image of Pillow; ``save(path)`` writes it.

    Raises:
        SampleError: As ``RigRetarget`` raises it.
    """
    from PIL import Image as pillow

    rows: list[tuple[str, Sequence[Image], Sequence[str]]] = []
    for number, frame in enumerate(read_frames(sample, None, further=("boxes_3d",))):
        boxes = None if frame.boxes is None else checked_boxes(as_array("boxes_3d", frame.boxes))
        drawn = []
        for camera, image in zip(frame.rig, as_arrays(frame.images), strict=True):
            if camera.mask is not None:
                image = image * (_DIMMED + (1 - _DIMMED) * camera.mask[..., None])
            drawn.append(draw_labels(replace(camera, mask=None), image, None, boxes))
        title = f"frame {number}" if leading_shape(sample["images"]) else ""
        for k in range(0, len(drawn), _COLUMNS):
            rows.append((title, drawn[k : k + _COLUMNS], frame.rig.names[k : k + _COLUMNS]))
    widths = [sum(image.shape[1] + _GAP_PX for image in images) + _GAP_PX for _, images, _ in rows]
    return pillow.fromarray(contact_sheet(rows, width_px=min(1800, max(widths))))


# --- rigs: fields of view from above, heights over the road from the side ---------------------------------------------
def draw_rigs(rigs: Sequence[Rig]) -> Picture:
    from matplotlib.backends.backend_agg import FigureCanvasAgg  # without pyplot: no global state and no display

    canvas = FigureCanvasAgg(rig_figure(rigs))
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def rig_figure(rigs: Sequence[Rig]) -> Any:
    """Draw a column per rig, from above and the side: fields of view, scanners as dots, heights over the road."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.5 * len(rigs), 7), dpi=145, layout="constrained")
    rows = figure.subplots(2, len(rigs), squeeze=False, sharex="row", sharey="row", height_ratios=(7, 3))
    for column, (above, side) in enumerate(rows.T):
        for k, rig in enumerate(rigs):
            colour, here = RIG_COLOURS[k % len(RIG_COLOURS)], k == column
            style = {"facecolor": (colour, 0.15 if here else 0), "edgecolor": (colour, 1 if here else 0.3)}
            for camera in rig:
                fov = min(camera.fov_deg[0], 359.0)
                angle = np.radians(camera.azimuth_deg + np.linspace(-fov / 2, fov / 2, max(2, int(fov / 3))))
                y, x = camera.center_m[1::-1, None] + _radius_m(camera) * np.stack([np.sin(angle), np.cos(angle)])
                above.fill([camera.center_m[1], *y], [camera.center_m[0], *x], **style)
                row = np.linspace(-0.5, camera.height_px - 0.5, 25)
                rays = camera.unproject(np.stack([np.full_like(row, camera.K[0, 2]), row], -1)).directions
                centre = camera.center_m - (0, 0, rig.ground_z_m)
                x, _, z = np.concatenate([centre[None], centre + 1.1 * rays]).T
                side.fill(x, z, **style)
        shown = rigs[column]
        for camera in shown:  # its name and field of view at the end of its wedge
            forward, left = np.cos(np.radians(camera.azimuth_deg)), np.sin(np.radians(camera.azimuth_deg))
            y, x = camera.center_m[1::-1] + (_radius_m(camera) + 0.2) * np.array([left, forward])
            text = f"{camera.name}\n{camera.fov_deg[0]:.0f}° x {camera.fov_deg[1]:.0f}°"
            aligned = {"ha": "right" if left > 0.3 else "left" if left < -0.3 else "center"}
            above.text(y, x, text, fontsize=9, va="bottom" if forward > 0 else "top", **aligned)
        for lidar in shown.lidars:
            x, y, z = lidar.center_m - (0, 0, shown.ground_z_m)
            above.plot(y, x, **_DOT)
            side.plot(x, z, **_DOT)
        above.set_title(f"{shown.name or 'rig'}: {len(shown)} cameras", color=RIG_COLOURS[column % len(RIG_COLOURS)])
        above.set(xlabel="left (m)", ylabel="forward (m)", aspect="equal")
        side.set(xlabel="forward (m)", ylabel="height over the road (m)", aspect="equal")
        side.axhline(0, color="grey", linewidth=3)
        for axes, margins in ((above, (0.35, 0.15)), (side, (0.15, 0.05))):
            axes.grid(alpha=0.3)
            axes.margins(*margins)
    above.invert_xaxis()
    return figure


def _radius_m(camera: Camera) -> float:
    return float(np.clip(5.0 * np.sqrt(60.0 / max(camera.fov_deg[0], 1.0)), 2.6, 6.5))
