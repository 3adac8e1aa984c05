"""The house: imports point upward only, and importing the package costs what torch costs and little more."""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "arbiview_aug"

LAYERS: list[tuple[str, ...]] = [
    ("errors", "environment", "held"),
    ("files", "offline"),
    ("lens",),
    ("rotations",),
    ("calibration",),
    ("framing", "keys"),
    ("camera",),
    ("rig",),
    ("surface", "grid", "overlaps", "tone", "command_line"),
    ("solids", "refined", "panorama"),
    ("objects",),
    ("measured", "moved"),
    ("lidar",),
    ("scene",),
    ("sampling", "merging"),
    ("favs.config", "favs.geometric_transformation", "favs.adaptive_fusion", "favs.dense_flow"),
    ("favs.feature_matching",),
    ("favs.object_alignment",),
    ("favs.paper",),
    ("dense",),
    ("projection",),
    ("required",),
    ("target_rays", "target_view"),
    ("shadowing",),
    ("maps",),
    ("favs.photometric", "confidence"),
    ("favs.overlap_depth",),
    ("favs.refinement",),
    ("target_plan",),
    ("plan",),
    ("device_maps",),
    ("favs.synthesis",),
    ("motion.sweep", "motion.aggregation"),
    ("motion.poses",),
    ("tensors", "sample_images", "random_rig", "inpainting"),
    ("sample",),
    ("boxes_2d",),
    ("labels", "detections", "neighbours"),
    ("fills", "holes", "motion.depth"),
    ("explain", "view_entries"),
    ("stitching",),
    ("generator",),
    ("transform_settings",),
    ("datasets", "resizing", "transforms"),
    ("evaluate",),
    ("bench", "convert", "demo", "depth", "inspect", "train"),
    ("__main__",),
]
"""From the ground up: a module imports from layers below its own; the modules of one name, or folder, among themselves.

``arbiview_aug/__init__`` gathers the public face and stands above all. What is imported within functions counts too.
"""

HEAVY = (
    "diffusers",
    "safetensors",
    "torchvision",
    "sklearn",
    "kornia",
    "scipy",
    "matplotlib",
    "PIL",
    "ray",
    "accelerate",
)
LIMIT_S = 0.4


def modules() -> dict[str, Path]:
    """Dotted names below the package; a package's ``__init__`` goes by the package's name."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(part for part in parts if part != "__init__")
        if name:
            found[name] = path
    return found


def layer(name: str) -> int | None:
    """The layer of a module: that of its longest listed prefix."""
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        prefix = ".".join(parts[:length])
        for k, names in enumerate(LAYERS):
            if prefix in names:
                return k
    return None


def imports(path: Path, known: dict[str, Path]) -> set[str]:
    """The package's modules that a file imports, wherever in the file."""
    found = set()
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
                found.add(below)
    return found


def unit(name: str) -> str:
    """What may import within itself: a folder that is one entry of ``LAYERS``, or a module."""
    listed = {entry for names in LAYERS for entry in names}
    top = name.split(".")[0]
    return top if top in listed else name


def test_imports_point_upward_only() -> None:
    known = modules()
    wrong = []
    for name, path in known.items():
        if name in ("favs", "motion"):  # an empty ``__init__``
            assert not imports(path, known)
            continue
        own = layer(name)
        if own is None:
            wrong.append(f"{name} has no place in LAYERS")
            continue
        for other in imports(path, known) - {name, "favs", "motion"}:
            if unit(other) == unit(name):
                continue
            above = layer(other)
            if above is None or above >= own:
                wrong.append(f"{name} imports {other}, which is not below it")
    assert not wrong, "\n".join(wrong)


def test_every_layer_is_in_order_of_use() -> None:
    """The list says no more than there is, but for the parts that are to come."""
    known = modules()
    to_come = {"demo", "grid"}
    for names in LAYERS:
        for name in names:
            assert name in known or name in to_come, name


def test_importing_loads_nothing_heavy() -> None:
    code = (
        "import sys, torch; had = set(sys.modules)\n"
        "import arbiview_aug, arbiview_aug.datasets.synthetic, arbiview_aug.generator, arbiview_aug.train.command\n"
        f"print([m for m in {HEAVY} if m in sys.modules and m not in had])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=500, check=True)
    assert done.stdout.strip() == "[]"


@pytest.mark.release
def test_importing_costs_little_more_than_torch(tmp_path: Path, report_bound: Callable[..., None]) -> None:
    """Processor time after ``import torch``, the best of five: a busy machine only adds to it."""
    code = "import time, torch; start = time.process_time(); import arbiview_aug; print(time.process_time() - start)"
    # Compiled once, as after any first import: not where the environment forbids that.
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONDONTWRITEBYTECODE"}
    environment["PYTHONPYCACHEPREFIX"] = str(tmp_path)
    command = [sys.executable, "-c", code]
    runs = [subprocess.run(command, capture_output=True, timeout=500, check=True, env=environment) for _ in range(5)]
    report_bound("s of CPU, import arbiview_aug after torch", min(float(run.stdout) for run in runs), at_most=LIMIT_S)
