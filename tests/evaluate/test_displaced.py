"""``evaluate --held-out next``: photographs of other cameras and moments as truth."""

import json
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
from arbiview_aug.evaluate.held_out import held_out_frames, surfaces_for
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
