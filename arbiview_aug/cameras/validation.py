"""Checks of a camera's calibration, and likely mistakes of a rig's.

The first argument of ``checked_...`` names the owner of the value ("camera 'front'"). They return read-only values and
raise ``CalibrationError`` with the fix.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import repeat
from typing import Any

import numpy as np

from arbiview_aug.cameras.lens import LENSES, BoolArray, FloatArray, canonical_name
from arbiview_aug.cameras.rotations import (
    CAMERA_AXES_IN_EGO,
    nearest_rotation,
    quaternion_from_rotation,
    rotation_from_quaternion,
)
from arbiview_aug.errors import CalibrationError, one_line, shown

ROTATION_TOLERANCE = 1e-4
"""Largest entry of |R Rᵀ - I| accepted as a rotation: published calibrations carry 5 to 7 digits."""

_MAX_COEFFICIENT = 1e6  # far above those of real lenses; polynomials of huge ones overflow
_SHORTEST_PX = 1e-6  # focal length; the inverse of 5e-324 is infinite
_MOST_PX = 1e9  # of K's entries: float32 squares stay finite
MOST_M = 1e9  # of positions, for the same reason

_FARTHEST_M, _MOST_HEIGHT_M = 20.0, 8.0  # of a vehicle's cameras, from the ego origin and over the road

_COMPARE = "compare docs/rigs.md"  # the fix of an unknown mistake
_AS_MOUNTED = "turn the image, or mend its pose; ignore this if it is mounted like that"
_STEEP_DEG, _DOWN_DEG = 60.0, -75.0  # cameras of vehicles roll less and look up less; few look down more
_TILTED, _LEVEL, _STRAIGHT = 0.5, 0.35, 0.95  # sines of 30, 20 and 72 degrees
_SAME_COSINE = 0.94  # cosine of 20 degrees: smaller turns are no mistake that shows

_LEAST_NAMED, _ALIKE = 3, 0.8
"""Least number of cameras with sides in their names, and least length of their turns' mean unit vector, for a set."""

_OFF_CENTER, _OFF_CENTER_ALONE, _ALIKE_OFF = 0.04, 0.08, 0.06
"""Principal points off centre by this share of the width, in all cameras or in one alone, and by about the same share
of the height, belong to another resolution."""

BODY_AXES = "a body's axes (ROS: x forward, z up)"  # words of messages

MAX_SIZE_PX = 32766  # largest image side: OpenCV's remap needs sizes below 32767


@dataclass(frozen=True)
class Finding:
    """One probable mistake.

    Attributes:
        where: The camera or key.
        expected: The right value.
        found: The given value.
        fix: The step that mends it.
    """

    where: str
    expected: str
    found: str
    fix: str

    def __str__(self) -> str:
        return f"{self.where}: expected {self.expected}, found {self.found}; {self.fix}"


def checked_calibration(
    name: Any, width_px: Any, height_px: Any, K: Any, cam2ego: Any, lens: Any, distortion: Any, mask: Any
) -> dict[str, Any]:
    """The checked fields of a camera."""
    if not isinstance(name, str) or not name or re.search("[\0\ud800-\udfff]", name):
        raise CalibrationError(f"camera name: expected a non-empty string of Unicode, got {shown(name)}")
    where = f"camera {shown(name)}"
    w, h = checked_pixels(where, "width_px", width_px), checked_pixels(where, "height_px", height_px)
    K, cam2ego = checked_array(where, "K", K, (3, 3)), checked_pose(where, cam2ego)
    if K[0, 0] < _SHORTEST_PX or K[1, 1] < _SHORTEST_PX:
        expected = f"positive focal lengths, {_SHORTEST_PX:g} px at least"
        raise refusal(where, "K", expected, f"fx {K[0, 0]:g}, fy {K[1, 1]:g}")
    if np.abs(K).max() > _MOST_PX:
        raise refusal(where, "K", f"entries of at most {_MOST_PX:g} px", f"{K.tolist()}")
    if K[1, 0] != 0 or K[2, 0] != 0 or K[2, 1] != 0 or abs(K[2, 2] - 1) > 1e-9:
        fix = "pass K.T" if np.any(K[2, :2]) and not np.any(K[:2, 2]) else "divide K by K[2, 2]"
        raise refusal(where, "K", "[[fx, s, cx], [0, fy, cy], [0, 0, 1]]", f"{K.tolist()}", fix)
    known = canonical_name(lens) if isinstance(lens, str) else ""
    if known not in LENSES:
        raise refusal(where, "lens", f"one of {', '.join(LENSES)}", shown(lens))
    distortion = checked_distortion(where, known, distortion)
    if mask is not None:
        try:
            mask = np.array(mask)
        except (TypeError, ValueError, RuntimeError) as error:  # rows of several lengths; tensors on other devices
            raise refusal(where, "mask", "a bool array", one_line(error, 200)) from None
        if mask.dtype != np.bool_:
            raise refusal(where, "mask", "bool, True = scene", f"dtype {mask.dtype}", "pass mask > 0")
        if mask.shape != (h, w):
            raise refusal(where, "mask", f"shape {(h, w)}, the size (h, w) of the image", f"shape {mask.shape}")
        mask.setflags(write=False)
    fields = {"name": str(name), "width_px": w, "height_px": h}  # numpy's text is no plain YAML
    return {**fields, "K": K, "cam2ego": cam2ego, "lens": known, "distortion": distortion, "mask": mask}


def checked_pixels(where: str, field: str, value: Any, least: int = 1) -> int:
    """An integer number of pixels from ``least`` to ``MAX_SIZE_PX``."""
    try:
        pixels = int(value)
        valid = not isinstance(value, bool) and pixels == value and least <= pixels <= MAX_SIZE_PX
    except (TypeError, ValueError, OverflowError):
        valid = False
    if not valid:
        raise refusal(where, field, f"a whole number of pixels from {least} to {MAX_SIZE_PX}", shown(value))
    return pixels


def checked_size(where: str, value: Any) -> tuple[int, int]:
    try:
        h, w = value
    except (TypeError, ValueError):
        raise refusal(where, "size", "(h, w) in pixels", shown(value)) from None
    return checked_pixels(where, "height_px", h), checked_pixels(where, "width_px", w)


def checked_array(
    where: str,
    field: str,
    value: Any,
    shape: tuple[int, ...],
    expected: str = "",
    is_valid: Callable[[FloatArray], Any] = lambda array: True,
) -> FloatArray:
    """A finite float64 copy of the given shape (-1: any) that ``is_valid``; ``expected`` describes it in the error."""
    try:
        if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
            for entry in np.array(value, dtype=object).flat:
                if isinstance(entry, bool | str | bytes | complex):
                    raise TypeError(f"{shown(entry)} is no real number")
        array = np.array(value, dtype=np.float64)
        got = "" if array.shape == shape or (shape == (-1,) and array.ndim == 1) else f"shape {array.shape}"
        if not np.isfinite(array).all():
            got = got or f"NaN or infinity in {array.tolist()}"
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # RuntimeError: tensors that need gradients
        got = f"{type(value).__name__} ({one_line(error, 200)})"
    if got or not is_valid(array):
        expected, got = (expected, shown(value)) if expected else (f"finite numbers of shape {shape}", got)
        raise refusal(where, field, expected, got)
    array += 0.0  # -0.0 becomes 0.0: equal calibrations have equal bytes (content_key)
    array.setflags(write=False)
    return array


def is_rigid(pose: FloatArray) -> bool:
    """Whether an array is a finite pose (4, 4): a rotation, within 1e-3, and a position over 0 0 0 1."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not np.allclose(pose[3], (0, 0, 0, 1)):
        return False
    R = pose[:3, :3].clip(-2, 2)  # squares of more could overflow
    return bool(np.abs(R @ R.T - np.eye(3)).max() <= 1e-3 and np.linalg.det(R) > 0)


def checked_pose(where: str, value: Any, field: str = "cam2ego") -> FloatArray:
    """(4, 4) pose; a rotation within ``ROTATION_TOLERANCE`` is made exact."""
    pose = checked_array(where, field, value, (4, 4))
    if np.abs(pose[3] - (0, 0, 0, 1)).max() > 1e-9:
        fix = f"pass {field}.T" if np.any(pose[3, :3]) and not np.any(pose[:3, 3]) else ""
        raise refusal(where, field, "last row (0, 0, 0, 1)", f"{pose[3].tolist()}", fix)
    R = pose[:3, :3] / max(1.0, float(np.abs(pose[:3, :3]).max()) / 2)  # products of huge entries would overflow
    deviation, determinant = float(np.abs(R @ R.T - np.eye(3)).max()), float(np.linalg.det(R))
    if deviation <= 0.1 and determinant < 0:
        fix = f"np.diag([1, -1, 1, 1]) @ {field}, if y is to the right (CARLA, Unreal)"
        if R[2, 1] > 0.5:  # the image's y axis is up, where the ego's z is
            fix = f"negate {field}[:3, 1], if the camera's y axis is up (Unity)"
        raise refusal(where, field, "right-handed axes", "mirrored, left-handed ones (determinant -1)", fix)
    if deviation > ROTATION_TOLERANCE or determinant < 0:
        expected = f"a rotation (|R Rᵀ - I| <= {ROTATION_TOLERANCE:g}, determinant +1)"
        fix = f"the nearest rotation is {nearest_rotation(R).round(9).tolist()}"
        raise refusal(where, field, expected, f"deviation {deviation:.3g}, determinant {determinant:.6g}", fix)
    if np.abs(pose[:3, 3]).max() > MOST_M:
        raise refusal(where, field, f"a position within {MOST_M:g} m of the ego frame", f"{pose[:3, 3].tolist()}")
    # Residual scale and skew of rounded digits would bend straight lines by a fraction of a pixel.
    if deviation > 1e-12:
        pose = pose.copy()
        pose[:3, :3] = nearest_rotation(R)
        pose.setflags(write=False)
    return pose


def checked_distortion(where: str, lens: str, value: Any) -> tuple[float, ...]:
    """As many coefficients as the lens takes, up to ``_MAX_COEFFICIENT``."""
    expected = f"finite numbers up to {_MAX_COEFFICIENT:g}"
    array = checked_array(where, "distortion", value, (-1,), expected, lambda k: (abs(k) <= _MAX_COEFFICIENT).all())
    coefficients = tuple(array.tolist())
    counts = LENSES[lens].coefficient_counts
    if len(coefficients) not in counts:
        expected = " or ".join(map(str, counts)) + f" coefficients for a {lens} lens"
        names = " or ".join(f"lens={name!r}" for name in LENSES if LENSES[name].coefficient_counts != (0,))
        fix = f"name the lens: {names}" if counts == (0,) else "docs/formats.md, Lenses, has them"
        raise refusal(where, "distortion", expected, str(len(coefficients)), fix)
    ranges = LENSES[lens].coefficient_ranges
    if any(not low <= k <= high for k, (_, low, high) in zip(coefficients, ranges, strict=False)):
        expected = " and ".join(f"{label} from {low:g} to {high:g}" for label, low, high in ranges)
        raise refusal(where, "distortion", f"{expected} for a {lens} lens", shown(coefficients))
    return coefficients


def pose_mistake(cam2ego: FloatArray, ground_z_m: float) -> tuple[str, str] | None:
    """Guess the mistake in poses (N, 4, 4), and the fix; None if most cameras are upright over the road."""
    looks_down = cam2ego[:, 2, 2] < -0.8  # such cameras have no lower edge
    if ((_stands(cam2ego) | looks_down) & is_mounted(cam2ego, ground_z_m)).mean() >= 0.5:
        return None
    # Cameras of one vehicle, far from the origin: millimetres would be metres apart by thousands.
    middle = cam2ego[:, :3, 3].mean(axis=0)
    is_together = len(cam2ego) > 1 and np.ptp(cam2ego[:, :3, 3], axis=0).max() < _FARTHEST_M
    if is_together and np.abs(middle[:2]).max() > _FARTHEST_M and _stands(cam2ego).mean() > 0.5:
        return "poses in the world's frame", "pass np.linalg.inv(ego2world) @ cam2world"
    for right, mistake, fix in _candidates(cam2ego):
        if (_stands(right) & is_mounted(right, ground_z_m)).mean() > 0.5:
            return mistake, fix
    heights = ", ".join(f"{z:+.1f}" for z in cam2ego[:, 2, 3] - ground_z_m)
    if _stands(cam2ego).all():
        return f"heights over the road of {heights} m", "check that ground_z_m is the road's height in the ego frame"
    return f"cameras that lie on their side or look up, {heights} m over the road", _COMPARE


def doubts(cameras: Sequence[Any], ground_z_m: float) -> list[Finding]:
    """Likely mistakes in the cameras of a rig: poses, directions unlike their names, K of another size."""
    cam2ego = np.stack([camera.cam2ego for camera in cameras])
    mistake = pose_mistake(cam2ego, ground_z_m)
    upright = "cameras upright over the road: cam2ego with axes right, down, forward, in metres"
    general = [] if mistake is None else [Finding("cam2ego", upright, *mistake)]
    is_known, is_body = mistake is not None and mistake[1] != _COMPARE, mistake is not None and mistake[0] == BODY_AXES
    sides = [_side(camera.name) for camera in cameras]
    has_front = (1, 0) in sides
    if not is_known or is_body:
        set_mistake = _set_mistake(cam2ego, sides, is_body)
        if set_mistake is not None:
            return [Finding("cam2ego", "cameras that look where their names say", *set_mistake)]
    if is_known:
        return general
    up = cam2ego[:, 2, 2]
    is_tilted = len(up) > 1 and np.abs(up).max() > _TILTED and up.min() > -_STRAIGHT
    for right, *tilt in _candidates(cam2ego) if is_tilted else ():
        is_level = (np.abs(right[:, 2, 2]) < _LEVEL) & (right[:, 2, 1] < -0.9) & is_mounted(right, ground_z_m)
        if is_level.all() and not any(map(_belies, right, sides, repeat(has_front))):
            return [Finding("cam2ego", "level cameras that look where their names say", *tilt)]
    y_m, y_axes = cam2ego[:, 1, 3], cam2ego[:, 1, 2]
    aside = (np.abs(y_m) > 0.1) & (np.abs(y_axes) > 0.5)
    found = []
    if aside.sum() > 1 and (y_m * y_axes)[aside].max() < 0:
        expected = "cameras that look to the left on the left"
        fix = "positions are left-handed (y to the right): negate cam2ego[1, 3]"
        found.append(Finding("cam2ego", expected, "y of all positions mirrored", fix))
    for camera in cameras:
        where, doubt = f"camera {shown(camera.name)}: cam2ego", pose_doubt(camera, has_front)
        likely = doubt and next(likely_poses(camera, ground_z_m, has_front), None)
        if doubt is not None and (likely or camera.elevation_deg >= _DOWN_DEG):  # some look down in earnest
            as_with, fix = ("", _AS_MOUNTED) if not likely else (f", as with {likely[1]}", likely[2])
            found.append(Finding(where, doubt[0], doubt[1] + as_with, fix))
        elif not is_mounted(camera.cam2ego[None], ground_z_m)[0]:
            x, y, z = camera.center_m
            at = f"({x:.1f}, {y:.1f}), {z - ground_z_m:.1f} m over the road"
            fix = "compare it with the other cameras': metres, and cam2ego instead of its inverse?"
            found.append(Finding(where, "a place on a vehicle", at, fix))
    return (found or general) + _size_doubts(cameras)


def pose_doubt(camera: Any, has_front: bool) -> tuple[str, str] | None:
    """Expected and found pose of a camera that lies, looks up, or looks elsewhere than its name says; or None."""
    pose, up_deg, side = camera.cam2ego, camera.elevation_deg, _side(camera.name)
    if up_deg > _STEEP_DEG or (up_deg < _DOWN_DEG and side[1]):
        return "a level camera", f"it looks {'up' if up_deg > 0 else 'down'} by {abs(up_deg):.0f} degrees"
    roll_deg = math.degrees(math.atan2(pose[2, 0], -pose[2, 1]))
    if up_deg > -_STEEP_DEG and abs(roll_deg) > _STEEP_DEG:
        return "an upright image", f"rolled by {roll_deg:.0f} degrees"
    if _belies(pose, side, has_front):
        return "a camera that looks where its name says", f"it looks to {camera.azimuth_deg:+.0f} degrees"
    return None


def likely_poses(camera: Any, ground_z_m: float, has_front: bool) -> Iterator[tuple[FloatArray, str, str]]:
    """Poses (4, 4) that were probably meant, the mistake in the given one, and the fix; the likeliest first.

    With each, the camera is upright, nearly level and on the vehicle, and looks where its name says.
    """
    side = _side(camera.name)
    staying_first = sorted(
        _candidates(camera.cam2ego[None]), key=lambda c: bool((c[0][0, :3, 3] != camera.center_m).any())
    )
    for (pose,), mistake, fix in staying_first:
        is_other = np.trace(pose[:3, :3].T @ camera.cam2ego[:3, :3]) < 1 + 2 * _SAME_COSINE
        is_level = abs(pose[2, 0]) < 0.2 and pose[2, 1] < -0.5 and abs(pose[2, 2]) < 0.6
        if is_other and is_level and is_mounted(pose[None], ground_z_m)[0] and not _belies(pose, side, has_front):
            yield pose, mistake, fix


def _set_mistake(cam2ego: FloatArray, sides: Sequence[tuple[int, int]], is_body: bool) -> tuple[str, str] | None:
    """The set mirrored or turned as a whole, by the sides in the cameras' names, and the fix."""
    axes = (cam2ego[:, :3, :3] @ CAMERA_AXES_IN_EGO if is_body else cam2ego)[:, :2, 2]
    swapped = [left * axis[1] < -0.35 for axis, (_, left) in zip(axes, sides, strict=True) if left]  # 20 degrees
    if len(swapped) > 1 and all(swapped):
        unreal = "diag(1, -1, 1, 1) @ cam2ego @ [[0, 0, 1, 0], [1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]]"
        fix = unreal if is_body else "negate cam2ego[1] and cam2ego[:, 0]"
        return "left and right are swapped, as in left-handed axes (CARLA, Unreal: y is right)", fix
    named = [complex(*axis) / complex(*side) * abs(complex(*side)) for axis, side in zip(axes, sides, strict=True)
             if any(side) and math.hypot(*axis) > 0.5]  # fmt: skip
    turn = complex(np.mean(named)) if len(named) >= _LEAST_NAMED and not is_body else 0j
    turn_deg = math.degrees(np.angle(turn))
    if abs(turn) > _ALIKE and abs(turn_deg) > 60:
        fix = f"x of the ego frame is forward: turn poses, points and boxes by {-turn_deg:.0f} degrees about z"
        return f"all cameras turned by {turn_deg:.0f} degrees", fix
    return None


def _size_doubts(cameras: Sequence[Any]) -> list[Finding]:
    """Cameras whose K is of an image of another size: principal points off centre by the same share both ways."""
    sizes = np.array([camera.size[::-1] for camera in cameras])
    middles = np.stack([camera.K[:2, 2] for camera in cameras]) + 0.5
    off = middles / sizes - 0.5
    together = (np.abs(off[:, 0]) > _OFF_CENTER).all() and len(set(np.sign(off[:, 0]))) == 1
    found = []
    for camera, (x, y), (w, h), middle in zip(cameras, off, sizes, middles, strict=True):
        is_scaled = abs(x) > (_OFF_CENTER if together else _OFF_CENTER_ALONE) and abs(x - y) < _ALIKE_OFF
        is_turned = max(abs(x), abs(y)) > 0.1 and np.abs(middle / (h, w) - 0.5).max() < 0.05
        if is_scaled or is_turned or max(abs(x), abs(y)) > 0.5:
            where, expected = f"camera {shown(camera.name)}: K", f"a principal point near the middle of {w}x{h} pixels"
            seen = "the middle of about {:.0f}x{:.0f} pixels".format(*2 * middle)
            found.append(Finding(where, expected, seen, "is K of another resolution? Camera.resize scales it"))
    return found


def _side(name: str) -> tuple[int, int]:
    """Side in a camera's name: forward 1 or backward -1, left 1 or right -1; 0 for neither or both."""
    words = {*re.findall("front|forward|back|rear|left|right|mirror|stereo", name.lower())}
    if words & {"mirror", "stereo"}:  # rear-view mirrors are at the front, a stereo pair's left and right look ahead
        return 0, 0
    return bool(words & {"front", "forward"}) - bool(words & {"back", "rear"}), ("left" in words) - ("right" in words)


def _belies(pose: FloatArray, side: tuple[int, int], has_front: bool) -> bool:
    """Whether a camera does not look where its name says; left and right without a front may be a stereo pair."""
    flat = math.hypot(*pose[:2, 2])
    most_deg = 100 if all(side) else 80 if has_front or side[0] else 110
    cosine = np.dot(pose[:2, 2], side) / max(flat * math.hypot(*side), 1e-9)
    return any(side) and flat > 0.5 and bool(cosine < math.cos(math.radians(most_deg)))


def _candidates(cam2ego: FloatArray) -> Iterator[tuple[FloatArray, str, str]]:
    """Poses (N, 4, 4) that were perhaps meant, the mistake in the given ones, and the fix."""
    body, metres, turned = np.eye(4), cam2ego.copy(), cam2ego.copy()
    body[:3, :3] = CAMERA_AXES_IN_EGO
    metres[:, :3, 3] /= 1000
    turned[:, :3, :3] = cam2ego[:, :3, :3].transpose(0, 2, 1)
    axes = f"by {CAMERA_AXES_IN_EGO.astype(int).tolist()} from the"
    yield metres, "positions in millimetres", "divide cam2ego[:3, 3] by 1000"
    yield cam2ego @ body, BODY_AXES, f"multiply cam2ego[:3, :3] {axes} right"
    yield body @ cam2ego, "an ego frame with a camera's axes (z forward)", f"multiply cam2ego[:3] {axes} left"
    yield cam2ego @ np.diag([1.0, -1, -1, 1]), "OpenGL's axes (y up, z backward)", "negate cam2ego[:3, 1:3]"
    yield np.asarray(np.linalg.inv(cam2ego), np.float64), "ego2cam, the inverse", "pass np.linalg.inv(cam2ego)"
    yield turned, "ego2cam's rotation, the inverse", "transpose cam2ego[:3, :3]"
    for order in ([3, 0, 1, 2], [1, 2, 3, 0]):  # one of them is level by chance, so the finding does not say which
        right = cam2ego.copy()
        quaternions = np.stack([quaternion_from_rotation(pose[:3, :3])[order] for pose in cam2ego])
        right[:, :3, :3] = rotation_from_quaternion(quaternions)
        yield right, "a quaternion in another order", "pass w last where it was first, or first where it was last"
    mirrored = np.diag([1.0, -1, 1, 1]) @ cam2ego @ np.diag([-1.0, 1, 1, 1])
    yield mirrored, "y to the right (a left-handed frame)", "negate cam2ego[1] and cam2ego[:, 0]"


def _stands(cam2ego: FloatArray) -> BoolArray:
    """(N,) whether an image's lower edge is down."""
    return np.asarray(cam2ego[:, 2, 1] < -0.5)


def is_mounted(cam2ego: FloatArray, ground_z_m: float) -> BoolArray:
    """(N,) whether cameras are at the height and distance of a vehicle's."""
    height = cam2ego[:, 2, 3] - ground_z_m
    near = np.abs(cam2ego[:, :2, 3]).max(axis=1) < _FARTHEST_M
    return np.asarray(near & (height > 0) & (height < _MOST_HEIGHT_M))


def refusal(where: str, field: str, expected: str, got: Any, fix: str = "") -> CalibrationError:
    """Error for a value: its owner, its name, the expected and the given value."""
    prefix = "".join(f"{part}: " for part in (where, field) if part)
    return CalibrationError(f"{prefix}expected {expected}, got {got}{f'; {fix}' if fix else ''}")
