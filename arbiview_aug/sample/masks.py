"""Pixels that show no scene: specks in masks, and the dark rim around a fisheye's image circle."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError

SPECK_SHARE = 2e-4
"""Largest speck as a share of the image; parts of the car in DDAD's masks are a hundred times larger."""

CLEANING = "clean_masks=True in the reader, --clean-masks, or arbiview_aug.datasets.cleaned_rig"
"""How to mask what is no scene, for messages."""

_DARK = 32  # of 255: brightest level of a rim beyond the vignette
_SIDE_PX = 512  # images are searched at this size
_LEAST_RIM, _LEAST_HIDDEN = 0.02, 0.005  # shares of the image: dark, and hidden where pixels have rays
_OFF_CIRCLE = 0.01  # of the image's width: farther boundary pixels do not lie on the circle
_LEAST_ON_CIRCLE = 0.6
"""Least share of a dark region's boundary on one circle, between those of real rims and of dark images."""

_DIMMED = 0.8
"""Brightness near the rim as a share of that farther inside; less is a vignette."""

_VIGNETTE = 0.93  # radius within the vignette as a share of the rim's
_TRIALS = 200


class Circle(NamedTuple):
    """An image circle, an ellipse where pixels are not square: radii in pixels along x and y."""

    center_px: FloatArray  # (2,)
    radii_px: FloatArray  # (2,)

    def holds(self, camera: Camera) -> BoolArray:
        """The camera's pixels (h, w) within the circle."""
        offset = (camera.pixel_grid() - self.center_px) / self.radii_px
        return np.asarray((offset**2).sum(axis=-1) <= 1)


def without_specks(mask: BoolArray) -> BoolArray:
    """A mask (h, w) whose regions of less than ``SPECK_SHARE`` of the image are turned over."""
    cleaned = mask.copy()
    for value in (False, True):
        _, labels, stats, _ = cv2.connectedComponentsWithStats((cleaned == value).astype(np.uint8), connectivity=8)
        small = stats[:, cv2.CC_STAT_AREA] < SPECK_SHARE * mask.size
        small[0] = False  # the other value
        cleaned[small[labels]] = not value
    return cleaned


def image_circle(camera: Camera, image: torch.Tensor) -> Circle | None:
    """Find the circle around which a fisheye's image (3, h, w), uint8 or float in [0, 1], is dark.

    The dark regions at the corners must end in one circle, so that a dark scene is not taken for a rim. The circle
    leaves out the vignette. None without a rim, and for lenses that keep straight lines straight.
    """
    if camera.is_rectilinear:
        return None
    image = image.detach().amax(dim=0).cpu()
    brightest = (image if image.dtype == torch.uint8 else (image.float() * 255).to(torch.uint8)).numpy()
    h, w = camera.size
    scale = min(1.0, _SIDE_PX / max(h, w))
    small = cv2.resize(brightest, (max(1, round(w * scale)), max(1, round(h * scale))), interpolation=cv2.INTER_AREA)
    small = cv2.medianBlur(small, 5)
    _, labels = cv2.connectedComponents((small < _DARK).astype(np.uint8))
    corners = {int(label) for label in labels[[0, 0, -1, -1], [0, -1, 0, -1]]} - {0}
    rim = np.isin(labels, list(corners)).astype(np.uint8)
    if rim.mean() < _LEAST_RIM:
        return None
    inner = cv2.dilate(rim, np.ones((3, 3), np.uint8)) > rim
    inner[[0, -1]] = inner[:, [0, -1]] = False
    pixels = np.stack(np.meshgrid(*(np.arange(n) for n in rim.shape[::-1])), axis=-1)
    pixels = (pixels + 0.5) * (w / small.shape[1], h / small.shape[0]) - 0.5  # of the camera's image
    circle = _fitted(pixels[inner], float(camera.K[0, 0] / camera.K[1, 1]), w)
    if circle is None:
        return None
    radius = np.linalg.norm((pixels - circle.center_px) / circle.radii_px, axis=-1)
    inside, margin = (small[(radius > low) & (radius < high)] for low, high in ((0.8, 0.9), (0.96, 1.0)))
    if inside.size and margin.size and np.median(margin) < _DIMMED * np.median(inside):
        circle = circle._replace(radii_px=_VIGNETTE * circle.radii_px)
        radius = radius / _VIGNETTE
    # Pixels without a ray are never read.
    return circle if ((radius > 1) & camera.unproject(pixels).valid).mean() >= _LEAST_HIDDEN else None


def _fitted(edge: FloatArray, stretch: float, width: int) -> Circle | None:
    """The circle through most of the pixels (n, 2), y stretched by the pixels' aspect (RANSAC)."""
    edge = edge * (1, stretch)
    if len(edge) < 50:
        return None
    rng, best = np.random.default_rng(0), np.zeros(len(edge), bool)
    for _ in range(_TRIALS):
        center, radius = _circle(edge[rng.choice(len(edge), 3, replace=False)])
        on = np.abs(np.linalg.norm(edge - center, axis=1) - radius) < _OFF_CIRCLE * width
        best = on if radius < width and on.sum() > best.sum() else best
    if best.mean() < _LEAST_ON_CIRCLE:
        return None
    center, radius = _circle(edge[best])
    return Circle(center / (1, stretch), radius / np.array([1, stretch]))


def _circle(points: FloatArray) -> tuple[FloatArray, float]:
    """Centre and radius by algebraic least squares of points (n, 2)."""
    ones = np.ones((len(points), 1))
    x, y, c = np.linalg.lstsq(np.hstack([2 * points, ones]), (points**2).sum(axis=1), rcond=None)[0]
    return np.array([x, y]), float(np.sqrt(max(c + x * x + y * y, 0.0)))


def dark_rims(cameras: Iterable[Camera], images: Sequence[torch.Tensor]) -> Iterator[tuple[Camera, Circle]]:
    """Cameras without a mask whose images (3, h, w) have a dark rim, and their image circles."""
    for camera, image in zip(cameras, images, strict=True):
        if camera.mask is None and (circle := image_circle(camera, image)) is not None:
            yield camera, circle


def cleaned_rig(rig: Rig, images: Sequence[torch.Tensor]) -> Rig:
    """The rig with masks that hide what is no scene.

    Specks in masks are turned over; fisheye cameras without a mask whose images have a dark rim get one.

    Args:
        rig: The rig.
        images: An image (3, h, w) of each camera, uint8 or float in [0, 1].

    Raises:
        SampleError: Another number of images.
    """
    if len(images) != len(rig):
        raise SampleError(f"images: expected {len(rig)} for cameras {', '.join(rig.names)}, got {len(images)}")
    rims = {camera.name: circle.holds(camera) for camera, circle in dark_rims(rig, images)}
    cameras = []
    for camera in rig:
        mask = rims.get(camera.name) if camera.mask is None else without_specks(camera.mask)
        is_same = mask is None or (camera.mask is not None and bool((mask == camera.mask).all()))
        cameras.append(camera if is_same else replace(camera, mask=mask))
    return rig.with_cameras(cameras)
