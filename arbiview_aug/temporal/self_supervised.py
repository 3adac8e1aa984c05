"""A small depth network that learns from a drive alone: how well its depth explains one image by others.

After Monodepth2 (Godard et al., 2019): SSIM and L1, the best of several sources for each pixel, and no loss where an
image that does not move explains it better. Sources are the same camera in neighbouring frames, and the other cameras
of the frame. Poses are known, so depth is in metres. The network corrects the static street, which it starts from.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import islice, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils.data import DataLoader, Dataset

from arbiview_aug.atomic_io import checksum, whole_file
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import DataError
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.sample.neighbours import read_neighbours
from arbiview_aug.scene.depth_maps import motion_camera
from arbiview_aug.scene.static import Street
from arbiview_aug.temporal.learned_depth import DepthInputs, Prediction, View
from arbiview_aug.temporal.motion_depth import TRAVEL_M, without_objects

_STRIDE = 16  # of the network's coarsest level
_CHANNELS = (16, 32, 64, 96, 128)
_LEVELS = 3  # image sizes that are compared, each half of the one before
_SMOOTHNESS = 1e-3
_OTHER_CAMERAS = 2  # of the frame, as sources: the ones that look the most alike
_RATE = 2e-3


class StreetNetwork(nn.Module):
    """U-Net that corrects the street's inverse depth, given an image and the street."""

    def __init__(self) -> None:
        super().__init__()
        inner = list(pairwise(_CHANNELS))
        self.first = _block(4, _CHANNELS[0])
        self.down = nn.ModuleList([nn.Sequential(_block(a, b, 2), _block(b, b)) for a, b in inner])
        self.up = nn.ModuleList([_block(a + b, a) for a, b in inner])
        self.last = nn.Conv2d(_CHANNELS[0], 1, 3, padding=1, bias=False)
        nn.init.zeros_(self.last.weight)  # untrained, it is the street

    def forward(self, images: Tensor, street: Tensor) -> Tensor:
        """Inverse z-depth (B, 1, h, w) in 1/m of images (B, 3, h, w) in [0, 1] over a street (B, 1, h, w)."""
        features = [self.first(torch.cat([images - 0.5, street.clamp(1e-3).log() + 3], 1))]
        for down in self.down:
            features.append(down(features[-1]))
        x = features.pop()
        for up in reversed(self.up):
            skip = features.pop()
            x = up(torch.cat([F.interpolate(x, size=skip.shape[-2:], mode="nearest"), skip], 1))
        return street.clamp(1e-3) * torch.exp(2 * torch.tanh(self.last(x)))


def _block(channels: int, out: int, stride: int = 1) -> nn.Module:
    convolution = nn.Conv2d(channels, out, 3, stride, padding=1, padding_mode="replicate")
    return nn.Sequential(convolution, nn.GroupNorm(8, out), nn.ELU())


# --- what is compared -------------------------------------------------------------------------------------------------
class Targets(NamedTuple):
    """The C cameras of a frame, and S sources for each; images uint8, poses camera to camera."""

    images: Tensor  # (C, 3, h, w)
    street: Tensor  # (C, 1, h, w) inverse z-depth
    K: Tensor  # (C, 3, 3)
    masks: Tensor  # (C, 1, h, w) whether a pixel counts
    sources: Tensor  # (C, S, 3, h, w)
    source_K: Tensor  # (C, S, 3, 3)
    to_source: Tensor  # (C, S, 4, 4)
    source_masks: Tensor  # (C, S, 1, h, w)
    is_later: Tensor  # (C, S) bool: the same camera at another time


def size_for(camera: Camera) -> tuple[int, int]:
    """(h, w) of the network's images: that of the depth map, in steps of the network."""
    h, w = (max(2, round(side / _STRIDE)) * _STRIDE for side in motion_camera(camera).size)
    return h, w


class _Shot(NamedTuple):
    """A camera's image at the network's size."""

    image: Tensor
    street: Tensor
    K: Tensor
    cam2ego: Tensor
    mask: Tensor

    @staticmethod
    def of(view: View, size: tuple[int, int], moved: Any = None) -> _Shot:
        """A view without the boxes that ``moved``."""
        camera = without_objects(view.pinhole.resize(size), moved)
        pixels: Any = cv2.resize(view.image.permute(1, 2, 0).numpy(), size[::-1], interpolation=cv2.INTER_AREA)
        rays = camera.unproject(camera.pixel_grid()).directions
        street = Street(ground_z_m=view.ground_z_m).inverse_distance(camera.center_m, rays)
        street = street / np.maximum(rays @ camera.cam2ego[:3, 2], 1e-3)
        mask = np.ones(size, bool) if camera.mask is None else camera.mask
        arrays = street[None].astype(np.float32), camera.K.astype(np.float32), camera.cam2ego, mask[None]
        return _Shot(torch.from_numpy(pixels).permute(2, 0, 1), *map(torch.tensor, arrays))


def read_targets(sample: Mapping[str, Any], size: tuple[int, int]) -> Targets | None:
    """Read a frame with its neighbours; None if none of them is at a useful distance."""
    (frame,) = read_frames(sample, None)
    neighbours = read_neighbours(frame, lambda _, __: None)
    near = [one for one in neighbours if TRAVEL_M[0] <= one.travel_m <= TRAVEL_M[1]]
    if not near:
        return None

    def shots(rig: Rig, images: Sequence[Tensor], moved: Any) -> list[_Shot]:
        given = DepthInputs(rig, images)
        return [_Shot.of(View.of(given, k), size, moved) for k in range(len(rig))]

    moved = [np.zeros((0, 7)) if one.moved is None else one.moved for one in near]
    here = shots(frame.rig, frame.images, np.concatenate(moved))
    there = [shots(one.rig, one.images(frame.images), boxes) for one, boxes in zip(near, moved, strict=True)]
    axes = frame.rig.cam2ego[:, :3, 2]
    alike = np.argsort(-(axes @ axes.T), axis=1)[:, 1 : 1 + _OTHER_CAMERAS]
    sources = [[*(of_frame[k] for of_frame in there), *(here[other] for other in alike[k])] for k in range(len(here))]
    images, street, K, cam2ego, masks = map(torch.stack, zip(*here, strict=True))
    of_sources = (map(torch.stack, zip(*of_camera, strict=True)) for of_camera in sources)
    source_images, _, source_K, source_pose, source_masks = map(torch.stack, zip(*of_sources, strict=True))
    to_source = (torch.linalg.inv(source_pose) @ cam2ego[:, None]).float()
    is_later = torch.tensor([k < len(there) for k in range(len(sources[0]))]).expand(len(here), -1)
    return Targets(images, street, K, masks, source_images, source_K, to_source, source_masks, is_later)


# --- training ---------------------------------------------------------------------------------------------------------
class _Drive(Dataset[Targets | None]):
    def __init__(self, data: Any, size: tuple[int, int]) -> None:
        self.data, self.size = data, size

    def __len__(self) -> int:
        return len(self.data)

    def __getitem__(self, index: int) -> Targets | None:
        try:
            return read_targets(self.data[index], self.size)
        except Exception:  # frames that cannot be read are named when their depth is computed
            return None


def fit_to_drive(model: FittedDepth, data: Any, steps: int, workers: int = 0) -> Iterator[float]:
    """Train a network on a data set of samples with neighbours; yields the loss of each step.

    Raises:
        DataError: No frame has a neighbour at a useful distance.
    """
    optimiser = torch.optim.Adam(model.network.parameters(), _RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    context = "forkserver" if workers else None
    loader: Any = DataLoader(
        _Drive(data, model.size), batch_size=None, shuffle=True, num_workers=workers, multiprocessing_context=context
    )
    done = 0
    while done < steps:
        used = done
        for targets in islice((targets for targets in loader if targets is not None), steps - done):
            at = Targets(*(tensor.to(model.device) for tensor in targets))
            images = at.images.float() / 255
            inverse = model.network(images, at.street)
            loss = loss_of_depth(at, inverse) + _SMOOTHNESS * _roughness(inverse, at.street, images)
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            done += 1
            yield loss.item()
        if used == done:
            least, most = TRAVEL_M
            raise DataError(f"--fit: expected frames with others {least:g} to {most:g} m before or after, got none")


def loss_of_depth(targets: Targets, inverse: Tensor) -> Tensor:
    """How badly inverse depth (C, 1, h, w) explains a frame by its sources, at several sizes."""
    return torch.stack([_loss_at(targets, inverse, 2**level) for level in range(_LEVELS)]).mean()


def _loss_at(targets: Targets, inverse: Tensor, step: int) -> Tensor:
    count, number = targets.sources.shape[:2]
    small, q = F.avg_pool2d(targets.images.float() / 255, step), F.avg_pool2d(inverse, step)
    of_sources = F.avg_pool2d(targets.sources.flatten(0, 1).float() / 255, step)
    h, w = small.shape[-2:]
    v, u = torch.meshgrid(*(torch.arange(n, device=q.device) for n in (h, w)), indexing="ij")
    pixels = torch.stack([(u + 0.5) * step - 0.5, (v + 0.5) * step - 0.5, torch.ones_like(u)]).flatten(1)
    points = torch.linalg.inv(targets.K) @ pixels / q.flatten(2)  # (C, 3, h w)
    there = targets.to_source[..., :3, :3] @ points[:, None] + targets.to_source[..., :3, 3:]
    seen = targets.source_K @ there
    uv = (seen[..., :2, :] / seen[..., 2:, :].clamp(1e-3)).transpose(-1, -2).reshape(-1, h, w, 2)
    grid = (uv + 0.5) / (uv.new_tensor([w, h]) * step) * 2 - 1
    masks = F.grid_sample(targets.source_masks.flatten(0, 1).float(), grid, mode="nearest", align_corners=False)
    valid = (masks[:, 0] > 0.5) & (seen[..., 2, :] > 0.1).reshape(-1, h, w)  # zero outside the image
    warped = F.grid_sample(of_sources, grid, padding_mode="border", align_corners=False)
    many = small.repeat_interleave(number, 0)
    error = _difference(warped, many).masked_fill(~valid, 10.0).view(count, number, h, w).min(1).values
    still = _difference(of_sources, many).view(count, number, h, w)
    still = still.masked_fill(~targets.is_later[..., None, None], 10.0).min(1).values
    counts = (error < still) & (error < 5) & (F.avg_pool2d(targets.masks.float(), step)[:, 0] > 0.99)
    return (error * counts).sum() / counts.sum().clamp(1)


def _difference(one: Tensor, two: Tensor) -> Tensor:
    """SSIM and L1 (B, h, w) of images (B, 3, h, w)."""
    both = F.pad(torch.cat([one, two, one * one, two * two, one * two], 1), (1, 1, 1, 1), mode="reflect")
    x, y, xx, yy, xy = F.avg_pool2d(both, 3, 1).chunk(5, 1)
    ssim = (2 * x * y + 1e-4) * (2 * (xy - x * y) + 9e-4)
    ssim = ssim / ((x * x + y * y + 1e-4) * (xx - x * x + yy - y * y + 9e-4))
    return (0.85 * (1 - ssim).clamp(0, 2) / 2 + 0.15 * (one - two).abs()).mean(1)


def _roughness(inverse: Tensor, street: Tensor, images: Tensor) -> Tensor:
    """Slopes of the correction of the street, where the image has none."""
    correction, total = (inverse / street.clamp(1e-3)).log(), inverse.new_zeros(())
    for axis in (2, 3):
        weight = torch.exp(-10 * images.diff(dim=axis).abs().mean(1, keepdim=True))
        total = total + (correction.diff(dim=axis).abs() * weight).mean()
    return total


# --- the fitted network -----------------------------------------------------------------------------------------------
class FittedDepth:
    """A network of a drive as a ``DepthModel``, kept in a file."""

    name, revision, licence, takes_prompt = "network fitted to this drive", "", "as the drive", False

    def __init__(self, size: tuple[int, int], device: torch.device | str = "cpu") -> None:
        self.network, self.size, self.device = StreetNetwork().to(device), size, device

    def save(self, path: Path) -> None:
        """Write the weights atomically; their checksum is the revision."""
        with whole_file(path) as file:
            torch.save((self.size, self.network.state_dict()), file)
        self.revision = checksum(path)[:12]

    def load(self, path: Path) -> None:
        """Read saved weights; DataError if they are broken."""
        try:
            self.size, weights = torch.load(path, map_location="cpu", weights_only=True)
            self.network.load_state_dict(weights)
        except Exception as error:  # torch raises errors of many types
            raise DataError(f"{path}: expected a fitted network, got {type(error).__name__}; delete it") from None
        self.revision = checksum(path)[:12]

    @torch.inference_mode()
    def predict(self, views: Sequence[View]) -> list[Prediction]:
        """Predict the inverse depth of images, in 1/m."""
        shots = [_Shot.of(view, self.size) for view in views]
        images = torch.stack([shot.image for shot in shots]).to(self.device).float() / 255
        found = self.network(images, torch.stack([shot.street for shot in shots]).to(self.device))
        return [Prediction(one[0], "metres") for one in found.float().cpu().numpy()]
