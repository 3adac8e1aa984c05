"""Conversions that are killed go on, from the first file to the last table: whole files or none."""

from __future__ import annotations

import multiprocessing
import os
import random
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from arbiview_aug import load_rig
from arbiview_aug.__main__ import main
from tests.cli.convert.drives import SURROUND, command, tree, write_frames, write_nuscenes

SEED = 0
MANY = 120
"""Frames, of which 40 at most are there when the kill comes: a slow machine kills late."""


def started(commands: Sequence[Sequence[str]]) -> list[multiprocessing.process.BaseProcess]:
    """Each in a process of its own."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["arbiview_aug.cli.convert.command"])
    processes: list[Any] = [context.Process(target=main, args=(one,)) for one in commands]
    for process in processes:
        process.start()
    return processes


def killed(commands: Sequence[Sequence[str]], after_s: float) -> int:
    """Start the commands, kill those that still run after a while; gives how many."""
    processes = started(commands)
    time.sleep(after_s)
    alive = [process for process in processes if process.is_alive()]
    for process in alive:
        process.kill()
    for process in processes:
        process.join()
    return len(alive)


@pytest.mark.timeout(1800)
@pytest.mark.parametrize(
    ("kind", "shards", "least"),
    [
        pytest.param("frames", 1, 8, marks=pytest.mark.slow),
        pytest.param("nuscenes", 3, 8, marks=pytest.mark.slow),
        *(pytest.param(k, n, 24, marks=pytest.mark.release) for k in ("frames", "nuscenes") for n in (1, 3)),
    ],
)
def test_killed_at_any_moment_it_goes_on(kind: str, shards: int, least: int, tmp_path: Path) -> None:
    """At least 40 samples and so many kills, from the first file to the last table."""
    if kind == "frames":
        source = write_frames(tmp_path / "source", 42)
    else:
        source = write_nuscenes(tmp_path / "source", 21)
    two = SURROUND.with_cameras(SURROUND.cameras[:2]).shifted(x_m=0.3)
    replace(two, lidars=load_rig("nuscenes").lidars).save(tmp_path / "two.json")
    target = ("--target", str(tmp_path / "two.json"))
    (whole,) = started([command(source, tmp_path / "whole", *target)])  # starts the server, which takes the longest
    whole.join()
    begun = time.monotonic()
    (again,) = started([command(source, tmp_path / "again", *target)])
    again.join()
    took_s = time.monotonic() - begun
    expected = tree(tmp_path / "whole")
    assert whole.exitcode == again.exitcode == 0 and tree(tmp_path / "again") == expected
    draw, kills, outputs, partial = random.Random(SEED), 0, 0, 0
    while kills < least or partial < least // 5 + 1:
        outputs += 1
        output = tmp_path / f"killed-{outputs}"
        asked = command(source, output, *target)
        for _ in range(least // 4):
            parts = [[*asked, "--num-shards", str(shards), "--shard-index", str(k)] for k in range(shards)]
            kills += killed(parts, draw.uniform(0.05, 1) * took_s / (1 if draw.random() < 0.5 else 3))
            there = tree(output) if output.exists() else {}
            half = [k for k, content in there.items() if not k.endswith(".part") and expected.get(k) != content]
            assert not half, half
            partial += 0 < len(there) < len(expected)
        for process in started([asked]):
            process.join()
            assert process.exitcode == 0
        assert tree(output) == expected
    print(
        f"{kind}, {shards} shards: {kills} kills in {outputs} outputs, {partial} times in between; a run {took_s:.1f} s"
    )


def runs(process: Any) -> bool:
    """Whether a process has not ended; one that nobody has asked for its exit code has."""
    try:
        return process.is_running() and process.status() != "zombie"
    except pytest.importorskip("psutil").NoSuchProcess:
        return False


@pytest.mark.slow
def test_killed_with_its_workers_it_goes_on(tmp_path: Path) -> None:
    """Workers die with their parent: nobody writes into the next run."""
    source = write_frames(tmp_path / "source", MANY)
    assert main(command(source, tmp_path / "whole")) == 0
    asked = command(source, tmp_path / "new", "--workers", "2")
    for records in sorted(random.Random(SEED).sample(range(1, 36), 4)):
        (process,) = started([asked])
        while len(list((tmp_path / "new" / "conversion" / "samples").glob("*.json"))) < records:
            assert process.is_alive()
            time.sleep(0.005)
        workers = pytest.importorskip("psutil").Process(process.pid).children(recursive=True)
        process.kill()
        process.join()
        deadline = time.monotonic() + 60
        while any(map(runs, workers)):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert len(tree(tmp_path / "new")) < len(tree(tmp_path / "whole"))
    assert main(asked) == 0
    assert tree(tmp_path / "new") == tree(tmp_path / "whole")


def settled(root: Path) -> dict[str, bytes]:
    """The files, once nobody writes any more: Ray's actors outlive their driver by a moment."""
    names: set[str] = set()
    while names != (names := {str(path) for path in root.rglob("*")}):
        time.sleep(3)
    return tree(root)


@pytest.mark.slow
def test_ray_killed_goes_on(tmp_path: Path) -> None:
    """The driver dies, and its actors with it; the next run finishes what is missing."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install 'arbiview_aug[distributed]'")
    source = write_frames(tmp_path / "source", MANY)
    assert main(command(source, tmp_path / "whole")) == 0
    expected = tree(tmp_path / "whole")
    asked = command(source, tmp_path / "new", "--runner", "ray", "--workers", "2")
    environment = {key: value for key, value in os.environ.items() if key != "RAY_ADDRESS"}
    environment["RAY_ENABLE_UV_RUN_RUNTIME_ENV"] = "0"
    with subprocess.Popen([sys.executable, "-m", "arbiview_aug", *asked], env=environment) as running:
        while len(list((tmp_path / "new" / "conversion" / "samples").glob("*.json"))) < 10:
            assert running.poll() is None
            time.sleep(0.005)
        running.kill()
    left = settled(tmp_path / "new")
    whole = {name: content for name, content in left.items() if not name.endswith(".part")}
    assert all(expected[name] == content for name, content in whole.items()) and len(whole) < len(expected)
    subprocess.run([sys.executable, "-m", "arbiview_aug", *asked], env=environment, check=True)
    assert tree(tmp_path / "new") == expected
