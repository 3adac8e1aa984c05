"""The cameras of a frame as tensors: what the denoiser needs of them for its conditions and its attention."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.generator.conditioning import Views, camera_conditions, pooled, reference_camera
from arbiview_aug.generator.config import GeneratorConfig
from arbiview_aug.generator.correspondence import (
    Correspondence,
    TokenWindow,
    correspondences,
    stacked,
    token_sizes,
    window,
)


class FrameGeometry(NamedTuple):
    """The N target and S source cameras of B frames. If both are read, sources are numbered before targets."""

    target_rays: torch.Tensor  # (B, N, 6, h, w), see ``conditioning.plucker_rays``
    target_pose: torch.Tensor  # (B, N, 16), see ``conditioning.pose_vector``
    source_rays: torch.Tensor  # (B, S, 6, h, w)
    source_pose: torch.Tensor  # (B, S, 16)
    target_reads: list[Correspondence]  # of the targets in sources and targets, one per token grid, the finest first
    source_reads: list[Correspondence]  # of the sources in the other sources

    def to(self, device: torch.device | str) -> FrameGeometry:
        tensors = (value.to(device, non_blocking=True) for value in self[:4])
        return FrameGeometry._make([*tensors, *self[4:]]).with_reads(lambda reads: reads.to(device))

    def with_reads(self, change: Callable[[Correspondence], Correspondence]) -> FrameGeometry:
        """Replace each correspondence by ``change`` of it."""
        return FrameGeometry._make([*self[:4], *([change(grid) for grid in reads] for reads in self[4:])])

    def target_views(self, latent: torch.Tensor, mask: torch.Tensor, confidence: torch.Tensor) -> Views:
        """The targets' conditions: latents (B, N, C, h, w), coverage and confidence (B, N, H, W) at any resolution."""
        return _views(latent, mask, confidence, self.target_rays, self.target_pose)

    def source_views(self, latent: torch.Tensor, mask: torch.Tensor, confidence: torch.Tensor) -> Views:
        """The sources' conditions; the latents are those of their images."""
        return _views(latent, mask, confidence, self.source_rays, self.source_pose)

    def target_windows(self, dropped: torch.Tensor | None = None) -> list[TokenWindow]:
        """Windows of the targets, without sources in the frames ``dropped`` (B,) bool (classifier-free guidance)."""
        sources, targets = self.source_pose.shape[1], self.target_pose.shape[1]
        reads = self.target_reads if dropped is None else [c.without(sources, dropped) for c in self.target_reads]
        return [window(c, sources + targets) for c in reads]

    def source_windows(self) -> list[TokenWindow]:
        return [window(c, self.source_pose.shape[1]) for c in self.source_reads]


def frame_geometry(
    targets: Sequence[Camera], sources: Sequence[Camera], ground_z_m: float, config: GeneratorConfig
) -> FrameGeometry:
    """The geometry of one frame (B = 1), whose N targets, S sources and road lie in one ego frame."""
    size = config.latent_size
    grids = token_sizes(size, len(config.unet.widths))
    target_rays, target_pose = camera_conditions(targets, [reference_camera(t, sources) for t in targets], size)
    source_rays, source_pose = camera_conditions(sources, sources, size)
    keys, count = [*sources, *targets], len(sources)
    settings = grids, ground_z_m, config.facing_m
    return FrameGeometry(
        target_rays[None],
        target_pose[None],
        source_rays[None],
        source_pose[None],
        correspondences(targets, keys, range(count, len(keys)), *settings),
        correspondences(sources, sources, range(count), *settings),
    )


def batched(frames: Sequence[FrameGeometry]) -> FrameGeometry:
    """One geometry of frames with equal numbers of targets and of sources."""
    *tensors, target_reads, source_reads = zip(*frames, strict=True)
    reads = ([stacked(grid) for grid in zip(*grids, strict=True)] for grids in (target_reads, source_reads))
    return FrameGeometry._make([*map(torch.cat, tensors), *reads])


def _views(
    latent: torch.Tensor, mask: torch.Tensor, confidence: torch.Tensor, rays: torch.Tensor, pose: torch.Tensor
) -> Views:
    size = (latent.shape[-2], latent.shape[-1])
    return Views(latent, pooled(mask, size)[:, :, None], pooled(confidence, size)[:, :, None], rays, pose)
