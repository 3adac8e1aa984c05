"""The camera matrices of mmdet3d's family: one rig under many names, as lists, arrays or tensors, 3×3 or 4×4."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.errors import ArbiviewError, SampleError, one_line

MATRICES = {
    **dict.fromkeys(("cam2img", "cam_intrinsic", "intrinsics", "camera_intrinsics", "ori_cam2img"), "K"),
    **dict.fromkeys(("lidar2cam", "lidar2camera", "extrinsics"), "lidar2cam"),
    **dict.fromkeys(("cam2lidar", "camera2lidar"), "cam2lidar"),
    **dict.fromkeys(("cam2ego", "camera2ego"), "cam2ego"),
    **dict.fromkeys(("lidar2img", "lidar2image", "ori_lidar2img"), "lidar2img"),
    "cam2global": "cam2global",
}
"""Matrix of each key, for each camera."""

_TOLERANCE = 1e-3
"""Largest difference between ``lidar2img`` and K @ lidar2cam, as a share of their largest entry: float32 leaves 1e-6, a
resize by 1 % is 1e-2."""


@contextmanager
def entry(key: str, expected: str) -> Iterator[None]:
    """Turn other packages' errors over an entry into ``SampleError`` with its key."""
    try:
        yield
    except ArbiviewError:
        raise
    except (TypeError, ValueError, LookupError, AttributeError, OverflowError, RuntimeError) as error:
        got = f"{type(error).__name__}: {one_line(error, 120)}"
        raise SampleError(f"{key}: expected {expected}, got {got}") from None


@dataclass(frozen=True)
class ResultCameras:
    """The cameras of a ``results`` dict."""

    names: Sequence[str]
    K: FloatArray  # (n, 3, 3)
    cam2ego: FloatArray  # (n, 4, 4), in the ego frame at the LiDAR's time
    lidar2ego: FloatArray  # (4, 4)
    ego2global: FloatArray | None = None  # (4, 4) the ego at the LiDAR's time, where the dict tells

    def matrices(self, kind: str) -> FloatArray:
        """(n, 4, 4) of a kind among ``MATRICES``' values."""
        K = padded(self.K)
        lidar2cam: FloatArray = np.linalg.inv(self.cam2ego) @ self.lidar2ego
        if kind == "cam2global":
            assert self.ego2global is not None
            return self.ego2global @ self.cam2ego
        return {
            "K": K,
            "cam2ego": self.cam2ego,
            "lidar2cam": lidar2cam,
            "cam2lidar": np.asarray(np.linalg.inv(lidar2cam)),
            "lidar2img": K @ lidar2cam,
        }[kind]


def read_views(matrices: Mapping[str, Any], count: int, names: Sequence[str], lidar2ego: FloatArray) -> ResultCameras:
    """The cameras that a dict's matrices (values of the keys of ``MATRICES``, each of ``count`` cameras) describe.

    ``cam2ego`` is not read: mmdet3d's is the mounting alone; ``lidar2cam`` includes the vehicle's motion between LiDAR
    and camera. Missing and contradictory matrices are a ``SampleError``.
    """
    of: dict[str, FloatArray] = {}
    for key, kind in MATRICES.items():
        if key in matrices and kind not in of:
            stack = stacked(key, matrices[key], count)
            of[kind] = stack.transpose(0, 2, 1) if is_transposed(stack) else stack
    if "cam2lidar" in of and "lidar2cam" not in of:
        with entry("cam2lidar", "matrices that can be inverted"):
            of["lidar2cam"] = np.asarray(np.linalg.inv(of["cam2lidar"]), np.float64)
    if "K" in of and "lidar2cam" in of:
        lidar2img = of["K"] @ of["lidar2cam"]
        off = np.abs(of.get("lidar2img", lidar2img) - lidar2img).max() / np.abs(lidar2img).max(initial=1e-9)
        if not off <= _TOLERANCE:  # NaN too
            raise SampleError(
                f"lidar2img: expected K @ lidar2cam, got matrices that differ by {off:.1%}; retarget right after "
                "loading, before the images or the points are resized, cropped, flipped or turned"
            )
    elif "lidar2img" in of:
        lidar2img = of["lidar2img"]
    else:
        raise SampleError(
            "results: expected the cameras' matrices, 'lidar2img' or 'cam2img' and 'lidar2cam' under one of "
            f"their names ({', '.join(MATRICES)}), got {', '.join(matrices) or 'none'}"
        )
    if "K" not in of or "lidar2cam" not in of or np.any(of["K"][:, :3, 3]):  # P2 of KITTI: a place in its last column
        with entry("lidar2img", "matrices that can be decomposed"):
            K, lidar2cam = decomposed(lidar2img)
    else:
        K, lidar2cam = of["K"][:, :3, :3], of["lidar2cam"]
    with entry("lidar2cam", "matrices that can be inverted"):
        cam2ego = lidar2ego @ np.linalg.inv(lidar2cam)
    ego2global = of["cam2global"][0] @ np.linalg.inv(cam2ego[0]) if "cam2global" in of else None
    return ResultCameras(names, K, cam2ego, lidar2ego, ego2global)


def is_transposed(stack: FloatArray) -> bool:
    """Whether poses (n, 4, 4) have their translations in the last row: PETR's ``extrinsics``, but not StreamPETR's."""
    return bool(np.any(stack[:, 3, :3]) and not np.any(stack[:, :3, 3]))


def decomposed(lidar2img: FloatArray) -> tuple[FloatArray, FloatArray]:
    """K (n, 3, 3) and lidar2cam (n, 4, 4) of projections (n, 4, 4)."""
    K, R = upper_triangular(lidar2img[:, :3, :3])
    lidar2cam = np.tile(np.eye(4), (len(K), 1, 1))
    lidar2cam[:, :3, :3] = R
    lidar2cam[:, :3, 3:] = np.linalg.solve(K, lidar2img[:, :3, 3:])
    scale = K[:, 2:, 2:]
    return K / scale, lidar2cam


def upper_triangular(M: FloatArray) -> tuple[FloatArray, FloatArray]:
    """K, upper triangular with a positive diagonal, and R (n, 3, 3) with M = K R (RQ decomposition), for det M > 0."""
    flip = np.eye(3)[::-1]
    Q, R = np.linalg.qr((flip @ M).transpose(0, 2, 1))
    K, rotation = flip @ R.transpose(0, 2, 1) @ flip, flip @ Q.transpose(0, 2, 1)
    sign = np.sign(np.diagonal(K, axis1=1, axis2=2))
    return K * sign[:, None, :], sign[:, :, None] * rotation


def stacked(key: str, value: Any, count: int) -> FloatArray:
    """(n, 4, 4) float64 of a value that holds a matrix for each camera; SampleError for another number or shape."""
    try:
        array = np.stack([np.asarray(matrix, np.float64) for matrix in value])
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.ndim != 3 or len(array) != count or not {*array.shape[1:]} <= {3, 4}:
        got = f"shape {array.shape}" if array.size else type(value).__name__
        raise SampleError(f"{key}: expected {count} matrices, 3×3 or 4×4, one for each image, got {got}")
    return padded(array)


def padded(matrices: FloatArray) -> FloatArray:
    """(n, 4, 4) from (n, 3 or 4, 3 or 4)."""
    full = np.tile(np.eye(4), (len(matrices), 1, 1))
    full[:, : matrices.shape[1], : matrices.shape[2]] = matrices
    return full


def like_given(original: Any, matrices: FloatArray) -> Any:
    """Matrices (n, 4, 4) as the given ones are: their container, their types, their shape."""
    first = original[0]
    rows, columns = np.shape(first)
    parts = matrices[:, :rows, :columns]
    if isinstance(original, torch.Tensor | np.ndarray) or not isinstance(first, torch.Tensor | np.ndarray):
        return like_array(original, parts)
    return type(original)([like_array(first, part) for part in parts])


def like_array(original: Any, values: Any) -> Any:
    """Numbers as the given ones are: a tensor or an array of their type, else a list or tuple."""
    if isinstance(original, torch.Tensor):
        return torch.tensor(np.asarray(values)).to(original)
    if isinstance(original, np.ndarray):
        return np.asarray(values).astype(original.dtype)
    return type(original)(np.asarray(values).tolist())
