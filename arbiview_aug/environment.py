"""Checks of installed packages, and thread settings that make results repeatable."""

from __future__ import annotations

import ast
import os
import pkgutil
import platform
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from hashlib import sha256
from importlib import import_module, metadata
from numbers import Number
from pathlib import Path
from typing import Any

import arbiview_aug
from arbiview_aug.errors import MissingPackageError, warn

_CV2_WHEELS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", "opencv-contrib-python-headless")


def installed_version(name: str) -> str | None:
    """The version of a distribution; None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def cv2_conflict() -> str | None:
    """Warning that several installed wheels provide ``cv2``, and the fix; None for one."""
    wheels = {name: version for name in _CV2_WHEELS if (version := installed_version(name)) is not None}
    if len(wheels) < 2:
        return None
    versions = " and ".join(f"{name} {version}" for name, version in wheels.items())
    return (
        f"{versions} are installed together: they overwrite each other's files, so cv2 may break or change with the "
        f"order of installation. Keep one: pip uninstall -y {' '.join(wheels)} && pip install {list(wheels)[-1]}"
    )


@cache
def warn_about_cv2_wheels() -> None:
    """Warn once per process if several wheels provide ``cv2``."""
    if (conflict := cv2_conflict()) is not None:
        warn(conflict, RuntimeWarning)


def imported(name: str) -> Any:
    """Import what ``module:name`` names."""
    module, _, attribute = name.partition(":")
    return getattr(import_module(module), attribute)


def lazy_names(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package whose names are imported on first use (PEP 562).

    The names are those that its ``__init__.py`` imports for type checkers, as ``from module import Name as Name``.
    """
    tree = ast.parse(pkgutil.get_data(package, "__init__.py") or b"")
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    modules = {alias.name: node.module for node in imports for alias in node.names if alias.asname}

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = imported(f"{modules[name]}:{name}")
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[package]), *modules}), sorted(modules)


def optional_package(name: str, extra: str | None = None) -> Any:
    """Import an optional package, which an ``extra`` of this package installs if given, or MissingPackageError."""
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        top = name.split(".")[0]
        if (error.name or "").split(".")[0] != top:
            raise  # one of its own dependencies is missing
        wanted = f"'arbiview_aug[{extra}]'" if extra else top
        raise MissingPackageError(f"{top} is not installed: pip install {wanted}") from None


def compiled(function: Any, **options: Any) -> Any:
    """Compile a function by numba at its first call, and keep the result in a cache folder where one can be written.

    Division by zero gives infinity, as in numpy. Operations keep their order; kinds of CPU may differ in the last bit.
    """
    from numba import njit

    options["no_cfunc_wrapper"] = True  # C calls none
    kernel: Any = njit(error_model="numpy", nogil=True, **options)(function)
    with suppress(RuntimeError):  # no locator available: neither the package's folder nor the user's can be written
        kernel._cache = _kernel_cache()(function)
    return kernel


def called(function: Any) -> Any:
    """Compile a function as ``compiled`` does, for other kernels alone: Python cannot call it."""
    return compiled(function, no_cpython_wrapper=True)


def borrowing(function: Any, *, no_cpython_wrapper: bool = True) -> Any:
    """Compile a function as ``called`` does, without counting references to arrays, which takes a fifth of the time.

    It must not allocate or return an array, nor call a function that does. Python can call it with the wrapper.
    """
    from numba.core.cpu import CPUTargetOptions

    option = {"_nrt": False} if hasattr(CPUTargetOptions, "_nrt") else {}  # private; numba's own str kernels use it
    return compiled(function, no_cpython_wrapper=no_cpython_wrapper, **option)


def inlined(function: Any) -> Any:
    """Let numba compile a function within its callers: for small parts of few kernels."""
    from numba import njit

    return njit(error_model="numpy", nogil=True, inline="always")(function)


@contextmanager
def compilation_announced() -> Iterator[None]:
    """Say on stderr that kernels are compiled, where numba's cache does not hold them."""
    from numba.core import event

    with event.install_listener("numba:compile", _announcer()):
        yield


@cache
def _announcer() -> Any:
    from numba.core import event

    class Announcer(event.Listener):  # type: ignore[misc]
        def on_start(self, event: Any) -> None:
            if event.data["dispatcher"].py_func.__module__.startswith("arbiview_aug."):
                say_compiling()

        def on_end(self, event: Any) -> None:
            pass

    return Announcer()


@cache
def say_compiling() -> None:
    """Say on stderr, once for each process, why the first frames take long."""
    print("arbiview_aug: compiling kernels that were not used before", file=sys.stderr)


def is_kept(kernel: Any) -> bool:
    """Whether numba's cache holds a kernel in its present form; a kernel without a cache counts as held."""
    files = getattr(kernel._cache, "_cache_file", None)
    return files is None or bool(files._load_index())


@cache
def _kernel_cache() -> type:
    """numba's cache of one kernel, which throws damaged files away and notices changes in other modules."""
    from numba.core.caching import FunctionCache, IndexDataCacheFile

    class Files(IndexDataCacheFile):  # type: ignore[misc]
        """Code that ends in its SHA-256, in files named after the signature, for concurrent processes."""

        def save(self, key: Any, data: Any) -> None:
            name = f"{self._index_name[:-4]}.{sha256(repr(key).encode()).hexdigest()[:16]}.nbc"
            self._save_data(name, data)
            self._save_index({**self._load_index(), key: name})

        def _load_index(self) -> Any:
            try:
                return super()._load_index()
            except Exception:  # a damaged file, or one of a version whose arguments' classes are elsewhere now
                return {}

        def _dump(self, data: Any) -> bytes:
            content = super()._dump(data)
            return bytes(content + sha256(content).digest())  # pickle reads no further than its end

        def _load_data(self, name: str) -> Any:
            content = Path(self._data_path(name)).read_bytes()
            if sha256(content[:-32]).digest() != content[-32:]:
                raise FileNotFoundError(name)  # damaged: it is compiled again
            return super()._load_data(name)

    class KernelCache(FunctionCache):  # type: ignore[misc]
        def __init__(self, function: Any) -> None:
            super().__init__(function)
            called, waiting, constants = set[str](), [function], set[str]()
            while waiting:  # kernels of the modules that its module imports kernels from, and so on
                known = waiting.pop().__globals__
                constants |= {f"{name} {value}" for name, value in known.items() if isinstance(value, Number)}
                kernels = [value.py_func for value in known.values() if hasattr(value, "py_func")]
                new = {kernel.__code__.co_filename: kernel for kernel in kernels}
                waiting += [new[file] for file in new.keys() - called]
                called |= new.keys()
            changes = ((s.st_mtime, s.st_size) for s in map(os.stat, sorted(called)))
            stamps = self._impl.locator.get_source_stamp(), *sorted(constants), *changes
            self._cache_file = Files(self._cache_path, f"{self._impl.filename_base}.sha256", stamps)

        def save_overload(self, signature: Any, data: Any) -> None:
            with suppress(OSError):  # a full disk, or a folder that cannot be written any more
                super().save_overload(signature, data)

    return KernelCache


@contextmanager
def repeatable_opencv() -> Iterator[None]:
    """Run OpenCV on one thread without Intel's IPP, whose last bits depend on memory alignment (OpenCV 5.0)."""
    import cv2

    ipp, threads = cv2.ipp.useIPP(), cv2.getNumThreads()
    cv2.ipp.setUseIPP(False)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.ipp.setUseIPP(ipp)
        cv2.setNumThreads(threads)


@contextmanager
def one_thread() -> Iterator[None]:
    """Run OpenCV, torch and the linear algebra behind numpy on one thread."""
    import cv2
    import torch
    from threadpoolctl import threadpool_limits  # a dependency of scikit-learn

    before = cv2.getNumThreads(), torch.get_num_threads()
    cv2.setNumThreads(1)
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        cv2.setNumThreads(before[0])
        torch.set_num_threads(before[1])


def versions() -> dict[str, str]:
    """Versions that results and times depend on."""
    import cv2

    packages = {name: installed_version(name) or "not installed" for name in ("torch", "numpy", "kornia")}
    python, package = platform.python_version(), arbiview_aug.__version__  # that of an editable install may be old
    return {"python": python, "opencv": cv2.__version__, "arbiview_aug": package, **packages}
