"""Contact sheet of a retargeted frame: source images, target views, holes, the truth."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.images import Image, RenderedView, to_bytes
from arbiview_aug.evaluate.report.pictures import Picture, contact_sheet, outline_coverage

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
    ring, order = left_to_right(source), left_to_right(target)
    names, vehicle = target.names, target.name or "the target"
    unseen = [1 - float(view.coverage.mean()) for view in views]
    rendered: list[Image] = [view.image for view in views]
    rows: list[tuple[str, Sequence[Image], Sequence[str], list[int]]] = [
        (f"What {source.name or 'the source'} recorded: {len(source)} cameras", images, source.names, ring),
        (f"The same moment, retargeted to {vehicle}: {len(names)} cameras", rendered, names, order),
    ]
    if any(unseen):
        # At the size of the sheet, since finer hatching would blur.
        height = round(width_px / sum(image.shape[1] / image.shape[0] for image in rendered))
        hatched = [hatched_view(view, height) for view in views]
        captions = [f"{name}: {share:.1%} unseen" for name, share in zip(names, unseen, strict=True)]
        rows.append((f"Hatched: what no source camera saw, {np.mean(unseen):.1%}", hatched, captions, order))
    if truth is not None:
        rows.append((f"The truth: what {vehicle} would have seen", truth, names, order))
    return contact_sheet(
        [[pictures[k] for k in places] for _, pictures, _, places in rows],
        [[captions[k] for k in places] for _, _, captions, places in rows],
        [title for title, *_ in rows],
        width_px=width_px,
    )


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
