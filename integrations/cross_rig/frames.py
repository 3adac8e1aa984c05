"""The vehicles, the streets, and the frames on disk: A's, B's, each variant's training set.

Each frame is a file, whole or not there, in a folder named after what makes it: a killed run continues.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import cv2
import numpy as np
import torch

import arbiview_aug
from arbiview_aug import Camera, Rig
from arbiview_aug.atomic_io import write_whole
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_target_rig
from integrations.cross_rig.cuboids import CuboidDrive
from integrations.cross_rig.labels import VISIBLE_SHARE, Grid, labels_of
from integrations.cross_rig.variants import Arrays, Variant, view_maker

Size = tuple[int, int]
"""(h, w) of every image."""

Split = Literal["train", "val", "test"]

World = Literal["drive", "cuboids"]
"""Generators of streets: ``SyntheticDrive``, and the one of ``cuboids`` with other shapes, textures and light."""

SPLITS: tuple[Split, ...] = ("train", "val", "test")
OF_TESTS = SPLITS[1:]
"""Streets of vehicle B: for thresholds, and for tests."""

STREETS = 100
"""The world that constants of the renderer were chosen on; another hundred is another world."""


def street_seed(split: Split, streets: int = STREETS) -> int:
    """Seed of ``SyntheticDrive`` for a split of a world: datasets with different seeds share no street."""
    return streets + 1 + SPLITS.index(split)


_AZIMUTHS_DEG = {"front": 0.0, "front_left": 55.0, "front_right": -55.0}
_AZIMUTHS_DEG |= {"back_left": 110.0, "back_right": -110.0, "back": 180.0}
"""nuScenes' six cameras."""
_RING_RADIUS_M = 0.8
_RING_CENTRE_X_M = 0.9
_HEIGHT_M = 1.5
_FOV_DEG = 65.0


class Change(NamedTuple):
    """A change of vehicle: its title in tables, and vehicle B at a size, in A's ego frame."""

    title: str
    target: Callable[[Size], Rig]


def source_rig(size: Size, *, fov_deg: float = _FOV_DEG, height_m: float = _HEIGHT_M) -> Rig:
    """Vehicle A: six cameras around a car's roof, all with one field of view."""
    looking = partial(Camera.looking, width_px=size[1], height_px=size[0], horizontal_fov_deg=fov_deg)
    cameras = []
    for name, azimuth in _AZIMUTHS_DEG.items():
        angle = math.radians(azimuth)
        x, y = _RING_CENTRE_X_M + _RING_RADIUS_M * math.cos(angle), 0.6 * _RING_RADIUS_M * math.sin(angle)
        cameras.append(looking(name=name, azimuth_deg=azimuth, position_m=(x, y, height_m)))
    return Rig(cameras, name="A")


CHANGES: dict[str, Change] = {
    "fov50": Change("FOV 65° → 50°", lambda size: source_rig(size, fov_deg=50.0)),
    "up70": Change("+0.7 m", lambda size: source_rig(size, height_m=_HEIGHT_M + 0.7)),
    "waymo": Change("Waymo-like, 5 at 2.1 m", demo_target_rig),
}
"""By name. ``waymo``: Waymo's azimuths and height at A's field of view, so that it stays a change of the layout."""


def content_hash(spec: Any) -> str:
    """16 hex digits of plain data."""
    return hashlib.sha256(json.dumps(spec, sort_keys=True).encode()).hexdigest()[:16]


@cache
def code_hash() -> str:
    """16 hex digits of all sources of the package and of this experiment: after a change, everything is made again."""
    files = (*Path(arbiview_aug.__file__).parent.rglob("*.py"), *Path(__file__).parent.glob("*.py"))
    return content_hash([file.read_text() for file in sorted(files)])


class FrameStore:
    """A set of frames in a folder below ``root``, named after the code and ``spec``, which says what the frames are.

    Each frame is a dict of arrays of one shape and type throughout.
    """

    def __init__(self, root: Path, spec: Any) -> None:
        self.key = content_hash([code_hash(), spec])
        self.folder = root / self.key

    def missing(self, num_frames: int) -> list[int]:
        """Frames that are not there, of the first ``num_frames``."""
        return [k for k in range(num_frames) if not self._path(k).is_file()]

    def write(self, index: int, frame: Arrays) -> None:
        """Write a frame; of several processes that make it, the last one's stays, which is the same."""
        content = io.BytesIO()
        np.savez(content, **frame)  # type: ignore[arg-type]
        write_whole({self._path(index): content.getvalue()})

    def read(self, name: str, index: int) -> np.ndarray:
        """An array of one frame."""
        with np.load(self._path(index)) as arrays:
            return np.asarray(arrays[name])

    def stacked(self, name: str, num_frames: int) -> np.ndarray:
        """An array of the first ``num_frames``, in memory: for small ones."""
        return np.stack([self.read(name, k) for k in range(num_frames)])

    def _path(self, index: int) -> Path:
        return self.folder / f"{index:05}.npz"


T = TypeVar("T")
U = TypeVar("U")

_MAX_FRAMES = 1 << 20
"""Length of the streets' datasets: a set of frames grows without becoming another."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Which frames: plain data, so that worker processes can be told."""

    root: Path  # folder of all sets
    size: Size
    split: Split
    change: str | None = None  # vehicle B by its change; None: vehicle A
    variant: Variant | None = None  # whose training set; None: the rig's true frames
    streets: int = STREETS  # the world, for ``street_seed``
    world: World = "drive"

    def drive(self, rig: Rig) -> SyntheticDrive:
        """The streets' dataset, as a rig sees them."""
        make = CuboidDrive if self.world == "cuboids" else SyntheticDrive
        return make(rig, num_frames=_MAX_FRAMES, seed=street_seed(self.split, self.streets), lidar=False)

    @cached_property
    def _own_drive(self) -> SyntheticDrive:
        return self.drive(self.rig)

    @property
    def rig(self) -> Rig:
        """The cameras of the images (the base, where they are drawn around it), in A's ego frame."""
        return source_rig(self.size) if self.change is None else CHANGES[self.change].target(self.size)

    def spec(self) -> dict[str, Any]:
        """Plain data that says what the frames are, without the variant."""
        return {name: getattr(self, name) for name in ("size", "split", "change", "streets", "world")}

    def store(self) -> FrameStore:
        """Folder of the frames."""
        return FrameStore(self.root, [self.spec(), self.variant and self.variant.views_spec()])

    def original(self) -> Source:
        """A's true frames of the same streets, which must be there before a variant's can be made."""
        return replace(self, change=None, variant=None)

    def drives(self, count: int) -> list[int] | None:
        """The drive of each of the first frames; None: each is a drive of one frame."""
        return None

    def maker(self) -> Callable[[int], Arrays]:
        """Return the function that makes a frame of this set from its index."""
        return self._true_frame if self.variant is None else self._views(self.variant)

    def _true_frame(self, index: int) -> Arrays:
        """A frame that a rig really sees: images, calibration and labels."""
        rig, drive = self.rig, self._own_drive
        scene, views = drive.scene(index), drive.render(index)
        boxes = scene.boxes_ego(rig.ground_z_m)
        counts = [np.bincount(view.flatten() + 1, minlength=len(boxes) + 1)[1:] for view in views.instances]
        pixels = np.max(counts, 0)  # of the camera that shows most of an object
        labels = labels_of(Grid(), boxes, scene.box_classes, pixels >= max(1.0, VISIBLE_SHARE * math.prod(self.size)))
        calibration = {"K": rig.K.astype(np.float32), "cam2ego": rig.cam2ego.astype(np.float32)}
        assert isinstance(views.images, torch.Tensor)
        return {"images": views.images.numpy(), **calibration, **labels}

    def _views(self, variant: Variant) -> Callable[[int], Arrays]:
        """A's frames as a variant re-renders them; points are cast again, since that is cheaper than keeping them."""
        original = self.original()
        store, views, drive = original.store(), view_maker(variant, original.rig, self.rig), self.drive(original.rig)

        def make(index: int) -> Arrays:
            boxes = drive.scene(index).boxes_ego(original.rig.ground_z_m).astype(np.float32)
            frame: dict[str, Any] = {"images": torch.from_numpy(store.read("images", index))}
            frame |= {"boxes_3d": torch.from_numpy(boxes)}
            if "points" in variant.reads:
                frame["points"] = drive.points(index)
            return views(index, frame)

        return make


def make_frames(source: Source, num_frames: int, workers: int) -> int:
    """Make the missing frames; returns how many were."""
    return sum(1 for _ in in_processes(partial(_make_frame, source), source.store().missing(num_frames), workers))


def _make_frame(source: Source, index: int) -> None:
    source.store().write(index, _maker(source)(index))


@lru_cache(maxsize=2)  # a worker goes from frame to frame of one source
def _maker(source: Source) -> Callable[[int], Arrays]:
    return source.maker()


def in_processes(function: Callable[[T], U], items: Sequence[T], workers: int) -> Iterator[U]:
    """Results as they come, by processes of one thread each."""
    if workers == 1 or len(items) < 2:
        one_thread()
        yield from map(function, items)
        return
    # Spawned: forked children of a process with threads may hang.
    spawn = get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(items)), mp_context=spawn, initializer=one_thread) as pool:
        for future in as_completed([pool.submit(function, item) for item in items]):
            yield future.result()


def one_thread() -> None:
    """The calling process works on one thread: many such processes do not fight for cores."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
