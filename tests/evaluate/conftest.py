"""The evaluation protocol in code."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def referee(data_root: Path) -> ModuleType:
    """The protocol that ``evaluate`` must agree with; the test is skipped where it is missing."""
    path = data_root.parent / "referee.py"
    if not path.is_file():
        pytest.skip(f"no evaluation protocol {path}: it lies beside the data folder")
    spec = importlib.util.spec_from_file_location("referee", path)
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
