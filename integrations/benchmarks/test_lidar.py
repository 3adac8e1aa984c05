"""``python -m integrations.benchmarks.lidar``: the goals, on one street and on DDAD's next scan; times."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from arbiview_aug.cli.parsers import SIZE
from integrations.benchmarks.acceptance.protocol import frame_folder
from integrations.benchmarks.lidar import PAIRS, ddad, main, measured_near, rings_dropped
from integrations.benchmarks.speed import measure
from tests.evaluate.test_metrics import LIDAR, at


@pytest.mark.slow
def test_scans_meet_their_goals(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The command's table, on one street."""
    monkeypatch.delenv("ARBIVIEW_DATA", raising=False)
    assert main(["--frames", "1"]) == 0
    head, _, *table = [
        [cell.strip() for cell in line.split("|")[1:-1]] for line in capsys.readouterr().out.splitlines()
    ]
    rows = {(scene, name): dict(zip(head[2:], map(float, values), strict=True)) for scene, name, *values in table}
    for scene in PAIRS:
        ours, goal = rows[scene, "scanned"], (0.8, 0.9) if "higher" in scene else (0.9, 0.95)
        assert ours["recall"] >= goal[0] and ours["precision"] >= goal[1]
        assert ours["chamfer_m"] < min(rows[scene, name]["chamfer_m"] for name in ("as they are", "rings dropped"))


@pytest.mark.slow
def test_the_next_scan_is_nearer_than_moved_points(data_root: Path) -> None:
    frame_folder(data_root, "ddad-next")
    rows = {name: metrics for _, name, metrics in ddad(data_root)}
    for key in ("range_error_m", "chamfer_m"):
        assert rows["scanned"][key] < rows["moved"][key]
    for key in ("recall", "precision"):
        assert rows["scanned"][key] > rows["moved"][key]


@pytest.mark.release
def test_120_000_points(nuscenes_root: Path, report_bound: Callable[..., None]) -> None:
    rows = measure("nuscenes-one", nuscenes_root, 5, [SIZE], "rays")["measures"]
    rows = [row for row in rows if "rays" in row["name"]]
    for row, most_ms in zip(rows, (80, 100), strict=True):
        report_bound(f"ms, {row['name']}", row["median_ms"], at_most=most_ms)


def test_rings_next_to_the_targets_stay() -> None:
    fewer = replace(LIDAR, elevations_deg=(11.0, -1.0))
    cloud = np.array([at(8, elevation, 0) for elevation in (10, 0, -10, 9, 2)])
    np.testing.assert_array_equal(rings_dropped(LIDAR, fewer, cloud), cloud[[0, 1, 3, 4]])


def test_rays_near_which_something_was_measured() -> None:
    """Half a line spacing above and below, half a column aside."""
    fine = replace(LIDAR, elevations_deg=tuple(np.arange(-20.0, 21.0, 4)), azimuth_step_deg=30.0)
    near = measured_near(LIDAR, fine, np.array([at(8, 0, 0), [np.nan] * 3]))
    assert fine.azimuth_deg == (-180.0, 180.0)
    rows, columns = np.nonzero(near)
    assert set(np.array(fine.elevations_deg)[rows]) == {-4.0, 0.0, 4.0}
    assert set(-180 + 30 * columns) == {-30, 0, 30}
