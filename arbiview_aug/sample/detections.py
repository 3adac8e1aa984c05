"""Image boxes of a sample's objects, which give stage 3 of ``quality="paper"`` its object types."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from arbiview_aug.errors import SampleError, SampleTypeError
from arbiview_aug.sample.boxes_2d import outline
from arbiview_aug.sample.calibration import as_array, numbers
from arbiview_aug.sample.frame import Frame
from arbiview_aug.scene.boxes import checked_boxes


@dataclass(frozen=True)
class Detection:
    """Detector's box in a source image, from which objects take their type."""

    box: tuple[float, float, float, float]  # (x0, y0, x1, y1) in source pixels
    type: str  # class name, weighted by ``PaperConfig.type_weights``


UNNAMED_TYPE = "upright"  # type of labelled boxes without names
OfCameras = Mapping[int, Sequence[Detection]]  # the detections of a frame, by the index of its camera


def read_detections(frame: Frame) -> OfCameras:
    """The sample's ``detections`` of a frame, else its ``boxes_3d`` projected into the cameras.

    ``detections``: for each camera ``{"boxes": (n, 4), "labels": [n names]}``, boxes x0 y0 x1 y1 in source pixels;
    in a batch, such a list for each frame. ``box_names``: a name for each of the ``boxes_3d``, ``upright`` by default;
    in a batch, a list for each frame.
    """
    if "detections" in frame.further:
        return _of_cameras(frame.further["detections"], frame)
    if frame.boxes is None:
        return {}
    boxes = checked_boxes(as_array("boxes_3d", frame.boxes))
    names = _names("box_names", frame.further.get("box_names", [UNNAMED_TYPE] * len(boxes)), len(boxes))
    of_cameras = {}
    for k, camera in enumerate(frame.rig):
        outlines = [(outline(camera, box), name) for box, name in zip(boxes, names, strict=True)]
        of_cameras[k] = [Detection(tuple(seen.inside.tolist()), name) for seen, name in outlines if seen is not None]
    return of_cameras


def _of_cameras(detections: Any, frame: Frame) -> OfCameras:
    of_cameras = {}
    for k, entry in enumerate(_entries("detections", detections, len(frame.rig), "cameras")):
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
        expected = f"a list of {count}, one for each of the {of_what}"
        raise SampleTypeError(f"{key}: expected {expected}, got {type(value).__name__}")
    if len(value) != count:
        raise SampleError(f"{key}: expected one for each of the {count} {of_what}, got {len(value)}")
    return list(value)


def _names(key: str, value: Any, count: int) -> list[str]:
    names = _entries(key, value, count, "boxes")
    if not all(isinstance(name, str) for name in names):
        raise SampleTypeError(f"{key}: expected names such as 'vehicle', got {names[:3]}; look them up in your classes")
    return names
