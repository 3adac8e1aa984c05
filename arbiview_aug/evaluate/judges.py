"""Networks that judge views: detectors and segmenters that were trained on photographs, by the names of the options.

Detectors take an RGB image (H, W, 3) uint8 and return ``Detections``; segmenters return masks (n, H, W).
"""

from __future__ import annotations

import importlib.util
import inspect
import os
import re
import sys
from collections.abc import Callable, Collection, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.errors import DataError, described, one_line, shown
from arbiview_aug.evaluate.report.pictures import Picture
from arbiview_aug.files import open_regular
from arbiview_aug.inpaint.networks import load_torchscript


class Detections(NamedTuple):
    """Objects that a detector sees in an image.

    Attributes:
        boxes: (n, 4) float64 x0 y0 x1 y1 in pixels, within the image.
        scores: (n,) float64 in [0, 1].
        labels: n names or class numbers, as text.
    """

    boxes: FloatArray
    scores: FloatArray
    labels: Sequence[str]

    def subset(self, chosen: BoolArray) -> Detections:
        """The detections that a mask (n,) chooses."""
        labels = [label for label, keep in zip(self.labels, chosen, strict=True) if keep]
        return Detections(self.boxes[chosen], self.scores[chosen], labels)


Detector = Callable[[Picture], Detections]
Segmenter = Callable[[Picture], BoolArray]

SEGMENTED = (360, 640)
"""(h, w) of the 16:9 crop that a TorchScript segmenter sees: TwinLiteNet's."""

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


# --- detectors --------------------------------------------------------------------------------------------------------
def load_detector(
    name: str, weights: str | None = None, classes: Collection[str] = (), device: torch.device | str = "cpu"
) -> Detector:
    """Load the detector that ``--detector`` names; it returns the detections that count.

    Args:
        name: ``FILE.py:function``, or with ``weights`` the name of a torchvision detector. Both are asked for
            detections from ``LEAST_SCORE`` on, a function by its parameter ``score`` if it has one.
        weights: File of a torchvision detector's weights.
        classes: Labels that count, names or numbers as text. By default names of vehicles and people, and all numbers.
        device: The device of a torchvision detector.

    Raises:
        DataError: No such detector, or one that does not fit; its calls raise it for outputs of other shapes.
    """
    option = f"--detector {name}"
    if weights is None:
        detect: Callable[..., Any] = _function(option, name)
        with suppress(TypeError, ValueError):  # compiled functions have no signature
            if "score" in inspect.signature(detect).parameters:
                detect = partial(detect, score=LEAST_SCORE)
    else:
        detect, names = _of_torchvision(option, name, weights, device)
        if unknown := {*classes} - {*names}:
            expected = f"names that {name} has, {shown(names)}"
            raise DataError(f"--detector-classes: expected {expected}, got {sorted(unknown)}")

    def detector(image: Picture) -> Detections:
        found: Detections = _called(option, lambda rgb: checked_detections(option, detect(rgb), image), image)
        counts = [label in classes if classes else label.isdecimal() or is_road_user(label) for label in found.labels]
        return found.subset(np.array(counts, bool) & (found.scores >= LEAST_SCORE))

    return detector


def checked_detections(option: str, output: Any, image: Picture) -> Detections:
    """A detector's output for an image, as ``Detections`` cut at the image's border.

    Raises:
        DataError: Not boxes (n, 4), scores (n,) and n labels; or boxes that are not finite and ordered.
    """
    expected = f"{option}: expected boxes (n, 4) x0 y0 x1 y1, scores (n,) and n labels for an image {image.shape}"
    if not isinstance(output, tuple | list) or len(output) != 3:
        got = f"{len(output)} values" if isinstance(output, tuple | list) else type(output).__name__
        raise DataError(f"{expected}, got {got}")
    try:
        boxes, scores = (np.asarray(_host(part), np.float64) for part in output[:2])
        labels = np.asarray(_host(output[2])).reshape(-1)
        texts = [str(int(one)) if np.issubdtype(labels.dtype, np.number) else str(one) for one in labels]
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise DataError(f"{expected}, got other values: {error}") from None
    boxes = boxes.reshape(0, 4) if boxes.size == 0 else boxes
    if boxes.ndim != 2 or boxes.shape[1] != 4 or scores.shape != (len(boxes),) or len(labels) != len(boxes):
        raise DataError(f"{expected}, got {boxes.shape}, {scores.shape} and {len(labels)}")
    if not np.isfinite(boxes).all() or (boxes[:, :2] > boxes[:, 2:]).any():
        bad = boxes[~np.isfinite(boxes).all(axis=1) | (boxes[:, :2] > boxes[:, 2:]).any(axis=1)][0]
        raise DataError(f"{expected}: finite, with x0 <= x1 and y0 <= y1, got {bad.tolist()}")
    if not ((scores >= 0) & (scores <= 1)).all():
        raise DataError(f"{expected}: scores from 0 to 1, got {shown(scores.tolist())}")
    h, w = image.shape[:2]
    return Detections(boxes.clip(0, (w, h, w, h)), scores, texts)


def _host(part: Any) -> Any:
    return part.detach().cpu() if isinstance(part, torch.Tensor) else part


def _of_torchvision(
    option: str, name: str, weights: str, device: torch.device | str
) -> tuple[Callable[[Picture], Any], list[str]]:
    from torchvision import models

    known = list(models.list_models(module=models.detection))
    if name not in known:
        raise DataError(f"{option}: expected a torchvision detector with --detector-weights: {', '.join(known)}")
    names = list(models.get_model_weights(name).DEFAULT.meta["categories"])
    model = models.get_model(name, weights=None, weights_backbone=None)
    try:
        with open_regular(weights) as content:
            state = torch.load(content, map_location="cpu", weights_only=True)
        model.load_state_dict(state["model"] if "model" in state else state)  # torchvision's references save more
    except Exception as error:  # files, pickle, zip, torch and mappings each have their own
        fix = f"expected weights of torchvision's {name} for its {len(names)} classes (others: FILE.py:function)"
        raise DataError(f"--detector-weights {weights}: {fix}: {one_line(error)}") from None
    model.eval().to(device)
    getattr(model, "roi_heads", model).score_thresh = LEAST_SCORE  # some ask for more: FCOS for 0.2

    @torch.inference_mode()
    def detect(image: Picture) -> Any:
        pixels = torch.from_numpy(image).to(device).permute(2, 0, 1).float() / 255
        (out,) = model([pixels])
        return out["boxes"], out["scores"], [names[label] for label in out["labels"].tolist()]

    return detect, names


# --- segmenters -------------------------------------------------------------------------------------------------------
def load_segmenter(name: str, device: torch.device | str = "cpu") -> Segmenter:
    """Load the segmenter that ``--segmenter`` names; it returns masks (n, H, W) bool, one for each class.

    Args:
        name: ``FILE.py:function``, which returns the same masks; or a TorchScript file of TwinLiteNet's kind: of images
            (1, 3, 360, 640), RGB in [0, 1], it returns n logits (1, 2, 360, 640): each mask against the rest. It sees
            the 16:9 part of an image that is left when the top or the sides are cut; the rest has no masks.
        device: Where TorchScript runs.

    Raises:
        DataError: No such file or function; its calls raise it for outputs of other shapes.
    """
    option = f"--segmenter {name}"
    segment = _function(option, name) if names_a_function(name) else _of_torchscript(option, name, device)

    def masks_of(image: Picture) -> BoolArray:
        masks = segment(image)
        try:
            array = np.asarray(_host(masks))
        except (TypeError, ValueError, RuntimeError):
            array = np.zeros(0)
        h, w = image.shape[:2]
        if not array.size or array.ndim != 3 or array.shape[1:] != (h, w) or not np.isin(array, (0, 1)).all():
            got = f"{array.dtype} {array.shape}" if array.shape and array.size else type(masks).__name__
            raise DataError(f"{option}: expected masks (n, {h}, {w}) of 0 and 1, got {got}")
        return array.astype(bool)

    return partial(_called, option, masks_of)


def _of_torchscript(option: str, name: str, device: torch.device | str) -> Callable[[Picture], BoolArray]:
    network = load_torchscript(name, option, DataError).to(device).eval()
    logits = (1, 2, *SEGMENTED)

    @torch.inference_mode()
    def segment(image: Picture) -> BoolArray:
        h, w = image.shape[:2]
        wide, high = min(w, h * 16 // 9), min(h, max(1, w * 9 // 16))
        part = slice(h - high, h), slice((w - wide) // 2, (w - wide) // 2 + wide)
        small = cv2.resize(image[part], SEGMENTED[::-1], interpolation=cv2.INTER_AREA)
        pixels = torch.from_numpy(small).to(device).permute(2, 0, 1)[None].float() / 255
        out = network(pixels)
        shapes = [tuple(one.shape) if isinstance(one, torch.Tensor) else one for one in out]
        if not isinstance(out, tuple | list) or {*shapes} != {logits}:
            got = shapes if isinstance(out, tuple | list) else type(out).__name__
            raise DataError(f"{option}: expected outputs {logits} for {tuple(pixels.shape)}, got {got}")
        masks = np.zeros((len(out), h, w), bool)
        for mask, one in zip(masks, out, strict=True):
            small = one[0].argmax(0).byte().cpu().numpy()
            mask[part] = cv2.resize(small, (wide, high), interpolation=cv2.INTER_NEAREST) > 0
        return masks

    return segment


# --- functions in files -----------------------------------------------------------------------------------------------
def names_a_function(name: str) -> bool:
    """Whether an option's value is ``FILE.py:function`` or, by mistake, ``FILE.py`` alone."""
    return name.endswith(".py") or ".py:" in name


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
    try:
        spec.loader.exec_module(module)
        function = getattr(module, wanted, None)
    except KeyboardInterrupt:
        raise
    except BaseException as error:  # SystemExit, too, which would end the command as if it was done
        raise DataError(f"{option}: importing {file} raised {type(error).__name__}: {one_line(error)}") from error
    if not callable(function):
        there = [key for key, value in vars(module).items() if callable(value) and not key.startswith("_")]
        raise DataError(f"{option}: expected a function {wanted} in {file}, found {shown(there)}")
    return function  # type: ignore[no-any-return]


def _called(option: str, function: Callable[[Picture], Any], image: Picture) -> Any:
    """Call a judge with a copy of an image: it may write into it, and raise anything."""
    try:
        return function(image.copy())
    except (DataError, KeyboardInterrupt):
        raise
    except BaseException as error:  # SystemExit, too, which would end the command as if it was done
        text = one_line(described(error))
        raise DataError(f"{option}: raised {text} for an image {image.shape} {image.dtype}") from error
