"""Checked frames and scenes of a sample dict, and checks of its other keys; error messages give the fix."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.key_names import USUAL_NAMES, hint, misnamed
from arbiview_aug.cameras.random_rig import names_in
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import Finding
from arbiview_aug.errors import SampleError, SampleTypeError, WarnOnce
from arbiview_aug.sample.batching import check_container, checked_images, leading_shape, split
from arbiview_aug.sample.calibration import NUMBERS, as_array, check_source, numbers, read_rig
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.masks import CLEANING, dark_rims
from arbiview_aug.sample.neighbours import Warn, read_neighbours
from arbiview_aug.scene.boxes import checked_boxes
from arbiview_aug.scene.depth_map import DepthMap, anchored_maps, believed, motion_camera
from arbiview_aug.scene.point_cloud import checked_points
from arbiview_aug.scene.scene import GEOMETRIES, Geometry, Scene

MOTION_KEY, LEARNED_KEY = "motion_depth_m", "learned_depth_m"
"""(N, h, w) z-depth computed offline, at the size of ``motion_camera``."""

MOTION_WORDS_KEY, LEARNED_WORDS_KEY = "motion_depth_words", "learned_depth_words"
DEPTH_WORDS = {"motion": MOTION_WORDS_KEY, LEARNED_KEY: LEARNED_WORDS_KEY}
"""Sample keys of texts on how depth was made or why it was declined, by names of ``GeometryRow.reads``."""

CALIBRATION_KEYS = (
    *("images", "rig", "K", "cam2ego", "distortion", "lens", "ground_z_m", "coverage", "ego_mask", "neighbours"),
    *(MOTION_KEY, LEARNED_KEY, MOTION_WORDS_KEY, LEARNED_WORDS_KEY, "retarget_params"),
)
"""Keys that describe the source's images; they are replaced by the target's or consumed."""

_MOST_FOCALS = 20  # of a side: 169 degrees of a pinhole image, and more than any lens sees
DEPTH_KEYS = ("depth_m", MOTION_KEY, LEARNED_KEY)
_SAMPLE_KEYS = {"boxes": "boxes_3d", "points": "points", "motion": MOTION_KEY}
"""Sample keys of the geometry that has a field in ``Scene``; others are read under their own name."""

_OF_CAMERAS = (*DEPTH_KEYS, "coverage", "ego_mask")  # tensors, or lists of one for each camera
_ARRAYS = (*NUMBERS, "ego2world", "time_s")
_FIELDS = {"points", "boxes_3d", "neighbours", *DEPTH_KEYS}  # of ``Frame``

_EXPECTED = {
    "boxes": "'boxes_3d' (B, 7) in the sample, got none; pass an empty (0, 7) tensor if there are no objects",
    "points": "'points' (P, >= 3) in the ego frame, or 'depth_m' (N, H, W), z-depth of each camera in metres, in the "
    "sample, got neither",
    LEARNED_KEY: f"{LEARNED_KEY!r} in the sample, got none; make it with depth --model, and read it with WithDepth",
}


# --- frames -----------------------------------------------------------------------------------------------------------
def read_frames(
    sample: Any,
    source: Rig | None,
    geometry: str = "infinity",
    *,
    further: Collection[str] = (),
    names: Collection[str] = (),
    warn: Warn | None = None,
) -> list[Frame]:
    """Read and check the frames of a sample, one for each element of its leading dimensions.

    Args:
        sample: The sample dict.
        source: Rig of samples without a calibration; a sample with another one is refused.
        geometry: A name in ``GEOMETRIES``; what it uses is read.
        further: Sample keys of other entries to read: arrays, or lists with one for each frame.
        names: Sample keys of names to read: a name, or in a batch a list or tensor of names.
        warn: Called with a topic and a message for neighbours that are left out.

    Raises:
        SampleError: Missing calibration or geometry; counts, sizes or values that do not fit.
        SampleTypeError: PIL images, arrays and the like.
        CalibrationError: Impossible cameras.
    """
    if not isinstance(sample, Mapping):
        raise SampleTypeError(f"sample: expected a dict, got {type(sample).__name__}")
    if "images" not in sample:
        got = ", ".join(map(str, sample)) or "an empty dict"
        raise SampleError(f"sample: expected a key 'images', got {got}{hint(sample, ('images',))}")
    images = sample["images"]
    check_container(images)
    lead = leading_shape(images)
    if 0 in lead:
        raise SampleError(f"images: expected at least one frame, got the leading dimensions {lead}")
    checked = [checked_images(views) for views in split("images", images, lead)]
    row = GEOMETRIES[geometry]
    if row.needs not in (None, "motion"):  # only moved cameras need depth from motion
        key = _SAMPLE_KEYS.get(row.needs, row.needs)
        if sample.get(key) is None and (row.needs != "points" or sample.get("depth_m") is None):
            expected = _EXPECTED.get(row.needs, f"{row.needs!r} in the sample, got none")
            raise SampleError(f"geometry={geometry!r}: expected {expected}{hint(sample, (key,))}")
    wanted = {*(_SAMPLE_KEYS.get(name, name) for name in row.reads), *further}
    keys = {*wanted, "coverage", "ego_mask", *(() if sample.get("rig") is not None else (*NUMBERS, "lens"))}
    if "neighbours" in wanted and sample.get("neighbours") is not None:
        keys |= {"boxes_3d", "ego2world", "time_s"}  # boxes tell what moved
    entries = {key: _entries(key, sample[key], lead) for key in sorted(keys) if sample.get(key) is not None}
    entries |= {key: _names(key, sample[key], lead) for key in names if sample.get(key) is not None}
    frames = []
    for k, views in enumerate(checked):
        given = {key: values[k] for key, values in entries.items()}
        frame_sample = {**sample, **given}  # errors look for misnamed keys in it
        rig = read_rig(views, frame_sample, source)
        if source is not None and sample.get("rig") is None:
            check_source(source, frame_sample)
        frame = Frame(
            views,
            rig,
            points=given.get("points"),
            boxes=given.get("boxes_3d"),
            depth={key: given[key] for key in DEPTH_KEYS if key in given},
            further={key: value for key, value in given.items() if key in {*wanted, *names} - _FIELDS},
        )
        if "neighbours" in given:
            neighbours = read_neighbours(frame, given["neighbours"], frame_sample, warn or WarnOnce())
            frame = replace(frame, neighbours=neighbours)
        frames.append(frame)
    return frames


def _entries(key: str, value: Any, lead: tuple[int, ...]) -> list[Any]:
    """Entry of each frame, without leading dimensions."""
    count = math.prod(lead)
    if key in _OF_CAMERAS:
        try:
            return split(key, value, lead)
        except SampleError as error:
            raise SampleError(f"{error}; rename the key if it is something else") from None
    if key == "lens":
        try:
            names = np.array(value, dtype=object)  # ``default_collate`` makes lists of a batch's names
        except (TypeError, ValueError, RuntimeError):  # tensors that numpy cannot hold
            return [value] * count
        if not names.ndim or names.shape[1:] != lead[: names.ndim - 1]:
            return [value] * count
        names = names.reshape(*names.shape, *[1] * (len(lead) + 1 - names.ndim))  # the frames of a window share theirs
        return np.broadcast_to(names, (len(names), *lead)).reshape(-1, count).T.tolist()
    if key in _ARRAYS:
        value = numbers(key, value)
    if not lead or (key in _ARRAYS and not value.ndim):
        return [value] * count
    is_list = isinstance(value, list | tuple)
    if is_list and len(value) == count:
        return list(value)
    if not is_list and tuple(getattr(value, "shape", ()))[: len(lead)] == lead:
        return [value[index] for index in np.ndindex(*lead)]
    got = f"shape {tuple(value.shape)}" if hasattr(value, "shape") else type(value).__name__
    raise SampleError(f"{key}: expected a tensor {lead} + (n, ...), or a list of {count} of them, got {got}")


def _names(key: str, value: Any, lead: tuple[int, ...]) -> list[str]:
    """Name of each frame."""
    count = math.prod(lead)
    is_whole = isinstance(value, torch.Tensor) and value.numel() and value.numel() % count == 0
    names = [value] if not lead else list(value.reshape(count, -1)) if is_whole else value
    if not isinstance(names, list | tuple) or len(names) != count:
        raise SampleError(f"{key}: expected a name for each of {count} frames, got {type(names).__name__}")
    return [", ".join(map(str, names_in(key, name))) for name in names]


# --- scenes -----------------------------------------------------------------------------------------------------------
def read_scene(frame: Frame, geometry: str) -> Scene:
    """Read the scene that a geometry uses, in the source's ego frame; SampleError for impossible values."""
    reads, parts = GEOMETRIES[geometry].reads, dict[str, Geometry]()
    for name in reads:
        key = _SAMPLE_KEYS.get(name, name)
        if key in frame.depth:
            maps = _depth_maps(key, frame)
            if name == "motion" and LEARNED_KEY in reads and LEARNED_KEY in frame.depth:
                maps = list(map(believed, maps, _depth_maps(LEARNED_KEY, frame)))
            anchors = ("points", "depth_m", "motion") if key != "depth_m" else ()
            parts[name] = anchored_maps(maps, [parts[anchor] for anchor in anchors if anchor in parts])
        elif name == "boxes" and frame.boxes is not None:
            parts[name] = checked_boxes(as_array(key, frame.boxes))
        elif name == "points" and frame.points is not None:
            parts[name] = checked_points(as_array(key, frame.points))
        elif key in frame.further:
            parts[name] = as_array(key, frame.further[key])
    fields: dict[str, Any] = {name: parts.pop(name) for name in _SAMPLE_KEYS if name in parts}
    return Scene(**fields, further=parts)


def _depth_maps(key: str, frame: Frame) -> list[DepthMap]:
    """The depth maps of a frame's cameras."""
    maps: Any = frame.depth[key]
    if isinstance(maps, torch.Tensor | np.ndarray):
        maps = list(as_array(key, maps)) if maps.ndim else ()
    if not isinstance(maps, list | tuple) or len(maps) != len(frame.rig):
        raise SampleError(f"{key}: expected {len(frame.rig)} maps (H, W), one for each image")
    cameras = frame.rig if key == "depth_m" else map(motion_camera, frame.rig)
    return [DepthMap.of(camera, as_array(key, depth), key) for camera, depth in zip(cameras, maps, strict=True)]


# --- other keys -------------------------------------------------------------------------------------------------------
PIXEL_BOUND_KEYS = (
    *("boxes_2d", "boxes2d", "bboxes_2d", "bboxes2d", "gt_boxes_2d", "gt_bboxes_2d", "gt_bboxes"),
    *("labels_2d", "labels2d", "centers_2d", "centers2d"),
    *("detections", "depths", "depth", "depth_m", "gt_depth", "keypoints_2d"),
    *("source_camera", "source_frame", "confidence", "generated", "sources"),
    *("img_metas", "img_aug_matrix", "post_rots", "post_trans"),
    *USUAL_NAMES["K"],
    *("lidar2img", "lidar2image", "ego2img", "global2img", "world2img"),
    *("projection", "projection_mat", "projection_matrix", "proj_mat", "P", "P2"),
)
"""Keys bound to the source's pixels; dropped, because they would be stale in the target's views."""

CAMERA_KEYS = (
    *USUAL_NAMES["cam2ego"],
    *("ego2cam", "lidar2cam", "lidar2camera", "cam2lidar", "camera2lidar"),
    *("cam2global", "global2cam", "cam2world", "world2cam"),
    *("distortions", "dist_coeffs", "distortion_coeffs", "distortion_coefficients", "img_filename"),
)
"""Keys that describe the source's cameras; dropped for the same reason."""

EGO_KEYS = ("points", "boxes_3d", "ego2world")  # they pass, or move with ``SampleKeys(frame="target")``
_MAX_ENTRIES = 64  # checked per list: longer lists are tokens or numbers

_CAMERA_VALUE = re.compile(r"(.*_)?(depths?|disparity|flow|normals?)(_?(gt|m|maps?))*", re.IGNORECASE)
_DEPENDS = "depth, disparity, flow and normals have other values in other cameras"
_DEPTH = "depth_maps(points, views) makes depth maps of the views (docs/lidar.md)"
_OTHER_FRAMES = "frames of other times belong into 'neighbours' or other samples (docs/formats.md, Several frames)"


def refuse_camera_values(labels: Sequence[Any]) -> None:
    """SampleError for keys of label maps whose values depend on the camera, by their names."""
    if named := [str(key) for key in labels if _CAMERA_VALUE.fullmatch(str(key))]:
        fix = f"drop the key, or name it in SampleKeys(keep=...); {_DEPTH}"
        raise SampleError(f"labels: expected keys of label maps, got {', '.join(named)}: {_DEPENDS}; {fix}")


def check_other_keys(
    sample: Mapping[str, Any], sizes: Sequence[tuple[int, ...]], label_keys: Sequence[str], pass_keys: Sequence[str]
) -> list[str]:
    """Find the keys that hold label maps; refuse others that may be bound to the source's pixels.

    ``sizes`` are (h, w) of the images; ``label_keys`` and ``pass_keys`` are the user's. SampleError for a tensor of the
    images' height and width, or a torchvision tv_tensor, under another key.
    """
    if absent := [key for key in label_keys if key not in sample]:
        got = ", ".join(map(str, sample))
        raise SampleError(f"SampleKeys.labels: expected {', '.join(absent)} in the sample, got {got}")
    labels = list(label_keys)
    for key, value in sample.items():
        if key in (*CALIBRATION_KEYS, *PIXEL_BOUND_KEYS, *EGO_KEYS, *labels, *pass_keys):
            continue
        if _tv_tensor(value[0] if isinstance(value, list | tuple) and value else value) == "Mask":
            labels.append(key)
            continue
        for leaf in _leaves(value):
            if kind := _tv_tensor(leaf):
                stale = f"{key}: a tv_tensors.{kind} is bound to the source's pixels and would be stale"
                raise SampleError(f"{stale}; drop it, or name it in SampleKeys(keep=({key!r},))")
            try:
                shape = tuple(leaf.shape)
            except (AttributeError, TypeError, RuntimeError):  # RuntimeError: nested tensors
                continue
            if any(pair in sizes for pair in pairwise(shape)):
                stale = f"{key}: shape {shape} looks like pixels of the source's cameras, which would be stale"
                keep = f"drop the key, or keep it as it is by SampleKeys(keep=({key!r},))"
                other = f"label maps belong under one key, in SampleKeys(labels=({key!r},)); {_OTHER_FRAMES}"
                other = f"{_DEPENDS}; {_DEPTH}" if _CAMERA_VALUE.fullmatch(str(key)) else other
                raise SampleError(f"{stale}; {keep}; {other}")
    return labels


def _tv_tensor(value: Any) -> str:
    return type(value).__name__ if type(value).__module__.startswith("torchvision.tv_tensors") else ""


def _leaves(value: Any) -> Iterator[Any]:
    """Yield the leaves of nested mappings and sequences, in order; a container within itself is read once."""
    seen: dict[int, Any] = {}
    waiting = [value]
    while waiting:
        entry = waiting.pop()
        if not isinstance(entry, Mapping | list | tuple):
            yield entry
        elif id(entry) not in seen:
            seen[id(entry)] = entry
            waiting += reversed([*entry.values()] if isinstance(entry, Mapping) else entry[:_MAX_ENTRIES])


# --- findings ---------------------------------------------------------------------------------------------------------
def misnamed_keys(sample: Mapping[str, Any], calibrated: bool, static: bool = False) -> list[Finding]:
    """Keys that are probably misnamed and would not be read.

    If ``calibrated``, a rig replaces ``lens``, ``distortion`` and ``ground_z_m``; if ``static``, no ego-frame key is
    used.
    """
    lenses = () if calibrated else ("distortion", "lens", "ground_z_m")
    keys = misnamed(sample, ("neighbours", *lenses, *(() if static else (*EGO_KEYS, "depth_m"))))
    seen, fix = "a key that is not read", "Rename it, as RigRetarget documents it, or name it in SampleKeys(keep=...)"
    return [
        Finding(wrong, f"the name {meant!r}", seen, f"did you mean {meant}? {fix}")
        for wrong, meant in keys.items()
        if wrong not in PIXEL_BOUND_KEYS
    ]


def camera_findings(cameras: Iterable[Camera], images: Sequence[torch.Tensor] = ()) -> Iterator[Finding]:
    """Focal lengths that are too short for pixels and, with images, dark fisheye rims that no mask hides."""
    cameras = list(cameras)
    for camera in cameras:
        f, side = camera.K[0, 0], min(camera.size)
        if side >= _MOST_FOCALS * f:
            found = f"{f:g} px for an image with a side of {side} px"
            fix = "is K in millimetres, or normalised? It is in pixels"
            yield Finding(f"camera {camera.name!r}: K", "a focal length in pixels", found, fix)
    for camera, circle in dark_rims(cameras, images) if images else ():
        expected = "a mask that hides the dark rim around the image circle"
        found = f"no mask, and {1 - circle.holds(camera).mean():.0%} of the image that would be read as scene"
        yield Finding(f"camera {camera.name!r}: image", expected, found, f"mask it: {CLEANING}")
