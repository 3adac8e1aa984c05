"""The view command: a recording that Rerun reads, and errors that name what is missing."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.cli.view import SampleRecording
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from tests.helpers import write_drive


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A drive of three small frames."""
    root, ahead = tmp_path_factory.mktemp("drive"), Neighbours(count=2, direction="future")
    sample = SyntheticDrive(demo_source_rig((24, 64)), num_frames=1, neighbours=ahead)[0]
    write_drive(root, [sample, *sample["neighbours"]])
    return str(root)


def rerun(*arguments: str | Path) -> str:
    """Output of Rerun's own command."""
    command = [sys.executable, "-m", "rerun", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=100).stdout


@pytest.mark.slow
def test_rerun_reads_the_recording(drive: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A drive whose target has lenses and scanners."""
    pytest.importorskip("rerun")
    path = tmp_path / "new" / "drive.rrd"
    assert main(["view", drive, "--frames", "2", "--target", "waymo", "--output", str(path)]) == 0
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
    drive: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["view", drive, "--frames", "2", "--output", str(tmp_path / "drive.rrd")]) == 2
    expected = "python -m arbiview_aug view: rerun is not installed: pip install 'arbiview_aug[viewer]'\n"
    assert capsys.readouterr().err == expected


def test_an_older_recording_stays_where_a_new_one_fails(
    drive: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rerun")
    asked = ["view", drive, "--size", "8x22", "--frames", "1", "--output", str(tmp_path / "drive.rrd")]
    assert main(asked) == 0
    before = (tmp_path / "drive.rrd").read_bytes()
    monkeypatch.setattr(SampleRecording, "add", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        main(asked)
    assert (tmp_path / "drive.rrd").read_bytes() == before and len(list(tmp_path.iterdir())) == 1
