"""A whole run, tiny: it goes on after being killed, and ends with the numbers of an uninterrupted one."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from integrations.cross_rig import __main__ as command
from integrations.cross_rig import cache, experiment
from integrations.cross_rig.experiment import Run, load_results, run
from integrations.cross_rig.report import markdown, summary, write_report
from integrations.cross_rig.settings import Settings, jobs, quick, small
from integrations.cross_rig.training import Schedule

TINY = Settings(
    size=(24, 64),
    train_frames=2,
    val_frames=1,
    test_frames=2,
    seeds=(0,),
    changes=("fov50",),
    variants=("raw", "scale_crop", "objects_fill_mixed", "oracle"),
    schedule=Schedule(steps=3, batch=2, precision="fp32"),
)


@pytest.fixture(autouse=True)
def _short_chunks(monkeypatch):
    monkeypatch.setattr(cache, "CHUNK_FRAMES", 1)


@pytest.fixture(scope="module")
def done(tmp_path_factory) -> Run:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "CHUNK_FRAMES", 1)
        setup = Run(settings=TINY, output=tmp_path_factory.mktemp("cross_rig"))
        assert list(run(setup, 1, lambda line: None)) == [4, 3, 2, 1, 0]
    return setup


def counts(setup: Run) -> dict[str, list]:
    return {variant: by_seed[0]["by_distance"] for variant, by_seed in load_results(setup, "voxels")["fov50"].items()}


@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_numbers(done, tmp_path, monkeypatch):
    shutil.copytree(done.output / "frames", tmp_path / "frames")
    shutil.rmtree(tmp_path / "frames" / done.source("test", "fov50").store().key / "00000")
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
    assert [job.variant.name for job in killed.missing()] == ["objects_fill_mixed", "oracle"]
    trained.clear()
    assert list(run(killed, 1, lambda line: None)) == [2, 1, 0]
    assert trained == [True, False]
    assert counts(killed) == counts(done)
    assert not list(tmp_path.rglob(".*"))


@pytest.mark.slow
def test_what_is_done_is_not_done_again(done, monkeypatch):
    monkeypatch.setattr(experiment, "train", None)
    assert list(run(done, 1, lambda line: None)) == [0]
    # Other test streets: the weights are there.
    more = replace(done, settings=replace(TINY, test_frames=1, variants=("raw",)))
    assert list(run(more, 1, lambda line: None)) == [1, 0]


@pytest.mark.slow
def test_variants_with_the_same_frames_are_one_training(done):
    """Every surface is the same when the centres stay: only the first one is trained."""
    more = replace(done, settings=replace(TINY, variants=("raw", "street_fill", "objects_fill", "oracle")))
    assert list(run(more, 1, lambda line: None)) == [1, 0]
    results = load_results(more, "voxels")["fov50"]
    assert set(results) == {"raw", "street_fill", "objects_fill", "oracle"}
    assert results["street_fill"] == results["objects_fill"]
    report = write_report(more)
    assert report["changes"]["fov50"]["same_frames"] == {"objects_fill": "street_fill"}
    assert "| objects, filled holes, no mask (the frames of street, filled holes, no mask) |" in markdown(report)


@pytest.mark.slow
def test_variants_without_a_mask_lift_every_pixel(tmp_path):
    """Black holes: the pixels of the masked variant. Filled holes: what was seen is the same bit for bit."""
    settings = replace(TINY, changes=("up70",), variants=("auto", "auto_black", "auto_fill"))
    more = Run(settings=settings, output=tmp_path)
    assert list(run(more, 1, lambda line: None)) == [3, 2, 1, 0]
    masked, black, filled = jobs(more.settings)
    assert more.images(black).store().key == more.images(masked).store().key != more.images(filled).store().key
    frames = [more.training_set(job).frame(1) for job in (masked, black, filled)]
    seen = np.broadcast_to(frames[0].coverage[:, None], frames[0].images.shape)
    assert 0.05 < 1 - seen.mean() < 0.95
    assert frames[1].coverage.all() and frames[2].coverage.all()
    np.testing.assert_array_equal(frames[1].images, frames[0].images)
    assert not frames[1].images[~seen].any()
    np.testing.assert_array_equal(frames[2].images[seen], frames[0].images[seen])
    assert (frames[2].images[~seen] > 0).mean() > 0.5


@pytest.mark.slow
def test_report(done):
    report = write_report(done)
    assert json.loads((done.output / "report.json").read_text()) == json.loads(json.dumps(report))
    assert (done.output / "report.png").stat().st_size > 1000
    assert report["tests_done"] == report["tests"] == 4
    rows = report["changes"]["fov50"]["variants"]
    assert list(rows) == list(TINY.variants)
    for name, row in rows.items():
        assert (row["loading_cpu_s"] > 0) == (name in ("scale_crop", "objects_fill_mixed"))
        assert 0 <= row["iou"]["low"] <= row["iou"]["value"] <= row["iou"]["high"] <= 1
        assert 0 <= row["ap"]["value"]["value"] <= 1
    assert "| objects, filled holes, no mask, + raw |" in markdown(report)


@pytest.mark.slow
def test_families_have_tables_of_their_own(done):
    more = replace(done, settings=replace(TINY, variants=("raw", "oracle"), families=("depths", "queries", "voxels")))
    assert list(run(more, 1, lambda line: None)) == [4, 3, 2, 1, 0]
    report = write_report(more)
    assert set(report["changes"]) == {"fov50", "fov50-depths", "fov50-queries"} and report["tests_done"] == 6
    assert "**FOV 65° → 50°, queries**, 6 samples seen, seeds 0" in markdown(report)
    losses = [more.trained(job)[1]["losses"][-1] for job in jobs(more.settings) if job.variant.name == "raw"]
    assert len(set(losses)) == 3


@pytest.mark.slow
def test_schedules_have_tables_of_their_own_that_say_how_many_samples_were_seen(done):
    """The short one is trained already; frames are the same."""
    more = replace(done, settings=replace(TINY, variants=("raw", "oracle"), schedules=("short", "long")))
    assert list(run(more, 1, lambda line: None)) == [2, 1, 0]
    report = write_report(more)
    assert {name: change["samples_seen"] for name, change in report["changes"].items()} == {
        "fov50": 3 * 2,
        "fov50-long": 8 * 2,
    }
    assert report["tests_done"] == report["tests"] == 4
    text, short = markdown(report), summary(report)
    assert "**FOV 65° → 50°**, 6 samples seen, seeds 0" in text
    assert "**FOV 65° → 50°, long**, 16 samples seen, seeds 0" in text
    assert "samples seen" in short.splitlines()[0]
    alone = {**report, "changes": {"fov50-long": report["changes"]["fov50-long"]}}
    assert [row.split(" | ")[1] for row in summary(alone).splitlines()[2:]] == ["16", "16"]


@pytest.mark.slow
def test_labels_are_the_sources_within_the_targets_cells(done):
    raw, _, mixed, oracle = (done.training_set(job) for job in jobs(TINY))
    np.testing.assert_array_equal(raw.state, mixed.state)
    np.testing.assert_array_equal(mixed.counts, oracle.counts)
    assert raw.counts.sum() > oracle.counts.sum()


@pytest.mark.slow
def test_variants_are_paired(done):
    """The same frames in the same order, whatever else a variant draws."""
    first = []
    for job in jobs(TINY):
        draws = done.draws(replace(job, seed=5))
        first.append(np.concatenate([draws.batch(1).state.numpy() for _ in range(20)]))
    np.testing.assert_array_equal(first[0], first[1])
    np.testing.assert_array_equal(first[0], first[2])


@pytest.mark.slow
def test_mixed_variants_draw_raw_frames_half_of_the_time(done):
    job = next(job for job in jobs(TINY) if job.variant.mixed)
    draws, raw_rig = done.draws(job), done.source("train").rig
    from_raw = [bool(np.isclose(draws.batch(1).K[0, 0, 0], raw_rig.K[0, 0, 0])) for _ in range(200)]
    assert 75 < sum(from_raw) < 125


def test_presets():
    assert len(jobs(quick())) == 2 * 3  # schedules, variants
    # Raw and scale/crop once for each seed, five variants for each change.
    assert len({job.name for job in jobs(small())}) == len(jobs(small())) == 2 * 4  # seeds, variants


@pytest.mark.slow
def test_keys_follow_what_matters(done):
    raw, _, mixed, oracle = jobs(TINY)
    keys = {done.training_key(job) for job in (raw, mixed, oracle)}
    assert len(keys) == 3
    longer = replace(done, settings=replace(TINY, schedule=replace(TINY.schedule, steps=4)))
    assert longer.training_key(raw) != done.training_key(raw)
    assert longer.images(raw).store().key == done.images(raw).store().key
    assert done.result_path(raw, "fov50") != longer.result_path(raw, "fov50")


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ("--streets 150", "streets: expected a whole hundred"),
        *(
            (f"--real A B {option}", f"{option.split()[0]} is for synthetic streets: leave it out with --real")
            for option in ("--world cuboids", "--streets 200", "--changes up70")
        ),
    ],
)
def test_command_refuses_what_makes_no_sense(given, message, capsys, tmp_path):
    assert command.main(["--quick", *given.split(), "--output", str(tmp_path)]) == 2
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("given", ["--steps 0", "--steps -3", "--seeds -1", "--train-frames 0", "--workers 0"])
def test_command_refuses_numbers(given, capsys):
    with pytest.raises(SystemExit, match="2"):
        command.main(["--quick", *given.split()])
    assert "error: argument" in capsys.readouterr().err


def test_command_lists_and_refuses(capsys, tmp_path):
    assert command.main(["--small", "--seeds", "0", "--changes", "up70", "--list", "--output", str(tmp_path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 4 and all(line.startswith("missing") for line in lines)
    with pytest.raises(SystemExit):
        command.main(["--small", "--variants", "nothing"])
    capsys.readouterr()
    few = ["--small", "--seeds", "0", "--changes", "up70", "--output", str(tmp_path)]
    assert command.main([*few, "--device", "cuda:99"]) == 2
    assert "expected cpu or a CUDA device that is there" in capsys.readouterr().err


def test_command_chooses_world_and_schedules(tmp_path):
    given = ["--small", "--world", "cuboids", "--schedules", "short", "long", "--steps", "10"]
    setup = Run(settings=command._settings(command._parser().parse_args(given)), output=tmp_path)
    assert {source.world for source, _ in setup.sources()} == {"cuboids"}
    steps = {job.length: setup.schedule(job).steps for job in jobs(setup.settings)}
    assert steps == {"short": 10, "long": 26}
    assert {job.name.endswith("-long") for job in jobs(setup.settings) if job.length == "long"} == {True}
    for other in (["--small"], ["--quick", "--real", "A", "B"]):  # recorded data are of no streets
        assert command._settings(command._parser().parse_args(other)).world == "drive"
    with pytest.raises(ValueError, match="schedules: expected some of short, long, got longest"):
        Settings(schedules=("longest",))


@pytest.mark.slow
def test_the_large_run_is_planned_on_a_machine_without_a_gpu(tmp_path):
    assert command.main(["--large", "--list", "--output", str(tmp_path)]) == 0


@pytest.mark.release
@pytest.mark.timeout(1800)
def test_quick_oracle_is_above_raw(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(cache, "CHUNK_FRAMES", 20)
    assert command.main(["--quick", "--output", str(tmp_path)]) == 0
    changes = json.loads((tmp_path / "report.json").read_text())["changes"]
    assert set(changes) == {"up70", "up70-long"}
    for change in changes.values():
        variants = change["variants"]
        assert variants["oracle"]["iou"]["value"] > variants["raw"]["iou"]["value"]
        assert set(variants) == {"raw", "auto_fill", "oracle"}
