"""Depth from motion against the truth of synthetic drives, and on a real pair of frames. Run with ``-s`` for numbers.

Four streets, 128 by 352 pixels, one frame 1.2 m before and one after; views from 0.6 m higher and 1 m aside.
"""

from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget
from arbiview_aug.datasets import FrameFolder, Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.metrics import psnr_db
from arbiview_aug.sample.inputs import MOTION_KEY
from arbiview_aug.temporal.motion_depth import MotionDepth
from integrations.benchmarks.acceptance.protocol import IN_BOTH, frame_folder, psnr_of
from tests.helpers import Standing
from tests.temporal.test_motion_depth import depth_of

RIG = demo_source_rig((128, 352))
STREETS = (0, 1, 2, 3)
MOVES = {"0.6 m higher": RIG.shifted(z_m=0.6), "1 m aside": RIG.shifted(y_m=1.0)}
OFF_MOTION_DEG, FAR_M = 6.0, 80.0


@cache
def drive(standing: bool) -> SyntheticDrive:
    kind = Standing if standing else SyntheticDrive
    return kind(RIG, num_frames=4, seed=9, lidar=False, neighbours=Neighbours())


def sample_of(index: int, standing: bool, labels: bool, turned_deg: float) -> dict[str, Any]:
    """A frame; with a pose error, every neighbour is turned by so much about an axis of its own."""
    sample = drive(standing)[index]
    rng, near = np.random.default_rng(index), []
    for entry in sample["neighbours"]:
        axis = rng.normal(size=3)
        pose = entry["ego2world"].numpy().copy()
        pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.radians(turned_deg) * axis / np.linalg.norm(axis))[0]
        near.append({**{k: entry[k] for k in entry if labels or k != "boxes_3d"}, "ego2world": torch.from_numpy(pose)})
    kept = {key: value for key, value in sample.items() if labels or key != "boxes_3d"}
    return {**kept, "neighbours": near}


def right(index: int, depth: MotionDepth) -> tuple[int, int, int]:
    """Pixels nearer than ``FAR_M`` and off the motion: all, with a depth, with one within a tenth of the truth."""
    pixels = kept = good = 0
    for camera, one, true in zip(RIG, depth.depth_m, drive(True).render(index).depth_m.numpy(), strict=True):
        rays, _ = camera.unproject(camera.pixel_grid())
        ask = (np.abs(rays[..., 0]) < np.cos(np.radians(OFF_MOTION_DEG))) & (true < FAR_M)
        pixels, kept = pixels + ask.sum(), kept + (ask & (one > 0)).sum()
        good += (ask & (one > 0) & (np.abs(one - true) <= 0.1 * true)).sum()
    return pixels, kept, good


def gain_db(index: int, move: str, sample: dict[str, Any], depth: MotionDepth) -> float:
    """PSNR over the static street's, where both cover."""
    outs = [
        RigRetarget(MOVES[move], geometry=surface, neighbours=None, holes="black")(
            sample | {MOTION_KEY: list(map(torch.from_numpy, depth.depth_m))}
        )
        for surface in ("motion", "street")
    ]
    (ours,), (street,) = psnr_of(outs, drive(True).render(index, MOVES[move]), [np.bool_(True)])
    return ours - street


@pytest.mark.timeout(1800)
@pytest.mark.filterwarnings("ignore:RigRetarget drops")
@pytest.mark.parametrize(
    ("standing", "labels", "turned_deg", "density", "share", "least_db"),
    [
        pytest.param(True, False, 0.0, 0.65, 0.9, 3.5, id="nothing else moves", marks=IN_BOTH),
        pytest.param(False, True, 0.0, 0.6, 0.9, 4.0, id="traffic, labelled", marks=pytest.mark.release),
        pytest.param(False, False, 0.0, 0.65, 0.9, 2.7, id="traffic, no labels", marks=pytest.mark.release),
        pytest.param(True, False, 0.2, 0.65, 0.9, 3.5, id="poses 0.2 degrees wrong", marks=pytest.mark.release),
    ],
)
def test_depth_is_right_and_renders_better_than_the_street(
    standing: bool, labels: bool, turned_deg: float, density: float, share: float, least_db: float
) -> None:
    """Less is asked with unlabelled traffic: some of it is put at wrong distances."""
    counts, gains = np.zeros(3), {move: [] for move in MOVES}
    for index in STREETS:
        sample = sample_of(index, standing, labels, turned_deg)
        depth = depth_of(sample, boxes=sample["boxes_3d"].numpy().astype(float) if labels else None)
        counts += right(index, depth)
        for move, rows in gains.items():
            rows.append(gain_db(index, move, sample, depth))
    mean = {move: float(np.mean(rows)) for move, rows in gains.items()}
    words = ", ".join(
        f"{move} {db:+.1f} dB ({min(gains[move]):+.1f} to {max(gains[move]):+.1f})" for move, db in mean.items()
    )
    print(f"\ndensity {counts[1] / counts[0]:.1%}, right {counts[2] / counts[1]:.1%}; over the street: {words}")
    assert counts[1] >= density * counts[0] and counts[2] >= share * counts[1]
    assert min(mean.values()) >= least_db
    assert min(min(rows) for rows in gains.values()) >= -0.1


@pytest.mark.slow
def test_the_next_frame_as_truth(ddad_root: Path) -> None:
    """DDAD's frame as its cameras see it 1.26 m on, by depth from the two: one side alone, the hard case.

    What is compared is one of the two images that the depth was found in, as the issue asks; LiDAR has no such help.
    """
    now, ahead = (FrameFolder(root)[0] for root in (ddad_root, frame_folder(ddad_root.parent, "ddad-next")))
    ego2ego = np.linalg.solve(now["ego2world"].numpy(), ahead["ego2world"].numpy())
    cameras = [camera.moved(ego2ego) for camera in ahead["rig"]]
    target = Rig(cameras, ground_z_m=now["rig"].ground_z_m).resized(0.5)
    outs = {}
    for surface in ("motion", "lidar", "fused", "street", "accurate"):
        options = {"geometry": "street", "quality": "accurate"} if surface == "accurate" else {"geometry": surface}
        outs[surface] = RigRetarget(target, neighbours=None, holes="black", **options)(now | {"neighbours": [ahead]})
    then = [
        cv2.resize(image.numpy().transpose(1, 2, 0), camera.size[::-1], interpolation=cv2.INTER_AREA).astype(float)
        for camera, image in zip(target, ahead["images"], strict=True)
    ]
    psnr, cover = {}, {surface: float(out["coverage"].float().mean()) for surface, out in outs.items()}
    for surface, out in outs.items():
        rows = []
        for k, (camera, true) in enumerate(zip(target, then, strict=True)):
            seen = torch.stack([other["coverage"][k] for other in outs.values()]).all(0).numpy()
            use = seen if camera.mask is None else seen & camera.mask
            error = out["images"][k].numpy().transpose(1, 2, 0)[use] - true[use]
            rows.append(psnr_db(float(np.mean(error**2))))
        psnr[surface] = float(np.mean(rows))
    print(f"\nthe next frame as truth, dB: {psnr}; covered: {cover}")
    assert psnr["motion"] >= psnr["street"] + 3.0 and psnr["accurate"] >= psnr["street"] + 0.3
    assert psnr["fused"] >= max(19.5, psnr["lidar"] + 1.0) and cover["fused"] >= 0.97 * cover["street"]
