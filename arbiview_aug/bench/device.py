"""``python -m arbiview_aug bench device``: batches by torch, on a GPU where there is one.

Six nuScenes cameras turned by 22°, at 1600x900 and at 704x256 from images of half size. Images are float32 or
bfloat16, positions always float32. ``MB moved`` is the least that the work must move: every image read once, every
position read once (8 bytes a pixel), every view written once; ``of copying`` is how near moving that comes to the
bandwidth of a plain copy on the same device, measured in the same run. What is moved besides, the float32 atlas above
all, shows as distance from 100 %.

On a GPU the clock is the time on the wall between two synchronisations, else CPU time on one thread.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from tqdm import tqdm

from arbiview_aug.bench.timing import machine, machine_line, one_thread, quartiles, versions, write_json
from arbiview_aug.command_line import count
from arbiview_aug.evaluate.tables import markdown_table
from arbiview_aug.evaluate.targets import without_masks
from arbiview_aug.favs.synthesis import render_torch
from arbiview_aug.plan import RenderPlan, build_plan
from arbiview_aug.rig import load_rig

YAW_DEG = 22.0
BATCH = 8
SIZES = (((900, 1600), (900, 1600)), ((450, 800), (256, 704)))
"""(h, w) of sources and views."""
DTYPES = (torch.float32, torch.bfloat16)
REPEATS = 9
_COPIED_BYTES = 2**28  # large against every cache


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m arbiview_aug bench device",
        description="Milliseconds of batches by torch, and the share of the device's copy bandwidth.",
    )
    here = "cuda" if torch.cuda.is_available() else "cpu"
    parser.add_argument("--device", default=here, choices=sorted({here, "cpu"}), help="(default: %(default)s)")
    parser.add_argument("--batch", type=count, default=BATCH, metavar="N", help="frames (default: %(default)s)")
    parser.add_argument("--compile", action="store_true", help="also through torch.compile")
    parser.add_argument("--repeats", type=count, default=REPEATS, metavar="N", help="(default: %(default)s)")
    parser.add_argument("--output", default="output/device.json", metavar="FILE", help="(default: %(default)s)")
    arguments = parser.parse_args(argv)
    with one_thread():
        report = measure(arguments.device, arguments.batch, arguments.repeats, compiled=arguments.compile)
    write_json(report, Path(arguments.output))
    print(f"{table(report)}\n\nreport: {arguments.output}")
    return 0


def measure(
    device: str,
    batch: int,
    repeats: int,
    *,
    compiled: bool = False,
    sizes: Sequence[tuple[tuple[int, int], tuple[int, int]]] = SIZES,
) -> dict[str, Any]:
    """All figures, as plain data for JSON.

    Args:
        device: ``cpu`` or ``cuda``.
        batch: Frames rendered together.
        repeats: How often each is timed.
        compiled: Also through ``torch.compile``.
        sizes: (h, w) of sources and views.
    """
    load_before = os.getloadavg()
    on = torch.device(device)
    copy_gb_s = _copy_bandwidth(on, repeats)
    rows = []
    for source_size, size in sizes:
        source = without_masks(load_rig("nuscenes")).resized(source_size)
        plan = build_plan(source, source.turned(yaw_deg=YAW_DEG).resized(size))
        for dtype in tqdm(DTYPES, desc="{1}x{0}".format(*size), leave=False):
            generator = torch.Generator(on).manual_seed(0)
            shape = (batch, 3, *source_size)
            images = [torch.rand(shape, generator=generator, device=on).to(dtype) for _ in source]
            runs: dict[str, Callable[..., Any]] = {"": render_torch}
            if compiled:
                runs[", compiled"] = torch.compile(render_torch)
            for how, run in runs.items():
                times = _times_ms(lambda run=run, plan=plan, images=images: run(plan, images), on, repeats)  # type: ignore[misc]
                least = least_bytes(plan, batch, dtype.itemsize)
                found = quartiles(times)
                rows.append(
                    {
                        "name": f"{size[1]}x{size[0]}, {str(dtype).removeprefix('torch.')}{how}",
                        **found._asdict(),
                        "ms_a_frame": found.median_ms / batch,
                        "least_bytes": least,
                        "copy_share": least / (found.median_ms * 1e6) / copy_gb_s,
                    }
                )
    return {
        "benchmark": "device",
        "device": torch.cuda.get_device_name(on) if on.type == "cuda" else "cpu, one thread",
        "batch": batch,
        "copy_gb_s": copy_gb_s,
        "rows": rows,
        "machine": machine(load_before),
        "versions": versions(),
    }


def least_bytes(plan: RenderPlan, batch: int, itemsize: int) -> int:
    """Every image that is read, once; every position (two float32), once; every view, once."""
    read = {pair.source for target in plan.targets for pair in target.pairs}
    sources = sum(h * w for k, (h, w) in enumerate(plan.source.sizes) if k in read)
    views = sum(target.source_camera.size for target in plan.targets)
    return batch * 3 * itemsize * (sources + views) + 8 * views


def table(report: dict[str, Any]) -> str:
    """The report to read, in Markdown."""
    rows = [
        [
            row["name"],
            f"{row['median_ms']:.1f}",
            f"{row['q1_ms']:.1f} to {row['q3_ms']:.1f}",
            f"{row['ms_a_frame']:.2f}",
            f"{row['least_bytes'] / 1e6:.0f}",
            f"{row['copy_share']:.0%}",
        ]
        for row in report["rows"]
    ]
    head = ["", "ms a batch", "quartiles", "ms a frame", "MB moved", "of copying"]
    return (
        f"{report['device']}: batches of {report['batch']} frames of six cameras, images and views in its memory; a "
        f"plain copy moves {report['copy_gb_s']:.1f} GB/s. {machine_line(report)}\n\n{markdown_table(head, rows)}"
    )


def _copy_bandwidth(device: torch.device, repeats: int) -> float:
    """GB/s read and written together."""
    source = torch.zeros(_COPIED_BYTES // 4, device=device)
    into = torch.empty_like(source)
    times = _times_ms(lambda: into.copy_(source), device, repeats)
    return 2 * _COPIED_BYTES / (float(np.median(times)) * 1e6)


def _times_ms(run: Callable[[], Any], device: torch.device, repeats: int) -> np.ndarray:
    cuda = device.type == "cuda"
    clock = time.perf_counter if cuda else time.process_time
    times = []
    for k in range(repeats + 2):  # the first two warm up, and compile
        if cuda:
            torch.cuda.synchronize(device)
        start = clock()
        run()
        if cuda:
            torch.cuda.synchronize(device)
        if k >= 2:
            times.append(1e3 * (clock() - start))
    return np.array(times)
