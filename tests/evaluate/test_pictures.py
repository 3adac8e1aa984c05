"""Contact sheets, coverage outlines, rig pictures: sizes, places and colours; never golden images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.report.pictures import HOLE, contact_sheet, outline_coverage, put_text, save_picture
from arbiview_aug.evaluate.report.rig_picture import COLOURS, draw_rigs


def plain(h: int, w: int, colour: tuple[int, int, int]) -> np.ndarray:
    return np.full((h, w, 3), colour, np.uint8)


def test_contact_sheet_places_images_row_by_row() -> None:
    red, green, blue = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    sheet = contact_sheet(
        [[plain(90, 160, red), plain(90, 160, green)], [plain(200, 100, blue)]],
        [["left", "right, with a caption that is far too long to fit under it" * 3], ["portrait"]],
        titles=["first", "second"],
        width_px=600,
    )
    assert sheet.dtype == np.uint8 and sheet.shape[1:] == (600, 3)
    places = {}
    for name, colour in (("red", red), ("green", green), ("blue", blue)):
        rows, columns = np.nonzero((sheet == colour).all(-1))
        places[name] = rows.min(), rows.max(), columns.min(), columns.max()
        assert len(rows) == (rows.max() - rows.min() + 1) * (columns.max() - columns.min() + 1), "text over an image"
    assert places["red"][:2] == places["green"][:2], "one row"
    assert places["red"][3] < places["green"][2] and places["green"][3] < 600
    assert places["blue"][0] > places["red"][1]
    height, width = places["red"][1] - places["red"][0] + 1, places["red"][3] - places["red"][2] + 1
    assert width / height == pytest.approx(160 / 90, abs=0.02)
    assert places["blue"][1] - places["blue"][0] < 0.31 * 600, "a lone portrait image does not fill the sheet"


def test_contact_sheet_takes_floats_and_no_labels() -> None:
    sheet = contact_sheet([[np.full((20, 40, 3), 99.6)]], width_px=100)
    assert (sheet == 100).all(-1).any()


@pytest.mark.parametrize(
    ("rows", "labels", "titles", "message"),
    [
        ([], None, None, "at least one image in every row"),
        ([[]], None, None, "at least one image in every row"),
        ([[plain(4, 4, (0, 0, 0))]], [["a"], ["b"]], None, "labels: expected one entry for each of 1 rows, got 2"),
        ([[plain(4, 4, (0, 0, 0))]], [["a", "b"]], None, "expected 1 labels in a row, got 2"),
        ([[plain(4, 4, (0, 0, 0))]], None, [], "titles: expected one entry for each of 1 rows, got 0"),
    ],
)
def test_contact_sheet_messages(rows: list, labels: list | None, titles: list | None, message: str) -> None:
    with pytest.raises(DataError, match=message):
        contact_sheet(rows, labels, titles=titles)


def test_outline_marks_holes_and_nothing_else() -> None:
    image = plain(90, 160, (120, 130, 140))
    coverage = np.ones((90, 160), bool)
    np.testing.assert_array_equal(outline_coverage(image, coverage), image)
    coverage[:, :60] = False
    picture = outline_coverage(image, coverage)
    changed = (picture != image).any(-1)
    assert not changed[:, 62:].any(), "covered pixels stay as they are, but for the line"
    assert 0.1 < changed[:, :60].mean() < 0.6
    assert (picture == HOLE).all(-1)[:, :60].any() and (image == (120, 130, 140)).all(), "the input is not changed"


def test_text_outside_ascii() -> None:
    picture = plain(40, 300, (255, 255, 255))
    put_text(picture, "yaw −11° café", (4, 25))
    assert (picture < 128).any()


def test_save_picture(tmp_path: Path) -> None:
    picture = plain(5, 6, (10, 20, 30))
    path = save_picture(tmp_path / "new" / "sheet.png", picture)
    np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], picture)
    with pytest.raises(DataError, match=r"expected a name ending in .png or .jpg"):
        save_picture(tmp_path / "sheet.words", picture)
    with pytest.raises(DataError, match="in a folder that can be written to"):
        save_picture(path / "below_a_file" / "sheet.png", picture)


def tinted(picture: np.ndarray, colour: tuple[int, int, int]) -> np.ndarray:
    """(h, w) bool: pixels that are a mixture of paper and a rig's colour, from 8 percent on."""
    ink, full = 255 - picture.astype(float), 255.0 - np.array(colour)
    strength = np.linalg.norm(ink, axis=-1)
    return (strength > 0.08 * np.linalg.norm(full)) & (ink @ full > 0.985 * strength * np.linalg.norm(full))


def test_rig_picture_has_a_column_per_rig() -> None:
    one = draw_rigs([load_rig("waymo")])
    two = draw_rigs([load_rig("waymo"), load_rig("argoverse2")])
    assert two.shape[0] == one.shape[0] and two.shape[1] > 2 * one.shape[1] - 1
    left, right = two[:, : one.shape[1]], two[:, -one.shape[1] :]
    shares = [[tinted(side, colour).mean() for colour in COLOURS[:2]] for side in (left, right)]
    assert shares[0][0] > 5 * shares[0][1] > 0, "a rig's own column, with the other behind it"
    assert shares[1][1] > 5 * shares[1][0] > 0


def test_rig_picture_forward_is_up_and_left_is_left() -> None:
    camera = Camera.looking(
        name="a", azimuth_deg=0, width_px=64, height_px=48, horizontal_fov_deg=60.0, position_m=(0.0, 0.0, 1.5)
    )
    for azimuth, (row, column) in {0: (-1, 0), 90: (0, -1), 180: (1, 0), -90: (0, 1)}.items():
        picture = draw_rigs([Rig([camera.turned(yaw_deg=azimuth)])])[:700]
        rows, columns = np.nonzero(tinted(picture[40:], COLOURS[0]))
        centre = np.array([rows.mean() + 40 - 370, columns.mean() - 400])  # the origin is at row 370, column 400
        if row:
            assert np.sign(centre[0]) == row and abs(centre[0]) > 3 * abs(centre[1])
        else:
            assert np.sign(centre[1]) == column and abs(centre[1]) > 3 * abs(centre[0])


@pytest.mark.parametrize("fov_deg", [5.0, 200.0, 359.5])
def test_rig_picture_of_extreme_lenses(fov_deg: float) -> None:
    camera = Camera.looking(
        name="a very long camera name " * 3,
        azimuth_deg=170,
        width_px=64,
        height_px=48,
        horizontal_fov_deg=fov_deg,
        lens="fisheye",
        distortion=(0.0,) * 4,
        position_m=(300.0, -50.0, 80.0),
    )
    assert draw_rigs([Rig([camera]), load_rig("ddad")]).dtype == np.uint8
