"""``quality="paper"``: FAVS stages 1 to 4 as published, on the far surface, frame by frame.

For every target camera: one source is primary; every source is warped by H_geometric (stage 1), matched to the
primary's warp (stage 2), shifted by its objects (stage 3), warped again by its final homography, and averaged with
w_distance · w_gradient · w_quality · w_primary (stage 4). A named baseline: nothing can be planned ahead.

Sparse PSNR on the paper's six turns, two real frames at half resolution, equalised (``bench ablation``): stages 1 and 4
alone 24.40 dB (nuScenes) and 23.57 (DDAD), all four 24.49 and 24.12; ``fast`` on its own surface 28.51 and 26.72.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.environment import repeatable_opencv
from arbiview_aug.errors import CalibrationError, SampleError
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.favs.stage1_geometry import h_geom
from arbiview_aug.favs.stage2_features import FeatureReport, GreyImage, Region, optimise_transformation, unmatched
from arbiview_aug.favs.stage3_objects import AlignmentReport, Detection, align_objects, declined, find_objects
from arbiview_aug.favs.stage4_fusion import distance_weight, fuse, gradient_weight, primary_weight

SAME_CENTER_M = 1e-6
"""Centres closer than this coincide: that source is exact and primary."""

_CLEAN = 1 - 1e-6  # share of unmasked taps that counts as all of them: weights are sums of float32

Float32Image = npt.NDArray[np.float32]


@dataclass(frozen=True)
class SourceReport:
    """How one source served one target view.

    Attributes:
        source: Index of the source camera in the source rig.
        primary: It is the primary camera.
        H_final: (3, 3) source pixels to target pixels, det 1.
        features: Stage 2.
        objects: Stage 3.
        share: Share of the target's pixels in which its weight is the largest.
    """

    source: int
    primary: bool
    H_final: FloatArray
    features: FeatureReport
    objects: AlignmentReport
    share: float


@dataclass(frozen=True)
class PaperView:
    """One target view.

    Attributes:
        image: (3, h, w) in the type of the source images, black where no source sees.
        source_camera: (h, w) int8 index of the source with the largest weight, -1 where there is none.
        reports: One for each source that the target shows.
        occluded: (h, w) bool, uncovered pixels that a source's image contains: its own car hides them; None for none.
    """

    image: torch.Tensor
    source_camera: npt.NDArray[np.int8]
    reports: tuple[SourceReport, ...]
    occluded: BoolArray | None = None

    @property
    def coverage(self) -> BoolArray:
        """(h, w) True where any weight is positive."""
        return self.source_camera >= 0


@dataclass(frozen=True)
class PaperRendering:
    """A frame as the target rig would have seen it.

    Attributes:
        source: The source rig.
        target: The target rig in the source's ego frame.
        targets: One view for each target camera.
    """

    source: Rig
    target: Rig
    targets: tuple[PaperView, ...]

    @property
    def coverage(self) -> list[BoolArray]:
        """(h, w) for each target camera."""
        return [view.coverage for view in self.targets]


class _Warp(NamedTuple):
    """A source as the target sees it through a homography."""

    image: Float32Image  # [h, w, 3] 0..255, black where the source does not see
    coverage: BoolArray  # [h, w]


# --- joining the stages -----------------------------------------------------------------------------------------------
def render_paper(
    source: Rig,
    target: Rig,
    images: Sequence[torch.Tensor],
    config: PaperConfig | None = None,
    detections: Mapping[int, Sequence[Detection]] | None = None,
) -> PaperRendering:
    """Render a target rig by the published stages.

    The same images give the same result, bit for bit, in every process: meanwhile OpenCV has one thread.

    Args:
        source: Pinhole cameras; their masks are honoured: the own car's pixels are never read.
        target: Pinhole cameras, in the source's ego frame.
        images: N images (3, H, W) on the CPU: uint8, or float in [0, 1].
        config: Settings.
        detections: A detector's boxes by source camera: they give objects their types.

    Raises:
        CalibrationError: A camera with a lens.
        SampleError: Images on another device, or that need gradients.
    """
    config = config or PaperConfig()
    check_pinhole(source, target)
    if any(image.device.type != "cpu" or image.requires_grad for image in images):
        raise SampleError(
            "quality='paper': expected CPU images without gradients: SIFT and RANSAC are OpenCV's and have no "
            "derivative; use quality='fast'"
        )
    arrays = [_masked(camera, image) for camera, image in zip(source, images, strict=True)]
    order = content_order(source.cameras)
    views = []
    with repeatable_opencv():
        for camera in target:
            blended, winners, reports = _render_view(source, order, camera, arrays, config, detections or {})
            occluded = _behind_own_car(source, winners, reports)
            views.append(PaperView(_as_tensor(blended, images[0].dtype), winners, reports, occluded))
    return PaperRendering(source, target, tuple(views))


def check_pinhole(*rigs: Rig) -> None:
    """Refuse lenses: a homography maps straight lines to straight lines."""
    for rig in rigs:
        for camera in rig:
            if not camera.is_rectilinear:
                raise CalibrationError(
                    f"camera {camera.name!r}: quality='paper' renders by homographies and needs a pinhole lens, got "
                    f"{camera.lens}; use .undistorted()"
                )


def check_settings(surface: str, execution: str) -> None:
    """Refuse settings of ``RigRetarget`` that the published stages do not have."""
    if surface not in ("auto", "far"):
        raise ValueError(f"surface: quality='paper' knows the far surface: expected auto or far, got {surface!r}")
    if execution == "torch":
        raise ValueError("execution: quality='paper' runs in OpenCV: expected auto or opencv, got 'torch'")


def _render_view(
    source: Rig,
    order: Sequence[int],
    target: Camera,
    arrays: Sequence[Float32Image],
    config: PaperConfig,
    detections: Mapping[int, Sequence[Detection]],
) -> tuple[Float32Image, npt.NDArray[np.int8], tuple[SourceReport, ...]]:
    homographies = {k: h_geom(source[k], target) for k in order if _may_see(source[k], target)}
    first = {k: warp_perspective(arrays[k], source[k], H, target.size) for k, H in homographies.items()}
    first = {k: warp for k, warp in first.items() if warp.coverage.any()}
    h, w = target.size
    if not first:
        return np.zeros((h, w, 3), np.float32), np.full((h, w), -1, np.int8), ()
    primary = primary_camera(source, target, list(first))
    reference = _grey(first[primary].image)
    found: list[tuple[int, FloatArray, FeatureReport, AlignmentReport]] = []
    for k, warp in first.items():
        H = homographies[k]
        features = unmatched(H, "it is the primary camera" if k == primary else "feature matching is switched off")
        if k != primary and (config.use_feature_matching or config.use_object_alignment):
            matched = optimise_transformation(
                H,
                _grey(warp.image),
                reference,
                (warp.coverage, first[primary].coverage),
                _visible(source[k], H, warp.coverage),
                source[k].K[0, 0] / target.K[0, 0],
                config,
            )
            # Objects are clusters of matches: switched off, stage 2 still finds them and leaves H_geometric as it is.
            features = matched if config.use_feature_matching else unmatched(H, features.reason, matched.matches)
        objects = declined(features.H_base, "object alignment is switched off")
        if k == primary:
            objects = declined(features.H_base, "it is the primary camera")
        elif config.use_object_alignment:
            candidates = find_objects(
                features.matches, H, features.H_base, target, source.ground_z_m, config, detections.get(k, ())
            )
            objects = align_objects(candidates, features.H_base, w, config)
        found.append((k, objects.H_aligned, features, objects))
    warps, weights = [], []
    for k, H_final, features, objects in found:
        kept = features.case == "geometric" and not objects.shift_px.any()
        warp = first[k] if kept else warp_perspective(arrays[k], source[k], H_final, target.size)
        warps.append(warp)
        weights.append(fusion_weight(warp.image, warp.coverage, features.quality, k == primary, config))
    blended, covered = fuse(np.stack([warp.image for warp in warps]), np.stack(weights))
    best = np.argmax(weights, axis=0)
    winners = np.where(covered, np.array([k for k, *_ in found], np.int8)[best], np.int8(-1))
    reports = tuple(
        SourceReport(k, k == primary, H_final, features, objects, float((winners == k).mean()))
        for k, H_final, features, objects in found
    )
    return blended.astype(np.float32), winners, reports


def _behind_own_car(source: Rig, winners: npt.NDArray[np.int8], reports: Sequence[SourceReport]) -> BoolArray | None:
    """Uncovered pixels (h, w) that lie in some source's image: nothing but its own car hides the far surface."""
    uncovered = winners < 0
    shown = np.zeros_like(uncovered)
    for report in reports:
        if source[report.source].mask is not None and uncovered.any():
            shown |= _source_pixels(source[report.source], report.H_final, winners.shape)[1]
    shown &= uncovered
    return shown if shown.any() else None


# --- stages 1 and 4 ---------------------------------------------------------------------------------------------------
def primary_camera(source: Rig, target: Camera, candidates: Sequence[int]) -> int:
    """The primary camera: one at the target's own centre if there is any, else all; of these the nearest axis.

    Args:
        source: The source rig.
        target: The target camera.
        candidates: Indices of the sources that the target shows, in content order, which decides ties.
    """
    exact = [k for k in candidates if np.linalg.norm(source[k].center_m - target.center_m) < SAME_CENTER_M]
    return max(exact or candidates, key=lambda k: round(float(source[k].cam2ego[:3, 2] @ target.cam2ego[:3, 2]), 9))


def warp_perspective(image: Float32Image, camera: Camera, H: FloatArray, size: tuple[int, int]) -> _Warp:
    """I_warped = warp_perspective(I_source, H) (Sec. FAVS, Stage 4), and where the source sees the target.

    Unlike ``cv2.warpPerspective`` it tells what lies before the camera from what lies behind it, and never reads a
    masked pixel or the border.

    Args:
        image: (H, W, 3), 0 where masked.
        camera: Its camera.
        H: (3, 3) source pixels to target pixels, positive third coordinates in front.
        size: (h, w) of the target.
    """
    uv, visible = _source_pixels(camera, H, size)
    u, v = (np.ascontiguousarray(uv[..., k]) for k in (0, 1))
    if camera.mask is not None and visible.any():
        clean = cv2.remap(camera.mask.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        visible = visible & (clean >= _CLEAN)
    warped = cv2.remap(image, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    warped[~visible] = 0
    return _Warp(np.asarray(warped, np.float32), visible)


def fusion_weight(
    image: Float32Image, coverage: BoolArray, quality: float, primary: bool, config: PaperConfig
) -> npt.NDArray[np.float32]:
    """w = w_distance · w_gradient · w_quality · w_primary (Sec. FAVS, Stage 4), 0 outside the coverage.

    Args:
        image: (h, w, 3) the warp, 0..255.
        coverage: (h, w) where it shows its source.
        quality: Matching quality in [0, 1].
        primary: It is the primary camera's, whose quality is 1: the others are matched to it.
        config: Settings.
    """
    weight = coverage.astype(np.float64)
    if config.use_distance_weight and not coverage.all():  # without a border there is no distance to it
        mask = coverage.astype(np.uint8)
        distance = cv2.distanceTransform(mask, cv2.DIST_L2, cv2.DIST_MASK_PRECISE).astype(np.float64)
        weight = weight * distance_weight(distance, float(distance.max()), config.distance_gamma)
    if config.use_gradient_weight:
        weight = weight * gradient_weight(_gradient_magnitude(image), config.gradient_sigma)
    if config.use_quality_weight and not primary:
        weight = weight * (config.unmatched_quality + (1 - config.unmatched_quality) * quality)
    if config.use_primary_weight:
        weight = weight * primary_weight(primary, config.primary_bonus)
    # In float32 small weights may vanish, but what a source sees is covered however little it counts.
    return np.where(coverage, np.maximum(weight, np.finfo(np.float32).tiny), 0).astype(np.float32)


def _gradient_magnitude(image: Float32Image) -> FloatArray:
    """|∇I| in grey levels a pixel: Sobel's kernel sums to 8."""
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    along = [cv2.Sobel(grey, cv2.CV_32F, dx, dy, scale=1 / 8) for dx, dy in ((1, 0), (0, 1))]
    return np.asarray(cv2.magnitude(*along), np.float64)


# --- label maps -------------------------------------------------------------------------------------------------------
def paper_labels(rendering: PaperRendering, labels: Sequence[torch.Tensor], fill: float) -> list[torch.Tensor]:
    """Label maps of the target views: the nearest label of the source with the largest weight, by its homography.

    Args:
        rendering: The rendering of these labels' images.
        labels: N maps (..., H, W) of any type.
        fill: Value of uncovered pixels.
    """
    rendered = []
    for view in rendering.targets:
        out = labels[0].new_full((*labels[0].shape[:-2], *view.source_camera.shape), fill)
        for report in view.reports:
            camera, label = rendering.source[report.source], labels[report.source]
            won = view.source_camera == report.source
            uv, _ = _source_pixels(camera, report.H_final, won.shape)
            pixel = np.floor(uv[won] + 0.5).astype(np.int64).clip(0, (camera.width_px - 1, camera.height_px - 1))
            x, y = (torch.from_numpy(np.ascontiguousarray(pixel[:, k])) for k in (0, 1))
            out[..., torch.from_numpy(won)] = label[..., y, x]
        rendered.append(out)
    return rendered


# --- details ----------------------------------------------------------------------------------------------------------
def _source_pixels(camera: Camera, H: FloatArray, size: tuple[int, int]) -> tuple[npt.NDArray[np.float32], BoolArray]:
    """(h, w, 2) float32 source pixel of each target pixel, and (h, w) whether it lies in front and in the image."""
    back = np.linalg.inv(H)  # positive third coordinates in front, as H
    x, y = np.arange(size[1], dtype=np.float64), np.arange(size[0], dtype=np.float64)[:, None]
    u, v, third = (row[0] * x + (row[1] * y + row[2]) for row in back)
    front = third > 1e-9 * np.abs(back[2]).max()
    with np.errstate(divide="ignore", invalid="ignore"):
        uv = np.stack([u / third, v / third], -1)
    uv = np.where(front[..., None], uv, -1.0)
    # Rotations of whole images land a rounding error beside the outermost pixel centres.
    nearest = np.round(uv)
    uv = np.where(np.abs(uv - nearest) < 1e-9, nearest, uv)
    return np.clip(uv, -1.0, 32767.0).astype(np.float32), front & camera.contains(uv)


def _may_see(source: Camera, target: Camera) -> bool:
    """Whether the two viewing cones meet, which most pairs of a ring do not."""
    angle = np.arccos(np.clip(source.cam2ego[:3, 2] @ target.cam2ego[:3, 2], -1, 1))
    return bool(angle <= source.half_angle_rad + target.half_angle_rad)


def _visible(camera: Camera, H: FloatArray, coverage: BoolArray) -> Region:
    """Bounding box, in source pixels, of what the target shows of a source."""
    uv = _source_pixels(camera, H, coverage.shape)[0][coverage]
    x0, y0 = np.floor(uv.min(0)).astype(int)
    x1, y1 = np.ceil(uv.max(0)).astype(int)
    return Region(int(x0), int(y0), int(x1), int(y1))


def _masked(camera: Camera, image: torch.Tensor) -> Float32Image:
    """(H, W, 3) float32 0..255, black where the own car is."""
    copied = image.permute(1, 2, 0).to(torch.float32, copy=True, memory_format=torch.contiguous_format)
    array = copied.numpy()  # by torch, as numpy has no bfloat16
    if image.dtype != torch.uint8:
        array *= 255
    if camera.mask is not None:
        array[~camera.mask] = 0
    return array


def _grey(image: Float32Image) -> GreyImage:
    return np.clip(np.round(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)), 0, 255).astype(np.uint8)


def _as_tensor(image: Float32Image, dtype: torch.dtype) -> torch.Tensor:
    planes = torch.from_numpy(np.ascontiguousarray(image.transpose(2, 0, 1)))
    return planes.round().clamp(0, 255).to(dtype) if dtype == torch.uint8 else (planes / 255).clamp(0, 1).to(dtype)
