"""Fields of cameras in tables and files that speak of a lens: what is not read must say nothing."""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from typing import Any

from arbiview_aug.errors import shown

_KEYS = re.compile(
    r"distort|^dist$|dist_?co|lens|fish|rectif|projection_(?:model|type)|skew|mirror|polynom"
    r"|^(?:camera_|cam_)?model(?:_type)?$|^(?:d|xi|alpha|beta|[kpj]\d)$",
    re.IGNORECASE,
)
_NO_LENSES = ("", "none", "null", "false", "no", "pinhole", "perspective", "rectilinear", "rectified", "undistorted")
_LENSES = re.compile(
    r"fish|equi|kannala|kb4|omni|mei|unified|sphere|eucm|^ds$|theta|scaramuzza|^poly|_poly$|cylind|division|fov|distort",
    re.IGNORECASE,
)
"""Words of models that are not the perspective one; others, such as plumb_bob, mean nothing without coefficients."""
_FLAT = (None, True, "true", "yes", [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [1, 0, 0, 0, 1, 0, 0, 0, 1])
"""Values of ``rectified`` and the like that turn nothing."""


def unread_lens(entry: Mapping[str, Any], read: Collection[str] = ()) -> str | None:
    """``KEY: VALUE`` of a lens that an entry has under a key that is not ``read``; None if all others are neutral."""
    for key, value in entry.items():
        if isinstance(key, str) and key not in read and _KEYS.search(key):
            is_flag, is_name = (
                any(word in key.lower() for word in of) for of in (("rectif", "undis"), ("model", "lens"))
            )
            if not (value in _FLAT if is_flag else is_neutral(value, is_name)):
                return f"{key}: {shown(value)}"
    return None


def is_neutral(value: Any, is_name: bool = False, levels: int = 3) -> bool:
    """Whether a value is nothing, 0, the name of a pinhole camera, or such values alone; ``is_name``: of a model."""
    if isinstance(value, str):
        return value.strip().lower() in _NO_LENSES or (is_name and not _LENSES.search(value))
    if isinstance(value, Mapping | list | tuple):
        values = value.values() if isinstance(value, Mapping) else value
        return levels > 0 and all(is_neutral(one, is_name, levels - 1) for one in values)
    return not value
