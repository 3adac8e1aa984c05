"""``python -m arbiview_aug bench neighbours``; and what frames without neighbours cost: nothing."""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug import RigRetarget
from arbiview_aug.__main__ import main
from arbiview_aug.cli.bench.neighbours import COLUMNS, lowered, nearest, travel_m
from arbiview_aug.cli.bench.timing import timed_rounds
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.frame_writer import write_drive
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.environment import one_thread
from arbiview_aug.temporal import fill
from arbiview_aug.transforms import rig_retarget
from tests.helpers import street_sample

TOLERANCE = 0.02
ROUNDS = 121
QUICK = ["--size", "32x88", "--reduce", "1", "--repeats", "1"]


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four frames, 1.5 m apart; most neighbours has the third."""
    root = tmp_path_factory.mktemp("drive")
    wanted = Neighbours(count=2, step_m=1.5)
    sample = SyntheticDrive(demo_source_rig((32, 88)), num_frames=1, lidar=False, neighbours=wanted)[0]
    write_drive(root, [sample, *sample["neighbours"][:3]])
    return root


@pytest.mark.slow
def test_command(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "neighbours.json"
    arguments = ["bench", "neighbours", *QUICK, "--surface", "street", "--output", str(path)]
    assert main([*arguments, "--data", str(drive), "--counts", "0", "1", "8"]) == 0
    report, printed = json.loads(path.read_text()), capsys.readouterr().out
    none, one, three = report["costs"]
    assert [cost["neighbours"] for cost in (none, one, three)] == [0, 1, 3]  # there are no more
    assert [cost["name"] for cost in (none, one)] == ["street, no neighbours", "street, 1 neighbour"]
    np.testing.assert_allclose(report["travel_m"], [1.5, 1.5, 3.0], atol=1e-6)
    assert none["filled"] == 0 < one["filled"] < three["filled"]
    assert none["ratio"] == 1 and all(cost[part][0] >= 0 for cost in (one, three) for part in ("plan", "fill", "frame"))
    assert all(heading in printed for heading, _ in COLUMNS) and f"report: {path}" in printed
    assert "neighbours up to 3.0 m away" in printed and report["machine"]["cpu"] and report["versions"]["torch"]


def test_frames_of_no_drive(ddad_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "neighbours", *QUICK, "--data", str(ddad_root)]) == 2
    assert "expected frames of a drive that moves, got none with neighbours" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["bench", "neighbours", "--step-m", "0"])


def test_the_nearest_come_first() -> None:
    def at(x_m: float) -> dict[str, Any]:
        pose = np.eye(4)
        pose[0, 3] = x_m
        return {"ego2world": pose}

    sample = at(5.0) | {"neighbours": [at(3.0), at(1.0), at(6.5), at(9.5)]}
    assert [travel_m(sample, n) for n in nearest(sample)] == [1.5, 2.0, 4.0, 4.5]


# --- without neighbours -----------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def sample() -> dict[str, Any]:
    return street_sample(lidar=False)


@pytest.mark.filterwarnings("ignore:target cameras")
@pytest.mark.parametrize("surface", ["street", "objects"])
def test_without_neighbours_nothing_of_fills_is_built_or_called(
    sample: dict[str, Any], surface: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither where a sample has none, nor where they are not wanted, nor where a list of them is empty."""
    target = lowered(sample["rig"], (32, 88))
    expected = RigRetarget(target, surface=surface, neighbours=None)(sample)
    for module, names in ((rig_retarget, ("plan_fills",)), (fill, ("build_plan", "merged"))):
        for name in names:
            monkeypatch.setattr(module, name, lambda *_, **__: pytest.fail("fills are made"))
    monkeypatch.setattr("arbiview_aug.sample.neighbours._neighbour", lambda *_: pytest.fail("a neighbour is looked at"))
    outputs = ("source_camera", "source_frame", "confidence")
    for frame, settings in (
        (sample, {}),
        (sample | {"neighbours": []}, {}),
        (sample | {"neighbours": [{"images": None}]}, {"neighbours": None}),
        (sample, {"outputs": outputs}),
    ):
        out = RigRetarget(target, surface=surface, **settings)(frame)
        assert all((out[key] == expected[key]).all() for key in ("images", "coverage"))


@pytest.mark.release
@pytest.mark.filterwarnings("ignore:target cameras")
def test_fast_costs_the_same_without_neighbours(report_bound: Callable[..., None]) -> None:
    """A transform that would read neighbours against itself told not to, on a sample that has none: the median of pairs
    of CPU times, in turn. Of two transforms one may be 7 % the slower, by where its memory lies."""
    sample = SyntheticDrive(demo_source_rig((450, 800)), num_frames=1, lidar=False)[0]
    del sample["boxes_3d"]
    retarget = RigRetarget(sample["rig"].turned(yaw_deg=22))

    def frame(reach: Any) -> None:
        retarget.reach = reach
        retarget(sample)

    work = {"reading": partial(frame, "ground"), "not": partial(frame, None)}
    with one_thread():
        times = timed_rounds(work, ROUNDS, "without neighbours")
    ratio, ms = (statistics.median(of.tolist()) for of in (times["reading"] / times["not"], times["reading"]))
    name = f"share of time that neighbours cost where there are none, fast, {ms:.1f} ms a frame"
    report_bound(name, abs(ratio - 1), at_most=TOLERANCE)
