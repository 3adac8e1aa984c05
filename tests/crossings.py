"""Files touched and file-border crossings of one ``RigRetarget`` call: ``python -m tests.crossings``.

A crossing is a Python call from a function in one file of the package to a function in another one.
"""

from __future__ import annotations

import sys
import warnings
from collections import Counter
from pathlib import Path
from types import FrameType
from typing import Any

import arbiview_aug
from arbiview_aug import RigRetarget, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive

PACKAGE = str(Path(arbiview_aug.__file__).parent)
BOUNDS = {"street, plan held": (15, 47), "LiDAR + boxes": (35, 1700), "paper": (19, 130)}
"""Most files and crossings that a call may have; one file estimates exposures. Aims: (10, 50), (20, 500), (12, 150)."""


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
    """A tracer for each kind of call, with warm caches."""
    sample = SyntheticDrive(load_rig("nuscenes").undistorted().resized((90, 160)), num_frames=1)[0]
    bare = {key: value for key, value in sample.items() if key not in ("points", "boxes_3d")}
    target = load_rig("argoverse2").undistorted().resized((64, 96))
    calls = {
        "street, plan held": (RigRetarget(target), bare),
        "LiDAR + boxes": (RigRetarget(target), sample),
        "paper": (RigRetarget(target, quality="paper"), bare),
    }
    found = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name, (retarget, given) in calls.items():
            retarget(given)
            again = given | {"points": given["points"] + 0.01} if "points" in given else given  # needs a new plan
            with Tracer() as found[name]:
                retarget(again)
    return found


def main() -> int:
    """Print the figures and the busiest borders; 1 where a bound is passed."""
    failed = False
    for name, tracer in traced_calls().items():
        most_files, most_crossings = BOUNDS[name]
        files, crossings = len(tracer.files), sum(tracer.crossings.values())
        failed |= files > most_files or crossings > most_crossings
        print(f"{name}: {files} files of at most {most_files}, {crossings} crossings of at most {most_crossings}")
        for (one, two), count in tracer.crossings.most_common(60 if "-v" in sys.argv else 0):
            print(f"  {count:6} {one[len(PACKAGE) + 1 :]} -> {two[len(PACKAGE) + 1 :]}")
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
