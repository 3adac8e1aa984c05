"""``python -m arbiview_aug bench device``: how near the torch execution comes to moving its bytes once.

A batch of frames of the data's cameras, brought to a size, is rendered for the same cameras turned by ``YAW_DEG`` at
that size, from images that lie on the device already: uint8, bfloat16 and float32, always with float32 grids.

*Bytes* are the least that must move: each source image that is read, once; each map position, once for the whole batch;
each view, once; all in their own types. *Share* is bytes / time, over the bandwidth of a copy within the device of as
many bytes, measured in the same rounds (a copy moves its bytes twice: read and written). A share of 1 is the limit.

Times are CUDA events', or on the CPU the process's CPU time on one thread; a call warms up before each.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import add_data, count, device_named, size
from arbiview_aug.cli.bench.data import recorded
from arbiview_aug.cli.bench.timing import clock_of, machine, machine_line, quartiles, show, timed_rounds
from arbiview_aug.environment import one_thread, versions
from arbiview_aug.evaluate.targets import without_masks
from arbiview_aug.image_ops import resized
from arbiview_aug.render.plan import RenderPlan, build_plan
from arbiview_aug.render.torch_backend import maps_on, render_torch

YAW_DEG = 22.0
SIZES = ((900, 1600), (256, 704))
DTYPES = {"uint8": torch.uint8, "bf16": torch.bfloat16, "fp32": torch.float32}
BATCH = {"cuda": 8, "cpu": 1}
REPEATS = 15


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m arbiview_aug bench device",
        description="Rendering by torch on a device: milliseconds, bytes moved, and their share of copy bandwidth.",
    )
    add_data(parser, "a synthetic street")
    parser.add_argument(
        "--device", default=None, metavar="NAME", help="cpu, cuda, cuda:1, ... (default: cuda where there is one)"
    )
    parser.add_argument("--batch", type=count, metavar="N", help="frames at once (default: 8; on the cpu 1)")
    parser.add_argument("--sizes", type=size, nargs="+", default=list(SIZES), metavar="HxW", help="of images and views")
    parser.add_argument(
        "--compile",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="measure torch.compile beside it (default: not on the cpu)",
    )
    parser.add_argument("--repeats", type=count, default=REPEATS, metavar="N", help="rounds (default: %(default)s)")
    parser.add_argument("--output", default="output/device.json", metavar="FILE", help="(default: %(default)s)")
    arguments = parser.parse_args(argv)
    device = device_named(arguments.device)
    with one_thread(), recorded(arguments.data) as data:
        report = measure(
            data.sample(0),
            data.name,
            device=device,
            batch=arguments.batch or BATCH.get(device.type, 1),
            sizes=arguments.sizes,
            compiled=device.type != "cpu" if arguments.compile is None else arguments.compile,
            repeats=arguments.repeats,
        )
    show(table(report), report, Path(arguments.output))
    return 0


def measure(
    sample: Mapping[str, Any],
    name: str,
    *,
    device: torch.device,
    batch: int,
    sizes: Sequence[tuple[int, int]] = SIZES,
    compiled: bool = False,
    repeats: int = REPEATS,
) -> dict[str, Any]:
    """All sizes and types, as plain data for JSON.

    Args:
        sample: A frame, as a reader gives it.
        name: Of the data.
        device: Where to render.
        batch: Frames at once.
        sizes: (h, w) of images and views.
        compiled: Measure ``torch.compile`` too.
        repeats: Rounds.
    """
    load_before = os.getloadavg()
    rows = [row for to in sizes for row in _of_size(sample, to, device, batch, compiled, repeats)]
    return {
        "benchmark": "device",
        "data": name,
        "cameras": len(sample["rig"]),
        "batch": batch,
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else device.type,
        "clock": "CUDA events" if device.type == "cuda" else "CPU time of the process",
        "rounds": repeats,
        "machine": machine(load_before),
        "versions": versions(),
        "rows": rows,
    }


def table(report: Mapping[str, Any]) -> str:
    """The report to read."""
    lines = [
        machine_line(report),
        f"{report['data']}, {report['cameras']} cameras turned by {YAW_DEG:g} degrees, batches of {report['batch']} on "
        f"{report['device']}",
        f"{'':<28}{'ms':>9}{'quartiles':>18}{'MB moved':>10}{'GB/s':>8}{'copy GB/s':>11}{'share':>8}",
    ]
    for row in report["rows"]:
        spread = f"{row['q1_ms']:.2f} .. {row['q3_ms']:.2f}"
        h, w = row["size"]
        label = f"{w}x{h} {row['dtype']}{', compiled' if row['compiled'] else ''}"
        lines.append(
            f"{label:<28}{row['median_ms']:>9.2f}{spread:>18}{row['bytes'] / 1e6:>10.1f}"
            f"{row['gb_per_s']:>8.1f}{row['copy_gb_per_s']:>11.1f}{row['share']:>8.1%}"
        )
    return "\n".join(lines)


def bytes_moved(plan: RenderPlan, images: Sequence[torch.Tensor]) -> int:
    """The least that rendering images (B, 3, H, W) moves: see the module."""
    read = sum(images[k].nbytes for k in {slot.source for slot in plan.layout.slots})
    maps = maps_on(plan, images[0].device)
    grids = sum(view.grid.nbytes + (0 if view.blend is None else view.blend.grid.nbytes) for view in maps)
    pixels = sum(view.source.numel() for view in maps)
    return read + grids + pixels * 3 * images[0].shape[0] * images[0].element_size()


def _of_size(
    sample: Mapping[str, Any], to: tuple[int, int], device: torch.device, batch: int, compiled: bool, repeats: int
) -> list[dict[str, Any]]:
    rig: Rig = without_masks(sample["rig"]).resized(to)
    plan = build_plan(rig, rig.turned(yaw_deg=YAW_DEG))
    runs: dict[tuple[str, bool], Callable[[], Any]] = {}
    moved: dict[str, int] = {}
    for name, dtype in DTYPES.items():
        images = [_of_type(resized(image, to), dtype).to(device).repeat(batch, 1, 1, 1) for image in sample["images"]]
        moved[name] = bytes_moved(plan, images)
        for by_compiler in (False, True)[: 1 + compiled]:
            runs[name, by_compiler] = _renders(plan, images, by_compiler)
    # One copy for each number of bytes: it must not fit a cache that the frame does not fit.
    copies = {name: _copies(count_of // 2, device) for name, count_of in moved.items()}
    label = "{1}x{0}".format(*to)
    clock = clock_of(device)
    named = {f"{name} {flag}": run for (name, flag), run in runs.items()} | {
        f"{k} copy": run for k, run in copies.items()
    }
    times = timed_rounds(named, repeats, label, clock=clock)
    rows = []
    for name, flag in runs:
        found = quartiles(times[f"{name} {flag}"])
        rate, copied = (moved[name] / quartiles(times[f"{name} {of}"]).median_ms / 1e6 for of in (flag, "copy"))
        rows.append(
            {"size": list(to), "dtype": name, "compiled": flag, **found._asdict(), "bytes": moved[name]}
            | {"gb_per_s": rate, "copy_gb_per_s": copied, "share": rate / copied}
        )
    return rows


def _of_type(image: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    return image if dtype == torch.uint8 else (image.float() / 255).to(dtype)


def _renders(plan: RenderPlan, images: list[torch.Tensor], compiled: bool) -> Callable[[], Any]:
    def render(images: list[torch.Tensor]) -> list[torch.Tensor]:
        return render_torch(plan, images)

    chosen: Callable[[list[torch.Tensor]], Any] = torch.compile(render, dynamic=False) if compiled else render

    def run() -> None:
        with torch.no_grad():
            chosen(images)

    return run


def _copies(half: int, device: torch.device) -> Callable[[], Any]:
    """A copy that reads ``half`` bytes and writes as many."""
    source, target = (torch.zeros(half, dtype=torch.uint8, device=device) for _ in range(2))
    return lambda: target.copy_(source)
