"""Training frames of any of the package's readers, at the training size, split by scenes (Sec. Dataset)."""

from __future__ import annotations

import signal
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, get_worker_info
from tqdm import tqdm

from arbiview_aug.cli.parallel import unchanged
from arbiview_aug.datasets.drive import Neighbours
from arbiview_aug.datasets.frame_folder import SEQUENCE_FILE
from arbiview_aug.datasets.nuscenes.reader import NuScenesDataset
from arbiview_aug.datasets.registry import READERS, open_data
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import TrainingError
from arbiview_aug.generator.training.checkpointing import STOP_SIGNALS
from arbiview_aug.image_ops import resized
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import read_frames

SHARES = (0.6, 0.2)  # shares of the scenes for training and validation; the rest are held out (Sec. Dataset)
_BLOCKS = 10  # number of scenes into which a drive without scenes is cut
_MOVING_MPS = 0.5  # of a box: noise of labels between two annotations is slower
CACHE_BYTES = 4 * 2**30  # memory for frames, of all workers together: 8,000 of six 128 x 224 images


class Split(NamedTuple):
    training: list[int]
    validation: list[int]
    held_out: list[int]


class Frames:
    """Frames of a map-style data set at the training size (h, w), cached in memory.

    A frame's ``further`` holds its ``token``, and as ``moving`` the boxes (M, 7) that move by velocities or neighbours.
    ``scenes`` names each frame's, ``name`` the data set as ``TrainedOn.data`` does.
    """

    def __init__(
        self, dataset: Dataset[dict[str, Any]], size: tuple[int, int], scenes: Sequence[str], name: str = ""
    ) -> None:
        self.dataset, self.size, self.scenes, self.name = dataset, size, list(scenes), name
        self._cache: LRUCache[int, Frame] = LRUCache(CACHE_BYTES, _bytes_of)

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Frame:
        worker = get_worker_info()
        if worker is not None:
            self._cache.limit = CACHE_BYTES // worker.num_workers
        return self._cache.get(index, lambda: self._read(index))

    def _read(self, index: int) -> Frame:
        (frame,) = read_frames(self.dataset[index], None, "auto", further=("neighbours",), names=("token",))
        moving = [near.moved for near in frame.neighbours or () if near.moved is not None]
        # Arrays, since each tensor that a worker sends keeps a file open.
        points, boxes = (None if part is None else np.asarray(part) for part in (frame.points, frame.boxes))
        if boxes is not None and boxes.ndim == 2:
            moving.append(boxes[np.linalg.norm(boxes[:, 7:9], axis=1) > _MOVING_MPS, :7])  # unknown speeds are NaN
        further = {**frame.further, "moving": np.concatenate([np.zeros((0, 7)), *moving])}
        images, rig = tuple(resized(image, self.size) for image in frame.images), frame.rig.resized(self.size)
        return Frame(images, rig, points, boxes, further=further)

    def prepare(self, indices: Sequence[int], *, workers: int = 0, show: bool = True) -> None:
        """Cache frames, read by ``workers`` processes, before the workers that make items fork and share the memory."""
        settings: Any = {"batch_size": None, "sampler": indices, "collate_fn": unchanged, **item_workers(workers)}
        read: DataLoader[Frame] = DataLoader(self, **settings)  # type: ignore[arg-type]
        for index, frame in zip(indices, tqdm(read, desc="frames", unit="frame", disable=not show), strict=True):
            frame = replace(frame, images=tuple(image.clone() for image in frame.images))  # as above
            self._cache.get(index, partial(unchanged, frame))

    def split(self, seed: int = 0) -> Split:
        """Split 60/20/20 by whole scenes; depends on the seed and the scenes' names alone.

        One of at least two scenes is held out; two and three have no validation part.
        """
        names = sorted(set(self.scenes))
        order = torch.randperm(len(names), generator=torch.Generator().manual_seed(seed)).tolist()
        first = max(1, round(SHARES[0] * len(names)))
        second = max(first, min(first + round(SHARES[1] * len(names)), len(names) - 1))
        parts = ({names[k] for k in part} for part in (order[:first], order[first:second], order[second:]))
        return Split(*([index for index, scene in enumerate(self.scenes) if scene in part] for part in parts))


def _bytes_of(frame: Frame) -> int:
    return sum(array.nbytes for array in (*frame.images, frame.points) if array is not None)


def item_workers(count: int) -> dict[str, Any]:
    """Arguments of a ``DataLoader`` with workers of one thread each; 0 makes its items in this process.

    Workers fork, to share this process's frames (not the default from Python 3.14).
    """
    started = ("fork", one_thread_worker) if count else (None, None)
    return {"num_workers": count, "multiprocessing_context": started[0], "worker_init_fn": started[1]}


def one_thread_worker(worker: int) -> None:
    """Initialise a worker: one thread, no signals: the main process saves first and then ends its workers."""
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def open_frames(data: str, size: tuple[int, int], *, scenes: int, seed: int = 0) -> Frames:
    """Open the frames (h, w) that ``--data`` names: ``KIND:PATH``, or a number of synthetic ``scenes``.

    TrainingError for an unknown kind, DataError for a folder without such data.
    """
    kind, _, folder = data.partition(":")
    if data == "synthetic":
        drive = SyntheticDrive(demo_source_rig(size), num_frames=scenes, seed=seed)
        return Frames(drive, size, [str(k) for k in range(scenes)], data)
    if kind not in READERS or not folder:
        raise TrainingError(f"--data {data}: expected synthetic, {' or '.join(f'{name}:PATH' for name in READERS)}")
    dataset = open_data(data, neighbours=Neighbours())
    is_drive, names = (dataset.root / SEQUENCE_FILE).is_file(), dataset.tokens
    if kind == "py123d":
        names = [token.rpartition("-")[0] for token in names]  # of the logs
        is_drive = len(set(names)) == 1
    if isinstance(dataset, NuScenesDataset):
        names = dataset.scene_tokens
    elif is_drive:  # cut into blocks: frames next to each other show the same street
        names = [f"block {_BLOCKS * k // len(dataset)}" for k in range(len(dataset))]
    return Frames(dataset, size, names, f"{kind}:{Path(folder).resolve()}")
