"""``python -m arbiview_aug``: the dispatcher, and the check of the environment."""

from __future__ import annotations

import argparse
import json
import os
import re
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, get_args

import pytest

from arbiview_aug import __main__, environment, load_rig
from arbiview_aug.__main__ import COMMANDS, main
from arbiview_aug.choices import TRAINING_PRESETS, GeometryName, Quality
from arbiview_aug.cli import doctor, parallel
from arbiview_aug.cli.parsers import parser_of
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.errors import OutputError
from arbiview_aug.generator.config import CONFIGS
from arbiview_aug.render.plan import PRESETS
from arbiview_aug.scene.scene import GEOMETRIES
from tests.helpers import latin, street_sample


def test_two_cv2_wheels_warn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    environment.warn_about_cv2_wheels.cache_clear()
    installed = {"opencv-python": "4.10.0", "opencv-contrib-python": "5.0.0"}
    monkeypatch.setattr(environment, "installed_version", installed.get)
    message = r"opencv-python 4.10.0 and .* 5.0.0 are installed together: .* pip install opencv-contrib-python"
    with pytest.warns(RuntimeWarning, match=message):
        environment.warn_about_cv2_wheels()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        environment.warn_about_cv2_wheels()


LONG = "x" * 300
DATA_COMMANDS: dict[str, tuple[str, ...]] = {
    **{f"{name} --data": () for name in ("bench", "demo", "depth", "evaluate")},
    "convert --data": ("--target", "waymo", "--output", "converted"),
    "check": (),
    "inspect": (),
}
"""Commands that read data, before its path, and what must follow."""


@pytest.fixture
def mistakes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A working directory of a frame, logs, links in circles, and a rig and a frame of too many cameras."""
    monkeypatch.chdir(tmp_path)
    camera = load_rig("waymo").to_dict()["cameras"][0]
    for folder, cameras in (("frame", []), ("crowd", [camera] * 300), ("few", [camera] * 129)):
        Path(folder).mkdir()
        Path(folder, "calib.json").write_text(json.dumps({"cameras": cameras}))
    for name in ("loop", "loop.yaml"):
        Path(name).symlink_to(name)
    Path("logs/log").mkdir(parents=True)
    Path("logs/log/sync.arrow").touch()
    Path("large.yaml").touch()
    os.truncate("large.yaml", 25_000_000)
    monkeypatch.setitem(sys.modules, "py123d", None)


@pytest.mark.usefixtures("mistakes")
@pytest.mark.parametrize(
    ("command", "message"),
    [
        *((f"{name} nuscenes:frame", "expected a nuScenes root .*; it is a frame folder") for name in DATA_COMMANDS),
        *((f"{name} --data nowhere", "data nowhere: expected a folder, found none") for name in ("demo", "evaluate")),
        *((f"{name} --target tesla", "expected a file or one of the shipped rigs") for name in ("demo", "evaluate")),
        *((f"{name} --output /proc", "--output /proc: expected a folder that can be") for name in ("demo", "evaluate")),
        *((f"{name} --output large.yaml/a", "got Not a directory") for name in ("demo", "evaluate")),
        ("check py123d:frame", "expected a folder of py123d's logs .*found none"),
        ("check py123d:logs", r"py123d is not installed: pip install 'arbiview_aug\[py123d\]'"),
        *((f"{name} {LONG}", "expected a name that a file can have") for name in DATA_COMMANDS),
        *((f"{name} nuscenes:{LONG}", "expected a name that a file can have") for name in DATA_COMMANDS),
        *((f"{name} loop", "expected a (folder|file or)") for name in DATA_COMMANDS),
        (f"demo --output {'x/' * 3000}", "expected a folder that can be written to, got File name too long"),
        ("demo --target loop.yaml", "expected a file or one of the shipped rigs"),
        *((f"demo --output {name}", "expected a folder that can be written to") for name in ("loop", "loop/a.png")),
        ("convert --data frame --target waymo --output loop", "expected a folder, got a file or a link"),
        ("inspect large.yaml", r"a file of 23\.8 MiB, more than 1\.0 MiB"),
        *((f"check {name}", "expected at most 128 cameras, got 1[25].") for name in ("crowd", "few")),
        (
            "convert --data frame --target waymo --output o --version v1.0-mini",
            r"no version \(--version\), which a frame f",
        ),
        ("demo --holes diffusion", "argument --holes: diffusion needs --generator PATH: python -m arbiview_aug train"),
        ("evaluate --holes diffusion --generator no/no/no", "generator no/no/no: expected a folder of a generator"),
        ("evaluate --quality paper fast --geometry street", "quality paper knows infinity alone, got street"),
        ("evaluate --generator /nope", "argument --generator: expected it with --holes diffusion"),
        ("evaluate --held-out next --data frame --size 8x8", "argument --size: expected it without --held-out"),
        ("evaluate --held-out next --target waymo --data frame", "argument --target: expected --held-out holes"),
        ("evaluate --segmenter road.py:f --data frame", "argument --segmenter: expected --held-out with it"),
        ("evaluate --held-out front", "argument --held-out: expected --data FOLDER with it, found none"),
        *(
            (f"demo --{option}", f"argument --{option.split()[0]}: ")
            for option in ("size 704", "size 0x3", "seed -1", "frames 0", "geometry flat")
        ),
        ("view frame --output d\udce9/a.rrd", "expected a name in UTF-8, which Rerun's writer needs"),
        ("view frame --output a.mp4", r"expected a name ending in \.rrd, got 'a\.mp4'"),
        *(
            (f"depth --data frame --{option}", f"argument --{option.split()[0]}: expected it with --model alone")
            for option in ("batch 4", "reference road")
        ),
        *(
            (f"check waymo --{option}", f"argument --{option.split()[0]}: expected frames with it, got a rig")
            for option in ("frames 5", "downscale 2", "clean-masks")
        ),
        ("convert --data frame --target waymo --output o --fit pad", "argument --fit: expected --size with it"),
        *(
            (f"convert --data frame --target waymo --output o {option}", "expected")
            for option in ("--holes diffusion --generator none", "--size 40000x8", "--depth none")
        ),
        ("demo --seed 1000000000000000000000", r"expected a whole number from 0, at most 2\*\*60, got"),
    ],
)
def test_mistakes_are_one_line(command: str, message: str, capsys: pytest.CaptureFixture[str]) -> None:
    program, *arguments = command.split()
    arguments += DATA_COMMANDS.get(command.rpartition(" ")[0], ())
    try:
        assert main([program, *arguments]) == 2
    except SystemExit as refused:  # argparse, after the usage
        assert refused.code == 2
    said = capsys.readouterr()
    assert re.search(message, said.err.splitlines()[-1]) and "Traceback" not in said.err
    assert said.err.startswith("usage") or len(said.err.splitlines()) == 1


PATH_METAVARS = ("PATH", "DIR", "FOLDER", "FILE", "RIG", "MODEL", "DATA", "ID_OR_PATH", "NAME")


@pytest.mark.parametrize("command", COMMANDS)
def test_every_option_that_names_a_file_refuses_what_no_file_is_called(command: str) -> None:
    parser = parser_of(command)
    options = [action for action in parser._actions if str(action.metavar).rpartition("]")[2] in PATH_METAVARS]
    no_files = "command", "lidar_channel", "lidar_columns"
    options = [action for action in options if action.dest not in no_files]
    assert options or command == "doctor"
    for action in options:
        for wrong in ("", LONG, f"a/{LONG}", "a\0b", "\ud800"):
            assert action.type is not None, action.dest
            with pytest.raises(argparse.ArgumentTypeError, match="expected a name that a file can have, of 1 to 255"):
                action.type(wrong)
        assert str(action.type(os.fsdecode(b"d\xe9/x.py:f"))) == os.fsdecode(b"d\xe9/x.py:f")


@pytest.mark.parametrize(
    "command",
    [
        "inspect DATA --output OUT/a.png",
        "check DATA --output OUT",
        "demo --data DATA --target waymo --size 24x36 --output OUT",
        "evaluate --data DATA --target waymo --size 24x36 --geometry infinity --output OUT",
        *(
            pytest.param(more, marks=pytest.mark.slow)
            for more in (
                "convert --data DATA --target waymo --size 24x36 --workers 1 --output PLAIN",
                "depth --data DATA --output OUT",
                "view DATA --target waymo --size 24x36 --output PLAIN/a.rrd",
                "bench --data DATA --size 24x36 --quality fast --geometry street --output OUT",
            )
        ),
    ],
)
def test_folders_that_are_not_utf_8(command: str, tmp_path: Path) -> None:
    """In processes of their own, which OpenCV would end."""
    if command.startswith("view"):
        pytest.importorskip("rerun", reason="Rerun is not installed: pip install 'arbiview_aug[viewer]'")
    root = latin(tmp_path)
    write_frame(root / "data", street_sample((48, 72)))
    names = {"DATA": f"{root}/data", "OUT": f"{root}/out", "PLAIN": f"{tmp_path}/plain"}
    words = [re.sub("^(DATA|OUT|PLAIN)", lambda found: names[found[0]], word) for word in command.split()]
    done = subprocess.run([sys.executable, "-m", "arbiview_aug", *words], capture_output=True, check=False)
    assert done.returncode in ((0, 1) if words[0] in ("check", "depth") else (0,)), done.stderr.decode()[-2000:]
    assert b"Traceback" not in done.stderr


def test_killed_workers_are_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """As torch tells them; its words for what a worker raised stay."""
    for words, kind in (("(pid(s) 7) exited unexpectedly", OutputError), ("process 0.", RuntimeError)):

        def killed(words: str = words, **_: Any) -> Iterator[int]:
            yield 1
            raise RuntimeError(f"DataLoader worker {words}")

        monkeypatch.setattr(parallel, "DataLoader", lambda *_, **options: killed(**options))
        with pytest.raises(kind, match="fewer --workers" if kind is OutputError else words):
            list(parallel.results([1, 2], 2, "convert"))  # type: ignore[arg-type]


def test_usage(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in COMMANDS)
    assert main([]) == 2
    assert main(["paint"]) == 2
    assert "unknown command 'paint'" in capsys.readouterr().err


def test_help_imports_nothing_that_takes_time() -> None:
    """Neither torch nor OpenCV nor numba, and none of the package's modules of work, before arguments are parsed."""
    code = f"""
import contextlib, io, runpy, sys
from arbiview_aug.__main__ import main
for words in {["", *COMMANDS]}:
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
        main([*words.split(), "--help"])
    assert "usage: python -m arbiview_aug" in said.getvalue(), words
    loaded = {{"torch", "cv2", "numba", "sklearn", "diffusers", "arbiview_aug.scene"}} & {{*sys.modules}}
    assert not loaded, (words, loaded)
sys.argv = ["train", "--help"]
with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.suppress(SystemExit):
    runpy.run_module("arbiview_aug.train", run_name="__main__")
assert "usage: python -m arbiview_aug train" in said.getvalue()
assert "torch" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr


def test_names_in_options_are_those_of_the_tables() -> None:
    assert [*get_args(Quality)] == [*PRESETS, "paper"] and {*get_args(GeometryName)} == {*GEOMETRIES}
    assert {*TRAINING_PRESETS} == {*CONFIGS}


@pytest.mark.parametrize("name", COMMANDS)
def test_an_interrupt_is_one_line_and_130(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(_: argparse.Namespace) -> int:
        raise KeyboardInterrupt

    monkeypatch.setattr(__main__, "imported", lambda _: interrupted)
    needed = {"check": ["d"], "inspect": ["d"], "view": ["d"], "depth": ["--data", "d"], "bench": ["--data", "d"]}
    needed["convert"] = ["--data", "d", "--target", "waymo", "--output", "o"]
    assert main([name, *needed.get(name, [])]) == 130
    fix = "; run it again to go on" if name in ("convert", "depth", "train") else ""
    assert capsys.readouterr().err == f"python -m arbiview_aug {name}: interrupted{fix}\n"


@pytest.mark.parametrize(
    "number", [signal.SIGINT, *(pytest.param(one, marks=pytest.mark.slow) for one in (signal.SIGTERM, signal.SIGHUP))]
)
def test_a_real_interrupt(number: signal.Signals, tmp_path: Path) -> None:
    code = (
        "import sys, threading; wait = lambda *_, **__: (print('ready', flush=True), threading.Event().wait())\n"
        "from arbiview_aug import __main__ as m; from arbiview_aug.cli import demo; demo.open_frames = wait\n"
        "sys.exit(m.main(['demo', '--output', sys.argv[1]]))"
    )
    command = [sys.executable, "-c", code, str(tmp_path)]
    handler = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    # A process that pytest was started from may ignore the signal, and so would its children.
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=partial(signal.signal, number, handler),
    ) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline() == "ready\n"
        os.kill(process.pid, number)
        _, said = process.communicate(timeout=300)
    assert process.returncode == 130 and said == "python -m arbiview_aug demo: interrupted\n"


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_complete(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        main([name, "--help"])
    said = " ".join(capsys.readouterr().out.split())
    assert said.startswith("usage: python -m arbiview_aug") and "example: python -m arbiview_aug" in said
    assert "(default: " in said
    if "[KIND:]PATH" in said:
        assert all(kind in said for kind in ("frames: frame folder", "nuscenes: nuScenes root"))


# --- python -m arbiview_aug doctor ------------------------------------------------------------------------------------
def test_a_sound_installation(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["doctor", "--size", "64x176"]) == 0
    printed = capsys.readouterr().out
    for part in ("numba ", "opencv ", "threads: ", "GPUs: ", "compiled kernels: ", "street "):
        assert part in printed
    assert "PROBLEM" not in printed and not list(tmp_path.iterdir())


def test_two_wheels_are_a_problem(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    installed = {"opencv-python": "5.0", "opencv-contrib-python": "4.9"}
    monkeypatch.setattr(environment, "installed_version", installed.get)
    monkeypatch.setattr(doctor, "_frame", lambda _: (True, "a frame"))
    assert main(["doctor"]) == 1
    assert re.search("^PROBLEM: OpenCV: .*pip uninstall -y opencv-python ", capsys.readouterr().out, re.MULTILINE)


def test_kernels_that_are_kept_or_not(tmp_path: Path) -> None:
    folder = tmp_path / "room" / "__pycache__"
    folder.mkdir(parents=True)
    assert doctor._kernels(None) == (False, "compiled kernels: not kept; set NUMBA_CACHE_DIR to a writable folder")
    none = f"compiled kernels: 0 files in {tmp_path}; the first frames wait for them"
    assert doctor._kernels(str(folder)) == (True, none)
    (folder / "kernels.sha256.nbi").write_bytes(b"index")
    assert doctor._kernels(str(folder)) == (True, f"compiled kernels: 1 files in {tmp_path}")
