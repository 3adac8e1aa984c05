"""``evaluate --held-out``: cameras rendered from the others, and their own photographs as truth."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import FrameFolder, Neighbours
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.evaluate.held_out import WithoutCamera, held_out_frames
from arbiview_aug.evaluate.metrics import as_arrays
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.helpers import camera

RIG = Rig([camera("left", 40), camera("front", 0), camera("right", -40)])


def folder_of_streets(root: Path, rig: Rig = RIG, count: int = 2) -> Path:
    drive = SyntheticDrive(rig, num_frames=count, supersampling=1)
    for k in range(count):
        write_frame(root / f"{k:03}", drive[k])
    return root


def test_scores_on_common_pixels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = folder_of_streets(tmp_path / "data")
    points = np.load(data / "000" / "lidar.npy")
    np.save(data / "000" / "class.npy", np.full(len(points), 7, np.uint8))
    options = ["--data", str(data), "--output", str(tmp_path / "out"), "--geometry", "infinity", "lidar"]
    assert main(["evaluate", "--held-out", "front", *options]) == 0
    found, printed = json.loads((tmp_path / "out" / "evaluate.json").read_text()), capsys.readouterr().out
    assert [row["camera"] for row in found["views"]] == ["front"] * 4
    means = found["means"]
    assert means["fast, infinity"]["common"] == means["fast, lidar"]["common"] <= means["fast, lidar"]["seen"] < 1
    assert means["fast, lidar"]["difference_db"] == pytest.approx(
        means["fast, lidar"]["gain_psnr_db"] - means["fast, infinity"]["gain_psnr_db"]
    )
    assert "class 7" in means["fast, lidar"] and "Frames of one drive are alike" in printed

    sample, squares = FrameFolder(data)[0], []
    views = {}
    for geometry in ("infinity", "lidar"):
        out = RigRetarget(Rig([RIG[1]]), geometry=geometry, holes="black", match_exposure=False)
        views[geometry] = out(dict(WithoutCamera(sample, 1)))
    common = np.all([view["coverage"][0].numpy() for view in views.values()], axis=0)
    true = as_arrays(sample["images"])[1][common].astype(float)
    squares = [np.mean((as_arrays(view["images"])[0][common] - true) ** 2) for view in views.values()]
    assert [row["psnr_db"] for row in found["views"][:2]] == pytest.approx(10 * np.log10(255**2 / np.array(squares)))


def test_held_out_holes_are_those_of_the_targets_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, raised = folder_of_streets(tmp_path / "data", count=1), RIG.shifted(z_m=0.7)
    raised.save(tmp_path / "raised.yaml")
    options = ["--data", str(data), "--output", str(tmp_path / "out"), "--target", str(tmp_path / "raised.yaml")]
    assert main(["evaluate", "--held-out", "holes", *options, "--holes", "mean", "continue"]) == 0
    found = json.loads((tmp_path / "out" / "evaluate.json").read_text())
    assert "held-out holes" in capsys.readouterr().out
    assert [*found["means"]] == ["fast, auto, mean", "fast, auto, continue"]
    RIG.save(tmp_path / "raised.yaml")  # the same place
    assert main(["evaluate", "--held-out", "holes", *options]) == 2 and "found none" in capsys.readouterr().err
    mean, filled = found["means"].values()
    assert mean["gradients"] < filled["gradients"] < 1 and filled["psnr_db"] > mean["psnr_db"]

    sample = FrameFolder(data)[0]
    seen = RigRetarget(raised, holes="black", match_exposure=False)(sample)["coverage"]
    out = RigRetarget(RIG, holes="continue", match_exposure=False)({**sample, "coverage": seen})
    hole = (~out["coverage"] & ~seen)[1].numpy()
    (row,) = (row for row in found["views"] if row["camera"] == "front" and "continue" in row["method"])
    away = as_arrays(out["images"])[1][hole] - as_arrays(sample["images"])[1][hole].astype(float)
    assert hole.sum() > 100 and row["psnr_db"] == pytest.approx(10 * np.log10(255**2 / np.mean(away**2)), abs=0.02)


def test_a_copy_of_the_camera_gives_back_its_photograph(tmp_path: Path) -> None:
    twins = Rig([camera("left", 40), camera("front", 0), camera("twin", 0)])
    data = folder_of_streets(tmp_path / "data", twins, 1)
    options = ["--data", str(data), "--output", str(tmp_path / "out"), "--geometry", "infinity"]
    assert main(["evaluate", "--held-out", "all", *options]) == 0
    rows = {row["camera"]: row for row in json.loads((tmp_path / "out" / "evaluate.json").read_text())["views"]}
    assert set(rows) == {"left", "front", "twin"}
    assert rows["front"]["seen"] == 1 and rows["front"]["psnr_db"] > 30 > rows["left"]["psnr_db"]


def test_neighbours_lose_the_camera_too() -> None:
    drive = SyntheticDrive(RIG, num_frames=1, supersampling=1, neighbours=Neighbours(count=1, step_m=1.2))
    ((name, frame),) = held_out_frames(drive, [0], ["front"])
    assert name.endswith(": front") and frame.sample["rig"].names == ["left", "right"]
    assert len(frame.sample["K"]) == 2 and frame.sample["neighbours"]
    for neighbour in frame.sample["neighbours"]:
        assert len(neighbour["images"]) == 2
        assert "rig" not in neighbour or neighbour["rig"].names == ["left", "right"]


@pytest.mark.parametrize(
    ("cameras", "num_cameras", "classes", "message"),
    [
        (
            ["rear", "front"],
            3,
            None,
            "expected all, next, or cameras of frame 000, left, front, right, got rear",
        ),
        (["all"], 1, None, "--held-out: expected frames of several cameras, frame 000 has one"),
        (
            ["all"],
            3,
            np.zeros(3, np.uint8),
            r"class.npy: expected a whole number for each of \d+ points, got uint8 \(3,\)",
        ),
    ],
)
def test_refused(
    tmp_path: Path,
    cameras: list[str],
    num_cameras: int,
    classes: object,
    message: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    data = folder_of_streets(tmp_path / "data", Rig(list(RIG)[:num_cameras]), 1)
    if classes is not None:
        np.save(data / "000" / "class.npy", classes)
    assert main(["evaluate", "--held-out", *cameras, "--data", str(data), "--output", str(tmp_path / "out")]) == 2
    assert re.search(message, capsys.readouterr().err)
