"""Conditions of the denoiser: condition latent, mask, confidence, viewing rays, f_pose of L_main; cameras as tensors.

The paper does not define its pose condition encoding f_pose. Here each view has

- channels next to its noisy latent: the condition latent (FAVS at the view's pose, holes pre-filled), the coverage mask
  of FAVS, its confidence, and the Plücker rays of its pixels;
- one token, MLP(Fourier(R, t, K)), appended to the embedding of the empty prompt.

Poses are relative to a reference camera, the most similar source for a target and itself for a source. The result is
invariant to rotations of the whole rig and to the order of its cameras.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import between
from arbiview_aug.generator.attention import Correspondence, TokenWindow, correspondences, token_sizes, window
from arbiview_aug.generator.config import GeneratorConfig

RAY_CHANNELS = 6
SOURCES_PER_TARGET = 2  # source branches of a target camera, as in training (Algorithm 1: left and right)
POSE_WIDTH = 16  # numbers of a pose: R (9), t (3), K (4)
_OCTAVES = 4  # number of Fourier frequencies π, 2π, 4π, 8π


class ViewInputs(NamedTuple):
    """The conditions of the views of B frames, N views each, on the latent grid."""

    latent: torch.Tensor  # (B, N, C, h, w) FAVS at a target's pose, pre-filled; a source's image
    mask: torch.Tensor  # (B, N, 1, h, w) known share of each latent pixel, in [0, 1]
    confidence: torch.Tensor  # (B, N, 1, h, w) in [0, 1]
    rays: torch.Tensor  # (B, N, 6, h, w) Plücker rays, see ``plucker_rays``
    pose: torch.Tensor  # (B, N, 16) see ``pose_vector``

    def dropped(self, drop: torch.Tensor) -> ViewInputs:
        """Zero the conditions of the frames ``drop`` (B,) bool, for classifier-free guidance."""
        return ViewInputs(*(value * ~drop.view(-1, *(1,) * (value.dim() - 1)) for value in self))

    def channels(self, noisy: torch.Tensor) -> torch.Tensor:
        """(B, N, 2 C + 8, h, w) the U-Net's input: noisy latent, condition latent, mask, confidence, rays."""
        return torch.cat([noisy, self.latent, self.mask, self.confidence, self.rays], 2)


def input_channels(latent_channels: int) -> int:
    """Number of channels of ``ViewInputs.channels``."""
    return 2 * latent_channels + 2 + RAY_CHANNELS


# --- geometry ---------------------------------------------------------------------------------------------------------
def nearest_sources(target: Camera, sources: Sequence[Camera]) -> list[int]:
    """Indices of the sources whose optical axes are nearest to a target's; ties are broken by content."""
    likeness = [(float(-s.cam2ego[:3, 2] @ target.cam2ego[:3, 2]), s.content_key, k) for k, s in enumerate(sources)]
    return [k for _, _, k in sorted(likeness)[:SOURCES_PER_TARGET]]


def relative_pose(camera: Camera, reference: Camera) -> tuple[FloatArray, FloatArray]:
    """R (3, 3) and t (3,) from the camera's frame to the reference's, t compressed to less than 1: t / (1 + |t|)."""
    R, t = between(camera, reference)
    return R, t / (1 + np.linalg.norm(t))


def plucker_rays(camera: Camera, reference: Camera, size: tuple[int, int]) -> torch.Tensor:
    """(6, h, w) float32 direction d and moment o x d of each pixel's ray in the reference's frame; 0 off the lens."""
    small = camera.resize(size)
    R, o = relative_pose(camera, reference)
    directions, valid = small.unproject_cam(small.pixel_grid())
    d = np.where(valid[..., None], directions, 0.0) @ R.T
    return torch.from_numpy(np.concatenate([d, np.cross(o, d)], -1).astype(np.float32)).movedim(-1, 0)


def pose_vector(camera: Camera, reference: Camera) -> torch.Tensor:
    """(16,) float32: R, compressed t, and K as log2 of the focal lengths and the principal point's offset, per side."""
    R, t = relative_pose(camera, reference)
    h, w = camera.size
    K = camera.K
    intrinsics = [math.log2(K[0, 0] / w), math.log2(K[1, 1] / h), (K[0, 2] + 0.5) / w - 0.5, (K[1, 2] + 0.5) / h - 0.5]
    return torch.from_numpy(np.concatenate([R.ravel(), t, intrinsics]).astype(np.float32))


def pooled(maps: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    """Coverage or confidence (..., H, W) as means over latent pixels (..., h, w), float32."""
    flat = maps.float().reshape(-1, 1, *maps.shape[-2:])
    return functional.adaptive_avg_pool2d(flat, size).reshape(*maps.shape[:-2], *size)


# --- the pose token ---------------------------------------------------------------------------------------------------
class PoseContext(nn.Module):
    """The U-Net's cross-attention context: the empty prompt's embedding (77 or 0 tokens) and one pose token."""

    empty_prompt: torch.Tensor

    def __init__(self, width: int, prompt_tokens: int = 0) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(POSE_WIDTH * (1 + 2 * _OCTAVES), width), nn.SiLU(), nn.Linear(width, width))
        self.register_buffer("empty_prompt", torch.zeros(prompt_tokens, width))

    def forward(self, pose: torch.Tensor) -> torch.Tensor:
        """(n, prompt_tokens + 1, width) contexts of poses (n, 16); the token of a dropped pose, which is 0, is 0."""
        pose = pose.float()
        angles = pose[..., None] * (math.pi * 2.0 ** torch.arange(_OCTAVES, device=pose.device))
        features = torch.cat([pose, angles.sin().flatten(-2), angles.cos().flatten(-2)], -1)
        dtype = self.empty_prompt.dtype
        is_given = pose.abs().amax(-1, keepdim=True) > 0  # a pose is never 0, since R is not
        token = self.mlp(features.to(dtype)) * is_given
        return torch.cat([self.empty_prompt.expand(len(pose), -1, -1), token[:, None]], 1)


# --- the branches of a frame ------------------------------------------------------------------------------------------
class BranchGeometry(NamedTuple):
    """N cameras of B frames, the targets or the sources; where views read both, sources are numbered first."""

    rays: torch.Tensor  # (B, N, 6, h, w), see ``plucker_rays``
    pose: torch.Tensor  # (B, N, 16), see ``pose_vector``
    reads: list[Correspondence]  # one for each token grid, the finest first

    def windows(self, sources: int = 0, dropped: torch.Tensor | None = None) -> list[TokenWindow]:
        """Windows of targets in ``sources`` views and these, or of sources in each other.

        Frames ``dropped`` (B,) bool read no sources (classifier-free guidance).
        """
        reads = self.reads if dropped is None else [grid.without(sources, dropped) for grid in self.reads]
        return [window(grid, sources + self.pose.shape[1]) for grid in reads]


class Branches(NamedTuple):
    """N views of B frames at the generator's image size: the targets, or the sources."""

    images: torch.Tensor  # (B, N, 3, H, W) in [0, 1]: FAVS at the targets with holes filled; photographs of the sources
    known: torch.Tensor  # (B, N, H, W) bool, or shares in [0, 1]; sources are read where they are known
    confidence: torch.Tensor  # (B, N, H, W) in [0, 1]
    geometry: BranchGeometry

    def inputs(self, latent: torch.Tensor) -> ViewInputs:
        """The denoiser's conditions, with the latents (B, N, C, h, w) of the images."""
        size = (latent.shape[-2], latent.shape[-1])
        known, trust = (pooled(maps, size)[:, :, None] for maps in (self.known, self.confidence))
        return ViewInputs(latent, known, trust, self.geometry.rays, self.geometry.pose)


def frame_geometry(
    targets: Sequence[Camera], sources: Sequence[Camera], ground_z_m: float, config: GeneratorConfig
) -> tuple[BranchGeometry, BranchGeometry]:
    """The targets' and the sources' geometry of one frame (B = 1); cameras and road lie in one ego frame."""
    size, keys, count = config.latent_size, [*sources, *targets], len(sources)
    grids = token_sizes(size, len(config.unet.widths))
    references = [sources[nearest_sources(target, sources)[0]] for target in targets]

    def branch(cameras: Sequence[Camera], references: Sequence[Camera], reads: list[Correspondence]) -> BranchGeometry:
        pairs = list(zip(cameras, references, strict=True))
        rays, poses = [plucker_rays(*pair, size) for pair in pairs], [pose_vector(*pair) for pair in pairs]
        return BranchGeometry(torch.stack(rays)[None], torch.stack(poses)[None], reads)

    return (
        branch(targets, references, correspondences(targets, keys, range(count, len(keys)), grids, ground_z_m)),
        branch(sources, sources, correspondences(sources, sources, range(count), grids, ground_z_m)),
    )
