"""Checks of installed packages, and thread settings that make results repeatable."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from importlib import import_module, metadata
from typing import Any

from arbiview_aug.errors import MissingPackageError, warn

_CV2_WHEELS = ("opencv-python", "opencv-python-headless", "opencv-contrib-python", "opencv-contrib-python-headless")


def installed_version(name: str) -> str | None:
    """The version of a distribution; None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


@cache
def warn_about_cv2_wheels() -> None:
    """Warn once per process if several wheels provide ``cv2``."""
    found = {name: version for name in _CV2_WHEELS if (version := installed_version(name)) is not None}
    if len(found) < 2:
        return
    versions = " and ".join(f"{name} {version}" for name, version in found.items())
    warn(
        f"{versions} are installed together: they overwrite each other's files, so cv2 may break or change with the "
        f"order of installation. Keep one: pip uninstall -y {' '.join(found)} && pip install {list(found)[-1]}",
        RuntimeWarning,
    )


def imported(name: str) -> Any:
    """Import what ``module:name`` names."""
    module, _, attribute = name.partition(":")
    return getattr(import_module(module), attribute)


def lazy_names(
    package: str, homes: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package whose names are imported on first use (PEP 562).

    ``homes`` are modules of ``arbiview_aug``, and the names that each defines, separated by blanks.
    """
    modules = {name: module for module, names in homes.items() for name in names.split()}

    def get(name: str) -> Any:
        if name not in modules:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = imported(f"arbiview_aug.{modules[name]}:{name}")
        setattr(sys.modules[package], name, value)
        return value

    return get, lambda: sorted({*vars(sys.modules[package]), *modules}), sorted(modules)


def optional_package(name: str, extra: str | None = None) -> Any:
    """Import an optional package, which an ``extra`` of this package installs if given.

    Raises:
        MissingPackageError: It is not installed.
    """
    try:
        return import_module(name)
    except ModuleNotFoundError as error:
        top = name.split(".")[0]
        if (error.name or "").split(".")[0] != top:
            raise  # one of its own dependencies is missing
        wanted = f"'arbiview_aug[{extra}]'" if extra else top
        raise MissingPackageError(f"{top} is not installed: pip install {wanted}") from None


def compiled(function: Any) -> Any:
    """Compile a function by numba at its first call, and keep the result in a cache folder where one can be written.

    Division by zero gives infinity, as in numpy. Operations keep their order, so results do not depend on the number of
    threads or processes; kinds of CPU may differ in the last bit.
    """
    from numba import njit

    try:
        return njit(error_model="numpy", nogil=True, cache=True)(function)
    except RuntimeError:  # no locator available: neither the package's folder nor the user's can be written
        return njit(error_model="numpy", nogil=True)(function)


@contextmanager
def compilation_announced() -> Iterator[None]:
    """Say once, on stderr, that functions are being compiled, where numba's cache does not hold them."""
    from numba.core import event

    with event.install_listener("numba:compile", _announcement()):
        yield


@cache
def _announcement() -> Any:
    from numba.core import event

    class Announcement(event.Listener):  # type: ignore[misc]
        said = False

        def on_start(self, event: Any) -> None:
            if not self.said:
                print("arbiview_aug: compiling kernels, once for each installation (half a minute)", file=sys.stderr)
            self.said = True

        def on_end(self, event: Any) -> None:
            pass

    return Announcement()


@contextmanager
def repeatable_opencv() -> Iterator[None]:
    """Run OpenCV on one thread without Intel's IPP, so that the same images give the same bits.

    The last bits of IPP's ``distanceTransform`` and ``magnitude`` depend on memory alignment, and SIFT's angles on
    those (OpenCV 5.0, IPP 2026.0). IPP can only be disabled for the calling thread. The thread count is process-wide.
    """
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

    names = "arbiview_aug", "torch", "numpy", "kornia"
    packages = {name: installed_version(name) or "not installed" for name in names}
    return {"python": platform.python_version(), "opencv": cv2.__version__, **packages}
