"""Throw-away environments for frameworks that no one else here needs, built once in a cache folder.

Two families: what runs beside torch borrows the packages of the environment that asks (and gets no second cv2, since
nothing is resolved); nuscenes-devkit wants numpy below 2 and has an environment of its own, without torch.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from arbiview_aug.environment import optional_package

_MADE = "made"
"""A file that is written last: a folder without it is of an interrupted try."""


@dataclass(frozen=True)
class Family:
    """Packages that fit into one environment.

    Attributes:
        requirements: For pip.
        borrows: Whether it sees the packages of the running environment; then nothing but these is installed.
    """

    requirements: tuple[str, ...]
    borrows: bool


FAMILIES = {
    "pipelines": Family(
        (
            *("mmengine==0.10.7", "addict>=2.4", "yapf>=0.40", "rich>=13", "markdown-it-py>=3", "mdurl>=0.1"),
            *("pygments>=2.17", "termcolor>=2", "platformdirs>=4"),
            *("lightning>=2.5,<3", "lightning-utilities>=0.11", "torchmetrics>=1.4"),
            *("webdataset>=1.0,<2", "braceexpand>=0.1.7"),
        ),
        borrows=True,
    ),
    "nuscenes": Family(("nuscenes-devkit==1.2.0", "numpy<2"), borrows=False),
}


def required(name: str) -> None:
    """End an example by one line that says how to install its framework, where that is missing."""
    try:
        optional_package(name)
    except ImportError as error:
        raise SystemExit(str(error)) from None


def python_of(name: Literal["pipelines", "nuscenes"]) -> Path:
    """The interpreter of a family's environment, which is built where it is missing: 65 and 560 MB, a minute.

    Raises:
        subprocess.CalledProcessError: venv or pip failed; their words stand on stderr.
    """
    family = FAMILIES[name]
    borrowed = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
    content = repr((family, sys.version, borrowed if family.borrows else ()))
    cache = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "arbiview_aug"
    folder = cache / f"{name}-{hashlib.sha256(content.encode()).hexdigest()[:16]}"
    python = folder / "bin" / "python"
    if (folder / _MADE).is_file():
        return python
    subprocess.run([sys.executable, "-m", "venv", "--clear", str(folder)], check=True)
    pip = [str(python), "-m", "pip", "install", "--quiet", "--retries", "10", "--disable-pip-version-check"]
    subprocess.run([*pip, *(["--no-deps"] if family.borrows else []), *family.requirements], check=True)
    if family.borrows:
        (site,) = folder.glob("lib/python*/site-packages")
        (site / "borrowed.pth").write_text("\n".join(borrowed) + "\n")
    (folder / _MADE).write_text(content)
    return python
