"""``bench speed --device``: how near the torch execution comes to moving its bytes once.

A batch of frames is rendered for the same cameras turned by ``YAW_DEG``, from images that lie on the device already:
uint8, bfloat16 and float32, always with float32 grids.

*Bytes* are the least that must move: each source image that is read, once; each map position, once for the whole batch;
each view, once; all in their own types. *Share* is bytes / time, over the bandwidth of a copy within the device of as
many bytes, measured in the same rounds (a copy moves its bytes twice: read and written). A share of 1 is the limit.

Times are CUDA events', or on the CPU the process's CPU time on one thread.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.bench.study import SIZE, facts
from arbiview_aug.cli.bench.timing import clock_of, machine_line, quartiles, timed_rounds
from arbiview_aug.environment import one_thread
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.image_ops import resized
from arbiview_aug.render.plan import RenderPlan, build_plan
from arbiview_aug.render.torch_backend import maps_on, render_torch

YAW_DEG = 22.0
DTYPES = {"uint8": torch.uint8, "bf16": torch.bfloat16, "fp32": torch.float32}
BATCH = {"cuda": 8, "cpu": 1}


def measure_device(
    rig: Rig,
    images: Sequence[torch.Tensor],
    data: str,
    device: torch.device,
    repeats: int,
    *,
    sizes: Sequence[tuple[int, int]] | None = None,
) -> dict[str, Any]:
    """Times and bandwidths of all sizes and types, as plain data for JSON.

    Args:
        rig: Cameras without masks.
        images: (3, h, w) uint8 of each.
        data: The name of the data.
        device: The device that renders.
        repeats: Rounds.
        sizes: (h, w) of images and views: by default those of the images, and ``SIZE``.
    """
    load_before, batch = os.getloadavg(), BATCH[device.type]
    with one_thread():
        rows = [row for to in sizes or (rig.sizes[0], SIZE) for row in _rows(rig, images, to, device, batch, repeats)]
    return facts(
        "speed",
        load_before,
        data=data,
        cameras=len(rig),
        batch=batch,
        device=torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        clock="CUDA events" if device.type == "cuda" else "CPU time of the process",
        rounds=repeats,
        rows=rows,
    )


COLUMNS = (
    ("ms", "{median_ms:.2f}"),
    ("quartiles", "{q1_ms:.2f} to {q3_ms:.2f}"),
    ("MB moved", "{megabytes:.1f}"),
    ("GB/s", "{gb_per_s:.1f}"),
    ("copy GB/s", "{copy_gb_per_s:.1f}"),
    ("share", "{share:.1%}"),
)


def device_table(report: Mapping[str, Any]) -> str:
    """The report to read, in Markdown."""
    rows = [
        row | {"name": "{1}x{0} {2}".format(*row["size"], row["dtype"]), "megabytes": row["bytes"] / 1e6}
        for row in report["rows"]
    ]
    title = f"{report['data']}, {report['cameras']} cameras turned by {YAW_DEG:g} degrees, batches of {report['batch']}"
    return f"{title} on {report['device']}; {machine_line(report)}\n\n{metric_table(rows, COLUMNS)}"


def bytes_moved(plan: RenderPlan, images: Sequence[torch.Tensor]) -> int:
    """The least number of bytes that rendering images (B, 3, H, W) moves."""
    read = sum(images[k].nbytes for k in {slot.source for slot in plan.layout.slots})
    maps = maps_on(plan, images[0].device)
    grids = sum(view.grid.nbytes + (0 if view.blend is None else view.blend.grid.nbytes) for view in maps)
    pixels = sum(view.source.numel() for view in maps)
    return read + grids + pixels * 3 * images[0].shape[0] * images[0].element_size()


def _rows(
    rig: Rig, images: Sequence[torch.Tensor], to: tuple[int, int], device: torch.device, batch: int, repeats: int
) -> list[dict[str, Any]]:
    rig = rig.resized(to)
    plan = build_plan(rig, rig.turned(yaw_deg=YAW_DEG))
    small = [resized(image, to) for image in images]
    runs: dict[str, Callable[[], Any]] = {}
    moved: dict[str, int] = {}
    for name, dtype in DTYPES.items():
        typed = [image if dtype == torch.uint8 else (image.float() / 255).to(dtype) for image in small]
        batches = [image.to(device).repeat(batch, 1, 1, 1) for image in typed]
        moved[name] = bytes_moved(plan, batches)
        runs[name] = _renders(plan, batches)
        # One copy for each number of bytes: it must not fit a cache that the frame does not fit.
        runs[f"{name} copy"] = _copies(moved[name] // 2, device)
    times = timed_rounds(runs, repeats, "{1}x{0}".format(*to), clock=clock_of(device))
    rows = []
    for name in DTYPES:
        rate, copied = (moved[name] / quartiles(times[run]).median_ms / 1e6 for run in (name, f"{name} copy"))
        rows.append(
            {"size": list(to), "dtype": name, **quartiles(times[name])._asdict(), "bytes": moved[name]}
            | {"gb_per_s": rate, "copy_gb_per_s": copied, "share": rate / copied}
        )
    return rows


def _renders(plan: RenderPlan, images: list[torch.Tensor]) -> Callable[[], Any]:
    def run() -> None:
        with torch.no_grad():
            render_torch(plan, images)

    return run


def _copies(half: int, device: torch.device) -> Callable[[], Any]:
    """A copy that reads ``half`` bytes and writes as many."""
    source, target = (torch.zeros(half, dtype=torch.uint8, device=device) for _ in range(2))
    return lambda: target.copy_(source)
