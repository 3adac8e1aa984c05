"""``python -m arbiview_aug doctor``."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import pytest

from arbiview_aug import environment
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
    ("wheels", "is_fine", "text"),
    [
        ({"opencv-python": "5.0"}, True, "opencv-python 5.0, alone"),
        ({}, True, "not from a wheel"),
        ({"opencv-python": "5.0", "opencv-contrib-python": "4.9"}, False, "pip uninstall -y opencv-python opencv-c"),
    ],
)
def test_wheels_of_opencv(wheels: dict[str, str], is_fine: bool, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (doctor, environment):
        monkeypatch.setattr(module, "cv2_wheels", lambda: wheels)
    line = doctor._opencv()
    assert line[0] == is_fine and text in line[1]


def test_kernels_that_are_whole_damaged_and_missing(tmp_path: Path) -> None:
    folder = tmp_path / "room" / "__pycache__"
    folder.mkdir(parents=True)
    assert doctor._kernels(None) == (False, "compiled kernels: not kept; set NUMBA_CACHE_DIR to a writable folder")
    is_fine, text = doctor._kernels(str(folder))
    assert is_fine and text.startswith(f"compiled kernels: none in {tmp_path}; ")
    (folder / "kernels.sha256.nbi").write_bytes(b"index" + sha256(b"index").digest())
    (folder / "kernels.sha256.1.nbc").write_bytes(b"code" + sha256(b"other").digest())
    is_fine, text = doctor._kernels(str(folder))
    assert not is_fine and "1 files" in text and "1 damaged files are deleted" in text
    assert [path.name for path in folder.iterdir()] == ["kernels.sha256.nbi"] and doctor._kernels(str(folder))[0]


def test_a_package_without_metadata(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor.metadata, "version", lambda name: doctor.metadata.distribution("none"))
    assert doctor._extras() == ["unknown, since arbiview_aug is not installed"]


def test_a_problem_is_marked_and_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(doctor, "_lines", lambda _: iter([(True, "fine"), (False, "broken"), (True, "fine too")]))
    assert main(["doctor"]) == 1
    assert capsys.readouterr().out == "fine\nPROBLEM: broken\nfine too\n"
