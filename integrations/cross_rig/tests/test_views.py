"""Views that the variants make of A's frames."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.temporal.motion_depth import MotionDepth
from integrations.cross_rig import views
from integrations.cross_rig.augmentation import SCALE, scaled_and_cropped
from integrations.cross_rig.frames import NEIGHBOURS, Source, _Later, _TrueFrames, _VariantFrames, box_store
from integrations.cross_rig.settings import Settings
from integrations.cross_rig.variants import VARIANTS
from integrations.cross_rig.views import ViewMaker
from integrations.cross_rig.worlds import CHANGES, SPLITS, source_rig, street_seed

SIZE = (24, 64)


@pytest.fixture(scope="module")
def frame() -> dict:
    drive = SyntheticDrive(source_rig(SIZE), num_frames=1, seed=9, neighbours=NEIGHBOURS)
    true, sample = drive.render(0), drive[0]
    return {
        **{key: sample[key] for key in ("neighbours", "ego2world", "time_s")},
        "images": true.images,
        "depth_m": torch.where(torch.isfinite(true.depth_m), true.depth_m, 0),
        "learned_depth_m": torch.where(torch.isfinite(true.depth_m), true.depth_m, 0),
        "points": drive.points(0),
        "boxes_3d": torch.from_numpy(drive.scene(0).boxes_ego(0.0)).float(),
    }


@pytest.mark.parametrize("name", [name for name, variant in VARIANTS.items() if variant.renders])
@pytest.mark.filterwarnings("ignore")
def test_every_arm_renders(frame, name):
    source, target = source_rig(SIZE), CHANGES["waymo"].target(SIZE)
    target = target if VARIANTS[name].knows_target else source
    views = ViewMaker(VARIANTS[name], source, target)(0, frame)
    coverage = np.unpackbits(views["coverage"], axis=-1, count=SIZE[1]).astype(bool)
    assert views["images"].shape == (len(target), 3, *SIZE) and views["images"].dtype == np.uint8
    assert coverage.shape == (len(target), *SIZE) and coverage.mean() > 0.4
    assert ("visible" in views) == (VARIANTS[name].labels == "views")
    uncovered = views["images"].transpose(0, 2, 3, 1)[~coverage]
    assert uncovered.all(-1).mean() > 0.5 if VARIANTS[name].holes == "fill" else not uncovered.any()
    if VARIANTS[name].random:
        assert not np.allclose(views["K"], target.K)
        again = ViewMaker(VARIANTS[name], source, target)(0, frame)
        np.testing.assert_array_equal(again["images"], views["images"])
    else:
        np.testing.assert_allclose(views["K"], target.K, rtol=1e-6)
        np.testing.assert_allclose(views["cam2ego"], target.cam2ego, atol=1e-6)


def test_motion_and_learned_depth_are_both_used(frame, monkeypatch):
    """Views change without the one or the other. At this size little matches: motion is what is said here."""
    left = (np.arange(SIZE[1]) < SIZE[1] // 2) * np.ones(SIZE, np.float32)
    maps = [[depth_m * left] * 6 for depth_m in (5.0, 0.0, 5.0)]
    unknown = frame | {"learned_depth_m": torch.zeros_like(frame["learned_depth_m"])}
    asked = []
    monkeypatch.setattr(
        views, "motion_depth", lambda *given: asked.append(given) or MotionDepth(maps[len(asked) - 1], "")
    )
    render = ViewMaker(VARIANTS["motion_learned"], source_rig(SIZE), CHANGES["up70"].target(SIZE))
    both, learned, motion = (render(0, given)["images"] for given in (frame, frame, unknown))
    assert (both != learned).mean() > 0.05 < (both != motion).mean()
    (_, images, neighbours, boxes, _) = asked[0]
    assert len(images) == 6 and len(neighbours) == 2 and boxes is None


def test_learned_depth_has_the_size_of_the_depth_commands(tmp_path, monkeypatch):
    size, variant = (64, 704), replace(VARIANTS["motion_learned"], reads=("learned_depth_m",))
    source = Source(root=tmp_path, size=size, split="train", change="up70", variant=variant)
    frames, given = _VariantFrames(source), []
    stored = {"images": np.zeros((6, 3, *size), np.uint8), "depth_m": np.full((6, *size), 8, np.float16)}
    monkeypatch.setattr(frames, "store", SimpleNamespace(read=lambda _, key: stored[key]))
    monkeypatch.setattr(frames, "views", lambda _, frame: given.append(frame) or {})
    frames(3)
    depth = given[0]["learned_depth_m"]
    assert depth.shape == (6, 32, 352) and 0.02 < float((8 / depth).std()) < 0.08


@pytest.mark.slow
def test_variants_are_given_the_frames_before_and_after(tmp_path, frame):
    source = Source(root=tmp_path, size=SIZE, split="train", change="up70", variant=VARIANTS["auto_neighbours"])
    given = _VariantFrames(source)._neighbours(3)
    drive = SyntheticDrive(
        source_rig(SIZE), num_frames=4, seed=street_seed("train"), lidar=False, neighbours=NEIGHBOURS
    )
    expected = drive[3]
    assert torch.equal(given["ego2world"], expected["ego2world"]) and len(given["neighbours"]) == 2
    for one, two in zip(given["neighbours"], expected["neighbours"], strict=True):
        for key in ("images", "ego2world", "boxes_3d"):
            assert torch.equal(one[key], two[key])
        assert one["time_s"] == two["time_s"]
    motion = replace(source, variant=VARIANTS["motion"])
    assert all("boxes_3d" not in one for one in _VariantFrames(motion)._neighbours(3)["neighbours"])


@pytest.mark.parametrize("change", ["up70", "waymo"])
def test_what_auto_picks_where_cameras_move(frame, change):
    """LiDAR with boxes."""
    source, target = source_rig(SIZE), CHANGES[change].target(SIZE)
    picked, asked = (
        ViewMaker(replace(VARIANTS["auto"], surface=surface), source, target)(0, frame) for surface in ("auto", "lidar")
    )
    for key in ("images", "coverage", "cam2ego"):
        np.testing.assert_array_equal(picked[key], asked[key])


def test_scaled_and_cropped_keeps_pixels_and_calibration_together():
    rng = np.random.default_rng(0)
    K = source_rig((48, 64)).K[:1].astype(np.float32)
    scales = []
    for _ in range(20):
        image = np.zeros((1, 3, 48, 64), np.uint8)
        row, column = int(rng.integers(16, 32)), int(rng.integers(22, 42))
        image[0, :, row - 1 : row + 2, column - 1 : column + 2] = 255
        out, coverage, K2 = scaled_and_cropped(image, K, rng)
        moved = K2[0] @ np.linalg.inv(K[0]) @ (column, row, 1)
        scales.append(K2[0, 0, 0] / K[0, 0, 0])
        if not (2 < moved[0] < 61 and 2 < moved[1] < 45):
            continue
        weight = out[0, 0].astype(float)
        v, u = np.indices(weight.shape)
        centre = (weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()
        np.testing.assert_allclose(centre, moved[:2], atol=0.1)
        # A smaller picture leaves a border that nobody saw; a larger one fills the window.
        assert coverage.mean() == pytest.approx(min(1, scales[-1] ** 2), abs=0.05)
    assert SCALE[0] <= min(scales) < 0.9 and 1.15 < max(scales) <= SCALE[1]


def test_streets_are_disjoint_and_rigs_stand_on_one_road():
    assert len({street_seed(split, streets) for split in SPLITS for streets in (100, 200)}) == 6
    for change in CHANGES.values():
        rig = change.target((96, 256))
        assert rig.ground_z_m == 0 and set(rig.sizes) == {(96, 256)}
    heights = {name: float(np.median(change.target(SIZE).cam2ego[:, 2, 3])) for name, change in CHANGES.items()}
    assert heights == pytest.approx(
        {"fov50": 1.5, "up70": 2.2, "up35": 1.85, "down35": 1.15, "waymo": 2.1, "av2": 1.73}
        | dict.fromkeys(("fov80", "turned", "pitched", "aside60", "fisheye"), 1.5),
        abs=0.02,
    )
    assert CHANGES["fov50"].target(SIZE)[0].fov_deg[0] == pytest.approx(50)
    assert CHANGES["pitched"].target(SIZE)[0].elevation_deg == pytest.approx(-5)


def test_two_wheelers_are_clutter_in_the_same_streets(tmp_path):
    """Frames of their own, with the same vehicles, and labels that differ in what is seen alone."""
    plain = Source(root=tmp_path, size=SIZE, split="train", change="up70", variant=VARIANTS["auto_neighbours"])
    joined = replace(plain, two_wheelers=True)
    a, b = (source.original().store().spec for source in (plain, joined))
    assert a | {"two_wheelers": True} == b != a
    assert box_store(plain).key == box_store(joined).key
    assert all(source.two_wheelers for source in (*joined.needs(), joined.rendered()))
    a, b = (_TrueFrames(source.original())(5) for source in (plain, joined))
    assert 0.001 < (a["images"] != b["images"]).mean() < 0.3
    np.testing.assert_array_equal(a["state"] > 0, b["state"] > 0)
    np.testing.assert_array_equal(a["height_dm"], b["height_dm"])
    frames = _VariantFrames(joined)
    boxes = frames._neighbours(5)["neighbours"][0]["boxes_3d"]
    assert len(boxes) == len(_Later(frames.drive, 0.1).scene(5).boxes) > len(plain.drive(plain.rig).scene(5).boxes)


def test_unknown_names_are_refused():
    with pytest.raises(ValueError, match=r"variants: expected some of raw, .*, got nothing"):
        Settings(variants=("nothing",))
    with pytest.raises(ValueError, match=r"changes: expected some of fov50, .*, got up7"):
        Settings(changes=("up7",))
