"""The house: imports point upward only, and importing the package costs what torch costs and little more."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "arbiview_aug"

ROOMS = (
    *("choices", "errors", "environment", "files", "lru_cache", "atomic_io", "image_ops"),
    *("cameras", "scene", "sample", "render", "favs", "temporal", "inpaint", "generator", "transforms", "datasets"),
    *("evaluate", "cli", "generator.training", "__main__", "train", "integrations"),
)
"""From the ground up: a module imports from its own room and from those before it, within functions too.

``arbiview_aug/__init__`` gathers the public names and stands above all. The trainer is a room of its own inside the
generator's folder: it reads data sets and scores, which the generator does not know of.
"""

HEAVY = (
    *("arbiview_aug.cameras.formats.calibration", "numba", "diffusers", "safetensors", "torchvision", "sklearn"),
    *("kornia", "scipy", "matplotlib", "PIL", "ray", "accelerate", "transformers"),
)


def modules() -> dict[str, Path]:
    """Dotted names below the package; a package's ``__init__`` goes by the package's name."""
    paths = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__init__")
        if name:
            paths[name] = path
    return paths


def room(name: str) -> str:
    """The room of a module: its longest listed prefix."""
    return max((entry for entry in ROOMS if name == entry or name.startswith(f"{entry}.")), key=len, default="none")


def imports(path: Path, known: dict[str, Path]) -> set[str]:
    """The package's modules that a file imports, wherever in the file."""
    imported = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path.name}: a relative import"
            names = [f"{node.module}.{alias.name}" for alias in node.names] + [str(node.module)]
        else:
            continue
        for name in names:
            below = name.removeprefix("arbiview_aug.")
            if name.startswith("arbiview_aug.") and below in known:
                imported.add(below)
    return imported


def test_rooms_import_from_those_before_them() -> None:
    known, wrong = modules(), []
    assert not [name for name in known if room(name) == "none"]
    for name, path in known.items():
        for other in imports(path, known) - {name}:
            if ROOMS.index(room(other)) > ROOMS.index(room(name)):
                wrong.append(f"{name} imports {other}, whose room comes later")
    assert not wrong, "\n".join(wrong)


def test_no_module_imports_itself_through_others() -> None:
    known = modules()
    graph = {name: imports(path, known) - {name} for name, path in known.items() if path.name != "__init__.py"}
    done: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, f"a cycle: {' -> '.join((*path[path.index(name) :], name))}"
        if name in done:
            return
        for other in sorted(graph[name] & graph.keys()):
            visit(other, (*path, name))
        done.add(name)

    for name in sorted(graph):
        visit(name, ())


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, torch; had = set(sys.modules)\n"
        "from arbiview_aug import *; import arbiview_aug.datasets.synthetic, arbiview_aug.generator\n"
        "import arbiview_aug.generator.training.trainer\n"
        f"print([m for m in {HEAVY} if m in sys.modules and m not in had])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=500, check=True)
    assert done.stdout.strip() == "[]"
