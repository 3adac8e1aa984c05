"""Contact sheets, outlines, rig pictures, tables, ``show``: sizes, places and colours; never golden images."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from arbiview_aug import RigRetarget, collate, project_boxes_3d, show
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.evaluate.metrics import RenderedView
from arbiview_aug.evaluate.report.pictures import (
    HOLE,
    contact_sheet,
    draw_rigs,
    frame_sheet,
    hatched_view,
    left_to_right,
    outline_coverage,
    rig_figure,
)
from arbiview_aug.evaluate.report.tables import (
    SEEN,
    cell,
    text_table,
)
from tests.helpers import camera, street_sample


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


def test_rig_figure_has_a_column_per_rig() -> None:
    one, two = (rig_figure([load_rig(name) for name in names]) for names in (["waymo"], ["waymo", "argoverse2"]))
    assert len(one.axes) == 2 and len(two.axes) == 4
    for axes, name in zip(two.axes[:2], ("waymo", "argoverse2"), strict=True):
        rig = load_rig(name)
        assert axes.get_title() == f"{name}: {len(rig)} cameras"
        assert {text.get_text().splitlines()[0] for text in axes.texts} == set(rig.names), "only its own names"
        assert len(axes.patches) == len(load_rig("waymo")) + len(load_rig("argoverse2")), "the other behind it"
        assert sum(patch.get_facecolor()[3] > 0 for patch in axes.patches) == len(rig), "its own wedges are filled"
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


def test_scanners_are_drawn_in_their_places() -> None:
    pose = np.eye(4)
    pose[:3, 3] = 1.0, 0.4, 1.7
    front = Lidar("front", pose, (-20.0, 0.0), 1.0, (1.0, 50.0), (-60.0, 60.0))
    camera = Camera.looking(name="a", azimuth_deg=0, width_px=64, height_px=48, horizontal_fov_deg=60.0)
    above, side = rig_figure([Rig([camera], lidars=[front], ground_z_m=-0.3)]).axes
    (dot,), (over_road, _) = above.lines, side.lines  # the last is the road
    assert np.allclose(dot.get_xydata(), [[0.4, 1.0]]) and np.allclose(over_road.get_xydata(), [[1.0, 2.0]])


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


def pictures(sample: Mapping[str, Any]) -> list[np.ndarray]:
    """The images in what ``show`` draws, three in a row over a caption of 20 px, 6 px apart."""
    drawn, (h, w) = np.asarray(show(sample)), sample["images"].shape[-2:]
    places = [(6 + k // 3 * (h + 26), 6 + k % 3 * (w + 6)) for k in range(len(sample["images"]))]
    return [drawn[y : y + h, x : x + w] for y, x in places]


def test_images_are_drawn_with_boxes() -> None:
    sample = street_sample()
    shown = zip(pictures(sample), sample["images"], strict=True)
    drawn = [bool((picture != image.permute(1, 2, 0).numpy()).any()) for picture, image in shown]
    labelled = [len(boxes.rows) > 0 for boxes in project_boxes_3d(sample["boxes_3d"], sample["rig"])]
    assert drawn == labelled and any(labelled)
    assert show(sample)._repr_png_().startswith(b"\x89PNG")


def test_what_no_camera_saw_is_dimmed() -> None:
    sample = street_sample()
    del sample["boxes_3d"]
    views = RigRetarget(sample["rig"].turned(pitch_deg=-10), geometry="street")(sample)
    for picture, image, seen in zip(pictures(views), views["images"], views["coverage"].numpy(), strict=True):
        image = image.permute(1, 2, 0).numpy()
        assert not seen.all() and (picture[seen] == image[seen]).all()
        assert picture[~seen].mean() < 0.5 * image[~seen].mean()


def test_batches_show_each_frame() -> None:
    sample = {key: value for key, value in street_sample().items() if key in ("images", "K", "cam2ego", "boxes_3d")}
    one, two = (show(batch).size for batch in (sample, collate([sample, sample])))
    assert two[0] == one[0] and two[1] > 2 * one[1], "with a title over each row"
