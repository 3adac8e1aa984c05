"""Views that the variants make of A's frames, and the world of cuboids."""

import numpy as np
import pytest
import torch

from arbiview_aug.datasets.synthetic import SceneClass, SyntheticDrive
from integrations.cross_rig.cuboids import CuboidDrive, make_scene
from integrations.cross_rig.frames import CHANGES, SPLITS, source_rig, street_seed
from integrations.cross_rig.variants import SCALE, VARIANTS, ViewMaker, scaled_and_cropped

SIZE = (24, 64)


@pytest.fixture(scope="module")
def frame() -> dict:
    drive = SyntheticDrive(source_rig(SIZE), num_frames=1, seed=9)
    boxes = torch.from_numpy(drive.scene(0).boxes_ego(0.0)).float()
    return {"images": drive.render(0).images, "points": drive.points(0), "boxes_3d": boxes}


@pytest.mark.parametrize("name", ["auto_fill", "street_fill", "objects_fill", "auto_fill_random", "random_a"])
@pytest.mark.filterwarnings("ignore")
def test_every_variant_renders(frame, name):
    source, target = source_rig(SIZE), CHANGES["waymo"].target(SIZE)
    target = target if VARIANTS[name].knows_target else source
    views, again = (ViewMaker(VARIANTS[name], source, target)(0, frame) for _ in range(2))
    assert views["images"].shape == (len(target), 3, *SIZE) and views["images"].dtype == np.uint8
    assert views["images"].any(1).mean() > 0.9, "holes are filled"
    np.testing.assert_array_equal(again["images"], views["images"])
    assert np.allclose(views["K"], target.K, rtol=1e-6) == (VARIANTS[name].random is None)
    assert np.allclose(views["cam2ego"], target.cam2ego, atol=1e-6) == (VARIANTS[name].random is None)


def test_scaled_and_cropped_keeps_pixels_and_calibration_together():
    rng = np.random.default_rng(0)
    K = source_rig((48, 64)).K[:1].astype(np.float32)
    scales = []
    for _ in range(20):
        image = np.zeros((1, 3, 48, 64), np.uint8)
        row, column = int(rng.integers(16, 32)), int(rng.integers(22, 42))
        image[0, :, row - 1 : row + 2, column - 1 : column + 2] = 255
        out, coverage, K2 = scaled_and_cropped(image, K, rng)
        moved = K2[0] @ np.linalg.inv(K[0]) @ (column, row, 1)
        scales.append(K2[0, 0, 0] / K[0, 0, 0])
        if 2 < moved[0] < 61 and 2 < moved[1] < 45:
            weight = out[0, 0].astype(float)
            v, u = np.indices(weight.shape)
            centre = (weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()
            np.testing.assert_allclose(centre, moved[:2], atol=0.1)
            # A smaller picture leaves a border that nobody saw; a larger one fills the window.
            assert coverage.mean() == pytest.approx(min(1, scales[-1] ** 2), abs=0.05)
    assert SCALE[0] <= min(scales) < 0.9 and 1.15 < max(scales) <= SCALE[1]


def test_streets_are_disjoint_and_rigs_are_on_one_road():
    assert len({street_seed(split, streets) for split in SPLITS for streets in (100, 200)}) == 6
    rigs = {name: change.target((96, 256)) for name, change in CHANGES.items()}
    assert all(rig.ground_z_m == 0 and set(rig.sizes) == {(96, 256)} for rig in rigs.values())
    heights = {name: float(np.median(rig.cam2ego[:, 2, 3])) for name, rig in rigs.items()}
    assert heights == pytest.approx({"fov50": 1.5, "up70": 2.2, "waymo": 2.1}, abs=0.02)
    assert rigs["fov50"][0].fov_deg[0] == pytest.approx(50)


def test_scenes_depend_on_seed_and_index_alone_and_objects_fill_their_boxes():
    scene = make_scene(3, 1)
    make_scene.cache_clear()
    np.testing.assert_array_equal(make_scene(3, 1).corners, scene.corners)
    assert not np.array_equal(make_scene(3, 2).boxes, scene.boxes)
    assert not np.array_equal(make_scene(4, 1).boxes, scene.boxes)
    for row, box in enumerate(scene.boxes):
        c, s = np.cos(box[6]), np.sin(box[6])
        local = (scene.corners[scene.instance == row].reshape(-1, 3) - box[:3]) @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        np.testing.assert_allclose(np.abs(local[:, :2]).max(0), box[3:5] / 2, atol=0.03)
        np.testing.assert_allclose([local[:, 2].min(), local[:, 2].max()], [-box[5] / 2, box[5] / 2], atol=1e-6)


@pytest.mark.slow
def test_views_have_the_truth_of_this_world_in_other_colours():
    drive = CuboidDrive(source_rig((48, 128)), num_frames=20, seed=3, lidar=False)
    views = drive.render(0)
    assert {SceneClass.SKY, SceneClass.GROUND, SceneClass.VEHICLE} <= set(views.classes.unique().tolist())
    assert (views.visible_pixels(len(drive.scene(0).boxes)).amax(0) > 8).sum() > 3
    assert torch.equal(torch.isinf(views.depth_m), views.classes == SceneClass.SKY)
    # The package's own renderer colours these scenes as its streets.
    plain = SyntheticDrive(drive.rig, num_frames=1, lidar=False)._renderer.render(drive.scene(0), drive.rig.cameras, 0)
    assert (plain[0][0] != views.images[0]).float().mean() > 0.8
    assert torch.equal(plain[0][1], views.depth_m[0])
