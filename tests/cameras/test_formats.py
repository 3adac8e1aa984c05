"""Files of many tools: what is read, what is refused by name, and what a rig's cameras are judged by."""

from __future__ import annotations

import json
import os
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug import Camera, Rig, load_rig, save_rig
from arbiview_aug.cameras.rotations import quaternion_from_rotation, rotation_from_quaternion
from arbiview_aug.cameras.shipped import shipped_rigs
from arbiview_aug.cameras.validation import doubts
from arbiview_aug.errors import CalibrationError
from tests.cameras.test_calibrations import (
    CAMCHAIN,
    CAMERA_INFO,
    CAMERAS_TXT,
    COLMAP_MOUNTING,
    FORWARD,
    IMAGES_TXT,
    OPENCV_YAML,
    TF_STATIC,
    nuscenes_tables,
    written,
)  # fmt: skip
from tests.helpers import camera

K = [[500.0, 0.0, 320.0], [0.0, 501.0, 240.0], [0.0, 0.0, 1.0]]
BENT = [-0.2, 0.05, 0.001, -0.002, 0.0]
FOUR = [0.05, 0.03, -0.03, 0.016]
SIZE = {"image_width": 640, "image_height": 480}
AXES = {"u0": 320.0, "v0": 240.0}
EYE, FLAT = [1.0, 0, 0, 0, 1, 0, 0, 0, 1], [one for row in K for one in row]
TURNED = [1.0, 0.01, 0.0, -0.01, 1.0, 0.0, 0.0, 0.0, 1.0]
P = [500.0, 0, 320, 0, 0, 501, 240, 0, 0, 0, 1, 0]


def cam(**more: Any) -> dict[str, Any]:
    return {"K": K, **SIZE, **more}


def info(**more: Any) -> dict[str, Any]:
    header = {"frame_id": "front_optical_frame"}
    return {"header": header, "width": 640, "height": 480, "k": FLAT, "d": [], "distortion_model": "plumb_bob", **more}


def mounted(folder: Path, **files: Any) -> Path:
    """A folder with files, JSON where they are no text, and poses of the cameras in them."""
    texts = {name: one if isinstance(one, str) else json.dumps(one) for name, one in files.items()}
    names = [name for name in ("front", "cam0") if name in f"{texts}"]
    return written(folder, **texts, mounting__yaml=json.dumps({"poses": dict.fromkeys(names, FORWARD.tolist())}))


# --- one camera: data of a file, then the lens and coefficients, or the message ---------------------------------------
LINES = {"fx": 500.0, "fy": 501.0, "cx": 320.0, "cy": 240.0, "w": 640, "h": 480}
KB = {"k2": 0.05, "k3": 0.03, "k4": -0.03, "k5": 0.016, "mu": 500.0, "mv": 501.0, **AXES}
MEI = {
    "model_type": "MEI",
    "mirror_parameters": {"xi": 2.0},
    "projection_parameters": {"gamma1": 9.0, "gamma2": 9.0, **AXES},
}
READ: dict[str, tuple[dict[str, Any], str, list[float]]] = {
    "dist_coeffs": ({"camera_matrix": K, "dist_coeffs": [BENT], **SIZE}, "radtan", BENT),
    "dist_coeff": ({"camera_matrix": K, "dist_coeff": [[k] for k in BENT], "image_size": [640, 480]}, "radtan", BENT),
    "mtx, dist, shape": ({"mtx": K, "dist": [BENT], "image_shape": [480, 640, 3]}, "radtan", BENT),
    "K, D, DIM": ({"K": K, "D": [[k] for k in FOUR], "DIM": [640, 480]}, "fisheye", FOUR),
    "fisheye: true": ({"K": K, "D": FOUR, "fisheye": True, "resolution": "640x480"}, "fisheye", FOUR),
    "Equidistant": (cam(D=FOUR, distortion_model="Equidistant"), "fisheye", FOUR),
    "KANNALA_BRANDT": (cam(D=FOUR, camera_model="KANNALA_BRANDT"), "fisheye", FOUR),
    "four of radtan": (cam(D=FOUR, distortion_model="plumb_bob"), "radtan", FOUR),
    "pinhole, radtan": (cam(D=FOUR, camera_model="pinhole", distortion_model="radtan"), "radtan", FOUR),
    "by names": ({**LINES, "k1": -0.2, "k2": 0.05, "p1": 0.001, "p2": -0.002}, "radtan", [*BENT, 0.0, 0.0, 0.0]),
    "Plumb Bob": (info(d=[0.0] * 5, distortion_model="Plumb Bob"), "pinhole", []),
    "empty": (info(distortion_model=""), "pinhole", []),
    "none": (info(d=[0.0] * 5, distortion_model="none"), "pinhole", []),
    "Foxglove": ({**cam(D=BENT, R=EYE, P=P, distortion_model="plumb_bob"), "frame_id": "front"}, "radtan", BENT),
    "zeros": (info(r=[0.0] * 9, p=[0.0] * 12, binning_x=1, roi={"width": 640, "height": 480}), "pinhole", []),
    "DAIR-V2X": ({"cam_K": FLAT, "cam_D": BENT, "P": P, "width": 640, "height": 480}, "radtan", BENT),
    "Autoware.AI": ({"CameraMat": K, "DistCoeff": BENT, "ImageSize": [640, 480], "DistModel": "brown"}, "radtan", BENT),
    "CamOdoCal": ({"model_type": "KANNALA_BRANDT", **SIZE, "projection_parameters": KB}, "fisheye", FOUR),
    "rectified": (cam(rectified=True, undistorted=True), "pinhole", []),
    "neutral": (cam(D=BENT, date="today", rms_error=0.3, flags=0, square_size=2, skew=0.0, scale=1), "radtan", BENT),
    "neutral words": (cam(D=BENT, sensor_model="a", extrinsics=K, focal_length=4, distance_m=3), "radtan", BENT),
    "prism of zeros": (cam(D=[*BENT, *[0.0] * 9], distortion_model="rational_polynomial"), "radtan", [*BENT, 0, 0, 0]),
}  # fmt: skip
PRISM = [*BENT, 0.0, 0.0, 0.0, 0.01, 0.0, 0.0, 0.0]
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "four, unmarked": (cam(D=FOUR), "a lens for its coefficients, got .*write distortion_model: plumb_bob"),
    "thin prism": (cam(D=FOUR, distortion_model="thin_prism_fisheye"), "distortion_model: expected plumb_bob"),
    "inverse": (cam(D=BENT, model="inverse_brown_conrady"), "model: expected plumb_bob"),
    "two models": (cam(D=FOUR, model="fisheye", distortion_model="radtan"), "one lens, got fisheye and radtan"),
    "none, bent": (cam(D=BENT, distortion_model="none"), "a lens for its coefficients"),
    "empty, bent": (info(d=BENT, distortion_model=""), "a lens for its coefficients"),
    "no coefficients": (cam(distortion_model="equidistant"), "expected coefficients of fisheye, got none"),
    "prism": (cam(D=PRISM), r"8 coefficients of radtan, got 12 \(thin prism"),
    "tangential": (cam(D=BENT, tangential_distortion=[0.1, 0.1]), "got 'tangential_distortion'"),
    "five": (cam(D=[*FOUR, 0.1], fisheye_model=1), "4 coefficients of fisheye, got 5"),
    "R": (info(d=BENT, r=TURNED), "r: expected the identity.*for rectified ones write P's left 3x3"),
    "P": (info(p=[400.0, *P[1:]]), "p: expected the camera matrix, got .* without distortion"),
    "binning": (info(binning_x=2), "full images, got binning"),
    "window": (info(roi={"x_offset": 5, "width": 0, "height": 0}), "full images, got binning or a region of interest"),
    "two sizes": (cam(D=BENT, dim=[1280, 960]), "expected one size"),
    "no size": (cam(image_width=0, image_height=0), "how large are its images"),
    "two matrices": (cam(camera_matrix=K), "one key of each kind, got K and camera_matrix"),
    "skew": ({**LINES, "skew": 0.3}, "got 'skew': 0.3"),
    "rectified, bent": (cam(D=BENT, rectified=True), "got 'rectified': True"),
    "new matrix": (cam(D=BENT, new_camera_matrix=TURNED), "got 'new_camera_matrix'"),
    "crop": (cam(crop=[0, 60, 640, 360]), "got 'crop'"),
    "offset": (cam(y_offset=10), "got 'y_offset': 10"),
    "f-theta": (cam(D=FOUR, model="ftheta"), "model: expected plumb_bob"),
    "scale": (cam(scale=0.5), "got 'scale': 0.5"),
    "units": (cam(units="mm"), "got 'units': 'mm'"),
    "column-major": (cam(storage_order="column"), "got 'storage_order'"),
    "MEI, bent": ({**MEI, **SIZE, "distortion_parameters": {"k1": 0.1, "p1": 0.0}}, "MEI.*undistort the images"),
    "ragged": ({"camera_matrix": [[1, 2], [3]], **SIZE}, "camera_matrix: expected a matrix or list of numbers"),
}  # fmt: skip


@pytest.mark.parametrize("name", READ)
def test_read(tmp_path: Path, name: str) -> None:
    data, lens, coefficients = READ[name]
    for text in (data, [data], "%YAML:1.0\n---\n" + json.dumps(data)):
        file = "front__yaml" if isinstance(text, str) else "front__json"
        (front,) = load_rig(mounted(tmp_path, **{file: text}) / file.replace("__", "."))
        assert (front.name, front.lens, front.distortion, front.size) == (
            "front",
            lens,
            tuple(coefficients),
            (480, 640),
        )
        assert front.K.tolist() == K


@pytest.mark.parametrize("name", REFUSED)
def test_refused_by_name(tmp_path: Path, name: str) -> None:
    data, message = REFUSED[name]
    with pytest.raises(CalibrationError, match=message):
        load_rig(mounted(tmp_path, front__json=data))


def test_a_unified_camera_without_distortion_is_an_eucm(tmp_path: Path) -> None:
    """Geyer's and Mei's model: (x, y) / (z + ξ d)."""
    omni: dict[str, Any] = {"camera_model": "omni", "distortion_model": "radtan", "distortion_coeffs": [0.0] * 4}
    omni |= {"intrinsics": [2.0, 900.0, 900.0, 320.0, 240.0], "resolution": [640, 480]}
    (read,) = load_rig(mounted(tmp_path, camchain__yaml={"cam0": omni}))
    x, y, z = np.random.default_rng(0).normal([0, 0, 2], 0.7, (100, 3)).T
    divisor = z + 2.0 * np.sqrt(x * x + y * y + z * z)
    uv = np.stack([900 * x / divisor + 320, 900 * y / divisor + 240], -1)
    assert read.lens == "eucm" and np.allclose(read.project_cam(np.stack([x, y, z], -1)).uv, uv, atol=1e-9)


def test_woodscapes_polynomial_is_an_ftheta(tmp_path: Path) -> None:
    w, *xyz = quaternion_from_rotation(FORWARD[:3, :3]).tolist()
    lens = {"aspect_ratio": 1.1, "cx_offset": 3.9, "cy_offset": -3.1, "height": 966.0, "width": 1280.0, "k1": 339.7}
    lens |= {"k2": -31.99, "k3": 48.27, "k4": -7.2, "model": "radial_poly", "poly_order": 4}
    data = {"extrinsic": {"quaternion": [*xyz, w], "translation": [1.5, 0.2, 1.6]}, "intrinsic": lens, "name": "FV"}
    (front,) = load_rig(written(tmp_path, FV__json=json.dumps(data)))
    np.testing.assert_allclose(front.cam2ego, FORWARD, atol=1e-12)
    theta = 1.2
    r = 339.7 * theta - 31.99 * theta**2 + 48.27 * theta**3 - 7.2 * theta**4
    uv = front.project_cam(np.array([[np.sin(theta), 0, np.cos(theta)], [0, np.sin(theta), np.cos(theta)]])).uv
    np.testing.assert_allclose(uv, [[639.5 + 3.9 + r, 482.5 - 3.1], [639.5 + 3.9, 482.5 - 3.1 + 1.1 * r]])
    with pytest.raises(CalibrationError, match=r"camera 'FV': expected intrinsic .*, got k5"):
        load_rig(written(tmp_path, FV__json=json.dumps({**data, "intrinsic": {**lens, "k5": 1.0}})))


@pytest.mark.parametrize(
    ("model", "numbers", "lens", "found"),
    [
        ("EUCM", "500 500 320 240 0.6 1.1", "eucm", (0.6, 1.1)),
        ("SIMPLE_FISHEYE", "500 320 240", "fisheye", (0.0,) * 4),
        ("THIN_PRISM_FISHEYE", "500 500 320 240 .1 .2 0 0 .3 .4 0 0", "fisheye", (0.1, 0.2, 0.3, 0.4)),
        ("THIN_PRISM_FISHEYE", "500 500 320 240 .1 .2 0 0 .3 .4 .1 0", "", "with p1, p2, sx1 and sy1 of 0, got"),
        ("SIMPLE_DIVISION", "500 320 240 -0.1", "", "camera model: expected SIMPLE_PINHOLE, .*, got SIMPLE_DIVISION"),
    ],
)
def test_newer_models_of_colmap(tmp_path: Path, model: str, numbers: str, lens: str, found: Any) -> None:
    cameras = CAMERAS_TXT.replace("SIMPLE_RADIAL 640 480 500.5 320 240 -0.05", f"{model} 640 480 {numbers}")
    written(tmp_path, cameras__txt=cameras, images__txt=IMAGES_TXT, mounting__yaml=COLMAP_MOUNTING)
    if lens:
        assert (load_rig(tmp_path)["left"].lens, load_rig(tmp_path)["left"].distortion) == (lens, found)
    else:
        with pytest.raises(CalibrationError, match=found):
            load_rig(tmp_path)


def test_poses_of_the_imu_alone(tmp_path: Path) -> None:
    text = "%YAML:1.0\n---\n" + CAMCHAIN.replace("T_cn_cnm1", "T_cam_imu")
    with pytest.raises(CalibrationError, match="T_cam_imu of all cameras, got neither"):
        load_rig(mounted(tmp_path, imucam_chain__yaml=text))
    own = "cam0:\n  T_cam_imu: [[1, 0, 0, 0.3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n"
    rig = load_rig(written(tmp_path, imucam_chain__yaml=text.replace("cam0:\n", own, 1)))
    np.testing.assert_allclose(rig[1].center_m, FORWARD[:3] @ [0.5, 0, 0, 1])  # 0.3 and 0.2 m to the right of the IMU


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
def test_lenses_of_tables_like_nuscenes(tmp_path: Path, row: dict[str, Any], lens: str) -> None:
    path = nuscenes_tables(tmp_path) / "calibrated_sensor.json"
    first, *others = json.loads(path.read_text())
    path.write_text(json.dumps([{**first, **row}, *others]))
    if " " in lens:
        with pytest.raises(CalibrationError, match=lens):
            load_rig(path)
    else:
        assert load_rig(path)[0].lens == lens


# --- folders and files ------------------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("other__json", '{"cam_front": {"intrinsic_param": [1.0]}}', r"other.json \(a calibration that is not read"),
        ("left__npz", "PK mtx.npy dist.npy", r"left.npz \(a calibration that is not read"),
        ("broken__yaml", "camera_matrix: [1, 2", r"broken.yaml \(expected plain YAML"),
        ("orb__yaml", "%YAML:1.0\nCamera.fx: 1.0\n", r"orb.yaml \(ORB-SLAM, which is not read: write a rig file"),
        ("nerf__json", '{"fl_x": 1.0}', r"nerf.json \(nerfstudio, which is not read"),
    ],
)
def test_a_camera_that_is_not_read_does_not_vanish(tmp_path: Path, file: str, text: str, message: str) -> None:
    assert load_rig(mounted(tmp_path, front__yaml=CAMERA_INFO)).names == ["front"]
    with pytest.raises(CalibrationError, match=f"ROS: expected cameras of one tool, got also {message}"):
        load_rig(written(tmp_path, **{file: text}))
    (tmp_path / "front.yaml").unlink()
    with pytest.raises(CalibrationError, match=f"expected a rig file, or a folder of COLMAP.*, got {message}"):
        load_rig(tmp_path)


def test_other_files_of_a_folder_are_named(tmp_path: Path) -> None:
    mounted(tmp_path, front__yaml=CAMERA_INFO, front__json="{", launch__yaml="a: 1", notes__txt="camera_matrix")
    load_rig("waymo").save(tmp_path / "rig.json")
    with pytest.warns(UserWarning, match=r"ROS: not read: launch.yaml, rig.json$"):
        load_rig(tmp_path)


def test_names_where_the_files_share_one(tmp_path: Path) -> None:
    shared = CAMERA_INFO.replace("camera_name: front", "camera_name: narrow_stereo")
    tf = TF_STATIC.replace("/left", "/left_optical_frame")
    rig = load_rig(written(tmp_path, front__yaml=shared, left__yaml=shared, tf_static__yaml=tf))
    assert rig.names == ["front", "left"]
    (tmp_path / "left.yaml").unlink()
    two = json.dumps([info(camera_name="a"), info(header={"frame_id": "left_optical_frame"})])
    assert load_rig(written(tmp_path, front__yaml=two)).names == ["a", "left"]
    with pytest.raises(CalibrationError, match=r"without a baseline, got one with; its frame may be the left camera's"):
        load_rig(written(tmp_path, front__yaml=json.dumps(info(p=[*P[:3], -60.0, *P[4:]]))))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "latin-1"])
@pytest.mark.parametrize("text", [CAMERA_INFO, OPENCV_YAML, json.dumps(cam(of="x"))])
def test_byte_order_marks_and_encodings(tmp_path: Path, encoding: str, text: str) -> None:
    suffix = "json" if text[0] == "{" else "yaml"
    mounted(tmp_path, **{f"front__{suffix}": text})
    text = text.replace("\n", "\r\n") if encoding == "utf-8-sig" else text[:-1] + text[-1].replace("\n", "# ü") + "ü"
    (tmp_path / f"front.{suffix}").write_bytes(text.encode(encoding))
    for path in (tmp_path, tmp_path / f"front.{suffix}"):
        if encoding == "utf-8-sig":
            assert load_rig(path).names == ["front"]
        else:
            with pytest.raises(CalibrationError, match=r"UTF-8, got another encoding.*: save it as UTF-8"):
                load_rig(path)


FILES = "front.yaml front.xml front.json mounting.yaml tf_static.yaml camchain.yaml images.txt images.bin cameras.bin"


@pytest.mark.parametrize("name", [*FILES.split(), "intrinsics.feather", "calibrated_sensor.json", "alone.txt"])
@pytest.mark.timeout(20)
def test_special_files_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    for make in (os.mkfifo, lambda path: path.symlink_to(path), lambda path: path.symlink_to("/dev/zero")):
        written(tmp_path, left__yaml=CAMERA_INFO)
        make(path)
        for calibration in (tmp_path, path):
            with pytest.raises((CalibrationError, ImportError)):
                load_rig(calibration)
        path.unlink()


def test_binaries_of_colmap_are_bounded(tmp_path: Path) -> None:
    (tmp_path / "cameras.bin").write_bytes(bytes(8))
    for file in ("images.bin", "cameras.bin"):
        with (tmp_path / file).open("wb") as large:
            large.truncate((1 << 28) + 1)  # of zeros that take no space
        with pytest.raises(CalibrationError, match=r"COLMAP.*more than 256.0 MiB"):
            load_rig(tmp_path)
        (tmp_path / file).write_bytes(bytes(8))


@pytest.mark.parametrize("name", ["", "x" * 300, "a\0b", "a\ud800b"])
def test_names_that_no_file_has(tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mounted(tmp_path, front__yaml=CAMERA_INFO)
    with pytest.raises(CalibrationError, match="found neither"):
        load_rig(name)
    entry = {**Rig([camera()]).to_dict()["cameras"][0], "mask": name}
    with pytest.raises(CalibrationError, match="mask: expected an image file"):
        load_rig(written(tmp_path, rig__json=json.dumps({"cameras": [entry]})) / "rig.json")
    with pytest.raises(CalibrationError, match="path: expected a file's or folder's name"):
        save_rig("waymo", name, format="ros")
    if len(name) < 300:
        with pytest.raises(CalibrationError, match="camera name: expected a non-empty string"):
            camera(name)


def test_folders_that_are_not_utf8(tmp_path: Path) -> None:
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/f\xfcr"))
    folder.mkdir()
    rig = Rig([camera(mask=np.eye(72, 96) > 0)])
    assert load_rig(rig.save(folder / "rig.yaml")) == rig
    (folder / "rig.yaml").unlink()
    load_rig(mounted(folder, front__yaml=CAMERA_INFO)).save(tmp_path / "again.yaml")


# --- rig files --------------------------------------------------------------------------------------------------------
RADTAN = {"model": "radtan", "coeffs": FOUR}


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
        ({}, {"distortion": {**RADTAN, "order": "k1,k2,k3,k4"}}, "order: expected k1 k2 p1 p2 k3"),
        ({}, {"distortion": {**RADTAN, "xi": 2}}, "distortion: 'xi' is not read"),
        ({}, {"distortion": RADTAN, "camera_model": "mei"}, "'camera_model' is not read"),
        ({}, {"distortion": RADTAN, "lens": "equidistant"}, "'lens' is not read"),
    ],
)
def test_all_keys_of_a_rig_file_are_known(tmp_path: Path, top: dict, inner: dict, message: str) -> None:
    data = Rig([camera()]).to_dict()
    changed = {**data, **top, "cameras": [{**data["cameras"][0], **inner}]}
    with pytest.raises(CalibrationError, match=message):
        load_rig(written(tmp_path, rig__json=json.dumps(changed)) / "rig.json")
    assert load_rig(written(tmp_path, rig__json=json.dumps({**data, "_a": 1, "license": "MIT"})) / "rig.json")


# --- each camera judged -----------------------------------------------------------------------------------------------
def at(name: str, azimuth_deg: float, **changes: Any) -> Camera:
    """A camera on the side of the vehicle to which it looks."""
    a = np.radians(azimuth_deg)
    return camera(name, azimuth_deg, **{"position_m": (np.cos(a), np.sin(a), 1.5), **changes})


AROUND = [at("front", 0.0), at("left", 90.0), at("right", -90.0), at("back", 180.0)]
BODY = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # a body's axes in those of its camera


def turned(camera: Camera, R: np.ndarray) -> Camera:
    pose = camera.cam2ego.copy()
    pose[:3, :3] = R
    return replace(camera, cam2ego=pose)


def test_sound_rigs_raise_no_doubt() -> None:
    down = camera("down", elevation_deg=-90.0)
    rigs = [AROUND, [AROUND[0], down, camera("stereo_left", 1.0), camera("rear_view_mirror")]]
    rigs += [[camera("left", 2.0), camera("right", -2.0)]]  # a stereo pair
    assert not any(doubts(rig, 0.0) for rig in rigs)
    for rig in map(load_rig, shipped_rigs()):
        assert not doubts(rig.cameras, rig.ground_z_m)


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("front", BODY, "'front'.*looks up by 90 degrees, as with a body's axes"),
        ("left", BODY, "'left'.*looks up by 90 degrees, as with a body's axes"),
        ("left", np.diag([-1.0, -1.0, 1.0]), "'left'.*rolled by -?180 degrees"),
        ("left", np.diag([1.0, -1.0, -1.0]), "OpenGL's axes"),
        ("back", np.diag([-1.0, 1.0, -1.0]), "'back'.*where its name says, found it looks to .*0 degrees"),
    ],
)
def test_one_camera_of_several(name: str, change: np.ndarray, message: str) -> None:
    rig = [turned(c, c.cam2ego[:3, :3] @ change) if c.name == name else c for c in AROUND]
    (said,) = doubts(rig, 0.0)
    assert re.search(message, str(said)), said


@pytest.mark.parametrize("order", [[1, 2, 3, 0], [3, 0, 1, 2]])
def test_quaternions_in_another_order(order: list[int]) -> None:
    left = at("left", 80.0, elevation_deg=-7.0)
    wrong = rotation_from_quaternion(quaternion_from_rotation(left.cam2ego[:3, :3])[order])
    (said,) = doubts([AROUND[0], turned(left, wrong), *AROUND[2:]], 0.0)
    assert "a quaternion" in said.found


def test_mirrored_rigs_are_called_left_handed(tmp_path: Path) -> None:
    unreal, mirror = np.array([[0.0, 0, 1], [1, 0, 0], [0, -1, 0]]), np.diag([1.0, -1, 1])
    for rig in (
        [turned(c, mirror @ c.cam2ego[:3, :3] @ unreal.T) for c in AROUND],  # y is to the right, as is the camera's
        [turned(c, at(c.name, -c.azimuth_deg).cam2ego[:3, :3]) for c in AROUND],
    ):
        with pytest.warns(UserWarning, match="left and right are swapped, as in left-handed axes"):
            load_rig(Rig(rig).save(tmp_path / "rig.yaml"))
    front = AROUND[0].cam2ego[:3, :3]
    for axes, fix in ((mirror @ front, r"np.diag\(\[1, -1, 1, 1\]\) @ cam2ego"), (front @ mirror, "Unity")):
        with pytest.raises(CalibrationError, match=f"right-handed axes, got mirrored, left-handed.*{fix}"):
            turned(AROUND[0], axes)
    crossed = [at("left", 90.0, position_m=(0, -1, 1.5)), at("right", -90.0, position_m=(0, 1, 1.5))]
    assert "y of all positions mirrored" in doubts(crossed, 0.0)[0].found


@pytest.mark.parametrize("size", [(36, 48), (96, 72), (144, 192)])
def test_intrinsics_of_another_size(size: tuple[int, int]) -> None:
    (said,) = doubts([camera(size=size, K=camera().K)], 0.0)
    assert f"middle of {size[1]}x{size[0]} pixels, found the middle of about 96x72" in str(said)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not doubts([camera().crop(10, 0, (62, 96)), camera("b", 1.0)], 0.0)
