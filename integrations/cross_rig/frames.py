"""The frames of the experiment on disk: A's streets, B's truth, each variant's training set."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any, TypeVar

import cv2
import numpy as np
import torch

from arbiview_aug import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from integrations.cross_rig import cache
from integrations.cross_rig.boxes import vehicle_boxes
from integrations.cross_rig.cache import Arrays, FrameStore
from integrations.cross_rig.cuboids import CuboidDrive
from integrations.cross_rig.labels import Grid, box_cells, visible_objects
from integrations.cross_rig.variants import Variant
from integrations.cross_rig.views import ViewMaker
from integrations.cross_rig.worlds import CHANGES, STREETS, Size, Split, World, source_rig, street_seed

T = TypeVar("T")
U = TypeVar("U")

_MAX_FRAMES = 1 << 20
"""Length of the streets' datasets: a set of frames grows without becoming another."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Which frames: plain data, so that worker processes can be told.

    Attributes:
        root: Folder of all sets.
        size: (h, w) of the images.
        split: Streets.
        change: Vehicle B by its change; None: vehicle A.
        variant: Whose training set; None: the rig's true frames. Variants that only draw differently share one.
        streets: The world, by ``worlds.street_seed``.
        world: The generator of the streets.
    """

    root: Path
    size: Size
    split: Split
    change: str | None = None
    variant: Variant | None = None
    streets: int = STREETS
    world: World = "drive"

    def drive(self, rig: Rig) -> SyntheticDrive:
        """The streets' dataset, as a rig sees them."""
        make = CuboidDrive if self.world == "cuboids" else SyntheticDrive
        return make(rig, num_frames=_MAX_FRAMES, seed=street_seed(self.split, self.streets), lidar=False)

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
        return self._true_frames() if self.variant is None else self._views(self.variant)

    def _true_frames(self) -> Callable[[int], Arrays]:
        """Frames that a rig really sees: images, calibration and labels."""
        rig, grid = self.rig, Grid()
        drive = self.drive(rig)
        calibration = {"K": rig.K.astype(np.float32), "cam2ego": rig.cam2ego.astype(np.float32)}

        def make(index: int) -> Arrays:
            scene, views = drive.scene(index), drive.render(index)
            boxes = scene.boxes_ego(rig.ground_z_m)
            visible = visible_objects(views.visible_pixels(len(boxes)).numpy(), self.size)
            state = box_cells(grid, boxes, scene.box_classes, visible)
            labels = {"state": state, "boxes": vehicle_boxes(grid, scene, rig.ground_z_m)}
            assert isinstance(views.images, torch.Tensor)
            return {"images": views.images.numpy(), **calibration, **labels}

        return make

    def _views(self, variant: Variant) -> Callable[[int], Arrays]:
        """A's frames as a variant re-renders them; points are cast again, since that is cheaper than keeping them."""
        original = self.original()
        store, views, drive = original.store(), ViewMaker(variant, original.rig, self.rig), self.drive(original.rig)

        def make(index: int) -> Arrays:
            boxes = drive.scene(index).boxes_ego(original.rig.ground_z_m).astype(np.float32)
            frame: dict[str, Any] = {"images": torch.from_numpy(store.images(index).copy())}
            frame |= {"boxes_3d": torch.from_numpy(boxes)}
            if "points" in variant.reads:
                frame["points"] = drive.points(index)
            return views(index, frame)

        return make


def make_frames(source: Source, num_frames: int, workers: int) -> int:
    """Make the missing chunks; returns how many were."""
    missing = source.store().missing(num_frames)
    return sum(1 for _ in in_processes(partial(_make_chunk, source), missing, workers))


def _make_chunk(source: Source, chunk: int) -> None:
    frames = range(chunk * cache.CHUNK_FRAMES, (chunk + 1) * cache.CHUNK_FRAMES)
    source.store().write(chunk, map(_maker(source), frames))


@lru_cache(maxsize=2)  # a worker goes from chunk to chunk of one source
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
