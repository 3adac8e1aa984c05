"""OpenCV's own panorama stitching as a baseline: spherical warps, seams, multi-band blending, then views cut out of it.

The calibration gives the rotations, so that registration, which overlaps of some ten degrees leave to chance, is not
needed: the rest is the pipeline of OpenCV's ``stitching_detailed`` example without exposure compensation. Cameras stand
in one place (the far surface), lenses are pinhole.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.images import Image, RenderedView, to_bytes

# The panorama's axes, seen from the ego frame: x right, y down, z forward.
_EGO2PANORAMA = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
_SEAM_SCALE = 0.25  # seams are found on smaller images, as in the example


def opencv_stitching(source: Rig, images: Sequence[Image], target: Rig) -> list[RenderedView]:
    """One view for each target camera.

    Args:
        source: The source rig, pinhole cameras.
        images: One for each of its cameras.
        target: The target rig in the source's ego frame.

    Raises:
        SampleError: Lenses other than pinhole.
    """
    if any(not camera.is_rectilinear for camera in (*source, *target)):
        raise SampleError("opencv_stitching: expected pinhole cameras; use Rig.undistorted()")
    scale = float(np.median([camera.K[0, 0] for camera in source]))
    panorama, covered, corner = stitched(source, [to_bytes(image) for image in images], scale)
    around_px = scale * 2 * np.pi
    if panorama.shape[1] > around_px - 4:  # closed: what lies between its last column and its first is both's
        columns = np.arange(int(np.ceil(around_px)) + 1) % panorama.shape[1]
        panorama, covered = panorama[:, columns], covered[:, columns]
    views = []
    for camera in target:
        rays = camera.unproject_cam(camera.pixel_grid()).directions @ (_EGO2PANORAMA @ camera.cam2ego[:3, :3]).T
        at = (_on_sphere(rays, scale) - corner).astype(np.float32)
        at[..., 0] %= np.float32(around_px)
        view = cv2.remap(panorama, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        seen = cv2.remap(covered, at[..., 0], at[..., 1], cv2.INTER_NEAREST) > 0
        views.append(RenderedView(np.asarray(view * seen[..., None], np.uint8), seen))
    return views


def stitched(
    source: Rig, images: Sequence[npt.NDArray[np.uint8]], scale: float
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.uint8], FloatArray]:
    """The panorama (h, w, 3), its mask (h, w), and (2,) the sphere's coordinates of its first pixel.

    Args:
        source: The rig.
        images: (h, w, 3) each.
        scale: Pixels a radian.
    """
    warper = cv2.PyRotationWarper("spherical", scale)
    corners, warped, masks = [], [], []
    for camera, image in zip(source, images, strict=True):
        K = camera.K.astype(np.float32)
        R = (_EGO2PANORAMA @ camera.cam2ego[:3, :3]).astype(np.float32)
        corner, part = warper.warp(image, K, R, cv2.INTER_LINEAR, cv2.BORDER_REFLECT)
        own = np.full(camera.size, 255, np.uint8) if camera.mask is None else camera.mask.astype(np.uint8) * 255
        _, mask = warper.warp(own, K, R, cv2.INTER_NEAREST, cv2.BORDER_CONSTANT)
        corners.append(corner)
        warped.append(part)
        masks.append(mask)
    masks = _seams(corners, warped, masks)
    sizes = [part.shape[1::-1] for part in warped]
    detail: Any = cv2.detail  # its type stubs lack some names
    blender = detail.Blender_createDefault(detail.Blender_MULTI_BAND)
    region = detail.resultRoi(corners=corners, sizes=sizes)
    blender.prepare(region)
    for part, mask, corner in zip(warped, masks, corners, strict=True):
        blender.feed(part.astype(np.int16), mask, corner)
    panorama, covered = blender.blend(None, None)
    return np.clip(panorama, 0, 255).astype(np.uint8), np.asarray(covered, np.uint8), np.array(region[:2], np.float64)


def _seams(corners: Sequence[Sequence[int]], parts: Sequence[Any], masks: Sequence[Any]) -> list[Any]:
    """The masks, each without what its neighbours show better."""
    small = [cv2.resize(part, None, fx=_SEAM_SCALE, fy=_SEAM_SCALE).astype(np.float32) for part in parts]
    small_masks = [
        cv2.resize(m, s.shape[1::-1], interpolation=cv2.INTER_NEAREST) for m, s in zip(masks, small, strict=True)
    ]
    small_corners = [(round(x * _SEAM_SCALE), round(y * _SEAM_SCALE)) for x, y in corners]
    finder: Any = cv2.detail.DpSeamFinder("COLOR")
    found = finder.find(small, small_corners, small_masks)
    cut = []
    for mask, seam in zip(masks, found, strict=True):
        own = seam.get() if isinstance(seam, cv2.UMat) else seam
        wide = cv2.resize(
            cv2.dilate(own, np.ones((3, 3), np.uint8)), mask.shape[1::-1], interpolation=cv2.INTER_LINEAR_EXACT
        )
        cut.append(np.asarray(cv2.bitwise_and(wide, mask), np.uint8))
    return cut


def _on_sphere(rays: FloatArray, scale: float) -> FloatArray:
    """(..., 2) coordinates of rays in the panorama's axes, as OpenCV's spherical warper has them."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    return np.stack([scale * np.arctan2(x, z), scale * (np.pi - np.arccos(np.clip(y, -1, 1)))], -1)
