"""Kernels compiled ahead: in several processes, in the parent process before workers are forked, or before timing."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any, Literal, NamedTuple

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rays import pixel_rays
from arbiview_aug.environment import compilation_announced, imported, is_kept, say_compiling
from arbiview_aug.scene.point_cloud import seen_through
from arbiview_aug.scene.scene import Scene

GroupName = Literal["objects", "plans", "points", "motion"]


class Group(NamedTuple):
    """Kernels that one process compiles, named by module and function."""

    warm_ups: tuple[str, ...]  # functions to call, in this order
    last: tuple[str, ...]  # the kernels of each file that are compiled last


GROUPS: dict[GroupName, Group] = {
    "objects": Group(
        ("transforms.warm_up:warm_up_boxes", "inpaint.kernels:warm_up", "render.photometry_kernels:warm_up"),
        ("scene.kernels:draw_solids", "inpaint.kernels:paint", "render.photometry_kernels:blend"),
    ),
    "plans": Group(("render.view_planner:warm_up",), ("render.kernels:read_ahead",)),
    "points": Group(
        ("transforms.warm_up:warm_up_points", "scene.scan:warm_up"),
        ("scene.completion:seen_through", "scene.scan_kernels:continue_road"),
    ),
    "motion": Group(("temporal.motion_depth:warm_up",), ("temporal.kernels:find_feet",)),
}
"""Groups that take about as long as each other, a quarter of a minute or less."""


@cache
def compile_kernels(*, matching: bool = True) -> None:
    """Compile all kernels, those of depth from motion if ``matching``, or load them from numba's cache."""
    with compilation_announced():
        for name in GROUPS:
            if matching or name != "motion":
                _warm_up(name)


@contextmanager
def compiling(*names: GroupName) -> Iterator[None]:
    """Compile the groups of kernels that numba's cache lacks, from here to the end of the block and after it.

    numba compiles one kernel of a process at a time, so other processes take their share of the groups, up to one for
    each core. For the main process of a command: elsewhere calls compile what they need.
    """
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    missing = [name for name in names if not all(is_kept(_named(kernel)) for kernel in GROUPS[name].last)]
    shares = [missing[k::cores] for k in range(min(cores, len(missing)))]
    spawn = multiprocessing.get_context("spawn")
    others = [spawn.Process(target=_compile_share, args=(share,), daemon=True) for share in shares[1:]]
    if others:
        say_compiling()
    try:
        for other in others:
            other.start()
        yield
        if others:
            for name in shares[0]:
                _warm_up(name)
        for other in others:
            other.join()
    finally:
        for other in others:
            other.kill()


def _compile_share(names: list[GroupName]) -> None:
    """Compile groups in a process that says nothing: what fails here fails again where it is called."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # handled by the parent
    silence = os.open(os.devnull, os.O_WRONLY)
    os.dup2(silence, 1)
    os.dup2(silence, 2)
    for name in names:
        _warm_up(name)


def _warm_up(name: GroupName) -> None:
    for function in GROUPS[name].warm_ups:
        _named(function)()


def _named(name: str) -> Any:
    return imported(f"arbiview_aug.{name}")


def warm_up_boxes() -> None:
    """Compile the kernels of objects' images, or load them from numba's cache."""
    camera, boxes, _ = _small_scene()
    surface: Any = Scene(boxes=boxes).surface("boxes", 0.0)
    surface.drawn(camera, pixel_rays(camera))
    surface.occlusion_map(camera, pixel_rays(camera))


def warm_up_points() -> None:
    """Compile the kernels of points' images, or load them from numba's cache."""
    camera, boxes, wall = _small_scene()
    surface: Any = Scene(boxes=boxes, points=wall).surface("lidar", 0.0).background
    surface.image(camera, pixel_rays(camera))
    surface.occlusion_map(camera, pixel_rays(camera))
    surface.uncertainty(camera.center_m, np.eye(3), np.ones(3))
    seen_through(wall, wall, camera.center_m)


def _small_scene() -> tuple[Camera, FloatArray, FloatArray]:
    """A camera that looks at a car's rear and a pedestrian, (B, 7), and at points on that rear, (P, 3)."""
    wall = np.stack(np.meshgrid(8.0, np.linspace(-2, 2, 20), np.linspace(0.3, 1.5, 10)), -1).reshape(-1, 3)
    boxes = np.array([[8.5, 0, 1, 1, 4, 2, 0], [5, 3, 1, 1, 1, 2, 0]])
    camera = Camera.looking(name="small", azimuth_deg=0, width_px=32, height_px=32, horizontal_fov_deg=90)
    return camera, boxes, wall
