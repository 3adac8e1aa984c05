"""Named methods: the rows of the tables."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.rays import half_way_view
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate import methods
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.methods import one_camera, retargeting, views_of
from arbiview_aug.favs.config import PaperConfig
from arbiview_aug.render.overlap_depth import OverlapDepth, overlap_depth
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.helpers import street_sample


@pytest.fixture(scope="module")
def sample() -> dict:
    return street_sample((48, 132))


def test_retargeting_is_the_transform(sample: dict) -> None:
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


def test_one_camera_keeps_what_the_ego_frame_holds(sample: dict) -> None:
    maps = torch.arange(len(sample["rig"])).float()[:, None, None].expand(-1, 48, 132)
    of_all = {
        "detections": [],
        "neighbours": [],
        "learned_depth_m": maps,
        "motion_depth_m": list(maps),
        "depth_m": None,
    }
    alone = one_camera({**sample, **of_all}, 2)
    assert alone["rig"].names == [sample["rig"].names[2]] and len(alone["images"]) == 1
    assert alone["boxes_3d"] is sample["boxes_3d"] and not {"K", "cam2ego", "detections", "neighbours"} & set(alone)
    for key in ("learned_depth_m", "motion_depth_m"):
        assert len(alone[key]) == 1 and (alone[key][0] == 2).all(), key


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the target rig")
@pytest.mark.parametrize("surface", ["motion", "fused"])
def test_a_camera_alone_has_the_motion_of_all(surface: GeometryName) -> None:
    neighbours = Neighbours(count=1, step_m=1.0)
    drive = SyntheticDrive(demo_source_rig((96, 264)), num_frames=1, lidar=False, neighbours=neighbours)
    sample = drive[0]
    rig: Rig = sample["rig"]
    view = rig.with_cameras([half_way_view(rig[0], rig[1], (56, 100))])
    moving, still = (retargeting("fast", name).alone(sample, 0, view) for name in (surface, "boxes"))
    assert (moving.image != still.image).mean() > 0.1


@pytest.mark.filterwarnings("ignore:the target rig")
def test_depth_from_overlap_reaches_a_camera_alone() -> None:
    """``accurate`` finds depth where two cameras overlap; the view from one of them then knows it."""
    sample = SyntheticDrive(demo_source_rig((128, 352)), num_frames=1)[0]
    rig: Rig = sample["rig"]
    view = rig.with_cameras([half_way_view(rig[0], rig[1], (112, 200))])
    fast, accurate = retargeting("fast", "street"), retargeting("accurate", "street")
    assert fast.render_alone is None and accurate.render_alone is not None
    without = fast.alone(sample, 0, view)
    (same,) = accurate.render(one_camera(sample, 0), view)
    np.testing.assert_array_equal(same.image, without.image)
    corrections = overlap_depth(rig, list(sample["images"])).corrections
    assert corrections, "some pair is refined"
    changed = [(accurate.alone(sample, k, view).image != fast.alone(sample, k, view).image).any() for k in range(2)]
    assert any(changed)


@pytest.mark.filterwarnings("ignore:the target rig")
def test_a_camera_alone_knows_the_depth_that_all_together_use(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pixels of boxes on the street are not measured; over the street alone they are."""
    drive = SyntheticDrive(demo_source_rig((48, 132)), num_frames=1, lidar=False)
    sample, given = drive[0], []
    rig: Rig = sample["rig"]
    view = rig.with_cameras([half_way_view(rig[0], rig[1], (28, 50))])

    def spied(rig: Rig, images: list, boxes: np.ndarray | None = None) -> OverlapDepth:
        given.append(boxes)
        return overlap_depth(rig, images, boxes)

    monkeypatch.setattr(methods, "overlap_depth", spied)
    for surface in ("street", "boxes", "auto"):
        method = retargeting("accurate", surface)
        for _ in range(2):  # found once
            method.alone(sample, 0, view)
    street, *with_boxes = given
    assert street is None and [len(boxes) for boxes in with_boxes] == [len(sample["boxes_3d"])] * 2


def test_confidence_comes_along() -> None:
    out = {"images": torch.zeros(1, 3, 4, 5), "coverage": torch.ones(1, 4, 5, dtype=torch.bool)}
    assert views_of(out)[0].confidence is None
    (view,) = views_of({**out, "confidence": torch.full((1, 4, 5), 0.25, dtype=torch.float16)})
    assert view.confidence is not None and view.confidence.dtype == np.float32
    np.testing.assert_array_equal(view.confidence, 0.25)
