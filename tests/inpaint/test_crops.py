"""Windows cover every hole once, with context, at the view's own resolution."""

from __future__ import annotations

import numpy as np
import pytest

from arbiview_aug.inpaint.networks import Window, drawn, packed, windows


def holes(seed: int, shape: tuple[int, int], kind: str) -> np.ndarray:
    rng = np.random.default_rng(seed)
    hole = np.zeros(shape, bool)
    if kind == "specks":
        hole[rng.integers(0, shape[0], 40), rng.integers(0, shape[1], 40)] = True
    elif kind == "wedge":
        hole[:, : shape[1] // 3] = True
    elif kind == "boxes":
        for _ in range(4):
            top, left = rng.integers(0, shape[0] - 20), rng.integers(0, shape[1] - 40)
            hole[top : top + 15, left : left + 35] = True
    elif kind == "all":
        hole[:] = True
    return hole


@pytest.mark.parametrize("size", [64, 128, 512])
@pytest.mark.parametrize("shape", [(90, 200), (200, 90), (48, 60), (256, 704)])
def test_every_hole_is_filled_once(size: int, shape: tuple[int, int]) -> None:
    views = [holes(k, shape, kind) for k, kind in enumerate(("specks", "none", "wedge", "boxes", "all"))]
    filled = [np.zeros(shape, int) for _ in views]
    for of_round in windows(views, size):
        for window in of_round:
            h, w = window.fills.shape
            assert h <= size and w <= size and window.top >= 0 and window.left >= 0
            assert window.top + h <= shape[0] and window.left + w <= shape[1]
            window.of(filled[window.view])[...] += window.fills
    for view, count in zip(views, filled, strict=True):
        np.testing.assert_array_equal(count, view)


def test_a_hole_has_context_and_a_whole_view_no_window() -> None:
    hole = np.zeros((100, 300), bool)
    hole[40:60, 100:140] = True
    (of_round,) = windows([np.zeros_like(hole), hole], 256)
    (window,) = of_round
    assert window.view == 1 and window.top <= 40 - 12 and window.left <= 100 - 12
    assert window.fills.shape[0] >= 20 + 2 * 12 and window.fills.shape[1] >= 40 + 2 * 12


def test_parts_of_one_hole_come_one_after_the_other() -> None:
    rounds = windows([np.ones((64, 300), bool), np.ones((64, 64), bool)], 64)
    assert len(rounds) > 4 and [len(of_round) for of_round in rounds] == [2, *[1] * (len(rounds) - 1)]
    filled = np.zeros((64, 300), bool)
    for of_round in rounds:
        window = next(one for one in of_round if one.view == 0)
        seen = window.of(filled)
        assert seen.any() or window is rounds[0][0], "each part sees the part before it"
        seen |= window.fills


def test_a_bent_hole_is_cut_where_that_saves_pixels() -> None:
    frame = np.zeros((256, 704), bool)
    frame[:20], frame[:, :20] = True, True
    cut = [window for of_round in windows([frame], 704) for window in of_round]
    assert len(cut) == 2 and sum(window.fills.size for window in cut) < 0.25 * frame.size
    whole = np.zeros((256, 704), bool)
    whole[100:200, 100:500] = True
    assert [len(of_round) for of_round in windows([whole], 704)] == [1]


def test_small_windows_share_a_canvas_and_do_not_overlap() -> None:
    view = np.zeros((256, 704), bool)
    view[30:200:60, 30:600:120] = True
    (small,) = windows([view], 256)
    canvases = packed(small, 256, 8)
    assert len(canvases) < len(small) / 4
    for canvas in canvases:
        taken = np.zeros(canvas.size, int)
        assert not any(side % 8 or side > 256 for side in canvas.size)
        for window, top, left in canvas.windows:
            h, w = window.fills.shape
            taken[top : top + h, left : left + w] += 1
        assert taken.max() == 1
        pixels, marks = drawn(canvas, [np.full((3, *view.shape), 0.5, np.float32)], [view])
        np.testing.assert_array_equal(pixels[0], np.where(marks, 0, 0.5))
        for window, top, left in canvas.windows:
            h, w = window.fills.shape
            assert marks[top : top + h, left : left + w][window.fills].all()
    assert sum(window.fills.sum() for canvas in canvases for window, _, _ in canvas.windows) == view.sum()


def test_windows_of_all_sizes_are_drawn_whole() -> None:
    """Also where a narrow one is placed on the upper shelf after a wide one below."""
    view = np.random.default_rng(0).random((3, 256, 704), np.float32)
    hole = holes(0, (256, 704), "specks")
    cut = [Window(0, 0, 0, hole[:100, :200]), Window(0, 100, 0, hole[100:190, :250])]
    cut += [Window(0, 0, 300, hole[:80, 300:350]), Window(0, 150, 400, hole[150:200, 400:420])]
    (canvas,) = packed(cut, 256, 8)
    pixels, marks = drawn(canvas, [view], [hole])
    for window, top, left in canvas.windows:
        h, w = window.fills.shape
        at = np.s_[..., top : top + h, left : left + w]
        np.testing.assert_array_equal(marks[at], window.fills)
        np.testing.assert_array_equal(pixels[at], window.of(view) * ~window.fills)
