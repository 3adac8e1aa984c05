"""Checks of a sample's other keys: label maps, stale pixel data, misnamed keys."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise
from typing import Any

from arbiview_aug.cameras.key_names import misnamed
from arbiview_aug.errors import SampleError
from arbiview_aug.sample.inputs import CALIBRATION_KEYS, Frame

PIXEL_BOUND_KEYS = (
    "boxes_2d",
    "labels_2d",
    "detections",
    "centers_2d",
    "depths",
    "depth",
    "depth_m",
    "keypoints_2d",
    "source_camera",
    "source_frame",
    "confidence",
    "generated",
    "sources",
)
"""Keys bound to the source's pixels; they are dropped, as they would be stale in the target's views."""

EGO_KEYS = ("points", "boxes_3d", "ego2world")  # they pass, or move with ``SampleKeys(frame="target")``
_MAX_ENTRIES = 64  # checked per list: longer lists are tokens or numbers


def check_other_keys(
    sample: Mapping[str, Any],
    sizes: Sequence[tuple[int, ...]],
    label_keys: Sequence[str],
    pass_keys: Sequence[str],
) -> list[str]:
    """The keys that hold label maps; refuse others that may be bound to the source's pixels.

    ``sizes`` are (h, w) of the images; ``label_keys`` and ``pass_keys`` are the user's. SampleError for a tensor of the
    images' height and width, or a torchvision tv_tensor, under another key.
    """
    absent = [key for key in label_keys if key not in sample]
    if absent:
        raise SampleError(
            f"SampleKeys.labels: expected {', '.join(absent)} in the sample, got {', '.join(map(str, sample))}"
        )
    labels = list(label_keys)
    if "ignore" in sample and "ignore" not in (*label_keys, *pass_keys):
        raise SampleError(
            "ignore: since 0.3 masks of the own car are 'ego_mask'; rename the key, or keep it by SampleKeys"
        )
    for key, value in sample.items():
        if key in (*CALIBRATION_KEYS, *PIXEL_BOUND_KEYS, *EGO_KEYS, *labels, *pass_keys):
            continue
        first = value[0] if isinstance(value, list | tuple) and value else value
        if _tv_tensor(first) == "Mask":
            labels.append(key)
            continue
        for leaf in _leaves(value):
            if kind := _tv_tensor(leaf):
                stale = f"{key}: a tv_tensors.{kind} is bound to the source's pixels and would be stale"
                raise SampleError(f"{stale}; drop it, or name it in SampleKeys(keep=({key!r},))")
            shape = tuple(getattr(leaf, "shape", ()))
            if any(pair in sizes for pair in pairwise(shape)):
                raise SampleError(
                    f"{key}: shape {shape} looks like a map over the source's pixels and would be stale; name it in "
                    f"SampleKeys(labels=({key!r},)) to render it, or in SampleKeys(keep=({key!r},)) to keep it as it is"
                )
    return labels


def _tv_tensor(value: Any) -> str:
    kind = type(value)
    return kind.__name__ if kind.__module__.startswith("torchvision.tv_tensors") else ""


def _leaves(value: Any) -> Iterator[Any]:
    """Yield the leaves of nested mappings and sequences, in order; a container that stands in itself is read once."""
    seen: dict[int, Any] = {}
    waiting = [value]
    while waiting:
        entry = waiting.pop()
        if not isinstance(entry, Mapping | list | tuple):
            yield entry
        elif id(entry) not in seen:
            seen[id(entry)] = entry
            waiting += reversed([*entry.values()] if isinstance(entry, Mapping) else entry[:_MAX_ENTRIES])


def warn_of_misnamed(
    sample: Mapping[str, Any],
    calibrated: bool,
    static: bool,
    named: Sequence[str],
    warn: Callable[[str, str], None],
) -> None:
    """Warn, by topic and message, of keys that are probably misnamed and would not be read.

    Where ``calibrated``, a rig stands for ``lens``, ``distortion`` and ``ground_z_m``; where ``static``, no ego-frame
    key is used. ``named`` keys are named on purpose.
    """
    lenses = () if calibrated else ("distortion", "lens", "ground_z_m")
    geometry = () if static else (*EGO_KEYS, "depth_m")
    for wrong, meant in misnamed(sample, ("neighbours", *lenses, *geometry)).items():
        if wrong not in (*named, *PIXEL_BOUND_KEYS):
            message = f"the sample's {wrong!r} is not read; did you mean {meant!r}?"
            warn(
                f"key {wrong}", f"{message} Rename it, as RigRetarget documents it, or name it in SampleKeys(keep=...)"
            )


def warn_of_rims(frames: Iterable[Frame], warn: Callable[[str, str], None]) -> None:
    """Warn, by topic and message, of fisheye images with a dark rim that no mask hides."""
    lenses = [(c, i) for f in frames for c, i in zip(f.rig, f.images, strict=True) if c.mask is None]
    if all(camera.is_rectilinear for camera, _ in lenses):
        return
    from arbiview_aug.sample.masks import CLEANING, image_circle

    for camera, image in lenses:
        if image_circle(camera, image) is not None:
            warn("rim", f"camera {camera.name!r}: the dark rim of the image is read as scene; mask it: {CLEANING}")
            return
