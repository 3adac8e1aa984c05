"""The frames of the experiment on disk: A's streets, B's truth, each variant's training set."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from arbiview_aug import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from integrations.cross_rig.boxes import vehicle_boxes
from integrations.cross_rig.cache import Arrays, FrameStore, code_hash, fill
from integrations.cross_rig.cuboids import CuboidDrive
from integrations.cross_rig.labels import Grid, box_cells, visible_objects
from integrations.cross_rig.variant import Variant
from integrations.cross_rig.views import ViewMaker
from integrations.cross_rig.worlds import CHANGES, STREETS, Size, Split, World, source_rig, street_seed

_WORLD = "arbiview_aug.datasets.synthetic"
_FORMAT = 1
"""Part of every set's name: raise it when this file stores something else."""

_COMPLETING = ("arbiview_aug.generator", "arbiview_aug.generator.inpainter")
_UNUSED: dict[str, tuple[str, ...]] = {
    "black": (*_COMPLETING, "arbiview_aug.inpaint.continued"),
    "fill": _COMPLETING,
}
"""By ``Variant.holes``, what ``RigRetarget`` asks to fill holes and does not need for these."""

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
        variant: Whose training set; None: the rig's own true frames. Variants that only draw differently share one.
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

    @property
    def street_seed(self) -> int:
        """Seed of the streets' dataset."""
        return street_seed(self.split, self.streets)

    def drive(self, rig: Rig) -> SyntheticDrive:
        """The streets' dataset, as a rig sees them."""
        make = CuboidDrive if self.world == "cuboids" else SyntheticDrive
        return make(rig, num_frames=_MAX_FRAMES, seed=self.street_seed, lidar=False)

    def world_spec(self) -> dict[str, Any]:
        """Name of the streets: their seed and the code that builds and renders them."""
        # Not the cameras' code: theirs is pinned by tests, and a change there must not cost hours of rendering.
        spec = {"streets": self.street_seed, "world": code_hash(_WORLD, within=_WORLD)}
        return spec | ({"cuboids": code_hash("integrations.cross_rig.cuboids")} if self.world == "cuboids" else {})

    @property
    def rig(self) -> Rig:
        """The cameras of the images (the base, where they are drawn around it), in A's ego frame."""
        return source_rig(self.size) if self.change is None else CHANGES[self.change].target(self.size)

    def store(self) -> FrameStore:
        """Folder of the frames."""
        spec: dict[str, Any] = {
            "format": _FORMAT,
            "rig": self.rig.content_key.hex(),
            "grid": vars(Grid()),
            **self.world_spec(),
            "labels": code_hash("integrations.cross_rig.labels"),
        }
        if self.variant is not None:
            variant = self.variant
            spec |= {
                "source": source_rig(self.size).content_key.hex(),
                "arm": variant.views_spec(),  # the key that names existing frame stores
                "renderer": code_hash("arbiview_aug.transforms.rig_retarget", without=_UNUSED[variant.holes]),
                # ``variant`` holds what a variant says of its views, so changes of other variants keep these frames.
                "views": code_hash("integrations.cross_rig.views", without=("integrations.cross_rig.variant",)),
            }
        return FrameStore(self.root, spec)

    def original(self) -> Source:
        """A's true frames of the same streets."""
        return replace(self, change=None, variant=None)

    def needs(self) -> list[Source]:
        """The sets that must be there before this one can be made."""
        if self.variant is None:
            return []
        return [self.original()]

    def maker(self) -> Callable[[int], Arrays]:
        """Return the function that makes a frame of this set from its index."""
        return _TrueFrames(self) if self.variant is None else _VariantFrames(self)


def box_store(source: Source) -> FrameStore:
    """Boxes of a split's vehicles, in A's ego frame; of no rendering."""
    spec = {
        "format": _FORMAT,
        "boxes": code_hash("integrations.cross_rig.boxes"),
        **source.world_spec(),
    }
    return FrameStore(source.root, spec)


def make_boxes(source: Source, num_frames: int) -> None:
    """Make what is missing."""
    store = box_store(source)
    drive = source.drive(source_rig((96, 256)))
    for chunk in store.missing(num_frames):
        fill(store, lambda k: {"boxes": vehicle_boxes(Grid(), drive.scene(k), drive.rig.ground_z_m)}, chunk)


def make_frames(source: Source, num_frames: int, workers: int) -> Iterator[tuple[int, int]]:
    """Make what is missing; yields (chunks done, chunks to do), first (0, n).

    Those that the source needs must be there.
    """
    missing = source.store().missing(num_frames)
    yield 0, len(missing)
    if workers == 1 or len(missing) < 2:
        for done, chunk in enumerate(missing, 1):
            _make_chunk(source, chunk)
            yield done, len(missing)
        return
    # Spawned: forked children of a process with threads may hang.
    with ProcessPoolExecutor(min(workers, len(missing)), mp_context=get_context("spawn")) as pool:
        waiting = [pool.submit(_make_chunk, source, chunk) for chunk in missing]
        for done, future in enumerate(waiting, 1):
            future.result()
            yield done, len(missing)


def _make_chunk(source: Source, chunk: int) -> None:
    one_thread()
    fill(source.store(), _maker(source), chunk)


@lru_cache(maxsize=2)  # a worker goes from chunk to chunk of one source
def _maker(source: Source) -> Callable[[int], Arrays]:
    return source.maker()


def one_thread() -> None:
    """The calling process works on one thread: many such processes do not fight for cores."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)


class _TrueFrames:
    """Frames that a rig really sees: images and labels."""

    def __init__(self, source: Source) -> None:
        self.source, self.rig = source, source.rig
        self.drive = source.drive(self.rig)

    def __call__(self, index: int) -> Arrays:
        start = time.process_time()
        scene, views = self.drive.scene(index), self.drive.render(index)
        boxes = scene.boxes_ego(self.rig.ground_z_m)
        visible = visible_objects(views.visible_pixels(len(boxes)).numpy(), self.source.size)
        cells = box_cells(Grid(), boxes, scene.box_classes, visible)
        assert isinstance(views.images, torch.Tensor) and isinstance(views.depth_m, torch.Tensor)
        arrays = {"images": views.images.numpy(), "state": cells.state, "height_dm": cells.height_dm}
        return {**arrays, "cpu_s": np.array(time.process_time() - start, np.float32)}


class _VariantFrames:
    """A's frames as a variant re-renders them; points are cast anew, since that is cheaper than keeping them."""

    def __init__(self, source: Source) -> None:
        assert source.variant is not None
        self.variant, self.original = source.variant, source.original()
        self.store = self.original.store()
        self.views = ViewMaker(self.variant, self.original.rig, source.rig)
        self.drive = source.drive(self.original.rig)

    def __call__(self, index: int) -> Arrays:
        frame: dict[str, Any] = {"images": torch.from_numpy(self.store.read(index, "images").copy())}
        if "boxes_3d" in self.variant.reads:
            boxes = self.drive.scene(index).boxes_ego(self.original.rig.ground_z_m)
            frame["boxes_3d"] = torch.from_numpy(boxes.astype(np.float32))
        if "points" in self.variant.reads:
            frame["points"] = self.drive.points(index)
        return self.views(index, frame)
