"""Other frames of a nuScenes scene: which, where their cameras were, what stood where, and what of them is lost."""

from __future__ import annotations

import pickle
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget, SampleKeys
from arbiview_aug.datasets import Neighbours, NuScenesDataset
from arbiview_aug.datasets.synthetic import demo_source_rig
from tests.datasets.nuscenes_root import CHANNELS, Tables, recorded, seconds, streets, tables_of, write_root

SIZE = (40, 112)
RIG = demo_source_rig(SIZE)
SPEED_MPS = 8.0
STANDS_S = (0.6, 1.7)


def stops(time_s: float) -> float:
    """8 m/s, but for a second at a light."""
    return SPEED_MPS * (time_s - np.clip(time_s - STANDS_S[0], 0, STANDS_S[1] - STANDS_S[0]))


SCENES = streets(5, stops=stops, goes=lambda time_s: SPEED_MPS * time_s)
STOPS, GOES = SCENES
EVERY = Neighbours(count=3, step_m=1.2)


def write(root: Path, change: Callable[[Tables], None] | None = None) -> Path:
    data = tables_of(RIG, SCENES)
    if change:
        change(data)
    return write_root(root, data, SIZE)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("nuscenes"))


@pytest.fixture(scope="module")
def dataset(root: Path) -> NuScenesDataset:
    return NuScenesDataset(root, neighbours=EVERY)


def since(neighbour: Any) -> float:
    return seconds(round(1e6 * neighbour["time_s"]))


def ahead_m(sample: dict[str, Any]) -> list[float]:
    """How far ahead each neighbour is."""
    here = sample["ego2world"].numpy()
    return [np.linalg.solve(here, n["ego2world"].numpy())[0, 3] for n in sample["neighbours"]]


# --- which ------------------------------------------------------------------------------------------------------------
def test_neighbours_are_a_step_of_travel_apart(dataset: NuScenesDataset) -> None:
    """Every 0.05 or 0.1 s there is a frame, so at 8 m/s they are 1.2 to 2 m apart; a keyframe's time is the LiDAR's."""
    sample = dataset.by_token("goes-sample-2")
    past, future = np.array(ahead_m(sample)).reshape(2, 3)
    for m in (-past, future):
        assert (m[0] >= 0.9) and (m <= 1.2 * np.arange(1, 4) + 0.4 + 0.8).all() and (np.diff(m) >= 0.4 - 1e-6).all()
    tokens = [n["token"] for n in sample["neighbours"]]
    assert all("goes" in t for t in tokens) and len(set(tokens)) == 6
    everything = NuScenesDataset(dataset.root, neighbours=Neighbours(count=9, step_m=1.2)).by_token("goes-sample-2")
    kinds = {"sweeps" not in n["token"] for n in everything["neighbours"]}
    assert kinds == {True, False}


def test_a_scene_ends_where_it_ends(dataset: NuScenesDataset) -> None:
    """Both scenes are at the same times and places."""
    for token, expected in (("goes-sample-0", [0, 3]), ("goes-sample-4", [3, 0]), ("stops-sample-4", [3, 0])):
        sample = dataset.by_token(token)
        m = ahead_m(sample)
        assert [sum(x < 0 for x in m), sum(x > 0 for x in m)] == expected
        assert all(token.partition("-")[0] in n["token"] for n in sample["neighbours"])


# --- where ------------------------------------------------------------------------------------------------------------
def exposures_us(neighbour: Any) -> list[int]:
    """When the files of its images were recorded."""
    return [int(Path(name).stem.rpartition("_")[2]) for _, name, _ in neighbour._loads["images"].args[0]]


def test_convention_each_camera_is_where_it_recorded(root: Path) -> None:
    """Cameras expose one after the other, 35 ms apart every 50 ms: each gives the exposure of the same turn, though
    another one's may lie nearer in time, and has the pose of its own moment."""
    channels = (CHANNELS[3], CHANNELS[0])
    for names, apart_s in ((CHANNELS, [0, -0.008, 0.008, 0.033, 0.017, 0.025]), (channels, [0, -0.033])):
        dataset = NuScenesDataset(root, neighbours=EVERY, channels=names)
        rig = RIG.with_cameras([RIG[CHANNELS.index(name)] for name in names])
        for token in ("goes-sample-1", "stops-sample-3"):
            street = next(street for street in SCENES if token.startswith(street.name))
            for neighbour in dataset.by_token(token)["neighbours"]:
                assert tuple(neighbour["rig"].names) == names
                here = neighbour["ego2world"].numpy()
                np.testing.assert_allclose(here, street.ego2world(since(neighbour)), atol=1e-6)
                times_us = exposures_us(neighbour)
                np.testing.assert_allclose(1e-6 * (np.array(times_us) - times_us[0]), apart_s, atol=1e-9)
                assert abs(1e-6 * times_us[0] - neighbour["time_s"]) < 0.1
                for camera, mounted, time_us in zip(neighbour["rig"], rig, times_us, strict=True):
                    world = street.ego2world(seconds(time_us)) @ mounted.cam2ego
                    np.testing.assert_allclose(here @ camera.cam2ego, world, atol=1e-6)


def test_points_are_of_the_turn_nearest_in_time(dataset: NuScenesDataset) -> None:
    """Each file's one point, in the ego frame of the neighbour's own time; keyframes have the LiDAR's."""
    sweeps = 0
    for neighbour in dataset.by_token("goes-sample-2")["neighbours"]:
        time_s = since(neighbour)
        turns = {row["timestamp"] for row in recorded(GOES, "LIDAR_TOP", "lidar", (0, 0))}
        turn_s = min(map(seconds, turns), key=lambda moment: abs(moment - time_s))
        then2now = np.linalg.solve(GOES.ego2world(time_s), GOES.ego2world(turn_s))
        np.testing.assert_allclose(neighbour["points"][:, :3], [(then2now @ [5.0, 1.0, -0.5, 1.0])[:3]], atol=1e-3)
        sweeps += turn_s != time_s
    assert sweeps > 3


# --- what stood where -------------------------------------------------------------------------------------------------
def test_velocities_are_those_of_the_traffic(dataset: NuScenesDataset) -> None:
    for street in SCENES:
        sample = dataset.by_token(f"{street.name}-sample-2")
        velocities = sample["boxes_3d"][:, 7:].numpy() @ street.scene.ego2street[:2, :2].T
        rows = [int(token.split("-")[1]) for token in sample["box_tokens"]]
        np.testing.assert_allclose(velocities, street.scene.velocities[rows], atol=1e-4)
        assert np.abs(velocities).max() > 3


def test_velocities_that_nobody_knows(tmp_path: Path) -> None:
    """nuscenes-devkit's rule: over both neighbours in time up to 3 s, over one up to 1.5 s."""

    def lose(data: Tables) -> None:  # of even boxes all but the first and the last keyframe, 2 s apart
        lost = [f"goes-{b}-{k}" for b in range(0, 99, 2) for k in (1, 2, 3)]
        lost += [f"goes-{b}-{k}" for b in range(1, 99, 2) for k in (1, 3)]  # of odd ones every other
        data["sample_annotation"] = [row for row in data["sample_annotation"] if row["token"] not in lost]

    dataset = NuScenesDataset(write(tmp_path, lose))
    for k in (0, 2, 4):
        sample = dataset.by_token(f"goes-sample-{k}")
        is_odd = [int(token.split("-")[1]) % 2 for token in sample["box_tokens"]]
        assert sample["boxes_3d"][:, 7].isfinite().tolist() == is_odd and (k == 2 or 0 in is_odd)


def test_boxes_are_where_things_were(dataset: NuScenesDataset) -> None:
    """Between keyframes too, since the traffic goes straight on."""
    sweeps = 0
    for street in SCENES:
        for k in range(street.keyframes):
            for neighbour in dataset.by_token(f"{street.name}-sample-{k}")["neighbours"]:
                moment = seconds(round(1e6 * neighbour["time_s"]))
                expected, boxes = street.at(moment).boxes_ego(0.0), neighbour["boxes_3d"].numpy()
                order = [int(np.linalg.norm(boxes[:, :2] - box[:2], axis=1).argmin()) for box in expected]
                assert sorted(order) == list(range(len(expected)))
                np.testing.assert_allclose(boxes[order][:, :6], expected[:, :6], atol=2e-3)
                off = boxes[order][:, 6] - expected[:, 6]
                np.testing.assert_allclose(np.sin(off), 0, atol=1e-3)
                sweeps += "sweeps" in neighbour["token"]
    assert sweeps > 20


def test_what_one_keyframe_alone_has_moves_by_its_velocity(tmp_path: Path) -> None:
    """Boxes that are labelled up to 1.0 s, or from 1.5 s on."""

    def lose(data: Tables) -> None:
        early = [f"goes-{b}-{k}" for b in range(0, 99, 2) for k in (3, 4)]
        late = [f"goes-{b}-{k}" for b in range(1, 99, 2) for k in (0, 1, 2)]
        data["sample_annotation"] = [row for row in data["sample_annotation"] if row["token"] not in {*early, *late}]

    dataset = NuScenesDataset(write(tmp_path, lose), neighbours=EVERY)
    between = [n for n in dataset.by_token("goes-sample-2")["neighbours"] if 1.05 < since(n) < 1.45]
    assert between
    for neighbour in between:
        expected, centres = GOES.at(since(neighbour)).boxes_ego(0.0)[:, :2], neighbour["boxes_3d"][:, :2]
        assert len(centres) == len(expected)
        assert (np.linalg.norm(centres.numpy()[:, None] - expected, axis=-1).min(0) < 2e-3).all()


# --- what is lost -----------------------------------------------------------------------------------------------------
def test_sweeps_that_were_never_copied(root: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(root, copy, ignore=shutil.ignore_patterns("sweeps"))
    with pytest.warns(UserWarning, match="sweeps/CAM_FRONT: found no sweeps: only keyframes are neighbours") as said:
        dataset = NuScenesDataset(copy, neighbours=Neighbours(count=2, step_m=4.0))
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sample = dataset.by_token("goes-sample-2")
        out = RigRetarget(sample["rig"].turned(pitch_deg=-12), keys=SampleKeys(extra=("source_frame",)))(sample)
    assert [n["token"] for n in sample["neighbours"]] == [f"goes-sample-{k}" for k in (1, 0, 3, 4)]
    assert (out["source_frame"] > 0).any()
    shutil.rmtree(copy)
    shutil.copytree(root, copy, ignore=lambda folder, _: ["LIDAR_TOP"] if folder.endswith("sweeps") else [])
    with pytest.warns(UserWarning, match="sweeps/LIDAR_TOP: found no sweeps: only keyframes have points"):
        dataset = NuScenesDataset(copy, neighbours=EVERY)
    has_points = {
        "sweeps" not in n["token"]: "points" in set(n) for n in dataset.by_token("goes-sample-2")["neighbours"]
    }
    assert has_points == {True: True, False: False}


def rows_of(data: Tables, channel: str) -> list[dict[str, Any]]:
    rows = [row for row in data["sample_data"] if row["token"].startswith(f"goes-{channel}-")]
    return sorted(rows, key=lambda row: row["timestamp"])


def test_a_camera_that_lost_images(tmp_path: Path) -> None:
    """Half a second of one camera: what has no image of it is named and left out."""

    def lose(data: Tables) -> None:
        lost = [row["token"] for row in rows_of(data, "CAM_BACK") if not row["is_key_frame"]]
        data["sample_data"] = [row for row in data["sample_data"] if row["token"] not in lost]

    dataset = NuScenesDataset(write(tmp_path, lose), neighbours=Neighbours())
    sample = dataset.by_token("goes-sample-2")
    with pytest.warns(UserWarning, match=r"neighbour 'sweeps/CAM_FRONT/.*' is left out: .* CAM_BACK within 0.1 s"):
        RigRetarget(sample["rig"].turned(pitch_deg=-12))(sample)


@pytest.mark.parametrize("jump_us", [10_000_000, 1_030_000])
def test_nothing_is_a_neighbour_across_a_clock_that_goes_back(tmp_path: Path, jump_us: int) -> None:
    """From the keyframe at 1.0 s on, times are earlier than those before, or among them."""

    def change(data: Tables) -> None:
        data["sample"][1:5] = data["sample"][4:0:-1]  # in any order
        for row in data["sample"]:
            scene, _, k = row["token"].rpartition("-")
            row["prev"] = f"{scene}-{int(k) - 1}" if int(k) else ""
        for row in data["sample_data"]:
            later = ("goes-sample-3", "goes-sample-4", *["goes-sample-2"] * row["is_key_frame"])
            row["timestamp"] -= jump_us * (row["sample_token"] in later)

    write(tmp_path, change)
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        dataset = NuScenesDataset(tmp_path, neighbours=Neighbours(count=9, step_m=1.2))
    (back,) = (str(w.message) for w in said)
    assert "the clock goes back from sample 'goes-sample-1' to 'goes-sample-2': they are no neighbours" in back
    there = {token: ahead_m(dataset.by_token(token)) for token in dataset.tokens}
    assert len(there["stops-sample-1"]) == 5  # of a scene whose clock does not
    for k in range(5):
        at_m = [0.5 * SPEED_MPS * k + m for m in there[f"goes-sample-{k}"]]
        assert all((m > 7.5) == (k >= 2) for m in at_m)
        assert len(at_m) > 2 or jump_us < 5_000_000


# --- all of it --------------------------------------------------------------------------------------------------------
def test_workers_get_the_same(dataset: NuScenesDataset) -> None:
    one, two = (of.by_token("goes-sample-1")["neighbours"] for of in (dataset, pickle.loads(pickle.dumps(dataset))))
    assert [n["token"] for n in one] == [n["token"] for n in two]
    assert torch.equal(one[0]["images"], two[0]["images"]) and one[0]["rig"] == two[0]["rig"]
    assert b"NuScenesDataset" not in pickle.dumps(dataset.by_token("goes-sample-1")["neighbours"])  # on the way here
