"""The repository's style in numbers: ``python -m tests.house``. What no test of behaviour should fail for."""

from __future__ import annotations

import inspect
import re
import subprocess
import sys
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import replace
from types import FrameType
from typing import Any

import arbiview_aug
from arbiview_aug import RigRetarget, load_rig
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive
from tests.test_docs import DOCS, ROOT, tables, text_of
from tests.test_imports import PACKAGE

README = ROOT / "README.md"
ORDER = ("Install", "Use", "When to use it, and when not", "Commands", "Limits", "In numbers", "Documentation")


def measures() -> Iterator[tuple[str, int, int]]:
    """What is counted, how much there is, and the most that there may be."""
    yield "README: lines", len(text_of(README).splitlines()), 150
    yield "README: words", len(text_of(README).split()), 1500
    headings = re.findall(r"^## (.+)$", text_of(README), re.MULTILINE)
    yield "README: sections out of order", headings != [*ORDER, "Citation", "Licence"], 0
    yield "README: pictures", text_of(README).count("!["), 1
    pictures = [picture.stat().st_size for picture in (ROOT / "docs" / "images").iterdir()]
    yield "bytes of the largest picture", max(pictures), 300_000
    yield "bytes of all pictures", sum(pictures), 1_100_000
    for page in (README, *DOCS):
        text = re.sub(r"<!-- (\w+)\b.*?<!-- /\1 -->", "", text_of(page), flags=re.DOTALL)  # generated ones
        cells = (cell for table in tables(text) for row in table for cell in row)
        yield (
            f"{page.name}: table cells of two sentences",
            sum(bool(re.search(r"[a-z`)][.] [A-Z`]", c)) for c in cells),
            0,
        )
    yield "folders of the package", sum(any(path.glob("*.py")) for path in PACKAGE.iterdir() if path.is_dir()), 13
    yield "files at the top of the package", len(list(PACKAGE.glob("*.py"))), 10
    code = "import sys, arbiview_aug.transforms.rig_retarget; print(*(m for m in sys.modules if m[:8] == 'arbiview'))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    yield "modules that importing RigRetarget loads", len(done.stdout.split()), 62
    yield "of these the paper's stages", done.stdout.count("favs."), 0
    parameters = inspect.signature(arbiview_aug.RigRetarget).parameters.values()
    yield "settings of RigRetarget", sum(parameter.kind is parameter.KEYWORD_ONLY for parameter in parameters), 12
    yield "lines of its docstring", len((inspect.getdoc(arbiview_aug.RigRetarget) or "").splitlines()), 50
    yield "lines of its constructor", len(inspect.getsource(arbiview_aug.RigRetarget.__init__).splitlines()), 40


def traced(retarget: RigRetarget, sample: Mapping[str, Any]) -> tuple[int, int]:
    """Files that a call touches, and Python calls from a function in one of them to a function in another one."""
    files, crossings = set[str](), 0

    def profile(frame: FrameType, event: str, _: Any) -> None:
        nonlocal crossings
        to, caller = frame.f_code.co_filename, frame.f_back
        if event == "call" and to.startswith(str(PACKAGE)):
            files.add(to)
            crossings += caller is not None and to != caller.f_code.co_filename in files

    sys.setprofile(profile)
    try:
        retarget(sample)
    finally:
        sys.setprofile(None)
    return len(files), crossings


def calls() -> Iterator[tuple[str, int, int]]:
    """``traced`` calls of each kind, with warm caches but for what every frame brings."""
    rig = load_rig("nuscenes").undistorted().resized((90, 160))
    drive = SyntheticDrive(rig, num_frames=3, neighbours=Neighbours(count=1, step_m=1.2))[1]
    bare = {key: drive[key] for key in ("images", "rig")}
    boxes = {**bare, "points": drive["points"], "boxes_3d": drive["boxes_3d"]}
    target = replace(load_rig("argoverse2").undistorted().resized((64, 96)), lidars=())
    for name, settings, sample, *most in (
        ("street", {}, bare, 20, 60),
        ("LiDAR and boxes", {}, boxes, 32, 550),
        ("motion", {"geometry": "motion"}, bare | {"neighbours": drive["neighbours"]}, 32, 350),
        ("paper", {"quality": "paper"}, bare, 23, 200),
    ):
        retarget = RigRetarget(target, **settings)
        retarget(sample)
        moved = {"points": sample["points"] + 0.01} if "points" in sample else {}  # which needs a new plan
        for what, count, bound in zip(("files", "crossings"), traced(retarget, {**sample, **moved}), most, strict=True):
            yield f"a call over {name}: {what}", count, bound


def main() -> int:
    """Print all; 1 if one is beyond its bound."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows = [*measures(), *calls()]
    for what, count, most in rows:
        print(f"{what}: {count:d} of {most}{'  <--' if count > most else ''}")
    return int(any(count > most for _, count, most in rows))


if __name__ == "__main__":
    raise SystemExit(main())
