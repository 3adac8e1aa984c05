"""Photographs from displaced cameras as truth: a frame's ``truth`` camera, or the cameras of the next frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from arbiview_aug.choices import GeometryName
from arbiview_aug.datasets.depth_folder import WithDepth
from arbiview_aug.datasets.frame_folder import FrameFolder
from arbiview_aug.errors import DataError, warn
from arbiview_aug.evaluate.frames import ScoredFrame, photographed
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.sample.frame import Frame, Neighbour
from arbiview_aug.sample.inputs import LEARNED_KEY, read_frames
from arbiview_aug.sample.neighbours import STILL_M
from arbiview_aug.temporal.motion_depth import without_objects

MOST_APART_S = 2.0
"""Longest time to the photograph that is the truth: a vehicle that stands waits longer, and traffic has gone on."""

NOT_DISPLACED = (
    "--displaced: expected a 'truth' camera in calib.json, or a later frame of the drive (sequence.json and "
    "ego2world), found none; see docs/formats.md"
)


def displaced_frames(data: Any, indices: Iterable[int]) -> Iterator[tuple[str, ScoredFrame]]:
    """Name and frame of those samples at ``indices`` that have photographs; DataError if none has.

    The truth is a ``FrameFolder``'s ``truth`` camera, else the nearest neighbour recorded later.
    """
    problems, found = list[str](), False
    recorded = data.dataset if isinstance(data, WithDepth) else data
    for index in indices:
        sample = data[index]
        truth = recorded.truth(index) if isinstance(recorded, FrameFolder) else None
        if truth is not None:
            frame = photographed(sample, truth["rig"], as_arrays(truth["images"]))
        elif found_later := later_neighbour(sample, problems):
            given, later, others = found_later
            moved = later.labelled if later.moved is None else later.moved
            rig = later.rig.with_cameras([without_objects(camera, moved) for camera in later.rig])
            sample = {**sample, **({"neighbours": others} if others else {})}
            frame = photographed(sample, rig, as_arrays(later.images(given.images)))
        else:
            continue
        found = True
        yield str(sample.get("token", index)), frame
    if not found:
        raise DataError(problems[0] if problems else NOT_DISPLACED)


def later_neighbour(sample: Mapping[str, Any], problems: list[str]) -> tuple[Frame, Neighbour, list[Any]] | None:
    """A sample's frame, the nearest neighbour recorded at most ``MOST_APART_S`` later, and the neighbours elsewhere.

    None if there is no such frame; what was wrong goes to ``problems``.
    """
    (frame,) = read_frames(sample, None, further=("neighbours",), warn=lambda _, message: problems.append(message))
    neighbours = frame.neighbours or ()
    later = next((neighbour for neighbour in neighbours if neighbour.is_later), None)
    if later is None:
        return None
    if (later.seconds or 0.0) > MOST_APART_S:
        problems.append(
            f"--displaced: frame {str(sample.get('token', ''))!r} is left out, since its vehicle stands: the next "
            f"frame from elsewhere is {later.seconds:.1f} s later"
        )
        warn(problems[-1])
        return None
    apart_m = {one.number: np.linalg.norm((one.ego2ego - later.ego2ego)[:3, 3]) for one in neighbours}
    others = [entry for k, entry in enumerate(sample["neighbours"]) if apart_m.get(k, np.inf) > STILL_M]
    return frame, later, others


def surfaces_for(sample: Mapping[str, Any]) -> list[GeometryName]:
    """Surfaces that a sample has the geometry for, from the least to the most."""
    names: list[GeometryName] = ["ground", "street"]
    names += ["boxes"] if sample.get("boxes_3d") is not None else []
    names += ["learned"] if sample.get(LEARNED_KEY) is not None else []
    measured: list[GeometryName] = ["lidar"] if sample.get("points") is not None else []
    return names + measured + ((["motion", "fused"] if measured else ["motion"]) if sample.get("neighbours") else [])
