"""Annotations as nuscenes-devkit projects them, and as samples of this package do."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig

_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
_MARGIN = 1.0
"""Share of the image size: boxes farther outside are not compared, since a pixel there is next to nothing in angle."""


@dataclass(frozen=True)
class Agreement:
    """How far apart two projections of the same boxes are.

    Attributes:
        centers_px: (n,) distances of their centres.
        corners_px: (n,) of each box the largest distance from a corner of the one to the nearest of the other.
    """

    centers_px: FloatArray
    corners_px: FloatArray

    def __str__(self) -> str:
        return (
            f"{len(self.centers_px)} boxes in images: centres within {self.centers_px.max(initial=0):.3g} px, "
            f"corners within {self.corners_px.max(initial=0):.3g} px (median {np.median(self.corners_px):.2g})"
        )


def devkit_boxes(python: Path, root: Path, version: str, output: Path) -> list[dict[str, Any]]:
    """Boxes that the devkit gives for a data set.

    Args:
        python: An interpreter that has the devkit.
        root: The data set.
        version: Its folder of tables.
        output: A file to write.
    """
    script = Path(__file__).with_name("devkit_boxes.py")
    subprocess.run([str(python), str(script), str(root), version, str(output)], check=True, timeout=500)
    found: list[dict[str, Any]] = json.loads(output.read_text())
    return found


def agreement(
    entries: list[dict[str, Any]],
    sample_of: Callable[[str], Mapping[str, Any]],
    rig_of: Callable[[Mapping[str, Any]], Rig] = lambda sample: sample["rig"],
) -> Agreement:
    """Compare the devkit's boxes with those of samples.

    Args:
        entries: Entries of ``devkit_boxes``.
        sample_of: The sample of a token, with ``boxes_3d`` and ``box_tokens``.
        rig_of: Its cameras, by the devkit's channels.
    """
    centers, corners = [], []
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
        centers.append(np.linalg.norm(ours[0] - theirs[0]))
        apart = np.linalg.norm(ours[1:, None] - theirs[None, 1:], axis=-1)
        corners.append(max(apart.min(axis=0).max(), apart.min(axis=1).max()))
    return Agreement(np.array(centers), np.array(corners))
