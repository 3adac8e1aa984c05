"""A's detectors on B's frames: what is shown, and a whole run at toy size that goes on where it was."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from integrations.cross_rig import __main__ as command
from integrations.cross_rig import cache, deploy
from integrations.cross_rig.deploy import ON_A, ON_B, Jittered, Trained, frames_of, rows_of
from integrations.cross_rig.experiment import Run
from integrations.cross_rig.settings import jobs
from integrations.cross_rig.tests import test_experiment
from integrations.cross_rig.training import untrained

TINY = replace(test_experiment.TINY, changes=("fisheye", "up70", "waymo"), variants=("raw",))


def test_rows_are_those_that_say_something(tmp_path):
    setup = Run(settings=TINY, output=tmp_path)
    in_place = ["as is", "calibration not read", "infinity", "infinity, masked", "A's true frames"]
    assert list(rows_of(setup, "fisheye")) == in_place
    assert rows_of(setup, "up70") == ON_B
    assert set(ON_B) - set(rows_of(setup, "waymo")) == {"calibration not read"}  # it has other cameras
    assert rows_of(setup, None) == ON_A


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cache, "CHUNK_FRAMES", 1)
        setup, lines = Run(settings=TINY, output=tmp_path_factory.mktemp("deploy")), []
        yield setup, deploy.deploy(setup, None, lines.append), lines


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_what_is_done_is_not_done_again(done, monkeypatch):
    setup, text, lines = done
    assert len(lines) == sum(len(rows_of(setup, change)) for change in (None, *TINY.changes))
    monkeypatch.setattr(deploy, "evaluate", None)
    assert deploy.deploy(setup, None, lines.append) == text
    for title in ("fisheye, 100° wide", "+0.7 m", "Waymo-like", "A, calibration that errs", *ON_A, *ON_B):
        assert f"| {title}" in text


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_frames_are_shown_as_their_rows_say(done):
    setup, _, _ = done
    schedule = setup.schedule(jobs(setup.settings)[0])
    detector = Trained(untrained(schedule).eval(), "untrained", schedule)
    a, b = setup.source("test").rig, setup.source("test", "up70").rig
    shown = {title: frames_of(setup, detector, "up70", way, "test") for title, way in ON_B.items()}
    frames = {title: of_row.frame(1) for title, of_row in shown.items()}
    for title, frame in frames.items():
        rig = b if title == "as is" else a
        np.testing.assert_allclose(frame.cam2ego, rig.cam2ego, atol=1e-6)
        np.testing.assert_array_equal(frame.state, frames["as is"].state)
        has_holes = title.endswith("masked") and title != "infinity, masked"  # turned and zoomed alike
        assert frame.coverage.all() == (not has_holes)
    np.testing.assert_array_equal(frames["as is"].images, frames["calibration not read"].images)
    assert len({frame.images.tobytes() for frame in frames.values()}) > 5


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_calibration_errs_the_same_each_time(done):
    setup, _, _ = done
    schedule, a = setup.schedule(jobs(setup.settings)[0]), setup.source("test").rig
    detector = Trained(untrained(schedule), "untrained", schedule)
    own = frames_of(setup, detector, None, ON_A["1°"], "test")
    assert isinstance(own, Jittered)
    poses = own.frame(0).cam2ego
    np.testing.assert_array_equal(poses, own.frame(0).cam2ego)
    cosines = np.einsum("nij,nij->n", a.cam2ego[:, :3, :3], poses[:, :3, :3]) / 2 - 0.5
    assert 0.2 < np.degrees(np.arccos(cosines)).mean() < 5
    np.testing.assert_allclose(poses[:, :3, 3], a.cam2ego[:, :3, 3], atol=1e-6)


def test_results_follow_what_made_them(tmp_path, monkeypatch):
    setup = Run(settings=TINY, output=tmp_path)
    (job,) = jobs(TINY)
    monkeypatch.setattr(Run, "training_key", lambda *_: "weights")

    def paths(*changed: str) -> dict:
        with monkeypatch.context() as patch:
            patch.setattr(deploy, "code_hash", lambda name, **_: "new" if name in changed else name)
            return {(change, title): path for change, title, _, path in deploy._tests(setup, job)}

    before = paths()
    assert len(set(before.values())) == len(before)
    for module in ("arbiview_aug.transforms.rig_retarget", "arbiview_aug.transforms.jitter"):
        assert not set(before.values()) & set(paths(module).values())
    monkeypatch.setitem(ON_B, "street", ON_B["LiDAR"])
    assert {key[1] for key, path in paths().items() if path != before[key]} == {"street"}
    monkeypatch.setattr(deploy, "_FOUND", (0.9,))
    of_detections = {title for title in ON_B if title.startswith("two passes")}
    assert {key[1] for key, path in paths().items() if path != before[key]} == {"street", *of_detections}


def test_frames_of_longer_runs_have_their_own_boxes(tmp_path, monkeypatch):
    """A chunk of two frames, of which the first run detects one."""
    monkeypatch.setattr(cache, "CHUNK_FRAMES", 2)
    monkeypatch.setattr(deploy, "ViewMaker", lambda *_: lambda _, frame: {"boxes": frame["boxes_3d"].numpy()})
    monkeypatch.setattr(
        deploy, "_detections", lambda run, *_: [torch.full((1, 7), float(k)) for k in range(run.settings.test_frames)]
    )
    for count in (1, 2):
        setup = Run(settings=replace(TINY, test_frames=count), output=tmp_path)
        cache.fill(setup.source("test", "up70").store(), lambda _: {"images": np.zeros((1, 3, 8, 8), np.uint8)}, 0)
        variant = ON_B["two passes"].variant
        views = deploy._views(setup, Trained(None, "weights", None), "up70", variant, "test")
        assert views.stacked("boxes", count)[:, 0, 0].tolist() == list(range(count))
        assert views.spec["views"] == variant.views_spec()


def test_rows_are_differences_from_the_first():
    """Also where another row was tested before it, with another seed."""

    def of(hits: int) -> dict:
        return {"by_distance": np.tile([hits, 50, 50], (5, 3, 1)).tolist()}

    done = {"street": {0: of(80), 1: of(80)}, "as is": {1: of(60)}, "infinity": {0: of(90)}}
    cells = deploy._cells(done, "as is")
    assert cells == {"street": "+6.9 [+6.9, +6.9] (1)", "as is": "37.5 (1)"}


def test_command_takes_rows(capsys, tmp_path):
    with pytest.raises(SystemExit):
        command.main(["--small", "--output", str(tmp_path), "--deploy", "nothing"])
    assert "learned depth" in capsys.readouterr().err


def test_detections_of_one_vehicle_become_one_box():
    """Queries say a vehicle in several cells."""
    found, counts = np.zeros((5, 8), np.float32), np.ones((100, 100), bool)
    found[:, 0], found[:, 1] = (0.9, 0.8, 0.7, 0.6, 0.2), (0.0, 1.5, 3.0, 6.0, 9.0)
    counts[62] = False  # x of 6 m: the own car
    assert deploy.distinct(found, counts)[:, 0].tolist() == [0.0, 3.0]
    assert deploy.distinct(found[4:], counts).shape == (0, 7)
