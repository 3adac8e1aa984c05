"""Photographs from displaced cameras as truth: a frame's ``truth`` camera, or the cameras of the next frame."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.datasets.depth_folder import WithDepth
from arbiview_aug.datasets.frame_folder import FrameFolder
from arbiview_aug.errors import DataError, warn
from arbiview_aug.evaluate.frames import Photographs, ScoredFrame
from arbiview_aug.evaluate.images import RenderedView, as_arrays
from arbiview_aug.evaluate.methods import Method
from arbiview_aug.evaluate.targets import without_masks
from arbiview_aug.sample.frame import Frame, Neighbour
from arbiview_aug.sample.inputs import LEARNED_KEY, read_frames
from arbiview_aug.sample.neighbours import STILL_M
from arbiview_aug.temporal.motion_depth import without_objects

MOST_APART_S = 2.0
"""Longest time to the photograph that is the truth: a vehicle that stands waits longer, and traffic has gone on."""


def displaced_frames(
    data: Any, indices: Iterable[int], next_frame: Mapping[str, Any] | None
) -> Iterator[tuple[str, ScoredFrame]]:
    """Name and frame of those samples at ``indices`` that have photographs; methods get all that a sample has.

    The truth is a ``FrameFolder``'s ``truth`` camera; else ``next_frame``, or the nearest neighbour recorded later.
    Samples without one are left out; DataError says why if there is no other.
    """
    problems, found = list[str](), False
    for index in indices:
        sample, truth = data[index], None
        recorded = data.dataset if isinstance(data, WithDepth) else data
        if next_frame is None and isinstance(recorded, FrameFolder):
            truth = recorded.truth(index)
        if truth is not None:
            photographs = _photographs(truth["rig"], truth["images"])
        else:
            found_later = later_neighbour(sample, next_frame, problems)
            if found_later is None:
                continue
            frame, later, others = found_later
            moved = later.labelled if later.moved is None else later.moved
            rig = later.rig.with_cameras([without_objects(camera, moved) for camera in later.rig])
            photographs = _photographs(rig, later.images(frame.images))
            sample = {**sample, **({"neighbours": others} if others else {})}
        name = str(sample.get("token", index))
        yield name, ScoredFrame(sample, truth=photographs.of_rig, target=photographs.rig)
        found = True
    if problems and not found:
        raise DataError(problems[0])


def later_neighbour(
    sample: Mapping[str, Any], next_frame: Mapping[str, Any] | None, problems: list[str]
) -> tuple[Frame, Neighbour, list[Any]] | None:
    """A sample's frame, ``next_frame`` or else the nearest neighbour recorded later, and the neighbours elsewhere.

    None if there is no such frame, or the vehicle stands so long that it comes more than ``MOST_APART_S`` later. What
    was wrong goes to ``problems``.
    """
    entries = [*([] if next_frame is None else [next_frame]), *(sample.get("neighbours") or [])]
    with_others = {**sample, "neighbours": entries}
    (frame,) = read_frames(with_others, None, further=("neighbours",), warn=lambda _, message: problems.append(message))
    neighbours = frame.neighbours or ()
    later = next((one for one in neighbours if one.is_later and (next_frame is None or one.number == 0)), None)
    if later is None:
        return None
    if next_frame is None and (later.seconds or 0.0) > MOST_APART_S:
        problems.append(
            f"--displaced: frame {str(sample.get('token', ''))!r} is left out, since its vehicle stands: the next "
            f"frame from elsewhere is {later.seconds:.1f} s later"
        )
        warn(problems[-1])
        return None
    apart_m = {one.number: np.linalg.norm((one.ego2ego - later.ego2ego)[:3, 3]) for one in neighbours}
    return frame, later, [entry for k, entry in enumerate(entries) if apart_m.get(k, np.inf) > STILL_M]


def _photographs(rig: Rig, images: Any) -> Photographs:
    """Photographs whose masked pixels do not score."""
    valid = [np.ones(camera.size, bool) if camera.mask is None else camera.mask for camera in rig]
    return Photographs(without_masks(rig), images, valid)


def _copy(sample: Mapping[str, Any], target: Rig) -> list[RenderedView]:
    """Copy the source image of the same name, else of the nearest direction."""
    rig: Rig = sample["rig"]
    images, views = as_arrays(sample["images"]), []
    for camera in target:
        image: Any = cv2.resize(images[own_index(rig, camera)], camera.size[::-1], interpolation=cv2.INTER_AREA)
        views.append(RenderedView(image, np.ones(camera.size, bool)))
    return views


def own_index(source: Rig, camera: Camera) -> int:
    """Index of the source camera of the same name, or else of the nearest direction."""
    nearest = int(np.argmax(source.cam2ego[:, :3, 2] @ camera.cam2ego[:3, 2]))
    return source.names.index(camera.name) if camera.name in source.names else nearest


COPY = Method("copy", _copy)
"""The source image itself."""


def surfaces_for(sample: Mapping[str, Any]) -> list[GeometryName]:
    """Surfaces that a sample has the geometry for, from the least to the most."""
    names: list[GeometryName] = ["ground", "street"]
    names += ["boxes"] if sample.get("boxes_3d") is not None else []
    names += ["learned"] if sample.get(LEARNED_KEY) is not None else []
    measured: list[GeometryName] = ["lidar"] if sample.get("points") is not None else []
    return names + measured + ((["motion", "fused"] if measured else ["motion"]) if sample.get("neighbours") else [])
