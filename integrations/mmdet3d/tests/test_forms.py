"""Each framework's ``results`` dict: every key speaks of the target's cameras, and the images are theirs."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import (
    CalibrationError,
    Lidar,
    RandomRig,
    Rig,
    RigRetarget,
    SampleError,
    SampleKeys,
    SampleTypeError,
    load_rig,
)
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.image_ops import resized
from arbiview_aug.integrations.mmdet3d.matrices import MATRICES
from arbiview_aug.integrations.mmdet3d.results import geometry
from arbiview_aug.integrations.mmdet3d.transform import MEAN_STD, RigRetargetMultiView
from integrations.mmdet3d.fake_results import (
    EGO2GLOBAL,
    FORMS,
    LIDAR2EGO,
    Boxes,
    Recording,
    bevdet,
    bevdet4d,
    recorded_drive,
    recording,
    source_rig,
)
from integrations.mmdet3d.measure import worst_error_px

pytestmark = pytest.mark.filterwarnings("ignore:retarget. drops")

README = (Path(__file__).parents[1] / "README.md").read_text()
SIZE = (48, 136)
SOURCE = source_rig((64, 176))
TARGET = replace(load_rig("waymo").undistorted().resized(SIZE), lidars=())
LIDAR_FORMS = [name for name in FORMS if name != "BEVDet"]


@pytest.fixture(scope="module")
def given() -> Recording:
    return recording(SyntheticDrive(SOURCE, num_frames=1)[0])


def step(target: Rig = TARGET, **settings: Any) -> RigRetargetMultiView:
    return RigRetargetMultiView(target, lidar2ego=LIDAR2EGO, **{"geometry": "street", **settings})


def pixels(results: dict) -> np.ndarray:
    """(M, h, w, 3) RGB levels of any form."""
    if "img_inputs" in results:
        mean, std = (np.array(numbers)[:, None, None] for numbers in MEAN_STD)
        return (results["img_inputs"][0].numpy() * std + mean).transpose(0, 2, 3, 1)[..., ::-1]
    arrays = np.stack([np.asarray(image, np.float64) for image in results["img"]])
    is_rgb = "camera_intrinsics" in results or "cam2lidar" in results
    return arrays if is_rgb else arrays[..., ::-1]


def in_key_frame(given: Recording) -> dict:
    """The sample in the ego frame of BEVDet's boxes, that of CAM_FRONT's time."""
    to_key = np.linalg.inv(given.moved[1])
    boxes = given.sample["boxes_3d"].clone()
    boxes[:, 0] += to_key[0, 3]
    rig = SOURCE.with_cameras([camera.moved(to_key) for camera in SOURCE])
    return {"images": given.sample["images"], "rig": rig, "boxes_3d": boxes}


def psnr(one: np.ndarray, two: np.ndarray) -> float:
    return float(10 * np.log10(255**2 / max(np.mean((one - two) ** 2), 1e-9)))


@pytest.mark.parametrize("form", FORMS)
def test_every_form(given: Recording, form: str) -> None:
    """Cameras where they were when they exposed, not their mounting alone, with which one is up to 0.36 m off; points
    and boxes; all in one ego frame: that of the LiDAR's time, or BEVDet's."""
    results = FORMS[form](given)
    before = deepcopy({key: value for key, value in results.items() if key not in ("img", "gt_bboxes_3d", "ann_info")})
    transform, read = step(geometry="boxes"), {}
    transform.retarget.register_forward_pre_hook(lambda _, arguments: read.update(arguments[0]))
    after = transform(results)
    error_px = worst_error_px(after, TARGET.in_frame_of(SOURCE))
    assert error_px <= 1e-3
    assert worst_error_px(results, SOURCE) <= 1e-3 or form == "BEVDet"  # as given: BEVDet's images are augmented
    assert str({k: v for k, v in results.items() if k in before}) == str(before)  # the input is as it was
    assert all(after.get(key) is results.get(key) for key in ("points", "gt_bboxes_3d"))
    sample = in_key_frame(given) if form == "BEVDet" else given.sample
    boxes, true_boxes = read["boxes_3d"].numpy(), sample["boxes_3d"].numpy()
    assert np.allclose(boxes[:, :6], true_boxes[:, :6], atol=1e-4)
    assert np.allclose(np.exp(1j * boxes[:, 6]), np.exp(1j * true_boxes[:, 6]), atol=1e-5)
    if "points" in results:
        assert np.allclose(read["points"], sample["points"], atol=1e-4)
    if form != "BEVDet":  # whose images are augmented: their cameras are compared by their images
        assert np.allclose(read["rig"].cam2ego, sample["rig"].cam2ego, atol=1e-5)
        assert np.abs(read["rig"].cam2ego - given.mounted).max() > 0.3
        assert np.allclose(read["rig"].K, sample["rig"].K, atol=1e-3)
    expected = RigRetarget(TARGET, geometry="boxes")(sample)
    same = after["coverage"] & expected["coverage"].numpy()
    level = psnr(pixels(after)[same], expected["images"].permute(0, 2, 3, 1).numpy()[same])
    print(f"{form}: {error_px:.1e} px, {level:.1f} dB")
    # BEVDet's images were resized by PIL and cropped before, which nothing brings back.
    assert after["coverage"].shape == (5, *SIZE) and level > (27 if form == "BEVDet" else 45)


@pytest.mark.parametrize("form", LIDAR_FORMS)
def test_the_own_rig_gives_everything_back(given: Recording, form: str) -> None:
    results = FORMS[form](given)
    after = step(SOURCE)(results)
    assert np.abs(pixels(after) - pixels(results)).max() <= 1  # float32 poses: 1e-4 px
    for key, kind in MATRICES.items():
        if key in results and kind != "cam2ego":
            assert type(after[key]) is type(results[key]) and type(after[key][0]) is type(results[key][0])
            assert np.allclose(after[key], results[key], rtol=1e-4, atol=1e-4)
            assert np.asarray(after[key]).dtype == np.asarray(results[key]).dtype


def test_every_key_of_mmdet3d(given: Recording) -> None:
    results = FORMS["mmdet3d"](given)
    results["lidar2img"], single = list(results["lidar2img"]), results["lidar2img"][0]
    after = step()(results | {"gt_masks": np.zeros((6, 64, 176), bool), "gt_semantic_seg": np.zeros((6, 64, 176))})
    target = TARGET.in_frame_of(SOURCE)
    assert list(after["images"]) == after["filename"] == TARGET.names and after["num_views"] == 5
    for name, info in after["images"].items():
        assert np.allclose(info["cam2ego"], target[name].cam2ego) and isinstance(info["cam2img"], list)
        assert np.allclose(info["cam2img"], target[name].K)
        assert np.allclose(info["lidar2cam"], np.linalg.inv(target[name].cam2ego) @ LIDAR2EGO)
    assert np.allclose(after["cam2global"], EGO2GLOBAL @ target.cam2ego)
    assert after["img_shape"] == after["ori_shape"] == after["pad_shape"] == SIZE
    assert not {"cam_instances", "gt_masks", "gt_semantic_seg"} & {*after}
    assert "lidar2img" not in step()({**results, "lidar2img": single})  # one camera's, which may be gone
    # Only the nested infos: what is missing at the top is not invented.
    nested = {key: results[key] for key in ("images", "img", "lidar_points")}
    assert set(step()(nested)) == {*nested, "coverage", "generated"}


def test_shapes_and_types_of_the_others(given: Recording) -> None:
    mit, petr = step()(FORMS["mit-han-lab BEVFusion"](given)), step()(FORMS["PETR"](given))
    assert mit["img"][0].size == mit["ori_shape"] == SIZE[::-1] and mit["image_paths"] == TARGET.names
    assert np.allclose(mit["camera2ego"], TARGET.in_frame_of(SOURCE).cam2ego, atol=1e-6)
    assert petr["img"][0].dtype == np.float32 and petr["img_shape"] == (*SIZE, 3, 5)
    assert np.allclose(np.array(petr["extrinsics"])[:, :3, 3], 0) and "bboxes" not in petr["ann_info"]
    assert petr["img_timestamp"] == [1.5] * 5
    stream = FORMS["PETR"](given)  # StreamPETR's are not transposed
    stream["extrinsics"] = [pose.T for pose in stream["extrinsics"]]
    upright = step()(stream)["extrinsics"]
    assert np.allclose([pose.T for pose in upright], petr["extrinsics"])
    alone = {key: value for key, value in stream.items() if key not in ("intrinsics", "extrinsics")}
    assert worst_error_px(step()(alone), TARGET.in_frame_of(SOURCE)) <= 1e-3  # lidar2img says it all


def test_bevdet_takes_augmented_images_and_gives_untouched_ones(given: Recording) -> None:
    """As of images that were resized and cropped with their calibration: half pixels, the flipped view and all."""
    results = FORMS["BEVDet"](given)
    results["curr"] = {"cams": {name: {} for name in SOURCE.names}, "lidar2ego_rotation": [1, 0, 0, 0]}
    after = step(SOURCE)(results)
    images, _, ego2globals, _, post_rots, post_trans, bda = after["img_inputs"]
    assert type(after["img_inputs"]) is tuple and bda is results["img_inputs"][6] and images.dtype == torch.float32
    assert torch.equal(post_rots, torch.eye(3).expand(6, 3, 3)) and not post_trans.any()
    assert torch.equal(ego2globals, results["img_inputs"][2][1].expand(6, 4, 4))
    size = tuple(results["img_inputs"][0].shape[-2:])
    key = in_key_frame(given)
    images = torch.stack([resized(image, (48, 132))[:, 12 : 12 + size[0], : size[1]] for image in key["images"]])
    rig = key["rig"].with_cameras([camera.resize((48, 132)).crop(12, 0, size) for camera in key["rig"]])
    known = {**key, "images": images, "rig": rig}
    expected = RigRetarget(SOURCE, geometry="street")(known)
    assert np.mean(after["coverage"] == expected["coverage"].numpy()) > 0.999
    views = zip(pixels(after), expected["images"].permute(0, 2, 3, 1).numpy(), after["coverage"], strict=True)
    levels = [psnr(one[seen], two[seen]) for one, two, seen in views]
    print("dB of each view", np.round(levels, 1))
    assert min(levels) > 38
    late = {**results, "gt_depth": torch.ones(6, 4, 4)}
    with pytest.warns(UserWarning, match="retarget: drops gt_depth"):
        assert "gt_depth" not in step()(late)
    assert "canvas" not in after and after["curr"]["lidar2ego_rotation"] == [1, 0, 0, 0]
    front = after["curr"]["cams"]["CAM_FRONT"]
    assert np.allclose(np.linalg.norm(front["sensor2ego_rotation"]), 1) and front["data_path"] == "CAM_FRONT"


# --- several frames ---------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def drive() -> list[Recording]:
    return recorded_drive(list(SyntheticDrive(SOURCE, num_frames=3)))


def test_bevdet4d(drive: list[Recording]) -> None:
    """As each frame by itself, in BEVDet4D's order; what its model makes of the poses leads to the target's cameras."""
    transform = step(geometry="boxes")
    after = transform(bevdet4d(drive))
    images, sensor2egos, ego2globals, intrins, post_rots, post_trans, _ = after["img_inputs"]
    views, frames = len(TARGET), len(drive)
    assert images.shape == (views * frames, 3, *SIZE) and after["coverage"].shape == (frames, views, *SIZE)
    for t, given in enumerate(reversed(drive)):
        alone = transform(bevdet(given))
        assert worst_error_px(alone, TARGET.in_frame_of(SOURCE)) <= 1e-3
        rows = slice(t * views, (t + 1) * views)
        assert torch.equal(images.view(views, frames, 3, *SIZE)[:, t], alone["img_inputs"][0])
        parts = (sensor2egos, ego2globals, intrins, post_rots, post_trans)
        assert all(torch.equal(part[rows], one) for part, one in zip(parts, alone["img_inputs"][1:6], strict=True))
    sensor2key = torch.linalg.inv(ego2globals[0]) @ ego2globals @ sensor2egos.double()
    passed_m = torch.linalg.norm(sensor2key.view(frames, views, 4, 4)[1:, :, :3, 3] - sensor2key[:views, :3, 3], dim=-1)
    assert torch.allclose(passed_m, torch.tensor([[4.5], [9.0]], dtype=torch.float64).expand(-1, views), atol=1e-3)
    assert list(after["curr"]["cams"]) == list(after["adjacent"][1]["cams"]) == TARGET.names
    with pytest.raises(SampleError, match="expected 6 images a frame, as 'cam_names' says, got 15"):
        transform({**bevdet4d(drive), "img_inputs": after["img_inputs"]})


def test_one_draw_for_all_frames_of_a_dict(drive: list[Recording]) -> None:
    """One draw of the rig, and of whether to retarget at all."""
    transform = step(RandomRig(SOURCE, yaw_deg=10, height_m=0.2), p=0.5, size=SIZE)
    skipped = set()
    for seed in range(8):
        torch.manual_seed(seed)
        after = transform(bevdet4d(drive))
        intrins, poses = (after["img_inputs"][k].view(3, 6, *shape) for k, shape in ((3, (3, 3)), (1, (4, 4))))
        assert torch.equal(intrins, intrins[:1].expand_as(intrins)) and torch.allclose(poses, poses[:1], atol=1e-5)
        skipped.add(after["retarget_params"]["skipped"])
    assert skipped == {0.0, 1.0}


@pytest.mark.parametrize(("form", "key"), [("DETR3D", "scene_token"), ("Sparse4D", "aug_config")])
def test_frames_of_a_drive_share_a_draw(drive: list[Recording], form: str, key: str) -> None:
    """Each frame passes the pipeline by itself, as BEVFormer's, StreamPETR's and Sparse4D's datasets do."""
    rig = SOURCE.resized(SIZE)
    transforms = [step(RandomRig(rig, yaw_deg=10), sequence_key=key)]
    transforms += [step(RandomRig(rig, yaw_deg=10, per="sequence"))] if key == "scene_token" else []
    for transform in transforms:
        one, same, other = (
            transform({**FORMS[form](drive[t]), key: name if form == "DETR3D" else {"resize": name}})[
                "retarget_params"
            ]["yaw_deg"]
            for t, name in ((0, "a"), (1, "a"), (0, "b"))
        )
        assert one == same != other
        with pytest.raises(SampleError, match=f"sequence_key: expected '{key}' in the results, got"):
            transform({name: value for name, value in FORMS[form](drive[0]).items() if name != key})


def test_skipped_frames_keep_their_cameras(given: Recording) -> None:
    target = SOURCE.turned(yaw_deg=10)
    skipping = step(target, p=0.01, size=SIZE, keys=SampleKeys(extra=("confidence",)))
    torch.manual_seed(1)
    results = FORMS["mmdet3d"](given)
    after = skipping(results)
    assert after["retarget_params"]["skipped"] and after["confidence"].all()
    assert after["filename"] == results["filename"]  # as where no step stood
    assert all(after["images"][name]["img_path"] == info["img_path"] for name, info in results["images"].items())
    assert worst_error_px(after, SOURCE.resized(SIZE, "crop")) <= 1e-3


def test_entries_that_are_empty(given: Recording) -> None:
    """Datasets leave them so."""
    full = {"img_timestamp": [1.5] * 6, "img_shape": [], "timestamp": None}
    full |= {"ann_info": {"num_lidar_pts": None}}
    after = step(replace(TARGET, lidars=[Lidar("top", LIDAR2EGO, (-5.0, 0.0), 1.0, (1.0, 80.0))]))(
        FORMS["mmdet3d"](given) | full
    )
    assert after["img_timestamp"] == [1.5] * 5 and after["img_shape"] == [] and len(after["points"])
    results = FORMS["mmdet3d"](given)
    results["images"] = {name: {**info, "height": None, "cam2img": None} for name, info in results["images"].items()}
    assert "cam2img" not in step()(results)["images"][TARGET.names[0]]
    assert step()(results | {"images": {"CAM_FRONT": None}})["images"][TARGET.names[0]] == {}
    for key in ("cam_names", "adjacent"):
        assert len(step()(FORMS["BEVDet"](given) | {key: None})["img_inputs"][0]) == 5


def test_geometry_in_plain_numbers() -> None:
    rows = np.float32([[8, 1, 0, 4, 2, 1.5, 0.3], [9, 1, 0, 4, 2, 1.5, 0]])
    expected = geometry({"points": rows, "gt_bboxes_3d": rows}, LIDAR2EGO)
    for form in (torch.from_numpy, np.ndarray.tolist):
        same = geometry({"points": form(rows), "gt_bboxes_3d": form(rows)}, LIDAR2EGO)
        assert all(torch.allclose(same[key], value) for key, value in expected.items()) and len(same) == 2
    for key, shape in (("gt_bboxes_3d", (2, 6)), ("points", (5, 2)), ("points", (1, 5, 3))):
        with pytest.raises(SampleError, match=rf"^{key}: expected rows of at least . numbers, got shape"):
            geometry({key: np.ones(shape)}, LIDAR2EGO)
    with pytest.raises(SampleTypeError, match="gt_bboxes_3d: expected a tensor of numbers"):
        geometry({"gt_bboxes_3d": "boxes"}, LIDAR2EGO)
    empty = np.zeros((0, 7))
    for boxes in ([], Boxes(empty), Boxes(empty, is_old=True)):
        assert geometry({"gt_bboxes_3d": boxes}, LIDAR2EGO)["boxes_3d"].shape == (0, 7)


AUGMENTED = {
    **{"img_aug_matrix": [np.diag([0.5, 0.5, 1, 1])] * 6, "pcd_rotation": -torch.eye(3), "pcd_trans": np.ones(3)},
    **{"flip": True, "pcd_horizontal_flip": True, "scale_factor": np.full(4, 0.5), "pcd_scale_factor": np.nan},
    **{"global_aug_matrix": 2 * np.eye(4), "bev_flip_matrix": np.diag([1, -1, 1, 1])},
}
MALFORMED: list[tuple[str, Any, str]] = [
    *(("DETR3D", {key: AUGMENTED[key]}, f"{key}: expected a frame as it was recorded") for key in AUGMENTED),
    ("DETR3D", {"lidar2img": 3.0}, "lidar2img: expected 6 matrices, 3×3 or 4×4, one for each image, got float"),
    ("DETR3D", {"lidar2img": []}, "lidar2img: expected 6 matrices"),
    ("DETR3D", {"lidar2cam": [1] * 6}, "lidar2cam: expected 6 matrices"),
    ("DETR3D", {"cam_intrinsic": np.ones((5, 4, 4))}, "cam_intrinsic: expected 6 matrices, 3×3 or 4×4"),
    ("DETR3D", {"lidar2img": np.full((6, 4, 4), np.nan)}, "lidar2img: expected K @ lidar2cam, got .* nan%"),
    ("DETR3D", {"lidar2img": np.ones((6, 4, 4))}, "lidar2img: expected K @ lidar2cam, got matrices that differ by"),
    ("DETR3D", dict.fromkeys(("lidar2cam", "lidar2img"), np.zeros((6, 4, 4))), "lidar2cam: .* can be inverted"),
    ("DETR3D", {"lidar2img": np.zeros((6, 4, 4)), "lidar2cam": None}, "lidar2img: .* can be decomposed"),
    ("DETR3D", {"ori_lidar2img": 3.0}, "ori_lidar2img: expected a matrix of each image"),
    ("DETR3D", {"img": [np.full((64, 176, 3), -1.0)] * 6}, r"img\[0\]: expected grey levels from 0 to 255, got -"),
    ("DETR3D", {"img": [np.zeros((64, 176))] * 6}, r"img\[0\]: expected \(H, W, 3\)"),
    ("DETR3D", {"img": [None] * 6}, r"img\[0\]: expected \(H, W, 3\)"),
    ("DETR3D", {"img": np.zeros((3, 6, 64, 176, 3))}, r"img\[0\]: .* retarget each frame of a queue in its pipeline"),
    ("Sparse4D", {"lidar2ego_rotation": [1, 0]}, "lidar2ego_rotation, lidar2ego_translation: expected a quaternion"),
    ("Sparse4D", {"lidar2ego_translation": [1, 0]}, "lidar2ego_rotation, lidar2ego_translation: expected a quat"),
    ("mmdet3d", {"flip": "no"}, "flip: expected numbers"),
    ("mmdet3d", {"pcd_rotation": np.eye(2)}, r"pcd_rotation: expected numbers of shape \(3, 3\)"),
    ("mmdet3d", {"images": {name: {"height": "x", "width": 3} for name in SOURCE.names}}, "images: expected height"),
    ("PETR", {"img_timestamp": ["a"] * 6, "timestamp": None}, "img_timestamp: expected seconds"),
    ("BEVDet", lambda e: (e[0] * np.nan, *e[1:]), r"img_inputs: expected 8 bit images .* nan off whole numbers"),
    ("BEVDet", lambda e: e[:5], r"img_inputs: expected .* got 5 entries"),
    ("BEVDet", lambda e: (*e[:4], e[4] * 0, *e[5:]), "post_rots that can be inverted, got a singular one"),
    ("BEVDet", lambda e: tuple(part[:0] for part in e), "expected 6 images a frame, as 'cam_names' says, got 0"),
    ("BEVDet", lambda e: (e[0].repeat(2, 1, 1, 1), *e[1:]), r"expected 12 cameras in each entry"),
]


@pytest.mark.parametrize(("form", "entries", "message"), MALFORMED)
def test_malformed_entries_are_named(given: Recording, form: str, entries: Any, message: str) -> None:
    results = FORMS[form](given)
    entries = {"img_inputs": entries(results["img_inputs"])} if callable(entries) else entries
    with pytest.raises((SampleError, SampleTypeError), match=message):
        step()(results | entries)


def test_messages(given: Recording) -> None:
    results, bevdet = FORMS["DETR3D"](given), FORMS["BEVDet"](given)
    mixed = Rig([TARGET[0], *(camera.resize((40, 60)) for camera in TARGET.cameras[1:])])
    for transform, sample, message in (
        (RigRetargetMultiView(TARGET), results, "lidar2ego: expected the LiDAR's pose"),
        (step(), {"img": results["img"]}, "expected the cameras' matrices"),
        (step(), {"filename": []}, "expected 'img', loaded images"),
        (step(mixed), results, "images of one size"),
        (step(keys=SampleKeys(frame="target")), results, r"SampleKeys\.frame: expected 'source'"),
        (step(img_norm=((0, 0, 0), (1, 1, 1))), {"img_inputs": bevdet["img_inputs"]}, r"whole numbers.*img_norm"),
    ):
        with pytest.raises(SampleError, match=message):
            transform(sample)
    with pytest.raises(CalibrationError, match=r"pinhole cameras.*got radtan.*undistorted\(\)"):
        RigRetargetMultiView("waymo")
    with pytest.raises(CalibrationError, match=r"lidar2ego: expected a pose \(4, 4\), got shape \(3, 3\)"):
        RigRetargetMultiView(TARGET, lidar2ego=np.eye(3))


@pytest.mark.parametrize(
    "settings", [{"img_norm": (1, 2)}, {"keys": {"nonsense": 1}}, {"ground_z_m": "x"}, {"ground_z_m": None}]
)
def test_malformed_settings_are_named(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=rf"^{next(iter(settings))}: expected"):
        step(**settings)


def test_readme_names_every_key_and_form() -> None:
    assert all(f"`{key}`" in README for key in MATRICES) and all(name in README for name in FORMS)
