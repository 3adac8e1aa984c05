"""Other frames of a sample's drive: good ones in their places, bad ones named and left out."""

import warnings
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleError, SampleKeys, SampleTypeError
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig, demo_target_rig
from arbiview_aug.sample.frame import Neighbour
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.sample.neighbours import ChangeRisk, change_risks
from arbiview_aug.scene.point_cloud import seen_through

RIG = demo_source_rig((64, 176))


@pytest.fixture(scope="module")
def recorded() -> dict[str, Any]:
    drive = SyntheticDrive(RIG, num_frames=1, lidar=False, neighbours=Neighbours(count=2, direction="past"))
    sample = drive[0]
    return sample | {"neighbours": [dict(neighbour) for neighbour in sample["neighbours"]]}


@pytest.fixture
def sample(recorded: dict[str, Any]) -> dict[str, Any]:
    return recorded | {"neighbours": [dict(neighbour) for neighbour in recorded["neighbours"]]}


def read(sample: dict[str, Any], source: Rig | None = None) -> tuple[tuple[Neighbour, ...], list[str]]:
    said: list[str] = []
    (frame,) = read_frames(sample, source, further=("neighbours",), warn=lambda _, message: said.append(message))
    return frame.neighbours or (), said


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, *, yaw_deg: float = 0.0, pitch_deg: float = 0.0) -> np.ndarray:
    out = np.eye(4)
    a, b = np.radians([yaw_deg, pitch_deg])
    turn = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1]])
    out[:3, :3] = turn @ np.array([[np.cos(b), 0, np.sin(b)], [0, 1, 0], [-np.sin(b), 0, np.cos(b)]])
    out[:3, 3] = x, y, z
    return out


def test_cameras_and_boxes_are_where_they_were(sample: dict[str, Any]) -> None:
    near, said = read(sample)
    assert not said and [n.number for n in near] == [0, 1] and [n.travel_m for n in near] == pytest.approx([1.2, 2.4])
    for camera, then in zip(RIG, near[1].rig, strict=True):
        assert np.allclose(then.center_m, camera.center_m - [2.4, 0, 0], atol=1e-6)
    parked = np.linalg.norm(near[0].boxes[:, :3] - sample["boxes_3d"].numpy()[:, :3], axis=1) < 1e-3
    assert parked.sum() > 5 and not parked.all()
    assert np.allclose(near[0].boxes[parked, 6], sample["boxes_3d"].numpy()[parked, 6], atol=1e-4)
    here = sample.pop("ego2world").numpy()
    for neighbour in sample["neighbours"]:
        neighbour["ego2ego"] = np.linalg.solve(here, neighbour.pop("ego2world").numpy())
    assert all(np.allclose(a.rig.cam2ego, b.rig.cam2ego) for a, b in zip(near, read(sample)[0], strict=True))


def test_the_nearest_comes_first_and_keeps_its_number(sample: dict[str, Any]) -> None:
    sample["neighbours"].reverse()
    neighbours, _ = read(sample)
    assert [n.number for n in neighbours] == [1, 0]
    for ends in ((-1.0, 1.0), (1.0, -1.0)):  # of two at one distance the one behind
        pairs = zip(sample["neighbours"], ends, strict=True)
        entries = [neighbour | {"ego2ego": pose(x), "time_s": None} for neighbour, x in pairs]
        assert [n.ahead_m for n in read(sample | {"neighbours": entries})[0]] == [-1.0, 1.0]


def test_velocities_stand_in_for_missing_boxes(sample: dict[str, Any]) -> None:
    first = sample["neighbours"][0]
    for neighbour in sample["neighbours"]:
        del neighbour["boxes_3d"]
    assert all(n.boxes is None for n in read(sample)[0])
    boxes = torch.tensor([[10.0, 2.0, 0.8, 4.0, 1.8, 1.6, 0.0, 8.0, -1.0], [20.0, 2.0, 0.8, 4.0, 1.8, 1.6, 0, 0, 0]])
    neighbours, _ = read(sample | {"boxes_3d": boxes})
    seconds = first["time_s"]
    assert np.allclose(neighbours[0].boxes[:, :2], [[10 + 8 * seconds, 2 - seconds], [20, 2]], atol=1e-5)
    boxes[0, 7] = float("nan")  # it may have driven anywhere
    (nearest, _), _ = read(sample | {"boxes_3d": boxes})
    assert nearest.boxes is None and nearest.moved is None
    same_place = first | {"ego2ego": pose(0.01), "time_s": -1.0}  # which says nothing
    assert read(sample | {"neighbours": [same_place]}) == ((), [])


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"ego2world": None}, "it has none"),
        ({"ego2ego": np.full((4, 4), np.nan)}, "finite"),
        ({"ego2ego": 2 * np.eye(4)}, "a rotation"),
        ({"ego2ego": pose(200.0)}, "check poses"),
        ({"ego2ego": pose(5.0, z=4.0)}, "climb"),
        ({"ego2ego": pose(5.0, pitch_deg=20.0)}, "tilt"),
        ({"ego2ego": pose(30.0), "time_s": 0.1}, "clock"),
        ({"time_s": np.nan}, "time_s"),
        ({"rig": demo_target_rig((64, 176))}, "cameras"),
        ({"rig": demo_source_rig((32, 88))}, "as calibrated"),
        ({"rig": RIG.turned(yaw_deg=30)}, "another rig"),
        ({"boxes_3d": np.zeros((2, 5))}, "boxes_3d"),
        ({"ego2world": np.zeros((4, 4))}, "a last row 0 0 0 1"),
        ({"boxes_3d": "cars"}, "boxes_3d: expected"),
        ("nothing", "a mapping"),
    ],
)
def test_what_cannot_be_is_named_and_left_out(sample: dict[str, Any], change: Any, why: str) -> None:
    second = sample["neighbours"][1]
    sample["neighbours"][1] = change if isinstance(change, str) else second | change
    neighbours, said = read(sample)
    assert [n.number for n in neighbours] == [0]
    name = "1" if isinstance(change, str) else repr(second["token"])
    assert len(said) == 1 and said[0].startswith(f"neighbour {name} is left out: ") and why in said[0], said


@pytest.mark.parametrize("images", [None, torch.zeros(6, 3, 64, 100, dtype=torch.uint8), torch.rand(6, 3, 64, 176)])
def test_images_that_do_not_fit_are_named_and_left_out(sample: dict[str, Any], images: Any) -> None:
    good = sample["neighbours"][:1]
    target = RIG.turned(pitch_deg=-10)
    expected = RigRetarget(target)(sample | {"neighbours": good})
    sample["neighbours"][1]["images"] = images
    with pytest.warns(UserWarning, match=r"neighbour '.*' is left out: .*images"):
        out = RigRetarget(target)(sample)
    assert torch.equal(out["images"], expected["images"]) and torch.equal(out["coverage"], expected["coverage"])


def test_other_containers_and_too_many_are_refused(sample: dict[str, Any]) -> None:
    with pytest.raises(SampleTypeError, match="neighbours: expected a list of frames, got Tensor"):
        RigRetarget(RIG.turned(yaw_deg=5))(sample | {"neighbours": torch.zeros(2)})
    with pytest.raises(SampleError, match="at most 120 for a frame, got 200"):
        RigRetarget(RIG)(sample | {"neighbours": sample["neighbours"] * 100})


def test_a_batch_has_a_list_for_each_frame(sample: dict[str, Any]) -> None:
    retarget = RigRetarget(RIG.turned(pitch_deg=-10), keys=SampleKeys(extra=("source_frame",)))
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
    with pytest.raises(SampleTypeError, match="a list of frames, got dict"):
        retarget(batch | {"neighbours": sample["neighbours"]})
    with pytest.raises(SampleError, match=r"ego2world: expected a tensor .* got shape"):
        retarget(batch | {"neighbours": [sample["neighbours"]] * 2, "ego2world": torch.eye(4)[None]})


def test_poses_of_its_own_are_read_without_a_K(sample: dict[str, Any]) -> None:
    near = sample["neighbours"][0]
    near |= {"rig": None, "K": None, "cam2ego": RIG.shifted(x_m=0.2).cam2ego}
    (neighbour, _), _ = read(sample)
    np.testing.assert_allclose(neighbour.rig.cam2ego, neighbour.ego2ego @ near["cam2ego"], atol=1e-6)
    near["points"] = np.zeros((0, 4), np.float32)
    (neighbour, _), _ = read(sample)
    assert neighbour.points().shape == (0, 4)


def test_lenses_and_masks_of_the_rig_that_all_samples_share(sample: dict[str, Any]) -> None:
    """K and cam2ego say nothing of them: without its mask the own bonnet would be read as road."""
    mask = np.ones((64, 176), bool)
    mask[50:] = False
    lens = {"lens": "radtan", "distortion": (0.05, 0.0, 0.0, 0.0)}
    rig = RIG.with_cameras([replace(camera, mask=mask, **lens) for camera in RIG])
    bare = {key: value for key, value in sample.items() if key not in ("rig", "K", "cam2ego")}
    for neighbour in bare["neighbours"]:
        neighbour.pop("rig", None)
        neighbour |= {"K": rig.K, "cam2ego": rig.cam2ego}
    neighbours, said = read(bare, rig)
    assert not said and len(neighbours) == 2
    for camera in neighbours[0].rig:
        assert camera.lens == "radtan" and np.array_equal(camera.mask, mask)


# --- LiDAR points of other frames -------------------------------------------------------------------------------------
def test_points_come_where_they_and_their_objects_are_now(sample: dict[str, Any]) -> None:
    """A post stays, a car drives on and turns, one without a counterpart and the own car are left out."""
    first = sample["neighbours"][0] | {"ego2ego": pose(-1.2), "time_s": -0.1}
    car, other = [10.0, 0, 0.8, 4, 1.8, 1.6, 0], [30.0, 5, 0.8, 6, 2.5, 3, 0]
    first["boxes_3d"] = np.array([car, other])
    now = np.array([[11.0, 0, 0.8, 4, 1.8, 1.6, np.pi / 2]])
    first["points"] = np.array([[20.0, 3, 1], [11.5, 0.5, 1], [30.0, 5, 1], [0.5, 0.5, 0.5]], np.float32)
    ((nearest, *_), said) = read(sample | {"neighbours": [first], "boxes_3d": now})
    assert not said
    # The car's centre was at 8.8 in the current frame; its front right lies on the left of where it is now.
    np.testing.assert_allclose(nearest.points(), [[18.8, 3, 1], [10.5, 1.5, 1]], atol=1e-5)
    for then, here in ((np.zeros((0, 7)), now), (first["boxes_3d"], now[:0])):
        ((nearest, *_), _) = read(sample | {"neighbours": [first | {"boxes_3d": then}], "boxes_3d": here})
        assert len(nearest.points()) == (3 if len(here) else 1)
    # A trailer without a counterpart reaches over the car; and a car is not the same one 50 m on.
    both = {"boxes_3d": np.array([car, [11.0, 0.5, 0.8, 6, 2.5, 3, 0]])}
    ((nearest, *_), _) = read(sample | {"neighbours": [first | both], "boxes_3d": now})
    np.testing.assert_allclose(nearest.points(), [[18.8, 3, 1], [10.5, 1.5, 1], [28.8, 5, 1]], atol=1e-5)
    ((nearest, *_), _) = read(sample | {"neighbours": [first], "boxes_3d": now + np.array([50, 0, 0, 0, 0, 0, 0])})
    assert len(nearest.points()) == 1
    del first["boxes_3d"]
    ((nearest, *_), _) = read(sample | {"neighbours": [first], "boxes_3d": now})
    np.testing.assert_allclose(nearest.points(), first["points"][:3] - [1.2, 0, 0], atol=1e-5)


def _wall(x_m: float, y_m: tuple[float, float], z_m: Any) -> np.ndarray:
    y, z = np.meshgrid(np.linspace(*y_m, 150), z_m)
    return np.stack([np.full_like(y, x_m), y, z], -1).reshape(-1, 3)


def test_scan_lines_of_other_frames_fill_the_gaps(sample: dict[str, Any]) -> None:
    """A wall at 8 m between the lines of a scan, and a ghost before it that those lines see through."""
    lines, between = _wall(8.0, (-3, 0), [0.3, 2.7]), _wall(8.0, (-3, 0), np.arange(0.4, 2.7, 0.05))
    far, ghost = _wall(40.0, (6, 20), np.arange(0.0, 8.0, 0.35)), _wall(8.0, (1.6, 2.8), [1.6, 1.7])
    entries = {key: sample[key] for key in ("images", "rig", "ego2world")}
    entries |= {"points": torch.from_numpy(np.concatenate([lines, far]))}
    then = {**sample["neighbours"][0], "points": np.concatenate([between, ghost])}
    then["points"][:, 0] += 1.2
    del then["boxes_3d"]
    retarget = RigRetarget(Rig([RIG[0].shifted(z_m=0.6)]))
    plain, swept = (retarget.explain(entries | {"neighbours": [one]}) for one in ({**then, "points": None}, then))
    assert "neighbouring frames" not in str(plain)
    assert f"points, {len(between)} points of neighbouring frames; the street" in str(swept)
    off = {}
    for name, explained in (("plain", plain), ("swept", swept)):
        (plan,) = explained.plan.targets
        off[name] = np.arange(64)[:, None] - plan.at.to_float()[..., 1]
    near_px = 0.6 / (8 - RIG[0].center_m[0]) * RIG[0].K[1, 1]
    rows = slice(28, 38)
    assert abs(off["swept"][rows, 100:130] - near_px).max() < 0.5 < abs(off["plain"][rows, 100:130] - near_px).max()
    for points in (np.zeros((0, 3)), np.zeros((2, 3)), RIG.cam2ego[:, :3, 3].mean(0)[None]):  # which contradict nothing
        assert not seen_through(points, then["points"], RIG.cam2ego[:, :3, 3].mean(0)).any()
    # None but the frame's own points without neighbours, and none are read over the street.
    unread, alone = {**then, "points": "unreadable"}, RigRetarget(retarget.target, neighbours=None)
    assert torch.equal(alone(entries | {"neighbours": [unread]})["images"], alone(entries)["images"])
    RigRetarget(retarget.target, geometry="street")(entries | {"neighbours": [unread]})
    with pytest.warns(UserWarning, match=r"points of neighbour '.*' are left out: points: expected a tensor"):
        out = retarget(entries | {"neighbours": [unread]})
    assert torch.equal(out["images"], retarget(entries | {"neighbours": [{**then, "points": None}]})["images"])


# --- labels that moved between two frames
CAR = np.array([10.0, 0.0, 1.0, 4.0, 2.0, 2.0, 0.0])


def test_risk_falls_with_the_distance_relative_to_height() -> None:
    """A car 2 m high casts shadows up to 2.6 m and contact shadows up to 0.6 m, on all sides; turned as well."""
    beside = np.array([0.5, 0.7, 2.5, 2.7])
    expected = [ChangeRisk.BESIDE, ChangeRisk.SHADED, ChangeRisk.SHADED, ChangeRisk.NONE]
    for yaw, along in ((0.0, 2.0), (np.pi / 2, 1.0)):
        box = np.array([*CAR[:6], yaw])
        for sign in (-1, 1):
            points = np.stack([CAR[0] + sign * (along + beside), np.zeros(4), np.zeros(4)], -1)
            assert change_risks(box[None], points).tolist() == expected
    assert not change_risks(np.zeros((0, 7)), points).any() and not len(change_risks(CAR[None], points[:0]))
