"""Kernels compiled ahead: in several processes, in the parent process before workers are forked, or before timing."""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rays import pixel_rays
from arbiview_aug.environment import compilation_announced, imported, is_kept, say_compiling
from arbiview_aug.scene.point_cloud import seen_through
from arbiview_aug.scene.scene import Scene

GROUPS = {
    "objects": (
        "transforms.warm_up:warm_up_boxes inpaint.kernels:warm_up render.paint_kernels:warm_up "
        "render.photometry_kernels:warm_up",
        "scene.kernels:draw_solids inpaint.kernels:fill_background render.photometry_kernels:blend",
    ),
    "plans": ("render.view_planner:warm_up", "render.photometry_kernels:read_ahead"),
    "points": (
        "transforms.warm_up:warm_up_points scene.scan:warm_up",
        "scene.completion:hidden_depths scene.scan:continue_road",
    ),
    "motion": ("temporal.motion_depth:warm_up", "temporal.kernels:find_feet"),
}
"""Functions that compile kernels, and the kernels that they compile last, by groups that take about equally long."""


@cache
def compile_kernels(*, matching: bool = True) -> None:
    """Compile all kernels, those of depth from motion if ``matching``, or load them from numba's cache."""
    with compilation_announced():
        _warm_up([name for name in GROUPS if matching or name != "motion"])


@contextmanager
def compiling(*names: str) -> Iterator[None]:
    """Compile the groups of kernels that numba's cache lacks, from here to the end of the block and after it.

    numba compiles one kernel of a process at a time, so other processes take their share of the groups, up to one for
    each core. For the main process of a command: elsewhere calls compile what they need.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    missing = [name for name in names if not all(map(is_kept, _named(GROUPS[name][1])))]
    shares = [missing[k::cores] for k in range(min(cores, len(missing)))]
    spawn = multiprocessing.get_context("spawn")
    processes = [spawn.Process(target=_compile_share, args=(share,), daemon=True) for share in shares[1:]]
    if processes:
        say_compiling()
    try:
        for process in processes:
            process.start()
        yield
        if processes:
            _warm_up(shares[0])
        for process in processes:
            process.join()
    finally:
        for process in processes:
            process.kill()


def _compile_share(names: Sequence[str]) -> None:
    """Compile groups in a silent process: errors occur again where kernels are called."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # handled by the parent
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(silence, stream)
    _warm_up(names)


def _warm_up(names: Sequence[str]) -> None:
    collects = gc.isenabled()
    gc.disable()  # the compiler's many small objects would be searched for garbage over and over
    try:
        for name in names:
            for function in _named(GROUPS[name][0]):
                function()
    finally:
        if collects:
            gc.enable()


def _named(names: str) -> Iterator[Any]:
    return (imported(f"arbiview_aug.{name}") for name in names.split())


_CAMERA = Camera.looking(name="small", azimuth_deg=0, width_px=32, height_px=32, horizontal_fov_deg=90)
_WALL = np.stack(np.meshgrid(8.0, np.linspace(-2, 2, 20), np.linspace(0.3, 1.5, 10)), -1).reshape(-1, 3)
_BOXES = np.array([[8.5, 0, 1, 1, 4, 2, 0], [5, 3, 1, 1, 1, 2, 0]])


def warm_up_boxes() -> None:
    """Compile the kernels of objects' images, or load them from numba's cache."""
    surface: Any = Scene(boxes=_BOXES).surface("boxes", 0.0)
    surface.drawn(_CAMERA, pixel_rays(_CAMERA))
    surface.occlusion_map(_CAMERA, pixel_rays(_CAMERA))


def warm_up_points() -> None:
    """Compile the kernels of points' images, or load them from numba's cache."""
    objects: Any = Scene(boxes=_BOXES, points=_WALL).surface("lidar", 0.0)
    objects.drawn(_CAMERA, pixel_rays(_CAMERA))
    surface = objects.background
    surface.image(_CAMERA, pixel_rays(_CAMERA))
    surface.occlusion_map(_CAMERA, pixel_rays(_CAMERA))
    surface.uncertainty(_CAMERA.center_m, np.eye(3), np.ones(3))
    seen_through(_WALL, _WALL, _CAMERA.center_m)
