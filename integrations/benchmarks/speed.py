"""``python -m integrations.benchmarks.speed``: whole ``RigRetarget`` calls relative to bare ``cv2.remap`` calls.

The floor of a target rig is one linear ``cv2.remap`` for each view, from interleaved uint8 RGB images into preallocated
outputs, with float32 maps that read a source of the view's own size at

    x' = 0.97 x + 0.02 y + 3        y' = 0.95 y + 0.01 x + 5

A time is the median over the rounds; a ratio is the median of call / floor within a round.

The targets are Waymo's five cameras without and with their lenses, four fisheye cameras, and the source's own, turned,
or raised and pitched down, all without scanners. *Motion estimate*: nuScenes' six cameras in a synthetic drive. *Depth
maps* from motion and from a network cost the same; these say at every pixel the depth of the nearest LiDAR point.
*Fused* is LiDAR with two maps. *Held*: the calibration comes back, and with it the plan; every other call makes a plan.
Images are decoded at half size where they are then still larger than the views. They lie channels-last in one block, as
this package's readers give them; contiguous ones are planes, torch's usual layout. Holes stay black and exposures as
recorded, unless the settings are the *default* ones. *Moment*: a frame of PandaSet with LiDAR and its labelled boxes,
where ``ARBIVIEW_DATA`` holds that, else this frame with 95. *Points by rays*: ``retarget_points`` alone. With
``--device`` the floor is a copy there of as many bytes as rendering must move; the clock of a GPU is its events.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import cache, partial
from itertools import cycle, islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from scipy.ndimage import distance_transform_edt

from arbiview_aug import PlanCache
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import Pinhole, intrinsics_for_fov
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.choices import GeometryName, Reduce
from arbiview_aug.cli.arguments import count, output_file, size
from arbiview_aug.cli.parsers import FULL_SIZE, SIZE, add_options
from arbiview_aug.datasets import FrameFolder, Neighbours, open_data
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.errors import DataError, WarnOnce
from arbiview_aug.evaluate.frames import without_masks
from arbiview_aug.evaluate.report.tables import cell, markdown_table
from arbiview_aug.image_ops import resized
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.torch_backend import maps_on, render_torch
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.sample.inputs import LEARNED_KEY, MOTION_KEY, read_frames
from arbiview_aug.scene.depth_map import motion_camera
from arbiview_aug.scene.surface import Layer
from arbiview_aug.temporal.learned_depth import measured_pixels
from arbiview_aug.temporal.motion_depth import estimate_motion
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.scans import retarget_points
from arbiview_aug.transforms.warm_up import compile_kernels
from integrations.benchmarks.study import (
    benchmark,
    machine_line,
    process_ms,
    quartiles,
    recorded,
    run_study,
    show,
    stored,
    study_parser,
    timed_rounds,
)

BOXES = (10, 30, 75, 150)
SCANNED = 120_000
"""Points of the scans that other scanners measure."""
BOUNDS: Mapping[tuple[int, int], Mapping[str, float]] = {
    SIZE: {
        **{"street, held": 1.2, "street": 3.5, "LiDAR": 8.0, "LiDAR, 75 boxes": 11.0},
        **{"street, held, default": 1.15, "75 boxes, default": 6.5, "LiDAR, 75 boxes, default": 10.5},
        "moment, default": 15.0,
        **{f"{n} boxes": 5.0 for n in BOXES},
        **{f"street, held, {fit} from full size, contiguous": 2.0 for fit in ("squashed", "cropped")},
        **{f"{known}, two neighbours": 20.0 for known in ("street", "75 boxes")},
    },
    FULL_SIZE: {"street": 2.5, "LiDAR": 3.5, "LiDAR, 75 boxes": 4.0, **{f"{n} boxes": 3.0 for n in BOXES}},
}
"""Largest ratios of calls by the size of the views, from nuScenes' images."""

DEFAULT = "nuscenes-one"
_FLOOR = "bare cv2.remap"
_PLAIN: dict[str, Any] = {"holes": "black", "match_exposure": False}
_DEFAULT: dict[str, Any] = {"holes": "continue", "match_exposure": True}
_ENOUGH_MS = 1500.0
_TRAVEL_M, _MOST_NEIGHBOURS = 1.2, 8  # between neighbouring frames, and their number
_DTYPES = {"uint8": torch.uint8, "bf16": torch.bfloat16, "fp32": torch.float32}
_BATCH = {"cuda": 8, "cpu": 1}  # frames
YAW_DEG = 22.0
_STEP_M, _STEPS = 1e-4, 200

Sample = Mapping[str, Any]
Calls = dict[str, Callable[[], Any]]  # the first is the floor


def _run(arguments: argparse.Namespace) -> None:
    """Measure, print the table, write the JSON."""
    path = output_file(arguments.output)
    device = None if arguments.device is None else device_named(arguments.device)
    with recorded(arguments.data or stored(DEFAULT), FULL_SIZE) as data:
        report = measure(*data, arguments.repeats, arguments.size, arguments.only, device)
    show(table(report), report, path)


def device_named(name: str) -> torch.device:
    """Torch device of this name; DataError for one that is not there."""
    with suppress(RuntimeError):
        device = torch.device(name)
        if device.type == "cpu" or (device.type == "cuda" and (device.index or 0) < torch.cuda.device_count()):
            return device
    raise DataError(f"--device: expected cpu or a CUDA device that is there, for example cuda:1, got {name!r}")


@benchmark
def measure(
    name: str,
    data: Path,
    repeats: int,
    sizes: Sequence[tuple[int, int]],
    only: str = "",
    device: torch.device | None = None,
) -> dict[str, Any]:
    """Time the calls on the first frame whose names contain ``only``, for views of each size (h, w).

    With a device, times batches that torch renders there instead (``_batches``).
    """
    full, half = _sample(data, 1), _sample(data, 2)
    start = time.process_time()
    compile_kernels()
    ready_s = time.process_time() - start
    rows = []
    for h, w in sizes:
        targets = _calls_of(full, half, (h, w)) if device is None else _batches(full, (h, w), device)
        for target, calls in targets:
            floor, *others = calls
            chosen = {call: calls[call] for call in (floor, *(call for call in others if only in call))}
            if len(chosen) == 1:
                continue
            times = timed_rounds(chosen, repeats, f"{h}x{w} {target}", enough_ms=_ENOUGH_MS, clock=clock_of(device))
            for call, taken in times.items():
                ratio = statistics.median(a / b for a, b in zip(taken, times[floor], strict=False))
                row = {"size": [h, w], "target": target, "name": call, **quartiles(taken), "ratio": ratio}
                rows.append(row | {"bound": BOUNDS.get((h, w), {}).get(call)})
    if not rows:
        raise DataError(f"--only {only}: expected part of a call's name, for example boxes or neighbour")
    return {"data": name, "rounds": repeats, "ready_s": ready_s, "measures": rows}


def clock_of(device: torch.device | None) -> Callable[[Callable[[], Any]], float]:
    """Clock of a device: CUDA events on a GPU, else the process's CPU time."""
    if device is None or device.type != "cuda":
        return process_ms

    def clock(run: Callable[[], Any]) -> float:
        start, end = (torch.cuda.Event(enable_timing=True) for _ in range(2))
        torch.cuda.synchronize(device)
        stream = torch.cuda.current_stream(device)
        start.record(stream)
        run()
        end.record(stream)
        end.synchronize()
        return start.elapsed_time(end)

    return clock


def _calls_of(full: Sample, half: Sample, size: tuple[int, int]) -> Iterator[tuple[str, Calls]]:
    """Yield targets at (h, w), each with its floor and its calls."""
    waymo, fisheye = (_cameras_of(name).resized(size) for name in ("waymo", "fisheye_surround"))
    is_small = all(2 * side <= of_camera for side, of_camera in zip(size, full["rig"].sizes[0], strict=True))
    sample = half if is_small else full
    for name, rig in {"pinhole": waymo.undistorted(), "radtan": waymo, "fisheye": fisheye}.items():
        images = islice(cycle(sample["images"]), len(rig))  # a remap for each view, also of fewer cameras
        calls = {_FLOOR: remap_floor(images, size)} | _calls(sample, rig)
        if is_small and name == "radtan":
            cropped = _cameras_of("waymo").resized(size, "crop")
            calls |= _both_layouts("street, held, squashed from full size", full, waymo)
            calls |= _both_layouts("street, held, cropped from full size", full, cropped)
        yield name, calls
    if is_small:
        moment, floor = _moment() or {**sample, "boxes_3d": boxes_around(95)}, remap_floor(sample["images"][:5], size)
        yield "moment", {_FLOOR: floor, "moment, default": _anew(moment, waymo.undistorted(), "lidar", **_DEFAULT)}
        yield "own", {_FLOOR: remap_floor(sample["images"], size)} | _own(sample, size) | _scans(sample)
    if size == FULL_SIZE:
        yield "own", {_FLOOR: remap_floor(sample["images"], size)} | _motion()


def _moment() -> Sample | None:
    """A frame of PandaSet below ``ARBIVIEW_DATA``, read at half size, if there."""
    folder = stored("pandaset")
    return folder and FrameFolder(folder, reduce=2)[3]


def remap_floor(images: Iterable[torch.Tensor], size: tuple[int, int]) -> Callable[[], None]:
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


def _cameras_of(name: str) -> Rig:
    """A shipped rig without masks, and without scanners: scans have calls of their own."""
    return replace(without_masks(load_rig(name)), lidars=())


def table(report: Mapping[str, Any]) -> str:
    """Machine, and a Markdown table for each size of views: milliseconds, and in parentheses the ratio to the floor."""
    parts = [f"{report['data']}; {machine_line(report)}; kernels ready after {report['ready_s']:.1f} s"]
    for h, w in dict.fromkeys(tuple(m["size"]) for m in report["measures"]):
        measures = [m for m in report["measures"] if m["size"] == [h, w]]
        targets, names = (list(dict.fromkeys(m[key] for m in measures)) for key in ("target", "name"))
        cells = {(m["name"], m["target"]): f"{m['median_ms']:.1f} ({m['ratio']:.2f})" for m in measures}
        bounds = {m["name"]: cell(m, "{bound:g}") for m in measures}
        rows = [[name, bounds[name], *(cells.get((name, target), "") for target in targets)] for name in names]
        parts.append(markdown_table([f"{h}x{w}", "bound", *targets], rows))
    return "\n\n".join(parts)


# --- calls ------------------------------------------------------------------------------------------------------------
def _calls(sample: Sample, target: Rig) -> Calls:
    return {
        **_both_layouts("street, held", sample, target),
        "street, held, default": _held(sample, target, **_DEFAULT),
        "street": _anew(sample, target, "street"),
        **{f"{n} boxes": _anew({**sample, "boxes_3d": boxes_around(n)}, target, "boxes") for n in BOXES},
        "LiDAR": _anew(sample, target, "lidar"),
        "LiDAR, 75 boxes": _anew({**sample, "boxes_3d": boxes_around(75)}, target, "lidar"),
        "75 boxes, default": _anew({**sample, "boxes_3d": boxes_around(75)}, target, "boxes", **_DEFAULT),
        "LiDAR, 75 boxes, default": _anew({**sample, "boxes_3d": boxes_around(75)}, target, "lidar", **_DEFAULT),
        "depth maps": _anew(sample, target, "learned"),
        "fused, 75 boxes": _anew({**sample, "boxes_3d": boxes_around(75)}, target, "fused"),
    }


def _scans(sample: Sample) -> Calls:
    """A dense scan by Waymo's scanner, without images."""
    rig, waymo = sample["rig"], load_rig("waymo").lidars
    target = replace(rig, lidars=waymo)

    @cache
    def points() -> torch.Tensor:
        beams = tuple(np.linspace(-30, 15, 256).tolist())
        dense = retarget_points(sample["points"], replace(rig, lidars=[replace(waymo[0], elevations_deg=beams)])).points
        return dense[torch.linspace(0, len(dense) - 1, SCANNED).long()]

    name = f"{SCANNED:,} points by 64 x 2,650 rays"
    return {
        name: lambda: retarget_points(points(), target),
        f"{name}, 75 boxes": lambda: retarget_points(points(), target, boxes_3d=boxes_around(75)),
    }


def _motion() -> Calls:
    """Depth from motion, from one frame of a synthetic drive before and one after."""

    @cache
    def read() -> tuple[Any, ...]:  # drawing takes 8 s
        drive = SyntheticDrive(load_rig("nuscenes"), num_frames=3, neighbours=Neighbours(count=1, step_m=_TRAVEL_M))
        return read_frames(drive[1], None, further=("neighbours",))[0], None, WarnOnce()

    return {"motion estimate": lambda: estimate_motion(*read())}


def _own(sample: Sample, views: tuple[int, int]) -> Calls:
    """Turned cameras, which have holes, and raised ones that look down, which neighbouring frames fill."""
    rig, boxes = sample["rig"], {"boxes_3d": boxes_around(75)}
    turned, low = rig.turned(yaw_deg=YAW_DEG).resized(views), looking_down(rig, views)
    poses = torch.eye(4, dtype=torch.float64).repeat(1 + _MOST_NEIGHBOURS, 1, 1)
    poses[1:, 0, 3] = torch.tensor([_TRAVEL_M * (1 + k // 2) * (-1) ** k for k in range(_MOST_NEIGHBOURS)])
    frame, *others = ({**sample, "ego2world": pose} for pose in poses)
    with_boxes = frame | boxes | {"neighbours": [other | boxes for other in others[:2]]}
    return {
        "street, held, turned": _held(sample, turned),
        "street, held, turned, default": _held(sample, turned, **_DEFAULT),
        "street, no neighbours": _anew(frame, low, "street"),
        "street, one neighbour": _anew(frame | {"neighbours": others[:1]}, low, "street"),
        "street, two neighbours": _anew(frame | {"neighbours": others[:2]}, low, "street"),
        "street, eight neighbours": _anew(frame | {"neighbours": others}, low, "street"),
        "75 boxes, two neighbours": _anew(with_boxes, low, "boxes"),
    }


def looking_down(rig: Rig, size: tuple[int, int]) -> Rig:
    """Raise a rig by 0.6 m, pitch it down by 15 degrees and widen it to 100: it sees road that no camera sees."""
    (h, w), K = size, intrinsics_for_fov("looking down", 100.0, size, Pinhole())
    poses = {c.name: c.turned(pitch_deg=-15.0).shifted(z_m=0.6).cam2ego for c in rig}
    cameras = [Camera(name=name, width_px=w, height_px=h, K=K, cam2ego=pose) for name, pose in poses.items()]
    return Rig(cameras, ground_z_m=rig.ground_z_m, name="looking down")


def _batches(sample: Sample, size: tuple[int, int], device: torch.device) -> Iterator[tuple[str, Calls]]:
    """Yield batches of images on a device by type, for turned cameras at (h, w); the floor copies as many bytes there.

    The bytes are the least that must move: each source image and each map position read once, each view written once.
    """
    rig, batch = sample["rig"].resized(size), _BATCH[device.type]
    plan = build_plan(rig, rig.turned(yaw_deg=YAW_DEG))
    small = [resized(image, size) for image in sample["images"]]
    for name, dtype in _DTYPES.items():
        typed = [image if dtype == torch.uint8 else (image.float() / 255).to(dtype) for image in small]
        batches = [image.to(device).repeat(batch, 1, 1, 1) for image in typed]
        # Each copy reads and writes its own buffers: smaller ones could fit a cache.
        one, two = (torch.zeros(bytes_moved(plan, batches) // 2, dtype=torch.uint8, device=device) for _ in range(2))
        render = torch.no_grad()(partial(render_torch, plan, batches))
        yield f"{name} on {device}", {"copy": partial(one.copy_, two), f"batch of {batch} by torch": render}


def bytes_moved(plan: RenderPlan, images: Sequence[torch.Tensor]) -> int:
    """Least number of bytes that rendering images (B, 3, H, W) moves."""
    read = sum(images[k].nbytes for k in {slot.source for slot in plan.layout.slots})
    maps = maps_on(plan, images[0].device)
    grids = sum(view.grid.nbytes + view.seam_grid.nbytes for view in maps)
    pixels = sum(view.source.numel() for view in maps)
    return read + grids + pixels * 3 * images[0].shape[0] * images[0].element_size()


def _both_layouts(name: str, sample: Sample, target: Rig) -> Calls:
    contiguous = {**sample, "images": sample["images"].contiguous()}
    return {name: _held(sample, target), f"{name}, contiguous": _held(contiguous, target)}


def _held(sample: Sample, target: Rig, **settings: Any) -> Callable[[], Any]:
    return partial(RigRetarget(target, geometry="street", **_PLAIN | settings), sample)


def _anew(sample: Sample, target: Rig, surface: GeometryName, **settings: Any) -> Callable[[], Any]:
    """Call with the rig, over the street, always a little elsewhere; plans over a frame's geometry never come back."""
    retarget = RigRetarget(target, geometry=surface, cache=PlanCache(max_bytes=0), **_PLAIN | settings)
    rigs = cycle([sample["rig"].shifted(x_m=k * _STEP_M) for k in range(_STEPS if surface == "street" else 1)])
    return lambda: retarget({**sample, "rig": next(rigs)})


def boxes_around(number: int) -> torch.Tensor:
    """(number, 7) random boxes from pedestrians to vans, 5 to 70 m from the vehicle, in all directions."""
    rng = np.random.default_rng(0)
    away_m, azimuth = rng.uniform(5, 70, number), rng.uniform(-np.pi, np.pi, number)
    lwh = [rng.uniform(low, high, number) for low, high in ((0.6, 6), (0.6, 2.2), (1.4, 2.5))]
    x, y, yaw = away_m * np.cos(azimuth), away_m * np.sin(azimuth), rng.uniform(-np.pi, np.pi, number)
    return torch.from_numpy(np.stack([x, y, lwh[2] / 2, *lwh, yaw], 1).astype(np.float32))


def _sample(data: Path, reduce: Reduce) -> dict[str, Any]:
    """Images (N, 3, h, w) of the first frame, its rig without masks, its points, and depth maps made of them."""
    sample = open_data(data, reduce=reduce)[0]
    if not isinstance(sample["images"], torch.Tensor) or "points" not in sample:
        raise DataError(f"--data {data}: expected images of one size, and LiDAR points")
    kept = {"images": sample["images"], "rig": without_masks(sample["rig"]), "points": sample["points"]}
    return kept | dict.fromkeys((MOTION_KEY, LEARNED_KEY), torch.from_numpy(np.stack(lidar_maps(kept))))


def lidar_maps(sample: Mapping[str, Any]) -> list[Layer]:
    """Depth maps of the size that the ``depth`` command writes: at every pixel the depth of the nearest LiDAR point."""
    points, maps = sample["points"][:, :3].numpy().astype(float), []
    for camera in map(motion_camera, sample["rig"]):
        known, (pixels, depth_m) = np.zeros(camera.size, np.float32), measured_pixels(camera, points)
        known[pixels] = depth_m
        nearest = distance_transform_edt(known == 0, return_distances=False, return_indices=True)
        maps.append(known[tuple(nearest)])
    return maps


def parser() -> argparse.ArgumentParser:
    """Create the parser."""
    made = study_parser(
        "speed",
        "Milliseconds of RigRetarget on one thread, and ratios to bare cv2.remap calls of the same views.",
        "--device cuda",
    )
    add_options(made, "--data", without="nuscenes-one below ARBIVIEW_DATA where that is, else a synthetic street")
    add = partial(add_options, made)
    add("--size", type=size, nargs="+", default=[SIZE, FULL_SIZE], metavar="HxW", help="of views (default: both)")
    add("--repeats", type=count, default=5, metavar="N", help="rounds of timing")
    add("--only", metavar="TEXT", default="", help="calls whose names contain it")
    device = "instead: batches that torch renders on cpu, cuda, cuda:1, ..., as ratios to a copy of the same bytes"
    add("--device", metavar="NAME", help=device)
    add("--output", default="output/speed.json", metavar="FILE", help="file to write to")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Measure and print."""
    return run_study(parser(), _run, argv)


if __name__ == "__main__":
    raise SystemExit(main())
