"""What a sample says of other frames of its drive: good ones in their places, bad ones named and left out."""

import warnings
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget, SampleError, SampleTypeError
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.neighbours import Neighbour, neighbours_of_frames
from arbiview_aug.sample import check_inputs

RIG = demo_source_rig((64, 176))


@pytest.fixture(scope="module")
def recorded() -> dict[str, Any]:
    drive = SyntheticDrive(RIG, num_frames=1, lidar=False, neighbours=Neighbours(count=2, direction="past"))
    sample = drive[0]
    return sample | {"neighbours": [dict(neighbour) for neighbour in sample["neighbours"]]}


@pytest.fixture
def sample(recorded: dict[str, Any]) -> dict[str, Any]:
    return recorded | {"neighbours": [dict(neighbour) for neighbour in recorded["neighbours"]]}


def read(sample: dict[str, Any]) -> tuple[list[Neighbour], list[str]]:
    said: list[str] = []
    (found,) = neighbours_of_frames(sample, check_inputs(sample, None), (), lambda _, message: said.append(message))
    return found, said


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> np.ndarray:
    out = np.eye(4)
    a, b = np.radians([yaw_deg, pitch_deg])
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    out[:3, :3] = turn @ np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    out[:3, 3] = x, y, z
    return out


def test_cameras_and_boxes_are_where_they_were(sample: dict[str, Any]) -> None:
    found, said = read(sample)
    assert not said and [n.number for n in found] == [0, 1] and [n.travel_m for n in found] == pytest.approx([1.2, 2.4])
    for camera, then in zip(RIG, found[1].rig, strict=True):
        assert np.allclose(then.center_m, camera.center_m - [2.4, 0, 0], atol=1e-6)
    parked = np.linalg.norm(found[0].boxes[:, :3] - sample["boxes_3d"].numpy()[:, :3], axis=1) < 1e-3
    assert parked.sum() > 5 and not parked.all()
    assert np.allclose(found[0].boxes[parked, 6], sample["boxes_3d"].numpy()[parked, 6], atol=1e-4)


def test_a_pose_between_the_frames_says_the_same(sample: dict[str, Any]) -> None:
    by_world, _ = read(sample)
    here = sample.pop("ego2world").numpy()
    for neighbour in sample["neighbours"]:
        neighbour["ego2ego"] = np.linalg.solve(here, neighbour.pop("ego2world").numpy())
    found, said = read(sample)
    assert not said and all(np.allclose(a.rig.cam2ego, b.rig.cam2ego) for a, b in zip(found, by_world, strict=True))


def test_the_nearest_comes_first_and_keeps_its_number(sample: dict[str, Any]) -> None:
    sample["neighbours"].reverse()
    found, _ = read(sample)
    assert [n.number for n in found] == [1, 0]


def test_velocities_stand_in_for_missing_boxes(sample: dict[str, Any]) -> None:
    first = sample["neighbours"][0]
    for neighbour in sample["neighbours"]:
        del neighbour["boxes_3d"]
    assert all(n.boxes is None for n in read(sample)[0])
    boxes = torch.tensor(
        [[10.0, 2.0, 0.8, 4.0, 1.8, 1.6, 0.0, 8.0, -1.0], [20.0, 2.0, 0.8, 4.0, 1.8, 1.6, 0, np.nan, 0]]
    )
    found, _ = read(sample | {"boxes_3d": boxes})
    seconds = first["time_s"]
    assert seconds < 0
    assert np.allclose(found[0].boxes[:, :2], [[10 + 8 * seconds, 2 - seconds], [20, 2]], atol=1e-5)


def test_the_same_place_says_nothing(sample: dict[str, Any]) -> None:
    sample["neighbours"] = [sample["neighbours"][0] | {"ego2ego": pose(0.01), "time_s": -1.0}]
    assert read(sample) == ([], [])


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"ego2world": None}, "it has none"),
        ({"ego2ego": np.full((4, 4), np.nan)}, "finite"),
        ({"ego2ego": np.eye(3)}, "shape"),
        ({"ego2ego": 2 * np.eye(4)}, "a rotation"),
        ({"ego2ego": pose(200.0)}, "a pose jumped"),
        ({"ego2ego": pose(5.0, z=4.0)}, "climb"),
        ({"ego2ego": pose(5.0, pitch_deg=20.0)}, "tilt"),
        ({"ego2ego": pose(30.0), "time_s": 0.1}, "clock"),
        ({"time_s": np.nan}, "time_s"),
        ({"time_s": "soon"}, "time_s"),
        ({"rig": demo_target_rig((64, 176))}, "cameras"),
        ({"rig": demo_source_rig((32, 88))}, "as calibrated"),
        ({"rig": RIG.turned(yaw_deg=30)}, "another rig"),
        ({"boxes_3d": np.zeros((2, 5))}, "boxes_3d"),
        ("nothing", "a mapping"),
    ],
)
def test_what_cannot_be_is_named_and_left_out(sample: dict[str, Any], change: Any, why: str) -> None:
    second = sample["neighbours"][1]
    sample["neighbours"][1] = change if isinstance(change, str) else second | change
    found, said = read(sample)
    assert [n.number for n in found] == [0]
    name = "1" if isinstance(change, str) else repr(second["token"])
    assert len(said) == 1 and said[0].startswith(f"neighbour {name} is left out: ") and why in said[0], said


@pytest.mark.parametrize(
    "images",
    [None, torch.zeros(6, 3, 64, 100, dtype=torch.uint8), torch.rand(6, 3, 64, 176), np.zeros((6, 3, 64, 176))],
)
def test_images_that_do_not_fit_are_named_and_left_out(sample: dict[str, Any], images: Any) -> None:
    good = sample["neighbours"][:1]
    target = RIG.turned(pitch_deg=-10)
    expected = RigRetarget(target)(sample | {"neighbours": good})
    sample["neighbours"][1]["images"] = images
    with pytest.warns(UserWarning, match=r"neighbour '.*' is left out: .*images"):
        out = RigRetarget(target)(sample)
    assert torch.equal(out["images"], expected["images"]) and torch.equal(out["coverage"], expected["coverage"])


def test_another_container_is_refused(sample: dict[str, Any]) -> None:
    with pytest.raises(SampleTypeError, match="neighbours: expected a list of frames, got Tensor"):
        RigRetarget(RIG.turned(yaw_deg=5))(sample | {"neighbours": torch.zeros(2)})


def test_too_many_are_refused(sample: dict[str, Any]) -> None:
    with pytest.raises(SampleError, match="at most 120 for a frame, got 200"):
        RigRetarget(RIG)(sample | {"neighbours": sample["neighbours"] * 100})


def test_a_batch_has_a_list_for_each_frame(sample: dict[str, Any]) -> None:
    retarget = RigRetarget(RIG.turned(pitch_deg=-10), outputs=("source_frame",))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one, alone = retarget(sample), retarget(sample | {"neighbours": []})
        keys = ("images", "K", "cam2ego", "ego2world")
        batch = {key: torch.stack([sample[key]] * 2) for key in keys} | {"rig": RIG, "time_s": torch.zeros(2)}
        batch |= {"boxes_3d": [sample["boxes_3d"]] * 2, "neighbours": [sample["neighbours"], []]}
        both = retarget(batch)
    for key in ("images", "coverage", "source_frame"):
        assert torch.equal(both[key], torch.stack([one[key], alone[key]]))
    assert (one["source_frame"] > 0).any()
    with pytest.raises(SampleTypeError, match="a list of 2 lists"):
        retarget(batch | {"neighbours": sample["neighbours"]})
