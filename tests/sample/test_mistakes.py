"""``check`` finds every silent mistake, and nothing in right samples; errors and warnings name the others."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import (
    Camera,
    CheckReport,
    Finding,
    Rig,
    RigRetarget,
    SampleError,
    check,
    load_rig,
    shipped_rigs,
)
from arbiview_aug.datasets import FrameFolder, cleaned_rig, open_data
from arbiview_aug.sample.label_mistakes import road_height_m
from arbiview_aug.sample.mistakes import check_rig
from tests.helpers import street_sample
from tests.sample.mistakes import (
    MISTAKES,
    Sample,
    at_the_bottom,
    at_the_top,
    columns,
    in_camera,
    lidar_frame,
    moved,
    swapped_images,
    turn,
    turned,
    without,
    yaws,
)


@lru_cache
def right_street(seed: int = 0) -> Sample:
    return street_sample(seed=seed)


@pytest.fixture(scope="module")
def street() -> Sample:
    """In a turned frame: along its axes, some conventions of yaw agree."""
    return turned(right_street(), 30)


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
        (columns([0, 1, 2, 4, 3, 5, 6]), "Swap columns 3 and 4"),
        (columns([0, 1, 2, 5, 4, 3, 6]), "Reorder"),
        (yaws(torch.rad2deg), "deg2rad"),
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
    first, *others = check(swapped_images(street)).findings
    assert "fit that of" in first.found and first.fix == "are the images in another order?", others
    for k in (1, 2):
        wrong = list(right_street()["rig"])
        wrong[k] = replace(wrong[k], cam2ego=turn(np.transpose)(wrong[k].cam2ego))
        (finding,) = check({**right_street(), "rig": Rig(wrong)}).findings
        assert finding.fix == "transpose cam2ego[:3, :3]" and wrong[k].name in finding.where


def test_the_road_alone_tells_points_of_the_lidar(street: Sample, nuscenes: Sample) -> None:
    for right in (street, nuscenes):
        report = str(check(without("boxes_3d")(lidar_frame(90)(right))))
        assert report.startswith("points: ") and "LiDAR's frame" in report


@pytest.mark.parametrize("yaw_deg", [0, 17, 45, pytest.param(90, marks=pytest.mark.slow)])
def test_right_labels_have_no_findings(yaw_deg: float) -> None:
    """Jittered as labels are, and with few points and boxes."""
    for seed in (0, 3):
        rng, sample = np.random.default_rng(seed), turned(right_street(seed), yaw_deg)
        if yaw_deg > 60:  # cameras called front would look aside
            unnamed = [replace(camera, name=f"camera {k}") for k, camera in enumerate(sample["rig"])]
            sample["rig"] = sample["rig"].with_cameras(unnamed)
        assert check(sample).ok, check(sample)
        boxes = sample["boxes_3d"].clone()
        jitter = np.zeros(boxes.shape)
        jitter[:, :7] = rng.normal(0, [0.1, 0.1, 0.1, 0.05, 0.05, 0.05, 0.05], (len(boxes), 7))
        few = {
            "points": sample["points"][rng.random(len(sample["points"])) < 0.3],
            "boxes_3d": boxes[rng.random(len(boxes)) < 0.4],
        }
        for changes in ({"boxes_3d": boxes + torch.from_numpy(jitter).to(boxes.dtype)}, few, {"points": None}):
            assert check({**sample, **changes}).ok, check({**sample, **changes})


def test_the_right_sample_is_silent(street: Sample) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RigRetarget(street["rig"].turned(yaw_deg=10))(street)
    assert check(street).ok


def test_sides_and_yaw_that_are_both_swapped_are_the_same_boxes(street: Sample) -> None:
    swapped = yaws(lambda yaw: yaw + torch.pi / 2)(columns([0, 1, 2, 4, 3, 5, 6])(street))
    assert check(swapped).ok


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


def test_shipped_rigs_have_no_findings() -> None:
    for name in shipped_rigs():
        assert check_rig(load_rig(name)) == []


def test_a_batch_is_checked_frame_by_frame(street: Sample) -> None:
    wrong = yaws(torch.rad2deg)(street)
    batch = {
        "images": torch.stack([street["images"]] * 2),
        "rig": street["rig"],
        "boxes_3d": [street["boxes_3d"], wrong["boxes_3d"]],
    }
    (finding,) = check(batch).findings
    assert "radians" in finding.expected


def test_a_rig_may_be_given_apart(street: Sample) -> None:
    sample = without("rig", "K", "cam2ego")(street)
    assert check(sample, street["rig"]).ok
    with pytest.raises(SampleError, match="expected calibration"):
        check(sample)


def test_the_report_is_plain_data() -> None:
    finding = Finding("points", "metres", "feet", "convert them")
    assert str(CheckReport((finding,))) == str(finding) == "points: expected metres, found feet; convert them"
    assert str(CheckReport()) == "no findings" and CheckReport().ok and not CheckReport((finding,)).ok
    with pytest.raises(AttributeError):
        finding.fix = ""  # type: ignore[misc]


def test_the_road_is_unknown_without_points_around_the_car() -> None:
    rng = np.random.default_rng(0)
    assert road_height_m(np.zeros((0, 3))) is None
    ahead = rng.uniform((5, -2, -0.02), (9, 2, 0.02), (5000, 3))
    assert road_height_m(ahead) is None
    around = rng.uniform((-9, -9, 1.98), (9, 9, 2.02), (5000, 3))
    assert road_height_m(around) == pytest.approx(2.0, abs=0.03)


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


# --- several images ---------------------------------------------------------------------------------------------------
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
@pytest.mark.parametrize("target", ["waymo", "fisheye_surround"])
def test_what_was_retargeted_has_no_findings(target: str) -> None:
    rig = load_rig(target)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for holes in ("continue", "black"):
            out = RigRetarget(rig.resized(0.1), geometry="street", holes=holes)(right_street())
            assert check(out).ok, check(out)


def test_points_of_a_lidar_that_looks_ahead_alone(street: Sample) -> None:
    """The road is unknown, but the boxes' points still tell their yaw."""
    ahead = street["points"][street["points"][:, 0] > 7]
    assert road_height_m(ahead.numpy()) is None
    assert check({**street, "points": ahead}).ok
    assert "pass -yaw" in str(check(yaws(lambda yaw: -yaw)({**street, "points": ahead})))


# --- mistakes that warnings name; those that errors name: test_inputs -------------------------------------------------
WARNINGS: dict[str, tuple[Callable[[Sample], Sample], str]] = {
    "an inverted cam2ego": (MISTAKES["inverted cam2ego"][0], r"ego2cam, the inverse: pass np\.linalg\.inv"),
    "K in millimetres": (MISTAKES["K in millimetres"][0], "camera 'front': K: .*millimetres"),
    "boxes as gt_boxes": (MISTAKES["gt_boxes"][0], "gt_boxes.*did you mean 'boxes_3d'"),
}


@pytest.mark.parametrize(
    ("mistake", "message"), [("ROS axes", "ROS.*multiply cam2ego"), ("millimetres", "millimetres: divide")]
)
def test_an_error_names_the_fix(mistake: str, message: str, street: Sample) -> None:
    with pytest.raises(SampleError, match=message):
        RigRetarget("waymo", size=(32, 64), geometry="street")(MISTAKES[mistake][0](street))


@pytest.mark.parametrize("mistake", WARNINGS)
def test_a_warning_names_the_fix(mistake: str, street: Sample) -> None:
    make, message = WARNINGS[mistake]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        RigRetarget("waymo", size=(32, 64))(make(street))
    assert any(re.search(message, str(warning.message)) for warning in told), list(map(str, told))
