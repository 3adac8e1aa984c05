"""Files of many tools: what is read, what is refused by name, and what a rig's cameras are judged by."""

from __future__ import annotations

import json
import os
import warnings
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from arbiview_aug import Camera, Rig, load_rig, save_rig
from arbiview_aug.cameras.rotations import quaternion_from_rotation, rotation_from_quaternion
from arbiview_aug.cameras.shipped import shipped_rigs
from arbiview_aug.cameras.validation import doubts
from arbiview_aug.errors import CalibrationError
from tests.helpers import camera
from tests.cameras.test_calibrations import (
    CAMCHAIN,
    CAMERA_INFO,
    CAMERAS_TXT,
    COLMAP_MOUNTING,
    FORWARD,
    IMAGES_TXT,
    OPENCV_YAML,
    ROWS,
    TF_STATIC,
    nuscenes_tables,
    written,
)

K = [[500.0, 0.0, 320.0], [0.0, 501.0, 240.0], [0.0, 0.0, 1.0]]
BENT = [-0.2, 0.05, 0.001, -0.002, 0.0]
FOUR = [0.05, 0.03, -0.03, 0.016]
SIZE = {"image_width": 640, "image_height": 480}
IDENTITY = np.eye(3).tolist()
TURNED = [[1.0, 0.01, 0.0], [-0.01, 1.0, 0.0], [0.0, 0.0, 1.0]]
INFO = {"header": {"frame_id": "front_optical_frame"}, "width": 640, "height": 480, "k": np.ravel(K).tolist()}
MEI = {
    "model_type": "MEI",
    "mirror_parameters": {"xi": 2.0},
    "projection_parameters": {"gamma1": 900.0, "gamma2": 900.0, "u0": 320.0, "v0": 240.0},
}


def mounted(folder: Path, **files: Any) -> Path:
    """A folder with files, JSON where they are no text, and poses of the cameras that tests have."""
    poses = {"front": FORWARD.tolist(), "cam0": FORWARD.tolist(), "camera_0": FORWARD.tolist()}
    texts = {name: one if isinstance(one, str) else json.dumps(one) for name, one in files.items()}
    used = {
        name: pose
        for name, pose in poses.items()
        if name in json.dumps(files) or name in texts or f"{name}__json" in texts
    }
    return written(folder, **texts, mounting__yaml=json.dumps({"poses": used}))


# --- one camera: data of a file, then the lens and coefficients, or the message -----------------------------------------
READ: dict[str, tuple[dict[str, Any], str, tuple[float, ...]]] = {
    "Python, dist_coeffs": ({"camera_matrix": K, "dist_coeffs": [BENT], **SIZE}, "radtan", tuple(BENT)),
    "Python, dist_coeff": ({"camera_matrix": K, "dist_coeff": [[k] for k in BENT], "image_size": [640, 480]}, "radtan", tuple(BENT)),
    "mtx, dist, shape": ({"mtx": K, "dist": [BENT], "image_shape": [480, 640, 3]}, "radtan", tuple(BENT)),
    "K, D, DIM": ({"K": K, "D": [[k] for k in FOUR], "DIM": [640, 480]}, "fisheye", tuple(FOUR)),
    "marked fisheye": ({"K": K, "D": FOUR, "fisheye": True, "resolution": "640x480"}, "fisheye", tuple(FOUR)),
    "equidistant": ({"K": K, "D": FOUR, "distortion_model": "Equidistant", **SIZE}, "fisheye", tuple(FOUR)),
    "KANNALA_BRANDT": ({"K": K, "D": FOUR, "camera_model": "KANNALA_BRANDT", **SIZE}, "fisheye", tuple(FOUR)),
    "four of radtan": ({"K": K, "D": FOUR, "distortion_model": "plumb_bob", **SIZE}, "radtan", tuple(FOUR)),
    "pinhole, radtan": ({"K": K, "D": FOUR, "camera_model": "pinhole", "distortion_model": "radtan", **SIZE}, "radtan", tuple(FOUR)),
    "k1 by name": ({"fx": 500.0, "fy": 501.0, "cx": 320.0, "cy": 240.0, "k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002, "w": 640, "h": 480}, "radtan", tuple(BENT[:4]) + (0.0,) * 4),
    "no distortion, Plumb Bob": ({**INFO, "d": [0.0] * 5, "distortion_model": "Plumb Bob"}, "pinhole", ()),
    "empty model": ({**INFO, "d": [], "distortion_model": ""}, "pinhole", ()),
    "no model": ({**INFO, "d": [0.0] * 5, "distortion_model": "none"}, "pinhole", ()),
    "Foxglove": ({**SIZE, "K": np.ravel(K).tolist(), "D": BENT, "R": np.ravel(IDENTITY).tolist(), "P": [*K[0], 0.0, *K[1], 0.0, *K[2], 0.0], "distortion_model": "plumb_bob", "frame_id": "front", "timestamp": {"sec": 1}}, "radtan", tuple(BENT)),
    "zeros of a simulator": ({**INFO, "d": [], "r": [0.0] * 9, "p": [0.0] * 12, "binning_x": 1, "roi": {"width": 640, "height": 480}}, "pinhole", ()),
    "DAIR-V2X": ({"cam_K": np.ravel(K).tolist(), "cam_D": BENT, "width": 640, "height": 480, "distortion_model": "plumb_bob"}, "radtan", tuple(BENT)),
    "Autoware.AI": ({"CameraExtrinsicMat": IDENTITY, "CameraMat": K, "DistCoeff": [BENT], "ImageSize": [640, 480], "ReprojectionError": 0.3, "DistModel": "plumb_bob"}, "radtan", tuple(BENT)),
    "CamOdoCal": ({"model_type": "KANNALA_BRANDT", **SIZE, "projection_parameters": {"k2": 0.05, "k3": 0.03, "k4": -0.03, "k5": 0.016, "mu": 500.0, "mv": 501.0, "u0": 320.0, "v0": 240.0}}, "fisheye", tuple(FOUR)),
    "rectified, as K says": ({"K": K, "rectified": True, "undistorted": True, **SIZE}, "pinhole", ()),
    "neutral keys": ({"K": K, "D": BENT, "date": "today", "avg_reprojection_error": 0.3, "flags": 0, "square_size": 2.5, "extrinsic_parameters": [[1.0]], "skew": 0.0, "scale": 1, "aspectRatio": 1.0, **SIZE}, "radtan", tuple(BENT)),
    "thin prism of zeros": ({"K": K, "D": [*BENT, *[0.0] * 9], "distortion_model": "rational_polynomial", **SIZE}, "radtan", (*BENT, 0.0, 0.0, 0.0)),
}  # fmt: skip
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "four, unmarked": ({"K": K, "D": FOUR, **SIZE}, "a lens for its coefficients, got .*write distortion_model: plumb_bob"),
    "unknown model": ({"K": K, "D": FOUR, "distortion_model": "thin_prism_fisheye", **SIZE}, "distortion_model: expected plumb_bob"),
    "inverse": ({"K": K, "D": BENT, "model": "inverse_brown_conrady", **SIZE}, "model: expected plumb_bob"),
    "two models": ({"K": K, "D": FOUR, "model": "fisheye", "distortion_model": "radtan", **SIZE}, "expected one lens, got fisheye and radtan"),
    "none, bent": ({"K": K, "D": BENT, "distortion_model": "none", **SIZE}, "a lens for its coefficients"),
    "empty, bent": ({**INFO, "d": BENT, "distortion_model": ""}, "a lens for its coefficients"),
    "thin prism": ({"K": K, "D": [*BENT, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0], **SIZE}, r"at most 8 coefficients of radtan, got 12 \(thin prism"),
    "five of fisheye": ({"K": K, "D": [*FOUR, 0.1], "fisheye_model": 1, **SIZE}, "at most 4 coefficients of fisheye, got 5"),
    "R": ({**INFO, "d": BENT, "distortion_model": "plumb_bob", "r": np.ravel(TURNED).tolist()}, "r: expected the identity.*for rectified ones write the left 3x3"),
    "P": ({**INFO, "d": [], "p": [400.0, 0, 320, 0, 0, 400, 240, 0, 0, 0, 1, 0]}, "p: expected the camera matrix, got .* without distortion"),
    "binning": ({**INFO, "d": [], "binning_x": 2}, "full images, got binning"),
    "window": ({**INFO, "d": [], "roi": {"x_offset": 5, "width": 0, "height": 0}}, "full images, got binning or a region of interest"),
    "two sizes": ({"K": K, "D": BENT, **SIZE, "dim": [1280, 960]}, "expected one size"),
    "no size": ({"K": K, "D": BENT, "image_width": 0, "image_height": 0}, "how large are its images"),
    "two matrices": ({"K": K, "camera_matrix": K, **SIZE}, "one key of each kind, got K and camera_matrix"),
    "skew": ({"fx": 500.0, "fy": 500.0, "cx": 320.0, "cy": 240.0, "skew": 0.3, **SIZE}, "got 'skew': 0.3"),
    "rectified, bent": ({"K": K, "D": BENT, "rectified": True, **SIZE}, "got 'rectified': True"),
    "undistorted matrix": ({"K": K, "D": BENT, "new_camera_matrix": TURNED, **SIZE}, "got 'new_camera_matrix'"),
    "crop": ({"K": K, "D": BENT, "crop": [0, 60, 640, 360], **SIZE}, "got 'crop'"),
    "scale": ({"K": K, "D": BENT, "scale": 0.5, **SIZE}, "got 'scale': 0.5"),
    "units": ({"K": K, "D": BENT, "units": "mm", **SIZE}, "got 'units': 'mm'"),
    "column-major": ({"K": K, "D": BENT, "storage_order": "column", **SIZE}, "got 'storage_order'"),
    "MEI, bent": ({**MEI, **SIZE, "distortion_parameters": {"k1": 0.1, "k2": 0.0, "p1": 0.0, "p2": 0.0}}, "MEI.*undistort the images"),
    "K of text": ({"K": "as above", "D": BENT, **SIZE, "camera_matrix": [[1, 2]]}, "K|camera_matrix|recognised"),
    "ragged": ({"camera_matrix": [[1, 2], [3]], **SIZE}, "camera_matrix: expected a matrix or list of numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_read(tmp_path: Path, name: str) -> None:
    data, lens, coefficients = READ[name]
    for files in ({"front__json": data}, {"front__json": [data]}, {"front__yaml": json.dumps(data)}):
        folder = tmp_path / str(len(os.listdir(tmp_path)))
        folder.mkdir()
        for path in (mounted(folder, **files), next(folder.glob("front.*"))):
            (front,) = load_rig(path)
            assert (front.name, front.lens, front.size) == ("front", lens, (480, 640))
            np.testing.assert_allclose(front.distortion[: len(coefficients)], coefficients, rtol=1e-12)
            assert front.K.tolist() == K


@pytest.mark.parametrize("name", REFUSED)
def test_refused_by_name(tmp_path: Path, name: str) -> None:
    data, message = REFUSED[name]
    with pytest.raises(CalibrationError, match=message):
        load_rig(mounted(tmp_path, front__json=data))


def test_a_unified_camera_without_distortion_is_an_eucm(tmp_path: Path) -> None:
    """Geyer's and Mei's model: (x, y) / (z + ξ d)."""
    kalibr = {
        "cam0": {
            "camera_model": "omni",
            "distortion_model": "radtan",
            "distortion_coeffs": [0.0] * 4,
            "intrinsics": [2.0, 900.0, 900.0, 320.0, 240.0],
            "resolution": [640, 480],
        }
    }
    (omni,) = load_rig(mounted(tmp_path, camchain__yaml=kalibr))
    assert omni.lens == "eucm"
    x, y, z = np.random.default_rng(0).normal([0, 0, 2], 0.7, (100, 3)).T
    divisor = z + 2.0 * np.sqrt(x * x + y * y + z * z)
    uv = np.stack([900 * x / divisor + 320, 900 * y / divisor + 240], -1)
    np.testing.assert_allclose(omni.project_cam(np.stack([x, y, z], -1)).uv, uv, atol=1e-9)


def test_woodscapes_polynomial_is_an_ftheta(tmp_path: Path) -> None:
    R = FORWARD[:3, :3]
    w, *xyz = quaternion_from_rotation(R).tolist()
    intrinsic = {
        "aspect_ratio": 1.1,
        "cx_offset": 3.9,
        "cy_offset": -3.1,
        "height": 966.0,
        "width": 1280.0,
        "k1": 339.7,
        "k2": -31.99,
        "k3": 48.27,
        "k4": -7.2,
        "model": "radial_poly",
        "poly_order": 4,
    }
    data = {
        "extrinsic": {"quaternion": [*xyz, w], "translation": [1.5, 0.2, 1.6]},
        "intrinsic": intrinsic,
        "name": "FV",
    }
    (front,) = load_rig(written(tmp_path, FV__json=json.dumps(data)))
    np.testing.assert_allclose(front.cam2ego, FORWARD, atol=1e-12)
    theta = 1.2
    r = 339.7 * theta - 31.99 * theta**2 + 48.27 * theta**3 - 7.2 * theta**4
    uv = front.project_cam(np.array([[np.sin(theta), 0, np.cos(theta)], [0, np.sin(theta), np.cos(theta)]])).uv
    np.testing.assert_allclose(uv, [[639.5 + 3.9 + r, 482.5 - 3.1], [639.5 + 3.9, 482.5 - 3.1 + 1.1 * r]])
    data["intrinsic"] = {**intrinsic, "k5": 1.0}
    with pytest.raises(CalibrationError, match="camera 'FV': expected intrinsic .*, got k5"):
        load_rig(written(tmp_path, FV__json=json.dumps(data)))


@pytest.mark.parametrize(
    ("model", "numbers", "lens", "coefficients"),
    [
        ("EUCM", "500 500 320 240 0.6 1.1", "eucm", (0.6, 1.1)),
        ("SIMPLE_FISHEYE", "500 320 240", "fisheye", (0.0,) * 4),
        ("THIN_PRISM_FISHEYE", "500 500 320 240 .1 .2 0 0 .3 .4 0 0", "fisheye", (0.1, 0.2, 0.3, 0.4)),
        ("THIN_PRISM_FISHEYE", "500 500 320 240 .1 .2 0 0 .3 .4 .1 0", "", "with p1, p2, sx1 and sy1 of 0, got"),
        ("SIMPLE_DIVISION", "500 320 240 -0.1", "", "camera model: expected SIMPLE_PINHOLE, .*, got SIMPLE_DIVISION; undistort"),
    ],
)  # fmt: skip
def test_newer_models_of_colmap(tmp_path: Path, model: str, numbers: str, lens: str, coefficients: Any) -> None:
    cameras = CAMERAS_TXT.replace("SIMPLE_RADIAL 640 480 500.5 320 240 -0.05", f"{model} 640 480 {numbers}")
    written(tmp_path, cameras__txt=cameras, images__txt=IMAGES_TXT, mounting__yaml=COLMAP_MOUNTING)
    if not lens:
        with pytest.raises(CalibrationError, match=coefficients):
            load_rig(tmp_path)
        return
    assert (load_rig(tmp_path)["left"].lens, load_rig(tmp_path)["left"].distortion) == (lens, coefficients)


def test_poses_of_the_imu_alone(tmp_path: Path) -> None:
    chain = mounted(tmp_path, imucam_chain__yaml="%YAML:1.0\n---\n" + CAMCHAIN.replace("T_cn_cnm1", "T_cam_imu"))
    text = (chain / "imucam_chain.yaml").read_text()
    with pytest.raises(CalibrationError, match="T_cam_imu of all cameras, got neither"):
        load_rig(chain)
    own = "cam0:\n  T_cam_imu: [[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    (chain / "imucam_chain.yaml").write_text(text.replace("cam0:\n", own, 1))
    rig = load_rig(chain)
    np.testing.assert_allclose(rig[1].center_m, FORWARD[:3] @ [0.5, 0, 0, 1])  # 0.2 and 0.3 m to the right of the IMU


@pytest.mark.parametrize(
    ("row", "lens"),
    [
        ({"camera_distortion": BENT}, "radtan"),
        ({"camera_distortion": []}, "pinhole"),
        ({"camera_distortion": FOUR, "camera_model": "equidistant"}, "fisheye"),
        ({"camera_distortion": FOUR}, "write distortion_model"),
        ({"camera_distortion": BENT, "rectification_matrix": TURNED}, "expected the identity"),
    ],
)
def test_lenses_of_nuscenes_like_tables(tmp_path: Path, row: dict[str, Any], lens: str) -> None:
    path = nuscenes_tables(tmp_path) / "calibrated_sensor.json"
    first, *others = json.loads(path.read_text())
    path.write_text(json.dumps([{**first, **row}, *others]))
    if " " in lens:
        with pytest.raises(CalibrationError, match=lens):
            load_rig(path)
    else:
        assert load_rig(path)[0].lens == lens


# --- folders and files ------------------------------------------------------------------------------------------------
ELSEWHERE = {
    "other__json": (
        json.dumps({"cam_front": {"intrinsic_param": [1.0]}}),
        r"other.json \(a calibration that is not recog",
    ),
    "left__npz": ("PK mtx.npy dist.npy", r"left.npz \(a calib"),
    "broken__yaml": ("camera_matrix: [1, 2", r"broken.yaml \(expected plain YAML"),
    "orb__yaml": ("%YAML:1.0\nCamera.fx: 1.0\n", r"orb.yaml \(ORB-SLAM"),
    "nerf__json": ('{"fl_x": 1.0}', r"nerf.json \(nerfstudio"),
}


@pytest.mark.parametrize("file", ELSEWHERE)
def test_a_camera_that_is_not_read_does_not_vanish(tmp_path: Path, file: str) -> None:
    text, message = ELSEWHERE[file]
    mounted(tmp_path, front__yaml=CAMERA_INFO)
    assert load_rig(tmp_path).names == ["front"]
    written(tmp_path, **{file: text})
    with pytest.raises(CalibrationError, match=f"ROS: expected cameras of one tool, got also {message}"):
        load_rig(tmp_path)


def test_other_files_of_a_folder_are_named(tmp_path: Path) -> None:
    mounted(
        tmp_path, front__yaml=CAMERA_INFO, front__ini="camera matrix", launch__yaml="a: 1", notes__txt="camera_matrix"
    )
    load_rig("waymo").save(tmp_path / "rig.json")
    with pytest.warns(UserWarning, match=r"ROS: not read: launch.yaml, rig.json$"):
        load_rig(tmp_path)


def test_names_of_files_where_the_cameras_share_one(tmp_path: Path) -> None:
    info = CAMERA_INFO.replace("camera_name: front", "camera_name: narrow_stereo")
    tf = TF_STATIC.replace("/left", "/left_optical_frame")
    assert load_rig(written(tmp_path, front__yaml=info, left__yaml=info, tf_static__yaml=tf)).names == ["front", "left"]
    two = [{**INFO, "d": [], "camera_name": "a"}, {**INFO, "d": [], "header": {"frame_id": "left_optical_frame"}}]
    (tmp_path / "left.yaml").unlink()
    assert load_rig(written(tmp_path, front__yaml=json.dumps(two))).names == ["a", "left"]


@pytest.mark.parametrize("encode", ["utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("text", [CAMERA_INFO, OPENCV_YAML, json.dumps({"K": K, **SIZE})])
def test_byte_order_marks_and_encodings(tmp_path: Path, encode: str, text: str) -> None:
    suffix = "json" if text[0] == "{" else "yaml"
    mounted(tmp_path, **{f"front__{suffix}": text})
    text = (
        text.replace("\n", "\r\n")
        if encode == "utf-8-sig"
        else f'{text[:-1]}, "of": "für"}}'
        if suffix == "json"
        else f"{text}# für"
    )
    (tmp_path / f"front.{suffix}").write_bytes(text.encode(encode))
    for path in (tmp_path, tmp_path / f"front.{suffix}"):
        if encode == "utf-8-sig":
            assert load_rig(path).names == ["front"]
        else:
            with pytest.raises(CalibrationError, match="in UTF-8, got another encoding.*: save it as UTF-8"):
                load_rig(path)


@pytest.mark.parametrize("name", ["front.yaml", "front.xml", "front.json", "mounting.yaml", "tf_static.yaml", "camchain.yaml", "images.txt", "images.bin", "cameras.bin", "intrinsics.feather", "calibrated_sensor.json", "alone.txt"])  # fmt: skip
@pytest.mark.parametrize("kind", ["pipe", "loop"])
@pytest.mark.timeout(20)
def test_special_files_are_refused(tmp_path: Path, name: str, kind: str) -> None:
    written(tmp_path, left__yaml=CAMERA_INFO)
    if kind == "pipe":
        os.mkfifo(tmp_path / name)
    else:
        (tmp_path / name).symlink_to(tmp_path / name)
    for path in (tmp_path, tmp_path / name):
        with pytest.raises((CalibrationError, ImportError)):
            load_rig(path)


@pytest.mark.parametrize("name", ["", "x" * 300, "a\0b", "a\ud800b"])
def test_names_that_no_file_has(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mounted(tmp_path, front__yaml=CAMERA_INFO)
    entry = {**Rig([camera()]).to_dict()["cameras"][0], "mask": name}
    with pytest.raises(CalibrationError, match="found neither"):
        load_rig(name)
    with pytest.raises(CalibrationError, match="mask: expected an image file"):
        load_rig(written(tmp_path, rig__json=json.dumps({"cameras": [entry]})) / "rig.json")
    if len(name) < 300:
        with pytest.raises(CalibrationError, match="expected"):
            save_rig("waymo", name, format="ros")
        with pytest.raises(CalibrationError, match="camera name: expected a non-empty string"):
            camera(name)


def test_masks_in_folders_that_are_not_utf8(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/f\xfcr"))
    folder.mkdir()
    rig = Rig([camera(mask=np.eye(72, 96) > 0)])
    assert load_rig(rig.save(folder / "rig.yaml")) == rig
    written(folder, front__yaml=CAMERA_INFO, mounting__yaml=f"poses: {{front: {ROWS}}}")
    load_rig(folder).save(tmp_path / "again.yaml")


# --- rig files --------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("top", "inner", "message"),
    [
        ({"lidar": [{}]}, {}, "'lidar' is not read: did you mean 'lidars'"),
        ({"Lidars": []}, {}, "'Lidars' is not read: did you mean 'lidars'"),
        ({"scanners": []}, {}, "'scanners' is not read: did you mean 'lidars'"),
        ({"lidars": {}}, {}, "lidars: expected a list"),
        ({"lidars": ""}, {}, "lidars: expected a list"),
        ({"extra": 1}, {}, "'extra' is not read: expected keys are cameras, dataset"),
        ({}, {"rectified": False}, "camera 'front': 'rectified' is not read"),
        ({}, {"ego2cam": []}, "'ego2cam' is not read"),
        ({}, {"mask": ""}, "mask: expected an image file"),
        ({}, {"distortion": []}, "distortion: expected null or"),
        ({}, {"distortion": {"model": "radtan", "coeffs": FOUR, "order": "k1,k2,k3,k4"}}, "order: expected k1 k2 p1 p2, got"),
        ({}, {"distortion": {"model": "radtan", "coeffs": FOUR, "xi": 2}}, "distortion: 'xi' is not read"),
        ({}, {"distortion": {"model": "radtan", "coeffs": FOUR}, "camera_model": "mei"}, "'camera_model' is not read"),
        ({}, {"distortion": {"model": "radtan", "coeffs": FOUR}, "lens": "equidistant"}, "'lens' is not read"),
    ],
)  # fmt: skip
def test_all_keys_of_a_rig_file_are_known(
    tmp_path: Path, top: dict[str, Any], inner: dict[str, Any], message: str
) -> None:
    data = Rig([camera()]).to_dict()
    data = {**data, **top, "cameras": [{**data["cameras"][0], **inner}]}
    with pytest.raises(CalibrationError, match=message):
        load_rig(written(tmp_path, rig__json=json.dumps(data)) / "rig.json")
    notes = {"_note": 1, "license": "MIT", "kind": "rig"}
    assert load_rig(written(tmp_path, rig__json=json.dumps({**Rig([camera()]).to_dict(), **notes})) / "rig.json")


# --- each camera judged -----------------------------------------------------------------------------------------------
AROUND = {"front": 0.0, "left": 90.0, "right": -90.0, "back": 180.0}


def turned(R: Any) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = R
    return pose


def judged(**poses: np.ndarray) -> list[str]:
    """Doubts of four cameras around the vehicle, some with other poses, multiplied from the right."""
    cameras = [
        camera(name, azimuth, position_m=(np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 1.5))
        for name, azimuth in AROUND.items()
    ]
    return doubts(
        [
            c
            if c.name not in poses
            else Camera(
                name=c.name,
                width_px=96,
                height_px=72,
                K=c.K,
                cam2ego=poses[c.name]
                if poses[c.name][2, 3]
                else turned(c.cam2ego[:3, :3] @ poses[c.name][:3, :3]) + np.pad(c.center_m[:, None], ((0, 1), (3, 0))),
            )
            for c in cameras
        ],
        0.0,
    )


BODY = turned([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])


def reordered(R: np.ndarray, order: tuple[int, ...]) -> np.ndarray:
    return rotation_from_quaternion(quaternion_from_rotation(R)[[*order]])


def test_sound_rigs_raise_no_doubt() -> None:
    assert not judged()
    for name in shipped_rigs():
        rig = load_rig(name)
        assert not doubts(rig.cameras, rig.ground_z_m)
    down = camera("down", elevation_deg=-90.0)
    assert not doubts([camera(), down, camera("stereo_left", 1.0), camera("rear_view_mirror")], 0.0)
    assert not doubts([camera("left", 2.0), camera("right", -2.0)], 0.0)  # a stereo pair


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("front", BODY, r"'front' looks up by 90 degrees \(it seems to have a body's axes"),
        ("left", BODY, "'left' looks up by 90 degrees .*body's axes"),
        ("left", turned(np.diag([-1.0, -1.0, 1.0])), r"'left' is rolled by -?180 degrees$"),
        ("left", turned(np.diag([1.0, -1.0, -1.0])), r"OpenGL's axes"),
        ("back", turned(np.diag([-1.0, 1.0, -1.0])), "'back' looks to .*0 degrees, unlike its name"),
    ],
)
def test_one_camera_of_several(name: str, change: np.ndarray, message: str) -> None:
    (said,) = judged(**{name: change})
    assert __import__("re").search(message, said), said


@pytest.mark.parametrize("order", [(1, 2, 3, 0), (3, 0, 1, 2)])
def test_quaternions_in_another_order(order: tuple[int, ...]) -> None:
    left = camera("left", 80.0, elevation_deg=-7.0)
    wrong = turned(reordered(left.cam2ego[:3, :3], order))
    wrong[:3, 3] = 0.1, 1.0, 1.5
    (said,) = judged(left=wrong)
    assert "its quaternion seems to be" in said


def test_mirrored_rigs_are_called_left_handed(tmp_path: Path) -> None:
    unreal = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    mirror = np.diag([1.0, -1, 1, 1])
    cameras = [
        camera(name, azimuth, position_m=(1, np.sin(np.radians(azimuth)), 1.5)) for name, azimuth in AROUND.items()
    ]
    for poses in (
        [mirror @ c.cam2ego @ np.linalg.inv(unreal) for c in cameras],
        [camera(c.name, -c.azimuth_deg).cam2ego for c in cameras],
    ):
        rig = Rig(
            [
                Camera(name=c.name, width_px=96, height_px=72, K=c.K, cam2ego=pose)
                for c, pose in zip(cameras, poses, strict=True)
            ]
        )
        with pytest.warns(UserWarning, match="left and right are swapped, as in left-handed axes"):
            load_rig(rig.save(tmp_path / "rig.yaml"))
    for axes, fix in (
        (mirror @ cameras[0].cam2ego, r"np.diag\(\[1, -1, 1, 1\]\) @"),
        (cameras[0].cam2ego @ mirror, "Unity"),
    ):
        with pytest.raises(CalibrationError, match=f"right-handed axes, got mirrored, left-handed.*{fix}"):
            Camera(name="a", width_px=96, height_px=72, K=cameras[0].K, cam2ego=axes)
    (said,) = doubts(
        [camera("left", 90.0, position_m=(0, -1, 1.5)), camera("right", -90.0, position_m=(0, 1, 1.5))], 0.0
    )
    assert "is y of the positions mirrored" in said


@pytest.mark.parametrize(
    ("size", "message"),
    [((36, 48), "96x72, not of 48x36"), ((96, 72), "not of 72x96"), ((144, 192), "96x72")],
)
def test_intrinsics_of_another_size(size: tuple[int, int], message: str) -> None:
    (said,) = doubts([camera(size=size, K=camera().K)], 0.0)
    assert message in said
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not doubts([camera().crop(10, 0, (62, 96)), camera("b", 1.0)], 0.0)
