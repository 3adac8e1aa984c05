"""Depth maps of points, and batches of samples."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import SampleError, warn
from arbiview_aug.sample.batching import lens_names, rewrapped, stacked
from arbiview_aug.sample.boxes_2d import rig_of
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.sample.inputs import DEPTH_KEYS
from arbiview_aug.scene.point_cloud import checked_points

STACKED = ("images", "K", "cam2ego", "coverage", "ego_mask", "distortion", "ego2world", "ego2ego", *DEPTH_KEYS)
"""Keys that ``collate`` stacks, as it does maps over the images. All else becomes a list: the number of points and
boxes differs from frame to frame."""

_ABSENT = {"coverage": True, "generated": False, "ego_mask": False}
"""Values of masks that a sample lacks: everything seen, nothing generated, no ego car in the image."""

_CALIBRATION = ("rig", "K", "cam2ego", "lens", "distortion", "ground_z_m", "ego2ego")
"""Keys that all samples must have or none, as the others depend on them."""


def depth_maps(points: Any, cameras: Rig | Mapping[str, Any]) -> torch.Tensor | list[torch.Tensor]:
    """Depth maps as BEVDepth and BEVDet supervise depth with: the nearest point in each pixel.

    Retargeted points are those of the target's scanners, so that depth maps and images are of one vehicle. Points are
    sparse: those behind a surface show through its gaps, as in the frameworks' maps.

    Args:
        points: (P, >=3) in the cameras' ego frame.
        cameras: A rig, or an unbatched sample as ``RigRetarget`` returns it.

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
    """Batch samples, before or after ``RigRetarget``: a ``collate_fn`` for frames with points and boxes.

    Cameras and maps over their images are stacked; points, boxes and all else become lists with an entry for each
    frame. ``lens`` stays a name for each camera, or a list over the frames where they differ; torch's
    ``default_collate`` makes tuples of each camera's names, which ``RigRetarget`` reads as well. Frames of one rig keep
    it. If rigs differ (nuScenes: cameras and LiDAR expose at different times), ``K`` and ``cam2ego`` replace it.

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
    """One tensor, or a list of a tensor for each camera; tv_tensors keep their class."""
    try:
        values = [torch.from_numpy(value.copy()) if isinstance(value, np.ndarray) else value for value in values]
        if all(isinstance(value, torch.Tensor) for value in values):
            return rewrapped(torch.stack(list(values)), values[0])
        cameras = [torch.stack(list(frames)) for frames in zip(*values, strict=True)]
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
