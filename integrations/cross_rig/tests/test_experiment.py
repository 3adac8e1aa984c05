"""A whole run, tiny: killed, it continues, and ends with the numbers of an uninterrupted one; its views and streets."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug.datasets.synthetic import SceneClass, SyntheticDrive
from integrations.cross_rig import __main__ as command
from integrations.cross_rig import experiment, frames
from integrations.cross_rig.__main__ import summary, write_report
from integrations.cross_rig.cuboids import CuboidDrive, make_scene
from integrations.cross_rig.experiment import Run, Settings, jobs, quick, run, small
from integrations.cross_rig.frames import CHANGES, SPLITS, FrameStore, source_rig, street_seed
from integrations.cross_rig.training import Schedule
from integrations.cross_rig.variants import SCALE, VARIANTS, scaled_and_cropped, view_maker

TINY = Settings(
    size=(24, 64),
    train_frames=2,
    val_frames=1,
    test_frames=2,
    changes=("fov50",),
    variants=("raw", "scale_crop", "auto_fill_mixed", "oracle"),
    schedule=Schedule(steps=3, batch=2, precision="fp32"),
)


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Run:
    setup = Run(settings=TINY, output=tmp_path_factory.mktemp("cross_rig"))
    assert list(run(setup, 1, lambda line: None)) == [4, 3, 2, 1, 0]
    return setup


def test_frames_are_named_after_spec_and_code(tmp_path, monkeypatch):
    store = FrameStore(tmp_path, {"a": 1})
    store.write(1, {"images": np.full((2, 3), 7, np.uint8), "state": np.uint8(1)})
    assert store.missing(3) == [0, 2] and (store.read("images", 1) == 7).all()
    assert FrameStore(tmp_path, {"a": 2}).missing(2) == [0, 1]
    read, text = [], Path.read_text
    monkeypatch.setattr(Path, "read_text", lambda path: (read.append(path.name), text(path) + "# changed")[1])
    monkeypatch.setattr(frames, "code_hash", frames.code_hash.__wrapped__)
    assert FrameStore(tmp_path, {"a": 1}).missing(2) == [0, 1]
    assert {"rig_retarget.py", "kernels.py", "training.py"} <= set(read)


@pytest.mark.slow
def test_a_killed_run_continues_to_the_same_numbers(done, tmp_path, monkeypatch):
    shutil.copytree(done.output / "frames", tmp_path / "frames")
    (tmp_path / "frames" / done.source("test", "fov50").store().key / "00000.npz").unlink()
    killed = replace(done, output=tmp_path)
    train, trained = experiment.train, list[bool]()

    def dying(draws, schedule, seed):
        if len(trained) == 2:
            raise KeyboardInterrupt
        trained.append(draws.raw is not None)
        return train(draws, schedule, seed)

    monkeypatch.setattr(experiment, "train", dying)
    with pytest.raises(KeyboardInterrupt):
        list(run(killed, 1, lambda line: None))
    trained.clear()
    assert list(run(killed, 1, lambda line: None)) == [2, 1, 0]
    assert trained == [True, False] and not list(tmp_path.rglob(".*"))
    assert killed.results("voxels", "short") == done.results("voxels", "short")
    monkeypatch.setattr(experiment, "train", None)
    assert list(run(killed, 1, lambda line: None)) == [0]


@pytest.mark.slow
def test_families_and_schedules_have_tables_of_their_own(done):
    settings = replace(TINY, variants=("raw", "oracle"), families=("voxels", "depths", "queries"))
    more = replace(done, settings=replace(settings, schedules=("short", "long")))
    assert list(run(more, 1, lambda line: None)) == [*range(10, -1, -1)]
    report = write_report(more)
    assert json.loads((done.output / "report.json").read_text()) == json.loads(json.dumps(report))
    seen = {name: change["samples_seen"] for name, change in report["changes"].items()}
    names = ("fov50", "fov50-depths", "fov50-queries")
    assert seen == {f"{name}{length}": n for length, n in (("", 6), ("-long", 16)) for name in names}
    assert "| FOV 65° → 50°, queries, long; raw A | 16 |" in (done.output / "report.md").read_text()
    for change in report["changes"].values():
        assert list(change["variants"]) == ["raw", "oracle"]
        assert all(0 <= row["value"] <= 1 and 0 <= row["ap"]["value"] <= 1 for row in change["variants"].values())
    del report["changes"]["fov50"]["variants"]["oracle"]
    assert "FOV" in summary(report), "a run that is not done"


@pytest.mark.slow
def test_labels_and_draws_are_paired(done):
    """A's labels in B's cells; the same frames in the same order, whatever else a variant draws."""
    raw, _, mixed, oracle = sets = [done.draws(replace(job, seed=5)) for job in jobs(TINY)]
    np.testing.assert_array_equal(raw.frames.state, mixed.frames.state)
    assert raw.frames.counts.sum() > oracle.frames.counts.sum() == mixed.frames.counts.sum()
    first, second, *_ = (np.concatenate([draws.batch(1).state.numpy() for _ in range(20)]) for draws in sets[:2])
    np.testing.assert_array_equal(first, second)
    from_raw = [bool(np.isclose(mixed.batch(1).K[0, 0, 0], raw.frames.K[0, 0, 0, 0])) for _ in range(200)]
    assert 75 < sum(from_raw) < 125


def test_settings_of_the_command(tmp_path):
    assert len(jobs(quick())) == 2 * 3 and len({job.name for job in jobs(small())}) == 2 * 4
    given = ["--small", "--world", "cuboids", "--schedules", "short", "long", "--steps", "10"]
    setup = Run(settings=command.settings_of(command.parser().parse_args(given)), output=tmp_path)
    assert {source.world for source in setup.sources()} == {"cuboids"}
    assert {job.length: setup.schedule(job).steps for job in jobs(setup.settings)} == {"short": 10, "long": 26}
    raw, longer = jobs(setup.settings)[0], replace(setup, settings=replace(setup.settings, test_frames=1))
    assert longer.result_path(raw) != setup.result_path(raw)


@pytest.mark.release
@pytest.mark.timeout(1800)
def test_quick_oracle_is_above_raw(tmp_path: Path):
    assert command.main(["--quick", "--output", str(tmp_path)]) == 0
    changes = json.loads((tmp_path / "report.json").read_text())["changes"]
    assert set(changes) == {"up70", "up70-long"}
    for change in changes.values():
        assert set(change["variants"]) == {"raw", "auto_fill", "oracle"}
        assert change["variants"]["oracle"]["value"] > change["variants"]["raw"]["value"]


# --- views and streets ------------------------------------------------------------------------------------------------
SIZE = (24, 64)


@pytest.fixture(scope="module")
def sample() -> dict:
    drive = SyntheticDrive(source_rig(SIZE), num_frames=1, seed=9)
    boxes = torch.from_numpy(drive.scene(0).boxes_ego(0.0)).float()
    return {"images": drive.render(0).images, "points": drive.points(0), "boxes_3d": boxes}


@pytest.mark.parametrize("name", ["auto_fill", "street_fill", "objects_fill", "auto_fill_random", "random_a"])
@pytest.mark.filterwarnings("ignore")
def test_every_variant_renders(sample, name):
    source, target = source_rig(SIZE), CHANGES["waymo"].target(SIZE)
    target = target if VARIANTS[name].knows_target else source
    views, again = (view_maker(VARIANTS[name], source, target)(0, sample) for _ in range(2))
    assert views["images"].shape == (len(target), 3, *SIZE) and views["images"].dtype == np.uint8
    assert views["images"].any(1).mean() > 0.9, "holes are filled"
    np.testing.assert_array_equal(again["images"], views["images"])
    assert np.allclose(views["K"], target.K, rtol=1e-6) == (VARIANTS[name].random is None)
    assert np.allclose(views["cam2ego"], target.cam2ego, atol=1e-6) == (VARIANTS[name].random is None)


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
        if 2 < moved[0] < 61 and 2 < moved[1] < 45:
            weight = out[0, 0].astype(float)
            v, u = np.indices(weight.shape)
            centre = (weight * u).sum() / weight.sum(), (weight * v).sum() / weight.sum()
            np.testing.assert_allclose(centre, moved[:2], atol=0.1)
            # A smaller picture leaves a border that nobody saw; a larger one fills the window.
            assert coverage.mean() == pytest.approx(min(1, scales[-1] ** 2), abs=0.05)
    assert SCALE[0] <= min(scales) < 0.9 and 1.15 < max(scales) <= SCALE[1]


def test_streets_are_disjoint_and_rigs_are_on_one_road():
    assert len({street_seed(split, streets) for split in SPLITS for streets in (100, 200)}) == 6
    rigs = {name: change.target((96, 256)) for name, change in CHANGES.items()}
    assert all(rig.ground_z_m == 0 and set(rig.sizes) == {(96, 256)} for rig in rigs.values())
    heights = {name: float(np.median(rig.cam2ego[:, 2, 3])) for name, rig in rigs.items()}
    assert heights == pytest.approx({"fov50": 1.5, "up70": 2.2, "waymo": 2.1}, abs=0.02)
    assert rigs["fov50"][0].fov_deg[0] == pytest.approx(50)


def test_scenes_depend_on_seed_and_index_alone_and_objects_fill_their_boxes():
    scene = make_scene(3, 1)
    make_scene.cache_clear()
    np.testing.assert_array_equal(make_scene(3, 1).corners, scene.corners)
    assert not np.array_equal(make_scene(3, 2).boxes, scene.boxes)
    assert not np.array_equal(make_scene(4, 1).boxes, scene.boxes)
    for row, box in enumerate(scene.boxes):
        c, s = np.cos(box[6]), np.sin(box[6])
        local = (scene.corners[scene.instance == row].reshape(-1, 3) - box[:3]) @ [[c, -s, 0], [s, c, 0], [0, 0, 1]]
        np.testing.assert_allclose(np.abs(local[:, :2]).max(0), box[3:5] / 2, atol=0.03)
        np.testing.assert_allclose([local[:, 2].min(), local[:, 2].max()], [-box[5] / 2, box[5] / 2], atol=1e-6)


@pytest.mark.slow
def test_views_have_the_truth_of_this_world_in_other_colours():
    drive = CuboidDrive(source_rig((48, 128)), num_frames=20, seed=3, lidar=False)
    views = drive.render(0)
    assert {SceneClass.SKY, SceneClass.GROUND, SceneClass.VEHICLE} <= set(views.classes.unique().tolist())
    counts = [np.bincount(view.flatten() + 1, minlength=len(drive.scene(0).boxes) + 1)[1:] for view in views.instances]
    assert (np.max(counts, 0) > 8).sum() > 3
    assert torch.equal(torch.isinf(views.depth_m), views.classes == SceneClass.SKY)
    # The package's own renderer colours these scenes as its streets.
    plain = SyntheticDrive(drive.rig, num_frames=1, lidar=False)._renderer.render(drive.scene(0), drive.rig.cameras, 0)
    assert (plain[0][0] != views.images[0]).float().mean() > 0.8
    assert torch.equal(plain[0][1], views.depth_m[0])
