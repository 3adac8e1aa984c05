"""Groups of kernels that several processes compile."""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest

from arbiview_aug.transforms import warm_up
from arbiview_aug.transforms.warm_up import GROUPS, compiling


class FakeProcess:
    """A process that is never started; ``calls`` are what was asked of all of them."""

    calls: ClassVar[list[Any]] = []

    def __init__(self, target: Any, args: tuple[list[str]], daemon: bool) -> None:
        assert daemon
        self.share = args[0]

    def __getattr__(self, name: str) -> Any:
        return lambda: self.calls.append((name, *self.share))


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    monkeypatch.setattr(FakeProcess, "calls", [])
    monkeypatch.setattr(warm_up.multiprocessing, "get_context", lambda _: SimpleNamespace(Process=FakeProcess))
    monkeypatch.setattr(warm_up, "_warm_up", lambda names: FakeProcess.calls.append(("here", *names)))
    monkeypatch.setattr(warm_up.os, "sched_getaffinity", lambda _: {0, 1}, raising=False)
    warm_up.say_compiling.cache_clear()
    return FakeProcess.calls


def test_each_core_takes_its_share_and_one_line_says_so(
    calls: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warm_up, "is_kept", lambda kernel: False)
    with compiling("objects", "plans", "points"):
        assert calls == [("start", "plans")], "the caller's own work goes on meanwhile"
    assert calls[1:] == [("here", "objects", "points"), ("join", "plans"), ("kill", "plans")]
    calls.clear()
    with pytest.raises(KeyError), compiling("objects", "plans"):
        raise KeyError
    assert calls == [("start", "plans"), ("kill", "plans")]
    assert len(capsys.readouterr().err.splitlines()) == 1


def test_kernels_that_are_there_and_single_cores_need_no_process(
    calls: list[Any], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(warm_up, "is_kept", lambda kernel: True)
    with compiling(*GROUPS):
        pass
    monkeypatch.setattr(warm_up, "is_kept", lambda kernel: False)
    monkeypatch.setattr(warm_up.os, "sched_getaffinity", lambda _: {0}, raising=False)
    with compiling(*GROUPS):
        pass
    assert not calls and not capsys.readouterr().err


@pytest.mark.slow
def test_groups_hold_all_that_warming_up_compiles(tmp_path: Any) -> None:
    """In an empty cache: afterwards nothing is missing, and a process compiles nothing more."""
    code = """
from numba.core import event
from arbiview_aug.transforms.warm_up import GROUPS, _named, compile_kernels, compiling
from arbiview_aug.environment import is_kept
if __name__ == "__main__":
    with compiling(*GROUPS):
        pass
    with event.install_recorder("numba:compile") as recorded:
        compile_kernels()
    print([str(e.data["dispatcher"].py_func.__name__) for _, e in recorded.buffer])
    print(all(is_kept(kernel) for _, last in GROUPS.values() for kernel in _named(last)))
"""
    (tmp_path / "cold.py").write_text(code)
    environment = {**warm_up.os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run([sys.executable, tmp_path / "cold.py"], env=environment, capture_output=True, text=True)
    assert done.stdout == "[]\nTrue\n", done.stderr
    assert done.stderr == "arbiview_aug: compiling kernels, once for each installation\n"
