"""The protocol between two recorded data sets: made-up nuScenes roots of two vehicles, end to end."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.errors import DataError
from integrations.cross_rig import __main__ as command
from integrations.cross_rig import real
from integrations.cross_rig.experiment import REAL, Run, Settings, fitted, jobs, recorded
from integrations.cross_rig.frames import OF_TESTS
from integrations.cross_rig.labels import FREE, HIDDEN, VEHICLE
from integrations.cross_rig.training import Schedule
from tests.datasets.nuscenes_root import START_US, Street, streets, tables_of, write_root

SIZE = (24, 64)
SMALL = Settings(size=SIZE, train_frames=1000, schedule=Schedule(steps=2, batch=2, precision="fp32"))


def _root(path: Path, rig: Rig, drives: range) -> Path:
    """A root whose even boxes hold ten points each, the odd ones none; every category is a car."""
    scenes = streets(2, **{f"drive-{k}": (lambda time_s: 5 * time_s) for k in drives})
    data = tables_of(rig, scenes)
    data["category"][0]["name"] = "vehicle.car"
    write_root(path, data, rig.sizes[0])
    for street in scenes:
        _write_points(path, data, street)
    return path


def _write_points(path: Path, data: dict, street: Street) -> None:
    for row in data["sample_data"]:
        if row["filename"].endswith(".bin") and f"/{street.name}__" in row["filename"] and row["is_key_frame"]:
            scene = street.at((row["timestamp"] - START_US) / 1e6)
            points = np.repeat(scene.boxes_ego(0.0)[::2, :3], 10, axis=0)
            rows = np.concatenate([points, np.zeros((len(points), 2))], 1).astype(np.float32)
            rows.tofile(path / row["filename"])


@pytest.fixture(scope="module")
def roots(tmp_path_factory) -> tuple[str, str]:
    folder = tmp_path_factory.mktemp("roots")
    rig = demo_source_rig((48, 128))
    a = _root(folder / "A", rig, range(4, 6))
    return str(a), str(_root(folder / "B", rig.shifted(z_m=0.7), range(4)))


def run_of(a: str, b: str, output: Path) -> Run:
    return Run(settings=fitted(recorded(SMALL, a, b)), output=output)


@pytest.mark.slow
def test_frames_have_labels_where_the_lidar_saw_a_vehicle(roots, tmp_path):
    run = run_of(*roots, tmp_path)
    assert (run.settings.train_frames, run.settings.val_frames, run.settings.test_frames) == (4, 2, 2)
    source = run.source("train")
    make = source.maker()
    arrays = make(0)
    assert arrays["images"].shape == (6, 3, *SIZE) and arrays["images"].mean() == pytest.approx(90, abs=1)
    sample = real.recording(roots[0])[source.frames[0]]
    boxes, points = real.vehicles_of(sample, roots[0])
    assert len(boxes) == len(sample["boxes_3d"]) and set(points > 0) == {True, False}
    for box, inside in zip(boxes, points, strict=True):
        if np.abs(box[:2]).max() < 24:
            cell = ((box[:2] + 25) / 0.5).astype(int)
            assert arrays["state"][tuple(cell)] == (VEHICLE if inside else HIDDEN)
    assert (arrays["state"] == FREE).mean() > 0.8
    # Views have the other vehicle's cameras, over the same road.
    views = next(run.trained_on(job)[0] for job in jobs(run.settings) if job.variant.name == "auto_fill").maker()(0)
    true = run.source("test", REAL).maker()(0)
    np.testing.assert_allclose(views["K"], true["K"], rtol=1e-5)
    np.testing.assert_allclose(views["cam2ego"][:, 2, 3], true["cam2ego"][:, 2, 3], atol=0.02)
    np.testing.assert_allclose(views["cam2ego"][:, 2, 3] - arrays["cam2ego"][:, 2, 3], 0.7, atol=0.02)


def test_drives_are_split_and_drawn_together(roots, tmp_path, monkeypatch):
    run, names = run_of(*roots, tmp_path), real.drives_of(roots[1])
    splits = [{names[k] for k in real.frames_of(roots[1], split)} for split in ("train", "val", "test")]
    assert all(splits) and sum(map(len, splits)) == len(set(names)) == len(set.union(*splits))
    # A data set against itself: what tests is no less apart from what trains the oracle.
    itself = run_of(roots[1], roots[1], tmp_path)
    tested = {k for split in OF_TESTS for k in itself.source(split, REAL).frames}
    assert tested and not tested & set(itself.source("train", REAL).frames)
    drives = run.source("test", REAL).drives(run.settings.test_frames)
    assert len(drives) == run.settings.test_frames and len(set(drives)) == len(splits[2])
    monkeypatch.setattr(real, "drives_of", lambda data: names if data == roots[1] else [names[k] for k in tested])
    with pytest.raises(DataError, match="drives that are not of B's validation or test"):
        real.frames_of_a("a", roots[1])


@pytest.mark.slow
def test_the_command_runs_continues_and_reports(roots, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(command.PRESETS, "quick", lambda: SMALL)
    variants = ["--variants", "raw", "auto_fill", "auto_fill_mixed", "oracle"]
    given = ["--quick", "--real", *roots, *variants, "--workers", "1", "--output", str(tmp_path)]
    assert command.main(given) == 0
    out, err = capsys.readouterr()
    assert "| A to B; auto, filled holes, no mask | 4 |" in out and "4 of 4 trainings to do" in err
    assert list(json.loads((tmp_path / "report.json").read_text())["changes"][REAL]["variants"]) == variants[1:]
    assert command.main(given) == 0
    assert "0 of 4 trainings to do" in capsys.readouterr().err


def test_data_that_cannot_be_run_is_refused(roots, tmp_path, capsys):
    def said(*given: str) -> str:
        assert command.main(["--quick", "--output", str(tmp_path), *given]) == 2
        return capsys.readouterr().err

    for option in ("--world cuboids", "--changes up70"):
        assert "is for synthetic streets: leave it out with --real" in said("--real", *roots, *option.split())
    assert "expected 3 drives or more to split, found 2" in said("--real", roots[1], roots[0])
    assert "expected a folder, found none" in said("--real", roots[0], str(tmp_path / "nothing"))
    (tmp_path / "file").touch()
    assert "file: expected a folder that can be written to" in said("--output", str(tmp_path / "file"))
    with pytest.raises(DataError, match="sample t: expected boxes_3d and box_names"):
        real.vehicles_of({"token": "t", "boxes_3d": torch.zeros(0, 7)}, "X")


def test_vehicles_by_category():
    people = "human.pedestrian.construction_worker"
    names = ["vehicle.bus.rigid", "vehicle.bicycle", people, "SCHOOL_BUS", "Car", "bush"]
    sample = {"token": "t", "boxes_3d": torch.arange(6)[:, None] * torch.ones(6, 7), "box_names": names}
    boxes, points = real.vehicles_of(sample, "X")
    assert boxes[:, 0].tolist() == [0, 3, 4] and (points == real.LEAST_POINTS).all()
