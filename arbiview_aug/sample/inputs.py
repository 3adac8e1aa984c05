"""Checked frames and scenes of a sample dict, and checks of its other keys; error messages give the fix."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import chain, pairwise
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.key_names import USUAL_NAMES, hint, misnamed
from arbiview_aug.cameras.random_rig import names_in
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, SampleTypeError, WarnOnce
from arbiview_aug.sample.batching import check_container, checked_images, entry, leading_shape, split
from arbiview_aug.sample.calibration import CHECKED_KEYS, as_array, differing_keys, read_rig
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
    frames, places = [], list(np.ndindex(*lead))
    for index, views in zip(places, split("images", images, lead), strict=True):
        checked = checked_images(views)
        frames.append(Frame(checked, read_rig(checked, sample, source, lead, index)))
    if source is not None and sample.get("rig") is None and not CHECKED_KEYS.isdisjoint(sample):
        for key in differing_keys(source, sample, lead):
            fix = f"drop source=, or {key} from the sample"
            raise SampleError(f"{key}: expected the calibration of source=, got another; {fix}")
    row = GEOMETRIES[geometry]
    if row.needs not in (None, "motion"):  # only moved cameras need depth from motion
        key = _SAMPLE_KEYS.get(row.needs, row.needs)
        if sample.get(key) is None and (row.needs != "points" or sample.get("depth_m") is None):
            expected = _EXPECTED.get(row.needs, f"{row.needs!r} in the sample, got none")
            raise SampleError(f"geometry={geometry!r}: expected {expected}{hint(sample, (key,))}")
    wanted = [*(_SAMPLE_KEYS.get(name, name) for name in row.reads), *sorted(further)]
    if "neighbours" in wanted and sample.get("neighbours") is not None:
        wanted.append("boxes_3d")  # they tell what moved
    entries = {key: _entries(key, sample[key], lead) for key in wanted if sample.get(key) is not None}
    entries |= {key: _names(key, sample[key], lead) for key in names if sample.get(key) is not None}
    for k, (frame, index) in enumerate(zip(frames, places, strict=True)):
        values = {key: frame_values[k] for key, frame_values in entries.items()}
        depth = {key: values.pop(key) for key in DEPTH_KEYS if key in values}
        neighbours, points, boxes = (values.pop(key, None) for key in ("neighbours", "points", "boxes_3d"))
        frame = replace(frame, points=points, boxes=boxes, depth=depth, further=values)
        if neighbours is not None:
            frame = replace(frame, neighbours=read_neighbours(frame, neighbours, sample, index, warn or WarnOnce()))
        frames[k] = frame
    return frames


def _entries(key: str, value: Any, lead: tuple[int, ...]) -> list[Any]:
    """Entry of each frame of a (*lead, ...) tensor, or of a list over frames (of depth maps, over cameras)."""
    if key in DEPTH_KEYS:
        try:
            return [entry(value, lead, index) for index in np.ndindex(*lead)]
        except (AttributeError, TypeError, ValueError, RuntimeError) as error:
            raise SampleError(f"{key}: expected one map (H, W) for each image ({error})") from None
    count, is_list = math.prod(lead), isinstance(value, list | tuple)
    if not lead:
        return [value]
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
                raise SampleError(f"{key}: shape {shape} looks like {_stale_map(key, value, leaf, sample['images'])}")
    return labels


def _stale_map(key: Any, value: Any, leaf: Any, images: Any) -> str:
    """Describe a leaf of an entry that has the images' height and width, and the fix."""
    shape = tuple(leaf.shape)
    image = images[0] if isinstance(images, list | tuple) else images
    is_nested = leaf is not value and not (isinstance(value, list | tuple) and any(leaf is part for part in value))
    has_colours = shape[-3:-2] == (3,) and (len(shape) > 3 or leaf is not value)  # not the maps of three cameras
    if has_colours and str(getattr(leaf, "dtype", "")).removeprefix("torch.") == str(image.dtype)[len("torch.") :]:
        label = "" if is_nested else f"; if they are label maps, name them in SampleKeys(labels=({key!r},))"
        return f"images of the source's cameras and would be stale; {_OTHER_FRAMES}; otherwise drop the key{label}"
    keep = f"SampleKeys(keep=({key!r},)) to keep it as it is"
    stale = "a map over the source's pixels and would be stale"
    if _CAMERA_VALUE.fullmatch(str(key)):
        return f"{stale}; {_DEPENDS}: drop the key, or name it in {keep}; {_DEPTH}"
    if is_nested:
        label = "a label map needs a key of its own, named in SampleKeys(labels=...)"
        return f"{stale}; {label}; {_OTHER_FRAMES}; otherwise drop the key, or name it in {keep}"
    return f"{stale}; name it in SampleKeys(labels=({key!r},)) to render it, or in {keep}"


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


def misnamed_keys(sample: Mapping[str, Any], calibrated: bool, static: bool = False) -> dict[str, str]:
    """Keys that are probably misnamed and would not be read, and the names that are meant.

    If ``calibrated``, a rig replaces ``lens``, ``distortion`` and ``ground_z_m``; if ``static``, no ego-frame key is
    used.
    """
    lenses = () if calibrated else ("distortion", "lens", "ground_z_m")
    keys = misnamed(sample, ("neighbours", *lenses, *(() if static else (*EGO_KEYS, "depth_m"))))
    return {wrong: meant for wrong, meant in keys.items() if wrong not in PIXEL_BOUND_KEYS}


def warn_of_misnamed(
    sample: Mapping[str, Any], calibrated: bool, static: bool, named: Sequence[str], warn: Callable[[str, str], None]
) -> None:
    """Warn, by topic and message, of ``misnamed_keys`` that are not ``named`` on purpose."""
    for wrong, meant in misnamed_keys(sample, calibrated, static).items():
        if wrong not in named:
            message = f"the sample's {wrong!r} is not read; did you mean {meant!r}?"
            fix = "Rename it, as RigRetarget documents it, or name it in SampleKeys(keep=...)"
            warn(f"key {wrong}", f"{message} {fix}")


def focal_mistake(camera: Camera) -> tuple[str, str] | None:
    """Mistake of a focal length that is too short for pixels, as (found, fix); None if it is plausible."""
    f, size = camera.K[0, 0], min(camera.size)
    if size < _MOST_FOCALS * f:
        return None
    return f"{f:g} px for an image with a side of {size} px", "is K in millimetres, or normalised? It is in pixels"


def warn_of_cameras(frames: Sequence[Frame], warn: Callable[[str, str], None]) -> None:
    """Warn, by topic and message, of focal lengths in another unit, and of dark fisheye rims that no mask hides."""
    for camera in chain.from_iterable(frame.rig for frame in frames):
        if mistake := focal_mistake(camera):
            warn("focal", f"camera {camera.name!r}: K: a focal length of {'; '.join(mistake)}")
    for camera, _ in (rim for frame in frames for rim in dark_rims(frame.rig, frame.images)):
        warn("rim", f"camera {camera.name!r}: the dark rim of the image is read as scene; mask it: {CLEANING}")
        return
