"""The paper's tables: its own numbers as printed, and ours beside them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.evaluate import paper_tables
from arbiview_aug.evaluate.methods import Method, baseline, retargeting
from arbiview_aug.evaluate.paper_tables import PROTOCOL, PUBLISHED, Study, measure_paper, paper_report


def methods() -> list[Method]:
    return [baseline("own camera"), retargeting("fast", "street", "fast")]


@pytest.fixture
def no_real_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("ARBIVIEW_DATA", raising=False)


def test_published_numbers() -> None:
    """Tables 1 and 2 of the paper; RMSE and PSNR belong together but for the row of FAVS."""
    assert PUBLISHED["crop and slide"][1:] == (9.5647, 0.8542, 72.4672, 87.5129)
    assert PUBLISHED["own camera"][1:] == (9.3167, 0.8339, 74.1309, 88.7707)
    assert PUBLISHED["paper"][1:] == (11.8707, 0.8813, 42.4985, 55.1446)
    assert PUBLISHED["generator"][1:] == (14.2335, 0.9691, 38.2820, 49.5294)
    assert "55.14 is 13.30 dB" in PROTOCOL


@pytest.mark.filterwarnings("ignore:the target rig")
def test_synthetic_streets(no_real_frames: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_tables, "SETS", ("paper", "truck"))
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
    lines = report.splitlines()
    (row,) = [line for line in lines if line.startswith("| own camera |")]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[1] == f"{own['raw_psnr_db']:.2f}" and cells[6:11] == [
        "Geometric, Table 2",
        "9.32",
        "0.8339",
        "74.13",
        "88.77",
    ]
    (ours,) = [line for line in lines if line.startswith("| generator |")]
    assert ours.split("|")[2].strip() == "-" and "14.23" in ours, "a row that waits for its method"
    assert report.endswith(PROTOCOL) and json.dumps(study.as_dict())


def test_real_frames(nuscenes_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_tables, "SETS", ("paper", "truck"))
    monkeypatch.setattr(paper_tables, "REDUCE", 4)
    study = measure_paper(nuscenes_root, methods=methods())
    assert list(study.means) == ["nuscenes-one"]
    own, fast = (study.means["nuscenes-one"][name] for name in ("own camera", "fast"))
    assert {"raw_psnr_db", "even_psnr_db"} <= set(own["paper"])
    assert "even_psnr_db" in own["truck"] and "raw_psnr_db" not in own["truck"], "exposure is no geometry"
    assert fast["paper"]["even_psnr_db"] > own["paper"]["even_psnr_db"] + 8
    assert "exposures made even" in paper_report(study)


def test_lenses_are_told(fisheye_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper_tables, "SETS", ("truck",))
    monkeypatch.setattr(paper_tables, "REDUCE", 4)
    study = measure_paper(fisheye_root, methods=[baseline("row split"), retargeting("draft", "far", "draft")])
    assert list(study.means["surround-fisheye"]) == ["draft"]
    assert "expected pinhole cameras" in study.declined["surround-fisheye, row split"]
    assert "surround-fisheye, row split: row_split: expected pinhole cameras" in paper_report(study)


def test_missing_frames_are_left_out(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARBIVIEW_DATA", str(tmp_path))
    monkeypatch.setattr(paper_tables, "SETS", ("truck",))
    assert list(measure_paper(frames=1, size=(16, 44), methods=methods()[:1]).means) == ["synthetic"]


def test_the_command(
    no_real_frames: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(paper_tables, "SETS", ("truck",))
    assert main(["evaluate", "--paper", "--size", "24x66", "--frames", "1", "--output", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "| paper without stage 3, objects |" in printed and PROTOCOL in printed
    assert (tmp_path / "paper.md").read_text().strip() in printed
    assert set(json.loads((tmp_path / "paper.json").read_text())) == {"means", "published", "protocol", "declined"}


def test_an_empty_study() -> None:
    assert paper_report(Study()) == PROTOCOL
