"""Kernels: damaged caches, and folders that cannot be written."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from numba.core import caching, config

from arbiview_aug import __version__, environment
from arbiview_aug.__main__ import main
from arbiview_aug.environment import compilation_announced, compiled


def _garbled(content: bytes) -> bytes:
    middle = len(content) // 2
    return content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :]


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    "emptied": lambda content: b"",
    "cut": lambda content: content[: len(content) // 2],
    "garbled": _garbled,
}


def twice(x: int) -> int:
    return 2 * x


def first(pair: Any) -> int:
    return pair[0]


@pytest.fixture
def kernel(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Any]:
    """A kernel as a new process has it, whose cache lies below ``tmp_path``."""
    monkeypatch.setattr(config, "CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(twice, "__module__", "arbiview_aug.environment")
    return lambda: compiled(twice)


@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
@pytest.mark.parametrize("how", DAMAGE)
def test_damaged_kernels_are_compiled_anew(kernel: Callable[[], Any], suffix: str, how: str, tmp_path: Path) -> None:
    assert kernel()(3) == 6
    (path,) = tmp_path.rglob(f"*.{suffix}")
    path.write_bytes(DAMAGE[how](path.read_bytes()))
    again = kernel()
    assert again(4) == 8 and not again.stats.cache_hits
    third = kernel()
    assert third(5) == 10 and sum(third.stats.cache_hits.values()) == 1


class Pair(NamedTuple):
    x: int
    y: int


def test_kernels_of_a_version_with_other_classes_are_compiled_again(
    kernel: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A class of an argument that is in another module since an upgrade."""
    kernel()
    monkeypatch.setattr(first, "__module__", "arbiview_aug.environment")
    assert compiled(first)(Pair(3, 4)) == 3
    monkeypatch.delattr(sys.modules[__name__], "Pair")
    again = compiled(first)
    assert again((2, 5)) == 2 and not again.stats.cache_hits


def test_kernels_are_cached_where_their_folder_can_be_written_only(
    kernel: Callable[[], Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one = kernel()
    (folder,) = (tmp_path / "cache").iterdir()
    folder.rmdir()
    folder.write_text("")
    assert one(3) == 6
    monkeypatch.setattr(caching.CacheImpl, "_locator_classes", [])
    assert kernel()(4) == 8 and not list(tmp_path.rglob("*.nbi"))


def test_kernels_are_compiled_anew_when_one_that_they_call_or_a_constant_changes(
    kernel: Callable[[], Any], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    inner = None
    for name in ("inner", "outer"):  # a kernel that calls one that calls another
        file, scope = tmp_path / f"{name}.py", {"inner": inner}
        file.write_text(f"def {name}(x):\n    return x\n")
        exec(compile(file.read_text(), str(file), "exec"), scope)
        inner = compiled(scope[name])
    monkeypatch.setitem(globals(), "outer", inner)
    assert kernel()(3) == 6
    for name in ("inner", "outer"):
        again = kernel()
        assert again(3) == 6 and again.stats.cache_hits
        (tmp_path / f"{name}.py").write_text(f"def {name}(x):\n    return x + 1\n")
        third = kernel()
        assert third(3) == 6 and not third.stats.cache_hits
    monkeypatch.setitem(globals(), "SHARE", 1)
    assert kernel()(3) == 6
    monkeypatch.setitem(globals(), "SHARE", np.float32(2))  # imported from a module without kernels
    fourth = kernel()
    assert fourth(3) == 6 and not fourth.stats.cache_hits


def test_compiling_is_announced(kernel: Callable[[], Any], capsys: pytest.CaptureFixture[str]) -> None:
    environment.say_compiling.cache_clear()  # other tests of this process may have compiled
    with compilation_announced():
        assert kernel()(3) == 6
    assert capsys.readouterr().err == "arbiview_aug: compiling kernels that were not used before\n"
    environment.say_compiling.cache_clear()
    with compilation_announced():
        assert kernel()(3) == 6
    assert capsys.readouterr().err == ""


def test_processes_that_save_a_kernel_at_the_same_time_do_not_mix_its_versions(
    kernel: Callable[[], Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Both read the index before either wrote it: an entry may be lost, but leads to no other's code."""
    first, second = kernel(), kernel()
    for one in (first, second):
        monkeypatch.setattr(one._cache._cache_file, "_load_index", dict)
    assert first(3) == 6 and second(3.5) == 7.0
    third = kernel()
    assert third(3) == 6 and third(3.5) == 7.0


def test_the_version_is_that_of_the_code(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Metadata of an editable install keep the version that it was installed with."""
    monkeypatch.setattr(environment.metadata, "version", lambda name: "0.0.1")
    assert environment.versions()["arbiview_aug"] == __version__
    assert main(["--version"]) == 0 and capsys.readouterr().out == f"arbiview_aug {__version__}\n"
