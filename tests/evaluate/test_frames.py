"""Samples that methods get, frames that score them, named methods, agreement of neighbours."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import LazyFrame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.frames import make_frame, retargeting, scores
from arbiview_aug.evaluate.lidar import coloured_points, lidar_split
from arbiview_aug.evaluate.metrics import RenderedView, as_arrays
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.helpers import street_sample

SIZE = (64, 176)


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive(demo_source_rig(SIZE), num_frames=1)


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
