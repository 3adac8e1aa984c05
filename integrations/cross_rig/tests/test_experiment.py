"""A whole run, tiny: killed, it continues, and ends with the numbers of an uninterrupted one."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from integrations.cross_rig import __main__ as command
from integrations.cross_rig import experiment, frames
from integrations.cross_rig.experiment import Run, Settings, jobs, quick, run, small
from integrations.cross_rig.frames import FrameStore
from integrations.cross_rig.report import summary, write_report
from integrations.cross_rig.training import Schedule

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
    train, trained = experiment.train, []

    def dying(draws, schedule, seed):
        if len(trained) == 2:
            raise KeyboardInterrupt
        trained.append(draws.raw is not None)
        return train(draws, schedule, seed)

    monkeypatch.setattr(experiment, "train", dying)
    with pytest.raises(KeyboardInterrupt):
        list(run(killed, 1, lambda line: None))
    assert [job.variant.name for job in killed.missing()] == ["auto_fill_mixed", "oracle"]
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


def test_tables_of_the_page_are_the_reports():
    page = (Path(__file__).parents[3] / "docs" / "benchmarks.md").read_text()
    tables = dict(re.findall(r"<!-- cross_rig: (\w+) -->\n(.*?)<!-- /cross_rig -->", page, re.DOTALL))
    results = (Path(__file__).parents[1] / "results").glob("*.json")
    assert tables == {path.stem: summary(json.loads(path.read_text())) for path in results} != {}


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
