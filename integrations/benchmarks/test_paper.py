"""The paper's tables: its own numbers as printed, and ours beside them."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.evaluate.frames import retargeting
from integrations.benchmarks import paper
from integrations.benchmarks.paper import (
    PROTOCOL,
    SETS,
    VEHICLES,
    crop_and_slide,
    main,
    named_targets,
    own_camera,
    spacing_deg,
)
from tests import helpers
from tests.helpers import ring


@pytest.fixture
def study(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., dict[str, dict[str, dict[str, float]]]]:
    """The command's means with two methods, by method and set of targets."""
    methods = [paper.baseline("own camera"), retargeting("fast", "street", "fast")]
    monkeypatch.setattr(paper, "study_methods", lambda: methods)
    monkeypatch.setattr(paper, "SETS", ("paper", "truck"))
    monkeypatch.delenv("ARBIVIEW_DATA", raising=False)

    def run(*options: str) -> dict[str, dict[str, dict[str, float]]]:
        assert main([*options, "--output", str(tmp_path)]) == 0
        report = json.loads((tmp_path / "paper.json").read_text())
        (means,) = report["means"].values()
        assert set(report) == {"means", "published", "protocol", "declined"} and not report["declined"]
        assert list(means) == ["own camera", "fast"]
        assert all(list(kinds) == ["paper", "truck"] for kinds in means.values())
        return means

    return run


@pytest.mark.filterwarnings("ignore:the target rig")
@pytest.mark.slow
def test_synthetic_streets(study: Callable[..., Any], capsys: pytest.CaptureFixture[str]) -> None:
    found = study("--frames", "1", "--size", "32x88")
    own, fast = found["own camera"]["paper"], found["fast"]["paper"]
    assert fast["raw_psnr_db"] > own["raw_psnr_db"] + 3 and fast["seen"] > own["seen"] + 0.1
    assert "true_psnr_db" in fast and "even_psnr_db" not in fast
    report = capsys.readouterr().out
    six, others = [[row for row in rows_of(report) if len(row) == length] for length in (9, 3)]
    assert six[0] == ["", *"published: PSNR,SSIM,MAE,RMSE,synthetic: PSNR,SSIM,MAE,RMSE".split(",")]
    assert six[2][:5] == ["own camera (Geometric, Table 2)", "9.32", "0.8339", "74.13", "88.77"]
    assert six[2][5:7] == [f"{own['raw_psnr_db']:.2f}", f"{own['raw_ssim']:.4f}"]
    assert six[3][:5] == ["fast", *"----"], "the paper has none of it"
    assert six[-1] == ["generator (ArbiViewGen, Tables 1 and 2)", "14.23", "0.9691", "38.28", "49.53", *"----"]
    assert others[0] == ["", "synthetic: six", "truck"] and [row[0] for row in others[2:]] == ["own camera", "fast"]
    assert others[3][1] == f"{fast['true_psnr_db']:.2f} / {fast['true_covered_psnr_db']:.2f}"
    assert PROTOCOL in report


def rows_of(report: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in report.splitlines() if line[:1] == "|"]


@pytest.mark.slow
def test_real_frames(study: Callable[..., Any], nuscenes_root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper, "REDUCE", 4)
    found = study("--data", str(nuscenes_root))
    own, fast = found["own camera"], found["fast"]
    assert {"raw_psnr_db", "even_psnr_db"} <= set(own["paper"])
    assert "even_psnr_db" in own["truck"] and "raw_psnr_db" not in own["truck"], "exposure is no geometry"
    assert fast["paper"]["even_psnr_db"] > own["paper"]["even_psnr_db"] + 8


def test_the_papers_yaws() -> None:
    """The paper states 11/14, 22/28, 27.5/35 and 13.75/17.5 degrees: sides and front / back."""
    rig = load_rig("nuscenes")
    yaws = [
        [(target[name].azimuth_deg - rig[name].azimuth_deg + 180) % 360 - 180 for name in ("CAM_FRONT", "CAM_BACK")]
        for target in named_targets("paper", rig).values()
    ]
    stated = [(11, 14), (-11, -14), (22, 28), (-22, -28), (27.5, 35), (-13.75, -17.5)]
    np.testing.assert_allclose(yaws, stated, atol=1e-6)


def test_spacing_of_other_rigs() -> None:
    ddad = load_rig("ddad")
    # CAMERA_09 looks back at -179.0 degrees, its nearer neighbour CAMERA_08 at -124.5.
    assert dict(zip(ddad.names, spacing_deg(ddad), strict=True))["CAMERA_09"] == pytest.approx(54.5, abs=0.2)
    lyft = load_rig("lyft_l5")
    spacing = dict(zip(lyft.names, spacing_deg(lyft), strict=True))
    assert spacing["CAM_FRONT"] == pytest.approx(60, abs=0.5), "the telephoto beside it is no neighbour"
    assert spacing["CAM_FRONT_ZOOMED"] == pytest.approx(60, abs=0.5)
    alone = Rig([Camera.looking(name="a", azimuth_deg=0, width_px=64, height_px=48, horizontal_fov_deg=50.0)])
    np.testing.assert_allclose(spacing_deg(alone), [50.0])


def test_named_sets() -> None:
    """Without masks, and over the same road; vehicles are as wide as the source and without lenses."""
    rig = load_rig("nuscenes").resized((225, 400))
    masked = rig.with_cameras([replace(camera, mask=np.zeros(camera.size, bool)) for camera in rig])
    targets = {kind: named_targets(kind, masked) for kind in SETS}
    assert list(targets["yaw"]) == ["yaw +11", "yaw -11", "yaw +22", "yaw -22", "yaw +35"]
    (truck,) = targets["truck"].values()
    np.testing.assert_allclose(truck.cam2ego[:, 2, 3] - rig.cam2ego[:, 2, 3], 1.0)
    assert truck.ground_z_m == rig.ground_z_m and truck.name == f"{rig.name}, truck"
    assert all(camera.mask is None for rigs in targets.values() for target in rigs.values() for camera in target)
    assert list(targets["vehicles"]) == list(VEHICLES)
    for name, vehicle in targets["vehicles"].items():
        for camera, shipped in zip(vehicle, load_rig(name).undistorted(), strict=True):
            assert camera.width_px == 400 and camera.lens == "pinhole"
            assert camera.fov_deg[0] == pytest.approx(shipped.fov_deg[0], rel=0.01)
            np.testing.assert_array_equal(camera.cam2ego, shipped.cam2ego)


# --- baselines --------------------------------------------------------------------------------------------------------
COLOURS = ((200, 30, 30), (30, 200, 30), (30, 30, 200), (200, 200, 30))


camera = partial(helpers.camera, size=(91, 181), horizontal_fov_deg=90.0)


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    return np.full((91, 181, 3), colour, np.uint8)


def test_own_camera_is_alone() -> None:
    rig = ring(4, radius_m=0.0, name="at ", size=(91, 181), horizontal_fov_deg=90.0)
    images = [plain(colour) for colour in COLOURS]
    (view,) = own_camera(rig, images, rig.with_cameras([camera("at 0", 45.0)]))
    # 45 degrees to the left, the image's right half of the angle is what the own camera saw; none else helps.
    columns = view.coverage.mean(0)
    assert columns[:88].max() == 0 and columns[93:].min() > 0.6
    assert set(map(tuple, view.image[view.coverage].tolist())) == {COLOURS[0]}
    assert not view.image[~view.coverage].any()
    (other,) = own_camera(rig, images, rig.with_cameras([camera("of another rig", 80.0)]))
    assert tuple(other.image[45, 90]) == COLOURS[1], "without its name, the camera that looks most nearly its way"


def test_crop_and_slide_is_a_window_over_strips() -> None:
    rig = ring(4, radius_m=0.0, name="at ", size=(91, 181), horizontal_fov_deg=90.0)
    images = [plain(colour) for colour in COLOURS]
    (view,) = crop_and_slide(rig, images, rig.with_cameras([camera("any", 30.0, position_m=(5.0, 0.0, 3.0))]))
    assert view.coverage.all(), "position and coverage play no part"
    # 30 of 90 degrees to the left: a third of the width, from the left, is the left neighbour's.
    row = view.image[45]
    np.testing.assert_array_equal(row[:58], np.broadcast_to(COLOURS[1], (58, 3)))
    np.testing.assert_array_equal(row[63:], np.broadcast_to(COLOURS[0], (118, 3)))
    (back,) = crop_and_slide(rig, images, rig.with_cameras([camera("any", 180.0)]))
    assert tuple(back.image[45, 90]) == COLOURS[2], "the panorama is closed"
