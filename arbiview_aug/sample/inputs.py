"""Checked frames and scenes of a sample dict, and checks of its other keys; error messages give the fix."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain, pairwise, zip_longest
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.key_names import USUAL_NAMES, hint, misnamed
from arbiview_aug.cameras.lens import LENSES, BoolArray, FloatArray, canonical_name
from arbiview_aug.cameras.random_rig import names_in
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, SampleTypeError, one_line, shown
from arbiview_aug.sample.batching import check_container, checked_images, entry, leading_shape, split
from arbiview_aug.sample.masks import CLEANING, dark_rims
from arbiview_aug.scene.boxes import checked_boxes
from arbiview_aug.scene.depth_map import DepthMap, anchored_maps, believed, motion_camera
from arbiview_aug.scene.point_cloud import checked_points
from arbiview_aug.scene.scene import GEOMETRIES, Geometry, Scene
from arbiview_aug.scene.surface import Points

MOTION_KEY, LEARNED_KEY = "motion_depth_m", "learned_depth_m"
"""(N, h, w) z-depth computed offline, at the size of ``motion_camera``."""

MOTION_WORDS_KEY, LEARNED_WORDS_KEY = "motion_depth_words", "learned_depth_words"
"""How they were made, or why they were declined, for ``explain`` and warnings."""

CALIBRATION_KEYS = (
    *("images", "rig", "K", "cam2ego", "distortion", "lens", "ground_z_m", "coverage", "ego_mask", "neighbours"),
    *(MOTION_KEY, LEARNED_KEY, MOTION_WORDS_KEY, LEARNED_WORDS_KEY, "retarget_params"),
)
"""Keys that describe the source's images; they are replaced by the target's or consumed."""

_CHECKED_KEYS = frozenset(("K", "cam2ego", "lens", "distortion", "ground_z_m"))  # against the transform's ``source``

_MOST_FOCALS = 20  # of a side: 169 degrees of a pinhole image, and more than any lens sees
_OFF_CENTER = 0.2  # a principal point is never off centre by this share of the image's size along both axes
_ON_CENTER = 0.05  # with K of another image size it is farther off along both axes


@dataclass(frozen=True, eq=False)
class Frame:
    """One checked frame of a sample.

    Attributes:
        images: N images (3, H, W), uint8 or float in [0, 1].
        rig: Their cameras.
        sample: The sample it was read from; further entries are read and checked on request.
        lead: Leading dimensions of the sample's images.
        index: Place of the frame in them.
        neighbours: Checked neighbouring frames, once ``sample.neighbours`` has read them.
        sweeps: Their points, likewise.
    """

    images: tuple[torch.Tensor, ...]
    rig: Rig
    sample: Mapping[str, Any] = field(default_factory=dict, repr=False)
    lead: tuple[int, ...] = ()
    index: tuple[int, ...] = ()
    neighbours: list[Any] | None = field(default=None, repr=False, init=False)
    sweeps: list[FloatArray] | None = field(default=None, repr=False, init=False)

    @property
    def number(self) -> int:
        """Number of the frame in a flattened batch."""
        return int(np.ravel_multi_index(self.index, self.lead)) if self.lead else 0

    def array(self, key: str) -> Points | None:
        """``entry`` as an array."""
        value = self.entry(key)
        return None if value is None else as_array(key, value)

    def entry(self, key: str) -> Any:
        """The frame's entry of a sample key; None without one.

        The key holds an array, a tensor with the sample's leading dimensions, or a list with an array for each frame.
        """
        value = self.sample.get(key)
        if value is None or not self.lead:
            return value
        count = math.prod(self.lead)
        if isinstance(value, list | tuple):
            if len(value) == count:
                return value[self.number]
        elif tuple(getattr(value, "shape", ()))[: len(self.lead)] == self.lead:
            return value[self.index]
        got = f"shape {tuple(value.shape)}" if hasattr(value, "shape") else type(value).__name__
        raise SampleError(f"{key}: expected a tensor {self.lead} + (n, ...), or a list of {count} of them, got {got}")

    def name(self, key: str) -> str:
        """The frame's name under a sample key that holds one name, or in a batch a list or tensor of names."""
        value, count = self.sample[key], math.prod(self.lead)
        if self.lead:
            is_whole = isinstance(value, torch.Tensor) and value.numel() and value.numel() % count == 0
            names = list(value.reshape(count, -1)) if is_whole else value
            if not isinstance(names, list | tuple) or len(names) != count:
                raise SampleError(f"{key}: expected a name for each of {count} frames, got {type(names).__name__}")
            value = names[self.number]
        return ", ".join(map(str, names_in(key, value)))


def read_frames(sample: Any, source: Rig | None) -> list[Frame]:
    """Read and check the frames of a sample, one for each element of its leading dimensions.

    ``source`` is the rig of samples that carry none; one that carries another calibration is refused. SampleError for
    missing calibration, counts, sizes or values; SampleTypeError for PIL images, arrays and the like; CalibrationError.
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
    frames = [
        frame_from(checked_images(frame), sample, source, lead, index)
        for frame, index in zip(split("images", images, lead), np.ndindex(*lead), strict=True)
    ]
    if source is not None and sample.get("rig") is None and not _CHECKED_KEYS.isdisjoint(sample):
        for key in _differing(source, sample, lead):
            fix = f"drop source=, or {key} from the sample"
            raise SampleError(f"{key}: expected the calibration of source=, got another; {fix}")
    return frames


def read_scene(frame: Frame, surface: str) -> Scene | None:
    """Read the geometry that a surface of ``GEOMETRIES`` uses, in the source's ego frame; None without any.

    SampleError for a sample that lacks what the surface needs, or in which it is impossible.
    """
    row, sample = GEOMETRIES[surface], frame.sample
    arrays: dict[str, Geometry] = {}
    for name in row.reads:
        array = _geometry(name, frame, arrays, name == "motion" and LEARNED_KEY in row.reads)
        if array is not None:
            arrays[name] = array
        elif name == row.needs and name != "motion" and (name != "points" or sample.get("depth_m") is None):
            # Neighbouring frames may still give depth from motion.
            expected, keys = _EXPECTED.get(name, f"{name!r} in the sample, got none"), _SAMPLE_KEYS.get(name, (name,))
            raise SampleError(f"geometry={surface!r}: expected {expected}{hint(sample, keys)}")
    if not arrays:
        return None
    fields: dict[str, Any] = {name: arrays.pop(name) for name in _SAMPLE_KEYS if name in arrays}
    return Scene(**fields, further=arrays)


DEPTH_KEYS = ("depth_m", MOTION_KEY, LEARNED_KEY)
_SAMPLE_KEYS = {"boxes": ("boxes_3d",), "points": ("points",), "motion": (MOTION_KEY,)}
"""Sample keys of the geometry that has a field in ``Scene``; others are read under their own name."""

_EXPECTED = {
    "boxes": "'boxes_3d' (B, 7) in the sample, got none; pass an empty (0, 7) tensor if there are no objects",
    "points": "'points' (P, >= 3) in the ego frame, or 'depth_m' (N, H, W), z-depth of each camera in metres, in the "
    "sample, got neither",
    LEARNED_KEY: f"{LEARNED_KEY!r} in the sample, got none; make it with depth --model, and read it with WithDepth",
}
_CHECKS: dict[str, Callable[[Points], Points]] = {"boxes_3d": checked_boxes, "points": checked_points}


def _geometry(name: str, frame: Frame, arrays: Mapping[str, Geometry], is_doubted: bool) -> Geometry | None:
    """The arrays or maps of a name in ``GeometryRow.reads``; None without any.

    Maps are fused with the points and maps in ``arrays``, which were read before. Depth from motion that ``is_doubted``
    is left out where a network's maps, if there are any, contradict it.
    """
    (key,) = _SAMPLE_KEYS.get(name, (name,))
    if frame.sample.get(key) is None:
        return None
    if key in DEPTH_KEYS:
        maps = _depth_maps(key, frame)
        if is_doubted and frame.sample.get(LEARNED_KEY) is not None:
            maps = list(map(believed, maps, _depth_maps(LEARNED_KEY, frame)))
        before = [arrays[one] for one in ("points", "depth_m", "motion") if one in arrays and key != "depth_m"]
        return anchored_maps(maps, before)
    array = frame.array(key)
    assert array is not None
    return _CHECKS[key](array) if key in _CHECKS else array


def _depth_maps(key: str, frame: Frame) -> list[DepthMap]:
    """The depth maps of a frame's cameras."""
    try:
        maps = entry(frame.sample[key], frame.lead, frame.index)
    except (AttributeError, TypeError, ValueError, RuntimeError) as error:
        raise SampleError(f"{key}: expected one map (H, W) for each image ({error})") from None
    if isinstance(maps, torch.Tensor | np.ndarray):
        maps = list(as_array(key, maps)) if maps.ndim else ()
    if not isinstance(maps, list | tuple) or len(maps) != len(frame.rig):
        raise SampleError(f"{key}: expected {len(frame.rig)} maps (H, W), one for each image")
    cameras = frame.rig if key == "depth_m" else map(motion_camera, frame.rig)
    return [DepthMap.of(camera, as_array(key, one), key) for camera, one in zip(cameras, maps, strict=True)]


# --- calibration ------------------------------------------------------------------------------------------------------
def frame_from(
    images: tuple[torch.Tensor, ...],
    sample: Mapping[str, Any],
    source: Rig | None,
    lead: tuple[int, ...] = (),
    index: tuple[int, ...] = (),
) -> Frame:
    """One frame of a sample, at an ``index`` into its leading dimensions, whose images are checked already."""
    rig = sample.get("rig")
    if rig is None:
        rig = source if source is not None else _rig_from_tensors(images, sample, index)
    if not isinstance(rig, Rig):
        raise SampleTypeError(f"rig: expected an arbiview_aug.Rig, got {type(rig).__name__}; use load_rig(path)")
    if len(rig) != len(images):
        raise SampleError(f"images: expected {len(rig)} images for cameras {', '.join(rig.names)}, got {len(images)}")
    for camera, image in zip(rig, images, strict=True):
        size = tuple(image.shape[-2:])
        if size != camera.size:
            fix = "height and width are swapped" if size == camera.size[::-1] else "use rig.resized((h, w)) or crop"
            expected = f"an image of (h, w) = {camera.size}, as calibrated"
            raise SampleError(f"camera {camera.name!r}: expected {expected}, got {size}; {fix}")
    return Frame(images, _with_masks(rig, sample, lead, index), sample, lead, index)


def _differing(source: Rig, sample: Mapping[str, Any], lead: tuple[int, ...]) -> Iterator[str]:
    """Calibration keys of a sample that are not those of the transform's ``source``, beyond rounding."""
    for key, expected in (("K", source.K), ("cam2ego", source.cam2ego), ("ground_z_m", np.array(source.ground_z_m))):
        got = expected if sample.get(key) is None else numbers(key, sample[key])
        is_shaped = expected.ndim == 0 or got.shape in (expected.shape, (*lead, *expected.shape))
        if not is_shaped or not np.allclose(got, expected, 1e-4, 1e-3):
            yield key
    if sample.get("lens") is not None or sample.get("distortion") is not None:
        for index in np.ndindex(*lead):
            for camera, (lens, coefficients) in zip(source, _lenses(sample, len(source), index), strict=True):
                pairs = zip_longest(camera.distortion, coefficients, fillvalue=0.0)
                if lens != camera.lens or not all(math.isclose(*pair, rel_tol=1e-4, abs_tol=1e-6) for pair in pairs):
                    yield "lens"


def _rig_from_tensors(images: tuple[torch.Tensor, ...], sample: Mapping[str, Any], index: tuple[int, ...]) -> Rig:
    """The rig of the sample's K, cam2ego and, where present, lens, distortion and ground_z_m."""
    missing = [key for key in ("K", "cam2ego") if sample.get(key) is None]
    if missing:
        got = f"missing {', '.join(missing)}{hint(sample, missing)}; or give RigRetarget the rig as source="
        raise SampleError(f"sample: expected calibration, 'rig' or 'K' and 'cam2ego', {got}")
    K, cam2ego = (numbers(key, sample[key], index) for key in ("K", "cam2ego"))
    for key, array, expected in (("K", K, (len(images), 3, 3)), ("cam2ego", cam2ego, (len(images), 4, 4))):
        if array.shape != expected:
            of_frame = " in a frame of the batch" if index else ""
            fix = "; pass K[..., :3, :3]" if key == "K" and array.shape[1:] in ((3, 4), (4, 4)) else ""
            got = f"got {array.shape}{of_frame}{fix}"
            raise SampleError(f"{key}: expected shape {expected} for {len(images)} images, {got}")
    cameras = []
    for k, (image, (lens, distortion)) in enumerate(zip(images, _lenses(sample, len(images), index), strict=True)):
        h, w = image.shape[-2:]
        if sample.get("coverage") is None:  # rendered views are cropped as their target asks
            _check_principal_point(k, K[k], (h, w))
        calibration: dict[str, Any] = {"K": K[k], "cam2ego": cam2ego[k], "lens": lens, "distortion": distortion}
        cameras.append(Camera(name=f"camera {k}", width_px=w, height_px=h, **calibration))
    given = sample.get("ground_z_m")
    ground_z_m = numbers("ground_z_m", 0.0 if given is None else given, index)
    if ground_z_m.size != 1:
        raise SampleError(f"ground_z_m: expected one height for each frame, got shape {ground_z_m.shape}")
    return Rig(cameras, ground_z_m=float(ground_z_m.item()))


def _check_principal_point(k: int, K: np.ndarray, size: tuple[int, int]) -> None:
    """Refuse a K that was made for another image size; ``Camera`` refuses NaN."""
    h, w = size
    x, y = (K[0, 2] + 0.5) / w - 0.5, (K[1, 2] + 0.5) / h - 0.5  # from the image's centre, as a share of its size
    off_swapped = max(abs((K[0, 2] + 0.5) / h - 0.5), abs((K[1, 2] + 0.5) / w - 0.5))
    outside = max(abs(x), abs(y)) > 0.5 and min(abs(x), abs(y)) > _ON_CENTER  # crops may leave it out on one side
    scaled = max(x, y) < -_OFF_CENTER or min(x, y) > _OFF_CENTER
    swapped = max(abs(x), abs(y)) > 0.12 and off_swapped < 0.05
    if not (outside or scaled or swapped):
        return
    where = "inside the image" if outside else "near the middle of the image"
    fix = "height and width are swapped" if swapped else "K of another image size? Camera.resize scales K"
    got = f"({K[0, 2]:g}, {K[1, 2]:g}); {fix}; pass rig= if the camera is really like this"
    raise SampleError(f"K[{k}]: expected a principal point {where} of (h, w) = {(h, w)}, got {got}")


def _lenses(sample: Mapping[str, Any], count: int, index: tuple[int, ...]) -> list[tuple[Any, tuple[float, ...]]]:
    """Lens and coefficients of each camera, without the zeros that pad them to a common number."""
    names, distortion = sample.get("lens"), sample.get("distortion")
    coefficients = None if distortion is None else numbers("distortion", distortion, index)
    if names is None:
        if coefficients is not None and coefficients.any():
            expected = f"'lens' beside it, one of {', '.join(LENSES)} for each camera"
            raise SampleError(f"distortion: expected {expected}{hint(sample, ('lens',))}")
        return [("pinhole", ())] * count
    if not isinstance(names, list | tuple) or len(names) != count:
        raise SampleError(f"lens: expected a list of {count} names, one for each camera, got {shown(names)}")
    lenses = [_lens(name, index) for name in names]
    if all(lens in LENSES and LENSES[lens].coefficient_counts == (0,) for lens in lenses):
        return [(lens, ()) for lens in lenses]
    if coefficients is None or coefficients.ndim != 2 or len(coefficients) != count:
        got = f"none{hint(sample, ('distortion',))}" if coefficients is None else f"shape {coefficients.shape}"
        raise SampleError(f"distortion: expected shape ({count}, up to 8) for the lenses {lenses}, got {got}")
    result = []
    for lens, row in zip(lenses, coefficients.tolist(), strict=True):
        size = LENSES[lens].coefficient_counts[-1] if lens in LENSES else len(row)
        result.append((lens, tuple(row) if any(row[size:]) else tuple(row[:size])))
    return result


def _lens(name: Any, index: tuple[int, ...]) -> str:
    """The lens of a camera in one frame: ``default_collate`` makes lists of a batch's names."""
    for i in index:
        if isinstance(name, str):
            break
        if not isinstance(name, list | tuple) or not i < len(name):
            raise SampleError(f"lens: expected a name for each frame of the batch, got {shown(name)}")
        name = name[i]
    if not isinstance(name, str):
        raise SampleTypeError(f"lens: expected names, one for each camera, got {shown(name)}")
    return canonical_name(name)


def _with_masks(rig: Rig, sample: Mapping[str, Any], lead: tuple[int, ...], index: tuple[int, ...]) -> Rig:
    """The rig, masked where an earlier retargeting saw nothing (``coverage``) or its own car (``ego_mask``)."""
    masks: list[BoolArray | None] = [camera.mask for camera in rig]
    for key in ("coverage", "ego_mask"):
        if sample.get(key) is None:
            continue
        try:
            maps = entry(sample[key], lead, index)
            hidden = [~m if key == "coverage" else m for m in maps]
            for k, (camera, pixels) in enumerate(zip(rig, hidden, strict=True)):
                if tuple(pixels.shape) != camera.size or pixels.dtype != torch.bool:
                    raise ValueError(f"got {pixels.dtype} {tuple(pixels.shape)}")
                if pixels.any():
                    visible, mask = ~pixels.cpu().numpy(), masks[k]
                    masks[k] = visible if mask is None else mask & visible
        except (TypeError, ValueError, AttributeError, RuntimeError) as error:  # RuntimeError: meta, sparse
            expected = f"a bool tensor of each image's size, as an earlier retargeting gives it ({error})"
            raise SampleError(f"{key}: expected {expected}; rename the key if it is something else") from None
    if all(mask is camera.mask for mask, camera in zip(masks, rig, strict=True)):
        return rig
    return rig.with_cameras([replace(camera, mask=mask) for camera, mask in zip(rig, masks, strict=True)])


def numbers(key: str, value: Any, index: tuple[int, ...] = ()) -> FloatArray:
    """An entry of a sample as a float64 array, at an ``index`` into its leading dimensions; scalars hold for all."""
    array = np.asarray(as_array(key, value), np.float64)
    try:
        return np.asarray(array[index]) if array.ndim else array
    except IndexError:
        raise SampleError(f"{key}: expected the images' leading dimensions, got shape {array.shape}") from None


def as_array(key: str, value: Any) -> Points:
    """An entry of a sample as an array: float32 in the same memory, anything else as float64."""
    try:
        if isinstance(value, torch.Tensor):
            value = value.detach().cpu()
            value = (value if value.dtype == torch.float32 or value.is_complex() else value.double()).numpy()
        if np.iscomplexobj(value):
            raise TypeError("complex numbers")
        array = np.asarray(value)
        return array if array.dtype == np.float32 else np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # RuntimeError: quantised and meta tensors
        got = f"{type(value).__name__} ({one_line(error, 120)})"
        raise SampleTypeError(f"{key}: expected a tensor of numbers, got {got}") from None


PROJECTION_KEYS = (
    *("lidar2img", "lidar2image", "ego2img", "global2img", "world2img"),
    *("projection", "projection_mat", "projection_matrix", "proj_mat", "P", "P2"),
)
"""Keys that are functions of intrinsics and poses."""

PIXEL_BOUND_KEYS = (
    *("boxes_2d", "boxes2d", "bboxes_2d", "bboxes2d", "gt_boxes_2d", "gt_bboxes_2d", "gt_bboxes"),
    *("labels_2d", "labels2d", "centers_2d", "centers2d"),
    *("detections", "depths", "depth", "depth_m", "gt_depth", "keypoints_2d"),
    *("source_camera", "source_frame", "confidence", "generated", "sources"),
    *("img_metas", "img_aug_matrix", "post_rots", "post_trans"),
    *USUAL_NAMES["K"],
    *PROJECTION_KEYS,
)
"""Keys bound to the source's pixels; they are dropped, as they would be stale in the target's views."""

POSE_KEYS = (
    *USUAL_NAMES["cam2ego"],
    *("ego2cam", "lidar2cam", "lidar2camera", "cam2lidar", "camera2lidar"),
    *("cam2global", "global2cam", "cam2world", "world2cam"),
)
CAMERA_KEYS = (
    *POSE_KEYS,
    *("distortions", "dist_coeffs", "distortion_coeffs", "distortion_coefficients", "img_filename"),
)
"""Keys that speak of the source's cameras; they would be stale, too."""

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
    """The keys that hold label maps; refuse others that may be bound to the source's pixels.

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
        first = value[0] if isinstance(value, list | tuple) and value else value
        if _tv_tensor(first) == "Mask":
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
    """Say what a leaf of an entry is, which has the images' height and width, and what to do with it."""
    shape = tuple(leaf.shape)
    image = images[0] if isinstance(images, list | tuple) else images
    is_nested = leaf is not value and not (isinstance(value, list | tuple) and any(leaf is one for one in value))
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


def misnamed_keys(sample: Mapping[str, Any], calibrated: bool, static: bool = False) -> dict[str, str]:
    """Keys that are probably misnamed and would not be read, and what is meant.

    Where ``calibrated``, a rig stands for ``lens``, ``distortion`` and ``ground_z_m``; where ``static``, no ego-frame
    key is used.
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
    """Say that a focal length is too short for pixels, as (found, fix); None if it is not."""
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
