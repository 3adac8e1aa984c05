"""The study runner with a toy method, and plain mistakes in command lines."""

from __future__ import annotations

from functools import partial
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.frames import make_frame
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Method, Sample, retargeting
from arbiview_aug.evaluate.report.tables import metric_table
from integrations.benchmarks.study import study


def test_a_row_is_one_method() -> None:
    """A toy that paints everything grey is scored, timed and printed beside the others for one entry in the list."""

    def grey(sample: Sample, target: Rig) -> list[RenderedView]:
        return [RenderedView(np.full((*c.size, 3), 128, np.uint8), np.ones(c.size, bool)) for c in target]

    drive = SyntheticDrive(demo_source_rig((32, 88)), num_frames=1, lidar=False)
    frame = make_frame(drive[0], truth=partial(drive.render, 0), exposures=())
    rig = frame.sample["rig"]
    toy = Method("toy", grey)
    found = study(
        [retargeting("fast", "infinity", "far"), toy],
        [frame],
        {"same": [rig], "turned": [rig.turned(yaw_deg=5)]},
        consistency=True,
    )
    assert list(found) == ["far", "toy"]
    for row in found.values():
        assert len(row["ms"]) == len(row["plan_ms"]) == 2 and min(row["ms"]) >= 0
    assert found["far"]["same"]["true_psnr_db"] > 40 > found["toy"]["same"]["true_psnr_db"] > 3
    agree = [found["far"][kind]["consistency_raw_psnr_db"] for kind in ("same", "turned")]
    assert agree[0] != agree[1], "each set has its own pairs"
    rows = [{"name": name, **row["turned"]} for name, row in found.items()]
    printed = metric_table(rows, [("seen", "{seen:.0%}"), ("dB", "{true_psnr_db:.1f}"), ("never", "{unknown:.1f}")])
    assert printed.splitlines()[-1].startswith("| toy | 100% |") and printed.endswith("    - |")


@pytest.mark.parametrize(
    ("command", "said"),
    [
        ("ablation --only nosuch", "--only: expected part of one of stage 2"),
        ("cost --set nosuch=1", "--set nosuch=1: expected one of generator, "),
        ("generator --behind --steps 4", "--behind: expected no --steps with it"),
        ("hidden --output file", "--output file: expected a folder that can be written to, got "),
        ("hidden --size 50x128", "--size: expected multiples of 16, got 50x128"),
        ("joint --generator nosuch", "nosuch: expected a generator's folder with config.json, found none"),
        ("label_holes --streets 1", "--streets: expected 2 or more, got 1"),
        ("lidar --data nosuch", "--data nosuch: expected a folder with ddad-one and ddad-next, found no ddad-next"),
        ("moving_traffic --output file", "--output file: expected a folder that can be written to, got "),
        ("paper --data nosuch", "data nosuch: expected a folder, found none"),
        ("seams --data nosuch", "data nosuch: expected a folder, found none"),
        ("training --set nosuch=1", "--set nosuch=1: expected one of generator, "),
    ],
)
def test_mistakes_are_told(
    command: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    name, *arguments = command.split()
    assert import_module(f"integrations.benchmarks.{name}").main(arguments) == 2
    *_, line = capsys.readouterr().err.splitlines()  # after progress bars
    assert line.startswith(f"python -m integrations.benchmarks.{name}: {said}")


@pytest.mark.parametrize("name", ["generator", "hidden", "label_holes", "lidar", "moving_traffic", "tops"])
def test_seeds_are_not_negative(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        import_module(f"integrations.benchmarks.{name}").main(["--seed", "-1"])
    assert "argument --seed: expected a whole number from 0" in capsys.readouterr().err
