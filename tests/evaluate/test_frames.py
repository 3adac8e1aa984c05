"""Frames that score methods, what methods get of them, and reports and pictures of both."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget, collate, project_boxes_3d, show
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import LazyFrame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.evaluate.frames import Evaluation, evaluate, make_frame, retargeting, scores
from arbiview_aug.evaluate.lidar import coloured_points, lidar_split
from arbiview_aug.evaluate.metrics import RenderedView, as_arrays
from arbiview_aug.evaluate.report.pictures import (
    HOLE,
    contact_sheet,
    frame_sheet,
    hatched_view,
    left_to_right,
    rig_figure,
)
from arbiview_aug.evaluate.report.tables import TRUTH_COLUMNS, html_report, layers
from arbiview_aug.favs.config import PaperConfig
from tests.helpers import camera, street_sample

SIZE = (48, 132)
NAMES = ["fast, street", "own & only"]


@pytest.fixture(scope="module")
def done() -> Evaluation:
    drive, target = SyntheticDrive(demo_source_rig(SIZE), num_frames=1), demo_target_rig(SIZE)
    frame = make_frame(drive[0], truth=lambda rig: drive.render(0, rig), exposures=())
    methods = [retargeting("fast", "street", NAMES[0]), retargeting("draft", "infinity", NAMES[1])]
    return evaluate([("only", frame)], lambda _: target, methods)


@pytest.fixture(scope="module")
def page(done: Evaluation) -> str:
    means = {name: done.means(name) for name in NAMES}
    return html_report("A <title> & more", done, NAMES, [("Truth", means, TRUTH_COLUMNS, "a note")], ["5 < 6"])


def test_nothing_else_is_needed(page: str) -> None:
    sources = re.findall(r'\bsrc="([^"]{0,30})', page)
    assert len(sources) > 5 * 6 and all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert "http" not in re.sub(r'src="[^"]*"', "", page) and "<link" not in page


def test_text_is_escaped_and_numbers_are_there(page: str, done: Evaluation) -> None:
    assert "A &lt;title&gt; &amp; more" in page and "5 &lt; 6" in page and "own &amp; only" in page
    assert f"{done.means(NAMES[0])['true_covered_psnr_db']:.2f}" in page
    assert page.count('class="slider"') == 5 and page.count('type="range"') == 5


def test_layers(done: Evaluation) -> None:
    shown = {name: done.pictures[name] for name in NAMES}
    found = layers(0, done, shown)
    expected = ["nearest source camera"]
    for name in NAMES:
        expected += [name] if shown[name][0].coverage.all() else [name, f"{name}: unseen"]
    assert list(found) == [*expected, "truth"]
    np.testing.assert_array_equal(found[NAMES[0]], shown[NAMES[0]][0].image)


# --- rig pictures, sheets, ``show`` -----------------------------------------------------------------------------------
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


def test_text_is_as_large_a_part_of_wide_sheets() -> None:
    row = ("title", [np.full((30, 90, 3), 255, np.uint8)], ["caption"])
    for rows in ([row], [("", *row[1:])]):
        heights = [np.ptp(np.flatnonzero((contact_sheet(rows, width_px=w) < 128).any((1, 2)))) for w in (900, 3600)]
        assert heights[1] > 3.8 * heights[0], "text shrinks with the sheet where a page shows it"


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


# --- samples that methods get, frames that score them, named methods, agreement of neighbours -------------------------
FRAME_SIZE = (64, 176)


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive(demo_source_rig(FRAME_SIZE), num_frames=1)


@pytest.fixture(scope="module")
def sample(drive: SyntheticDrive) -> dict:
    return drive[0]


def untouched(sample: dict, target: Rig) -> list[RenderedView]:
    """For a target that is the source."""
    return [RenderedView(image, np.ones(image.shape[:2], bool)) for image in as_arrays(sample["images"])]


def test_points_are_split_between_method_and_score(sample: dict) -> None:
    frame = make_frame(sample, hand_over_points=True)
    everything = sample["points"].numpy()
    fit, test = lidar_split(everything)
    assert frame.held_out
    np.testing.assert_array_equal(frame.sample["points"].numpy(), everything[fit])
    for exposure in ("raw", "even"):
        reference = frame.lidar[exposure]
        assert reference.sample["points"] is frame.sample["points"]
        assert lidar_split(reference.points.points)[1].all(), "no point that a method has seen scores"
        assert 1000 < len(reference.points) <= test.sum()
    whole = coloured_points(sample["rig"], as_arrays(sample["images"]), everything.astype(np.float64))
    assert len(frame.lidar["raw"].points) == lidar_split(whole.points)[1].sum()


def test_methods_that_read_no_points_get_none_and_all_score(sample: dict) -> None:
    frame = make_frame(sample)
    assert "points" not in frame.sample and not frame.held_out
    whole = coloured_points(sample["rig"], as_arrays(sample["images"]), sample["points"].numpy().astype(np.float64))
    np.testing.assert_array_equal(frame.lidar["raw"].points.points, whole.points)
    assert "points" in sample, "the sample itself stays"


def test_neighbours_bring_no_points_where_points_score(sample: dict) -> None:
    """Theirs lie in the sectors that score, too. Their images are not read for that."""
    near = LazyFrame({"time_s": 0.5, "points": sample["points"]}, pytest.fail)
    drive = {**sample, "neighbours": [near]}
    for given in (True, False):
        frame = make_frame(drive, hand_over_points=given)
        for one in (frame.sample, *(reference.sample for reference in frame.lidar.values())):
            (kept,) = one["neighbours"]
            assert kept.get("points") is None and kept["time_s"] == 0.5 and "images" in list(kept)
    assert make_frame(drive, exposures=()).sample["neighbours"] == [near]


def test_even_exposures_reach_the_method(sample: dict) -> None:
    dim = sample["images"].clone()
    dim[0] = (dim[0].float() * 0.6).to(torch.uint8)
    frame = make_frame({**sample, "images": dim})
    even = as_arrays(frame.lidar["even"].sample["images"])
    ratio = even[0].mean() / as_arrays(dim)[0].mean()
    assert ratio > 1.2, "the dark camera is brightened"
    assert frame.lidar["raw"].sample["images"][0].float().mean() == pytest.approx(dim[0].float().mean())


def test_scores_of_the_source_itself(drive: SyntheticDrive, sample: dict) -> None:
    calls = []

    def render(given: dict, target: Rig) -> list[RenderedView]:
        calls.append(given)
        return untouched(given, target)

    frame = make_frame(sample, truth=lambda rig: drive.render(0, rig))
    views, rows = scores(frame, render, drive.rig)
    assert len(views) == len(rows) == 6 and len(calls) == 2
    assert views[0].image is not None and all(row["seen"] == 1 for row in rows)
    for row in rows:
        assert row["true_psnr_db"] > 100 and row["true_hole_share"] == 0
        share = sum(row[f"true_{name}_share"] for name in ("ground", "object", "sky"))
        assert share == pytest.approx(1)
        assert row["raw_coverage"] == 1 and row["raw_psnr_db"] > 20
    calls.clear()
    _, rows = scores(frame, render, drive.rig, ("even",))
    assert len(calls) == 1 and "even_psnr_db" in rows[0] and "raw_psnr_db" not in rows[0]


def test_retargeting_is_the_transform() -> None:
    sample = street_sample((48, 132))
    target = sample["rig"].turned(yaw_deg=10)
    views = retargeting("fast", "street").render(sample, target)
    out = RigRetarget(target, geometry="street", holes="black")(sample)
    for view, image, coverage in zip(views, as_arrays(out["images"]), out["coverage"], strict=True):
        np.testing.assert_array_equal(view.image, image)
        np.testing.assert_array_equal(view.coverage, coverage)
        assert not view.image[~view.coverage].any()


def test_names_and_points() -> None:
    assert retargeting("draft", "ground").name == "draft, ground"
    assert retargeting(PaperConfig(), name="mine").name == "mine"
    assert retargeting("fast", "auto").reads_points and not retargeting("fast", "street").reads_points
    assert not retargeting("paper", "auto").reads_points, "the published stages know rotations only"
