"""Frames to measure on: a user's, read at several sizes, or synthetic streets on disk, whose true views are known."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import torch

from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.arguments import REAL_TARGET
from arbiview_aug.datasets import Neighbours, open_data
from arbiview_aug.datasets.frame_writer import write_drive, write_frame
from arbiview_aug.datasets.image_io import Reduce
from arbiview_aug.datasets.registry import data_name
from arbiview_aug.datasets.synthetic import RenderedViews, SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.frames import LidarReference, ScoredFrame, make_frame
from arbiview_aug.evaluate.targets import without_masks

REDUCES: tuple[Reduce, ...] = get_args(Reduce)

SOURCES_OVER_VIEWS = 2
"""Synthetic images are as much larger than the views: so decoding at half size has something to save."""


@dataclass(frozen=True)
class Recorded:
    """Frames on disk.

    Attributes:
        name: For tables.
        root: The folder, or ``KIND:PATH``.
        truth: The true views of a frame for a rig; None where nobody knows them.
    """

    name: str
    root: Path
    truth: Callable[[int, Rig], RenderedViews] | None = None

    def sample(self, index: int, reduce: Reduce = 1) -> dict[str, Any]:
        """A frame as its reader gives it."""
        data = open_data(self.root, reduce=reduce)
        return data[index]

    def reader(self, reduce: Reduce) -> Callable[[], Any]:
        """Reads the first frame's images from disk, with its calibration and without its points."""
        data = open_data(self.root, reduce=reduce)
        data.load_points = False
        return partial(data.__getitem__, 0)

    def target(self, name: str | None, size: tuple[int, int]) -> Rig:
        """The rig to render at (h, w): by its name or file, else what the commands take where none is named.

        Stretched, as it was when the published figures were recorded.
        """
        if name is None and self.truth is not None:
            return demo_target_rig(size)
        return without_masks(load_rig(name or REAL_TARGET)).resized(size, "stretch")

    def frame(self, index: int, reduce: Reduce, reference: Reduce) -> ScoredFrame:
        """A frame to evaluate on, with images at 1 / ``reduce``, scored by the colours of images at 1 / ``reference``.

        Where there is no truth, methods get the points of every other degree, and the others score.

        Raises:
            DataError: There is neither truth nor LiDAR.
        """
        sample = self.sample(index, reduce)
        if self.truth is not None:
            return make_frame(sample, truth=partial(self.truth, index), exposures=(), hand_over_points=True)
        if "points" not in sample:
            raise DataError(f"data {self.root}: expected LiDAR points to score by, got none")
        frame = make_frame(sample, exposures=("even",), hand_over_points=True)
        if reduce == reference:
            return frame
        points = make_frame(self.sample(index, reference), exposures=("even",), hand_over_points=True)
        even = LidarReference(frame.lidar["even"].sample, points.lidar["even"].points)
        return replace(frame, lidar={"even": even})


@contextmanager
def recorded(data: str | Path | None, *, frames: int = 1, size: tuple[int, int] = (512, 1408)) -> Iterator[Recorded]:
    """A user's frames, or ``frames`` synthetic streets as JPEGs of ``size`` (h, w) in a temporary folder."""
    if data is not None:
        yield Recorded(data_name(data), Path(data))
        return
    drive = SyntheticDrive(demo_source_rig(size), num_frames=frames)
    with tempfile.TemporaryDirectory() as folder:
        for k in range(frames):
            write_frame(Path(folder) / f"{k:04}", drive[k])
        yield Recorded("synthetic streets", Path(folder), drive.render)


@contextmanager
def recorded_drive(data: str | Path | None, wanted: Neighbours, *, size: tuple[int, int]) -> Iterator[tuple[str, Path]]:
    """Name and folder of a user's drive; or of a synthetic one, a frame with the neighbours that are wanted, as JPEGs
    of ``size`` (h, w) in a temporary folder."""
    if data is not None:
        yield data_name(data), Path(data)
        return
    sample = SyntheticDrive(demo_source_rig(size), num_frames=1, lidar=False, neighbours=wanted)[0]
    with tempfile.TemporaryDirectory() as folder:
        write_drive(Path(folder), [sample, *sample["neighbours"]])
        yield "synthetic drive", Path(folder)


def as_of_another_frame(sample: Mapping[str, Any]) -> dict[str, Any]:
    """The same sample with its images a pixel aside and its points and boxes a millimetre: nothing that was planned or
    estimated for the one fits the other. Memory lies as it did."""
    images = sample["images"]
    aside: Any = images.clone() if isinstance(images, torch.Tensor) else [image.clone() for image in images]
    for to, image in zip(aside, images, strict=True):
        to[..., 1:] = image[..., :-1]
    moved = dict(sample) | {"images": aside}
    for key in ("points", "boxes_3d"):
        if key in sample:
            shift = torch.zeros(sample[key].shape[-1])
            shift[2] = 1e-3
            moved[key] = sample[key] + shift
    return moved
