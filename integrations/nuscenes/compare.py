"""Annotations as nuscenes-devkit projects them, and as samples of this package do."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig

_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
_MARGIN = 1.0
"""Share of the image size: boxes farther outside are not compared, since a pixel there is next to nothing in angle."""


def devkit_boxes(python: Path, root: Path, version: str, output: Path) -> list[dict[str, Any]]:
    """Boxes that the devkit gives for a data set and version, by an interpreter that has it, through a file."""
    script = Path(__file__).with_name("devkit_boxes.py")
    subprocess.run([str(python), str(script), str(root), version, str(output)], check=True, timeout=500)
    found: list[dict[str, Any]] = json.loads(output.read_text())
    return found


def apart_px(
    entries: list[dict[str, Any]],
    sample_of: Callable[[str], Mapping[str, Any]],
    rig_of: Callable[[Mapping[str, Any]], Rig] = lambda sample: sample["rig"],
) -> FloatArray:
    """(n, 2) distances of the devkit's boxes from those of samples; printed.

    Of each box the distance of the centres, and the largest from a corner of the one to the nearest of the other.

    Args:
        entries: Entries of ``devkit_boxes``.
        sample_of: The sample of a token, with ``boxes_3d`` and ``box_tokens``.
        rig_of: Its cameras, by the devkit's channels.
    """
    found = []
    samples: dict[str, Mapping[str, Any]] = {}
    for entry in entries:
        sample = samples.setdefault(entry["sample"], sample_of(entry["sample"]))
        camera = rig_of(sample)[entry["channel"]]
        box = sample["boxes_3d"][sample["box_tokens"].index(entry["box"])].double().numpy()
        theirs = np.array(entry["pixels"])
        size = np.array(camera.size[::-1])
        if (theirs.min(0) < -_MARGIN * size).any() or (theirs.max(0) > (1 + _MARGIN) * size).any():
            continue
        c, s = np.cos(box[6]), np.sin(box[6])
        points = (_CORNERS * box[3:6]) @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]) + box[:3]
        ours = camera.project(np.vstack([box[:3], points])).uv
        apart = np.linalg.norm(ours[1:, None] - theirs[None, 1:], axis=-1)
        corners = max(apart.min(axis=0).max(), apart.min(axis=1).max())
        found.append((np.linalg.norm(ours[0] - theirs[0]), corners))
    distances = np.array(found).reshape(-1, 2)
    print(f"{len(found)} boxes in images: centres and corners within {distances.max(0, initial=0).round(3)} px")
    return distances
