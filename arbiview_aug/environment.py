"""Checks of the Python environment."""

from __future__ import annotations

import warnings
from importlib import metadata

CV2_WHEELS = (
    "opencv-python",
    "opencv-python-headless",
    "opencv-contrib-python",
    "opencv-contrib-python-headless",
)
"""Distributions that all install the package ``cv2``."""

_warned = False


def installed_cv2_wheels() -> dict[str, str]:
    """Versions of the installed distributions that bring ``cv2``, by name."""
    found = {}
    for name in CV2_WHEELS:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def warn_about_cv2_wheels() -> None:
    """Warn, once a process, where two wheels bring ``cv2``: they overwrite each other's files without a word."""
    global _warned
    if _warned:
        return
    _warned = True
    found = installed_cv2_wheels()
    if len(found) < 2:
        return
    versions = " and ".join(f"{name} {version}" for name, version in found.items())
    warnings.warn(
        f"{versions} are installed together: they overwrite each other's files, so cv2 may break or change with the "
        f"order of installation. Keep one: pip uninstall -y {' '.join(found)} && pip install {list(found)[-1]}",
        RuntimeWarning,
        stacklevel=3,
    )
