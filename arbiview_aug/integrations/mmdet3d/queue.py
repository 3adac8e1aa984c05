"""Several frames of a drive in one dict: the queues that BEVFormer's and StreamPETR's datasets collect."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug.errors import SampleError
from arbiview_aug.integrations.mmdet3d.matrices import MATRICES
from arbiview_aug.integrations.mmdet3d.results import STALE_KEYS, target_outputs, without_stale

NUMBERS = ("image_wh", "focal", "img_timestamp", "timestamp")
"""Numbers of each frame, or of each of its cameras, where their first axis is as long as the queue."""

LABELS = ("gt_bboxes_3d", "points")
"""Lists of the frames' geometry; a single entry is the last frame's."""

Frame = dict[str, Any]


class OneDraw:
    """A ``RigRetarget`` whose further calls repeat the first one's draw: a vehicle keeps its cameras."""

    def __init__(self, retarget: Callable[..., dict[str, Any]], params: Mapping[str, float] | None = None) -> None:
        self.retarget, self.params = retarget, params

    def __call__(self, sample: dict[str, Any]) -> dict[str, Any]:
        """A retargeted sample."""
        out = self.retarget(sample, self.params)
        if self.params is None:
            self.params = out.get("retarget_params")
        return out


def is_queue(results: Mapping[str, Any]) -> bool:
    """Whether ``img`` holds images of several frames: a list of lists, or an axis more."""
    images = _content(results.get("img"))
    if not isinstance(images, list | tuple | np.ndarray | torch.Tensor) or not len(images):
        return False
    return isinstance(images[0], list | tuple) or getattr(images[0], "ndim", 0) == 4


def retarget_queue(results: Mapping[str, Any], retarget_frame: Callable[[Frame], Frame]) -> Frame:
    """Retarget the frames of a queue one by one, and put what changed where it was.

    A frame has its entries of ``img``, of the matrices that have an axis for frames, of ``NUMBERS`` and ``LABELS``, and
    all of its ``img_metas``. Poses of the vehicle (``can_bus``, ``ego_pose``, ``T_global``), ``prev_exists`` and labels
    stay. Values in mmcv's ``DataContainer`` stay in one.

    Args:
        results: The collected queue; it is not changed.
        retarget_frame: Function that retargets the dict of a frame.

    Raises:
        SampleError: Matrices or ``img_metas`` of another number of frames; what ``retarget_frame`` refuses.
    """
    held = {key: _content(value) for key, value in results.items()}
    count = len(held["img"])
    metas = _metas(held.get("img_metas", {}), count)
    sliced = [key for key, value in held.items() if _is_of_frames(key, value, count)]
    for key in (key for key in MATRICES if key in held and key not in sliced):
        raise SampleError(
            f"{key}: expected matrices for {count} frames, as many as of 'img', got {np.shape(held[key])}"
        )
    of_one = {*STALE_KEYS, *NUMBERS, *LABELS, "img_metas", *sliced}
    shared = {key: value for key, value in held.items() if key not in of_one}
    last = {key: held[key] for key in LABELS if key in held and key not in sliced}
    outs = []
    for t, meta in enumerate(metas):
        frame = shared | {key: held[key][t] for key in sliced} | meta
        outs.append(retarget_frame(frame | (last if t == count - 1 else {})))
    kept = without_stale(results)
    for key in sliced:
        if key not in (*LABELS, "timestamp") and key in outs[0]:
            kept[key] = _put_back(results[key], _together(held[key], [out[key] for out in outs]))
    if "points" in held:
        points = [out["points"] for out in outs] if "points" in sliced else outs[-1]["points"]
        kept["points"] = _put_back(results["points"], points)
    if "img_metas" in held:
        written = [{key: out[key] for key in meta if key in out} for meta, out in zip(metas, outs, strict=True)]
        metas_in = held["img_metas"]
        again = dict(zip(metas_in, written, strict=True)) if isinstance(metas_in, Mapping) else type(metas_in)(written)
        kept["img_metas"] = _put_back(results["img_metas"], again)
    return kept | target_outputs(outs)


def _metas(queued: Any, count: int) -> list[Frame]:
    """The ``img_metas`` of each frame: a list, or a dict by the frames' numbers."""
    metas = list(queued.values() if isinstance(queued, Mapping) else queued) or [{}] * count
    metas = [_content(meta) for meta in metas]
    if len(metas) != count or not all(isinstance(meta, Mapping) for meta in metas):
        raise SampleError(f"img_metas: expected a dict for each of the {count} frames of 'img', got {len(metas)}")
    return [dict(meta) for meta in metas]


def _is_of_frames(key: str, value: Any, count: int) -> bool:
    """Whether a value has an entry for each frame."""
    if not isinstance(value, list | tuple | np.ndarray | torch.Tensor) or len(value) != count:
        return False
    if key in MATRICES:
        return np.ndim(value[0]) == 3
    return key == "img" or key in LABELS or (key in NUMBERS and (key == "timestamp" or np.ndim(value[0]) > 0))


def _together(original: Any, values: Sequence[Any]) -> Any:
    """The frames' values in the container that they came in."""
    if isinstance(original, torch.Tensor):
        return torch.stack([torch.as_tensor(value) for value in values])
    return np.stack(values) if isinstance(original, np.ndarray) else type(original)(values)


def _content(value: Any) -> Any:
    """Content of mmcv's ``DataContainer``; other values as they are."""
    return value.data if hasattr(value, "cpu_only") and hasattr(value, "data") else value


def _put_back(container: Any, content: Any) -> Any:
    if content is not None and hasattr(container, "cpu_only"):
        settings = {name: getattr(container, name) for name in ("stack", "padding_value", "cpu_only", "pad_dims")}
        return type(container)(content, **settings)
    return content
