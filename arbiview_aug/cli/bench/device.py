"""``bench speed --device``: bandwidth of the torch execution, compared with a copy on the device.

A batch of frames is rendered for the same cameras turned by ``YAW_DEG``, from images on the device. *Bytes* are the
least that must move: each source image read once, each map position once per batch, each view once. *Share* is
bytes / time over the bandwidth of a copy of as many bytes, measured in the same rounds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.bench.study import SIZE, benchmark
from arbiview_aug.cli.bench.timing import clock_of, machine_line, quartiles, timed_rounds
from arbiview_aug.evaluate.report.tables import metric_table
from arbiview_aug.image_ops import resized
from arbiview_aug.render.plan import RenderPlan, build_plan
from arbiview_aug.render.torch_backend import maps_on, render_torch

YAW_DEG = 22.0
DTYPES = {"uint8": torch.uint8, "bf16": torch.bfloat16, "fp32": torch.float32}
BATCH = {"cuda": 8, "cpu": 1}


@benchmark
def measure_device(
    rig: Rig,
    images: Sequence[torch.Tensor],
    data: str,
    device: torch.device,
    repeats: int,
    *,
    sizes: Sequence[tuple[int, int]] | None = None,
) -> dict[str, Any]:
    """Time all types on images (3, h, w) uint8 of cameras without masks, by default at their size and at ``SIZE``."""
    batch, is_gpu = BATCH[device.type], device.type == "cuda"
    return {
        "data": data,
        "cameras": len(rig),
        "batch": batch,
        "device": torch.cuda.get_device_name(device) if is_gpu else device.type,
        "clock": "CUDA events" if is_gpu else "CPU time of the process",
        "rounds": repeats,
        "rows": [row for to in sizes or (rig.sizes[0], SIZE) for row in _rows(rig, images, to, device, batch, repeats)],
    }


COLUMNS = (
    ("ms", "{median_ms:.2f}"),
    ("quartiles", "{q1_ms:.2f} to {q3_ms:.2f}"),
    ("MB moved", "{megabytes:.1f}"),
    ("GB/s", "{gb_per_s:.1f}"),
    ("copy GB/s", "{copy_gb_per_s:.1f}"),
    ("share", "{share:.1%}"),
)


def device_table(report: Mapping[str, Any]) -> str:
    """Title and Markdown table of a report."""
    rows = [
        row | {"name": "{1}x{0} {2}".format(*row["size"], row["dtype"]), "megabytes": row["bytes"] / 1e6}
        for row in report["rows"]
    ]
    title = f"{report['data']}, {report['cameras']} cameras turned by {YAW_DEG:g} degrees, batches of {report['batch']}"
    return f"{title} on {report['device']}; {machine_line(report)}\n\n{metric_table(rows, COLUMNS)}"


def bytes_moved(plan: RenderPlan, images: Sequence[torch.Tensor]) -> int:
    """Least number of bytes that rendering images (B, 3, H, W) moves."""
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
    sizes: dict[str, int] = {}
    for name, dtype in DTYPES.items():
        typed = [image if dtype == torch.uint8 else (image.float() / 255).to(dtype) for image in small]
        batches = [image.to(device).repeat(batch, 1, 1, 1) for image in typed]
        sizes[name] = bytes_moved(plan, batches)
        runs[name] = torch.no_grad()(partial(render_torch, plan, batches))
        # Each copy reads and writes its own buffers: smaller ones could fit a cache.
        one, two = (torch.zeros(sizes[name] // 2, dtype=torch.uint8, device=device) for _ in range(2))
        runs[f"{name} copy"] = partial(one.copy_, two)
    times = timed_rounds(runs, repeats, "{1}x{0}".format(*to), clock=clock_of(device))
    rows = []
    for name in DTYPES:
        rate, copied = (sizes[name] / quartiles(times[run]).median_ms / 1e6 for run in (name, f"{name} copy"))
        rows.append(
            {"size": list(to), "dtype": name, **quartiles(times[name])._asdict(), "bytes": sizes[name]}
            | {"gb_per_s": rate, "copy_gb_per_s": copied, "share": rate / copied}
        )
    return rows
