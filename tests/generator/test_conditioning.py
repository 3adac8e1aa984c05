"""Conditions of the denoiser besides the noise: rays, poses, masks; the geometry of a frame as tensors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.generator.conditioning import (
    PoseContext,
    batched,
    frame_geometry,
    nearest_sources,
    plucker_rays,
    pose_vector,
)
from tests.generator.small import ring, small_config

ONE = Camera.looking(
    name="one", azimuth_deg=0, position_m=(1.0, 0.0, 1.5), width_px=100, height_px=60, horizontal_fov_deg=90
)


def test_rays_are_directions_and_moments_in_the_references_frame() -> None:
    """A camera 1 m to the left of its reference, looking the same way: o = (-1, 0, 0), compressed to half."""
    left = ONE.shifted(y_m=1.0)
    rays = plucker_rays(left, ONE, (3, 5))
    assert rays.shape == (6, 3, 5)
    d, moment = rays[:3].movedim(0, -1), rays[3:].movedim(0, -1)
    assert torch.allclose(d[1, 2], torch.tensor([0.0, 0.0, 1.0]), atol=1e-6)
    assert torch.allclose(d.norm(dim=-1), torch.ones(3, 5), atol=1e-6)
    assert torch.allclose(moment[1, 2], torch.tensor([0.0, 0.5, 0.0]), atol=1e-6)
    own = plucker_rays(left, left, (3, 5))
    assert torch.allclose(own[:3], rays[:3], atol=1e-6) and not own[3:].any()


def test_poses_are_relative_and_bounded() -> None:
    same = pose_vector(ONE, ONE)
    assert torch.allclose(same[:12], torch.tensor([1.0, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0]))
    turn = np.eye(4)
    turn[:2, :2], turn[:3, 3] = [[0, -1], [1, 0]], (5, 6, 7)
    other = ONE.turned(yaw_deg=12).shifted(y_m=0.4)
    assert torch.allclose(pose_vector(other, ONE), pose_vector(other.moved(turn), ONE.moved(turn)), atol=1e-6)
    for strange in (ONE.shifted(x_m=9e8), replace(ONE, K=np.diag([1e9, 1e-4, 1.0]))):
        pose = pose_vector(strange, ONE)
        assert torch.isfinite(pose).all() and pose[9:12].abs().max() <= 1
        assert torch.isfinite(plucker_rays(strange, ONE, (2, 2))).all()


def test_the_reference_is_the_source_that_looks_most_alike() -> None:
    rig = load_rig("nuscenes")
    target = rig["CAM_BACK_LEFT"].turned(yaw_deg=-20)
    for sources in (list(rig), list(rig)[::-1]):
        assert sources[nearest_sources(target, sources)[0]].name == "CAM_BACK_LEFT"
    twins = [replace(ONE, name="a"), ONE.shifted(z_m=0.1)]
    (first, second), (first_of_reversed, _) = nearest_sources(ONE, twins), nearest_sources(ONE, twins[::-1])
    assert {first, second} == {0, 1} and twins[first] == twins[::-1][first_of_reversed]


def test_the_pose_token_follows_the_prompt() -> None:
    torch.manual_seed(0)
    context = PoseContext(24, prompt_tokens=3)
    context.empty_prompt.normal_()
    pose = torch.stack([pose_vector(ONE, ONE), pose_vector(ONE.turned(yaw_deg=5), ONE), torch.zeros(16)])
    out = context(pose)
    assert out.shape == (3, 4, 24)
    assert torch.equal(out[:, :3], context.empty_prompt.expand(3, 3, 24))
    assert (out[0, 3] - out[1, 3]).abs().max() > 0.01
    assert not out[2, 3].any()  # dropped


def test_frames_of_different_rigs_make_a_batch() -> None:
    config = small_config()
    close, apart = ring(4, radius_m=0.0, horizontal_fov_deg=120), ring(4, horizontal_fov_deg=120)
    frames = [frame_geometry([rig[0]], [rig[1], rig[3]], 0.0, config) for rig in (close, apart)]
    both = batched(frames)
    assert both.target_rays.shape == (2, 1, 6, 6, 10) and both.source_pose.shape == (2, 2, 16)
    assert [c.valid.shape[-2:] for c in both.target_reads] == [(6, 10), (3, 5)]
    assert both.target_reads[0].valid.shape[3] == 3 and frames[0].target_reads[0].valid.shape[3] == 1
    for k, frame in enumerate(frames):
        count = int(frame.target_reads[0].valid.sum())
        assert int(both.target_reads[0].valid[k].sum()) == count > 0
    dropped = both.target_windows(torch.tensor([True, False]))
    assert not dropped[0].valid[0].any() and dropped[0].valid[1].any()
    moved = both.to("cpu")
    assert torch.equal(moved.target_rays, both.target_rays)
