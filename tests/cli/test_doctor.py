"""``python -m arbiview_aug doctor``."""

from __future__ import annotations

import re
from hashlib import sha256
from pathlib import Path

import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.cli import doctor


def test_a_sound_installation(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["doctor", "--size", "64x176"]) == 0
    printed = capsys.readouterr().out
    for part in ("numba ", "OpenCV: ", "threads: ", "GPUs: ", "compiled kernels: ", "free disk here: ", "street "):
        assert part in printed
    assert "generator yes" in printed and "PROBLEM" not in printed and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("wheels", "text"),
    [
        ({"opencv-python": "5.0"}, "OpenCV: opencv-python 5.0, alone"),
        ({}, "OpenCV: .* not from a wheel"),
        (
            {"opencv-python": "5.0", "opencv-contrib-python": "4.9"},
            "PROBLEM: OpenCV: .*pip uninstall -y opencv-python ",
        ),
    ],
)
def test_packages_and_problems(
    wheels: dict[str, str], text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "cv2_wheels", lambda: wheels)
    monkeypatch.setattr(doctor, "installed_version", lambda _: None)
    monkeypatch.setattr(doctor, "_frame", lambda _: (True, "a frame"))
    assert main(["doctor"]) == int(text.startswith("PROBLEM"))
    printed = capsys.readouterr().out
    assert re.search(f"^{text}", printed, re.MULTILINE) and "extras: unknown, since arbiview_aug is not inst" in printed


def test_kernels_that_are_whole_damaged_and_missing(tmp_path: Path) -> None:
    folder = tmp_path / "room" / "__pycache__"
    folder.mkdir(parents=True)
    assert doctor._kernels(None) == (False, "compiled kernels: not kept; set NUMBA_CACHE_DIR to a writable folder")
    is_fine, text = doctor._kernels(str(folder))
    assert is_fine and text.startswith(f"compiled kernels: 0 files in {tmp_path}; the first frames wait")
    (folder / "kernels.sha256.nbi").write_bytes(b"index" + sha256(b"index").digest())
    (folder / "kernels.sha256.1.nbc").write_bytes(b"code" + sha256(b"other").digest())
    is_fine, text = doctor._kernels(str(folder))
    assert not is_fine and "1 files" in text and "1 damaged files are deleted" in text
    assert [path.name for path in folder.iterdir()] == ["kernels.sha256.nbi"] and doctor._kernels(str(folder))[0]
