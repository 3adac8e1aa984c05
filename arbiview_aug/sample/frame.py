"""A frame and its neighbours: plain data that ``sample.inputs`` reads, which nobody changes later."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.sample.batching import check_container, checked_images
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.scene.boxes import carried, moved_boxes
from arbiview_aug.scene.point_cloud import checked_points, finite_rows, own_car, seen_through


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame of a sample. Images and calibration are checked; other entries are checked where they are used.

    Attributes:
        images: N images (3, H, W), uint8 or float in [0, 1].
        rig: Their cameras.
        points: Measured points (P, >= 3) in the ego frame, as the sample holds them; None without any, as for boxes.
        boxes: Labelled objects (B, >= 7), not checked either.
        depth: Depth maps of each camera, by sample key.
        neighbours: Other frames of the drive, nearest first; None if the sample has no such key.
        further: Other entries that were asked for, by sample key.
    """

    images: tuple[torch.Tensor, ...]
    rig: Rig
    points: Any = None
    boxes: Any = None
    depth: Mapping[str, Sequence[Any]] = field(default_factory=dict, repr=False)
    neighbours: tuple[Neighbour, ...] | None = None
    further: Mapping[str, Any] = field(default_factory=dict, repr=False)


@dataclass(frozen=True, eq=False)
class Neighbour:
    """Another frame of the drive, seen from the current one."""

    number: int  # its index in the sample's list
    name: str  # its token, else its number
    rig: Rig  # its cameras in the current frame's ego frame, over the current frame's road
    travel_m: float  # distance between the two vehicles
    ahead_m: float  # its position along the current heading
    seconds: float | None  # time from the current frame to it; None if either has no time
    boxes: FloatArray | None  # (B, 7) labelled objects at its time, in the current ego frame; None if unknown
    boxes_now: FloatArray | None  # (B, 7) labelled objects in the current frame; None if unknown
    ego2ego: FloatArray  # (4, 4) its ego frame to the current one
    given: Mapping[str, Any]  # the entry itself; its images are read lazily
    current: Frame  # the current frame, without its neighbours

    @property
    def is_later(self) -> bool:
        """Whether it was recorded after the current frame; without times, whether it is ahead."""
        return (self.seconds or self.ahead_m) > 0

    @property
    def labelled(self) -> FloatArray:
        """(B, 7) the labelled objects of both frames, in the current ego frame."""
        return np.concatenate([np.zeros((0, 7)), *(b for b in (self.boxes, self.boxes_now) if b is not None)])

    @cached_property
    def moved(self) -> FloatArray | None:
        """(B, 7) the labels of both frames that moved between them; None if either has none."""
        if self.boxes is None or self.boxes_now is None:
            return None
        return moved_boxes(self.boxes_now, self.boxes)

    def points(self) -> FloatArray | None:
        """(P, C) its points in the current ego frame, those of labelled objects moved with them; None without any."""
        value = self.given.get("points")
        if value is None:
            return None
        array = as_array("points", value)
        its_points = checked_points(array)
        kept = ~own_car(its_points)
        points = np.array(array[finite_rows(array)][kept] if array.ndim == 2 else its_points, np.float64)
        points[:, :3] = its_points[kept] @ self.ego2ego[:3, :3].T + self.ego2ego[:3, 3]
        return points if self.boxes is None or self.boxes_now is None else carried(points, self.boxes, self.boxes_now)

    @cached_property
    def sweep(self) -> FloatArray | None:
        """(P, C) its ``points`` that those of the current frame do not contradict; None if either has none."""
        if self.current.points is None or (points := self.points()) is None:
            return None
        origin = np.mean([camera.center_m for camera in self.current.rig], axis=0)
        measured = checked_points(as_array("points", self.current.points))
        return points[~seen_through(measured, points[:, :3], origin)]

    def images(self, like: Sequence[torch.Tensor]) -> tuple[torch.Tensor, ...]:
        """Its images, checked, with the dtype and device of the current ones."""
        check_container(self.given.get("images"))
        images = checked_images(list(self.given["images"]))
        sizes, expected = [tuple(image.shape[1:]) for image in images], self.rig.sizes
        if sizes != expected:
            raise SampleError(f"images: expected the sizes {expected}, got {sizes}")
        if images[0].dtype != like[0].dtype:
            raise SampleTypeError(f"images: expected {like[0].dtype} as in the current frame, got {images[0].dtype}")
        return tuple(image.to(like[0].device) for image in images)
