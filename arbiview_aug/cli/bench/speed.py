"""``python -m arbiview_aug bench speed``: whole ``RigRetarget`` calls relative to bare ``cv2.remap`` calls.

The floor of a target rig is one linear ``cv2.remap`` for each view, from interleaved uint8 RGB images into preallocated
outputs, with float32 maps that read a source of the view's own size at

    x' = 0.97 x + 0.02 y + 3        y' = 0.95 y + 0.01 x + 5

A time is the median over the rounds; a ratio is the median of call / floor within a round.

The targets are Waymo's five cameras without and with their lenses, four fisheye cameras, and the source's own, turned
or lowered. *Depth maps* from motion and from a network cost the same; these say at every pixel the depth of the nearest
LiDAR point. *Fused* is LiDAR with two maps. *Held*: the calibration comes back, and with it the plan; every other call
plans anew. Images are decoded at half size where they are then still larger than the views. They lie channels-last in
one block, as this package's readers give them; contiguous ones are planes, torch's usual layout. Holes stay black
unless they are *filled*.
"""

from __future__ import annotations

import os
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import count, cycle
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import Holes, Reduce, SurfaceName
from arbiview_aug.cli.arguments import add_data, device_named, size
from arbiview_aug.cli.bench.data import Recorded, lidar_maps, lifted, recorded
from arbiview_aug.cli.bench.device import YAW_DEG, device_table, measure_device
from arbiview_aug.cli.bench.neighbours import lowered
from arbiview_aug.cli.bench.study import SIZE, benchmark, benchmark_parser
from arbiview_aug.cli.bench.timing import machine_line, quartiles, show, timed_rounds
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.report.tables import cell, markdown_table
from arbiview_aug.evaluate.targets import without_masks
from arbiview_aug.render.harmonise import Harmonise
from arbiview_aug.render.plan import compile_kernels
from arbiview_aug.sample.inputs import LEARNED_KEY, MOTION_KEY
from arbiview_aug.transforms.rig_retarget import RigRetarget

FULL_SIZE = (900, 1600)
BOXES = (10, 30, 75, 150)
BOUNDS: Mapping[tuple[int, int], Mapping[str, float]] = {
    SIZE: {
        **{"street, held": 1.2, "street": 3.5, "LiDAR": 8.0, "LiDAR, 75 boxes": 11.0},
        **{f"{n} boxes": 5.0 for n in BOXES},
        **{f"street, held, {fit} from full size, contiguous": 2.0 for fit in ("squashed", "cropped")},
        **{f"{known}, two neighbours": 20.0 for known in ("street", "75 boxes")},
    },
    FULL_SIZE: {"street": 2.5, "LiDAR": 3.5, "LiDAR, 75 boxes": 4.0, **{f"{n} boxes": 3.0 for n in BOXES}},
}
"""Largest ratios of calls by the size of the views, from nuScenes' images."""

_FLOOR = "bare cv2.remap"
_ENOUGH_MS = 1500.0
_TRAVEL_M = 1.2  # between neighbouring frames
_STEP_M, _STEPS = 1e-4, 200

Sample = Mapping[str, Any]
Calls = dict[str, Callable[[], Any]]


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = benchmark_parser(
        "speed",
        "Milliseconds of RigRetarget on one thread, and ratios to bare cv2.remap calls of the same views.",
        repeats=5,
        output="output/speed.json",
        example="--device cuda",
    )
    add_data(parser, "nuscenes-one below ARBIVIEW_DATA where that is, else a synthetic street")
    sizes = [SIZE, FULL_SIZE]
    parser.add_argument("--size", type=size, nargs="+", default=sizes, metavar="HxW", help="of views (default: both)")
    parser.add_argument(
        "--device",
        metavar="NAME",
        help="render batches by torch on cpu, cuda, cuda:1, ...: milliseconds, and the share of copy bandwidth",
    )
    arguments = parser.parse_args(argv)
    with recorded(arguments.data or default_data(), size=FULL_SIZE) as data:
        if arguments.device is None:
            report = measure(data, arguments.repeats, arguments.size)
            text = table(report)
        else:
            device, sample = device_named(arguments.device), _sample(data, 1)
            report = measure_device(sample["rig"], list(sample["images"]), data.name, device, arguments.repeats)
            text = device_table(report)
    show(text, report, Path(arguments.output))
    return 0


def default_data() -> Path | None:
    """nuScenes keyframe below ``ARBIVIEW_DATA``, if there."""
    root = os.environ.get("ARBIVIEW_DATA")
    folder = Path(root) / "nuscenes-one" if root else None
    return folder if folder is not None and folder.is_dir() else None


@benchmark
def measure(data: Recorded, repeats: int, sizes: Sequence[tuple[int, int]]) -> dict[str, Any]:
    """Time the calls on the first frame, for views of each size (h, w)."""
    start = time.process_time()
    compile_kernels()
    ready_s = time.process_time() - start
    waymo, fisheye = without_masks(load_rig("waymo")), without_masks(load_rig("fisheye_surround"))
    targets = {"pinhole": waymo.undistorted(), "radtan": waymo, "fisheye": fisheye}
    full, half = _sample(data, 1), _sample(data, 2)
    rows = []
    for h, w in sizes:
        is_small = 2 * h <= full["rig"][0].height_px and 2 * w <= full["rig"][0].width_px
        sample = half if is_small else full
        calls = {name: (len(rig), _calls(sample, rig.resized((h, w)))) for name, rig in targets.items()}
        if is_small:
            for name, to in (("squashed", waymo.resized((h, w))), ("cropped", waymo.resized((h, w), "crop"))):
                calls["radtan"][1].update(_both_layouts(f"street, held, {name} from full size", full, to))
            calls["own"] = len(full["rig"]), _own(sample, (h, w))
        for name, (views, runs) in calls.items():
            runs = {_FLOOR: remap_floor(sample["images"][:views], (h, w)), **runs}
            times = timed_rounds(runs, repeats, f"{w}x{h} {name}", enough_ms=_ENOUGH_MS)
            for call, taken in times.items():
                ratio = statistics.median(a / b for a, b in zip(taken, times[_FLOOR], strict=False))
                row = {"size": [h, w], "target": name, "name": call, **quartiles(taken)._asdict()}
                rows.append(row | {"ratio": ratio, "bound": BOUNDS.get((h, w), {}).get(call)})
    return {"data": data.name, "rounds": repeats, "ready_s": ready_s, "measures": rows}


def table(report: Mapping[str, Any]) -> str:
    """Machine, and a Markdown table for each size of views: milliseconds, and in parentheses the ratio to the floor."""
    parts = [f"{report['data']}; {machine_line(report)}; kernels ready after {report['ready_s']:.1f} s"]
    for h, w in dict.fromkeys(tuple(m["size"]) for m in report["measures"]):
        measures = [m for m in report["measures"] if m["size"] == [h, w]]
        targets, names = (list(dict.fromkeys(m[key] for m in measures)) for key in ("target", "name"))
        cells = {(m["name"], m["target"]): f"{m['median_ms']:.1f} ({m['ratio']:.2f})" for m in measures}
        bounds = {m["name"]: cell(m, "{bound:g}") for m in measures}
        rows = [[name, bounds[name], *(cells.get((name, target), "") for target in targets)] for name in names]
        parts.append(markdown_table([f"{w}x{h}", "bound", *targets], rows))
    return "\n\n".join(parts)


# --- calls ------------------------------------------------------------------------------------------------------------
def _calls(sample: Sample, target: Rig) -> Calls:
    return {
        **_both_layouts("street, held", sample, target),
        "street, held, filled": _held(sample, target, holes="fill"),
        "street": _anew(sample, target, "street"),
        **{f"{n} boxes": _anew({**sample, "boxes_3d": boxes_around(n)}, target, "objects") for n in BOXES},
        "LiDAR": _anew(sample, target, "lidar"),
        "LiDAR, 75 boxes": _anew({**sample, "boxes_3d": boxes_around(75)}, target, "lidar"),
        "depth maps": _anew(sample, target, "learned"),
        "fused, 75 boxes": _anew({**sample, "boxes_3d": boxes_around(75)}, target, "fused"),
    }


def _own(sample: Sample, views: tuple[int, int]) -> Calls:
    """Turned cameras, which have holes, and lowered ones, which neighbouring frames fill."""
    rig = sample["rig"]
    turned, low = rig.turned(yaw_deg=YAW_DEG).resized(views), lowered(rig, views)
    poses = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)
    poses[1:, 0, 3] = torch.tensor([-_TRAVEL_M, _TRAVEL_M])
    frame, *neighbours = ({**sample, "ego2world": pose} for pose in poses)
    boxes = {"boxes_3d": boxes_around(75)}
    with_boxes = frame | boxes | {"neighbours": [neighbour | boxes for neighbour in neighbours]}
    return {
        "street, held, turned": _held(sample, turned),
        "street, held, turned, filled": _held(sample, turned, holes="fill"),
        "street, held, turned, harmonised": _held(sample, turned, harmonise=True),
        "street, two neighbours": _anew(frame | {"neighbours": neighbours}, low, "street"),
        "75 boxes, two neighbours": _anew(with_boxes, low, "objects"),
    }


def _both_layouts(name: str, sample: Sample, target: Rig) -> Calls:
    contiguous = {**sample, "images": sample["images"].contiguous()}
    return {name: _held(sample, target), f"{name}, contiguous": _held(contiguous, target)}


def _held(sample: Sample, target: Rig, holes: Holes = "black", harmonise: Harmonise = False) -> Callable[[], Any]:
    return partial(RigRetarget(target, surface="street", holes=holes, harmonise=harmonise), sample)


def _anew(sample: Sample, target: Rig, surface: SurfaceName) -> Callable[[], Any]:
    """Call with the geometry, over the street the rig, always a little elsewhere, so that no plan comes back."""
    retarget = RigRetarget(target, surface=surface, harmonise=False, holes="black", cache_bytes=0)
    ways_m = count(_STEP_M, _STEP_M)
    rigs = cycle([sample["rig"].shifted(x_m=k * _STEP_M) for k in range(_STEPS if surface == "street" else 1)])
    return lambda: retarget(lifted({**sample, "rig": next(rigs)}, next(ways_m)))


def boxes_around(number: int) -> torch.Tensor:
    """(number, 7) random boxes from pedestrians to vans, 5 to 70 m from the vehicle, in all directions."""
    rng = np.random.default_rng(0)
    away_m, azimuth = rng.uniform(5, 70, number), rng.uniform(-np.pi, np.pi, number)
    lwh = [rng.uniform(low, high, number) for low, high in ((0.6, 6), (0.6, 2.2), (1.4, 2.5))]
    x, y, yaw = away_m * np.cos(azimuth), away_m * np.sin(azimuth), rng.uniform(-np.pi, np.pi, number)
    return torch.from_numpy(np.stack([x, y, lwh[2] / 2, *lwh, yaw], 1).astype(np.float32))


def remap_floor(images: torch.Tensor, size: tuple[int, int]) -> Callable[[], None]:
    """Bare remaps to views of ``size`` (h, w), one for each of the images (N, 3, >=h, >=w) uint8."""
    h, w = size
    sources = [np.ascontiguousarray(image.permute(1, 2, 0).numpy()[:h, :w]) for image in images]
    y, x = np.indices((h, w), dtype=np.float32)
    map_x, map_y = 0.97 * x + 0.02 * y + 3, 0.95 * y + 0.01 * x + 5
    outputs = np.empty((len(sources), h, w, 3), np.uint8)

    def run() -> None:
        for source, output in zip(sources, outputs, strict=True):
            cv2.remap(source, map_x, map_y, cv2.INTER_LINEAR, dst=output)

    return run


def _sample(data: Recorded, reduce: Reduce) -> dict[str, Any]:
    """Images (N, 3, h, w) of the first frame, its rig without masks, its points, and depth maps made of them."""
    sample = data.sample(0, reduce)
    if not isinstance(sample["images"], torch.Tensor) or "points" not in sample:
        raise DataError(f"--data {data.root}: expected images of one size, and LiDAR points")
    found = {"images": sample["images"], "rig": without_masks(sample["rig"]), "points": sample["points"]}
    return found | dict.fromkeys((MOTION_KEY, LEARNED_KEY), torch.from_numpy(np.stack(lidar_maps(found))))
