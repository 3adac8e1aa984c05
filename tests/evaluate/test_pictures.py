"""Contact sheets, coverage outlines, rig pictures: sizes, places and colours; never golden images."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.errors import DataError, OutputError
from arbiview_aug.evaluate.report.pictures import (
    HOLE,
    contact_sheet,
    draw_rigs,
    outline_coverage,
    put_text,
    rig_figure,
    save_picture,
)


def plain(h: int, w: int, colour: tuple[int, int, int]) -> np.ndarray:
    return np.full((h, w, 3), colour, np.uint8)


def test_contact_sheet_places_images_row_by_row() -> None:
    red, green, blue = (250, 0, 0), (0, 250, 0), (0, 0, 250)
    captions = ["left", "right, with a caption that is far too long to fit under it" * 3]
    two = ("first", [plain(90, 160, red), plain(90, 160, green)], captions)
    sheet = contact_sheet([two, ("second", [plain(200, 100, blue)], ["portrait"])], width_px=600)
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


def test_contact_sheet_takes_floats() -> None:
    sheet = contact_sheet([("", [np.full((20, 40, 3), 99.6)], [""])], width_px=100)
    assert (sheet == 100).all(-1).any()


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
    put_text(picture, "yaw −11° café", (4, 25), 0.45)
    assert (picture < 128).any()


def test_save_picture(tmp_path: Path) -> None:
    picture = plain(5, 6, (10, 20, 30))
    path = save_picture(tmp_path / "new" / "sheet.png", picture)
    np.testing.assert_array_equal(cv2.imread(str(path))[..., ::-1], picture)
    with pytest.raises(DataError, match=r"expected a name ending in .png or .jpg"):
        save_picture(tmp_path / "sheet.words", picture)
    with pytest.raises(OutputError, match=r"sheet\.png: expected a file that can be written, got Not a directory"):
        save_picture(path / "below_a_file" / "sheet.png", picture)


def test_rig_figure_has_a_column_per_rig() -> None:
    one, two = (rig_figure([load_rig(name) for name in names]) for names in (["waymo"], ["waymo", "argoverse2"]))
    assert len(one.axes) == 2 and len(two.axes) == 4
    for axes, name in zip(two.axes[:2], ("waymo", "argoverse2"), strict=True):
        rig = load_rig(name)
        assert axes.get_title() == f"{name}: {len(rig)} cameras"
        assert {text.get_text().splitlines()[0] for text in axes.texts} == set(rig.names), "only its own names"
        assert len(axes.patches) == len(load_rig("waymo")) + len(load_rig("argoverse2")), "the other behind it"
        assert sum(patch.get_facecolor()[3] > 0 for patch in axes.patches) == len(rig), "its own wedges are filled"
    heights = {line for text in two.axes[3].texts for line in text.get_text().splitlines()}
    over_road = {f"{c.name} {c.center_m[2] - rig.ground_z_m:.2f} m" for c in rig}
    beams = {f"{s.name} {s.center_m[2] - rig.ground_z_m:.2f} m, {len(s.elevations_deg)} beams" for s in rig.lidars}
    assert heights == over_road | beams and len(beams) == 2, "over its own road"
    picture = draw_rigs([load_rig("waymo")])
    assert picture.shape == (1050, 800, 3) and picture.std() > 20


def test_rig_figure_forward_is_up_and_left_is_left() -> None:
    camera = Camera.looking(
        name="a", azimuth_deg=0, width_px=64, height_px=48, horizontal_fov_deg=60.0, position_m=(0.0, 0.0, 1.5)
    )
    for azimuth, direction in {0: (0, 1), 90: (-1, 0), 180: (0, -1), -90: (1, 0)}.items():
        above = rig_figure([Rig([camera.turned(yaw_deg=azimuth)])]).axes[0]
        (wedge,) = above.patches
        pixels = above.transData.transform(wedge.get_xy())  # right, up
        looks = pixels[1:-1].mean(0) - pixels[0]
        np.testing.assert_allclose(looks / np.linalg.norm(looks), direction, atol=1e-6)


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


def test_scanners_are_drawn_in_their_places() -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 0.4, 1.7
    front = Lidar("front", pose, (-20.0, 0.0), 1.0, (1.0, 50.0), (-60.0, 60.0))
    camera = Camera.looking(name="a", azimuth_deg=0, width_px=64, height_px=48, horizontal_fov_deg=60.0)
    above, side = rig_figure([Rig([camera], lidars=[front], ground_z_m=-0.3)]).axes
    (dot,), (over_road, _) = above.lines, side.lines  # the last is the road
    assert np.allclose(dot.get_xydata(), [[0.4, 1.0]]) and np.allclose(over_road.get_xydata(), [[1.0, 2.0]])
