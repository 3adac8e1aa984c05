"""Several frames in one dict, or one after the other: each frame's matrices are its own, and the draw is one."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import RandomRig, SampleError, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.integrations.mmdet3d.transform import RigRetargetMultiView
from integrations.mmdet3d.fake_results import (
    FORMS,
    LIDAR2EGO,
    QUEUES,
    Recording,
    bevdet,
    recorded_drive,
    source_rig,
    sparse4d,
)
from integrations.mmdet3d.measure import frames_of, lidar2img_of, worst_error_px

pytestmark = pytest.mark.filterwarnings("ignore:retarget. drops")

SIZE = (48, 136)
SOURCE = source_rig((60, 176))  # BEVFormer pads them to (64, 192)
TARGET = load_rig("waymo").undistorted().resized(SIZE)


@pytest.fixture(scope="module")
def drive() -> list[Recording]:
    return recorded_drive(list(SyntheticDrive(SOURCE, num_frames=3)))


def through(step: RigRetargetMultiView, results: Any) -> Any:
    return [step(frame) for frame in results] if isinstance(results, list) else step(results)


def grey(images: torch.Tensor) -> np.ndarray:
    """(..., h, w, 3) levels of normalised images."""
    mean, std = np.float32([103.53, 116.28, 123.675]), np.float32([57.375, 57.12, 58.395])
    return np.moveaxis(images.numpy(), -3, -1) * std + mean


@pytest.mark.parametrize("form", QUEUES)
def test_projections_of_three_frames_are_the_new_rigs(drive: list[Recording], form: str) -> None:
    step = RigRetargetMultiView(TARGET, lidar2ego=LIDAR2EGO, geometry="street")
    results = QUEUES[form](drive)
    after = through(step, results)
    frames = frames_of(after)
    errors_px = [worst_error_px(frame, TARGET.in_frame_of(SOURCE)) for frame in frames]
    print(f"{form}: {max(errors_px):.1e} px")
    assert len(frames) == 3 and max(errors_px) <= 1e-3
    if form != "BEVDet4D":  # whose images are augmented already
        assert max(worst_error_px(frame, SOURCE) for frame in frames_of(results)) <= 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("form", QUEUES)
def test_one_draw_for_all_frames(drive: list[Recording], form: str) -> None:
    """One draw of the rig, and of whether to retarget at all."""
    torch.manual_seed(3)
    target = RandomRig(SOURCE, yaw_deg=10, height_m=0.2)
    key = "aug_config" if form == "Sparse4D" else None
    step = RigRetargetMultiView(target, lidar2ego=LIDAR2EGO, geometry="street", p=0.5, size=SIZE, sequence_key=key)
    skipped = set()
    for begun in range(8):
        results = QUEUES[form](drive)
        if form == "Sparse4D":
            for frame in results:  # Sparse4D's sampler keeps it for a sequence
                frame["aug_config"] = {"resize": 1 + 0.01 * begun}
        after = through(step, results)
        params = (after[0] if isinstance(after, list) else after)["retarget_params"]
        rig = SOURCE if params["skipped"] else target.rig({k: v for k, v in params.items() if k != "skipped"})
        skipped.add(params["skipped"])
        frames = frames_of(after)
        for frame in frames:
            if form == "BEVDet4D" and params["skipped"]:  # its images are cropped already, another rig's
                assert np.allclose(lidar2img_of(frame), lidar2img_of(frames[0]))
            else:
                assert worst_error_px(frame, rig.resized(SIZE, "crop")) <= 1e-3
        if len(skipped) == 2:
            return
    raise AssertionError("p=0.5 drew the same eight times")


def test_bevdet4d(drive: list[Recording]) -> None:
    """As each frame by itself, in BEVDet4D's order; what its model makes of the poses leads to the target's cameras."""
    step = RigRetargetMultiView(TARGET, geometry="boxes")
    after = step(QUEUES["BEVDet4D"](drive))
    images, sensor2egos, ego2globals, intrins, post_rots, post_trans, _ = after["img_inputs"]
    views, frames = len(TARGET), len(drive)
    assert images.shape == (views * frames, 3, *SIZE) and after["coverage"].shape == (frames, views, *SIZE)
    for t, given in enumerate(reversed(drive)):
        alone = step(bevdet(given))["img_inputs"]
        rows = slice(t * views, (t + 1) * views)
        assert torch.equal(images.view(views, frames, 3, *SIZE)[:, t], alone[0])
        parts = (sensor2egos, ego2globals, intrins, post_rots, post_trans)
        assert all(torch.equal(part[rows], one) for part, one in zip(parts, alone[1:6], strict=True))
    sensor2key = torch.linalg.inv(ego2globals[0]) @ ego2globals @ sensor2egos.double()
    passed_m = torch.linalg.norm(sensor2key.view(frames, views, 4, 4)[1:, :, :3, 3] - sensor2key[:views, :3, 3], dim=-1)
    assert torch.allclose(passed_m, torch.tensor([[4.5], [9.0]], dtype=torch.float64).expand(-1, views), atol=1e-3)
    assert list(after["curr"]["cams"]) == list(after["adjacent"][1]["cams"]) == TARGET.names
    with pytest.raises(SampleError, match="expected 6 images a frame, as 'cam_names' says, got 15"):
        step({**QUEUES["BEVDet4D"](drive), "img_inputs": after["img_inputs"]})


@pytest.mark.parametrize("form", ["StreamPETR", "BEVFormer"])
def test_queues_are_their_frames(drive: list[Recording], form: str) -> None:
    """Pixels of each frame are those of the frame by itself; poses of the vehicle stay; rims are no pixels."""
    step = RigRetargetMultiView(TARGET, lidar2ego=LIDAR2EGO, geometry="street")
    given = QUEUES[form](drive)
    after = step(given)
    assert after["img"].shape == (3, 5, 3, *SIZE) and after["coverage"].shape == (3, 5, *SIZE)
    for t, recorded in enumerate(drive):
        alone = np.stack(step(FORMS["DETR3D"](recorded))["img"])
        assert np.abs(grey(after["img"][t]) - alone).mean() < 0.1
        meta = after["img_metas"][t]
        assert meta["filename"] == TARGET.names and meta["ori_shape"] == [(*SIZE, 3)] * 5
        assert meta["scene_token"] == "drive"
        if form == "BEVFormer":
            assert np.array_equal(meta["can_bus"], given["img_metas"][t]["can_bus"])
            assert isinstance(meta["lidar2img"], list) and meta["prev_bev"] == (t > 0)
    if form == "StreamPETR":
        for key in ("ego_pose", "ego_pose_inv", "prev_exists", "timestamp", "gt_bboxes_3d"):
            assert after[key] is given[key]
        assert after["extrinsics"].shape == (3, 5, 4, 4) and after["extrinsics"].dtype == torch.float32
        assert torch.allclose(after["intrinsics"] @ after["extrinsics"], after["lidar2img"], atol=1e-3)
        assert torch.equal(after["img_timestamp"], given["timestamp"][:, None].expand(-1, 5))


def test_containers_and_nested_lists_stay(drive: list[Recording]) -> None:
    """mmcv's ``DataContainer``; and queues that are loaded and no more: lists of lists, or one (T, N, h, w, 3)."""

    class DataContainer:
        def __init__(self, data, stack=False, padding_value=0, cpu_only=False, pad_dims=2):
            self.data, self.stack, self.padding_value = data, stack, padding_value
            self.cpu_only, self.pad_dims = cpu_only, pad_dims

    step = RigRetargetMultiView(TARGET, lidar2ego=LIDAR2EGO, geometry="street")
    plain = QUEUES["BEVFormer"](drive)
    metas = DataContainer(plain["img_metas"], cpu_only=True)
    after = step({"img": DataContainer(plain["img"], stack=True), "img_metas": metas})
    assert torch.equal(after["img"].data, step(plain)["img"]) and after["img"].stack and not after["img"].cpu_only
    assert list(after["img_metas"].data) == [0, 1, 2] and after["img_metas"].cpu_only
    matrices = [{"lidar2img": list(frame.K @ frame.lidar2cam)} for frame in drive]
    listed = step({"img": [frame.arrays for frame in drive], "img_metas": matrices})
    assert len(listed["img"]) == 3 and listed["img"][2][4].dtype == np.uint8
    stacked = step({"img": np.stack([frame.arrays for frame in drive]), "img_metas": matrices})
    assert np.array_equal(np.stack([np.stack(images) for images in listed["img"]]), stacked["img"])


def test_sparse4d_after_its_adaptor(drive: list[Recording]) -> None:
    step = RigRetargetMultiView(TARGET, geometry="street")
    given = QUEUES["Sparse4D"](drive)[1]
    after = step(given)
    loaded = step(sparse4d(drive[1]))
    assert np.allclose(after["projection_mat"], lidar2img_of(loaded), rtol=1e-5, atol=1e-2)
    assert after["image_wh"].tolist() == [[SIZE[1], SIZE[0]]] * 5 and after["image_wh"].dtype == np.float32
    assert np.allclose(after["focal"], [np.sqrt(c.K[0, 0] * c.K[1, 1]) for c in TARGET])
    assert after["cam_intrinsic"].shape == (5, 3, 3) and after["T_global"] is given["T_global"]
    assert np.abs(grey(after["img"]) - np.stack(loaded["img"])).max() <= 116  # two deviations


def test_frames_of_a_drive_share_a_draw(drive: list[Recording]) -> None:
    """Each frame passes the pipeline by itself, as BEVFormer's and StreamPETR's datasets do."""
    target = RandomRig(SOURCE.resized(SIZE), yaw_deg=10, per="sequence")
    for step in (
        RigRetargetMultiView(target, lidar2ego=LIDAR2EGO, geometry="street"),
        RigRetargetMultiView(RandomRig(target.base, yaw_deg=10), lidar2ego=LIDAR2EGO, sequence_key="scene_token"),
    ):
        one, same, other = (
            step({**FORMS["DETR3D"](drive[t]), "scene_token": name})["retarget_params"]["yaw_deg"]
            for t, name in ((0, "a"), (1, "a"), (0, "b"))
        )
        assert one == same != other
        with pytest.raises(SampleError, match="sequence_key: expected 'scene_token' in the results, got"):
            step(FORMS["DETR3D"](drive[0]))


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        (
            lambda _, given: {"img_metas": list(given["img_metas"].values())[:2]},
            "a dict for each of the 3 frames of",
        ),
        (lambda drive, _: {"lidar2img": list(drive[0].lidar2cam)}, r"expected matrices for 3 frames.*got \(6, 4, 4\)"),
        (lambda _, given: {"img": given["img"] * 1.1}, r"expected 8 bit images normalised.*photometric distortion"),
    ],
)
def test_messages(drive: list[Recording], entries: Any, message: str) -> None:
    given = QUEUES["BEVFormer"](drive)
    with pytest.raises(SampleError, match=message):
        RigRetargetMultiView(TARGET, lidar2ego=LIDAR2EGO, geometry="street")(given | entries(drive, given))
