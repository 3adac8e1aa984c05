"""``evaluate`` and ``bench`` at a tiny size; numbers against the protocol in code."""

from __future__ import annotations

import json
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.__main__ import main
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli import evaluate as command
from arbiview_aug.cli.arguments import chosen_frames, gathered_warnings
from arbiview_aug.cli.bench import Row, pareto_front, table
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.frames import retargeting
from arbiview_aug.evaluate.metrics import RenderedView, as_arrays, as_tensors
from arbiview_aug.render.requirements import STATIC_HARM
from arbiview_aug.transforms.rig_retarget import RigRetarget

AGREEMENT_DB = 0.01


def run(arguments: list[str], folder: Path) -> dict:
    assert main(["evaluate", *arguments, "--output", str(folder)]) == 0
    return json.loads((folder / "evaluate.json").read_text())


def test_frames_are_spread_over_the_drive() -> None:
    assert chosen_frames(3, 10) == [0, 3, 6] and chosen_frames(99, 10) == [*range(10)]


def test_warnings_of_frames_are_one_of_the_run() -> None:
    lines: list[str] = []
    with gathered_warnings(lines):
        for k in range(3):
            warnings.warn(f"neighbour 'frame {k}' is left out: {k} m away", stacklevel=1)
            warnings.warn("the target cannot be reached", stacklevel=1)
    assert lines == ["neighbour 'frame 0' is left out: 0 m away (2 more like it)", "the target cannot be reached"]


def test_synthetic_street(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = run(["--size", "48x132", "--quality", "fast", "draft", "--geometry", "street", "infinity"], tmp_path)
    printed = capsys.readouterr().out
    assert "Against the true views" in printed
    rows = ["fast, street", "fast, infinity", "draft, street", "draft, infinity"]
    assert list(report["means"]) == rows
    street, far = report["means"]["fast, street"], report["means"]["fast, infinity"]
    assert street["true_covered_ground_psnr_db"] > far["true_covered_ground_psnr_db"] + 3
    assert {"true_hole_object_share", "true_covered_sky_psnr_db", "seen"} <= set(street)
    assert "raw_psnr_db" not in street, "where the truth is known, LiDAR need not score"
    assert len(report["views"]) == 4 * 5 and {row["camera"] for row in report["views"]} >= {"front", "side_left"}
    assert f"{street['true_covered_psnr_db']:.2f}" in printed
    assert "<h2>van</h2>" in (tmp_path / "report.html").read_text()


@pytest.mark.slow
def test_numbers_agree_with_the_protocol(
    referee: ModuleType, nuscenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command's sparse figures, against the protocol's metrics of the same renderings."""
    common = ["--data", str(nuscenes_root), "--downscale", "2", "--geometry", "street"]
    FrameFolder(nuscenes_root, reduce=2)[0]["rig"].turned(yaw_deg=22).save(tmp_path / "turned.yaml")
    report = run([*common, "--target", str(tmp_path / "turned.yaml")], tmp_path)
    assert "every other degree" not in capsys.readouterr().out
    sample = FrameFolder(nuscenes_root, reduce=2)[0]
    rig, points = sample["rig"], sample["points"].numpy()[:, :3].astype(float)
    cameras = {
        c.name: {"K": c.K, "cam2ego": c.cam2ego, "image": image, "mask": np.ones(c.size, np.uint8)}
        for c, image in zip(rig, as_arrays(sample["images"]), strict=True)
    }
    mean = report["means"]["fast, street"]
    for exposure, protocol in (("raw", cameras), ("even", referee.equalised(cameras, points))):

        def render(targets: list, protocol: dict = protocol) -> list[np.ndarray]:
            images = as_tensors([c["image"] for c in protocol.values()])
            return as_arrays(
                RigRetarget(rig.turned(yaw_deg=22), geometry="street", holes="black", match_exposure=False)(
                    {**sample, "images": images}
                )["images"]
            )

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            want = referee.score(render, protocol, points, [referee.rotated_targets(protocol, 22.0)])
        assert mean[f"{exposure}_psnr_db"] == pytest.approx(want["psnr"], abs=AGREEMENT_DB)
        assert mean[f"{exposure}_mae"] == pytest.approx(want["mae"], abs=0.01)
        assert mean[f"{exposure}_rmse"] == pytest.approx(want["rmse"], abs=0.02)
        assert mean[f"{exposure}_ssim"] == pytest.approx(want["ssim"], abs=1e-4)
        assert mean[f"{exposure}_points"] == pytest.approx(want["n"])


# --- judges -----------------------------------------------------------------------------------------------------------
JUDGES = """
import numpy as np

def detect(rgb):
    h, w = rgb.shape[:2]
    return [[0, 0, w / 2, h]], [0.6]

def blank(rgb):
    rgb[:] = 0
    return [], []

def segment(rgb):
    return np.stack([rgb[..., 0] > 100, rgb[..., 0] > 200])
"""


def test_judges_of_a_street(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "own.py").write_text(JUDGES)
    judges = ["--detector", f"{tmp_path}/own.py:detect", "--segmenter", f"{tmp_path}/own.py:segment"]
    rows = run(["--size", "48x132", "--geometry", "infinity", "--holes", "continue", *judges], tmp_path)["judges"]
    row, printed = rows["fast, infinity, continue"], capsys.readouterr().out
    assert len(rows) == 1 and row["objects"] == row["images"] == 5 and row["ap"] == row["recall"] == 1
    assert 0 < row["iou_1_low"] <= row["iou_1"] <= row["iou_1_high"] < 1
    assert "note: rows of fewer than 100 objects or 10 images are too few to tell methods apart" in printed
    page = (tmp_path / "report.html").read_text()
    for title in ("Objects that the detector finds", "Masks in views and true images"):
        assert title in printed and title in page


def test_a_judge_that_writes_into_its_image_changes_no_number(tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(JUDGES)
    asked = ["--size", "24x66", "--geometry", "infinity"]
    judged = run([*asked, "--detector", f"{tmp_path}/own.py:blank"], tmp_path)
    assert judged["views"] == run(asked, tmp_path)["views"]


def test_a_method_that_declines_a_frame_is_in_no_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    own, first = retargeting("fast", "infinity", "own"), list[object]()

    def render(sample: Mapping[str, Any], target: Rig) -> list[RenderedView]:
        first[:] = first or [sample["boxes_3d"]]
        if sample["boxes_3d"] is not first[0]:
            raise SampleError("too dark")
        return own.render(sample, target)

    monkeypatch.setattr(command, "_methods", lambda _: [own, replace(own, name="picky", render=render)])
    (tmp_path / "own.py").write_text(JUDGES)
    report = run(["--size", "24x66", "--frames", "2", "--detector", f"{tmp_path}/own.py:detect"], tmp_path)
    assert list(report["means"]) == ["own"] and list(report["judges"]) == ["own"]
    assert "note: picky: frame synthetic-0-1: too dark" in capsys.readouterr().out
    first.clear()
    monkeypatch.setattr(command, "_methods", lambda _: [replace(own, name="picky", render=render)])
    assert main(["evaluate", "--size", "24x66", "--frames", "2", "--output", str(tmp_path)]) == 2
    assert "frame synthetic-0-1: too dark" in capsys.readouterr().err


@pytest.mark.slow
def test_rows_do_not_depend_on_other_rows(tmp_path: Path) -> None:
    """Motion needs neighbours, which must not fill the holes of other rows."""
    target = tmp_path / "down.yaml"
    demo_source_rig((48, 132)).turned(pitch_deg=-12).shifted(z_m=0.6).save(target)
    given, chosen = ["--size", "48x132", "--target", str(target), "--geometry"], (["street"], ["street", "motion"])
    alone, beside = (run([*given, *names], tmp_path)["means"] for names in chosen)
    assert list(beside) == ["fast, street", "fast, motion"] and beside["fast, street"] == alone["fast, street"]


# --- python -m arbiview_aug bench -------------------------------------------------------------------------------------
SIZE = (64, 176)
SMALLEST = ["--size", "16x24", "--geometry", "infinity", "--downscale", "4"]


def point(name: str, ms: float, db: float) -> Row:
    return {"name": name, "psnr_db": db, "median_ms": ms}


DRAFT, FAST, LIDAR = point("draft", 4, 18), point("fast", 7, 20), point("lidar", 300, 28)
ALL = [LIDAR, point("as good, slower", 9, 20), point("as fast, worse", 7, 19), DRAFT, FAST]


def test_front_is_what_nothing_beats() -> None:
    for rows in (ALL, ALL[::-1]):
        assert [row["name"] for row in pareto_front(rows)] == ["draft", "fast", "lidar"]
    assert pareto_front([]) == []


# --- the sweep --------------------------------------------------------------------------------------------------------
@pytest.mark.slow
def test_the_sweep(tmp_path: Path) -> None:
    write_frame(tmp_path / "0", SyntheticDrive(demo_source_rig((128, 352)), num_frames=1)[0])
    only = ["--quality", "draft", "fast", "--geometry", "infinity", "street", "boxes", "--downscale", "1"]
    only += ["--data", str(tmp_path / "0")]
    assert main(["bench", *only, "--size", "64x176", "--output", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "pareto.json").read_text())
    rows: dict[str, Any] = {row["name"]: row for row in report["settings"]}
    assert len(rows) == 2 * 3 and report["against"].startswith("LiDAR points") and report["size"] == list(SIZE)
    for row in rows.values():
        assert 0 < row["q1_ms"] <= row["median_ms"] <= row["q3_ms"]
        assert 0.5 < row["seen"] <= 1 and row["psnr_db"] >= row["whole_psnr_db"] > 10
    assert rows["fast, street, 1/1"]["psnr_db"] > rows["fast, infinity, 1/1"]["psnr_db"] + 1
    assert rows["fast, street, 1/1"]["psnr_db"] > rows["draft, street, 1/1"]["psnr_db"]
    front = {name for name, row in rows.items() if row["front"]}
    assert max(rows, key=lambda name: rows[name]["psnr_db"]) in front
    printed = table(report)
    assert all(f"| {name}" in printed for name in front)
    # The target stands higher than the source: whatever they measure, static surfaces are not for training.
    assert "Static surfaces (infinity, ground, street) are not for training here: target cameras" in printed
    assert STATIC_HARM in printed and ". Better: 'points', 'depth_m' or" in printed


def test_frames_without_points_are_scored_by_held_out_cameras(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for count, code in ((3, 0), (1, 2)):
        rig = demo_source_rig((64, 176))
        rig = rig.with_cameras(list(rig)[:count])
        sample = SyntheticDrive(rig, num_frames=1)[0]
        write_frame(tmp_path / f"{count}", {key: value for key, value in sample.items() if key != "points"})
        data = ["--data", str(tmp_path / f"{count}"), "--quality", "draft", "--output", str(tmp_path)]
        assert main(["bench", *data, *SMALLEST]) == code
    said = capsys.readouterr()
    assert "against photographs of cameras rendered from the others" in said.out
    assert "expected LiDAR points or several cameras, to score by" in said.err


def test_points_that_no_camera_sees(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    sample = SyntheticDrive(demo_source_rig((64, 176)), num_frames=1)[0]
    write_frame(tmp_path / "0", sample | {"points": torch.zeros(0, 4)})
    data = ["--data", str(tmp_path / "0"), "--target", "ddad", "--quality", "draft", "--output", str(tmp_path)]
    assert main(["bench", *data, *SMALLEST]) == 2
    assert "expected LiDAR points in views of ddad that source cameras see" in capsys.readouterr().err


def test_paper_is_left_out_of_other_lenses(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_frame(tmp_path / "0", SyntheticDrive(load_rig("fisheye_surround").resized((64, 96)), num_frames=1)[0])
    command = ["bench", "--data", str(tmp_path / "0"), "--target", "ddad", "--output", str(tmp_path), *SMALLEST]
    assert main([*command, "--quality", "paper", "draft"]) == 0
    assert "note: left out, --quality paper: expected pinhole cameras, camera 'Front'" in capsys.readouterr().err
    assert [row["quality"] for row in json.loads((tmp_path / "pareto.json").read_text())["settings"]] == ["draft"]
    assert main([*command, "--quality", "paper"]) == 2 and "--quality paper: expected" in capsys.readouterr().err


def test_geometry_that_is_not_offered(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["bench", "--data", ".", "--geometry", "motion"])
    assert "invalid choice: 'motion'" in capsys.readouterr().err
    write_frame(tmp_path / "0", SyntheticDrive(demo_source_rig((16, 44)), num_frames=1)[0])
    chosen = ["--data", str(tmp_path / "0"), "--quality", "accurate", "--geometry", "infinity"]
    assert main(["bench", *chosen, "--size", "16x44", "--output", str(tmp_path)]) == 2
    assert "expected geometry of infinity, ground, street, boxes, lidar, which" in capsys.readouterr().err
