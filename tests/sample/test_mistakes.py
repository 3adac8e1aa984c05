"""``check`` finds every silent mistake, and nothing in right samples; errors and warnings name the others."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import Camera, CheckReport, Finding, Rig, RigRetarget, SampleError, check, load_rig
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rotations import (
    CAMERA_AXES_IN_EGO,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_z,
)
from arbiview_aug.cameras.validation import doubts
from arbiview_aug.datasets import FrameFolder, cleaned_rig, open_data
from arbiview_aug.sample.mistakes import check_rig, road_height_m
from tests.helpers import street_sample

Sample = dict[str, Any]
Mistake = Callable[[Sample], Sample]
BODY = np.eye(4)
BODY[:3, :3] = CAMERA_AXES_IN_EGO


def turned(sample: Sample, yaw_deg: float) -> Sample:
    """The sample in an ego frame turned about z, so that yaw conventions differ; it stays right."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_z(yaw_deg)
    points, boxes = sample["points"].clone(), sample["boxes_3d"].clone()
    for rows in (points, boxes):
        rows[:, :3] = rows[:, :3] @ torch.from_numpy(pose[:3, :3].T).to(rows.dtype)
    boxes[:, 6] = torch.remainder(boxes[:, 6] + math.radians(yaw_deg) + math.pi, 2 * math.pi) - math.pi
    rig = sample["rig"].with_cameras([camera.moved(pose) for camera in sample["rig"]])
    return {**sample, "rig": rig, "points": points, "boxes_3d": boxes}


def boxes(change: Callable[[torch.Tensor], torch.Tensor]) -> Mistake:
    return lambda sample: {**sample, "boxes_3d": change(sample["boxes_3d"])}


def yaws(change: Callable[[torch.Tensor], torch.Tensor]) -> Mistake:
    return boxes(lambda rows: torch.cat([rows[:, :6], change(rows[:, 6:7]), rows[:, 7:]], dim=1))


def sizes(factor: float) -> Mistake:
    return boxes(lambda rows: rows[:, :7] * torch.tensor([1.0] * 3 + [factor] * 3 + [1.0]))


def raised(heights: float) -> Mistake:
    return boxes(lambda rows: torch.cat([rows[:, :2], rows[:, 2:3] + heights * rows[:, 5:6], rows[:, 3:]], dim=1))


wider, higher = (boxes(lambda rows, o=o: rows[:, o]) for o in ([0, 1, 2, 4, 3, 5, 6], [0, 1, 2, 5, 4, 3, 6]))
at_the_bottom, at_the_top = raised(-0.5), raised(0.5)


def without(*keys: str) -> Mistake:
    return lambda sample: {key: value for key, value in sample.items() if key not in keys}


def lidar_frame(yaw_deg: float, forward_m: float = 0.94, up_m: float = 1.84) -> Mistake:
    """Points in the frame of a LiDAR on the roof; its x axis looks to ``-yaw_deg``."""
    R = rotation_z(yaw_deg)
    return moved("points", R, tuple(R @ (-forward_m, 0, -up_m)))


def ground(shift_m: float) -> Mistake:
    return lambda sample: {**sample, "rig": replace(sample["rig"], ground_z_m=sample["rig"].ground_z_m + shift_m)}


def cameras(change: Callable[[Camera], Camera]) -> Mistake:
    return lambda sample: {**sample, "rig": sample["rig"].with_cameras(list(map(change, sample["rig"])))}


def poses(change: Callable[[FloatArray], FloatArray]) -> Mistake:
    return cameras(lambda camera: replace(camera, cam2ego=change(camera.cam2ego)))


def millimetres(cam2ego: FloatArray) -> FloatArray:
    return np.hstack([cam2ego[:, :3], cam2ego[:, 3:] * [[1000], [1000], [1000], [1]]])


WORLD = np.array([[0.6, -0.8, 0, 411.0], [0.8, 0.6, 0, 1181], [0, 0, 1, 0.4], [0, 0, 0, 1]])
"""A pose of the ego in the world."""


def in_world(key: str) -> Mistake:
    return moved(key, WORLD[:3, :3], tuple(WORLD[:3, 3]))


def scaled_K(factor: float) -> Mistake:
    """K of images of ``factor`` times the size."""
    return cameras(lambda camera: replace(camera, K=np.diag([factor, factor, 1]) @ camera.K))


def speckled(camera: Camera) -> Camera:
    mask = np.ones(camera.size, bool)
    mask[-20:] = False
    mask[5, 7], mask[-10, 30] = False, True
    return replace(camera, mask=mask)


def renamed(key: str, name: str) -> Mistake:
    return lambda sample: {name if k == key else k: value for k, value in sample.items()}


def moved(key: str, A: FloatArray | list[list[float]], t: tuple[float, ...] = (0, 0, 0)) -> Mistake:
    """Points or boxes moved by A (3, 3) and t; boxes' headings with them."""

    def mistaken(sample: Sample) -> Sample:
        rows, matrix = sample[key].clone(), torch.as_tensor(A, dtype=sample[key].dtype)
        rows[:, :3] = rows[:, :3] @ matrix.T + torch.tensor(t, dtype=rows.dtype)
        if key == "boxes_3d":
            yaw = rows[:, 6]
            ahead = torch.stack([yaw.cos(), yaw.sin(), 0 * yaw], dim=1) @ matrix.T
            rows[:, 3:6] *= matrix[0].norm()
            rows[:, 6] = torch.atan2(ahead[:, 1], ahead[:, 0])
        return {**sample, key: rows}

    return mistaken


def in_camera(key: str) -> Mistake:
    """Points, or boxes as KITTI has them: the bottom's centre, and yaw about the y axis down."""

    def mistaken(sample: Sample) -> Sample:
        pose, rows = sample["rig"][0].cam2ego, sample[key].double().numpy().copy()
        if key == "boxes_3d":
            rows[:, 2] -= rows[:, 5] / 2
            ahead = np.stack([np.cos(rows[:, 6]), np.sin(rows[:, 6]), 0 * rows[:, 6]], axis=1) @ pose[:3, :3]
            rows[:, 6] = np.arctan2(-ahead[:, 2], ahead[:, 0])
        rows[:, :3] = (rows[:, :3] - pose[:3, 3]) @ pose[:3, :3]
        return {**sample, key: torch.from_numpy(rows)}

    return mistaken


NEARBY = np.vstack([np.column_stack([rotation_z(37), (25, -14, 0.3)]), [0, 0, 0, 1]])
"""A pose in a world that begins nearby, as simulators and odometry have it."""


def in_local_world(key: str) -> Mistake:
    change = moved(key, NEARBY[:3, :3], tuple(NEARBY[:3, 3]))
    return lambda sample: {**change(sample), "ego2world": torch.from_numpy(NEARBY)}


def second_camera(change: Callable[[FloatArray], FloatArray]) -> Mistake:
    def mistaken(sample: Sample) -> Sample:
        first, second, *others = sample["rig"]
        second = replace(second, cam2ego=change(second.cam2ego))
        return {**sample, "rig": sample["rig"].with_cameras([first, second, *others])}

    return mistaken


def turn(change: Callable[[FloatArray], FloatArray]) -> Callable[[FloatArray], FloatArray]:
    """A change of the rotation alone."""
    return lambda pose: np.vstack([np.hstack([change(pose[:3, :3]), pose[:3, 3:]]), pose[3:]])


def quaternion_misread(order: list[int]) -> Mistake:
    return second_camera(turn(lambda R: rotation_from_quaternion(quaternion_from_rotation(R)[order])))


MIRROR, OPENGL = np.diag([1.0, -1, 1, 1]), np.diag([1.0, -1, -1, 1])
FLIP_Y, FLIP_X, DOWN, SWAP = np.diag([1.0, -1, 1]), np.diag([-1.0, 1, 1]), np.diag([1.0, -1, -1]), np.eye(3)[[1, 0, 2]]
quarter = math.pi / 2
MISTAKES: dict[str, tuple[Mistake, str]] = {
    "yaw in degrees": (yaws(torch.rad2deg), "boxes_3d: .*in radians.* torch.deg2rad"),
    "width before length": (wider, "boxes_3d: .*wider than long.*Swap columns 3 and 4"),
    "height first": (higher, "boxes_3d: .*highest along the sixth.*Reorder"),
    "yaw the other way round": (yaws(lambda yaw: -yaw), "boxes_3d: .*; pass -yaw$"),
    "yaw from the y axis": (yaws(lambda yaw: yaw - quarter), r"boxes_3d: .*; pass yaw \+ pi / 2$"),
    "heading from north": (yaws(lambda yaw: quarter - yaw), "boxes_3d: .*; pass pi / 2 - yaw$"),
    "z at the bottom": (at_the_bottom, "boxes_3d: .*centre.*add half the height"),
    "LiDAR's frame": (lidar_frame(90), "points: .*1.8.*LiDAR's frame"),
    "LiDAR's frame, turned back": (lidar_frame(180), "points: .*LiDAR's frame"),
    "another frame of the same height": (lidar_frame(90, 0, 0), "points: .*LiDAR's frame"),
    "ground_z_m too low": (ground(-0.33), r"ground_z_m: .*found -0.33; set ground_z_m=-?0.0\d"),
    "ground_z_m too high": (ground(0.33), r"ground_z_m: .*found \+0.33; set ground_z_m=-?0.0\d"),
    "ROS axes": (poses(lambda pose: pose @ BODY.T), r"cam2ego: .*ROS.*\[\[0, 0, 1\], \[-1, 0, 0\], \[0, -1, 0\]\]"),
    "K in millimetres": (cameras(lambda c: replace(c, K=np.diag([0.02, 0.02, 1]) @ c.K)), "K: .*pixels.*millimetres"),
    "inverted cam2ego": (poses(np.linalg.inv), r"cam2ego: .*inverse.*np\.linalg\.inv"),
    "depth in millimetres": (
        lambda s: {**s, "depth_m": torch.full((len(s["rig"]), *s["rig"].sizes[0]), 4000, dtype=torch.int32)},
        "depth_m: .*nearest pixel 4000 m away; is it in millimetres",
    ),
    "millimetres": (poses(millimetres), "cam2ego: .*millimetres.* by 1000"),
    "poses in the world": (poses(lambda pose: WORLD @ pose), "cam2ego: .*world's frame; pass np.linalg.inv.ego2world"),
    "points in the world": (in_world("points"), "points: .*nearest 1[12].. m away; are they in the world's frame"),
    "boxes in the world": (in_world("boxes_3d"), "boxes_3d: .*nearest 1[12].. m away; are they in the world's frame"),
    "OpenGL's axes": (poses(lambda pose: pose @ OPENGL), r"cam2ego: .*OpenGL.*negate"),
    "an ego frame with a camera's axes": (poses(lambda pose: BODY.T @ pose), "cam2ego: .*from the left"),
    "K of a smaller image": (scaled_K(0.8), "K: .*another resolution"),
    "K of a larger image": (scaled_K(1.25), "K: .*another resolution"),
    "specks in a mask": (cameras(speckled), "mask: .*specks of 2 pixels.*clean_masks=True"),
    "an inverted mask": (
        cameras(lambda c: replace(c, mask=np.indices(c.size)[0] > c.height_px * 0.75)),
        "mask: .*upper third hidden; pass ~mask",
    ),
    "gt_boxes": (renamed("boxes_3d", "gt_boxes"), "gt_boxes: .*did you mean boxes_3d"),
    "boxes3d": (renamed("boxes_3d", "boxes3d"), "boxes3d: .*did you mean boxes_3d"),
    "lidar_points": (renamed("points", "lidar_points"), "lidar_points: .*did you mean points"),
    "boxes in a camera's frame": (in_camera("boxes_3d"), "boxes_3d: .*frame of camera .*; apply the cam2ego of"),
    "boxes in the LiDAR's frame": (
        moved("boxes_3d", rotation_z(90), (0.0, 0.94, -1.84)),
        "boxes_3d: .*turned by 90 degrees and 1.8 m lower.*lidar2ego",
    ),
    "mirrored boxes": (moved("boxes_3d", FLIP_Y), "boxes_3d: .*mirrored.*; negate y and yaw$"),
    "boxes with x backward": (moved("boxes_3d", FLIP_X), "boxes_3d: .*; negate x, and pass pi - yaw$"),
    "boxes with x and y swapped": (moved("boxes_3d", SWAP), "boxes_3d: .*; swap x and y, and pass pi / 2 - yaw$"),
    "boxes with z down": (moved("boxes_3d", DOWN), "boxes_3d: .*z down.*; negate y, z and yaw$"),
    "boxes in feet": (moved("boxes_3d", np.eye(3) / 0.3048), "boxes_3d: .*multiply positions and sizes by 0.3048"),
    "boxes in a world nearby": (in_local_world("boxes_3d"), r"boxes_3d: .*; apply inv\(ego2world\), to yaw too"),
    "z at the top": (at_the_top, "boxes_3d: .*centre.*subtract half the height"),
    "sizes from the centre": (sizes(0.5), "boxes_3d: .*half the size of what.*Double"),
    "sizes twice as large": (sizes(2.0), "boxes_3d: .*twice the size of what.*halve"),
    "sizes in millimetres": (sizes(1000.0), "boxes_3d: expected sizes in metres.*millimetres"),
    "mirrored points": (moved("points", FLIP_Y), "points: .*mirrored.*edges of the images; negate y$"),
    "points with x and y swapped": (moved("points", SWAP), "points: .*; swap x and y$"),
    "points with z down": (moved("points", DOWN), "points: .*z down.*; negate y and z$"),
    "points in a camera's frame": (in_camera("points"), "points: .*frame of camera .*; apply the cam2ego of"),
    "points in a world nearby": (in_local_world("points"), r"points: .*; apply inv\(ego2world\)$"),
    "one camera with a body's axes": (second_camera(lambda pose: pose @ BODY.T), "camera .*: cam2ego: .*ROS.*right$"),
    "one camera with OpenGL's axes": (second_camera(lambda pose: pose @ OPENGL), "camera .*: cam2ego: .*OpenGL.*; neg"),
    "one camera rolled": (second_camera(turn(lambda R: R @ rotation_z(120))), "camera .*: cam2ego: .*rolled by -1[12]"),
    "one quaternion x y z w": (quaternion_misread([1, 2, 3, 0]), "camera .*: cam2ego: .*a quaternion in another order"),
    "one quaternion w x y z": (quaternion_misread([3, 0, 1, 2]), "camera .*: cam2ego: .*a quaternion in another order"),
    "left-handed positions": (
        poses(lambda pose: pose * np.array([1.0, 1, 1, -1]) ** np.array([[0], [1], [0], [0]])),
        r"cam2ego: .*mirrored; positions are left-handed.*negate cam2ego\[1, 3\]",
    ),
    "left-handed poses": (
        poses(lambda pose: MIRROR @ pose @ np.diag([-1.0, 1, 1, 1])),
        r"cam2ego: .*left and right are swapped.*; negate cam2ego\[1\] and",
    ),
    "y of the ego frame forward": (
        poses(lambda pose: np.vstack([rotation_z(90) @ pose[:3], pose[3:]])),
        "cam2ego: .*turned by 1[12]. degrees; x of the ego frame is forward",
    ),
    "a mask that hides all": (
        cameras(lambda c: replace(c, mask=np.zeros(c.size, bool))),
        "mask: .*100% of the image hidden; pass ~mask",
    ),
}
"""Each mistake, and how its finding reads."""


@pytest.fixture(scope="module")
def street() -> Sample:
    """In a turned frame: along its axes, some conventions of yaw agree."""
    return turned(street_sample(seed=0), 30)


@pytest.fixture(scope="module")
def nuscenes(nuscenes_root: Path) -> Sample:
    return turned(open_data(f"nuscenes:{nuscenes_root}", reduce=4)[0], 30)


@pytest.mark.parametrize("mistake", MISTAKES)
@pytest.mark.parametrize("frame", ["street", "nuscenes"])
def test_a_silent_mistake_is_found(frame: str, mistake: str, request: pytest.FixtureRequest) -> None:
    make, message = MISTAKES[mistake]
    report = check(make(request.getfixturevalue(frame)))
    assert not report.ok and any(re.search(message, str(finding)) for finding in report.findings), report
    assert all(finding.fix for finding in report.findings)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (at_the_bottom, "boxes half below the road; add half the height"),
        (wider, "Swap columns 3 and 4"),
        (higher, "Reorder"),
        (at_the_top, "half a height over the road; subtract half the height"),
        (in_camera("boxes_3d"), "m over it: boxes in the frame of camera"),
        (moved("boxes_3d", np.eye(3), (0.9, 0.0, -1.84)), "1.8 m lower; are they in the LiDAR's frame"),
        (moved("boxes_3d", np.eye(3), (0.0, 0.0, 2.6)), "m higher; are they in the LiDAR's frame"),
    ],
)
def test_boxes_alone_tell(make: Any, message: str, street: Sample, nuscenes: Sample) -> None:
    for right in (street, nuscenes):
        assert message in str(check(without("points")(make(right))))


def test_points_on_images_tell_of_single_cameras(street: Sample) -> None:
    swapped = street["images"][[1, 0, *range(2, len(street["images"]))]]
    first, *others = check({**street, "images": swapped}).findings
    assert "fit that of" in first.found and first.fix == "are the images in another order?", others
    right = street_sample(seed=0)
    (finding,) = check(second_camera(turn(np.transpose))(right)).findings
    assert finding.fix == "transpose cam2ego[:3, :3]" and right["rig"].names[1] in finding.where


def test_the_road_alone_tells_points_of_the_lidar(street: Sample, nuscenes: Sample) -> None:
    for right in (street, nuscenes):
        report = str(check(without("boxes_3d")(lidar_frame(90)(right))))
        assert report.startswith("points: ") and "LiDAR's frame" in report


@pytest.mark.parametrize("yaw_deg", [0, 17, 45, pytest.param(90, marks=pytest.mark.slow)])
def test_right_labels_have_no_findings(yaw_deg: float) -> None:
    """Jittered as labels are, and with few points and boxes."""
    for seed in (0, 3):
        rng, sample = np.random.default_rng(seed), turned(street_sample(seed=seed), yaw_deg)
        if yaw_deg > 60:  # cameras called front would look aside
            unnamed = [replace(camera, name=f"camera {k}") for k, camera in enumerate(sample["rig"])]
            sample["rig"] = sample["rig"].with_cameras(unnamed)
        assert check(sample).ok, check(sample)
        boxes = sample["boxes_3d"].clone()
        jitter = np.zeros(boxes.shape)
        jitter[:, :7] = rng.normal(0, [0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.05], (len(boxes), 7))
        shares = {"points": 0.3, "boxes_3d": 0.4}
        few = {key: sample[key][rng.random(len(sample[key])) < share] for key, share in shares.items()}
        for changes in ({"boxes_3d": boxes + torch.from_numpy(jitter).to(boxes.dtype)}, few, {"points": None}):
            assert check({**sample, **changes}).ok, check({**sample, **changes})


def test_the_right_sample_is_silent(street: Sample) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RigRetarget(street["rig"].turned(yaw_deg=10))(street)
    assert check(street).ok


def test_sides_and_yaw_that_are_both_swapped_are_the_same_boxes(street: Sample) -> None:
    assert check(yaws(lambda yaw: yaw + torch.pi / 2)(wider(street))).ok


@pytest.mark.slow
def test_given_frames_have_no_false_finding(data_root: Path) -> None:
    """Specks in DDAD's masks are there, and so is the rim of three of four fisheye images."""
    for name in ("nuscenes-one", "ddad-one", "kitti-stereo", "surround-fisheye", "pandaset"):
        if not (data_root / name).is_dir():
            pytest.skip(f"no frame {name} in {data_root}")
        frames = FrameFolder(data_root / name, reduce=2)
        for k in range(0, len(frames), 4):
            wheres = {finding.where for finding in check(frames[k]).findings}
            kind = {"ddad-one": "mask", "surround-fisheye": "image"}.get(name)
            assert len(wheres) == {"mask": 5, "image": 3, None: 0}[kind], wheres
            assert all(where.endswith(f": {kind}") for where in wheres)
        sample = frames[0]
        assert check({**sample, "rig": cleaned_rig(sample["rig"], sample["images"])}).ok
    assert check(open_data(f"nuscenes:{data_root / 'nuscenes-one'}", reduce=4)[0]).ok


def test_a_batch_is_checked_frame_by_frame(street: Sample) -> None:
    boxes_3d = [street["boxes_3d"], yaws(torch.rad2deg)(street)["boxes_3d"]]
    batch = {"images": torch.stack([street["images"]] * 2), "rig": street["rig"], "boxes_3d": boxes_3d}
    (finding,) = check(batch).findings
    assert "radians" in finding.expected
    sample = without("rig", "K", "cam2ego")(street)  # a rig may be given apart
    assert check(sample, street["rig"]).ok
    with pytest.raises(SampleError, match="expected calibration"):
        check(sample)


def test_the_report_is_plain_data() -> None:
    finding = Finding("points", "metres", "feet", "convert them")
    assert str(CheckReport((finding,))) == str(finding) == "points: expected metres, found feet; convert them"
    assert str(CheckReport()) == "no findings" and CheckReport().ok and not CheckReport((finding,)).ok


def test_the_road_is_unknown_without_points_around_the_car(street: Sample) -> None:
    assert road_height_m(np.zeros((0, 3))) is None
    around = np.random.default_rng(0).uniform((-9, -9, 1.98), (9, 9, 2.02), (5000, 3))
    assert road_height_m(around) == pytest.approx(2.0, abs=0.03)
    ahead = street["points"][street["points"][:, 0] > 7]  # the boxes' points still tell their yaw
    assert road_height_m(ahead.numpy()) is None
    assert check({**street, "points": ahead}).ok
    assert "pass -yaw" in str(check(yaws(lambda yaw: -yaw)({**street, "points": ahead})))


def test_one_camera_elsewhere(street: Sample) -> None:
    first, *others = street["rig"]
    for wrong in (first.shifted(x_m=1500.0), first.shifted(z_m=-2.0)):
        (finding,) = check_rig(Rig([wrong, *others]))
        assert finding.where == "camera 'front': cam2ego" and "its inverse" in finding.fix


def test_a_rig_of_heights_that_no_vehicle_has(street: Sample) -> None:
    rig = Rig(list(street["rig"]), ground_z_m=2.0)
    (finding,) = check_rig(rig)
    assert "ground_z_m is the road's height" in finding.fix
    on_its_side = rig.with_cameras([camera.turned(roll_deg=90) for camera in street["rig"]])
    assert all("rolled by" in finding.found for finding in check_rig(on_its_side)[: len(rig)])


def pattern(camera: Camera, seed: int = 0) -> torch.Tensor:
    """The camera's image (3, h, w) of a blurred noise far away."""
    noise = np.random.default_rng(seed).uniform(0, 255, (256, 1024)).astype(np.float32)
    sky = cv2.GaussianBlur(noise, (0, 0), 2) * 6 - 640
    x, y, z = np.moveaxis(camera.unproject(camera.pixel_grid()).directions, -1, 0)
    u, v = (np.arctan2(y, x) / np.pi + 1) * 512, (np.arcsin(z) / np.pi + 0.5) * 256
    gray = cv2.remap(sky, u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
    return torch.from_numpy(gray.clip(0, 190).astype(np.uint8)).expand(3, -1, -1).contiguous()


@pytest.mark.parametrize(("yaw_deg", "pitch_deg"), [(0, 0), (0, 2.5), (-2.5, 0)])
def test_neighbours_that_disagree(yaw_deg: float, pitch_deg: float) -> None:
    looking = {"width_px": 400, "height_px": 240, "horizontal_fov_deg": 80}
    rig = Rig([Camera.looking(name=name, azimuth_deg=a, **looking) for name, a in (("front", 0), ("front_left", 40))])
    images = torch.stack([pattern(camera) for camera in rig])
    first = rig[0].turned(yaw_deg=yaw_deg, pitch_deg=pitch_deg)
    findings = check({"images": images, "rig": rig.with_cameras([first, rig[1]])}).findings
    if not yaw_deg and not pitch_deg:
        assert not findings
    else:
        (finding,) = findings
        assert finding.where == "cameras 'front' and 'front_left'" and "calibrate them again" in finding.fix
        assert float(finding.found.split()[0]) == pytest.approx(2.5, abs=0.3)


@pytest.mark.parametrize(("step_m", "masked"), [(3.0, False), (0.0, False), (3.0, True)])
def test_the_own_car_in_images_of_a_moving_vehicle(step_m: float, masked: bool) -> None:
    """A bonnet that stays in every frame; none where the vehicle stands, or a mask hides it."""
    mask = np.ones((96, 160), bool)
    mask[66:] = False
    camera = Camera.looking(
        name="front", azimuth_deg=0, width_px=160, height_px=96, horizontal_fov_deg=90, mask=mask if masked else None
    )
    images = torch.stack([pattern(camera, seed if step_m else 0)[None] for seed in range(4)])
    images[..., 70:, 20:] = 255
    ego2world = torch.eye(4).repeat(4, 1, 1)
    ego2world[:, 0, 3] = step_m * torch.arange(4)
    findings = check({"images": images, "rig": Rig([camera]), "ego2world": ego2world}).findings
    assert [finding.where for finding in findings] == ["camera 'front': mask"] * (step_m > 0 and not masked)
    assert all(re.search(r"about 2\d% of the image", finding.found) for finding in findings)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("target", ["waymo", "fisheye_surround"])
def test_what_was_retargeted_has_no_findings(target: str) -> None:
    for holes in ("continue", "black"):
        out = RigRetarget(load_rig(target).resized(0.1), geometry="street", holes=holes)(street_sample(seed=0))
        assert check(out).ok, check(out)


SAID = {  # of rendering: by an error over the street, else by a warning
    "ROS axes": "ROS.*multiply cam2ego",
    "inverted cam2ego": r"ego2cam, the inverse: pass np\.linalg\.inv",
    "K in millimetres": "camera 'front': K: .*millimetres",
    "gt_boxes": "gt_boxes: .*did you mean boxes_3d",
}


@pytest.mark.parametrize("mistake", SAID)
def test_rendering_names_the_fix(mistake: str, street: Sample) -> None:
    wrong, said = MISTAKES[mistake][0](street), {"match": SAID[mistake]}
    if mistake == "ROS axes":
        with pytest.raises(SampleError, **said):
            RigRetarget("waymo", size=(32, 64), geometry="street")(wrong)
    else:
        with pytest.warns(UserWarning, **said):
            RigRetarget("waymo", size=(32, 64))(wrong)


def test_every_misnamed_key_is_said(street: Sample) -> None:
    wrong = {**street, "gt_boxes": street["boxes_3d"], "boxes3d": street["boxes_3d"]}
    del wrong["boxes_3d"]
    with pytest.warns(UserWarning, match="did you mean boxes_3d") as said:
        RigRetarget(street["rig"])(wrong)
    messages = " ".join(str(warning.message) for warning in said)
    assert "gt_boxes: " in messages and "boxes3d: " in messages


def test_a_pose_that_is_none_tells_nothing(street: Sample) -> None:
    for pose in (torch.zeros(4, 4), torch.full((4, 4), float("nan")), torch.eye(3)):
        assert check({**street, "ego2world": pose}).findings == check({**street, "ego2world": None}).findings


@pytest.mark.parametrize("order", [[1, 2, 3, 0], [3, 0, 1, 2]])
@pytest.mark.parametrize("azimuth_deg", [35, 55, 75])
def test_quaternions_of_a_pair_that_look_steeply_when_misread(azimuth_deg: float, order: list[int]) -> None:
    cameras = [
        Camera.looking(
            name=name, azimuth_deg=azimuth, position_m=(1.5, azimuth / 100, 1.5), width_px=64, height_px=48,
            horizontal_fov_deg=60,
        )
        for name, azimuth in (("front", 0), ("front_left", azimuth_deg))
    ]  # fmt: skip
    assert not doubts(cameras, 0.0)
    poses = [camera.cam2ego.copy() for camera in cameras]
    for pose in poses:
        pose[:3, :3] = rotation_from_quaternion(quaternion_from_rotation(pose[:3, :3])[order])
    wrong = [replace(camera, cam2ego=pose) for camera, pose in zip(cameras, poses, strict=True)]
    assert any("quaternion" in finding.found for finding in doubts(wrong, 0.0))
