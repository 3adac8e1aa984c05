"""``python -m arbiview_aug bench ablation``: its rows are settings that work, and its figures tell them apart."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from arbiview_aug import RigRetarget
from arbiview_aug.__main__ import main
from arbiview_aug.bench.ablation import OWN_CAMERA, ROWS, measure, settings_of, table
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.favs.config import PaperConfig


def test_rows_are_settings_and_no_two_are_alike() -> None:
    built = [RigRetarget(demo_source_rig((32, 88)), **settings_of(name)) for name in ROWS]
    assert len({repr(retarget) for retarget in built}) == len(ROWS)
    switched = {name for name in PaperConfig.__dataclass_fields__ if name.startswith("use_")}
    off = {
        name for r in built for name in switched if isinstance(r.config, PaperConfig) and not getattr(r.config, name)
    }
    assert off == switched - {"use_detections"}, "each stage and weight of the paper is off somewhere"


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_street_tells_the_surfaces_apart() -> None:
    names = ["paper without stages 2 and 3", "fast on the street surface", "fast on the far surface", OWN_CAMERA]
    report = json.loads(json.dumps(measure(None, names, size=(64, 176))))
    paper, street, far, own = (report["rows"][name] for name in names)
    assert report["raw_overlap_db"] is None and list(report["rows"]) == names
    assert street["psnr_db"] > far["psnr_db"] > own["psnr_db"] and abs(paper["psnr_db"] - far["psnr_db"]) < 1
    assert street["raised_psnr_db"] > far["raised_psnr_db"]
    assert all(row["ms"] > 0 and row["rmse"] > row["mae"] > 0 for row in (paper, street, far, own))
    printed = table(report)
    assert all(name in printed for name in (*names, *report["published"])) and f"{street['psnr_db']:.2f}" in printed


def test_command(nuscenes_root: Path, fisheye_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "ablation.json"
    only = ["--only", "fast on the street", "--reduce", "4", "--output", str(path)]
    assert main(["bench", "ablation", "--data", str(nuscenes_root), "--json", *only]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report == json.loads(path.read_text()) and report["data"] == "nuscenes-one"
    assert report["rows"]["fast on the street surface"]["psnr_db"] > 20 and report["size"] == [225, 400]
    overlap = report["raw_overlap_db"]
    assert overlap["harmonised"] > overlap["as recorded"] + 3
    assert main(["bench", "ablation", "--data", str(fisheye_root), *only]) == 2
    assert "expected LiDAR points to score by, got none" in capsys.readouterr().err
    with pytest.raises(SystemExit, match="2"):
        main(["bench", "ablation", "--only", "no such row"])
