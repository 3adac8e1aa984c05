"""What a training reads of samples: boxes that are seen, cells that saw something real, depth maps, and batches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import checked_stride
from arbiview_aug.errors import SampleError, SampleTypeError, warn
from arbiview_aug.sample.batching import lens_names, rewrapped, stacked
from arbiview_aug.sample.boxes_2d import rig_of
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.sample.inputs import DEPTH_KEYS
from arbiview_aug.scene.boxes import PIECES, checked_boxes, draw_solids, silhouette_sums, solids
from arbiview_aug.scene.point_cloud import checked_points

SEEN_SHARE, SEEN_PX = 0.1, 32
"""Share of an object's pixels in one image that must be seen, or the number that are enough however much of it is
hidden: half a cell of most detectors."""

STACKED = ("images", "K", "cam2ego", "coverage", "ego_mask", "distortion", "ego2world", "ego2ego", *DEPTH_KEYS)
"""Keys of one shape in all frames of a rig; so have maps over the images. All else is a list: of points and boxes
each frame has its own number."""

_ABSENT = {"coverage": True, "generated": False, "ego_mask": False}
"""Masks that samples without them stand for: all is seen, nothing made up, no car of one's own in the image."""

_CALIBRATION = ("rig", "K", "cam2ego", "lens", "distortion", "ground_z_m", "ego2ego")
"""Keys without which the others mean something else."""


def visible_boxes(sample: Mapping[str, Any]) -> BoolArray:
    """Boxes that some camera of a sample sees, to ignore the others in a detector's loss.

    Objects occlude each other by what they fill of their boxes; walls and trees are unknown. Pixels count that
    ``coverage`` holds, generated ones do not.

    Args:
        sample: An unbatched output of ``RigRetarget`` with ``boxes_3d``.

    Returns:
        (B,) bool: True where one image shows ``SEEN_SHARE`` of the box's pixels, or ``SEEN_PX`` if those are fewer.

    Raises:
        SampleError: No boxes, or a batch.
    """
    _check("visible_boxes", sample)
    if sample.get("boxes_3d") is None:
        raise SampleError("visible_boxes: expected a sample with 'boxes_3d', got none")
    cameras, boxes = rig_of(sample), checked_boxes(sample["boxes_3d"])
    visible = np.zeros(len(boxes), bool)
    for camera in cameras if len(boxes) else ():
        _, piece = draw_solids(camera, boxes, solids(boxes), faces=False)
        shown = piece >= 0 if camera.mask is None else (piece >= 0) & camera.mask
        seen_px = np.bincount(piece[shown] // PIECES, minlength=len(boxes))
        needed_px = np.minimum(SEEN_SHARE * silhouette_sums(camera, boxes, np.ones(camera.size)), SEEN_PX)
        visible |= (seen_px > 0) & (seen_px >= needed_px)
    return visible


def lift_mask(sample: Mapping[str, Any], stride: int) -> torch.Tensor | list[torch.Tensor]:
    """Feature cells that saw something real, to lift no others into a bird's-eye view.

    Args:
        sample: An output of ``RigRetarget``; its ``coverage`` is read, and ``ego_mask`` if there is one.
        stride: Pixels of an image along a side of a cell.

    Returns:
        (..., M, ceil(h / stride), ceil(w / stride)) bool, True where half a cell is covered; a list over the cameras
        where ``coverage`` is one.

    Raises:
        SampleError: No ``coverage``.
        ValueError: ``stride`` is no whole number from 1.
    """
    stride = checked_stride("stride", stride)
    _check("lift_mask", sample)
    if sample.get("coverage") is None:
        raise SampleError("lift_mask: expected an output of RigRetarget with 'coverage', got none")
    coverage, ignore = sample["coverage"], sample.get("ego_mask")
    maps, is_list = (coverage if isinstance(coverage, list) else [coverage]), isinstance(coverage, list)
    masks = [None] * len(maps) if ignore is None else ignore if is_list else [ignore]
    pooled = []
    for seen, mask in zip(maps, masks, strict=True):
        real = (seen if mask is None else seen & ~mask).float()
        planes = real.reshape(-1, 1, *real.shape[-2:])
        share = torch.nn.functional.avg_pool2d(planes, stride, ceil_mode=True)  # of what lies in the image
        pooled.append((share >= 0.5).reshape(*real.shape[:-2], *share.shape[-2:]))
    return pooled if is_list else pooled[0]


def _check(function: str, sample: Any) -> None:
    if not isinstance(sample, Mapping):
        raise SampleTypeError(f"{function}: expected an output of RigRetarget, got {type(sample).__name__}")


def depth_maps(points: Any, cameras: Rig | Mapping[str, Any]) -> torch.Tensor | list[torch.Tensor]:
    """Depth maps as BEVDepth and BEVDet supervise depth with: the nearest point in each pixel.

    Retargeted points are those of the target's scanners, so that depth maps and images are of one vehicle. Points are
    sparse: those behind a surface show through its gaps, as in the frameworks' own maps.

    Args:
        points: (P, >=3) in the cameras' ego frame.
        cameras: A rig, or an unbatched sample, such as ``RigRetarget`` returns.

    Returns:
        (N, h, w) float32 z-depth in the camera's frame, metres; 0 without a point. A list where sizes differ.

    Raises:
        SampleError: Points of another shape; a batch of samples.
    """
    rig, array = rig_of(cameras), checked_points(as_array("points", points))
    maps = []
    for camera in rig:
        uv, depth_m, valid = camera.project(array)
        pixel, (h, w) = np.rint(uv), camera.size
        seen = valid & (depth_m > 0) & (pixel >= 0).all(axis=1) & (pixel < (w, h)).all(axis=1)
        column, row = pixel[seen].astype(int).T
        nearest = np.full(camera.size, np.inf, np.float32)
        np.minimum.at(nearest, (row, column), depth_m[seen].astype(np.float32))
        maps.append(torch.from_numpy(np.where(np.isfinite(nearest), nearest, np.float32(0))))
    return stacked(maps)


# --- batches
def collate(samples: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """A batch of samples, before or after ``RigRetarget``: a ``collate_fn`` for frames with points and boxes.

    Cameras and maps over their images are stacked; of points, boxes and all else there is a list, an entry a frame.
    ``lens`` stays a name for each camera, or has a list over the frames where they differ; torch's ``default_collate``
    makes tuples of each camera's names, which ``RigRetarget`` reads as well.
    Frames of one rig keep it. If each has its own (nuScenes: cameras and LiDAR expose at different times), ``K`` and
    ``cam2ego`` say so.

    Keys that some samples lack are left out, with a warning; but samples without ``coverage``, ``generated`` or
    ``ego_mask`` are covered, not generated, and show no car.

    Args:
        samples: At least one.

    Raises:
        SampleError: No samples; other calibrations in some than in others; or rigs that differ and have lenses or
            masks: tensors carry neither.
    """
    if not samples or not all(isinstance(sample, Mapping) and "images" in sample for sample in samples):
        raise SampleError("collate: expected one or more samples with 'images', got none or something else")
    samples = _with_equal_keys(samples)
    first = samples[0]
    batch: dict[str, Any] = {}
    for key in sorted(first, key=lambda key: key == "rig"):  # last, as a rig wins over K and cam2ego
        values = [sample[key] for sample in samples]
        if key in (*STACKED, "rig", "lens", "ground_z_m") and any(value is None for value in values):
            if any(value is not None for value in values):
                raise SampleError(f"collate: {key}: expected a value in all samples or in none, got None in some")
            batch[key] = None
        elif key == "rig":
            batch |= _rigs(values)
        elif key in STACKED or _are_maps(values, first["images"]):
            batch[key] = _stacked(key, values)
        elif isinstance(values[0], Mapping) and "images" in values[0]:  # the ``sources`` of a view
            batch[key] = collate(values)
        elif key == "lens":
            batch[key] = lens_names([list(names) for names in values], (len(values),))
        elif key == "ground_z_m":
            batch[key] = torch.tensor([float(value) for value in values], dtype=torch.float64)
        else:
            batch[key] = values
    return batch


def _with_equal_keys(samples: Sequence[Mapping[str, Any]]) -> Sequence[Mapping[str, Any]]:
    """The samples with the keys that all have, completed by masks; SampleError if a calibration is not among them."""
    if all(set(sample) == set(samples[0]) for sample in samples):
        return samples
    masks = {key: value for key, value in _ABSENT.items() if any(sample.get(key) is not None for sample in samples)}
    filled = []
    for sample in samples:
        missing = {key: value for key, value in masks.items() if sample.get(key) is None}
        images = [image.shape[-2:] for image in sample["images"]]
        filled.append({**sample, **{k: stacked([torch.full(i, v) for i in images]) for k, v in missing.items()}})
    common = set(filled[0]).intersection(*filled)
    odd = sorted({str(key) for sample in filled for key in sample if key not in common})
    if needed := [key for key in odd if key in _CALIBRATION]:
        fix = "retarget in the dataset (RetargetedDataset), or give all of them"
        raise SampleError(f"collate: expected {', '.join(needed)} in all samples or in none, got some without; {fix}")
    if odd:
        warn(f"collate: left out {', '.join(odd)}, which not all samples have")
    return [{key: sample[key] for key in sample if key in common} for sample in filled]


def _are_maps(values: Sequence[Any], images: Any) -> bool:
    """Whether all values are maps over all images: label maps, masks; of a sample, or of a batch."""
    sizes, maps = [tuple(image.shape[-2:]) for image in images], list[Any]()
    for value in values:  # points have many rows
        is_list = isinstance(value, list | tuple) or (isinstance(value, torch.Tensor) and value.ndim > 0)
        maps.append(value if is_list and len(value) == len(sizes) else ())
    return all([tuple(m.shape[-2:]) if isinstance(m, torch.Tensor) else None for m in ms] == sizes for ms in maps)


def _stacked(key: str, values: Sequence[Any]) -> Any:
    """One tensor, or where cameras have tensors of their own a list of one for each camera; tv_tensors stay such."""
    try:
        values = [torch.from_numpy(value.copy()) if isinstance(value, np.ndarray) else value for value in values]
        if all(isinstance(value, torch.Tensor) for value in values):
            return rewrapped(torch.stack(list(values)), values[0])
        cameras = [torch.stack(list(of_camera)) for of_camera in zip(*values, strict=True)]
        return rewrapped(cameras, values[0])
    except (TypeError, ValueError, RuntimeError) as error:
        raise SampleError(f"collate: {key}: expected equal shapes in all samples: {error}") from None


def _rigs(rigs: Sequence[Any]) -> dict[str, Any]:
    if all(rig == rigs[0] for rig in rigs):
        return {"rig": rigs[0]}
    for camera in chain.from_iterable(rigs):
        if not camera.is_rectilinear or camera.mask is not None:
            fix = "retarget in the dataset (RetargetedDataset)"
            expected = f"pinhole cameras without masks where rigs differ; {fix}"
            raise SampleError(f"collate: camera {camera.name!r}: expected {expected}")
    return {
        "K": torch.stack([torch.from_numpy(rig.K) for rig in rigs]),
        "cam2ego": torch.stack([torch.from_numpy(rig.cam2ego) for rig in rigs]),
        "ground_z_m": torch.tensor([rig.ground_z_m for rig in rigs], dtype=torch.float64),
    }
