"""``python -m arbiview_aug demo``, at a tiny size."""

from __future__ import annotations

import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import pytest
import torch

from arbiview_aug.__main__ import main
from arbiview_aug.cli import demo
from arbiview_aug.datasets.synthetic import demo_source_rig


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

    monkeypatch.setattr(demo, "working_s", lambda: clock[0])
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
