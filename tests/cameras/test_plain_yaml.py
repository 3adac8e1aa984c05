"""Rig files of strangers: bounded, and numbers only where numbers are written."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from arbiview_aug import load_rig
from arbiview_aug.cameras.plain_yaml import dump_yaml, parse_json, parse_yaml
from arbiview_aug.errors import CalibrationError

CAMERA = """
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


SOUND = f"cameras:{CAMERA}"
NUMBER, PLAIN = "K: expected|width_px: expected|distortion: expected", "expected plain YAML or JSON"
REFUSED: tuple[tuple[str | bytes, str], ...] = (
    (bomb(10), "more than 200000 values"),
    (MERGES, "more than 200000 values"),
    ("cameras: &a [1, *a]", "an alias within the value"),
    ("cameras: []\ncameras: []", "the key 'cameras' stands twice"),
    ("[" * 5000, PLAIN),
    ('name: !!timestamp "x"\ncameras: []', f"{PLAIN}.* not what its tag says"),
    ('name: !!int ""\ncameras: []', "not what its tag says"),
    ('name: !!bool "maybe"\ncameras: []', "not what its tag says"),
    (f"cameras:{''.join(CAMERA.replace('front', f'c{k}') for k in range(129))}", "at most 128 cameras, got 129"),
    (SOUND.replace("64", str([list(range(50))] * 50)), "camera 'front': width_px"),
    *((text.replace("MARK", "{marker}"), PLAIN) for text in (
        "!!python/object/apply:os.system ['touch MARK']", "cameras: !!python/object/apply:os.system ['touch MARK']",
        "cameras: [!!python/name:os.system '']", "cameras: [{unclosed", "a: \x00")),
    (b"\xff\xfe\x00", PLAIN),
    *((SOUND.replace("[[40, 0, 31.5]", f"[[{one}, 0, 31.5]", 1), NUMBER) for one in ("true", "1:30", "yes")),
    (SOUND.replace("width: 64", "width: true"), NUMBER),
    (SOUND.replace("32", "32\n  distortion: {model: fisheye, coeffs: [true, 0, 0, 0]}", 1), NUMBER),
    (SOUND.replace("name: front", "name: front\n  name: back"), "stands twice"),
)  # fmt: skip


@pytest.mark.parametrize(("text", "message"), REFUSED)
@pytest.mark.timeout(20)
def test_files_of_strangers_are_refused(tmp_path: Path, text: str | bytes, message: str) -> None:
    path, marker = tmp_path / "rig.yaml", tmp_path / "executed"
    path.write_bytes(text if isinstance(text, bytes) else text.replace("{marker}", str(marker)).encode())
    with pytest.raises(CalibrationError, match=message) as error:
        load_rig(path)
    assert len(str(error.value)) < 1000 and not marker.exists()


def test_sound_and_broken_files(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(SOUND)
    assert load_rig(tmp_path / "rig.yaml").names == ["front"]
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
    cameras = CAMERA.replace("width: 64\n  height: 32", "<<: *base")
    path.write_text("_base: &base {width: 64, height: 32}\ncameras:" + cameras)
    assert load_rig(path)["front"].size == (32, 64)


def test_numbers_are_numbers():
    assert parse_yaml("[1, -2, 1e3, 1.5, .5, -1.5e-3, 1.]") == [1, -2, 1000.0, 1.5, 0.5, -0.0015, 1.0]
    texts = ["1:30", "yes", "on", "0x10", "1_000", "2020-01-01"]
    assert parse_yaml(f"[{', '.join(texts)}]") == texts
    assert parse_yaml("[true, False, null, ~]") == [True, False, None, None]
    assert math.isinf(parse_yaml(".inf")) and math.isnan(parse_yaml(".nan")) and parse_yaml("") is None


def test_text_stays_text():
    texts = ["08", "12e3", "1e3", "1.", ".5", ".inf", "0x10", "1:30", "yes", "True", "null", "~", "=", "<<", "12"]
    data = {text: [text, 1e30, 1e-7, -0.5, 3, None, True] for text in texts}
    assert parse_yaml(dump_yaml(data)) == data
