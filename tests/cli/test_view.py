"""The view command: a recording that Rerun reads, and errors that name what is missing."""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path

import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.cli.view import SampleRecording, _frames

TINY = ["--size", "24x64", "--frames", "2"]


def rerun(*arguments: str | Path) -> str:
    """Output of Rerun's own command."""
    command = [sys.executable, "-m", "rerun", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=100).stdout


@pytest.mark.slow
def test_rerun_reads_the_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A drive whose target has lenses and scanners."""
    pytest.importorskip("rerun")
    path = tmp_path / "new" / "drive.rrd"
    assert main(["view", *TINY, "--target", "waymo", "--output", str(path)]) == 0
    assert f"recording: {path} (2 frames, " in capsys.readouterr().out
    rerun("rrd", "verify", path)
    printed = rerun("rrd", "print", path)
    cameras = {"source": "front", "target": "FRONT"}
    paths = [f"/ego/{side}/{name}/{layer}" for side, name in cameras.items() for layer in ("image", "boxes")]
    paths += [f"/ego/target/FRONT/{layer}" for layer in ("coverage", "confidence", "frustum")]
    for entity in (*paths, "/ego/boxes", "/ego/source_points", "/ego/target_points", "/ego/source/front"):
        assert f"{entity} " in printed, entity
    assert "/ego/source/front/frustum" not in printed  # it has no lens


def test_without_rerun_one_line_says_how_to_install_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["view", *TINY, "--output", str(tmp_path / "drive.rrd")]) == 2
    expected = "python -m arbiview_aug view: rerun is not installed: pip install 'arbiview_aug[viewer]'\n"
    assert capsys.readouterr().err == expected


def test_an_older_recording_stays_where_a_new_one_fails(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("rerun")
    asked = ["view", "--size", "8x22", "--frames", "1", "--output", str(tmp_path / "drive.rrd")]
    assert main(asked) == 0
    before = (tmp_path / "drive.rrd").read_bytes()
    monkeypatch.setattr(SampleRecording, "add", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(asked)
    assert (tmp_path / "drive.rrd").read_bytes() == before and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("count", [1, 3])
def test_frames_of_a_street_for_depth_from_motion(count: int) -> None:
    """Each frame has the others, which depth from motion needs; for other geometries none."""
    arguments = argparse.Namespace(data=None, size=(8, 22), seed=0, frames=count, geometry="motion")
    frames = list(_frames(arguments))
    assert [len(frame["neighbours"]) for frame in frames] == [max(1, count - 1)] * count
    arguments.geometry = "auto"
    assert not any("neighbours" in frame for frame in _frames(arguments))
