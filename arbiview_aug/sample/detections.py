"""Image boxes of a sample's objects, which give stage 3 of ``quality="paper"`` its object types."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.favs.stage3_objects import Detection
from arbiview_aug.sample.boxes_2d import outline
from arbiview_aug.sample.inputs import Frame, numbers, read_scenes

UNNAMED_TYPE = "upright"  # type of labelled boxes without names
OfCameras = Mapping[int, Sequence[Detection]]  # the detections of a frame, by the index of its camera


def detections_of_frames(
    sample: Mapping[str, Any], frames: Sequence[Frame], lead: tuple[int, ...]
) -> Sequence[OfCameras]:
    """The detections of each frame: the sample's ``detections``, else its ``boxes_3d`` projected into its cameras.

    ``detections``: for each camera ``{"boxes": (n, 4), "labels": [n names]}``, boxes x0 y0 x1 y1 in source pixels;
    in a batch, such a list for each frame. ``box_names``: a name for each of the ``boxes_3d``, ``upright`` by default;
    in a batch, a list for each frame.
    """
    if (given := sample.get("detections")) is not None:
        of_frames = _entries("detections", given, len(frames), "frames") if lead else [given]
        return [_of_cameras(found, frame) for found, frame in zip(of_frames, frames, strict=True)]
    if sample.get("boxes_3d") is None:
        return [{} for _ in frames]
    scenes, names = read_scenes(sample, frames, lead, "objects"), sample.get("box_names")
    names_of = [names] if not lead or names is None else _entries("box_names", names, len(frames), "frames")
    names_of = names_of * (len(frames) // len(names_of))
    found = []
    for frame, scene, of_frame in zip(frames, scenes, names_of, strict=True):
        assert scene.boxes is not None
        count = len(scene.boxes)
        kinds = [UNNAMED_TYPE] * count if of_frame is None else _names("box_names", of_frame, count)
        found.append({k: _projected(camera, scene.boxes, kinds) for k, camera in enumerate(frame.rig)})
    return found


def _of_cameras(given: Any, frame: Frame) -> OfCameras:
    of_cameras = {}
    for k, entry in enumerate(_entries("detections", given, len(frame.rig), "cameras")):
        where = f"detections[{k}]"
        if not isinstance(entry, Mapping) or not {"boxes", "labels"} <= entry.keys():
            got = ", ".join(map(str, entry)) if isinstance(entry, Mapping) else type(entry).__name__
            raise SampleTypeError(f"{where}: expected a dict with 'boxes' (n, 4) and 'labels', got {got}")
        array = numbers(f"{where}['boxes']", entry["boxes"])
        array = array.reshape(0, 4) if array.size == 0 else array
        if array.ndim != 2 or array.shape[1] != 4:
            raise SampleError(f"{where}: expected boxes (n, 4): x0 y0 x1 y1 in source pixels, got {array.shape}")
        if not np.isfinite(array).all() or (array[:, :2] > array[:, 2:]).any():
            raise SampleError(f"{where}: expected finite boxes with x0 <= x1 and y0 <= y1, got {array.tolist()}")
        kinds = _names(f"{where}['labels']", entry["labels"], len(array))
        of_cameras[k] = [Detection(tuple(box), kind) for box, kind in zip(array.tolist(), kinds, strict=True)]
    return of_cameras


def _entries(key: str, value: Any, count: int, of_what: str) -> list[Any]:
    if not isinstance(value, list | tuple):
        raise SampleTypeError(f"{key}: expected a list of {count}, one for each of the {of_what}, got {type(value)}")
    if len(value) != count:
        raise SampleError(f"{key}: expected one for each of the {count} {of_what}, got {len(value)}")
    return list(value)


def _names(key: str, value: Any, count: int) -> list[str]:
    names = _entries(key, value, count, "boxes")
    if not all(isinstance(name, str) for name in names):
        raise SampleTypeError(f"{key}: expected names such as 'vehicle', got {names[:3]}; look them up in your classes")
    return names


def _projected(camera: Camera, boxes: FloatArray, kinds: Sequence[str]) -> list[Detection]:
    """Image boxes of (B, 7) boxes in the ego frame, cut at the image's border."""
    outlines = [(outline(camera, box), kind) for box, kind in zip(boxes, kinds, strict=True)]
    return [Detection(tuple(seen.inside.tolist()), kind) for seen, kind in outlines if seen is not None]
