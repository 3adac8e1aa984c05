"""Two recorded data sets, made small and moved to a road at z = 0, so that grid and detectors are those of the streets.

Drives are split, never frames. Vehicles with fewer than 5 LiDAR points count for nothing.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug import Rig, RigRetarget
from arbiview_aug.datasets import open_data
from arbiview_aug.datasets.drive import Recording
from arbiview_aug.datasets.synthetic import BoxClass
from arbiview_aug.errors import DataError
from arbiview_aug.scene.boxes import points_in
from integrations.cross_rig.frames import OF_TESTS, SPLITS, Arrays, Source, Split
from integrations.cross_rig.labels import Grid, labels_of
from integrations.cross_rig.variants import Variant, arrays_of, view_maker

_VEHICLES = {"vehicle", "car", "van", "truck", "bus", "trailer"}
_NO_VEHICLES = {"bicycle", "motorcycle", "cyclist", "human", "pedestrian", "static", "movable"}
"""A box is a vehicle if its category (``vehicle.bus.rigid``, ``SCHOOL_BUS``) has a word of the first set, and none of
the second."""

LEAST_POINTS = 5
"""nuScenes and Waymo leave out boxes with fewer LiDAR points, or mark them as hard."""

_SHARES = {"val": 0.15, "test": 0.35}
"""Shares of B's drives, at least one each; the others are for training, and A's that are not among these shares."""


@lru_cache(maxsize=4)
def recording(data: str) -> Recording:
    """The data set, opened once in each process; DataError for one without drives."""
    opened = open_data(data)
    if not getattr(opened, "scene_tokens", None):
        raise DataError(f"data {data}: expected the drive of each sample (nuScenes layout), found none")
    return opened


@lru_cache(maxsize=4)
def first_rig(data: str) -> Rig:
    """The rig of the first sample, whose images are read for it."""
    rig: Rig = recording(data)[0]["rig"]
    return rig


def drives_of(data: str) -> list[str]:
    """The drive of each sample."""
    return list(recording(data).scene_tokens)  # type: ignore[attr-defined]


def frames_of(data: str, split: Split | None) -> list[int]:
    """Samples of a split, or of all drives (None): one of each drive in turn, in one random order."""
    drives = drives_of(data)
    names = sorted(set(drives))
    if split is not None:
        if len(names) < len(SPLITS):
            raise DataError(f"data {data}: expected {len(SPLITS)} drives or more to split, found {len(names)}")
        shuffled = np.random.default_rng(0).permutation(names).tolist()
        val, test = (max(1, round(_SHARES[s] * len(names))) for s in ("val", "test"))
        names = {"val": shuffled[:val], "test": shuffled[val : val + test], "train": shuffled[val + test :]}[split]
    by_drive: dict[str, list[int]] = {name: [] for name in names}
    for k in np.random.default_rng(0).permutation(len(drives)).tolist():
        if drives[k] in by_drive:
            by_drive[drives[k]].append(k)
    return [k for turn in zip_longest(*by_drive.values()) for k in turn if k is not None]


def frames_of_a(a: str, b: str) -> list[int]:
    """A's samples, without drives that B's thresholds or tests are of: two vehicles may have driven the same ones."""
    drives, drives_of_b = drives_of(a), drives_of(b)
    held_out = {drives_of_b[k] for split in OF_TESTS for k in frames_of(b, split)}
    frames = [k for k in frames_of(a, None) if drives[k] not in held_out]
    if not frames:
        raise DataError(f"data {a}: expected drives that are not of B's validation or test, found none")
    return frames


@dataclass(frozen=True, kw_only=True)
class RecordedSource(Source):
    """As ``Source``, of recorded frames."""

    data: tuple[str, str]  # names of the data sets of A and B for ``open_data``

    @property
    def is_of_b(self) -> bool:
        """Whether B recorded these frames; else A recorded them, or those that they are rendered from."""
        return self.change is not None and self.variant is None

    @property
    def recorded_by(self) -> str:
        """The data set whose frames these are, or that they are rendered from."""
        return self.data[self.is_of_b]

    @cached_property
    def frames(self) -> list[int]:
        """Its samples."""
        return frames_of(self.data[1], self.split) if self.is_of_b else frames_of_a(*self.data)

    @cached_property
    def rig(self) -> Rig:
        """The cameras of the first sample, small and without lenses, over a road at z = 0."""
        return small_rig(first_rig(self.data[self.change is not None]), self.size)

    def spec(self) -> dict[str, Any]:
        """Data set, samples, and the first sample's calibration."""
        data = self.recorded_by
        samples = [recording(data).tokens[k] for k in self.frames]
        rigs = {"rig": self.rig.content_key.hex(), "recorded": first_rig(data).content_key.hex()}
        return {"data": str(Path(data).resolve()), "samples": samples, "size": self.size, **rigs}

    def drives(self, count: int) -> list[int]:
        """Numbers of the drives of the first frames."""
        chosen = [drives_of(self.recorded_by)[k] for k in self.frames[:count]]
        return [sorted(set(chosen)).index(name) for name in chosen]

    def maker(self) -> Callable[[int], Arrays]:
        """Function that makes a frame of this set."""
        make = super().maker()
        return lambda index: make(self.frames[index])

    def _true_frame(self, index: int) -> Arrays:
        sample = recording(self.recorded_by)[index]
        rig = sample["rig"]
        shrink = RigRetarget(small_rig(rig, self.size, road=rig.ground_z_m), geometry="infinity", holes="black")
        boxes, points = vehicles_of(sample, self.recorded_by)
        boxes[:, 2] -= rig.ground_z_m
        labels = labels_of(Grid(), boxes, np.full(len(boxes), BoxClass.CAR), points >= LEAST_POINTS)
        return _over_road(arrays_of(shrink({"images": sample["images"], "rig": rig})), rig) | labels

    def _views(self, variant: Variant) -> Callable[[int], Arrays]:
        views = view_maker(variant, self.original().rig, self.rig)

        def make(index: int) -> Arrays:
            sample = recording(self.recorded_by)[index]
            return _over_road(views(index, sample), sample["rig"])

        return make


def _over_road(views: Arrays, rig: Rig) -> Arrays:
    """Views whose poses are in a frame with the road at z = 0."""
    views["cam2ego"][:, 2, 3] -= np.float32(rig.ground_z_m)
    return views


def small_rig(rig: Rig, size: tuple[int, int], *, road: float = 0.0) -> Rig:
    """Pinhole cameras of one size, cut to its aspect, with the road at z = ``road``."""
    small = rig.undistorted().resized(size, fit="crop").shifted(z_m=road - rig.ground_z_m)
    return Rig(list(small), ground_z_m=road, name=rig.name)


def vehicles_of(sample: dict[str, Any], data: str) -> tuple[np.ndarray, np.ndarray]:
    """Boxes (B, 7) of a sample's vehicles, and the number of LiDAR points in each (enough where there is no LiDAR)."""
    if "boxes_3d" not in sample or "box_names" not in sample:
        raise DataError(f"data {data}: sample {sample['token']}: expected boxes_3d and box_names, found no labels")
    words = [set(re.split(r"[^a-z]+", name.lower())) for name in sample["box_names"]]
    chosen = np.array([bool(found & _VEHICLES) and not found & _NO_VEHICLES for found in words], bool)
    boxes = np.asarray(sample["boxes_3d"], np.float64)[chosen, :7]
    if "points" not in sample:
        return boxes, np.full(len(boxes), LEAST_POINTS)
    inside = points_in(boxes, np.asarray(sample["points"], np.float64)[:, :3])
    return boxes, np.array([len(found) for found in inside], int)
