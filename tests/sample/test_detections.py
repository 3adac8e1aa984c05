"""A sample's detections and labelled boxes give stage 3 of ``quality="paper"`` its types."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from arbiview_aug import PaperConfig, Rig, RigRetarget, SampleError
from arbiview_aug.datasets import FrameFolder, NuScenesDataset
from arbiview_aug.favs.renderer import PaperRendering
from arbiview_aug.sample.detections import UNNAMED_TYPE, read_detections
from arbiview_aug.sample.inputs import read_frames
from tests.helpers import camera

# 90 degrees over 801 px: focal length 400 px, principal point (400, 200), looking along the ego's x axis.
FRONT = camera(size=(401, 801), position_m=(0, 0, 1.0), horizontal_fov_deg=90)
RIG = Rig([FRONT, replace(FRONT.turned(yaw_deg=180), name="back")])
IMAGES = torch.zeros(2, 3, 401, 801, dtype=torch.uint8)


def detected(sample: dict, lead: tuple[int, ...] = ()) -> list:
    sample = {"images": IMAGES.expand(*lead, -1, -1, -1, -1), "rig": RIG, **sample}
    return [
        read_detections(frame) for frame in read_frames(sample, None, further=("detections", "box_names", "boxes_3d"))
    ]


def box(x: float, y: float = 0.0, z: float = 1.0, yaw: float = 0.0, size=(2.0, 2.0, 2.0)) -> list[float]:
    return [x, y, z, *size, yaw]


def test_boxes_are_projected_by_hand() -> None:
    """A cube of 2 m whose near face is 10 m ahead: half a side is f / 10 = 40.05 px around the middle."""
    f = FRONT.K[0, 0]
    (frame,) = detected({"boxes_3d": torch.tensor([box(11.0)]), "box_names": ["vehicle.car"]})
    (seen,) = frame[0]
    assert seen.type == "vehicle.car" and frame[1] == []
    assert np.allclose(seen.box, (400 - f / 10, 200 - f / 10, 400 + f / 10, 200 + f / 10))
    # Turned by 45 degrees its corner points at the camera: half a diagonal to both sides at 11 m.
    (turned,) = detected({"boxes_3d": torch.tensor([box(11.0, yaw=np.pi / 4)])})[0][0]
    half = f * np.sqrt(2) / 11
    assert turned.type == UNNAMED_TYPE
    assert np.allclose((turned.box[0], turned.box[2]), (400 - half, 400 + half))
    # Beside the vehicle, reaching behind it: both cameras see its part, cut at their borders.
    (frame,) = detected({"boxes_3d": torch.tensor([box(0.0, y=3.0, size=(20.0, 2.0, 2.0))])})
    assert frame[0][0].box[0] == 0 and frame[1][0].box[2] == 800
    assert detected({"boxes_3d": torch.tensor([box(11.0, y=60.0)])})[0] == {0: [], 1: []}
    assert detected({"boxes_3d": torch.zeros(0, 7)})[0] == {0: [], 1: []} and detected({}) == [{}]


def test_detections_win_over_boxes_and_batches_have_an_entry_a_frame() -> None:
    detections = [{"boxes": torch.tensor([[1.0, 2, 30, 40]]), "labels": ["pedestrian"]}, {"boxes": [], "labels": []}]
    sample = {"detections": detections, "boxes_3d": torch.tensor([box(11.0)])}
    (frame,) = detected(sample)
    assert frame[0][0].box == (1, 2, 30, 40) and frame[0][0].type == "pedestrian" and frame[1] == []
    assert detected({"detections": [detections, detections]}, (2,)) == [frame, frame]
    boxes = {"boxes_3d": torch.tensor([[box(11.0)], [box(21.0)]]), "box_names": [["bus"], ["tram"]]}
    assert [f[0][0].type for f in detected(boxes, (2,))] == ["bus", "tram"]
    del boxes["box_names"]
    assert [f[0][0].type for f in detected(boxes, (2,))] == [UNNAMED_TYPE] * 2


@pytest.mark.parametrize(
    ("sample", "message"),
    [
        ({"detections": {}}, r"detections: expected a list of 2, one for each of the cameras"),
        ({"detections": [{}]}, r"detections: expected one for each of the 2 cameras, got 1"),
        ({"detections": [{"boxes": []}, {}]}, r"detections\[0\]: expected a dict with 'boxes' \(n, 4\) and 'labels'"),
        ({"detections": [{"boxes": [[1, 2, 3]], "labels": ["a"]}] * 2}, r"expected boxes \(n, 4\).*got \(1, 3\)"),
        ({"detections": [{"boxes": [[9, 2, 3, 4]], "labels": ["a"]}] * 2}, r"x0 <= x1"),
        ({"detections": [{"boxes": [[1, 2, 3, 4]], "labels": [7]}] * 2}, r"names such as 'vehicle', got \[7\]"),
        ({"detections": [{"boxes": [[1, 2, 3, 4]], "labels": []}] * 2}, r"one for each of the 1 boxes, got 0"),
        ({"boxes_3d": torch.tensor([box(11.0)]), "box_names": []}, r"box_names: expected one for each of the 1 boxes"),
    ],
)
def test_messages(sample: dict, message: str) -> None:
    with pytest.raises((SampleError, TypeError), match=message):
        detected(sample)


def test_names_in_parts_have_the_weight_of_a_part() -> None:
    config = PaperConfig(type_weights=(("vehicle", 0.9), ("pedestrian", 0.7), ("vehicle.bus.rigid", 0.1)))
    weights = [config.type_weight(k) for k in ("vehicle.car", "human.pedestrian.adult", "vehicle.bus.rigid", "animal")]
    assert weights == [0.9, 0.7, 0.1, 0.5]


@pytest.mark.slow
def test_labels_of_a_real_frame_reach_stage_3(nuscenes_root) -> None:
    labelled, small = (
        NuScenesDataset(nuscenes_root, "v1.0-mini", load_points=False)[0],
        FrameFolder(nuscenes_root, reduce=2)[0],
    )
    sample = {key: small[key] for key in ("images", "rig")} | {k: labelled[k] for k in ("boxes_3d", "box_names")}
    rendering = RigRetarget(sample["rig"].turned(yaw_deg=-22), quality="paper").explain(sample).rendering
    assert isinstance(rendering, PaperRendering)
    types = {o.type for view in rendering.targets for r in view.reports for o in r.objects.objects}
    assert types - {"ground", "upright", "far"} <= set(labelled["box_names"]) and "vehicle.truck" in types
