"""``python -m integrations.benchmarks.seams``: a step made by hand."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from arbiview_aug import Camera
from integrations.benchmarks.seams import main, seam_cells, summary


def test_a_step_of_a_tenth_is_measured() -> None:
    """A grey view, whose right half is a second source that is a tenth brighter, and a band of 16 columns."""
    camera = Camera.looking(
        name="ahead", azimuth_deg=0, position_m=(0, 0, 1.5), width_px=352, height_px=160, horizontal_fov_deg=90
    )
    winner = np.zeros((160, 352), np.int8)
    winner[:, 176:] = 1
    second = np.full_like(winner, -1)
    second[:, 168:184] = 1 - winner[:, 168:184]
    light = np.array([100, 110], np.uint8)
    image, other = light[winner][..., None].repeat(3, -1), light[second.clip(0)][..., None].repeat(3, -1)
    views = SimpleNamespace(source_camera=winner), SimpleNamespace(source_camera=second)
    cells = list(seam_cells(camera, *views, image, other))
    # Noise-free sides but for the box that smooths the view, 2 pixels into each.
    assert cells and all(cell.step == pytest.approx(np.log(1.1), abs=1e-6) for cell in cells)
    assert max(cell.noise for cell in cells) < 0.02
    # Rays rise by 10 and fall by 3 degrees inside the view: all kinds occur.
    assert {cell.kind for cell in cells} == {"sky", "road", "other"}
    assert "sky" in summary(cells) and "100% above it" in summary(cells) and summary([]) == "no seams"


@pytest.mark.slow
def test_command(nuscenes_root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--data", str(nuscenes_root), "--target", "waymo", "--size", "64x96"]) == 0
    lines = capsys.readouterr().out.splitlines()
    ways = "recorded", "gains", "gains and seams"
    assert len(lines) == 3
    assert all(line.startswith(f"nuscenes-one, {way}: ") for line, way in zip(lines, ways, strict=True))
