"""``python -m integrations.benchmarks.ablation``: its rows are settings that work, and its figures tell them apart."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from arbiview_aug.evaluate.frames import ScoredFrame
from arbiview_aug.evaluate.methods import Method
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.transforms.settings import render_config
from integrations.benchmarks import ablation
from integrations.benchmarks.ablation import NOTES, ROWS, STEPS, SYNTHETIC, Step, main, markdown, measure, step_figures


def test_no_two_rows_are_alike_and_steps_need_all() -> None:
    assert len(set(ROWS.values())) == len(ROWS)
    assert {row for step in STEPS.values() for row in (step.row, step.without)} == set(ROWS)
    configs = [render_config(row.quality) for row in ROWS.values()]
    switched = {name for name in PaperConfig.__dataclass_fields__ if name.startswith("use_")}
    off = {name for c in configs for name in switched if isinstance(c, PaperConfig) and not getattr(c, name)}
    assert off == switched - {"use_detections"}, "each stage and weight of the paper is off somewhere"


@pytest.mark.parametrize(
    ("step", "changed"),
    [
        ("stage 2, matching", {"use_feature_matching"}),
        ("w_quality", {"use_quality_weight"}),
        ("bilinear, not nearest", {"interpolation"}),
        ("blended seams", {"seam_width"}),
        ("antialiasing", {"antialias"}),
        ("depth from overlap", {"overlap_depth"}),
        ("street, not far", {"surface"}),
        ("boxes on the street", {"surface", "reads"}),
        ("motion on the street", {"surface", "reads"}),
        ("boxes beside LiDAR", {"reads"}),
        ("learned, fused", {"reads"}),
        ("harmonising", {"harmonise"}),
    ],
)
def test_a_step_changes_one_thing(step: str, changed: set[str]) -> None:
    one, two = (ROWS[name] for name in (STEPS[step].row, STEPS[step].without))
    configs = [vars(render_config(row.quality)) for row in (one, two)]
    found = {name for name, value in configs[0].items() if value != configs[1][name]}
    found |= {name for name in one._fields if name != "quality" and getattr(one, name) != getattr(two, name)}
    assert found == changed


def test_figures_of_a_step() -> None:
    low = {"turned": {"db": 29.0}, "raised": {"db": 20.5}, "plan_ms": [5.0] * 3}
    row = {"turned": {"db": 30.0}, "raised": {"db": 20.0}, "ms": [12.0, 14.0, 16.0], "plan_ms": [40.0] * 3}
    ms = {"draft": [10.0, 10.0, 10.0], "fast, far": [13.0, 14.0, 15.0], "fast, LiDAR": [10.0, 10.0, 10.0]}
    rows = {"fast": row, "fast, objects": row, **{name: {**low, "ms": of_row} for name, of_row in ms.items()}}
    found = step_figures(Step("fast", "draft"), rows, "db")
    assert found["ms"] == 14 and found["added_ms"] == {"median_ms": 4, "q1_ms": 3, "q3_ms": 5}
    assert found["turned"] == {"psnr_db": 30, "gain_db": 1, "gain_db_per_ms": 0.25}
    assert found["raised"] == {"psnr_db": 20, "gain_db": -0.5, "gain_db_per_ms": -0.125}
    replanned = step_figures(Step("fast, objects", "draft"), rows, "db")
    assert replanned["ms"] == 54 and replanned["added_ms"]["median_ms"] == 44, "its plan is paid in every frame"
    both = step_figures(Step("fast, objects", "fast, LiDAR"), rows, "db")
    assert both["ms"] == 54 and both["added_ms"]["median_ms"] == 39, "and so is that of what it is compared with"
    assert step_figures(Step("fast", "fast, far"), rows, "db")["turned"]["gain_db_per_ms"] is None, "-1, 0 and 1 ms"


def test_geometry_that_a_row_does_not_read_is_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[set[str]] = []
    monkeypatch.setattr(ablation, "retargeting", lambda *_, **__: Method("", lambda sample, _: given.append({*sample})))
    sample = dict.fromkeys(("images", "rig", "points", "boxes_3d", "motion_depth_m", "learned_depth_m", "neighbours"))
    for name in ("fast", "fast, LiDAR", "fast, fused without motion"):
        ROWS[name].method(name).render(sample, None)
    plain = {"images", "rig"}
    assert given == [plain, plain | {"points"}, plain | {"points", "boxes_3d", "learned_depth_m"}]
    assert ROWS["fast, LiDAR"].fits(ScoredFrame(sample)) and not ROWS["fast, LiDAR"].fits(ScoredFrame({}))


def test_the_table() -> None:
    move = {"psnr_db": 28.514, "gain_db": -0.001, "gain_db_per_ms": -0.0001}
    step = {"ms": 22.84, "added_ms": {"median_ms": 1.94}, "turned": move, "raised": {**move, "gain_db": 1.5}}
    slow = {**step, "ms": 410.2, "turned": {**move, "gain_db_per_ms": None}}
    sets = {
        "here": {
            "steps": {"blended seams": step, "harmonising": slow},
            "overlap": [{"overlap_raw_psnr_db": 15.15}, {}],
        },
        "there": {"steps": {"harmonising": slow}, "overlap": []},
    }
    text = markdown({"data": sets})
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:1] == "|"]
    assert cells[0][2:] == ["here: turned", "raised", "ms", "mdB a ms", "there: turned", "raised", "ms", "mdB a ms"]
    assert cells[2] == ["blended seams", "fast", "28.51 (+0.00)", "28.51 (+1.50)", "22.8 (+1.9)", "+0 / +0", *"----"]
    assert cells[3][:6] == ["harmonising", "fast, harmonised", "28.51 (+0.00)", "28.51 (+1.50)", "410 (+2)", "no time"]
    assert len(cells) == 4, "rows without figures are left out"
    assert text.startswith(NOTES) and text.endswith("in dB, here 15.15 to -.")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_street_tells_the_surfaces_apart() -> None:
    report = json.loads(json.dumps(measure([], list(STEPS), size=(64, 176))))
    street = report["data"][SYNTHETIC]
    assert list(street["rows"]) == list(ROWS) and list(street["steps"]) == list(STEPS), (
        "it has all geometry and the truth"
    )
    steps, rows = street["steps"], street["rows"]
    geometry = [name for name in STEPS if name.endswith("on the street")]
    for name in ("street, not far", "ground, not far", *geometry):
        assert steps[name]["turned"]["gain_db"] > 0.3 and steps[name]["raised"]["gain_db"] > 0.3, name
    assert steps["antialiasing"]["turned"]["gain_db"] > 0 < steps["bilinear, not nearest"]["turned"]["gain_db"]
    stages_1_and_4, far = rows["paper without stages 2 and 3"]["turned"], rows["fast, far"]["turned"]
    assert abs(stages_1_and_4["true_psnr_db"] - far["true_psnr_db"]) < 1
    assert all(min(row["ms"]) > 0 and row["turned"]["true_rmse"] > row["turned"]["true_mae"] for row in rows.values())
    assert steps["depth from overlap"]["ms"] > 2 * steps["depth from overlap, held"]["ms"]
    printed = markdown(report)
    assert all(f"| {name} " in printed for name in STEPS) and f"{steps['blended seams']['ms']:.1f} (" in printed


@pytest.mark.slow
def test_command(nuscenes_root: Path, fisheye_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "ablation.json"
    arguments = ["--downscale", "4", "--output", str(path)]
    assert main([*arguments, "--data", str(nuscenes_root), "--only", "harmonising"]) == 0
    report = json.loads(path.read_text())
    assert list(report["data"]) == ["nuscenes-one"] and "| harmonising " in capsys.readouterr().out
    found = report["data"]["nuscenes-one"]
    assert list(found["rows"]) == ["fast", "fast, harmonised"] and found["size"] == [225, 400]
    assert found["rows"]["fast"]["turned"]["even_psnr_db"] == found["steps"]["harmonising"]["turned"]["psnr_db"] + (
        -found["steps"]["harmonising"]["turned"]["gain_db"]
    )
    before, after = (of["overlap_raw_psnr_db"] for of in found["overlap"])
    assert after > before + 3
    assert main([*arguments, "--data", str(fisheye_root)]) == 2
    assert "expected LiDAR points to score by, got none" in capsys.readouterr().err
    assert main([*arguments, "--only", "no such step"]) == 2
    assert main([*arguments, "--data", str(nuscenes_root), str(nuscenes_root)]) == 2
    assert "expected folders of different names" in capsys.readouterr().err
