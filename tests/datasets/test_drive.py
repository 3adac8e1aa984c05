"""Which frames of a drive are neighbours, and that they are read late or, broken, not at all."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug import DataError, RandomRig, RigRetarget, SampleKeys
from arbiview_aug.datasets import FrameFolder, LazyFrame, Neighbours, NuScenesDataset
from arbiview_aug.datasets.drive import Drive, parts_of_clock
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from tests.helpers import write_drive

SIZE = (64, 176)


def test_frames_are_picked_by_distance() -> None:
    """It stood still between 3 and 4."""
    drive = Drive(np.array([0.0, 1.0, 2.5, 4.0, 4.0, 5.5, 7.0])[:, None] * [1, 0, 0], np.zeros(7, np.int64))
    for wanted, expected in (
        (Neighbours(), [2, 5]),
        (Neighbours(count=2), [2, 1, 5, 6]),
        (Neighbours(direction="past", count=5), [2, 1, 0]),
        (Neighbours(direction="future", step_m=2.5), [6]),
        (Neighbours(step_m=100.0), []),
    ):
        assert drive.neighbours(4, wanted) == expected


def test_settings_are_checked(tmp_path: Path) -> None:
    counts, steps = [{"count": value} for value in (0, 1.5, True)], [{"step_m": v} for v in (0, np.nan, "1", True)]
    for bad in (*counts, *steps, {"direction": "up"}):
        with pytest.raises(ValueError, match="neighbours: "):
            Neighbours(**bad)
    assert Neighbours(count=np.int64(2), step_m=np.float32(1.5)).count == 2
    for reader in (FrameFolder, NuScenesDataset):
        with pytest.raises(TypeError, match="neighbours: expected Neighbours or None, got int"):
            reader(tmp_path, neighbours=2)


def test_standing_still_has_no_neighbours() -> None:
    """Though its poses waver: their steps alone would add up to 4 m."""
    positions_m = 0.005 * np.random.default_rng(0).standard_normal((500, 3))
    assert np.linalg.norm(np.diff(positions_m, axis=0), axis=1).sum() > 4
    drive = Drive(positions_m, np.zeros(500, np.int64))
    assert drive.neighbours(250, Neighbours()) == []


def test_nothing_is_a_neighbour_across_a_clock_that_goes_back() -> None:
    times_s = dict(zip("abcdef", [0.0, 1.0, 2.0, 0.5, 1.5, 2.5], strict=True))
    with pytest.warns(UserWarning, match="here: the clock goes back from frame 'c' to 'd'"):
        parts = parts_of_clock("abcdef", times_s, "here")
    drive, wanted = Drive(np.arange(6.0)[:, None] * [1, 0, 0], parts), Neighbours(step_m=1.0, count=9)
    assert drive.neighbours(2, wanted) == [1, 0] and drive.neighbours(4, wanted) == [3, 5]


def test_a_lazy_frame_decodes_once_and_only_when_asked() -> None:
    calls = []
    frame = LazyFrame({"token": "a"}, lambda: calls.append(1) or "pixels", lambda: calls.append(2) or "points")
    assert frame["token"] == "a" and set(frame) == {"token", "images", "points"} and len(frame) == 3
    assert "images" in frame and "token" in frame and "depth" not in frame and not calls
    assert frame["images"] == "pixels" == frame["images"] and calls == [1]
    assert frame.get("points") == "points" == frame["points"] and calls == [1, 2]
    assert "points" not in set(bare := LazyFrame({}, list)) and bare.get("points") is None


# --- a street that moves ----------------------------------------------------------------------------------------------
def test_a_synthetic_drive_moves_on() -> None:
    """The street has its road at 0 in the world, for every rig, and what stands is where it was."""
    rig = replace(demo_source_rig(SIZE), ground_z_m=-0.33)
    drive = SyntheticDrive(rig, num_frames=4, lidar=False, neighbours=Neighbours(count=2, step_m=1.5))
    sample = drive[1]
    here = sample["ego2world"].numpy()
    boxes = sample["boxes_3d"].numpy()[:, :3]
    assert np.allclose(boxes @ here[:3, :3].T + here[:3, 3], drive.scene(1).boxes[:, :3], atol=1e-4)
    assert sample["neighbours"][0]["ego2world"][2, 3] == here[2, 3]
    still, moved, travel_m = 0, 0, []
    for neighbour in sample["neighbours"]:
        ego2ego = np.linalg.solve(here, neighbour["ego2world"].numpy())
        travel_m.append(ego2ego[:3, 3])
        then = neighbour["boxes_3d"].numpy()[:, :3] @ ego2ego[:3, :3].T + ego2ego[:3, 3]
        off_m = np.linalg.norm(then - boxes, axis=1)
        still, moved = still + (off_m < 1e-3).sum(), moved + (off_m > 0.05).sum()
    assert np.allclose(travel_m, [[-1.5, 0, 0], [-3, 0, 0], [1.5, 0, 0], [3, 0, 0]], atol=1e-9)
    assert still > 10 and moved > 10 and "points" not in neighbour
    images = sample["neighbours"][0]["images"]
    assert images.shape == sample["images"].shape and not torch.equal(images, sample["images"])


def test_a_synthetic_drive_has_points_of_its_neighbours() -> None:
    """Walls are where they were; noise is drawn for each frame."""
    sample = SyntheticDrive(demo_source_rig(SIZE), num_frames=1, neighbours=Neighbours(direction="past"))[0]
    (before,) = sample["neighbours"]
    now = sample["points"].numpy()[:, :3]
    ego2ego = np.linalg.solve(sample["ego2world"].numpy(), before["ego2world"].numpy())
    then = before["points"].numpy()[:, :3] @ ego2ego[:3, :3].T + ego2ego[:3, 3]
    high, others = (one[(one[:, 2] > 2.5) & (np.hypot(*one.T[:2]) < 20)] for one in (now, then))
    apart_m = np.linalg.norm(high - others[::20, None], axis=-1).min(axis=1)
    assert len(apart_m) > 50 and np.median(apart_m) < 0.25 and apart_m.min() > 0


# --- frame folders ----------------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three frames of one street, 1.3 m apart, as folders."""
    root = tmp_path_factory.mktemp("drive")
    rig = demo_source_rig(SIZE)
    sample = SyntheticDrive(rig, num_frames=1, lidar=False, neighbours=Neighbours(step_m=1.3))[0]
    write_drive(root, [sample, *sample["neighbours"]])
    return root


def test_a_folder_without_a_drive_says_so(recorded: Path, tmp_path: Path) -> None:
    shutil.copytree(recorded / "0000", tmp_path / "0000")
    with pytest.warns(UserWarning, match=r"expected frames of a drive \(sequence.json and ego2world\), found none"):
        alone = FrameFolder(tmp_path, neighbours=Neighbours())[0]
    assert alone["neighbours"] == [] and "scene_token" not in alone
    sequence = FrameFolder(recorded)
    assert sequence[0]["scene_token"] == recorded.name
    random = RandomRig(sequence[0]["rig"], yaw_deg=3, per="sequence")
    assert random.draw_for(sequence[0]) == random.draw_for(sequence[2])


@pytest.mark.parametrize("broken", ["image", "corrupt", "calibration"])
def test_a_broken_neighbour_is_named_and_left_out(recorded: Path, tmp_path: Path, broken: str) -> None:
    root = tmp_path / "drive"
    shutil.copytree(recorded, root)
    victim = next((root / "0002").glob("*.png"), None) or next((root / "0002").glob("*.jpg"))
    if broken == "image":
        victim.unlink()
    elif broken == "corrupt":
        victim.write_bytes(victim.read_bytes()[:200])
    folder = FrameFolder(root, neighbours=Neighbours())
    if broken == "calibration":
        calib = json.loads((root / "0002" / "calib.json").read_text())
        calib["cameras"][0]["K"] = [[0, 0, 0]] * 3
        (root / "0002" / "calib.json").write_text(json.dumps(calib))
    sample, keys = folder[1], SampleKeys(extra=("source_frame",))
    retarget = RigRetarget(sample["rig"].turned(pitch_deg=-12), keys=keys)
    with pytest.warns(UserWarning, match="neighbour '0002' is left out: .*rendered without it"):
        out = retarget(sample)
    assert set(out["source_frame"].unique().tolist()) == {-1, 0, 1}


def test_a_wrong_sequence_is_refused(recorded: Path, tmp_path: Path) -> None:
    shutil.copytree(recorded, root := tmp_path / "drive")
    for text, why in (
        ("[]", "expected {'frames'"),
        ('{"frames": ["0000", "nowhere"]}', "got 'nowhere'"),
        ('{"frames": ["0000", "0000"]}', "each frame once"),
        ('{"frames": [{"name": "0000", "time_s": "soon"}]}', "ValueError"),
        ('{"frames": [{"name": "0000", "time_s": NaN}]}', "finite number"),
    ):
        (root / "sequence.json").write_text(text)
        with pytest.raises(DataError, match=rf"sequence\.json.*{why}"):
            FrameFolder(root)
