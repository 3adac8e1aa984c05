"""``check`` and ``demo``: findings, exit status, numbers and pictures."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug.__main__ import main
from arbiview_aug.cli import demo
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.evaluate.report.pictures import draw_labels
from tests.cameras.calibrations import CAMERA_INFO, mounted
from tests.helpers import camera, street_sample


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two frames of a street as frame folders."""
    sample = street_sample()
    for name in ("a", "b"):
        root = tmp_path / "data" / name
        root.mkdir(parents=True)
        calib = sample["rig"].to_dict() | {"boxes_3d": sample["boxes_3d"].tolist()}
        for entry, image in zip(calib["cameras"], sample["images"], strict=True):
            entry["file"] = f"{entry['name']}.png"
            cv2.imwrite(str(root / entry["file"]), image.permute(1, 2, 0).numpy()[..., ::-1])
        np.save(root / "lidar.npy", sample["points"].numpy())
        (root / "calib.json").write_text(json.dumps(calib))
    return tmp_path / "data"


def change(frame: Path, **entries: object) -> None:
    file = frame / "calib.json"
    changed = json.loads(file.read_text()) | entries
    file.write_text(json.dumps({key: value for key, value in changed.items() if value is not None}))


def test_a_right_folder_has_no_findings(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(folder), "--output", str(tmp_path / "out"), "--frames", "1000000000000"]) == 0
    assert capsys.readouterr().out == f"no findings in 2 of 2 frames; pictures: {tmp_path / 'out'}/check-*.png\n"
    assert len(list((tmp_path / "out").glob("check-*.png"))) == 6
    picture = cv2.imread(str(tmp_path / "out" / "check-front.png"))
    assert (picture != cv2.imread(str(folder / "a" / "front.png"))).any(axis=-1).mean() > 0.05


def test_findings_are_lines_with_their_frames(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    boxes = json.loads((folder / "a" / "calib.json").read_text())["boxes_3d"]
    degrees = [[*box[:6], float(np.degrees(box[6]))] for box in boxes]
    change(folder / "a", boxes_3d=degrees)
    change(folder / "b", ground_z_m=0.4, boxes3d=boxes, boxes_3d=None)
    assert main(["check", str(folder), "--output", str(tmp_path)]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and lines[-1].startswith("3 findings in 2 of 2 frames")
    for begins, ends in (
        ("boxes_3d: expected yaw in radians", "(1 of 2 frames)"),
        ("ground_z_m: expected the road's height", "(1 of 2 frames)"),
        (f"{folder / 'b' / 'calib.json'}: 'boxes3d' is not read", "did you mean 'boxes_3d'?"),
    ):
        assert any(line.startswith(begins) and line.endswith(ends) for line in lines), lines


def test_a_rig_is_checked_alone(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = FrameFolder(folder)[0]["rig"]
    for poses, status in ((rig.cam2ego, 0), (np.linalg.inv(rig.cam2ego), 1)):
        data = rig.to_dict()
        for entry, pose in zip(data["cameras"], poses, strict=True):
            entry["cam2ego"] = pose.tolist()
        (tmp_path / "rig.json").write_text(json.dumps(data))
        assert main(["check", str(tmp_path / "rig.json")]) == status
    assert capsys.readouterr().out.splitlines()[0] == "no findings"
    assert main(["check", str(tmp_path / "none.yaml")]) == 2
    (ros := tmp_path / "ros").mkdir()
    mounted(ros, front__yaml=CAMERA_INFO)
    assert main(["check", str(ros)]) == 0
    with pytest.raises(SystemExit):
        main(["check", str(ros), "--frames", "2"])
    assert "argument --frames: expected frames with it, got a rig" in capsys.readouterr().err
    camera_file = next(ros.glob("front*.yaml")).rename(folder / "a" / "front.yaml")  # data are data all the same
    assert main(["check", str(folder / "a"), "--output", str(tmp_path / "out")]) == 0 and camera_file.exists()


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_boxes_are_drawn_where_they_are(lens: str) -> None:
    front = camera(size=(96, 128), position_m=(0.0, 0.0, 1.0), lens=lens)
    box = np.array([[10.0, 0, 1, 2, 2, 2, 0.5], [-10, 0, 1, 2, 2, 2, 0], [0, 0, 1, 40, 40, 10, 0]])
    black = np.zeros((96, 128, 3), np.uint8)
    drawn = draw_labels(front, black, None, box[:2]).any(axis=-1)
    rows, columns = np.nonzero(drawn)
    around = front.project(box[0, :3]).uv
    assert np.abs(np.array([columns.mean(), rows.mean()]) - around).max() < 6
    assert drawn.any() and drawn.mean() < 0.2
    assert draw_labels(front, black, np.zeros((0, 3)), box).any(), "the camera may stand in a box"
    points = draw_labels(front, black, box[:1, :3], None).any(axis=-1)
    assert np.abs(np.argwhere(points).mean(axis=0)[::-1] - around).max() < 2


# --- python -m arbiview_aug demo``, at a tiny size --------------------------------------------------------------------
def numbers(printed: str, surface: str) -> list[float]:
    """The table's row of a surface."""
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in printed.splitlines() if line[:1] == "|"]
    (cells,) = [cells for name, *cells in rows if name == surface]
    return [float(cell.rstrip("%")) for cell in cells]


def test_each_time_is_of_what_it_says(monkeypatch: pytest.MonkeyPatch) -> None:
    """A call pays 1 s, a new plan 10 s more, and the first call 100 s more for rays."""
    clock, known = [0.0], set()
    sample = {"rig": demo_source_rig((8, 22)), "boxes_3d": torch.zeros(1, 7)}

    def retarget(sample: Mapping[str, Any]) -> None:
        clock[0] += 1 + (0 if known else 100)
        plan = sample["rig"].content_key, sample["boxes_3d"].numpy().tobytes()
        clock[0] += 10 * (plan not in known)
        known.add(plan)

    monkeypatch.setattr(demo, "timeit", partial(demo.timeit, timer=lambda: clock[0]))
    assert demo.timed(retarget, sample) == pytest.approx((1e3, 11e3))


def test_synthetic_street(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--size", "64x176", "--output", str(tmp_path), "--width", "900"]) == 0
    printed = capsys.readouterr().out
    assert (
        "sedan -> van: 6 cameras to 5" in printed
        and " 64x176, quality fast" in printed
        and "over the boxes surface" in printed
    )
    assert "Against the true views" in printed and "(5 cameras, 1 frame)" in printed and "ms a frame" in printed
    auto, far = numbers(printed, "auto"), numbers(printed, "infinity")
    seen, psnr, ground, _, _, mae, ssim, *_, whole = auto
    assert 80 < seen < 100 and whole < psnr and 0 < mae < 50 and 0.2 < ssim < 1
    # 0.6 m higher, the road is where a plane says it is and not infinitely far away.
    assert ground > far[2] + 3
    sheet = cv2.imread(str(tmp_path / "demo.png"))
    assert sheet is not None and sheet.shape[1] == 900 and 200 < sheet.shape[0] < 900
    assert sheet.std() > 20
    assert f"picture: {tmp_path / 'demo.png'}" in printed


@pytest.mark.parametrize("reader", ["frame folder", pytest.param("tables", marks=pytest.mark.slow)])
def test_real_keyframe(reader: str, nuscenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = nuscenes_root
    if reader == "tables":
        root = tmp_path / "tables"
        for name in ("samples", "v1.0-mini"):
            shutil.copytree(nuscenes_root / name, root / name)
    picture = tmp_path / "sheet.jpg"
    assert main(["demo", "--data", str(root), "--size", "160x288", "--output", str(picture), "--frames", "3"]) == 0
    printed = capsys.readouterr().out
    assert "6 cameras to 5" in printed and "LiDAR points" in printed and "(5 cameras, 1 frame)" in printed
    seen, _, even, covered, ground, *_ = numbers(printed, "auto")
    assert seen > 95 and even > 15 and covered >= even and ground > numbers(printed, "infinity")[4] + 5
    assert cv2.imread(str(picture)) is not None


@pytest.mark.slow
def test_the_published_method_beside_fast(nuscenes_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    options = ["--quality", "paper", "--output", str(tmp_path)]
    assert main(["demo", *options, "--size", "64x112"]) == 0
    printed = capsys.readouterr().out
    assert "stages 1 to 4 as published" in printed and "nothing can be planned ahead" in printed
    # 0.6 m higher, rotations alone miss the road.
    assert numbers(printed, "street")[2] > numbers(printed, "paper")[2] + 3
    assert main(["demo", *options, "--size", "64x112", "--data", str(nuscenes_root)]) == 0  # waymo's lenses undistorted
    assert numbers(capsys.readouterr().out, "paper")[0] > 80
    with pytest.raises(SystemExit, match="2"):
        main(["demo", *options, "--geometry", "street"])
    assert "quality paper knows infinity alone" in capsys.readouterr().err
