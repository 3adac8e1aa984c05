"""``quality="paper"``: FAVS stages 1 to 4 as published, over ``geometry="infinity"``, frame by frame.

The paper's section "Feature-Aware Adaptive View Synthesis (FAVS) Algorithm". For every target camera, one source is
primary. Each source is warped by H_geom (stage 1), matched to the primary camera's warp (stage 2), shifted by its
objects (stage 3), warped again by its final homography, and fused (stage 4). ``docs/benchmarks.md`` compares this
baseline with the other presets.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig, content_order
from arbiview_aug.environment import repeatable_opencv
from arbiview_aug.errors import SampleError
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.favs.stage1_geometry import check_pinhole, h_geom
from arbiview_aug.favs.stage2_features import normalised, optimise_transformation, unmatched
from arbiview_aug.favs.stage3_objects import align_objects, find_objects
from arbiview_aug.favs.stage4_fusion import Float32Image, Warp, adaptive_fusion, source_pixels, warp_perspective
from arbiview_aug.render.harmonise import Harmoniser
from arbiview_aug.render.plan import HoleContents
from arbiview_aug.render.rendered import Views, from_winners
from arbiview_aug.render.requirements import SAME_CENTER_M


@dataclass(frozen=True)
class SourceReport:
    """How one source served one target view."""

    source: int  # index of the source camera in the source rig
    primary: bool  # whether it is the primary camera
    H_final: FloatArray  # (3, 3) source pixels to target pixels, det 1
    reason: str  # results of stages 2 and 3
    share: float  # share of the target's pixels in which its weight is the largest


@dataclass(frozen=True)
class PaperView:
    """A target view rendered by the published stages."""

    image: torch.Tensor  # (3, h, w) in the type of the source images, black where no source sees
    source_camera: npt.NDArray[np.int8]  # (h, w) index of the source with the largest weight, -1 for none
    reports: tuple[SourceReport, ...]  # one for each source that the target shows
    occluded: BoolArray | None = None  # (h, w) uncovered pixels that some source's own car hides; None for none

    @property
    def coverage(self) -> BoolArray:
        """(h, w) True where any weight is positive."""
        return self.source_camera >= 0


@dataclass(frozen=True, repr=False)
class PaperRendering:
    """A frame rendered by the published stages."""

    source: Rig  # the source rig
    target: Rig  # the target rig in the source's ego frame
    targets: tuple[PaperView, ...]  # one view for each target camera

    @property
    def coverage(self) -> list[BoolArray]:
        """(h, w) for each target camera."""
        return [view.coverage for view in self.targets]

    def __str__(self) -> str:
        """Coverage of each target camera, and the result of each stage for its sources."""
        names = f"{self.source.name or 'source'} -> {self.target.name or 'target'}"
        lines = [f"{names}: {len(self.source)} cameras to {len(self.target)}, stages 1 to 4 as published, far surface"]
        for camera, view in zip(self.target, self.targets, strict=True):
            lines.append(f"  {camera.name}: {view.coverage.mean():.1%} covered")
            for report in view.reports:
                lines.append(f"    {report.share:6.1%} from {self.source[report.source].name}: {report.reason}")
        return "\n".join(lines)


def render_paper(
    source: Rig,
    target: Rig,
    images: Sequence[torch.Tensor],
    config: PaperConfig | None = None,
) -> PaperRendering:
    """Render a target rig, in the source's ego frame, by the published stages.

    The same images give the same bits in every process, for which OpenCV runs on one thread. N images (3, H, W) are on
    the CPU: uint8, or float in [0, 1]; pixels that the sources' masks hide are never read.

    Raises:
        CalibrationError: A camera is not a pinhole camera.
        SampleError: Images are on another device, or need gradients.
    """
    check_pinhole((*source.cameras, *target.cameras))
    if any(image.device.type != "cpu" or image.requires_grad for image in images):
        raise SampleError(
            "quality='paper': expected CPU images without gradients: SIFT and RANSAC are OpenCV's and have no "
            "derivative; use quality='fast'"
        )
    arrays = [
        image.permute(1, 2, 0).to(torch.float32, copy=True, memory_format=torch.contiguous_format).numpy()
        for image in images  # by torch, as numpy has no bfloat16
    ]
    for camera, array in zip(source.cameras, arrays, strict=True):
        if images[0].dtype != torch.uint8:
            array *= 255
        if camera.mask is not None:
            array[~camera.mask] = 0
    order = content_order(source.cameras)
    with repeatable_opencv():
        views = [
            _render_view(source, order, camera, arrays, images[0].dtype, config or PaperConfig())
            for camera in target.cameras
        ]
    return PaperRendering(source, target, tuple(views))


def check_settings(
    target: Rig, geometry: str, backend: str, outputs: Collection[str], min_confidence: float, harmoniser: Harmoniser
) -> None:
    """Refuse settings of ``RigRetarget`` that the published stages do not have."""
    check_pinhole(target)
    for is_wrong, message in (
        ("confidence" in outputs, "SampleKeys.extra: quality='paper' has no 'confidence': it moves pixels by matches"),
        (min_confidence, "holes: quality='paper' has no confidence: expected min_confidence=0"),
        (geometry not in ("auto", "infinity"), "geometry: quality='paper' has none: expected auto or infinity"),
        (backend == "torch", "backend: quality='paper' runs in OpenCV: expected auto or opencv, got 'torch'"),
        (harmoniser.is_on, "match_exposure: quality='paper' is as published: expected True or False, got gains"),
    ):
        if is_wrong:
            raise ValueError(message)


def primary_camera(sources: Sequence[Camera], target: Camera, candidates: Sequence[int]) -> int:
    """Choose the primary camera: the nearest optical axis, among sources at the target's centre if there are any.

    ``candidates`` are indices of the sources that the target shows; the first one wins ties.
    """
    poses, pose = {k: sources[k].cam2ego for k in candidates}, target.cam2ego
    exact = [k for k in candidates if np.linalg.norm(poses[k][:3, 3] - pose[:3, 3]) < SAME_CENTER_M]
    return max(exact or candidates, key=lambda k: round(float(poses[k][:3, 2] @ pose[:3, 2]), 9))


def _render_view(
    source: Rig,
    order: Sequence[int],
    target: Camera,
    arrays: Sequence[Float32Image],
    dtype: torch.dtype,
    config: PaperConfig,
) -> PaperView:
    size, cameras = target.size, source.cameras
    # Stage 1, for the sources whose viewing cones meet the target's.
    homographies, warped = dict[int, FloatArray](), dict[int, Warp]()
    for k in order:
        angle_rad = np.arccos(np.clip(cameras[k].cam2ego[:3, 2] @ target.cam2ego[:3, 2], -1, 1))
        if angle_rad <= cameras[k].half_angle_rad + target.half_angle_rad:
            homographies[k] = h_geom(cameras[k], target)
            warped[k] = warp_perspective(arrays[k], homographies[k], size, cameras[k].mask)
    warps = {k: warp for k, warp in warped.items() if warp.coverage.any()}
    if not warps:
        nothing = np.full(size, -1, np.int8)
        return PaperView(torch.zeros(3, *size, dtype=dtype), nothing, (), _occluded(warped, nothing))
    # Stages 2 and 3.
    primary = primary_camera(cameras, target, list(warps))
    reference, results = warps[primary], dict[int, tuple[FloatArray, float, str]]()
    for k, warp in warps.items():
        base = unmatched(homographies[k], "feature matching is switched off")
        if k == primary:
            results[k] = base.H_base, base.quality, "the primary camera, the reference of the others"
            continue
        if config.use_feature_matching or config.use_object_alignment:
            focal_ratio = cameras[k].K[0, 0] / target.K[0, 0]
            matched = optimise_transformation(homographies[k], warp, reference, focal_ratio, config)
            base = matched if config.use_feature_matching else base._replace(matches=matched.matches)
        H_final, objects = base.H_base, "object alignment is switched off"
        if config.use_object_alignment:
            candidates = find_objects(base.matches, homographies[k], base.H_base, target, source.ground_z_m)
            H_final, objects = align_objects(candidates, base.H_base, size[1], config)
        results[k] = H_final, base.quality, f"features: {base.reason}; objects: {objects}"
    # Stage 4.
    for k, (H_final, *_) in results.items():
        if not np.array_equal(H_final, normalised(homographies[k])):
            warps[k] = warp_perspective(arrays[k], H_final, size, cameras[k].mask)
    fused, winners = adaptive_fusion(warps, [quality for _, quality, _ in results.values()], primary, config)
    reports = tuple(
        SourceReport(k, k == primary, H_final, reason, float((winners == k).mean()))
        for k, (H_final, _, reason) in results.items()
    )
    planes = torch.from_numpy(np.ascontiguousarray(fused.transpose(2, 0, 1), np.float32))
    is_bytes = dtype == torch.uint8
    image = (planes.round().clamp(0, 255) if is_bytes else (planes / 255).clamp(0, 1)).to(dtype)
    return PaperView(image, winners, reports, _occluded(warped | warps, winners))


def _occluded(warps: Mapping[int, Warp], winners: npt.NDArray[np.int8]) -> BoolArray | None:
    """(h, w) uncovered pixels that lie in some source's image; None for none."""
    occluded = np.logical_or.reduce([warp.in_image for warp in warps.values()]) & (winners < 0)
    return occluded if occluded.any() else None


def paper_labels(rendering: PaperRendering, labels: Sequence[torch.Tensor], fill: float) -> list[torch.Tensor]:
    """Render N label maps (..., H, W) of any type as M maps (..., h, w); uncovered pixels are ``fill``.

    Each pixel takes the nearest label of the source with the largest weight.
    """
    rendered = []
    for view in rendering.targets:
        out = labels[0].new_full((*labels[0].shape[:-2], *view.source_camera.shape), fill)
        for report in view.reports:
            label = labels[report.source]
            won = view.source_camera == report.source
            h, w = label.shape[-2:]
            uv, _ = source_pixels(report.H_final, (h, w), won.shape)
            pixel = np.floor(uv[won] + 0.5).astype(np.int64).clip(0, (w - 1, h - 1))
            x, y = (torch.from_numpy(np.ascontiguousarray(pixel[:, k])) for k in (0, 1))
            out[..., torch.from_numpy(won)] = label[..., y, x]
        rendered.append(out)
    return rendered


def as_rendered(rendering: PaperRendering, outputs: Collection[str] = ()) -> Views:
    """Convert a rendering; ``outputs`` as in ``Renderer.render``."""
    views = rendering.targets
    winners, labels = [torch.from_numpy(view.source_camera) for view in views], partial(paper_labels, rendering)
    rendered = from_winners([view.image for view in views], rendering.target, winners, labels, outputs)
    occluded = [None if view.occluded is None else view.occluded.view(np.uint8) for view in views]
    return replace(rendered, holes=list(map(HoleContents, occluded)))
