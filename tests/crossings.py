"""Files touched and file-border crossings of one ``RigRetarget`` call: ``python -m tests.crossings``.

A crossing is a Python call from a function in one file of the package to a function in another one.
"""

from __future__ import annotations

import sys
import warnings
from collections import Counter
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import arbiview_aug
from arbiview_aug import RigRetarget, load_rig
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive

PACKAGE = str(Path(arbiview_aug.__file__).parent)


class Tracer:
    """Counts calls between files of the package while it is entered."""

    def __init__(self) -> None:
        self.files: set[str] = set()
        self.crossings: Counter[tuple[str, str]] = Counter()

    def _profile(self, frame: FrameType, event: str, _: Any) -> None:
        if event != "call":
            return
        to = frame.f_code.co_filename
        if not to.startswith(PACKAGE):
            return
        self.files.add(to)
        caller = frame.f_back
        if caller is not None and caller.f_code.co_filename.startswith(PACKAGE) and caller.f_code.co_filename != to:
            self.crossings[caller.f_code.co_filename, to] += 1

    def __enter__(self) -> Tracer:
        sys.setprofile(self._profile)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)


def traced_calls() -> dict[str, Tracer]:
    """A tracer for each kind of call, with warm caches but for what every frame brings anew."""
    rig = load_rig("nuscenes").undistorted().resized((90, 160))
    sample = SyntheticDrive(rig, num_frames=1)[0]
    drive = SyntheticDrive(rig, num_frames=3, neighbours=Neighbours(count=1, step_m=1.2))[1]
    bare = {key: value for key, value in sample.items() if key not in ("points", "boxes_3d")}
    unmeasured = {key: value for key, value in drive.items() if key != "points"}
    target = replace(load_rig("argoverse2").undistorted().resized((64, 96)), lidars=())
    calls = {
        "street, plan cached": (RigRetarget(target), bare),
        "LiDAR + boxes": (RigRetarget(target), sample),
        "motion": (RigRetarget(target, geometry="motion"), unmeasured),
        "paper": (RigRetarget(target, quality="paper"), bare),
    }
    tracers = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, (retarget, entries) in calls.items():
            retarget(entries)
            with Tracer() as tracers[name]:
                moved = {"points": entries["points"] + 0.01} if "points" in entries else {}  # which needs a new plan
                retarget({**entries, **moved})
    return tracers


if __name__ == "__main__":
    for name, tracer in traced_calls().items():
        print(f"{name}: {len(tracer.files)} files, {sum(tracer.crossings.values())} crossings")
        for (one, two), count in tracer.crossings.most_common(60 if "-v" in sys.argv else 0):
            print(f"  {count:6} {one[len(PACKAGE) + 1 :]} -> {two[len(PACKAGE) + 1 :]}")
