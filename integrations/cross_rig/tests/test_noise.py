"""Errors have the size that they say, and are drawn for a frame."""

import numpy as np
import torch

from integrations.cross_rig.noise import noisy_boxes, noisy_depth, thinned, turned
from integrations.cross_rig.worlds import source_rig


def test_depth_is_off_by_a_share_of_itself():
    depth = torch.tensor([2.0, 50.0]).reshape(2, 1, 1).expand(2, 96, 256)
    noisy = noisy_depth(depth, 3)
    errors = depth / noisy - 1
    torch.testing.assert_close(errors.std(), torch.tensor(0.05), rtol=0.02, atol=0)
    assert (errors[..., 1:] - errors[..., :-1]).abs().mean() < 0.01 and torch.equal(noisy, noisy_depth(depth, 3))
    assert not torch.equal(noisy, noisy_depth(depth, 4))


def test_boxes_move_and_turn_or_are_missed():
    boxes = torch.rand((4000, 7), generator=torch.Generator().manual_seed(0)) * 10
    moved = noisy_boxes(boxes, 1) - boxes
    np.testing.assert_allclose(moved.std(0).numpy(), [0.1, 0.1, 0, 0, 0, 0, np.radians(2)], rtol=0.05)
    assert 0.08 < 1 - len(thinned(boxes, 1)) / 4000 < 0.12
    assert torch.equal(thinned(boxes, 1), thinned(boxes, 1))


def test_cameras_turn_by_a_fifth_of_a_degree_and_stay():
    rig = source_rig((96, 256))
    off = turned(rig)
    cosines = [(np.trace(a.cam2ego[:3, :3].T @ b.cam2ego[:3, :3]) - 1) / 2 for a, b in zip(rig, off, strict=True)]
    angles = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    assert 0.05 < np.sqrt(np.mean(angles**2)) < 0.5
    for a, b in zip(rig, off, strict=True):
        np.testing.assert_array_equal(a.center_m, b.center_m)
    assert turned(rig) == off
