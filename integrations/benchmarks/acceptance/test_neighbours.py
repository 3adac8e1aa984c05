"""Another real frame of the drive as a source: what it adds is what it can see, and it is not visible that it does."""

from pathlib import Path

import numpy as np
import pytest

from arbiview_aug import Rig, RigRetarget
from arbiview_aug.datasets import FrameFolder
from integrations.benchmarks.acceptance.protocol import frame_folder
from integrations.benchmarks.speed import looking_down

pytestmark = pytest.mark.slow


def lowered(rig: Rig) -> Rig:
    """0.6 m higher, pitched down by 15 degrees, 100 degrees wide, at half the size."""
    h, w = rig.sizes[0]
    return looking_down(rig, (h // 2, w // 2))


def test_the_frame_ahead_adds_all_that_it_sees(ddad_root: Path) -> None:
    """3.15 points of the 3.19 that lie on the road before its cameras and are not its own car."""
    now = FrameFolder(ddad_root, load_points=False)[0]
    ahead = FrameFolder(frame_folder(ddad_root.parent, "ddad-next"), load_points=False)[0]
    target = lowered(now["rig"])
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
