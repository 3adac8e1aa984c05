"""Maps of the calibration at every pixel or feature cell, for networks that read them beside the images.

CoIn3D (arXiv 2603.05042) names the four: Plücker rays, ground depth, its gradient and the focal length. All are
functions of a camera and the road's height alone, for every lens, so they are computed once for a calibration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from operator import attrgetter
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.choices import checked_stride, choice
from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.sample.batching import gathered, stacked
from arbiview_aug.sample.inputs import Frame, read_frames
from arbiview_aug.sample.training import lift_mask

CHANNELS = {"rays": 3, "moments": 3, "road": 1, "road_gradient": 1, "pixel_angle": 1, "height": 1}
"""Channels of each map."""

COVERAGE_KEY = "camera_maps_coverage"

_MAX_BYTES = 128 * 2**20
_STEP_PX = 0.5  # of derivatives
_NEAREST_ROAD_M = 0.1  # a camera on the road itself has no scale


class CameraMaps(torch.nn.Module):
    """Add ``camera_maps`` (..., N, C, ceil(h / stride), ceil(w / stride)) float32 to a sample, retargeted or not.

    Channels stand in the order of ``maps``; cells without a ray, outside a lens's image circle, are 0 in all of them.
    With d the unit viewing ray of a cell's middle in the ego frame, o the camera's centre there, and g the road's z:

    - ``rays`` (3): d. With ``moments`` (3), o x d in metres, they are Plücker coordinates.
    - ``road`` (1): inverse distance of the road along the ray, max(0, -d_z / (o_z - g)), 1/m; 0 at the horizon and
      above it, at most 10.
    - ``road_gradient`` (1): its derivative down the image, 1/m for each cell; 0 above the horizon.
    - ``pixel_angle`` (1): square root of a cell's solid angle, radians: metres for each cell at unit distance. In the
      middle of a pinhole image it is stride / f.
    - ``height`` (1): o_z - g, metres.

    A list of tensors, one for each camera, where the images have several sizes. With ``coverage`` in the sample there
    is also ``camera_maps_coverage``, its cells that ``lift_mask`` finds covered. Maps of up to 128 MiB are held for
    calibrations that come back. ``SampleKeys(camera_maps=STRIDE)`` has ``RigRetarget`` add all maps to its output.

    Args:
        maps: Names of the maps.
        stride: Pixels along a side of a cell: 1, or the stride of a network's features.

    Raises:
        ValueError: Unknown maps, or a stride below 1.
    """

    def __init__(self, maps: Sequence[str] = tuple(CHANNELS), *, stride: int = 1) -> None:
        super().__init__()
        if not isinstance(maps, list | tuple) or not maps:
            raise ValueError(f"maps: expected names among {', '.join(CHANNELS)}, got {maps!r}")
        self.maps = tuple(choice("maps", name, CHANNELS) for name in maps)
        self.stride = checked_stride("stride", stride)
        self._cache: LRUCache[Any, torch.Tensor] = LRUCache(_MAX_BYTES, attrgetter("nbytes"))

    @property
    def channels(self) -> int:
        """C, the number of channels."""
        return sum(CHANNELS[name] for name in self.maps)

    def extra_repr(self) -> str:
        return f"maps={self.maps}, stride={self.stride}"

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """A new dict with the maps, on the images' device.

        Raises:
            SampleError: A sample that is no sample of ``RigRetarget``.
        """
        frames = read_frames(sample, None)
        maps = gathered([self._of_frame(frame) for frame in frames], frames[0].lead)
        covered = {} if sample.get("coverage") is None else {COVERAGE_KEY: lift_mask(sample, self.stride)}
        return {**sample, "camera_maps": maps, **covered}

    def _of_frame(self, frame: Frame) -> torch.Tensor | list[torch.Tensor]:
        of_cameras = [self._held(camera, frame.rig.ground_z_m) for camera in frame.rig]
        return stacked([maps.to(image.device, copy=True) for maps, image in zip(of_cameras, frame.images, strict=True)])

    def _held(self, camera: Camera, ground_z_m: float) -> torch.Tensor:
        calibration = camera.size, camera.lens, camera.distortion, camera.K.tobytes(), camera.cam2ego.tobytes()
        settings = self.maps, self.stride  # masks change no map
        return self._cache.get(
            (*calibration, ground_z_m), lambda: torch.from_numpy(camera_maps(camera, ground_z_m, *settings))
        )


def camera_maps(
    camera: Camera, ground_z_m: float, maps: Sequence[str] = tuple(CHANNELS), stride: int = 1
) -> npt.NDArray[np.float32]:
    """The maps (C, ceil(h / stride), ceil(w / stride)) of one camera over a road at ``ground_z_m``; see ``CameraMaps``.

    Raises:
        SampleError: A camera that does not stand over the road, where its map is asked for.
    """
    height_m = float(camera.center_m[2]) - ground_z_m
    if {"road", "road_gradient"} & {*maps} and height_m < _NEAREST_ROAD_M:
        where = f"a camera {_NEAREST_ROAD_M:g} m or more over the road at z = {ground_z_m:g} m"
        raise SampleError(f"camera {camera.name!r}: map 'road': expected {where}, got z = {camera.center_m[2]:g} m")
    rays, is_valid = _rays(camera, stride, 0, 0)
    right, down = (_slope(camera, rays, stride, axis) for axis in (0, 1))
    road = -rays[2] / max(height_m, _NEAREST_ROAD_M)
    by_name = {
        "rays": rays,
        "moments": np.cross(camera.center_m, rays, axisb=0, axisc=0),
        "road": np.maximum(road, 0)[None],
        "road_gradient": np.where(road > 0, -down[2] / max(height_m, _NEAREST_ROAD_M), 0)[None],
        "pixel_angle": np.sqrt(np.linalg.norm(np.cross(right, down, axis=0), axis=0))[None],
        "height": np.full_like(road, height_m)[None],
    }
    return np.where(is_valid, np.concatenate([by_name[name] for name in maps]), 0).astype(np.float32)


def _rays(camera: Camera, stride: int, right: float, down: float) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
    """Unit ego-frame rays (3, ny, nx) through the middles of cells, moved by pixels, and where there are any."""
    h, w = camera.size
    u, v = (stride * (np.arange(-(-side // stride)) + 0.5) - 0.5 for side in (w, h))
    directions, is_valid = camera.unproject(np.stack(np.meshgrid(u + right, v + down), -1))
    return np.moveaxis(np.where(is_valid[..., None], directions, 0), -1, 0), is_valid


def _slope(camera: Camera, rays: FloatArray, stride: int, axis: int) -> FloatArray:
    """Derivative (3, ny, nx) of rays to the right (axis 0) or down (1), for each cell; one-sided at an image circle."""
    step = _STEP_PX * (1 - axis), _STEP_PX * axis
    (ahead, is_ahead), (behind, is_behind) = _rays(camera, stride, *step), _rays(camera, stride, *(-x for x in step))
    apart = np.where(is_ahead, ahead, rays) - np.where(is_behind, behind, rays)
    return apart * (stride / _STEP_PX) / np.maximum(is_ahead.astype(int) + is_behind, 1)


class CameraPriorStem(torch.nn.Module):
    """Add what camera maps say to features of the same stride; at first nothing, by zeros in its last convolution.

    Args:
        maps: Channels of the camera maps (``CameraMaps.channels``).
        features: Channels of the features.
        hidden: Channels between the two convolutions of 1 x 1.
    """

    def __init__(self, maps: int, features: int, hidden: int = 32) -> None:
        super().__init__()
        last = torch.nn.Conv2d(hidden, features, 1)
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.zeros_(last.bias)  # type: ignore[arg-type]
        self.stem = torch.nn.Sequential(torch.nn.Conv2d(maps, hidden, 1), torch.nn.ReLU(), last)

    def forward(self, features: torch.Tensor, camera_maps: torch.Tensor) -> torch.Tensor:
        """Features (..., F, h, w) with what the maps (..., C, h, w) add; leading dimensions are the same."""
        sides = (
            ("features", features, self.stem[-1].out_channels),
            ("camera_maps", camera_maps, self.stem[0].in_channels),
        )
        for name, got, channels in sides:
            if not isinstance(got, torch.Tensor):  # ``CameraMaps`` gives a list for images of several sizes
                fix = "torch.stack the cameras of one size"
                raise SampleTypeError(f"{name}: expected a tensor, got {type(got).__name__}; {fix}")
            expected = channels, *features.shape[-2:]
            if got.shape[-3:] != expected or got.shape[:-3].numel() != features.shape[:-3].numel():
                fix = "are stride=, the numbers of channels and of images those of the features and maps?"
                raise SampleError(f"{name}: expected (..., channels, h, w) = {expected}, got {tuple(got.shape)}; {fix}")
        maps = camera_maps.reshape(-1, *camera_maps.shape[-3:]).to(features)
        return features + self.stem(maps).reshape(features.shape)
