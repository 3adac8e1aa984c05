"""Kernels compiled ahead: in the parent process, before workers are forked, or before anything is timed."""

from __future__ import annotations

from functools import cache

from arbiview_aug.environment import compilation_announced


@cache
def compile_kernels(*, matching: bool = True) -> None:
    """Compile all kernels, those of depth from motion if ``matching``, or load them from numba's cache.

    Each file that has kernels warms its own up.
    """
    from arbiview_aug.inpaint import kernels as inpaint
    from arbiview_aug.render import photometry_kernels as photometry
    from arbiview_aug.render import view_planner
    from arbiview_aug.scene import scan
    from arbiview_aug.temporal import motion_depth

    with compilation_announced():
        for module in (view_planner, photometry, inpaint, scan, *((motion_depth,) if matching else ())):
            module.warm_up()
