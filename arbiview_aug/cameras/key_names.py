"""Hints for misnamed keys: "did you mean …"."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from numbers import Number
from typing import Any

from arbiview_aug.errors import CalibrationError

USUAL_NAMES = {
    "images": ("image", "imgs", "img"),
    "K": ("intrinsics", "intrinsic", "camera_intrinsics", "camera_intrinsic", "cam_intrinsic", "cam2img", "Ks"),
    "cam2ego": (
        *("extrinsics", "extrinsic", "cam_to_ego", "camera_to_ego", "cam2egos", "camera2ego", "sensor2ego"),
        *("cam2vehicle", "cam_to_vehicle"),
    ),
    "distortion": ("distortions", "dist", "dist_coeffs", "distortion_coeffs", "distortion_coefficients", "D", "coeffs"),
    "lens": ("lenses", "lens_model", "distortion_model", "camera_model"),
    "ground_z_m": ("ground_z", "ground_height", "ground_height_m", "road_z_m"),
    "points": ("lidar_points", "lidar", "pts", "point_cloud", "pointcloud", "lidar_pts"),
    "boxes_3d": ("gt_boxes", "gt_bboxes_3d", "gt_boxes_3d", "bboxes_3d", "boxes3d", "boxes"),
    "depth_m": ("depth", "depth_map", "depth_maps"),
    "neighbours": ("neighbors",),
    "ego2world": ("ego_to_world", "ego2global"),
    "lidar": ("lidar_points", "points", "point_cloud", "lidar_file"),
    "file": ("filename", "file_name", "image", "image_file", "img_path", "image_path"),
    "mask": ("mask_file", "mask_path", "ego_mask"),
    "width": ("width_px", "image_width", "w"),
    "height": ("height_px", "image_height", "h"),
    "cameras": ("cams", "sensors"),
    "lidars": ("lidar", "lidar_sensors", "laser_scanners", "lasers", "scanners", "scanner", "laser"),
}
"""Common names of the keys in other tools."""

_CALLED = {
    "pinhole": "none no null undistorted pinhole perspective ideal",
    "radtan": "plumbbob rationalpolynomial rational radtan radialtangential brown brownconrady opencv opencvradtan",
    "fisheye": "equidistant equi fisheye opencvfisheye kannalabrandt kannalabrandt4 kannalabrandt8 kb4 kb8",
    "unified": "mei omni omnidir omnidirectional ucm",
    **{"double_sphere": "doublesphere ds", "eucm": "eucm", "ftheta": "ftheta", "ftheta_backward": "fthetabackward"},
}
_LENSES = {spelling: lens for lens, spellings in _CALLED.items() for spelling in spellings.split()}
"""This package's lens by the names that tools give it; ``unified`` is MEI and omni."""

_LIKENESS = 0.88
"""Least difflib ratio of a misspelling: ``masks`` for ``mask`` is one, ``boxes_2d`` for ``boxes_3d`` is not."""


def misnamed(entries: Mapping[Any, Any], read: Sequence[str]) -> dict[str, str]:
    """Keys of ``entries`` that probably mean one of the ``read`` keys that are absent or null."""
    names = tuple(read)
    meanings = ((key, meant_by(key, names)) for key in entries if isinstance(key, str))
    return {k: meant for k, meant in meanings if meant and entries.get(meant) is None and _could_be(meant, entries[k])}


def hint(entries: Iterable[Any], wanted: Sequence[str]) -> str:
    """Suggestions for an error about missing keys; empty without any."""
    names = tuple(wanted)
    pairs = [(key, meant) for key in entries if isinstance(key, str) and (meant := meant_by(key, names))]
    return "".join(f"; found {key!r}: did you mean {meant!r}?" for key, meant in pairs)


def plain(key: Any) -> str:
    """A key or a model's name without case and punctuation: ``Camera_Matrix`` and ``cameraMatrix`` are one."""
    return re.sub("[^a-z0-9]", "", str(key).lower())


def lens_called(value: Any) -> str | None:
    """This package's lens of a model's name in any tool, ``unified`` for MEI and omni; None for an unknown name."""
    return _LENSES.get(plain(value))


def refuse_unknown(entries: Iterable[Any], known: Sequence[str], where: str) -> None:
    """CalibrationError for unknown keys of this package's files; keys that begin with _ are notes."""
    for key in entries:
        if key not in known and not str(key).startswith(("_", ".", "x-")):
            meant = meant_by(key, tuple(known)) if isinstance(key, str) else None
            guess = f"did you mean {meant!r}?" if meant else f"expected keys are {', '.join(sorted(known))}"
            got = f"{str(key)[:100]!r} is not read: {guess}; if it is a note, begin it with _"
            raise CalibrationError(f"{where}: {got}")


def check_keys(entry: Any, needed: Sequence[str], known: Sequence[str], where: str) -> None:
    """CalibrationError unless an entry of a file is a mapping that has the needed keys."""
    if not isinstance(entry, Mapping):
        raise CalibrationError(f"{where}: expected a mapping, got {type(entry).__name__}")
    if missing := [key for key in needed if entry.get(key) is None]:
        expected = f"expected keys {', '.join(known)}, missing {', '.join(missing)}"
        raise CalibrationError(f"{where}: {expected}{hint(entry, missing)}")


@lru_cache(maxsize=4096)
def meant_by(key: str, names: tuple[str, ...]) -> str | None:
    """The name that a key is a common alias or a misspelling of."""
    if key in names:
        return None
    usual = (name for name in names if key in USUAL_NAMES.get(name, ()))
    spelled = {name.lower(): name for name in names}
    close = difflib.get_close_matches(key.lower(), spelled, n=1, cutoff=_LIKENESS)
    return next(usual, spelled[close[0]] if close else None)


def _could_be(meant: str, value: Any) -> bool:
    """Whether a value fits the key: paths, counts and 2D boxes have similar names."""
    if meant in ("points", "boxes_3d", "depth_m", "neighbours") and isinstance(value, str | Number | Mapping):
        return False
    if meant == "lidar" and isinstance(value, Number):
        return False
    if meant == "boxes_3d":
        first = value[0] if isinstance(value, list | tuple) and value else value
        last = first.shape[-1:] if hasattr(first, "shape") else [len(first)] if isinstance(first, list | tuple) else ()
        return all(n >= 7 for n in last)
    return value is not None
