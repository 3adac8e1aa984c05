"""Points in ``RigRetarget``'s output where the target has scanners."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import (
    CalibrationError,
    Lidar,
    RandomRig,
    RetargetedDataset,
    RigRetarget,
    SampleError,
    SampleKeys,
    collate,
    retarget_points,
)
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import SampleTypeError
from arbiview_aug.scene.boxes import checked_boxes, points_by_box
from tests.helpers import street_sample

POSE = np.array([[1.0, 0, 0, 0.9], [0, 1, 0, 0], [0, 0, 1, 2.2], [0, 0, 0, 1]])
TOP = Lidar("top", POSE, tuple(np.linspace(-25, 5, 12)), 2.0, (1.0, 80.0))
SIZE = (64, 176)


def target(**changes: Any) -> Any:
    return replace(demo_source_rig(SIZE), **({"lidars": [TOP]} | changes))


@pytest.fixture(scope="module")
def sample() -> dict[str, Any]:
    return street_sample(SIZE)


def test_points_are_those_of_the_target(sample: dict[str, Any]) -> None:
    out = RigRetarget(target())(sample)
    points, rings, counts = out["points"], out["point_rings"], out["num_points"]
    assert points.dtype == torch.float32 and points.shape[1] == 4
    assert 500 < len(points) == len(rings) <= 12 * 180
    away = points[:, :3].double().numpy() - POSE[:3, 3]
    elevation = np.degrees(np.arcsin(away[:, 2] / np.linalg.norm(away, axis=1)))
    np.testing.assert_allclose(elevation, np.array(TOP.elevations_deg)[rings], atol=0.01)
    bare = retarget_points(sample["points"], target())  # labels tell what is counted, not what is measured
    assert bare.counts is None and torch.equal(bare.points, points)
    assert set(points[:, 3].tolist()) <= set(sample["points"][:, 3].tolist())
    assert counts.shape == (len(sample["boxes_3d"]),) and counts.dtype == torch.int64 and counts.sum() > 0
    assert "top (2160 rays)" in str(RigRetarget(target()).explain(sample))


def test_points_pass_without_scanners(sample: dict[str, Any]) -> None:
    out = RigRetarget(target(lidars=()))(sample)
    assert out["points"] is sample["points"] and "point_rings" not in out and "num_points" not in out
    bare = {key: value for key, value in sample.items() if key not in ("points", "boxes_3d", "box_classes")}
    assert not {"points", "point_rings", "num_points"} & RigRetarget(target())(bare).keys()


def test_points_stay_on_demand(sample: dict[str, Any]) -> None:
    """Also where the target is drawn around a rig with scanners."""
    keys = SampleKeys(points="source")
    for to in (target(), RandomRig(target(), height_m=0.3)):
        retarget = RigRetarget(to, keys=keys)
        out = retarget(sample)
        assert out["points"] is sample["points"] and "point_rings" not in out and "num_points" not in out
        assert "measured" not in str(retarget.explain(sample)).splitlines()[-1]
    with pytest.raises(ValueError, match=r"SampleKeys\.points"):
        SampleKeys(points="both")  # type: ignore[arg-type]


def assert_of_one_rig(out: dict[str, Any], rig: Any) -> None:
    """Cameras, points, rings and numbers of points all belong to a rig in the ego frame of the sample."""
    np.testing.assert_allclose(out["cam2ego"], rig.cam2ego, atol=1e-9)
    np.testing.assert_allclose(out["K"], rig.K, atol=1e-9)
    points, (scanner,) = out["points"].double().numpy(), rig.lidars
    away = points[:, :3] - scanner.center_m
    elevation = np.degrees(np.arcsin(away[:, 2] / np.linalg.norm(away, axis=1)))
    assert len(points) > 200
    np.testing.assert_allclose(elevation, np.array(scanner.elevations_deg)[out["point_rings"]], atol=0.02)
    _, ends = points_by_box(checked_boxes(out["boxes_3d"]), points[:, :3].astype(np.float32), 0.0)
    np.testing.assert_array_equal(out["num_points"], np.diff(ends, prepend=0))


@pytest.fixture(scope="module")
def recorded() -> list[dict[str, Any]]:
    drive = SyntheticDrive(demo_source_rig((32, 88)), num_frames=4)
    return [drive[k] for k in range(4)]


@pytest.mark.parametrize("workers", [0, 1])
def test_everything_of_a_sample_is_of_one_rig(recorded: list[dict[str, Any]], workers: int) -> None:
    """Each sample has its own draw of the rig, and of whether to retarget."""
    base = replace(recorded[0]["rig"], lidars=[TOP])
    random = RandomRig(base, yaw_deg=8.0, height_m=0.4, forward_m=0.3)
    data = RetargetedDataset(recorded * 2, RigRetarget(random, p=0.6, size=(32, 88), geometry="street"))
    torch.manual_seed(4)
    skipped = set()
    for batch in torch.utils.data.DataLoader(data, batch_size=4, num_workers=workers, collate_fn=collate):
        for k, params in enumerate(batch["retarget_params"]):
            out = {key: value[k] for key, value in batch.items()}
            drawn = {name: value for name, value in params.items() if name != "skipped"}
            skipped.add(bool(params["skipped"]))
            if params["skipped"]:
                np.testing.assert_allclose(out["cam2ego"], base.cam2ego)
                (of,) = (frame for frame in recorded if torch.equal(frame["points"], out["points"]))
                assert torch.equal(out["images"], of["images"]) and (out["point_rings"] == -1).all()
            else:
                assert_of_one_rig(out, random.rig(drawn))
    assert skipped == {True, False}


def test_arrays_and_dtypes_stay(sample: dict[str, Any]) -> None:
    retarget = RigRetarget(target())
    expected = retarget(sample)["points"]
    array = retarget(sample | {"points": sample["points"].numpy()})["points"]
    assert isinstance(array, np.ndarray)
    np.testing.assert_array_equal(array, expected.numpy())
    double = retarget(sample | {"points": sample["points"].double()})["points"]
    assert double.dtype == torch.float64 and torch.equal(double.float(), expected)


def test_batches_are_their_frames(recorded: list[dict[str, Any]]) -> None:
    retarget = RigRetarget(target())
    singles, batch = [retarget(frame) for frame in recorded[:2]], retarget(collate(recorded[:2]))
    for key in ("points", "point_rings", "num_points"):
        assert all(torch.equal(one[key], two) for one, two in zip(singles, batch[key], strict=True))


def test_skipped_samples_have_the_same_keys(sample: dict[str, Any]) -> None:
    retarget = RigRetarget(target(), p=0.5, size=SIZE)
    skipped, scanned = (retarget(sample, params={"skipped": skip}) for skip in (1.0, 0.0))
    assert skipped.keys() == scanned.keys() and skipped["points"] is sample["points"]
    assert (skipped["point_rings"] == -1).all() and len(skipped["point_rings"]) == len(sample["points"])
    missing = torch.cat([sample["points"], torch.full_like(sample["points"][:3], torch.nan)])
    with pytest.warns(UserWarning, match="rows with NaN"):
        skipped = retarget({**sample, "points": missing}, params={"skipped": 1.0})
    assert len(skipped["point_rings"]) == len(missing)


def test_both_roads_coincide(sample: dict[str, Any]) -> None:
    """A target whose frame is 0.3 m higher has its scanner 0.3 m lower there; the points are the same."""
    lower = replace(demo_source_rig(SIZE).shifted(z_m=-0.3), ground_z_m=-0.3, lidars=[TOP.shifted(z_m=-0.3)])
    one, two = RigRetarget(target())(sample)["points"], RigRetarget(lower)(sample)["points"]
    torch.testing.assert_close(one, two, atol=1e-3, rtol=0)
    moved = RigRetarget(lower, keys=SampleKeys(frame="target"))(sample)["points"]
    torch.testing.assert_close(moved[:, 2], two[:, 2] - 0.3, atol=1e-4, rtol=0)


@pytest.mark.parametrize("zeros", [torch.zeros, np.zeros])
@pytest.mark.parametrize("shape", [(0,), (0, 4), (0, 3)])
def test_no_points(sample: dict[str, Any], shape: tuple[int, ...], zeros: Any) -> None:
    out = RigRetarget(target(), geometry="street")(sample | {"points": zeros(shape)})
    assert out["points"].shape == shape and len(out["point_rings"]) == 0 and out["num_points"].sum() == 0


def test_missing_returns_are_left_out() -> None:
    points = torch.tensor([[10.0, 0.0, 1.0, 7.0], [float("nan")] * 4, [10.0, 0.1, 1.0, 8.0]])
    with pytest.warns(UserWarning, match="rows with NaN"):
        out = retarget_points(points, target())
    assert torch.isfinite(out.points).all() and set(out.points[:, 3].tolist()) <= {7.0, 8.0}


# --- neighbouring scans -----------------------------------------------------------------------------------------------
WALL = torch.tensor([[15.0, y, z, 30.0] for y in np.arange(-6, 6, 0.05) for z in np.arange(0.1, 4, 0.1)]).float()


def with_wall(sample: dict[str, Any], **more: Any) -> dict[str, Any]:
    """A frame that sees the right half of a wall; its neighbour, 1.2 m behind, saw all of it."""
    behind = torch.eye(4, dtype=torch.float64)
    behind[0, 3] = -1.2
    seen = WALL + torch.tensor([1.2, 0, 0, 5.0])
    neighbour = {key: sample[key] for key in ("images", "rig")} | {"ego2ego": behind, "points": seen}
    kept = {key: sample[key] for key in ("images", "rig")}
    return kept | {"points": WALL[WALL[:, 1] < 0], "neighbours": [neighbour | more]}


def test_neighbouring_scans_fill_what_one_does_not_see(sample: dict[str, Any]) -> None:
    alone, filled = (RigRetarget(target(), neighbours=n)(with_wall(sample))["points"] for n in (None, "road"))
    left = filled[:, 1] > 1
    assert (alone[:, 1] < 0.5).all() and len(alone) > 50
    assert left.sum() > 0.3 * len(filled)
    assert (filled[left, 0] - 15).abs().median() < 0.01
    assert (filled[left, 3] == 35).all() and set(filled[:, 3].tolist()) == {30.0, 35.0}  # the nearest point's columns
    explained = [RigRetarget(target(), neighbours=n).explain(with_wall(sample)) for n in (None, "road")]
    unsupported = [int(str(one).split("rays); ")[1].split("%")[0]) for one in explained]
    assert unsupported[1] < unsupported[0]


def test_neighbours_without_fitting_points(sample: dict[str, Any]) -> None:
    expected = RigRetarget(target(), neighbours=None)(with_wall(sample))["points"]
    for points, message in (("unreadable", "points of neighbour 0 are left out"), (WALL[:, :3], "4 columns, got .3.")):
        with pytest.warns(UserWarning, match=message):
            out = RigRetarget(target())(with_wall(sample, points=points))
        assert torch.equal(out["points"], expected)


def test_sweeps_of_users() -> None:
    own, other = WALL[WALL[:, 1] < 0], WALL[WALL[:, 1] >= 0].numpy()
    both = retarget_points(torch.cat([own, torch.from_numpy(other)]), target()).points
    assert torch.equal(retarget_points(own, target(), sweeps=[other[:50], other[50:]]).points, both)
    assert isinstance(retarget_points(own.numpy(), target(), sweeps=[other]).points, np.ndarray)
    layouts = (
        torch.from_numpy(other),
        other.tolist(),
        np.asarray(other, order="F"),
        other[::-1][::-1],
        other.astype(float),
    )
    for sweep in layouts:
        assert torch.equal(retarget_points(own, target(), sweeps=[sweep]).points, both)


# --- bad input --------------------------------------------------------------------------------------------------------
BEHIND = torch.tensor([[-20.0, 0.3 * k, 1.0, 5.0] for k in range(100)])
AROUND = torch.tensor([[0.9, 0.0, 1.5, 6.0, 3.0, 4.0, 0.0]])


@pytest.mark.parametrize(
    ("lidar", "more", "is_empty"),
    [
        ({}, {"boxes_3d": AROUND}, False),  # inside an object
        ({"lidar2ego": POSE @ np.diag([1.0, -1, -1, 1])}, {}, False),  # upside down
        ({"elevations_deg": (-5.0,)}, {}, False),  # one beam
        ({"elevations_deg": tuple(np.linspace(-25, 15, 1024)), "azimuth_step_deg": 30.0}, {}, False),
        ({"azimuth_step_deg": 360.0}, {}, False),  # one column
        ({"azimuth_deg": (-30, 30)}, {"points": BEHIND}, True),  # all points behind
        ({}, {"points": torch.zeros(0, 4)}, True),  # no points
        ({}, {"points": torch.full((9, 4), float("nan"))}, True),
        ({}, {"points": torch.full((9, 4), 1e30)}, True),
        ({}, {"points": torch.tensor([[0.9, 0, 2.2, 1.0]]).repeat(9, 1)}, True),  # ranges of zero
        ({}, {"points": torch.zeros(9, 4)}, True),  # missing returns as zeros, in the own car
        ({"range_m": (0.0, 1e-3)}, {}, True),
    ],
)
@pytest.mark.filterwarnings("ignore:points. rows with NaN")
def test_extremes(sample: dict[str, Any], lidar: dict[str, Any], more: dict[str, Any], is_empty: bool) -> None:
    scanner = replace(TOP, **lidar)
    out = RigRetarget(target(lidars=[scanner]), geometry="street")(sample | more)
    points, rings = out["points"], out["point_rings"]
    assert points.shape == (len(rings), 4) and points.dtype == torch.float32 and torch.isfinite(points).all()
    assert (len(points) == 0) == is_empty and rings.max() < scanner.shape[0] if len(rings) else is_empty
    assert out["num_points"].sum() <= len(points)


REFUSED: list[tuple[Any, dict[str, Any], str]] = [  # points, other arguments, and what is said of them
    (torch.ones((5, 4), dtype=torch.int32), {}, "points: expected a float tensor or array to scan, got torch"),
    ([[1.0, 2.0, 3.0]], {}, "got list"),
    (torch.ones((5, 2)), {}, "points: expected shape"),
    (WALL, {"ground_z_m": "x"}, "ground_z_m: expected a tensor of numbers, got str"),
    (WALL, {"ground_z_m": [0.0, 1.0]}, r"ground_z_m: expected one height, got shape \(2,\)"),
    (WALL, {"sweeps": [np.zeros((5, 3))]}, r"sweeps\[0\]: expected the columns of points .*, got \(5, 3\)"),
    (WALL, {"sweeps": np.array(3.0)}, "sweeps: expected a list of points"),
    (WALL, {"sweeps": [np.array(3.0)]}, r"sweeps\[0\]: expected the columns of points"),
    (WALL, {"sweeps": 3}, r"sweeps: expected a list of points \(Q, C\), got int"),
    (WALL, {"target": "lyft_l5"}, "rig 'lyft_l5': expected lidars, which measure the points, got none"),
    (WALL, {"target": target(lidars=[TOP.shifted(z_m=-3)])}, "lidar 'top': expected a place over the road"),
]


@pytest.mark.parametrize(("points", "arguments", "message"), REFUSED)
def test_what_is_refused(points: Any, arguments: dict[str, Any], message: str) -> None:
    with pytest.raises((SampleError, SampleTypeError, CalibrationError), match=message):
        retarget_points(points, **({"target": target()} | arguments))
