"""The world of cuboids: labels that fit its objects, and looks that are not the package's."""

import numpy as np
import pytest
import torch

from arbiview_aug.datasets.synthetic import SceneClass, SyntheticDrive
from integrations.cross_rig.cuboids import CuboidDrive, make_scene
from integrations.cross_rig.frames import source_rig


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
