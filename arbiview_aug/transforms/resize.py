"""``ResizeRig`` and ``CropRig``: samples in other sizes, with the calibration that belongs to them.

A resize or crop that does not know of cameras (torchvision's, kornia's) leaves ``K`` wrong without any error. These
change pixels, ``K``, masks and label maps together, by the pixel convention of ``Camera.resize`` and ``Camera.crop``.
Lenses use normalised coordinates and stay as they are.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, WarnOnce
from arbiview_aug.image_ops import nearest_resized, resized
from arbiview_aug.sample.batching import leading_shape, like, rewrapped
from arbiview_aug.sample.inputs import LEARNED_KEY, MOTION_KEY, PIXEL_BOUND_KEYS, check_other_keys, read_frames
from arbiview_aug.transforms.outputs import label_maps
from arbiview_aug.transforms.settings import SampleKeys, checked_instance, checked_pixels

_MAPS = ("coverage", "ego_mask", "source_camera", "source_frame", "confidence", "generated", "depth", "depth_m")
"""Keys of maps (..., N, H, W) over the images' pixels, which are resized by the nearest pixel."""


class _PixelTransform(torch.nn.Module, ABC):
    """Applies one change of pixels to the images of a sample and to everything that follows them."""

    def __init__(self, keys: SampleKeys) -> None:
        super().__init__()
        self.keys = checked_instance("keys", keys, SampleKeys)
        self._warn = WarnOnce()

    def forward(self, sample: Mapping[str, Any]) -> dict[str, Any]:
        """The sample in its other size.

        Args:
            sample: As ``RigRetarget`` takes or gives it, batched or not; it is not changed.

        Returns:
            A new dict. 2D boxes and the like (recompute them by ``project_boxes_3d``), and other frames of the drive,
            are dropped with a warning.

        Raises:
            SampleError: As ``RigRetarget`` raises; ``CropRig``: a window that leaves an image.
        """
        frames = read_frames(sample, None)
        images, lead = sample["images"], leading_shape(sample["images"])

        def changed(of_frames: Sequence[Any], change: Callable[[torch.Tensor], torch.Tensor], like: Any) -> Any:
            parts = [torch.stack([change(part.as_subclass(torch.Tensor)) for part in frame]) for frame in of_frames]
            return rewrapped(torch.stack(parts).reshape(*lead, *parts[0].shape), like)

        sizes = [tuple(image.shape[-2:]) for image in frames[0].images]
        labels = check_other_keys(sample, sizes, self.keys.labels, self.keys.keep)
        out = dict(sample)
        for key in (*PIXEL_BOUND_KEYS, MOTION_KEY, LEARNED_KEY, "neighbours"):
            if key in out and key not in (*_MAPS, *labels, *self.keys.keep):
                del out[key]
                self._warn(key, f"{type(self).__name__} drops {key}: it speaks of pixels that have moved")
        out["images"] = changed([frame.images for frame in frames], self._image, images)
        for key in {*_MAPS, *labels} & out.keys() - {*self.keys.keep}:
            if (maps := out[key]) is not None or key not in _MAPS:
                out[key] = changed(label_maps(key, maps, frames, lead), self._map, maps)
        if isinstance(sample.get("rig"), Rig):
            out["rig"] = sample["rig"].with_cameras([self._camera(camera) for camera in sample["rig"]])
        if sample.get("K") is not None:
            K = np.stack([self._camera(camera).K for frame in frames for camera in frame.rig])
            out["K"] = like(torch.from_numpy(K.reshape(*lead, -1, 3, 3)), sample["K"])
        return out

    @abstractmethod
    def _image(self, image: torch.Tensor) -> torch.Tensor:
        """Change a (3, H, W) image."""

    @abstractmethod
    def _map(self, image: torch.Tensor) -> torch.Tensor:
        """Change a (..., H, W) map."""

    @abstractmethod
    def _camera(self, camera: Camera) -> Camera:
        """The camera of the changed image."""


class ResizeRig(_PixelTransform):
    """Resize all images of a sample, antialiased, and K, rig, masks and label maps with them.

    Args:
        size: (h, w) of every output image.
        keys: Its ``labels`` and ``keep``, as for ``RigRetarget``.
    """

    def __init__(self, size: tuple[int, int], *, keys: SampleKeys = SampleKeys()) -> None:  # noqa: B008 - frozen
        super().__init__(keys)
        self.size = checked_pixels(size)

    def extra_repr(self) -> str:
        return f"size={self.size}"

    def _image(self, image: torch.Tensor) -> torch.Tensor:
        return resized(image, self.size)

    def _map(self, image: torch.Tensor) -> torch.Tensor:
        return nearest_resized(image, self.size)

    def _camera(self, camera: Camera) -> Camera:
        return camera.resize(self.size)


class CropRig(_PixelTransform):
    """Cut one window out of all images of a sample, and out of K, rig, masks and label maps with them.

    Args:
        top: First row.
        left: First column.
        size: (h, w) of the window, which must lie within every image.
        keys: As for ``ResizeRig``.
    """

    def __init__(self, top: int, left: int, size: tuple[int, int], *, keys: SampleKeys = SampleKeys()) -> None:  # noqa: B008
        super().__init__(keys)
        self.top, self.left = checked_pixels((top, left), "top, left", "two numbers", 0)
        self.size = checked_pixels(size)

    def extra_repr(self) -> str:
        return f"top={self.top}, left={self.left}, size={self.size}"

    def _image(self, image: torch.Tensor) -> torch.Tensor:
        (h, w), (to_h, to_w) = image.shape[-2:], self.size
        if self.top + to_h > h or self.left + to_w > w:
            got = f"rows {self.top} to {self.top + to_h}, columns {self.left} to {self.left + to_w}"
            raise SampleError(f"CropRig: expected a window within the image of (h, w) = {(h, w)}, got {got}")
        return image[..., self.top : self.top + to_h, self.left : self.left + to_w]

    _map = _image

    def _camera(self, camera: Camera) -> Camera:
        return camera.crop(self.top, self.left, self.size)
