"""``python -m integrations.benchmarks.hidden``: is hidden called covered? Ray by ray on streets whose truth is known.

A's views are rendered from higher and from aside, over LiDAR and boxes and over boxes alone. A ray is cast from each of
A's cameras to the true point of every pixel: what no camera sees is hidden. Beside it, the cars that B truly sees and
``visible_boxes`` drops.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from tqdm import tqdm

from arbiview_aug import RigRetarget, visible_boxes
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import add_output, count, seed, size, writable_folder
from arbiview_aug.cli.bench.timing import benchmark, machine_line, show
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.datasets.synthetic.dataset import GROUND_CLASSES
from arbiview_aug.datasets.synthetic.raycast import cast, find_candidates, scene_from
from arbiview_aug.datasets.synthetic.scene import BoxClass, Scene, SceneClass
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.report.tables import metric_table
from integrations.benchmarks.study import run_study, study_parser

Bools = npt.NDArray[np.bool_]
Floats = npt.NDArray[np.floating]

MOVES_M = {"+0.7 m": (0.0, 0.0, 0.7), "1 m aside": (0.0, 1.0, 0.0)}
SETTINGS = {"LiDAR + boxes": ("points", "boxes_3d"), "boxes alone": ("boxes_3d",)}
SURFACES = ("ground", "tops", "sides", "other")

TOP = 0.9
"""Upward part of a vehicle's normal, above which it is a top."""

SEEN_PX = 100
"""Pixels of one view from which B is said to see a car."""

_TOUCH_M, _TOUCH = 0.01, 1e-3  # by which a ray may end before its point: rounding
_FAR_M = 1e4  # of the sky
_TILE = 16


class Views(NamedTuple):
    """The truth of a target's views on one street; all (M, h, w).

    Attributes:
        images: (M, h, w, 3) uint8.
        surface: Index in ``SURFACES``, -1 for the sky.
        seen: Whether a source truly sees the pixel's point.
        instances: Row of ``boxes_3d``, -1 for none.
    """

    images: npt.NDArray[np.uint8]
    surface: npt.NDArray[np.int64]
    seen: Bools
    instances: npt.NDArray[np.int64]


def true_views(drive: SyntheticDrive, index: int, target: Rig) -> Views:
    """The truth of a target on street ``index``."""
    truth, scene = drive.render(index, target), drive.scene(index)
    depth, classes, instances = (np.stack([np.asarray(v) for v in part]) for part in truth[1:])
    points = np.stack([_points(*of_camera) for of_camera in zip(target, depth, strict=True)])
    seen = np.any([visible(scene, drive.rig, camera, points) for camera in drive.rig], axis=0)
    surface = np.full(depth.shape, SURFACES.index("other"))
    surface[np.isin(classes, GROUND_CLASSES)] = SURFACES.index("ground")
    vehicle = classes == SceneClass.VEHICLE
    top = vehicle & (np.stack([_upward(p) for p in points]) > TOP)
    surface[vehicle], surface[top] = SURFACES.index("sides"), SURFACES.index("tops")
    surface[~np.isfinite(depth)] = -1
    images = np.stack([np.asarray(v) for v in truth.images]).transpose(0, 2, 3, 1)
    return Views(images, surface, seen, instances.astype(int))


def visible(scene: Scene, rig: Rig, source: Camera, points: Floats) -> Bools:
    """Whether a source sees points (M, h, w, 3): by a ray to each.

    Only rays within the image are cast.
    """
    uv, _, valid = source.project(points)
    inside = valid & source.contains(uv, 1e-6)
    if source.mask is not None:
        x, y = np.where(inside[..., None], uv, 0).round().astype(int).clip(0, np.array(source.size[::-1]) - 1).T
        inside &= source.mask[y.T, x.T]
    seen = np.zeros(inside.size, bool)
    flat = np.flatnonzero(_tiled(inside))
    if not len(flat):
        return seen.reshape(inside.shape)
    # Pixels of a tile share a packet, filled up with its last ray.
    flat = flat[np.argsort(flat // _TILE**2, kind="stable")]
    offset = _tiled(points)[flat] - source.center_m
    distance = np.linalg.norm(offset, axis=-1)
    starts = np.flatnonzero(np.diff(flat // _TILE**2, prepend=-1))
    ends = np.append(starts[1:], len(flat))
    rank = np.arange(len(flat)) - np.repeat(starts, ends - starts)
    packet = np.repeat(np.arange(len(starts)), ends - starts)
    rows = np.minimum(starts[:, None] + np.arange(_TILE**2), ends[:, None] - 1)
    R, origin = scene.ego2street[:3, :3], source.center_m - (0, 0, rig.ground_z_m)
    rays = ((offset / distance[:, None]) @ R.T)[rows].transpose(0, 2, 1)
    start = R @ origin + scene.ego2street[:3, 3]
    local, packets = scene_from(scene, start), torch.from_numpy(np.ascontiguousarray(rays, np.float32))
    t, _ = cast(local, torch.from_numpy(start[None].astype(np.float32)), packets, find_candidates(local, packets))
    seen[flat] = t.numpy()[packet, rank] >= distance * (1 - _TOUCH) - _TOUCH_M
    return _untiled(seen, inside.shape)


def _tiled(a: Any) -> Any:
    """(M, h, w, ...) to (pixels, ...), tile by tile; sizes are multiples of a tile."""
    m, h, w, *rest = a.shape
    a = a.reshape(m, h // _TILE, _TILE, w // _TILE, _TILE, *rest).swapaxes(2, 3)
    return a.reshape(m * h * w, *rest)


def _untiled(a: Any, shape: tuple[int, ...]) -> Any:
    m, h, w = shape
    return a.reshape(m, h // _TILE, w // _TILE, _TILE, _TILE).swapaxes(2, 3).reshape(shape)


def _points(camera: Camera, depth_m: Floats) -> Floats:
    """Points (h, w, 3) of a depth map, ego frame; the sky is far away."""
    rays = camera.unproject_cam(camera.pixel_grid()).directions
    distance = np.where(np.isfinite(depth_m), depth_m, _FAR_M)[..., None].astype(float)
    return np.asarray((rays / rays[..., 2:] * distance) @ camera.cam2ego[:3, :3].T + camera.center_m)


def _upward(points: Floats) -> Floats:
    """Upward part (h, w) of the normals of points (h, w, 3), from the nearer neighbour in each direction."""

    def step(axis: int) -> Floats:
        width = [(int(k == axis), int(k == axis)) for k in range(3)]
        both = np.diff(np.pad(points, width, mode="edge"), axis=axis)
        n = points.shape[axis]
        one, two = both.take(range(n), axis), both.take(range(1, n + 1), axis)
        lengths = [np.linalg.norm(part, axis=-1, keepdims=True) for part in (one, two)]
        lengths = [np.where(length == 0, np.inf, length) for length in lengths]
        return np.where(lengths[0] <= lengths[1], one, two)

    normal = np.cross(step(1), step(0))
    return np.abs(normal[..., 2]) / np.maximum(np.linalg.norm(normal, axis=-1), 1e-12)


def tally(views: Views, out: dict[str, Any]) -> npt.NDArray[np.float64]:
    """(surfaces, seen or hidden, covered or hole, 2): pixels, and sums of their errors in levels."""
    covered = np.asarray(out["coverage"])
    image = np.asarray(out["images"]).transpose(0, 2, 3, 1)
    error = np.abs(image.astype(np.float32) - views.images).mean(axis=-1)
    valid = views.surface >= 0
    place = (2 * views.surface + ~views.seen) * 2 + ~covered
    bins = [np.bincount(place[valid], weight, 4 * len(SURFACES)) for weight in (None, error[valid])]
    return np.stack(bins, axis=-1).reshape(len(SURFACES), 2, 2, 2)


def cars(views: Views, out: dict[str, Any], box_classes: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Cars that B sees, those that ``visible_boxes`` drops, and the same of those that A sees too; others it keeps.

    B sees a car if one of its views shows ``SEEN_PX`` pixels of it, and A if it sees as many of the same view.
    """
    is_car, kept = box_classes == BoxClass.CAR, visible_boxes(out)

    def pixels(mask: Bools) -> npt.NDArray[np.int64]:
        of_views = zip(views.instances, mask, strict=True)
        return np.max([np.bincount(one[valid] + 1, minlength=len(kept) + 1)[1:] for one, valid in of_views], axis=0)

    of_b, of_both = pixels(np.ones_like(views.seen)), pixels(views.seen)
    seen, shown = (is_car & (count >= SEEN_PX) for count in (of_b, of_both))
    sets = seen, seen & ~kept, shown, shown & ~kept, is_car & kept & (of_b == 0)
    return np.array([np.count_nonzero(one) for one in sets])


def check_tiled(image_size: tuple[int, int]) -> None:
    """DataError for sides that are no multiples of a tile."""
    if any(side % _TILE for side in image_size):
        raise DataError(f"--size: expected multiples of {_TILE}, got {image_size[0]}x{image_size[1]}")


# --- the command ------------------------------------------------------------------------------------------------------
def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON; the exit status."""
    return run_study(parser(), _run, argv)


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    text = "Whether hidden pixels are called covered, on synthetic streets whose truth is known."
    parser = study_parser("hidden", text, "--streets 12")
    parser.add_argument("--size", type=size, default=(256, 704), metavar="HxW", help="of every view, multiples of 16")
    parser.add_argument("--streets", type=count, default=12, metavar="N")
    parser.add_argument("--seed", type=seed, default=900, metavar="N", help="of the streets; develop on others")
    parser.add_argument("--targets", nargs="+", choices=MOVES_M, default=list(MOVES_M))
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    add_output(parser)
    return parser


def _run(arguments: argparse.Namespace) -> None:
    check_tiled(arguments.size)
    folder = writable_folder(Path(arguments.output), arguments.output)
    report = measure(arguments)
    show(table(report), report, folder / "hidden.json")


@benchmark
def measure(arguments: argparse.Namespace) -> dict[str, Any]:
    """All rows."""
    source = demo_source_rig(arguments.size)
    street = {"num_frames": arguments.streets, "seed": arguments.seed}
    drive = SyntheticDrive(source, **street)
    targets = {name: source.shifted(*MOVES_M[name]) for name in arguments.targets}
    totals: dict[str, list[Any]] = {}
    for index in tqdm(range(len(drive)), leave=False):
        sample = drive[index]
        for name, target in targets.items():
            views = true_views(drive, index, target)
            for setting in arguments.settings:
                given = {key: value for key, value in sample.items() if key in ("images", "rig", *SETTINGS[setting])}
                out = RigRetarget(target, neighbours=None)(given)
                total = totals.setdefault(f"{name}, {setting}", [0, 0])
                total[0] += tally(views, out)
                total[1] += cars(views, out, sample["box_classes"].numpy())
    rows = {name: _row(*total) for name, total in totals.items()}
    return {**street, "size": list(arguments.size), "rows": rows}


def _row(total: npt.NDArray[np.float64], counts: npt.NDArray[np.int64]) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for surface, of_surface in zip(SURFACES, total, strict=True):
        pixels, errors = np.moveaxis(of_surface, -1, 0)
        error = errors / np.maximum(pixels, 1)
        row[surface] = {
            "hidden_covered": pixels[1, 0] / pixels.sum(),
            "seen_hole": pixels[0, 1] / pixels.sum(),
            "hidden": pixels[1].sum() / pixels.sum(),
            "error_seen": error[0, 0],
            "error_hidden_covered": error[1, 0],
            "error_hole": errors[:, 1].sum() / max(pixels[:, 1].sum(), 1),
            "error": errors.sum() / pixels.sum(),
        }
    names = "cars", "dropped", "cars_of_both", "dropped_of_both", "kept_unseen"
    return row | dict(zip(names, counts.tolist(), strict=True))


_COLUMNS = (
    ("truly hidden", "{hidden:.2%}"),
    ("hidden called covered", "{hidden_covered:.2%}"),
    ("seen called hidden", "{seen_hole:.2%}"),
    ("error: seen", "{error_seen:.1f}"),
    ("hidden and covered", "{error_hidden_covered:.1f}"),
    ("holes", "{error_hole:.1f}"),
    ("all", "{error:.1f}"),
)


def table(report: dict[str, Any]) -> str:
    """The rows as Markdown."""
    rows = [{"name": name, "surface": s, **row[s]} for name, row in report["rows"].items() for s in SURFACES]
    lines = []
    for name, row in report["rows"].items():
        of_both = f"{row['dropped_of_both']} of {row['cars_of_both']} cars that A and B see"
        of_b = f"{row['dropped']} of {row['cars']} that B sees"
        kept = f"{row['kept_unseen']} of which B sees nothing"
        lines.append(f"{name}: `visible_boxes` drops {of_both}, {of_b}; it keeps {kept}")
    return "\n\n".join([machine_line(report), metric_table(rows, _COLUMNS, ("name", "surface")), "\n".join(lines)])


if __name__ == "__main__":
    sys.exit(main())
