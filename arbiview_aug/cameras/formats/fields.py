"""One camera of another tool's file: keys that are read, neutral ones, and those that are refused by name."""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np

from arbiview_aug.cameras.formats.entries import WAY_OUT, matrix, refusal
from arbiview_aug.cameras.key_names import lens_called, plain
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.errors import shown

_K = "cameramatrix k mtx cameramat intrinsicmatrix intrinsics intrinsic camk cameraintrinsic cameraintrinsics"
_D = (
    "distortioncoefficients distortioncoefficient distortioncoeffs distortioncoeff distcoeffs distcoeff distortion "
    "dist d camd distortionvector cameradistortion coeffs"
)
# Spellings of ROS, Foxglove, OpenCV's samples and tools, Python scripts, Kalibr, Autoware.AI, CamOdoCal, MC-Calib, T4,
# WoodScape and DAIR-V2X, without case and punctuation.
_SPELLINGS = {
    **{"K": _K, "D": _D, "R": "rectificationmatrix r", "P": "projectionmatrix p"},
    "model": "cameramodel modeltype model lens lensmodel lenstype cameratype",
    "distortion model": "distortionmodel distmodel distortiontype cameradistortionmodel",
    "is fisheye": "fisheyemodel fisheye isfisheye usefisheye",
    **{"width": "imagewidth width imgwidth w", "height": "imageheight height imgheight h"},
    "size": "imagesize imgsize resolution dim size imagedimensions cameraresolution",
    "shape": "imageshape imgshape shape",
    **{"binning x": "binningx", "binning y": "binningy", "window": "roi"},
    **{"fx": "fx gamma1 mu", "fy": "fy gamma2 mv", "cx": "cx u0 ppx", "cy": "cy v0 ppy"},
}
_COEFFICIENTS = {"xi", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"}
_MEANINGS = {spelling: meaning for meaning, spellings in _SPELLINGS.items() for spelling in spellings.split()}
_MEANINGS |= {key: key for key in _COEFFICIENTS}
_WINDOW = ("width", "height", "x_offset", "y_offset")
_PINHOLE = ("fx", "fy", "cx", "cy")
_SCALARS = {*_PINHOLE, *_COEFFICIENTS, "width", "height", "binning x", "binning y"}
_GROUPS = {*_K.split(), *_D.split(), "projectionparameters", "distortionparameters", "mirrorparameters"}

# Words of keys that say something of the lens, or of the image too, and of those that say how a calibration was made.
_OF_LENS = re.compile(
    "dist|lens|fisheye|rectif|skew|mirror|prism|tangential|radial|poly|omni|cylind|(camera|intrinsics?|projection)(model|"
    r"type)|^[kpd]\d$"
)
_MATTERS = re.compile(
    _OF_LENS.pattern + "|crop|binning|alpha|flip|rotate|projection|(camera|intrinsics?)mat|offset|scale|intrin|coef|"
    r"resol|unit|^order|order$|major|optimal|aspect|^[str]\d$|^tau"
)
_NEUTRAL = re.compile(
    "distance|polygon|depth|error|rms|std|date|time|square|board|pattern|grid|guess|covar|points|extrin|pose|"
    "aspectratio$|^fix|^calib"
)
_ANY = re.compile("")
_NO_EFFECT = {"", "0", "00", "px", "pixel", "pixels", "row", "rowmajor", "opencv", "none", "false", "no"}
_CHOICE = "for raw images remove R and P; for rectified ones write P's left 3x3 as camera matrix, without coefficients"
_NAME_IT = "write distortion_model: plumb_bob (k1 k2 p1 p2), or equidistant (k1 to k4 of a fisheye), to the file"


def has_camera(data: Any) -> bool:
    """Whether a mapping has a camera matrix, or focal lengths and a principal point."""
    found = _meanings(data) if isinstance(data, Mapping) else {}
    K = found.get("K", ("", None))[1]
    is_matrix = isinstance(K, list) and (len(K) in (4, 5, 6, 9, 12) or any(isinstance(row, list) for row in K))
    return is_matrix or isinstance(K, Mapping) or {*_PINHOLE} <= found.keys()


def _meanings(data: Mapping[Any, Any], name: str = "") -> dict[str, tuple[str, Any]]:
    """Key and value by meaning, an unknown key by itself. Two keys of one meaning are refused, if a name is given."""
    found: dict[str, tuple[str, Any]] = {}
    for key, value in data.items():
        is_group = plain(key) in _GROUPS and isinstance(value, Mapping) and "data" not in value
        inner = _meanings(value, name) if is_group else {_MEANINGS.get(plain(key), str(key)): (str(key), value)}
        if name and (twice := found.keys() & inner.keys()):
            got = f"{found[min(twice)][0]} and {inner[min(twice)][0]}"
            raise refusal(name, "one key of each kind", got, "remove one")
        found |= inner
    return found


def read_fields(name: str, data: Mapping[Any, Any]) -> tuple[str, FloatArray, Any, tuple[float, float] | None, bool]:
    """A camera's lens, (3, 3) intrinsics, coefficients and (width, height), and whether P has a baseline.

    CalibrationError without a camera matrix, and for an unknown lens or an unread key that would change the views.
    """
    found = {meaning: (key, value) for meaning, (key, value) in _meanings(data, name).items() if value is not None}
    for meaning in found.keys() & _SCALARS:
        key, number = found[meaning][0], _array(name, *found[meaning]).ravel()
        if number.size != 1:
            raise refusal(name, "a number", shown(found[meaning][1]), key=key)
        found[meaning] = key, float(number[0])
    values = {meaning: value for meaning, (_, value) in found.items()}
    arrays = {key: _array(name, *found[key]) for key in "KDRP" if key in values}
    K, D = arrays.get("K", np.zeros(0)), arrays.get("D", np.zeros(0)).ravel()
    if K.ndim == 1 and K.size in (5, 6):  # Kalibr's xi, or two coefficients, before the focal lengths
        K, D = K[-4:], np.concatenate([K[:-4], D])
    if not K.size and {*_PINHOLE} <= values.keys():
        K = np.array([values[key] for key in _PINHOLE])
    if K.size == 4:
        K = np.array(matrix(*K.ravel()))
    elif K.shape in ((3, 4), (4, 4)) and not K[:3, 3].any():
        K = K[:3, :3]
    if K.size != 9 or not np.isfinite(K).all():
        expected = "a camera matrix of 3x3 finite numbers, or fx, fy, cx, cy"
        raise refusal(name, expected, shown(values.get("K", "none")), key=found.get("K", ("", None))[0])
    K = K.reshape(3, 3)
    lens, coefficients = _lens(name, found, D)
    if lens == "unified":  # (x, y) / (z + ξ d) is 1 + ξ times EUCM's with α = ξ / (1 + ξ) and β = 1
        xi, *bent = coefficients or [math.nan]
        if any(bent) or not xi >= 0:
            raise refusal(name, "MEI or omni without distortion", f"{shown(coefficients)} with xi first", WAY_OUT)
        lens, coefficients, K = "eucm", [xi / (1 + xi), 1.0], K / [[1 + xi, 1, 1], [1, 1 + xi, 1], [1, 1, 1]]
    for key, value in found.values():
        if plain(key) not in _MEANINGS and _is_meaningful(name, key, value, _MATTERS, is_straight=lens == "pinhole"):
            fix = f"remove the key if K and the coefficients describe the images as they are stored, or {WAY_OUT}"
            raise refusal(name, "keys that are read", f"{key!r}: {shown(value)}", fix)
    width, height = size = _size(name, values) or (0, 0)
    window = values.get("window") or {}
    sides = [int(window.get(key, 0)) if isinstance(window, Mapping) else -1 for key in _WINDOW]
    is_binned = any(values.get(f"binning {axis}", 0) > 1 for axis in "xy")
    if is_binned or sides not in ([0] * 4, [width, height, 0, 0]):
        raise refusal(name, "full images", "binning or a region of interest")
    R, P = (arrays.get(key, np.zeros(0)) for key in "RP")
    if R.any() and not (R.size == 9 and np.allclose(R.reshape(3, 3), np.eye(3), atol=1e-6)):
        raise refusal(name, "the identity", shown(R.ravel().tolist()), _CHOICE, key=found["R"][0])
    P = P.reshape(3, 4) if P.any() and P.size == 12 else np.column_stack([K, np.zeros(3)])
    if not D.any() and lens == "pinhole" and not np.allclose(P[:, :3], K, rtol=1e-4, atol=0.01):
        got = f"{shown(P[:, :3].tolist())} without distortion"
        raise refusal(name, "the camera matrix", got, _CHOICE, key=found["P"][0])
    return lens, K, coefficients, size if width and height else None, bool(np.abs(P[:, 3]).max() > 1e-6)


def unread_lens(data: Mapping[Any, Any], read: Collection[str]) -> str:
    """``KEY: VALUE`` of a lens in an entry under a key that is not ``read``; empty without one."""
    for key, value in data.items():
        meaning = _MEANINGS.get(plain(key))
        if meaning in ("model", "distortion model"):  # others, for example a camera's make, are notes
            lens = lens_called(value)
            is_lens = lens not in ("pinhole", "radtan") and bool(lens or _OF_LENS.search(plain(value)))
        else:
            is_known = meaning in _COEFFICIENTS or meaning in ("D", "is fisheye")
            words = _ANY if is_known else _OF_LENS
            is_lens = (is_known or meaning is None) and _is_meaningful("", key, value, words, is_straight=True)
        if is_lens and key not in read:
            return f"{key}: {shown(value)}"
    return ""


def _is_meaningful(name: str, key: str, value: Any, words: re.Pattern[str], *, is_straight: bool) -> bool:
    """Whether a key that is not read could change the views; ``is_straight``: those of a pinhole."""
    word = plain(key)
    if value is None or not words.search(word) or _NEUTRAL.search(word):
        return False
    if isinstance(value, bool) and re.search("rect|undist", word):  # if straight, K is that of the images
        return not is_straight if value else is_straight and word.endswith("ed")
    if plain(value) in _NO_EFFECT or (value == 1 and value is not True and re.search("scale|aspect", word)):
        return False
    try:
        numbers = _array(name, key, value)
    except ValueError:
        return True
    return bool(numbers.any()) and not np.array_equal(numbers, np.eye(3))


def _array(name: str, key: str, value: Any) -> FloatArray:
    """Numbers of nested lists, of text, or of a matrix with rows, cols and data."""
    try:
        if isinstance(value, Mapping):
            numbers, shape = np.asarray(value["data"], float), [int(value.get(key, 0)) for key in ("rows", "cols")]
            return numbers.reshape(shape) if math.prod(shape) == numbers.size else numbers
        return np.asarray(value.split() if isinstance(value, str) else value, float)
    except (TypeError, ValueError, LookupError, OverflowError):
        raise refusal(name, "a matrix or list of numbers", shown(value), key=key) from None


def _lens(name: str, found: Mapping[str, tuple[str, Any]], D: FloatArray) -> tuple[str, Any]:
    """Lens and coefficients, by the models that the file names; those of ``unified`` begin with xi."""
    lenses = set[str]()
    for meaning in ("model", "distortion model", "is fisheye"):
        key, value = found.get(meaning, ("", None))
        if value is None or value == "":
            continue
        lens = lens_called(value)
        if meaning == "is fisheye" or plain(key) == "distortiontype":  # 0 or 1; of MC-Calib, too
            lens = "fisheye" if plain(value) in ("1", "10", "true") else "radtan"
        if lens is None or lens.startswith("ftheta"):  # whose coefficients are in pixels elsewhere
            known = "plumb_bob, rational_polynomial, equidistant, fisheye, pinhole, none"
            raise refusal(name, known, repr(value), WAY_OUT, key=key)
        lenses.add(lens)
    xi = [found["xi"][1]] if "xi" in found else []
    is_unified = bool(xi) or "unified" in lenses
    if len(named := {"unified"} if is_unified else lenses - {"pinhole"}) > 1:
        raise refusal(name, "one lens", " and ".join(sorted(named)), "correct the file")
    lens = next(iter(named), "")
    numbers = {key: value for key, (_, value) in found.items() if re.fullmatch("[kp][1-6]", key)}
    if numbers and not D.size:
        order = "k1 k2 p1 p2 k3 k4 k5 k6" if lens != "fisheye" and "p1" in numbers else "k1 k2 k3 k4"
        if lens == "fisheye" and "k1" not in numbers:
            order = "k2 k3 k4 k5"  # CamOdoCal: r = θ + k2 θ³ + ...
        if unread := [key for key, k in numbers.items() if k and key not in order.split()]:
            raise refusal(name, f"coefficients {order}", ", ".join(unread), WAY_OUT)
        D = np.array([numbers.get(key, 0.0) for key in order.split()])
    if lens in ("radtan", "fisheye") and "D" not in found and not numbers:
        raise refusal(name, f"coefficients of {lens}", "none")
    if is_unified or lens in ("double_sphere", "eucm", "fisheye"):
        return lens, [*xi, *D.tolist()]
    if not D.any():
        return "pinhole", ()
    if not lens and plain(found.get("size", ("",))[0]) == "dim" and D.size == 4:
        return "fisheye", D  # K, D and DIM are cv2.fisheye's in its best-known tutorial
    is_none = lens_called(found.get("distortion model", ("", "radtan"))[1] or "none") == "pinhole"
    if not lens and (is_none or (D.size == 4 and not lenses)):
        raise refusal(name, "a lens for its coefficients", shown(D.tolist()), _NAME_IT)
    return lens or "radtan", D


def _size(name: str, values: Mapping[str, Any]) -> tuple[float, float] | None:
    """(width, height) of the image."""
    sizes = [(values["width"], values["height"])] if {"width", "height"} <= values.keys() else []
    for meaning in {"size", "shape"} & values.keys():
        value = values[meaning]
        value = [value.get("width"), value.get("height")] if isinstance(value, Mapping) and "width" in value else value
        sides = _array(name, meaning, value.replace("x", " ") if isinstance(value, str) else value).ravel().tolist()
        if len(sides) < 2:
            raise refusal(name, "width and height", shown(value), key=meaning)
        sizes.append((sides[1], sides[0]) if meaning == "shape" else (sides[0], sides[1]))
    sizes = [*{(float(width), float(height)) for width, height in sizes}]
    if len(sizes) > 1:
        raise refusal(name, "one size", f"{sizes[0]} and {sizes[1]}", "correct the file")
    return sizes[0] if sizes else None
