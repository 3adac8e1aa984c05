"""Pixels that neighbouring frames fill, against the truth of synthetic drives: how right they are, and what moved.

Cameras 0.6 m higher (over the street alone: at their own height), pitched down by 15 degrees and 100 degrees wide, 128
by 352 pixels. Run with ``-s`` for the numbers.
"""

import functools
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest

from arbiview_aug import Camera, Rig, RigRetarget, SampleKeys
from arbiview_aug.datasets import FrameFolder, Neighbours
from arbiview_aug.datasets.synthetic import RenderedViews, SceneClass, SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.metrics import psnr_db
from arbiview_aug.inpaint.inpainter import telea
from integrations.benchmarks.acceptance.protocol import frame_folder
from integrations.benchmarks.speed import looking_down
from tests.helpers import Standing

pytestmark = pytest.mark.timeout(1800)

SIZE = (128, 352)
RIG = demo_source_rig(SIZE)
FRAMES = range(4)
NEAR_M = 15.0


class Street(NamedTuple):
    """One street: as recorded, as if the traffic stood still, and the true views for cameras raised by 0.6 m or not."""

    moving: dict[str, Any]
    standing: dict[str, Any]
    truth: dict[float, RenderedViews]


def lowered(up_m: float) -> Rig:
    return looking_down(RIG, SIZE).shifted(z_m=up_m - 0.6)


@functools.cache
def streets(count: int, step_m: float) -> list[Street]:
    wanted = Neighbours(count=count, step_m=step_m)
    moving, standing = (
        kind(RIG, num_frames=len(FRAMES), seed=5, lidar=kind is SyntheticDrive, neighbours=wanted)
        for kind in (SyntheticDrive, Standing)
    )
    return [
        Street(moving[k], standing[k], {up_m: moving.render(k, lowered(up_m)) for up_m in (0.0, 0.6)}) for k in FRAMES
    ]


def rendered(sample: dict[str, Any], target: Rig, *keys: str) -> dict[str, Any]:
    """The sample as the target sees it by these of its labels alone."""
    unwanted = {"points", "boxes_3d"} - set(keys)
    known = {k: v for k, v in sample.items() if k not in unwanted}
    known["neighbours"] = [{k: n[k] for k in n if k not in unwanted} for n in sample["neighbours"]]
    return RigRetarget(target, keys=SampleKeys(extra=("source_frame",)), holes="black")(known)


def db(squares: list[np.ndarray]) -> float:
    return psnr_db(float(np.concatenate(squares).mean()))


def near_road(camera: Camera) -> np.ndarray:
    rays, valid = camera.unproject(camera.pixel_grid())
    return valid & (np.hypot(rays[..., 0], rays[..., 1]) <= NEAR_M * -rays[..., 2] / camera.center_m[2])


@pytest.mark.parametrize(
    ("lidar", "count", "step_m"),
    [
        pytest.param(False, 1, 1.2, marks=pytest.mark.slow),
        pytest.param(True, 1, 1.2, marks=pytest.mark.slow),
        pytest.param(True, 4, 2.5, marks=pytest.mark.release),
    ],
)
def test_real_pixels_beat_invented_ones(lidar: bool, count: int, step_m: float) -> None:
    target = lowered(0.6)
    ours, theirs, road, walk = [], [], [], []
    missing = filled = 0
    for street in streets(count, step_m):
        out = rendered(street.moving, target, "boxes_3d", *(["points"] if lidar else []))
        truth = street.truth[0.6]
        for k, camera in enumerate(target):
            image, true = out["images"][k].numpy(), truth.images[k].numpy().astype(np.float32)
            there, classes = out["source_frame"][k].numpy() > 0, truth.classes[k].numpy()
            hole = out["source_frame"][k] != 0
            inpainted = telea(out["images"][k], hole).numpy()
            squares = ((image - true) ** 2).mean(0)
            ours.append(squares[there])
            theirs.append(((inpainted - true) ** 2).mean(0)[there])
            road.append(squares[there & (classes == SceneClass.GROUND)])
            walk.append(squares[there & (classes == SceneClass.SIDEWALK)])
            near = near_road(camera)
            missing, filled = missing + (hole.numpy() & near).sum(), filled + (there & near).sum()
    print(
        f"\n{'LiDAR' if lidar else 'boxes'}, {2 * count} frames: {filled / missing:.1%} of the near road, "
        f"{db(ours):.1f} dB (Telea {db(theirs):.1f}), road {db(road):.1f}, sidewalk {db(walk):.1f}"
    )
    assert db(road) > db(theirs) + 8
    if lidar:  # nothing else knows how high a sidewalk is
        assert db(ours) > db(theirs) + 8
    if count == 4:
        assert filled > 0.8 * missing


@pytest.mark.parametrize(
    ("count", "step_m"),
    [pytest.param(1, 1.2, marks=pytest.mark.slow), pytest.param(4, 2.5, marks=pytest.mark.release)],
)
@pytest.mark.parametrize(("labels", "most"), [(True, 0.001), (False, 0.005)])
def test_what_moved_leaves_nothing(labels: bool, most: float, count: int, step_m: float) -> None:
    """Pixels worse than 30 grey levels that are not so where the traffic stands still."""
    up_m = 0.6 if labels else 0.0
    target = lowered(up_m)
    near = np.stack([near_road(camera) for camera in target])
    ghosts = pixels = missing = filled = 0
    for street in streets(count, step_m):
        true = street.truth[up_m].images.numpy().astype(np.float32)
        bad = []
        for sample in (street.standing, street.moving):
            out = rendered(sample, target, *(["boxes_3d"] if labels else []))
            frame = out["source_frame"].numpy()
            bad.append((np.abs(out["images"].numpy() - true).mean(1) > 30) & (frame > 0))
        ghosts, pixels = ghosts + (bad[1] & ~bad[0]).sum(), pixels + frame.size
        missing, filled = missing + (near & (frame != 0)).sum(), filled + (near & (frame > 0)).sum()
    print(
        f"\n{2 * count} frames, {'with' if labels else 'without'} labels: ghosts on {ghosts / pixels:.3%}, "
        f"{filled / missing:.1%} of the near road filled"
    )
    assert ghosts <= most * pixels
    if count == 4:
        assert filled > (0.75 if labels else 0.4) * missing


@pytest.mark.slow
def test_the_frame_ahead_adds_all_that_it_sees(ddad_root: Path) -> None:
    """3.15 points of the 3.19 that lie on the road before its cameras and are not its own car."""
    now = FrameFolder(ddad_root, load_points=False)[0]
    ahead = FrameFolder(frame_folder(ddad_root.parent, "ddad-next"), load_points=False)[0]
    h, w = now["rig"].sizes[0]
    target = looking_down(now["rig"], (h // 2, w // 2))
    alone = RigRetarget(target, geometry="street", neighbours=None, holes="black")(now)
    filled = RigRetarget(target, geometry="street", holes="black")(now | {"neighbours": [ahead]})
    ego2ego = np.linalg.solve(now["ego2world"].numpy(), ahead["ego2world"].numpy())
    possible, gained = [], []
    for camera, before, after in zip(target, alone["coverage"], filled["coverage"], strict=True):
        hole = ~before.numpy()
        rays, _ = camera.unproject(camera.pixel_grid()[hole])
        distance_m = (target.ground_z_m - camera.center_m[2]) / rays[:, 2]
        points = camera.center_m + rays * distance_m[:, None]
        seen = np.zeros(len(points), bool)
        for source in ahead["rig"]:
            moved = source.moved(ego2ego)
            uv, _, valid = moved.project(points)
            x, y = np.rint(uv).clip(0, (source.width_px - 1, source.height_px - 1)).astype(int).T
            clean = np.ones(source.size, bool) if source.mask is None else source.mask
            seen |= valid & moved.contains(uv) & clean[y, x] & (distance_m > 0)
        possible.append(seen.sum() / hole.size)
        gained.append((after.numpy() & hole).sum() / hole.size)
    assert np.mean(possible) > 0.03
    assert np.mean(gained) > 0.97 * np.mean(possible)
