"""``python -m arbiview_aug doctor``: whether this installation is sound, and how fast a frame is here."""

from __future__ import annotations

import argparse
import os
import platform
import statistics
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from timeit import timeit

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.kernels import project_image
from arbiview_aug.cli.arguments import gathered_warnings
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.environment import cv2_conflict, installed_version, one_thread, versions
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.warm_up import compiling

_CALLS = 5

Line = tuple[bool, str]  # whether it is fine, and the finding


def run(arguments: argparse.Namespace) -> int:
    """Print one line for each finding; return 1 if something is wrong."""
    is_sound = True
    for is_fine, text in _lines(arguments.size):
        is_sound &= is_fine
        print(text if is_fine else f"PROBLEM: {text}", flush=True)
    return int(not is_sound)


def _lines(size: tuple[int, int]) -> Iterator[Line]:
    found = {**versions(), "numba": installed_version("numba") or "not installed"}
    yield True, f"{', '.join(f'{name} {version}' for name, version in found.items())}; {platform.platform()}"
    if (conflict := cv2_conflict()) is not None:
        yield False, f"OpenCV: {conflict}"
    threads = f"OpenCV {cv2.getNumThreads()}, torch {torch.get_num_threads()} of {os.cpu_count()} cores"
    gpus = [torch.cuda.get_device_name(k) for k in range(torch.cuda.device_count())]
    yield True, f"threads: {threads}; GPUs: {', '.join(gpus) or 'none that torch can use'}"
    yield _kernels(project_image._cache.cache_path)
    yield _frame(size)


def _kernels(path: str | None) -> Line:
    """Count the compiled kernels, given the folder of one subpackage; None if numba can write to no folder."""
    if path is None:
        return False, "compiled kernels: not kept; set NUMBA_CACHE_DIR to a writable folder"
    root = Path(path).parents[1 if Path(path).name == "__pycache__" else 0]
    count = sum(1 for _ in root.rglob("*.sha256*.nb[ic]"))
    return True, f"compiled kernels: {count} files in {root}{'' if count else '; the first frames wait for them'}"


def _frame(size: tuple[int, int]) -> Line:
    """Time one frame of a synthetic street, and check that something was seen."""
    with compiling("objects", "plans", "points"):
        sample = SyntheticDrive(demo_source_rig(size), num_frames=1)[0]
    target, found = demo_target_rig(size), list[str]()
    with gathered_warnings([]), one_thread():
        for geometry in ("street", "auto"):
            call = partial(RigRetarget(target, geometry=geometry), sample)  # type: ignore[arg-type]
            out = call()
            ms = statistics.median(1e3 * timeit(call, number=1) for _ in range(_CALLS))
            found.append(f"{geometry} {ms:.0f} ms")
    images = np.stack([image.numpy() for image in out["images"]])
    cameras = f"{len(sample['rig'])} cameras to {len(images)} of {size[0]}x{size[1]}"
    return bool(images.std() > 1 and out["coverage"].any()), f"a frame, {cameras}, on one thread: {', '.join(found)}"
