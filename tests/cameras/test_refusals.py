"""What cameras, rigs, scanners, random rigs and rig files refuse, by name: one table."""

from __future__ import annotations

import itertools
import json
import math
import re
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import CalibrationError, Camera, RandomRig, Rig, load_rig
from arbiview_aug.cameras.validation import MAX_SIZE_PX
from tests import helpers
from tests.cameras.test_camera import POSE, K, edited, make
from tests.cameras.test_lidar import AT_2_M, scanner

FOUR = (0.1, 0.0, 0.0, 0.0)
TURNED = edited(POSE, (0, 0), POSE[0, 0] + 0.01)
SCALED = POSE @ np.diag([1.01, 1.01, 1.01, 1.0])
MIRRORED = POSE @ np.diag([-1.0, 1.0, 1.0, 1.0])
GRADIENTS = torch.tensor(K, requires_grad=True)
ANGLES, PLACE = (
    "camera 'front': .*: expected finite angles in degrees, got ",
    r"position_m: expected finite \(x, y, z\)",
)
FOV = "horizontal_fov_deg: expected "
PIXELS = "expected a whole number of pixels"
WIDTH, STEP = "expected a half-width", "azimuth_step_deg: expected "
BEAMS = "lidar 'top': elevations_deg: expected 1 to 1024 elevations from -90 to 90"
NEUTRAL = {**dict.fromkeys(("yaw_deg", "pitch_deg", "roll_deg", "height_m", "forward_m", "lateral_m"), 0.0)}


def looking(**changes: Any) -> Camera:
    values: dict = dict(name="front", azimuth_deg=0.0, width_px=64, height_px=48, horizontal_fov_deg=60.0)
    return Camera.looking(**{**values, **changes})


def camera() -> Camera:
    return helpers.camera(size=(48, 64), horizontal_fov_deg=70.0, position_m=(1.5, 0.1, 1.6))


def rig(*lidars: Any, **changes: Any) -> Rig:
    return Rig(**{"cameras": [camera()], "name": "b", "lidars": list(lidars), **changes})


def lens(name: str, *coefficients: float) -> Camera:
    return make(lens=name, distortion=coefficients)


def file(*cameras: Any, top: Any = None, **changes: Any) -> Rig:
    """A rig file's: one camera with changed entries, or those given."""
    whole = rig().to_dict()
    entry = {key: value for key, value in {**whole["cameras"][0], **changes}.items() if value != "missing"}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rig.json"
        path.write_text(json.dumps({**whole, "cameras": [*cameras] or [entry], **(top or {})}))
        return load_rig(path)


def lidar_file(entry: Any, **changes: Any) -> Rig:
    known = {key: value for key, value in {**scanner().to_dict(), **changes}.items() if value != "missing"}
    return Rig.from_dict({**rig().to_dict(), "lidars": [known if entry is None else entry]})


def drawn(**settings: Any) -> RandomRig:
    return RandomRig("waymo", **settings)


RADTAN = {"model": "radtan", "coeffs": [0.1, 0, 0, 0]}
REFUSED: tuple[tuple[Callable[[], object], str], ...] = (
    # Cameras.
    *((lambda n=name: make(name=n), "camera name: expected a non-empty string") for name in ("", None, 3)),
    (lambda: make(cam2ego=TURNED), r"camera 'front': cam2ego: expected a rotation \(\|R Rᵀ - I\| <= 0.0001"),
    (lambda: make(cam2ego=SCALED), r"camera 'front': cam2ego: .*deviation 0.0201"),
    (lambda: make(cam2ego=MIRRORED), r"left-handed ones .determinant -1"),
    (lambda: make(K=edited(K, (0, 2), np.nan)), r"camera 'front': K: expected finite numbers, got NaN"),
    (lambda: make(cam2ego=edited(POSE, (0, 3), np.inf)), r"cam2ego: expected finite numbers"),
    (lambda: make(K=np.eye(3, 4)), r"K: expected shape \(3, 3\), got shape \(3, 4\)"),
    (lambda: make(cam2ego=POSE[:3]), r"cam2ego: expected shape \(4, 4\), got shape \(3, 4\)"),
    (lambda: make(K=[[1, 2], [3]]), r"K: expected numbers of shape \(3, 3\), got list"),
    (lambda: make(K="intrinsics"), r"K: expected numbers of shape"),
    (lambda: make(K=K.T), r"K: expected \[\[fx, s, cx\].*pass K.T"),
    (lambda: make(K=2 * K), r"divide K by K\[2, 2\]"),
    (lambda: make(K=GRADIENTS), r"K: expected numbers of shape \(3, 3\), got Tensor \(.*detach"),
    (lambda: make(cam2ego=POSE.T), r"cam2ego: expected last row \(0, 0, 0, 1\).*pass cam2ego.T"),
    (lambda: make(K=edited(K, (0, 0), -500.0)), r"positive focal lengths, 1e-06 px at least, got fx -500"),
    (lambda: make(K=edited(K, (1, 1), 0.0)), r"positive focal lengths, 1e-06 px at least, got fx 500, fy 0"),
    (lambda: make(K=edited(K, (1, 1), 5e-324)), r"1e-06 px at least, got fx 500, fy 4.94"),
    (lambda: make(mask=np.ones((640, 480), bool)), r"mask: .*\(480, 640\), the size \(h, w\) .*, got .*\(640, 480\)"),
    (lambda: make(mask=np.ones((480, 640), np.uint8)), r"mask: expected bool.*pass mask > 0"),
    (lambda: make(mask=[[True], [True, False]]), r"mask: expected a bool array, got "),
    (lambda: make(width_px=0), rf"camera 'front': width_px: {PIXELS} from 1 to {MAX_SIZE_PX}, got 0"),
    (lambda: make(height_px=480.5), f"height_px: {PIXELS}"),
    (lambda: make(width_px=40000), r"width_px: expected .* got 40000"),
    (lambda: make(width_px="wide"), r"width_px: expected .* got 'wide'"),
    (lambda: make().resize((0, 5)), f"camera 'front': height_px: {PIXELS}"),
    (lambda: make(mask=np.ones((480, 640), bool)).crop(0, 0, (-3, 5)), f"camera 'front': height_px: {PIXELS}"),
    # Lenses.
    (lambda: lens("brown"), r"camera 'front': lens: expected one of pinhole, .*, eucm, got 'brown'"),
    (lambda: lens("pinhole", *FOUR), r"0 coefficients for a pinhole lens.*name the lens"),
    (lambda: lens("radtan", *[0.1] * 6), r"distortion: expected 4 or 5 or 8 coefficients for a radtan lens, got 6"),
    (lambda: lens("fisheye", *[0.1] * 5), r"4 coefficients for a fisheye lens, got 5"),
    (lambda: lens("ftheta", 0.1, 0.2), "expected 4 coefficients for a ftheta lens, got 2"),
    (lambda: lens("fisheye", 0, 0, 0, math.nan), r"distortion: expected finite numbers"),
    (lambda: make(lens="fisheye", distortion=None), r"distortion: expected a sequence of numbers"),
    (lambda: make(lens="radtan", distortion="1234"), r"distortion: expected a sequence of numbers"),
    *((lambda n=n, k=k: lens(n, k, 0.0, 0.0, 0.0), r"distortion: expected finite numbers up to 1e\+06")
      for n in ("radtan", "fisheye") for k in (1e300, -1e12)),
    (lambda: lens("double_sphere", -1.2, 0.5), "expected xi from -0.99 to 1 and alpha from 0 to 1 for a double_sphere"),
    (lambda: lens("ds", 0.1, 1.01), "alpha from 0 to 1"),
    (lambda: lens("eucm", 0.5, 0.0), "expected alpha from 0 to 1 and beta from 0.001 to 1000 for a eucm lens"),
    (lambda: lens("eucm", -0.1, 1.0), "alpha from 0 to 1"),
    (lambda: lens("eucm", 0.5, math.nan), "finite numbers"),
    # Cameras by angles, and moved ones.
    (lambda: looking(azimuth_deg="30"), rf"{ANGLES}\('30', 0.0, 0.0\)"),
    (lambda: looking(elevation_deg=None), rf"{ANGLES}\(0.0, None, 0.0\)"),
    (lambda: looking(azimuth_deg=np.nan), rf"{ANGLES}\(nan"),
    (lambda: looking(azimuth_deg=10**400), ANGLES),
    (lambda: looking(position_m=("1", "2", "3")), rf"{PLACE} in metres, got \('1', '2', '3'\)"),
    *((lambda p=place: looking(position_m=p), PLACE) for place in ((1.0, 2.0), "front", (0, 0, 10**400))),
    (lambda: looking(horizontal_fov_deg="60"), f"{FOV}.* got '60'"),
    *((lambda d=deg: looking(horizontal_fov_deg=d), f"{FOV}between 0 and 180 for a pinhole lens") for deg in (180, 0)),
    (lambda: looking(horizontal_fov_deg=120.0, lens="radtan", distortion=(-0.3, 0, 0, 0)), "unfolded branch, got 120"),
    (lambda: looking(horizontal_fov_deg=None), "expected either K or horizontal_fov"),
    (lambda: looking(K=K), "expected either K or horizontal_fov_deg"),
    (lambda: looking(height_px=0), "height_px: expected"),
    (lambda: looking(lens="wide"), "lens: expected one of pinhole, radtan, fisheye"),
    (lambda: looking(lens=np.zeros(3)), r"lens: expected one of pinhole, radtan, fisheye"),
    (lambda: looking(distortion="x"), "distortion: expected"),
    (lambda: looking().moved(np.eye(3)), r"ego2ego: expected shape \(4, 4\), got shape \(3, 3\)"),
    (lambda: looking().moved(np.full((4, 4), np.nan)), "ego2ego: expected finite numbers"),
    (lambda: looking().moved(np.full((4, 4), 1e308)), "cam2ego: expected finite numbers"),
    (lambda: looking().moved(None), r"ego2ego: expected shape \(4, 4\)"),
    (lambda: looking().moved("left"), r"camera 'front': ego2ego: expected numbers of shape \(4, 4\), got str"),
    (lambda: looking().moved([["1 m"] * 4] * 4), r"ego2ego: expected numbers of shape \(4, 4\)"),
    (lambda: looking().moved(1j * np.eye(4)), r"ego2ego: .* got ndarray \(complex numbers\)"),
    (lambda: looking().turned(yaw_deg="3"), r"yaw, pitch, roll: expected finite angles in degrees"),
    (lambda: looking().turned(yaw_deg=np.inf), r"yaw, pitch, roll: expected finite angles"),
    (lambda: looking().shifted(z_m="1"), r"shift: expected finite \(x, y, z\) in metres"),
    (lambda: looking().resize((4, 4), None), "fit: expected one of crop, pad, stretch, got None"),
    (lambda: looking().resize(5), r"size: expected \(h, w\) in pixels, got 5"),
    (lambda: looking().resize(("4", "5")), rf"height_px: {PIXELS} .* got '4'"),
    (lambda: looking().crop(0.5, 0, (4, 4)), rf"top: {PIXELS} .* got 0.5"),
    # Scanners.
    (lambda: scanner(name=""), "lidar name: expected a non-empty string"),
    *((lambda e=each: scanner(elevations_deg=e), BEAMS) for each in (
        (), (0.0,) * 10_000, range(10**12), itertools.repeat(0.0), (0.0, math.nan), (95.0,), 3, np.array(5.0))),
    *((lambda s=step: scanner(azimuth_step_deg=s), f"{STEP}more than") for step in (0.0, 1e-9)),
    (lambda: scanner(azimuth_step_deg="wide"), f"{STEP}a number of degrees"),
    *((lambda a=a: scanner(azimuth_deg=a), "azimuth_deg: expected two azimuths") for a in ((9, -9), (0, 720))),
    *((lambda r=r: scanner(range_m=r), "range_m: expected two distances") for r in ((0.0, 0.0), 100.0)),
    (lambda: scanner(lidar2ego=AT_2_M.T), r"lidar 'top': lidar2ego: expected last row .* pass lidar2ego.T"),
    (lambda: scanner(lidar2ego=2 * np.eye(3)), "lidar2ego: expected shape"),
    (lambda: scanner().moved(np.eye(3)), "ego2ego: expected shape"),
    (lambda: scanner().moved(np.ones((4, 4))), "^lidar 'top': ego2ego: expected last row"),
    *((lambda s=s: scanner().shifted(s), "^lidar 'top': shift: expected three finite") for s in ("a", math.nan)),
    # Rigs.
    (lambda: rig(cameras=[]), r"rig 'b': expected at least one camera, got none"),
    (lambda: rig(cameras=[camera(), camera()]), r"rig 'b': expected different camera names, got front more than once"),
    (lambda: rig(cameras=[camera()] * 129), r"rig 'b': expected at most 128 cameras, got 129"),  # winners are int8
    (lambda: rig(cameras=5), r"rig 'b': expected Camera objects, got int"),
    (lambda: rig(cameras=[np.eye(3)]), r"rig 'b': expected Camera objects, got ndarray"),
    (lambda: rig(ground_z_m=np.nan), r"rig 'b': ground_z_m: expected a finite height in metres"),
    (lambda: rig(ground_z_m="low"), r"ground_z_m: expected a finite height in metres, got 'low'"),
    (lambda: rig(scanner()).shifted("a"), "shift: expected finite"),  # type: ignore[arg-type]
    (lambda: rig("top"), "expected Lidar objects, got str"),
    (lambda: rig(scanner(), scanner()), "expected different lidar names, got top more than once"),
    *((lambda s=s: rig().resized(s), r"rig 'b': size: expected .* or a positive scale up to 32766, got")
      for s in (-1.0, 0, np.nan, 1e306)),
    # Rig files.
    (lambda: Rig.from_dict([]), r"expected a mapping with a list 'cameras', got list"),  # type: ignore[arg-type]
    (lambda: Rig.from_dict({"name": "a"}), r"expected a mapping with a list 'cameras'"),
    (lambda: file(top={"cameras": []}), r"expected at least one camera"),
    (lambda: file(7), r"camera 0: expected a mapping, got int"),
    (lambda: file(K="missing"), r"camera 'front': expected keys .*, missing K"),
    (lambda: file(distortion=[0.1]), r"camera 'front': distortion: expected null or \{model, coeffs\}"),
    (lambda: file(distortion=[]), "distortion: expected null or"),
    (lambda: file(distortion={"model": "mei", "coeffs": []}), r"lens: expected one of .* got 'mei'"),
    (lambda: file(distortion={**RADTAN, "order": "k1,k2,k3,k4"}), "order: expected k1 k2 p1 p2 k3"),
    (lambda: file(distortion={**RADTAN, "xi": 2}), "distortion: 'xi' is not read"),
    (lambda: file(distortion=RADTAN, camera_model="mei"), "'camera_model' is not read"),
    (lambda: file(distortion=RADTAN, lens="equidistant"), "'lens' is not read"),
    (lambda: file(distortion=RADTAN, lens="fisheye"), r"'lens' is not read: .* got 'fisheye'"),
    (lambda: file(mask_file="nowhere.png"), r"'mask_file' is not read: did you mean 'mask'"),
    (lambda: file(lens="fisheye"), r"camera 'front': 'lens' is not read: write distortion: \{model: LENS"),
    *((lambda k=key, v=value: file(**{k: v}), rf"camera 'front': '{key}' is not read: .* got '{value}'") for key, value
      in (("lens_model", "fisheye"), ("camera_model", "ds"), ("distortion_model", "equidistant"))),
    (lambda: file(rectified=False), "camera 'front': 'rectified' is not read"),
    (lambda: file(ego2cam=[]), "'ego2cam' is not read"),
    (lambda: file(*rig().to_dict()["cameras"] * 2), r"different camera names"),
    (lambda: file(top={"ground_z_m": None}), r"ground_z_m: expected a finite height"),
    (lambda: file(top={"lidar": [{}]}), "'lidar' is not read: did you mean 'lidars'"),
    (lambda: file(top={"Lidars": []}), "'Lidars' is not read: did you mean 'lidars'"),
    (lambda: file(top={"scanners": []}), "'scanners' is not read: did you mean 'lidars'"),
    *((lambda v=v: file(top={"lidars": v}), "lidars: expected a list of at most 32") for v in ({}, "", {"top": {}})),
    (lambda: file(top={"ground_z_m": None, "ground_z": -0.2}), "'ground_z' is not read: did you mean 'ground_z"),
    (lambda: file(top={"extra": 1}), "'extra' is not read: expected keys are cameras, dataset"),
    (lambda: lidar_file("top"), "lidar 0: expected a mapping, got str"),
    (lambda: lidar_file({"name": "top"}), "lidar 'top': expected keys .*, missing lidar2ego, elevations_deg"),
    (lambda: lidar_file(None, azimuth_deg="missing", azimuths_deg=[0, 90]),
     "lidar 'top': 'azimuths_deg' is not read: did you mean 'azimuth_deg'?"),
    (lambda: lidar_file(None, range_m=[0, 0]), "rig: lidar 'top': lidar 'top': range_m: expected two distances"),
    (lambda: load_rig("tesla"), r"expected a file or one of the shipped rigs \(argoverse2, .*waymo\)"),
    (lambda: load_rig("x" * 5000), "found neither"),  # no file can have this name
    (lambda: load_rig(3), "expected a shipped rig's name or the path of a rig file, got int"),  # type: ignore[arg-type]
    # Random rigs.
    (lambda: drawn(yaw_deg="wide"), f"RandomRig: yaw_deg: {WIDTH} or a .low, high., got 'wide'"),
    (lambda: drawn(yaw_deg=True), f"RandomRig: yaw_deg: {WIDTH} or a .low, high., got True"),
    *((lambda d=d: drawn(yaw_deg=d), f"RandomRig: yaw_deg: {WIDTH}") for d in ((3, 1), -1, 10**400, ("1", 2))),
    *((lambda m=m: drawn(height_m=m), f"RandomRig: height_m: {WIDTH}") for m in (math.nan, (0, math.inf), (0, 1, 2))),
    *((lambda s=s: drawn(focal_scale=s), f"RandomRig: focal_scale: {WIDTH} below 1 or a positive .low, high")
      for s in (1.0, (0.0, 2.0))),
    (lambda: drawn(per="epoch"), "RandomRig: per: expected 'sample' or 'sequence', got 'epoch'"),
    (lambda: drawn().rig({"yaw_deg": 1.0}), r"expected the parameters yaw_deg, .*focal_scale, got yaw_deg"),
    (lambda: drawn().rig({**NEUTRAL, "focal_scale": 1, "tilt": 1.0}), r"expected the parameters .* got .*, tilt"),
    *((lambda e=e: drawn(per="sequence").set_epoch(e), "set_epoch: expected a whole number below")
      for e in (math.nan, 1.5, 2**70, -(2**70), "1", None, True)),
)  # fmt: skip


@pytest.mark.parametrize(("call", "message"), REFUSED, ids=[f"{k}-{row[1][:40]}" for k, row in enumerate(REFUSED)])
def test_refused_by_name(call: Callable[[], object], message: str) -> None:
    with pytest.raises((CalibrationError, ValueError), match=message):
        call()


def test_the_offered_rotation_is_accepted() -> None:
    with pytest.raises(CalibrationError) as caught:
        make(cam2ego=TURNED)
    rows = re.search(r"nearest rotation is (\[\[.*\]\])", str(caught.value))
    assert rows
    fixed = POSE.copy()
    fixed[:3, :3] = np.array([float(x) for x in re.findall(r"-?[\d.]+(?:e-?\d+)?", rows[1])]).reshape(3, 3)
    assert np.abs(make(cam2ego=fixed).cam2ego - POSE).max() < 0.02


def test_notes_of_a_rig_file_are_kept_out() -> None:
    notes = {"lens": "opencv_radtan", "camera_model": "pinhole", "distortion_model": "plumb_bob", "lenses": None}
    assert file(distortion=RADTAN, **notes)[0].lens == "radtan" and file(camera_model="pinhole")[0].lens == "pinhole"
    assert file(top={"_a": 1, "license": "MIT"})
