"""Gain by measured points: on real frames against the protocol's ``ground`` renderer, and on synthetic streets.

Real frames: half resolution, exposures made even, quality ``fast``; the surface is made of the points of every other
degree of azimuth, the others score it. Synthetic streets: how far the outlines of vehicles are from the truth, and
what the scan lines of neighbouring frames are worth between the frame's own.
Run with ``-s`` for the tables.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import RenderedViews, SceneClass, SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.metrics import Image, as_arrays, as_tensors, psnr_db
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.rendered import render_labels, render_opencv
from arbiview_aug.transforms.rig_retarget import RigRetarget
from integrations.benchmarks.acceptance.protocol import FRAMES, ProtocolFrame, frame_folder
from tests.helpers import few_or_all

pytestmark = pytest.mark.timeout(1800)

MOVES = {"up 0.6 m": (0.0, (0.0, 0.0, 0.6)), "11° and moved": (11.0, (0.5, 0.3, 0.7)), "22°": (22.0, (0.0, 0.0, 0.0))}
GAINS_DB = {"nuscenes-one": (8.0, 9.0, 3.0), "ddad-one": (7.0, 7.0, 3.5)}
"""Over ``ground``, by move: what naive linear interpolation of inverse depth reaches."""

LARGEST_SHIFT_PX = 1.5
SWEPT_FRAMES = ((0, 0), (0, 1), (5, 0), (5, 1))  # seeds and scenes
OFF_LINES_PX = (3, 10)  # of the frame's own points
GAIN_DB = 1.5


@pytest.mark.parametrize("name", FRAMES)
def test_gain_over_ground(name: str, referee: ModuleType, data_root: Path) -> None:
    frame = ProtocolFrame(referee, frame_folder(data_root, name))
    fit, test = referee.lidar_split(frame.lidar)
    sample = {"images": as_tensors(frame.images), "points": torch.from_numpy(frame.lidar[fit])}

    def ours(targets: list[Any]) -> list[Image]:
        (target,) = frame.rigs([targets])
        retarget = RigRetarget(target, source=frame.rig, geometry="lidar", match_exposure=False, holes="black")
        return as_arrays(retarget(sample)["images"])

    reference = referee.reference_renderer(frame.cameras, "ground", ground_z=frame.ground_z_m)
    rows = []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of targets that are half outside
        for move, (yaw_deg, shift_m) in MOVES.items():
            targets = [referee.rotated_targets(frame.cameras, yaw_deg, shift_m)]
            psnr = [referee.score(r, frame.cameras, frame.lidar[test], targets)["psnr"] for r in (ours, reference)]
            rows.append((move, *psnr, psnr[0] - psnr[1]))
    print(f"\n{name}, PSNR in dB: lidar, ground, gain")
    print("\n".join(f"  {move:<16}{a:8.2f}{b:8.2f}{gain:+8.2f}" for move, a, b, gain in rows))
    for (move, *_, gain), least in zip(rows, GAINS_DB[name], strict=True):
        assert gain >= least, move


def vehicle_shifts(plan: RenderPlan, source: RenderedViews, truth: RenderedViews) -> Iterator[float]:
    """Pixels between top and bottom edges of vehicles in all views of a plan and the true ones, column by column.

    Where nothing covers the true edge it is a hole, not displaced; columns at the image's border are cut off.
    """
    views = render_labels(plan, list(source.instances), -2)
    for view, labels, classes in zip(views, truth.instances, truth.classes, strict=True):
        vehicles = np.unique(labels[classes == SceneClass.VEHICLE].numpy())
        for k in vehicles[vehicles >= 0]:
            mask, rendered = (labels == k).numpy(), (view == k).numpy()
            for x in np.flatnonzero(rendered.any(0) & mask.any(0)) if mask.sum() >= 200 else ():  # others: a few rows
                (ours,), (true,) = np.nonzero(rendered[:, x]), np.nonzero(mask[:, x])
                for edge in (0, -1):
                    if 0 < true[edge] < len(mask) - 1 and view[true[edge], x] != -2:
                        yield abs(int(ours[edge]) - int(true[edge]))


def off_lines(camera: Camera, points: np.ndarray) -> np.ndarray:
    """(h, w) pixels between the scan lines of points."""
    uv, z, valid = camera.project(points)
    x, y = np.rint(uv[valid & (z > 0)]).astype(int).T
    inside = (x >= 0) & (x < camera.width_px) & (y >= 0) & (y < camera.height_px)
    free = np.ones(camera.size, np.uint8)
    free[y[inside], x[inside]] = 0
    away_px = cv2.distanceTransform(free, cv2.DIST_L2, 5)
    return (away_px >= OFF_LINES_PX[0]) & (away_px <= OFF_LINES_PX[1])


@pytest.mark.parametrize("count", few_or_all(1, len(SWEPT_FRAMES), "frames"))
def test_other_frames_show_what_is_between_scan_lines(count: int) -> None:
    """32 lines from the roof, traffic, no labels."""
    rig, moves = demo_source_rig((256, 704)), {"0.6 m higher": {"z_m": 0.6}, "1 m aside": {"y_m": 1.0}}
    psnr: dict[tuple[str, str], list[float]] = {}
    shifts: dict[tuple[str, str], list[float]] = {}
    for seed, index in SWEPT_FRAMES[:count]:
        drive = SyntheticDrive(rig, num_frames=2, seed=seed, neighbours=Neighbours())
        sample, source = drive[index], drive.render(index)
        near = [{key: frame[key] for key in frame if key != "boxes_3d"} for frame in sample["neighbours"]]
        bare = [{key: frame[key] for key in frame if key != "points"} for frame in near]
        sample = {key: value for key, value in sample.items() if key not in ("boxes_3d", "box_classes")}
        points = sample["points"].numpy()[:, :3].astype(float)
        for move, by in moves.items():
            target = rig.shifted(**by)
            truth = drive.render(index, target)
            for name, neighbours in (("alone", bare), ("swept", near)):
                plan = RigRetarget(target).explain(sample | {"neighbours": neighbours}).plan
                shifts.setdefault((move, name), []).extend(vehicle_shifts(plan, source, truth))
                views = render_opencv(plan, list(sample["images"]))
                for view, true, z, covered, camera in zip(
                    views, truth.images, truth.depth_m.numpy(), plan.coverage, target, strict=True
                ):
                    use = covered & np.isfinite(z) & off_lines(camera, points)
                    error = (view.float() - true.float()).numpy()[:, use]
                    psnr.setdefault((move, name), []).append(psnr_db(float(np.mean(error**2))))
    for move, name in psnr:
        half, more, most = np.percentile(shifts[move, name], [50, 75, 90])
        words = f"{np.mean(psnr[move, name]):.1f} dB, 50/75/90 %: {half:.0f}/{more:.0f}/{most:.0f} px"
        print(f"\n{move:<14}{name:<8}{words}", end="")
    for move in moves:
        assert np.mean(psnr[move, "swept"]) >= np.mean(psnr[move, "alone"]) + GAIN_DB
        assert np.median(shifts[move, "swept"]) <= LARGEST_SHIFT_PX
