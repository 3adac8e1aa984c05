"""3D boxes in images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from arbiview_aug import Camera, Rig, RigRetarget, SampleError, load_rig, project_boxes_3d
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.scene.boxes import draw_boxes
from tests.helpers import camera

# 90 degrees over 801 px: focal length 400 px, principal point (400, 200), looking along the ego's x axis.
FRONT = camera(size=(401, 801), position_m=(0, 0, 1.0), horizontal_fov_deg=90)


def box(x: float, y: float = 0.0, z: float = 1.0, yaw: float = 0.0, size=(2.0, 2.0, 2.0)) -> list[float]:
    return [x, y, z, *size, yaw]


LENS = {"lens": "fisheye", "distortion": (-0.01, -0.005, 0.001, 0.0), "horizontal_fov_deg": 185}
FISHEYE = camera("fisheye", 10, size=(400, 500), elevation_deg=-20, position_m=(0, 0, 1.0), **LENS)


def test_a_cube_by_hand() -> None:
    (seen,) = project_boxes_3d([box(11.0)], Rig([FRONT]))
    assert seen.rows.tolist() == [0] and seen.truncation[0] == pytest.approx(0) and seen.visibility[0] == 1
    # A thin plate across, its middle on the ray to the leftmost pixel's centre (u = 0, y = 400 / f per metre).
    (cut,) = project_boxes_3d([box(10.0, y=10 * 400 / FRONT.K[0, 0], size=(1e-6, 2.0, 2.0))], Rig([FRONT]))
    assert cut.boxes[0, 0] == 0 and cut.truncation[0] == pytest.approx(0.5, abs=1e-6)
    (none,) = project_boxes_3d(torch.zeros(0, 7), Rig([FRONT]))
    assert none.boxes.shape == (0, 4) and none.rows.shape == none.visibility.shape == (0,)


def test_what_stands_before_hides() -> None:
    """A cube twice as far has a quarter of the pixels; one half covers the other's right half."""
    rig = Rig([FRONT])
    (seen,) = project_boxes_3d([box(21.0), box(11.0)], rig)
    assert seen.visibility.tolist() == [0, 1]
    (half,) = project_boxes_3d([box(21.0), box(11.0, y=-1.0)], rig)
    assert half.visibility[0] == pytest.approx(0.5, abs=0.02) and half.visibility[1] == 1
    mask = np.ones(FRONT.size, bool)
    mask[:, :400] = False
    (masked,) = project_boxes_3d([box(11.0)], Rig([replace(FRONT, mask=mask)]))
    assert masked.visibility[0] == pytest.approx(0.5, abs=0.02)


def test_boxes_around_and_behind_the_camera_are_not_seen() -> None:
    (seen,) = project_boxes_3d([box(0.0), box(-11.0), box(0.0, y=3.0, size=(20.0, 2.0, 2.0))], Rig([FRONT]))
    assert seen.rows.tolist() == [2]  # beside the vehicle, reaching behind it
    assert seen.boxes[0, 0] == 0 and seen.truncation[0] > 0.9


@pytest.mark.parametrize("camera", [FRONT, FISHEYE], ids=lambda camera: camera.name)
def test_the_rectangle_bounds_the_pixels(camera: Camera) -> None:
    """Against all pixels whose rays meet the box, also where edges are bent: none is outside, and past the last of them
    there is at most a corner too sharp to hold a pixel's centre."""
    rng = np.random.default_rng(3)
    boxes = np.stack([box(*place, yaw=yaw, size=(4, 2, 1.8)) for *place, yaw in rng.uniform(-8, 8, (20, 4))])
    boxes[:, 2] = 0.9
    (seen,) = project_boxes_3d(boxes, Rig([camera]))
    assert len(seen.rows) >= 4
    more = []
    for index, rectangle in zip(seen.rows, seen.boxes, strict=True):
        v, u = np.nonzero(draw_boxes(camera, boxes[[index]])[1] >= 0)
        more.append(np.array([u.min(), v.min(), -u.max(), -v.max()]) - rectangle * [1, 1, -1, -1])
    assert np.min(more) >= -0.05 and np.max(more) <= 1.5


def test_a_retargeted_sample_knows_its_own_boxes() -> None:
    """The boxes of an output sample are those of the target rig; what no source saw shows none of them."""
    rig = demo_source_rig((64, 176))
    sample = SyntheticDrive(rig, num_frames=1, lidar=False)[0]
    target = rig.turned(yaw_deg=20).shifted(z_m=0.3)
    out = RigRetarget(target, geometry="street")(sample)
    of_sample, of_rig = project_boxes_3d(out["boxes_3d"], out), project_boxes_3d(out["boxes_3d"], target)
    for one, two in zip(of_sample, of_rig, strict=True):
        assert one.rows.tolist() == two.rows.tolist() and np.allclose(one.boxes, two.boxes, atol=1e-6)
        assert (one.visibility <= two.visibility).all()
    with pytest.raises(SampleError, match=r"expected one sample, got a batch \(1,\)"):
        batch = {key: out[key][None] for key in ("images", "K", "cam2ego", "coverage")}
        project_boxes_3d(out["boxes_3d"], batch)


@pytest.mark.parametrize("beside_m", [3.0, 4.5])
def test_what_goes_on_where_a_lens_folds_back(beside_m: float) -> None:
    """Near vehicles of a radtan camera, whose polynomial ends some 40 degrees off its axis: as an undistorted one."""
    rig = load_rig("waymo").resized((128, 352))
    boxes = torch.tensor(
        [[3.2, beside_m, 1.6, 9.3, 2.1, 3.2, 1.1], [6, -beside_m, 1.75, 8, 2.5, 3.5, 0], [12, beside_m, 1, 4, 2, 2, 0]]
    )
    bent, plain = (project_boxes_3d(boxes, cameras)[0] for cameras in (rig, rig.undistorted()))
    assert ((bent.truncation >= 0) & (bent.truncation < 1)).all()
    both = [int(k) for k in bent.rows if int(k) in plain.rows.tolist()]
    assert len(both) >= 2
    for k in both:
        one, two = (view.truncation[view.rows.tolist().index(k)] for view in (bent, plain))
        assert abs(float(one - two)) < 0.12
