"""``evaluate --held-out``: photographs of other cameras and moments, and of cameras left out, as truth."""

import json
import re
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import FrameFolder, Neighbours
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.image_io import encoded_image
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.errors import CalibrationError, DataError
from arbiview_aug.evaluate.held_out import WithoutCamera, held_out_frames, surfaces_for
from arbiview_aug.evaluate.metrics import as_arrays
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.helpers import camera

RIG = Rig([camera("front", 0)])
SAME_DB = 138.1  # PSNR of equal images


def run(data: Path, folder: Path, *options: str) -> dict[str, Any]:
    assert main(["evaluate", "--held-out", "next", *options, "--data", str(data), "--output", str(folder)]) == 0
    return json.loads((folder / "evaluate.json").read_text())


def stereo(root: Path, metres: float, count: int) -> Path:
    """Streets, each with a photograph from a camera so far to the right."""
    drive, right = SyntheticDrive(RIG, num_frames=count, supersampling=1), RIG.shifted(y_m=-metres)
    for k in range(count):
        folder = root / f"{k:03}"
        write_frame(folder, drive[k])
        file = "00.jpg" if metres == 0 else "right.jpg"
        if metres:
            (folder / file).write_bytes(encoded_image(drive.render(k, right).images[0]))
        calib = json.loads((folder / "calib.json").read_text())
        entry = right.to_dict()["cameras"][0]
        calib["truth"] = {key: entry[key] for key in ("K", "cam2ego")} | {"name": "right", "file": file}
        (folder / "calib.json").write_text(json.dumps(calib))
    return root


def test_a_camera_that_is_the_source_itself(tmp_path: Path) -> None:
    found = run(stereo(tmp_path / "data", 0.0, 1), tmp_path / "out", "--geometry", "infinity")
    for row in found["means"].values():
        assert row["psnr_db"] == pytest.approx(SAME_DB, abs=0.1) and row["seen"] == 1
    (tmp_path / "own.py").write_text("def detect(rgb):\n    return [[0, 0, 9, 9]], [0.6]\n")
    judged = run(tmp_path / "data", tmp_path / "out", "--geometry", "street", "--detector", f"{tmp_path}/own.py:detect")
    assert judged["arguments"]["held_out"] == ["next"] and "fast, street" in judged["judges"]


@pytest.mark.slow
def test_a_stereo_pair(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = stereo(tmp_path / "data", 0.5, 2)
    found, printed = run(data, tmp_path / "out"), capsys.readouterr().out
    psnr = {name: row["psnr_db"] for name, row in found["means"].items()}
    assert list(psnr) == ["fast, ground", "fast, street", "fast, boxes", "fast, lidar"]
    assert psnr["fast, street"] < psnr["fast, lidar"]
    assert "2 frames" in printed and f"{psnr['fast, lidar']:.2f}" in printed
    assert "photographs" in (tmp_path / "out" / "report.html").read_text()


def test_the_next_frame_without_what_moved() -> None:
    drive = SyntheticDrive(RIG, num_frames=1, supersampling=1, neighbours=Neighbours(count=1, step_m=1.2))
    ((_, frame),) = held_out_frames(drive, [0], ["next"])
    before, after = drive[0]["neighbours"]
    assert [entry["token"] for entry in frame.sample["neighbours"]] == [before["token"]], "the truth is not given"
    assert frame.target is not None and frame.truth is not None
    photographs = frame.truth(frame.target)
    np.testing.assert_array_equal(photographs.images[0], as_arrays(after["images"])[0])
    np.testing.assert_allclose(frame.target[0].center_m - RIG[0].center_m, (1.2, 0, 0), atol=0.01)
    assert 0.5 < photographs.valid[0].mean() < 1, "traffic does not score"


def test_a_vehicle_that_stands_is_left_out_with_the_time_that_it_waits() -> None:
    sample = SyntheticDrive(RIG, num_frames=1, supersampling=1, neighbours=Neighbours(count=1, step_m=1.2))[0]
    _, after = sample["neighbours"]
    sample = sample | {"time_s": 1.0, "token": "red light", "neighbours": [{**after, "time_s": 4.4}]}
    message = "frame 'red light' is left out, since its vehicle stands: the next frame from elsewhere is 3.4 s later"
    with pytest.warns(UserWarning, match=message), pytest.raises(DataError, match=message):
        next(held_out_frames([sample], [0], ["next"]))


def test_surfaces_are_all_that_a_sample_has_geometry_for() -> None:
    known = {"boxes_3d": 0, "learned_depth_m": 0, "points": 0, "neighbours": [0]}
    assert surfaces_for({}) == ["ground", "street"]
    assert surfaces_for(known) == ["ground", "street", "boxes", "learned", "lidar", "motion", "fused"]


def test_folders_without_photographs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_frame(tmp_path / "0", SyntheticDrive(RIG, num_frames=1, supersampling=1)[0])
    assert (
        main(["evaluate", "--held-out", "next", "--data", str(tmp_path / "0"), "--output", str(tmp_path / "out")]) == 2
    )
    assert "expected a 'truth' camera in calib.json" in capsys.readouterr().err
    calib = json.loads((tmp_path / "0" / "calib.json").read_text())
    (tmp_path / "0" / "calib.json").write_text(json.dumps(calib | {"truth": "right.jpg"}))
    with pytest.raises(CalibrationError, match="truth: expected a camera's mapping, got str"):
        FrameFolder(tmp_path / "0").truth(0)


@pytest.mark.slow
def test_real_stereo_pairs(kitti_root: Path, referee: ModuleType, tmp_path: Path) -> None:
    """Eleven frames of a suburb, 0.54 m aside; figures agree with the protocol."""
    found = run(kitti_root, tmp_path)
    psnr = {name: row["psnr_db"] for name, row in found["means"].items()}
    assert len(found["views"]) == 11 * len(psnr) and psnr["fast, motion"] > psnr["fast, street"] + 5.0
    *_, truth = referee.load_displaced(str(kitti_root / "frame_010"))
    frames = FrameFolder(kitti_root)
    out = RigRetarget(frames.truth(0)["rig"], geometry="street", holes="black")(frames[0])
    want = referee.displaced_metrics(as_arrays(out["images"])[0], out["coverage"][0].numpy(), truth["image"])
    found = run(kitti_root, tmp_path, "--geometry", "street")  # alone: on all pixels that it covers
    (row,) = (r for r in found["views"] if r["frame"] == "frame_010")
    covered_db, _, seen = want.values()
    assert (row["psnr_db"], row["seen"]) == pytest.approx((covered_db, seen), abs=1e-3)


# --- evaluate --held-out ----------------------------------------------------------------------------------------------
THREE = Rig([camera("left", 40), camera("front", 0), camera("right", -40)])


def folder_of_streets(root: Path, rig: Rig = THREE, count: int = 2) -> Path:
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
    assert "cannot be reached" not in printed, "there is no target to choose"

    sample, squares = FrameFolder(data)[0], []
    views = {}
    for geometry in ("infinity", "lidar"):
        out = RigRetarget(Rig([THREE[1]]), geometry=geometry, holes="black", match_exposure=False)
        views[geometry] = out(dict(WithoutCamera(sample, 1)))
    common = np.all([view["coverage"][0].numpy() for view in views.values()], axis=0)
    true = as_arrays(sample["images"])[1][common].astype(float)
    squares = [np.mean((as_arrays(view["images"])[0][common] - true) ** 2) for view in views.values()]
    assert [row["psnr_db"] for row in found["views"][:2]] == pytest.approx(10 * np.log10(255**2 / np.array(squares)))


def test_held_out_holes_are_those_of_the_targets_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data, raised = folder_of_streets(tmp_path / "data", count=1), THREE.shifted(z_m=0.7)
    raised.save(tmp_path / "raised.yaml")
    options = ["--data", str(data), "--output", str(tmp_path / "out"), "--target", str(tmp_path / "raised.yaml")]
    assert main(["evaluate", "--held-out", "holes", *options, "--holes", "mean", "continue"]) == 0
    found = json.loads((tmp_path / "out" / "evaluate.json").read_text())
    assert "held-out holes" in capsys.readouterr().out
    assert [*found["means"]] == ["fast, auto, mean", "fast, auto, continue"]
    THREE.save(tmp_path / "raised.yaml")  # the same place
    assert main(["evaluate", "--held-out", "holes", *options]) == 2 and "found none" in capsys.readouterr().err
    mean, filled = found["means"].values()
    assert mean["gradients"] < filled["gradients"] < 1 and filled["psnr_db"] > mean["psnr_db"]

    sample = FrameFolder(data)[0]
    seen = RigRetarget(raised, holes="black", match_exposure=False)(sample)["coverage"]
    out = RigRetarget(THREE, holes="continue", match_exposure=False)({**sample, "coverage": seen})
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
    drive = SyntheticDrive(THREE, num_frames=1, supersampling=1, neighbours=Neighbours(count=1, step_m=1.2))
    ((name, frame),) = held_out_frames(drive, [0], ["front"])
    assert name == drive[0]["token"] and frame.target is not None and frame.target.names == ["front"]
    assert frame.sample["rig"].names == ["left", "right"]
    assert len(frame.sample["K"]) == 2 and frame.sample["neighbours"]
    for neighbour in frame.sample["neighbours"]:
        assert len(neighbour["images"]) == 2
        assert "rig" not in neighbour or neighbour["rig"].names == ["left", "right"]


@pytest.mark.parametrize(
    ("cameras", "count", "message"),
    [
        ("rear front", 3, "expected all, next, or cameras of frame 000, left, front, right, got rear"),
        ("all", 1, "--held-out: expected frames of several cameras, frame 000 has one"),
        ("all", 3, r"class.npy: expected a whole number for each of \d+ points, got uint8 \(3,\)"),
    ],
)
def test_refused(tmp_path: Path, cameras: str, count: int, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    data = folder_of_streets(tmp_path / "data", Rig(list(THREE)[:count]), 1)
    if message.startswith("class.npy"):
        np.save(data / "000" / "class.npy", np.zeros(3, np.uint8))
    asked = ["evaluate", "--held-out", *cameras.split(), "--data", str(data), "--output", str(tmp_path / "out")]
    assert main(asked) == 2 and re.search(message, capsys.readouterr().err)
