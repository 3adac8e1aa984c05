"""Fixtures that several test modules share."""

import gc
import importlib.util
import logging
import math
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from hypothesis import settings

# The same examples in every run: a failure must come from the change that is tested.
settings.register_profile("reproducible", derandomize=True, deadline=None)
settings.load_profile("reproducible")

COMPILER = pytest.StashKey[subprocess.Popen]()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config) -> None:
    """Compile the kernels once, while the processes of ``-n`` collect: each would compile them for itself."""
    config.stash[COMPILER] = subprocess.Popen([sys.executable, "-m", "tests.compiled"], cwd=config.rootpath)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_node_collection_finished(node: Any) -> None:
    """Begin with the first test when the kernels are compiled."""
    if node.config.stash[COMPILER].wait():
        pytest.exit("the kernels do not compile", returncode=1)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Keep a module's tests in one process, as ``--dist loadfile`` does: they share what is dear."""
    from xdist.scheduler import LoadFileScheduling

    return LoadFileScheduling(config, log) if config.getoption("dist") == "load" else None  # that of ``-n`` alone


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the modules that train for minutes: everything else fits beside them."""
    items.sort(key=lambda item: item.path.name not in ("test_learning.py", "test_experiment.py"))


def pytest_collection_finish() -> None:
    """Take what was imported out of the garbage collector's sight: a search through it takes half a second."""
    gc.collect()
    gc.freeze()


@pytest.fixture
def report_bound(request: pytest.FixtureRequest, capsys: pytest.CaptureFixture[str]) -> Callable[..., None]:
    """Print a measured time, ratio or rate beside its bound; a miss fails with ``--bounds`` alone.

    Times depend on the machine and on what else runs there, so tests report them; the release checks
    (``docs/contributing.md``) pass ``--bounds`` on a machine that is otherwise idle.
    """

    def report(name: str, value: float, *, at_most: float = math.inf, at_least: float = -math.inf) -> None:
        bound = f"at most {at_most:g}" if at_most < math.inf else f"at least {at_least:g}"
        missed = not at_least <= value <= at_most
        line = f"{name}: {value:.4g} (bound: {bound}){', missed' if missed else ''}"
        with capsys.disabled():
            print(f"\n{line}")
        if missed and request.config.getoption("--bounds"):
            pytest.fail(line)

    return report


@pytest.fixture(scope="session")
def data_root() -> Path:
    """The folder of real frames; a test that needs it is skipped where it is missing."""
    repository = Path(__file__).parents[1]
    root = Path(os.environ.get("ARBIVIEW_DATA", repository / ".." / "shared" / "data"))
    if not root.is_dir():
        pytest.skip(f"no real frames at {root}: set ARBIVIEW_DATA to their folder")
    return root.resolve()


@pytest.fixture(scope="session")
def nuscenes_root(data_root: Path) -> Path:
    """One real keyframe, both as a frame folder and in nuScenes tables."""
    return _frame(data_root, "nuscenes-one")


@pytest.fixture(scope="session")
def ddad_root(data_root: Path) -> Path:
    """One real frame with masks of the own car."""
    return _frame(data_root, "ddad-one")


@pytest.fixture(scope="session")
def kitti_root(data_root: Path) -> Path:
    """Eleven real frames of a drive, each with a photograph from 0.54 m to the right."""
    return _frame(data_root, "kitti-stereo")


@pytest.fixture(scope="session")
def fisheye_root(data_root: Path) -> Path:
    """Four real fisheye cameras, as PNGs."""
    return _frame(data_root, "surround-fisheye")


@pytest.fixture(scope="session")
def referee(data_root: Path) -> ModuleType:
    """The evaluation protocol, which ``evaluate`` must agree with; the test is skipped where it is missing."""
    path = data_root.parent / "referee.py"
    if not path.is_file():
        pytest.skip(f"no evaluation protocol {path}: it lies beside the data folder")
    spec = importlib.util.spec_from_file_location("referee", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="session")
def generator() -> Any:
    """A small generator, not to be changed."""
    pytest.importorskip("diffusers")
    from tests.generator.small import small_generator

    return small_generator()


@pytest.fixture
def own_ray(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Ray on this machine alone, which ends with the test."""
    ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'arbiview_aug[distributed]'")
    monkeypatch.setenv("RAY_ENABLE_UV_RUN_RUNTIME_ENV", "0")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    yield
    ray.shutdown()
    # Ray's handlers keep the stream that stood for standard error when it was imported: the capture of a first test
    # is closed in the second, and each record then ends in a traceback.
    for name in [name for name in logging.root.manager.loggerDict if name.split(".")[0] == "ray"]:
        logging.getLogger(name).handlers.clear()


def _frame(data_root: Path, name: str) -> Path:
    if not (data_root / name).is_dir():
        pytest.skip(f"no frame {name} in {data_root}")
    return data_root / name
