"""``python -m arbiview_aug doctor``."""

from __future__ import annotations

import re
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
    for part in ("numba ", "opencv ", "threads: ", "GPUs: ", "compiled kernels: ", "street "):
        assert part in printed
    assert "PROBLEM" not in printed and not list(tmp_path.iterdir())


def test_two_wheels_are_a_problem(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    installed = {"opencv-python": "5.0", "opencv-contrib-python": "4.9"}
    monkeypatch.setattr(environment, "installed_version", installed.get)
    monkeypatch.setattr(doctor, "_frame", lambda _: (True, "a frame"))
    assert main(["doctor"]) == 1
    assert re.search("^PROBLEM: OpenCV: .*pip uninstall -y opencv-python ", capsys.readouterr().out, re.MULTILINE)


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
