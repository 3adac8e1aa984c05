"""Text tables: what a reader sees of the metrics; sheets."""

from __future__ import annotations

import numpy as np

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.report.pictures import HOLE, frame_sheet, hatched_view, left_to_right, shrunk
from arbiview_aug.evaluate.report.tables import (
    SEEN,
    SPARSE_COLUMNS,
    TRUTH_COLUMNS,
    cell,
    text_table,
)
from tests.helpers import camera


def test_cells() -> None:
    row = {"seen": 0.5, "psnr": 20.126, "ssim": 0.98765}
    assert cell(row, SEEN[1]) == "50.0%" and cell(row, "{psnr:.2f}") == "20.13" and cell(row, "{ssim:.4f}") == "0.9877"
    assert cell(row, "{absent:.2f}") == "-", "what a row lacks is no zero"


def test_layout() -> None:
    rows = {"a method of some length": {"seen": 1.0}, "b": {"seen": 0.25, "x": 3.0}}
    table = text_table("Title", rows, [SEEN, ("a wide heading", "{x:.2f}")], "a note")
    title, _, head, rule, first, second, _, note = table.splitlines()
    assert title == "Title:" and note == "a note"
    assert len(head) == len(rule) == len(first) == len(second), "columns line up"
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in (first, second)]
    assert cells == [["a method of some length", "100.0%", "-"], ["b", "25.0%", "3.00"]]
    assert text_table("Nothing", {}, [SEEN]).count("\n") == 3


def test_metrics_are_named_once() -> None:
    for columns in (TRUTH_COLUMNS, SPARSE_COLUMNS):
        assert len({form for _, form in columns}) == len(columns)


def test_cameras_stand_as_in_a_panorama() -> None:
    rig = Rig([camera(f"at {a}", a) for a in (0, -60, 60, 180)])
    assert [rig.names[k] for k in left_to_right(rig)] == ["at 60", "at 0", "at -60", "at 180"]


def test_sheets_hatch_only_what_is_unseen() -> None:
    rig = Rig([camera(f"at {a}", a) for a in (0, 60)])
    images = [np.full((40, 60, 3), 90, np.uint8)] * 2
    seen, half = np.ones((40, 60), bool), np.ones((40, 60), bool)
    half[:, :30] = False
    whole = frame_sheet(rig, images, rig, [RenderedView(images[0], seen)] * 2, width_px=400)
    holed = frame_sheet(
        rig, images, rig, [RenderedView(images[0], seen), RenderedView(images[0], half)], images, width_px=400
    )
    assert not (whole == HOLE).all(-1).any() and (holed == HOLE).all(-1).any()
    assert holed.shape[0] > 1.7 * whole.shape[0], "two rows more: hatched, and the truth"
    hatched = (hatched_view(RenderedView(images[0], half), 40) == HOLE).all(-1)
    assert hatched[:, :25].any() and not hatched[:, 35:].any()


def test_shrinking_never_enlarges() -> None:
    assert shrunk(np.zeros((40, 60, 3), np.uint8), 20).shape == (20, 30, 3)
    assert shrunk(np.zeros((40, 60, 3), np.uint8), 400).shape == (40, 60, 3)
