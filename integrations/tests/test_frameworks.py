"""Every integration where its framework is: examples in the environments of ``integrations.environments``."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from integrations.environments import python_of

ROOT = Path(__file__).parents[2]
EXAMPLES = ("kornia", "lightning", "mmdet3d", "nuscenes", "openpcdet", "webdataset")


def test_every_folder_has_readme_and_example() -> None:
    for name in EXAMPLES:
        folder = ROOT / "integrations" / name
        assert f"integrations.{name}.example" in (folder / "README.md").read_text()
        assert (folder / "example.py").is_file()


def test_frameworks_are_imported_where_they_are_used(tmp_path: Path) -> None:
    """Importing the adapter of mmdet3d registers the step, as ``custom_imports`` does, where mmengine is installed."""
    registry = tmp_path / "mmengine" / "registry.py"
    registry.parent.mkdir()
    (registry.parent / "__init__.py").write_text("")
    registry.write_text(
        "class TRANSFORMS:\n    def register_module(name, force, module): print(name, module.__module__)\n"
    )
    code = (
        "import sys, arbiview_aug\n"
        "from arbiview_aug.integrations import kornia, mmdet3d\n"
        "mmdet3d.RigRetargetMultiView, mmdet3d.register\n"
        "import importlib; sys.path.insert(0, sys.argv[1]); importlib.reload(mmdet3d)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, capture_output=True, text=True, timeout=500, check=True
    )
    assert done.stdout.splitlines() == ["RigRetargetMultiView arbiview_aug.integrations.mmdet3d.transform"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lightning", "webdataset"])
def test_examples_check_their_framework_first(name: str) -> None:
    code = f"import runpy, sys; sys.modules[{name!r}] = None; runpy.run_module(sys.argv[1], run_name='__main__')"
    command = [sys.executable, "-c", code, f"integrations.{name}.example"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=500)
    assert (done.returncode, done.stderr) == (1, f"{name} is not installed: pip install {name}\n")


@pytest.mark.integrations
@pytest.mark.parametrize("name", EXAMPLES)
def test_example(name: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [str(python_of("pipelines")), "-m", f"integrations.{name}.example"]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-4000:]
    assert name != "mmdet3d" or done.stdout.startswith("mmengine.dataset.Compose")
