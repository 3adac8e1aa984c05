"""What cameras, rigs, scanners, random rigs and files of strangers refuse, by name."""

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
from arbiview_aug.cameras.plain_yaml import dump_yaml, parse_json, parse_yaml
from arbiview_aug.cameras.validation import MAX_SIZE_PX
from tests import helpers
from tests.cameras.test_camera import POSE, K, edited, make
from tests.cameras.test_rig import AT_2_M, scanner

FOUR = (0.1, 0.0, 0.0, 0.0)
TURNED = edited(POSE, (0, 0), POSE[0, 0] + 0.01)
MIRRORED = POSE @ np.diag([-1.0, 1.0, 1.0, 1.0])
GRADIENTS = torch.tensor(K, requires_grad=True)
ANGLES, PLACE = ".*: expected finite angles in degrees, got ", r"position_m: expected finite \(x, y, z\)"
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
    (lambda: make(cam2ego=MIRRORED), r"left-handed ones .determinant -1"),
    (lambda: make(K=edited(K, (0, 2), np.nan)), r"camera 'front': K: expected finite numbers of shape .*, got NaN"),
    (lambda: make(K=np.eye(3, 4)), r"K: expected finite numbers of shape \(3, 3\), got shape \(3, 4\)"),
    (lambda: make(K=[[1, 2], [3]]), r"K: expected finite numbers of shape \(3, 3\), got list"),
    (lambda: make(K=K.T), r"K: expected \[\[fx, s, cx\].*pass K.T"),
    (lambda: make(K=2 * K), r"divide K by K\[2, 2\]"),
    (lambda: make(K=GRADIENTS), r"K: expected finite numbers of shape \(3, 3\), got Tensor \(.*detach"),
    (lambda: make(cam2ego=POSE.T), r"cam2ego: expected last row \(0, 0, 0, 1\).*pass cam2ego.T"),
    (lambda: make(K=edited(K, (0, 0), -500.0)), r"positive focal lengths, 1e-06 px at least, got fx -500"),
    (lambda: make(K=edited(K, (1, 1), 5e-324)), r"1e-06 px at least, got fx 500, fy 4.94"),
    (lambda: make(K=edited(K, (0, 0), 1e308)), r"K: expected entries of at most 1e\+09 px"),
    (lambda: make(mask=np.ones((640, 480), bool)), r"mask: .*\(480, 640\), the size \(h, w\) .*, got .*\(640, 480\)"),
    (lambda: make(mask=np.ones((480, 640), np.uint8)), r"mask: expected bool.*pass mask > 0"),
    (lambda: make(mask=[[True], [True, False]]), r"mask: expected a bool array, got "),
    (lambda: make(width_px=0), rf"camera 'front': width_px: {PIXELS} from 1 to {MAX_SIZE_PX}, got 0"),
    (lambda: make(height_px=480.5), f"height_px: {PIXELS}"),
    (lambda: make(mask=np.ones((480, 640), bool)).crop(0, 0, (-3, 5)), f"camera 'front': height_px: {PIXELS}"),
    # Lenses.
    (lambda: lens("brown"), r"camera 'front': lens: expected one of pinhole, .*, eucm, got 'brown'"),
    (lambda: lens("pinhole", *FOUR), r"0 coefficients for a pinhole lens.*name the lens"),
    (lambda: lens("radtan", *[0.1] * 6), r"distortion: expected 4 or 5 or 8 coefficients for a radtan lens, got 6"),
    (lambda: lens("fisheye", 0, 0, 0, math.nan), r"distortion: expected finite numbers"),
    (lambda: make(lens="radtan", distortion="1234"), r"distortion: expected finite numbers"),
    *((lambda n=n, k=k: lens(n, k, 0.0, 0.0, 0.0), r"distortion: expected finite numbers up to 1e\+06")
      for n in ("radtan", "fisheye") for k in (1e300, -1e12)),
    (lambda: lens("double_sphere", -1.2, 0.5), "expected xi from -0.99 to 1 and alpha from 0 to 1 for a double_sphere"),
    (lambda: lens("eucm", 0.5, 0.0), "expected alpha from 0 to 1 and beta from 0.001 to 1000 for a eucm lens"),
    (lambda: lens("eucm", 0.5, math.nan), "finite numbers"),
    # Cameras by angles, and moved ones.
    (lambda: looking(azimuth_deg="30"), rf"{ANGLES}\('30', 0.0, 0.0\)"),
    (lambda: looking(azimuth_deg=10**400), ANGLES),
    *((lambda p=place: looking(position_m=p), PLACE) for place in ((1.0, 2.0), "front", (0, 0, 10**400))),
    (lambda: looking(horizontal_fov_deg="60"), f"{FOV}.* got '60'"),
    *((lambda d=deg: looking(horizontal_fov_deg=d), f"{FOV}between 0 and 180 for a pinhole lens") for deg in (180, 0)),
    (lambda: looking(horizontal_fov_deg=120.0, lens="radtan", distortion=(-0.3, 0, 0, 0)), "unfolded branch, got 120"),
    (lambda: looking(horizontal_fov_deg=None), "expected either K or horizontal_fov"),
    (lambda: looking(K=K), "expected either K or horizontal_fov_deg"),
    (lambda: looking(lens=np.zeros(3)), r"lens: expected one of pinhole, radtan, fisheye"),
    (lambda: looking().moved(np.full((4, 4), np.nan)), "ego2ego: expected finite numbers"),
    (lambda: looking().moved(np.full((4, 4), 1e308)), "cam2ego: expected finite numbers"),
    (lambda: looking().moved([["1 m"] * 4] * 4), r"ego2ego: expected finite numbers of shape \(4, 4\)"),
    (lambda: looking().moved(1j * np.eye(4)), r"ego2ego: .* got ndarray \(.* is no real number\)"),
    (lambda: looking().turned(yaw_deg="3"), r"yaw, pitch, roll: expected finite angles in degrees"),
    (lambda: looking().shifted(z_m="1"), r"shift: expected finite \(x, y, z\) in metres"),
    (lambda: looking().resize((4, 4), None), "fit: expected one of crop, pad, stretch, got None"),
    (lambda: looking().resize(5), r"size: expected \(h, w\) in pixels, got 5"),
    (lambda: looking().crop(0.5, 0, (4, 4)), rf"top: {PIXELS} .* got 0.5"),
    # Scanners.
    (lambda: scanner(name=""), "lidar name: expected a non-empty string"),
    *((lambda e=each: scanner(elevations_deg=e), BEAMS) for each in (
        (), (0.0,) * 10_000, range(10**12), itertools.repeat(0.0), (0.0, math.nan), (95.0,), 3, np.array(5.0))),
    *((lambda s=step: scanner(azimuth_step_deg=s), f"{STEP}more than") for step in (0.0, 1e-9)),
    (lambda: scanner(azimuth_step_deg="wide"), f"{STEP}more than"),
    *((lambda a=a: scanner(azimuth_deg=a), "azimuth_deg: expected two azimuths") for a in ((9, -9), (0, 720))),
    *((lambda r=r: scanner(range_m=r), "range_m: expected two distances") for r in ((0.0, 0.0), 100.0)),
    (lambda: scanner(lidar2ego=AT_2_M.T), r"lidar 'top': lidar2ego: expected last row .* pass lidar2ego.T"),
    (lambda: scanner().moved(np.ones((4, 4))), "^lidar 'top': ego2ego: expected last row"),
    *((lambda s=s: scanner().shifted(s), "^lidar 'top': shift: expected three finite") for s in ("a", math.nan)),
    # Rigs.
    (lambda: rig(cameras=[]), r"rig 'b': expected at least one camera, got none"),
    (lambda: rig(cameras=[camera(), camera()]), r"rig 'b': expected different camera names, got front more than once"),
    (lambda: rig(cameras=[camera()] * 129), r"rig 'b': expected at most 128 cameras, got 129"),  # winners are int8
    (lambda: rig(cameras=5), r"rig 'b': expected Camera objects, got int"),
    (lambda: rig(ground_z_m=np.nan), r"rig 'b': ground_z_m: expected a finite height in metres"),
    (lambda: rig("top"), "expected Lidar objects, got str"),
    (lambda: rig(scanner(), scanner()), "expected different lidar names, got top more than once"),
    *((lambda s=s: rig().resized(s), r"rig 'b': size: expected .* or a positive scale up to 32766, got")
      for s in (-1.0, 0, np.nan, 1e306)),
    # Rig files.
    (lambda: Rig.from_dict([]), r"expected a mapping with a list 'cameras', got list"),  # type: ignore[arg-type]
    (lambda: file(7), r"camera 0: expected a mapping, got int"),
    (lambda: file(K="missing"), r"camera 'front': expected keys .*, missing K"),
    (lambda: file(distortion=[0.1]), r"camera 'front': distortion: expected null or \{model, coeffs\}"),
    (lambda: file(distortion={"model": "mei", "coeffs": []}), r"lens: expected one of .* got 'mei'"),
    (lambda: file(distortion={**RADTAN, "order": "k1,k2,k3,k4"}), "order: expected k1 k2 p1 p2 k3"),
    (lambda: file(distortion={**RADTAN, "xi": 2}), "distortion: 'xi' is not read"),
    (lambda: file(distortion=RADTAN, camera_model="mei"), "'camera_model' is not read"),
    (lambda: file(distortion=RADTAN, lens="equidistant"), "'lens' is not read"),
    (lambda: file(mask_file="nowhere.png"), r"'mask_file' is not read: did you mean 'mask'"),
    (lambda: file(lens="fisheye"), r"camera 'front': 'lens' is not read: write distortion: \{model: LENS"),
    *((lambda k=key, v=value: file(**{k: v}), rf"camera 'front': '{key}' is not read: .* got '{value}'") for key, value
      in (("lens_model", "fisheye"), ("camera_model", "ds"), ("distortion_model", "equidistant"))),
    (lambda: file(rectified=False), "camera 'front': 'rectified' is not read"),
    (lambda: file(ego2cam=[]), "'ego2cam' is not read"),
    (lambda: file(top={"lidar": [{}]}), "'lidar' is not read: did you mean 'lidars'"),
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
    *((lambda d=d: drawn(yaw_deg=d), f"RandomRig: yaw_deg: {WIDTH}") for d in ((3, 1), -1, 10**400, ("1", 2), True)),
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


def test_the_offered_rotation_and_published_digits_are_accepted() -> None:
    published = make(cam2ego=np.round(POSE, 5)).cam2ego
    assert np.abs(published[:3, :3] @ published[:3, :3].T - np.eye(3)).max() < 1e-12
    assert np.abs(published - POSE).max() < 1e-5 and np.array_equal(make(cam2ego=published).cam2ego, published)
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


# --- files of strangers: bounded, and numbers only where numbers are written
ONE_CAMERA = """
- name: front
  width: 64
  height: 32
  K: [[40, 0, 31.5], [0, 40, 15.5], [0, 0, 1]]
  cam2ego: [[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 1.5], [0, 0, 0, 1]]
"""


def bomb(levels: int) -> str:
    lines = ["a0: &a0 [1, 2, 3, 4, 5, 6, 7, 8, 9]"]
    lines += [f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, levels)]
    return "\n".join([*lines, f"cameras: *a{levels - 1}"])


MERGES = "\n".join(
    ["a0: &a0 {b: 1}", *(f"a{k}: &a{k}\n  <<: [{', '.join([f'*a{k - 1}'] * 9)}]" for k in range(1, 10)), "cameras: []"]
)


SOUND = f"cameras:{ONE_CAMERA}"
NUMBER, PLAIN = "K: expected|width_px: expected|distortion: expected", "expected plain YAML or JSON"
STRANGE: tuple[tuple[str | bytes, str], ...] = (
    (bomb(10), "more than 200000 values"),
    (MERGES, "more than 200000 values"),
    ("cameras: &a [1, *a]", "an alias within the value"),
    ("cameras: []\ncameras: []", "the key 'cameras' stands twice"),
    ("[" * 5000, PLAIN),
    ('name: !!timestamp "x"\ncameras: []', f"{PLAIN}.* not what its tag says"),
    (f"cameras:{''.join(ONE_CAMERA.replace('front', f'c{k}') for k in range(129))}", "at most 128 cameras, got 129"),
    *((text.replace("MARK", "{marker}"), PLAIN) for text in (
        "!!python/object/apply:os.system ['touch MARK']", "cameras: !!python/object/apply:os.system ['touch MARK']",
        "cameras: [!!python/name:os.system '']", "cameras: [{unclosed", "a: \x00")),
    (b"\xff\xfe\x00", PLAIN),
    *((SOUND.replace("[[40, 0, 31.5]", f"[[{one}, 0, 31.5]", 1), NUMBER) for one in ("true", "1:30", "yes")),
    (SOUND.replace("width: 64", "width: true"), NUMBER),
    (SOUND.replace("32", "32\n  distortion: {model: fisheye, coeffs: [true, 0, 0, 0]}", 1), NUMBER),
    (SOUND.replace("name: front", "name: front\n  name: back"), "stands twice"),
)  # fmt: skip


@pytest.mark.parametrize(("text", "message"), STRANGE)
@pytest.mark.timeout(20)
def test_files_of_strangers_are_refused(tmp_path: Path, text: str | bytes, message: str) -> None:
    path, marker = tmp_path / "rig.yaml", tmp_path / "executed"
    path.write_bytes(text if isinstance(text, bytes) else text.replace("{marker}", str(marker)).encode())
    with pytest.raises(CalibrationError, match=message) as error:
        load_rig(path)
    assert len(str(error.value)) < 1000 and not marker.exists()


def test_a_broken_json_is_refused(tmp_path: Path) -> None:
    (tmp_path / "rig.json").write_text('{"cameras": [')
    with pytest.raises(CalibrationError, match=PLAIN):
        load_rig(tmp_path / "rig.json")


@pytest.mark.timeout(20)
def test_a_double_in_large_json_is_found_soon():
    keys = [*range(100_000), 99_999]
    with pytest.raises(ValueError, match="the key 'a99999' stands twice"):
        parse_json("{" + ", ".join(f'"a{k}": 0' for k in keys) + "}")


def test_aliases_of_a_real_file_stay(tmp_path):
    path = tmp_path / "rig.yaml"
    cameras = ONE_CAMERA.replace("width: 64\n  height: 32", "<<: *base")
    path.write_text("_base: &base {width: 64, height: 32}\ncameras:" + cameras)
    assert load_rig(path)["front"].size == (32, 64)


def test_numbers_are_numbers_and_text_stays_text():
    assert parse_yaml("[1, -2, 1e3, 1.5, .5, -1.5e-3, 1.]") == [1, -2, 1000.0, 1.5, 0.5, -0.0015, 1.0]
    texts = ["1:30", "yes", "on", "0x10", "1_000", "2020-01-01"]
    assert parse_yaml(f"[{', '.join(texts)}]") == texts
    assert parse_yaml("[true, False, null, ~]") == [True, False, None, None]
    assert math.isinf(parse_yaml(".inf")) and math.isnan(parse_yaml(".nan")) and parse_yaml("") is None
    texts = ["08", "12e3", "1e3", "1.", ".5", ".inf", "0x10", "1:30", "yes", "True", "null", "~", "=", "<<", "12"]
    data = {text: [text, 1e30, 1e-7, -0.5, 3, None, True] for text in texts}
    assert parse_yaml(dump_yaml(data)) == data
