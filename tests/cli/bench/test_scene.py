"""``python -m arbiview_aug bench scene``: what is not required is not done, by the counters; the view is the same."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.cameras.overlap import adjacent_pairs
from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.cli.bench.scene import Done, Situation, done, situations, subsets
from tests.helpers import street_sample

SIZE = (72, 200)


@pytest.fixture(scope="module")
def sample() -> dict[str, Any]:
    return street_sample(SIZE)


@pytest.fixture(scope="module")
def found(sample: dict[str, Any]) -> dict[str, tuple[Situation, Done, Done]]:
    result = {}
    for situation in situations(sample):
        required, otherwise = done((situation.required, situation.otherwise), 1, situation.name)
        result[situation.name] = situation, required, otherwise
    return result


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_what_is_done(found: dict[str, tuple[Situation, Done, Done]]) -> None:
    def of(start: str) -> tuple[Done, Done]:
        (name,) = (name for name in found if name.startswith(start))
        return found[name][1:]

    required, otherwise = of("cameras turned")
    assert required.pairs["far"] == 6 and "far" not in otherwise.pairs and otherwise.pairs["street"] >= 12

    for start in ("target = source", "one source sees all"):
        required, otherwise = of(start)
        assert required.pairs == {"far": 6} and required.cells[1] == required.bands == 0 and required.sources == 6
        assert otherwise.pairs["street"] > 6 and sum(otherwise.cells) > sum(required.cells)
    assert of("target = source")[1].bands > 0

    required, otherwise = of("the same, accurate")
    assert required.overlaps == 0 and not required.planned_each_frame and required.pairs == {"far": 6}
    assert otherwise.overlaps == 6 and otherwise.planned_each_frame

    required, otherwise = of("LiDAR, turned")
    pixels = 6 * SIZE[0] * SIZE[1]
    assert 0 < required.dense_pixels < 0.6 * pixels < otherwise.dense_pixels == pixels
    assert required.pairs["far"] == 6 and "far" not in otherwise.pairs

    for start in ("LiDAR, one source", "LiDAR, all cameras"):
        required, otherwise = of(start)
        assert set(required.pairs) == {"far"} and required.dense_pixels == 0 and not required.planned_each_frame
        assert set(otherwise.pairs) == {"lidar"} and otherwise.dense_pixels > 0 and otherwise.planned_each_frame

    required, otherwise = of("3 cameras without overlap")
    assert required.overlaps == required.bands == 0 and required.sources == 3 and not required.planned_each_frame
    assert otherwise.overlaps == 2 and otherwise.bands > 0 and otherwise.planned_each_frame

    required, otherwise = of("a sample that p skips")
    assert required.plan_ms is None and required.pairs == {} and otherwise.plan_ms is not None
    assert all(of_case.frame_ms > 0 for _, *of_both in found.values() for of_case in of_both)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_sparing_work_changes_no_view(found: dict[str, tuple[Situation, Done, Done]]) -> None:
    """But where a source was exact: there the street, or points, were a guess."""
    compared = 0
    for name, (situation, *_) in found.items():
        if "without overlap" in name or "LiDAR" in name:
            continue  # other cameras; points hide pixels from sources that do not stand at the target's centre
        one, two = (case.retarget()(case.sample) for case in (situation.required, situation.otherwise))
        both = (one["coverage"] & two["coverage"])[:, None].expand_as(one["images"])
        assert both.float().mean() > 0.7
        off = (one["images"].double() - two["images"].double()).abs()[both]
        assert off.quantile(0.9) <= 2, name
        compared += 1
    assert compared == 5


def test_subsets() -> None:
    rig = load_rig("nuscenes")
    apart, together = subsets(rig)
    assert len(apart) == len(together) == 3
    assert not adjacent_pairs(rig.with_cameras([rig[k] for k in apart]))
    assert len(adjacent_pairs(rig.with_cameras([rig[k] for k in together]))) == 2


def test_command(tmp_path: Path, fisheye_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "scene.json"
    arguments = ["bench", "scene", "--data", str(fisheye_root), "--reduce", "4", "--repeats", "1"]
    assert main([*arguments, "--only", "p skips", "--output", str(path)]) == 0
    report = json.loads(path.read_text())
    (situation,) = report["situations"]
    printed = capsys.readouterr().out
    assert report["data"] == "surround-fisheye" and report["machine"]["cpu"] and report["versions"]["torch"]
    assert situation["name"] in printed and f"{situation['required']['frame_ms']:.1f}" in printed
    assert f"report: {path}" in printed
    with pytest.raises(SystemExit, match="2"):
        main([*arguments, "--only", "LiDAR"])  # it has no points
