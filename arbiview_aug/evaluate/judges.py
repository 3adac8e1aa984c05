"""Networks that judge views: detectors and segmenters that were trained on photographs, as ``FILE.py:function``.

Detectors take an RGB image (H, W, 3) uint8 and return ``Detections``; segmenters return masks (n, H, W).
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.errors import DataError, one_line, shown
from arbiview_aug.evaluate.report.pictures import Picture


class Detections(NamedTuple):
    """Objects that a detector sees in an image.

    Attributes:
        boxes: (n, 4) float64 x0 y0 x1 y1 in pixels, within the image.
        scores: (n,) float64 in [0, 1].
    """

    boxes: FloatArray
    scores: FloatArray

    def subset(self, chosen: BoolArray) -> Detections:
        """The detections that a mask (n,) chooses."""
        return Detections(self.boxes[chosen], self.scores[chosen])


Detector = Callable[[Picture], Detections]
Segmenter = Callable[[Picture], BoolArray]

LEAST_SCORE = 0.05
"""Detections below it are left out: torchvision's default of Faster R-CNN, whatever the detector's."""

_WORDS = (
    *("person", "people", "pedestrian", "human", "rider", "cyclist", "bicyclist", "motorcyclist"),
    *("bicycle", "bike", "motorcycle", "motorbike", "vehicle", "car", "van", "truck", "lorry", "bus", "trailer"),
    *("wheelchair", "stroller", "signaler"),
)
_NO_ROAD_USERS = "static", "sign", "rack", "stop", "ego"
"""Words of names such as ``static_object.bicycle_rack``, ``bus stop`` and ``vehicle.ego``."""


def is_road_user(name: str) -> bool:
    """Whether a class name is of vehicles or people: COCO's ``car``, nuScenes' ``vehicle.car``, ``BOX_TRUCK``."""
    words = re.split(r"[^a-z]+", name.lower())
    return {*words}.isdisjoint(_NO_ROAD_USERS) and not {*words}.isdisjoint(_WORDS)


def load_detector(name: str) -> Detector:
    """Load the detector that ``--detector`` names.

    It returns the detections from ``LEAST_SCORE`` on that count, cut at the image's border: vehicles and people by
    name, and all numbers.

    Raises:
        DataError: No such function. Calls raise it for outputs that are not boxes (n, 4), scores (n,) and n labels, or
            boxes that are not finite and ordered.
    """
    option = f"--detector {name}"
    detect = _function(option, name)

    def detections_of(image: Picture) -> Detections:
        output = _called(option, detect, image)
        expected = f"{option}: expected boxes (n, 4) x0 y0 x1 y1, scores (n,) and n labels for an image {image.shape}"
        try:
            boxes, scores, labels = (np.asarray(_host(part)) for part in output)
            boxes, scores, labels = boxes.astype(np.float64), scores.astype(np.float64), labels.reshape(-1)
            texts = [str(int(label)) if np.issubdtype(labels.dtype, np.number) else str(label) for label in labels]
        except (TypeError, ValueError, RuntimeError, OverflowError) as error:
            raise DataError(f"{expected}, got other values: {error}") from None
        boxes = boxes.reshape(0, 4) if boxes.size == 0 else boxes
        if boxes.ndim != 2 or boxes.shape[1] != 4 or scores.shape != (len(boxes),) or len(labels) != len(boxes):
            raise DataError(f"{expected}, got {boxes.shape}, {scores.shape} and {len(labels)}")
        wrong = ~np.isfinite(boxes).all(axis=1) | (boxes[:, :2] > boxes[:, 2:]).any(axis=1)
        if wrong.any():
            raise DataError(f"{expected}: finite, with x0 <= x1 and y0 <= y1, got {boxes[wrong][0].tolist()}")
        if not ((scores >= 0) & (scores <= 1)).all():
            raise DataError(f"{expected}: scores from 0 to 1, got {shown(scores.tolist())}")
        counts = np.array([text.isdecimal() or is_road_user(text) for text in texts], bool)
        h, w = image.shape[:2]
        return Detections(boxes.clip(0, (w, h, w, h)), scores).subset(counts & (scores >= LEAST_SCORE))

    return detections_of


def load_segmenter(name: str) -> Segmenter:
    """Load the segmenter that ``--segmenter`` names; it returns masks (n, H, W) bool, one for each class.

    Raises:
        DataError: No such function; its calls raise it for outputs of other shapes.
    """
    option = f"--segmenter {name}"
    segment = _function(option, name)

    def masks_of(image: Picture) -> BoolArray:
        masks = _called(option, segment, image)
        try:
            array = np.asarray(_host(masks))
        except (TypeError, ValueError, RuntimeError):
            array = np.zeros(0)
        h, w = image.shape[:2]
        if not array.size or array.ndim != 3 or array.shape[1:] != (h, w) or not np.isin(array, (0, 1)).all():
            got = f"{array.dtype} {array.shape}" if array.shape and array.size else type(masks).__name__
            raise DataError(f"{option}: expected masks (n, {h}, {w}) of 0 and 1, got {got}")
        return array.astype(bool)

    return masks_of


def _host(part: Any) -> Any:
    return part.detach().cpu() if isinstance(part, torch.Tensor) else part


@contextmanager
def _foreign(text: str) -> Iterator[None]:
    """Turn what another's code raises into DataError with a text; SystemExit, too, which would end the command."""
    try:
        yield
    except KeyboardInterrupt:
        raise
    except BaseException as error:
        raise DataError(f"{text} raised {type(error).__name__}: {one_line(error)}") from error


def _function(option: str, name: str) -> Callable[[Picture], Any]:
    """Import the function that ``FILE.py:function`` names."""
    file, _, wanted = name.rpartition(":")
    if not wanted or not file.endswith(".py"):
        raise DataError(f"{option}: expected FILE.py:function, found no function's name; add it, such as own.py:detect")
    if not os.path.isfile(file):  # unlike Path.is_file, False for a name that is too long
        raise DataError(f"{option}: expected a file {file}, found none")
    spec = importlib.util.spec_from_file_location(f"arbiview_aug_judge_{Path(file).stem}", file)
    assert spec is not None and spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    with _foreign(f"{option}: importing {file}"):
        spec.loader.exec_module(module)
        function = getattr(module, wanted, None)
    if not callable(function):
        there = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise DataError(f"{option}: expected a function {wanted} in {file}, found {shown(there)}")
    return function


def _called(option: str, function: Callable[[Picture], Any], image: Picture) -> Any:
    """Call a judge with a copy of an image: it may write into it, and raise anything."""
    with _foreign(f"{option}: for an image {image.shape} {image.dtype} it"):
        return function(image.copy())
