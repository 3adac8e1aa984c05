"""``python -m integrations.benchmarks.lidar``: scans as another scanner would have measured them, against true ones.

Synthetic streets scanned by both scanners, which err as real ones do (``ErringDrive``), but for rays of B that would be
lost by chance; and DDAD's next scan, 1.26 m ahead, where ARBIVIEW_DATA names the real frames. Returns and ranges count
at rays within half a line spacing of which A measured something; ``recall of all`` counts at all rays. Baselines: A's
points as they are, and those of its rings that are next to one of B's (LiDAR-Distillation's way to fewer beams).
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from arbiview_aug import Lidar, Rig, RigRetarget, retarget_points
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cli.arguments import count, seed
from arbiview_aug.datasets import FrameFolder, Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.datasets.synthetic.dataset import NOISE_M, Rays, albedo, cast_rays
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER, IntArray, Scene
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.lidar import lidar_split
from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.inpaint.neighbours import Reach
from arbiview_aug.scene.point_cloud import own_car
from integrations.benchmarks.scans import chamfer_m, polar, scan_metrics
from integrations.benchmarks.study import run_study, stored, study_parser

COLUMNS = ("recall", "precision", "range_error_m", "chamfer_m", "recall of all")
HEIGHT_M, UP_M = 1.9, 0.7
_GRID_DEG = 0.05  # of directions near which something was measured

PULSE_M = 0.5
"""Surfaces of one beam within this distance return one echo from between them: pulses last 3 to 5 ns."""

DIVERGENCE_DEG, REACH_M = 0.17, 150.0
"""An HDL-32E's divergence, 3 mrad. Among rays between others that return from one surface, 95, 94 and 84 % return at 20
to 30, 30 to 50 and 50 to 100 m; in nuScenes' frame 92, 92 and 83 %."""


class ErringDrive(SyntheticDrive):
    """Streets whose scanners depart from exact rays.

    A beam returns from what its middle and four rays at its edge, ``divergence_deg`` apart, meet first, mixed over
    ``PULSE_M``. 63 % of the rays return from a white surface that faces the scanner at ``reach_m``, others with a
    probability of 1 - exp(-albedo cos(incidence) (reach_m / distance)²).
    """

    divergence_deg, reach_m, noise_m = DIVERGENCE_DEG, REACH_M, NOISE_M

    def _scan(
        self, scene: Scene, position: FloatArray, rays: Rays, range_m: tuple[float, float], seed: tuple[int, ...]
    ) -> FloatArray:
        R = scene.ego2street[:3, :3]
        origin = R @ position + scene.ego2street[:3, 3]
        beam = _beam(rays.astype(np.float64), math.radians(self.divergence_deg / 2))  # [columns, beams, S, 3]
        street = (beam @ R.T).astype(np.float32).reshape(len(rays), -1, 3)
        t, row = _echoes(*cast_rays(scene, origin, street), beam.shape[2])
        ego = beam[:, :, 0].reshape(-1, 3)
        rng = np.random.default_rng(np.random.SeedSequence(seed))
        noise_m, gain = rng.normal(0, self.noise_m, len(t)), rng.uniform(0.8, 1.2, len(t))
        keep = (t > range_m[0]) & (t < range_m[1])
        if self.reach_m < math.inf:
            drawn = rng.random(len(t))
            hits = origin + (ego[keep] @ R.T) * t[keep, None]
            signal = albedo(scene, row[keep]) * _incidence(scene, hits, ego[keep] @ R.T, row[keep])
            keep[keep] = drawn[keep] < 1 - np.exp(-signal * (self.reach_m / t[keep]) ** 2)
        points = position + ego[keep] * (t + noise_m)[keep, None]
        intensity = (albedo(scene, row[keep]) * gain[keep] * 90).clip(0, 255)
        return np.concatenate([points, intensity[:, None]], 1)


def _beam(rays: FloatArray, half_rad: float) -> FloatArray:
    """(columns, beams, 1 or 5, 3) rays of beams: the middle, and four at the edge."""
    if half_rad == 0:
        return rays[:, :, None]
    side = np.cross([0.0, 0.0, 1.0], rays)
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
    up = np.cross(rays, side)
    beam = np.stack([rays, *(rays + math.tan(half_rad) * edge for edge in (side, -side, up, -up))], 2)
    return np.asarray(beam / np.linalg.norm(beam, axis=-1, keepdims=True))


def _echoes(t: FloatArray, row: IntArray, rays: int) -> tuple[FloatArray, IntArray]:
    """Distances and rows (n,) of the first echoes of beams of ``rays`` rays (n * rays,)."""
    if rays == 1:
        return t, row
    t, row = t.reshape(-1, rays), row.reshape(-1, rays)
    finite = np.isfinite(t)
    # One surface has one echo, from its middle: at grazing incidence its part of the beam is longer than a pulse.
    same = row[:, :, None] == row[:, None]
    t = np.where(finite, (np.where(finite, t, 0)[:, None] * same).sum(2) / same.sum(2), np.inf)
    n, order = np.arange(len(t)), t.argmin(1)
    chosen = t[n, order]
    with np.errstate(invalid="ignore"):  # of the sky
        together = finite & (np.abs(t - chosen[:, None]) <= PULSE_M)
    mean = np.where(together, t, 0).sum(1) / np.maximum(together.sum(1), 1)
    return np.where(np.isfinite(chosen), mean, np.inf), row[n, order]


def _incidence(scene: Scene, points: FloatArray, rays: FloatArray, row: IntArray) -> FloatArray:
    """(n,) cosines between rays (n, 3) and the normals where they meet surfaces, at points (n, 3)."""
    normal = np.tile([0.0, 0.0, 1.0], (len(row), 1))  # the road's
    kind = np.where(row >= 0, scene.kind[row.clip(0)], -1)
    flat, curved = np.flatnonzero(kind == BOX), np.flatnonzero((kind >= 0) & (kind != BOX))
    planes = scene.planes[row[flat]]
    before = np.einsum("nfi,ni->nf", planes[..., :3], points[flat]) - planes[..., 3]
    normal[flat] = planes[np.arange(len(flat)), before.argmax(1), :3]
    k = row[curved]
    local = np.einsum("nji,nj->ni", scene.rotation[k], points[curved] - scene.center[k]) / scene.half[k]
    gradient, is_cap = local / scene.half[k], np.abs(local[:, 2]) > 1 - 1e-3
    is_cylinder = kind[curved] == CYLINDER
    gradient[is_cylinder, 2] = 0
    gradient[is_cylinder & is_cap] = 0, 0, 1
    gradient /= np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
    normal[curved] = np.einsum("nij,nj->ni", scene.rotation[k], gradient)
    return np.asarray(np.abs((normal * rays).sum(1)))


def scanner(beams: int, height_m: float) -> Lidar:
    """Evenly spaced beams on the roof: those of an HDL-32E and a VLP-16, and 64 that reach as far up."""
    pose = np.eye(4)
    pose[:3, 3] = 0.9, 0.0, height_m
    low, high, step = {16: (-15.0, 15.0, 0.2), 32: (-30.67, 10.67, 0.332), 64: (-24.8, 10.67, 0.17)}[beams]
    table = tuple(map(float, np.linspace(low, high, beams)))
    return Lidar(f"{beams} beams at {height_m} m", pose, table, step, (1.0, 90.0))


NEIGHBOURS: dict[str, Reach | None] = {"scanned": None, "with neighbours": "road"}
PAIRS = {
    f"{a} -> {b}{words}": (scanner(a, HEIGHT_M), scanner(b, HEIGHT_M + up_m))
    for words, up_m in (("", 0.0), (f", {UP_M} m higher", UP_M))
    for a, b in ((32, 64), (64, 32))
}


def main(argv: list[str] | None = None) -> int:
    """Print a table of both studies; the exit status."""
    return run_study(parser(), _run, argv)


def _run(arguments: argparse.Namespace) -> None:
    folder: Path | None = arguments.data
    following = stored("ddad-next") if folder is None else folder / "ddad-next"
    if folder and following and not following.is_dir():
        raise DataError(f"--data {folder}: expected a folder with ddad-one and ddad-next, found no ddad-next")
    found = (*synthetic(arguments.frames, arguments.seed), *(ddad(following.parent) if following else ()))
    rows = [[scene, name, *(f"{of[key]:.3f}" if key in of else "" for key in COLUMNS)] for scene, name, of in found]
    print(markdown_table(("scene", "points", *COLUMNS), rows, left=2))


def synthetic(frames: int, seed: int) -> Iterator[tuple[str, str, dict[str, float]]]:
    """Scene, name of the points, and their metrics, for each pair of scanners: means over streets."""
    for scene, (a, b) in PAIRS.items():
        rows: dict[str, list[dict[str, float]]] = {}
        rig = replace(demo_source_rig((8, 22)), lidars=[a])
        target, around = replace(rig, lidars=[b]), Neighbours(count=1)
        drive = ErringDrive(rig, num_frames=frames, seed=seed, neighbours=around)
        complete = ErringDrive(target, num_frames=frames, seed=seed)
        complete.reach_m = math.inf
        for k in range(frames):
            sample, truth = drive[k], complete.points(k).numpy()
            points = sample["points"].numpy()
            clouds = {"as they are": points, "rings dropped": rings_dropped(a, b, points)}
            for name, neighbours in NEIGHBOURS.items():
                retarget = RigRetarget(target, geometry="street", holes="black", neighbours=neighbours)
                clouds[name] = retarget(sample)["points"].numpy()
            where = measured_near(a, b, points)
            for name, cloud in clouds.items():
                of_all = {"recall of all": scan_metrics(b, cloud, truth)["recall"]}
                rows.setdefault(name, []).append(scan_metrics(b, cloud, truth, where) | of_all)
        for name, metrics in rows.items():
            yield scene, name, {key: float(np.mean([m[key] for m in metrics])) for key in COLUMNS}


def rings_dropped(a: Lidar, b: Lidar, points: FloatArray) -> FloatArray:
    """The points of those rings of ``a`` that are nearest to a ring of ``b``: LiDAR-Distillation's way to fewer beams.

    It shifts heights too, so that roads coincide: in the ego frame they do.
    """
    elevation, _, _ = polar(a, points)
    table = np.array(a.elevations_deg)
    kept = np.unique(np.abs(np.array(b.elevations_deg)[:, None] - table).argmin(1))
    return np.asarray(points[np.isin(np.abs(elevation[:, None] - table).argmin(1), kept)])


def measured_near(a: Lidar, b: Lidar, points: FloatArray) -> BoolArray:
    """(beams, columns) rays of ``b`` within half a line and a column spacing of which ``a`` measured a point."""
    half = np.diff(np.sort(a.elevations_deg)).mean() / 2, a.azimuth_step_deg / 2 + _GRID_DEG
    elevation, azimuth, _ = polar(b, points[np.isfinite(points[:, :3]).all(1)])
    row, column = np.rint((elevation + 90) / _GRID_DEG), np.rint(azimuth / _GRID_DEG)
    turn = round(360 / _GRID_DEG)
    grid = np.zeros((turn // 2 + 1, turn), np.uint8)
    grid[row.astype(int), column.astype(int) % turn] = 1
    up, aside = (round(angle / _GRID_DEG) for angle in half)
    around = np.pad(grid, ((0, 0), (aside, aside)), mode="wrap")
    near = cv2.dilate(around, np.ones((2 * up + 1, 2 * aside + 1), np.uint8))[:, aside : aside + turn]
    columns_deg = b.azimuth_deg[0] + b.azimuth_step_deg * np.arange(b.shape[1])
    rows = np.rint((np.array(b.elevations_deg) + 90) / _GRID_DEG).astype(int)
    return np.asarray(near[rows[:, None], np.rint(columns_deg / _GRID_DEG).astype(int) % turn] > 0)


def ddad(data: Path) -> Iterator[tuple[str, str, dict[str, float]]]:
    """DDAD's scan seen from the next frame's place, against the next frame's own scan.

    Its four solid-state sensors have no beam table, so a dense scanner on the roof stands for them: the return nearest
    to the direction of each true point within 0.2 degrees is compared. The mean error of range is that at rays that
    all clouds have. Static is a true point with one of A's within 2 m: the scans are a second apart. Every other degree
    of the next scan is the truth; the other half may serve as a neighbouring scan.
    """
    from sklearn.neighbors import KDTree

    one, two = FrameFolder(data / "ddad-one")[0], FrameFolder(data / "ddad-next")[0]
    rig: Rig = two["rig"]
    move = np.linalg.inv(two["ego2world"].numpy()) @ one["ego2world"].numpy()
    moved = one["points"].numpy().astype(np.float64)
    moved[:, :3] = moved[:, :3] @ move[:3, :3].T + move[:3, 3]
    truth = two["points"].numpy().astype(np.float64)
    fit, test = lidar_split(truth)
    half, truth = truth[fit], truth[test]
    centre = np.array([1.5, 0.0, rig.ground_z_m + 1.9])
    away = np.linalg.norm(truth[:, :3] - centre, axis=1)
    static = KDTree(moved[:, :3]).query(truth[:, :3])[0][:, 0] <= 2
    kept = static & ~own_car(truth) & (away > 2) & (away < 100)
    truth, away = truth[kept], away[kept]
    pose = np.eye(4)
    pose[:3, 3] = centre
    dense = Lidar("roof", pose, tuple(map(float, np.arange(-35.0, 15.0, 0.1))), 0.1, (1.0, 120.0))
    clouds = {"moved": moved[~own_car(moved)]}
    for name, sweeps in (("scanned", ()), ("with neighbours", [half])):
        target = replace(rig, lidars=[dense])
        clouds[name] = retarget_points(moved, target, ground_z_m=rig.ground_z_m, sweeps=sweeps).points
    rays, at_rays = (truth[:, :3] - centre) / away[:, None], {}
    for name, cloud in clouds.items():
        distance = np.linalg.norm(cloud[:, :3] - centre, axis=1)
        angle, nearest = KDTree((cloud[:, :3] - centre) / distance[:, None]).query(rays)
        at_rays[name] = angle[:, 0] <= np.radians(0.2), distance[nearest[:, 0]] - away, cloud[nearest[:, 0]]
    everywhere = np.all([near for near, *_ in at_rays.values()], axis=0)
    for name, (near, error, cloud) in at_rays.items():
        right = near & (np.abs(error) <= np.maximum(0.2, 0.02 * away))
        metrics = {"recall": right.mean(), "precision": right.sum() / near.sum()}
        metrics |= {"range_error_m": np.abs(error[everywhere]).mean(), "chamfer_m": chamfer_m(cloud[near], truth)}
        yield "DDAD's next scan", name, metrics


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    text = "Scans as another scanner would have measured them, against true ones."
    parser = study_parser("lidar", text, "--frames 4")
    parser.add_argument("--frames", type=count, default=12, metavar="N", help="streets (default: %(default)s)")
    parser.add_argument("--seed", type=seed, default=8000, help="seed of the streets (default: %(default)s)")
    text = "folder with ddad-one and ddad-next (default: ARBIVIEW_DATA, where it has them)"
    parser.add_argument("--data", type=Path, metavar="DIR", help=text)
    return parser


if __name__ == "__main__":
    sys.exit(main())
