"""The paper's tables: its own numbers as printed, and ours beside them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from arbiview_aug.evaluate.methods import Method, retargeting
from arbiview_aug.favs.config import PaperConfig
from integrations.benchmarks import paper
from integrations.benchmarks.baselines import BASELINES, method_of
from integrations.benchmarks.paper import (
    PROTOCOL,
    PUBLISHED,
    Study,
    main,
    measure_paper,
    paper_report,
    paper_stages,
    study_methods,
)


def methods() -> list[Method]:
    return [method_of("own camera", BASELINES["own camera"]), retargeting("fast", "street", "fast")]


@pytest.fixture
def no_real_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ARBIVIEW_DATA", raising=False)


def test_published_numbers() -> None:
    """Tables 1 and 2 of the paper; RMSE and PSNR belong together but for the row of FAVS."""
    assert tuple(PUBLISHED["crop and slide"].values())[1:] == (9.5647, 0.8542, 72.4672, 87.5129)
    assert tuple(PUBLISHED["own camera"].values())[1:] == (9.3167, 0.8339, 74.1309, 88.7707)
    assert tuple(PUBLISHED["paper"].values())[1:] == (11.8707, 0.8813, 42.4985, 55.1446)
    assert tuple(PUBLISHED["generator"].values())[1:] == (14.2335, 0.9691, 38.2820, 49.5294)
    assert "55.14 is 13.30 dB" in PROTOCOL


@pytest.mark.filterwarnings("ignore:the target rig")
@pytest.mark.slow
def test_synthetic_streets(no_real_frames: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper, "SETS", ("paper", "truck"))
    told = []
    study = measure_paper(
        None, frames=1, size=(32, 88), methods=methods(), tick=lambda what, of: told.append((what, of))
    )
    assert list(study.means) == ["synthetic"] and not study.declined
    found = study.means["synthetic"]
    assert list(found) == ["own camera", "fast"] and all(list(kinds) == ["paper", "truck"] for kinds in found.values())
    assert len(told) == told[-1][1] == (6 + 1) * 2, "targets, methods"
    own, fast = found["own camera"]["paper"], found["fast"]["paper"]
    assert fast["raw_psnr_db"] > own["raw_psnr_db"] + 3 and fast["seen"] > own["seen"] + 0.1
    assert "true_psnr_db" in fast and "even_psnr_db" not in fast
    report = paper_report(study)
    six, others = [[row for row in rows_of(report) if len(row) == length] for length in (9, 3)]
    assert six[0] == ["", *"published: PSNR,SSIM,MAE,RMSE,synthetic: PSNR,SSIM,MAE,RMSE".split(",")]
    assert six[2][:5] == ["own camera (Geometric, Table 2)", "9.32", "0.8339", "74.13", "88.77"]
    assert six[2][5:7] == [f"{own['raw_psnr_db']:.2f}", f"{own['raw_ssim']:.4f}"]
    assert six[3][:5] == ["fast", *"----"], "the paper has none of it"
    assert six[-1] == ["generator (ArbiViewGen, Tables 1 and 2)", "14.23", "0.9691", "38.28", "49.53", *"----"]
    assert others[0] == ["", "synthetic: six", "truck"] and [row[0] for row in others[2:]] == ["own camera", "fast"]
    assert others[3][1] == f"{fast['true_psnr_db']:.2f} / {fast['true_covered_psnr_db']:.2f}"
    assert report.endswith(PROTOCOL) and json.dumps(study.as_dict())


def rows_of(report: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in report.splitlines() if line[:1] == "|"]


def test_real_sets_stand_in_the_papers_measure() -> None:
    """Rows with a truth to compare with stand in the second table alone."""
    real = {"fast": {"paper": {"raw_psnr_db": 27.0, "even_psnr_db": 28.0}}}
    true = {"fast": {"paper": {"raw_psnr_db": 26.0, "true_psnr_db": 25.0, "true_covered_psnr_db": 24.0}}}
    rows = rows_of(paper_report(Study({"here": real, "street": true})))
    assert ["fast", *"----", "27.00", *"---"] in rows
    assert ["fast", "28.00", "25.00 / 24.00"] in rows


@pytest.mark.slow
def test_real_frames(nuscenes_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper, "SETS", ("paper", "truck"))
    monkeypatch.setattr(paper, "REDUCE", 4)
    study = measure_paper(nuscenes_root, methods=methods())
    assert list(study.means) == ["nuscenes-one"]
    own, fast = (study.means["nuscenes-one"][name] for name in ("own camera", "fast"))
    assert {"raw_psnr_db", "even_psnr_db"} <= set(own["paper"])
    assert "even_psnr_db" in own["truck"] and "raw_psnr_db" not in own["truck"], "exposure is no geometry"
    assert fast["paper"]["even_psnr_db"] > own["paper"]["even_psnr_db"] + 8
    assert "exposures made even" in paper_report(study)


@pytest.mark.slow
def test_the_command(
    no_real_frames: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(paper, "SETS", ("truck",))
    assert main(["--size", "24x66", "--frames", "1", "--output", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "| paper without stage 3, objects " in printed and PROTOCOL in printed
    assert set(json.loads((tmp_path / "paper.json").read_text())) == {"means", "published", "protocol", "declined"}


def test_rows_of_the_study() -> None:
    names = [method.name for method in study_methods()]
    assert names[: len(BASELINES)] == list(BASELINES) and {"paper", "draft", "fast", "accurate"} <= set(names)
    assert len(set(names)) == len(names)
    assert not any(method.reads_points for method in study_methods())


def test_stages_are_off_one_at_a_time() -> None:
    whole = PaperConfig()
    stages = paper_stages()
    assert stages["paper"] == whole
    off = {name: [k for k, v in vars(config).items() if v != getattr(whole, k)] for name, config in stages.items()}
    assert off["paper without stage 2, matching"] == ["use_feature_matching"]
    assert off["paper without stage 3, objects"] == ["use_object_alignment"]
    weights = off["paper without stage 4, weights"]
    assert len(weights) == 4 and all("weight" in key for key in weights)
