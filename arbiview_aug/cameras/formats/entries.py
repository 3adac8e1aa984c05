"""Cameras as in a rig file, made by readers; ``mounting.yaml``, which completes other tools' files."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from arbiview_aug.cameras import validation
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import LENSES, FloatArray
from arbiview_aug.cameras.plain_yaml import read_plain
from arbiview_aug.cameras.rotations import poses_from
from arbiview_aug.cameras.validation import checked_array, checked_pose
from arbiview_aug.errors import CalibrationError, shown

WAY_OUT = (
    "undistort the images to a pinhole's, or fit a lens of this package (docs/rigs.md, A lens that is not read), and "
    "write a rig file"
)


def refusal(name: str, expected: str, got: str, fix: str = "", *, key: str = "") -> CalibrationError:
    """Error for a camera whose file differs from ``expected``."""
    return validation.refusal(f"camera {name!r}", key, expected, got, fix)


def fitted(name: str, lens: str, coefficients: Any) -> tuple[str, list[float]]:
    """A lens and its coefficients without padding zeros; a polynomial of zeros is a pinhole."""
    numbers = [float(k) for k in np.ravel(coefficients)]
    if lens == "radtan" and not any(numbers):
        return "pinhole", []
    counts = LENSES[lens].coefficient_counts
    for count in reversed(counts):
        if len(numbers) >= count and not any(numbers[count:]):
            return lens, numbers[:count]
    got = f"{len(numbers)}{' (thin prism or tilt)' if lens == 'radtan' and len(numbers) > 8 else ''}"
    raise refusal(name, f"{' or '.join(map(str, counts))} coefficients of {lens}", got, WAY_OUT)


def camera_of(
    name: str, size: tuple[Any, Any], K: Any, cam2ego: FloatArray, lens: str = "pinhole", coefficients: Any = ()
) -> Camera:
    """A camera of (width, height), whose coefficients may be padded with zeros."""
    lens, coefficients = fitted(name, lens, coefficients)
    calibration: dict[str, Any] = {"K": K, "cam2ego": cam2ego, "lens": lens, "distortion": coefficients}
    return Camera(name=name, width_px=size[0], height_px=size[1], **calibration)


def matrix(fx: float, fy: float, cx: float, cy: float) -> list[list[float]]:
    """(3, 3) intrinsics."""
    return [[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]


MOUNTING = "mounting.yaml"


@dataclass(frozen=True)
class Mounting:
    """The file's content.

    Attributes:
        poses: cam2ego (4, 4) by camera; in the file as ``pose_of`` reads them.
        ground_z_m: Height of the road in the ego frame.
        metres_per_unit: Scale of a calibration without one (COLMAP).
        images: Image of each camera (COLMAP).
        sizes: ``{width, height}`` of all cameras, or by camera.
        names: Names of cameras by those in the files, in the rig's order; all other cameras follow.
    """

    poses: Mapping[str, FloatArray] = field(default_factory=dict)
    ground_z_m: float | None = None
    metres_per_unit: float | None = None
    images: Mapping[str, str] = field(default_factory=dict)
    sizes: Mapping[str, Any] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def read(cls, folder: Path) -> Mounting:
        """The file in a folder, empty without one; CalibrationError for unknown keys or impossible values."""
        path = folder / MOUNTING
        data = read_plain(path, MOUNTING) if path.is_file() else {}
        keys = cls.__dataclass_fields__
        if not isinstance(data, Mapping) or not set(data) <= set(keys):
            raise CalibrationError(f"{MOUNTING}: expected the keys {', '.join(keys)}, got {shown(data)}")
        data = dict(data)
        for key in {"poses", "images", "sizes", "names"} & set(data):
            if not isinstance(data[key], Mapping):
                raise CalibrationError(f"{MOUNTING}: {key}: expected values by camera, got {shown(data[key])}")
            data[key] = {str(name): value for name, value in data[key].items()}
        poses = {name: pose_of(f"camera {name!r}", value) for name, value in data.get("poses", {}).items()}
        scale = data.get("metres_per_unit")
        if scale is not None and not (type(scale) in (int, float) and 0 < scale < math.inf):
            raise CalibrationError(f"{MOUNTING}: metres_per_unit: expected a positive number, got {shown(scale)}")
        return cls(**{**data, "poses": poses})

    def check(self, cameras: Sequence[str]) -> None:
        """Refuse values of other cameras than a folder's, which would not be read."""
        sizes = {} if "width" in self.sizes else self.sizes
        for key, values in (("poses", self.poses), ("sizes", sizes), ("names", self.names)):
            if unknown := [name for name in values if name not in cameras]:
                got = f"{', '.join(unknown)}: write names as in the files, or remove it"
                raise CalibrationError(f"{MOUNTING}: {key}: expected cameras of {', '.join(cameras)}, got {got}")

    def pose(self, name: str, instead: str = "") -> FloatArray:
        """A camera's pose, or CalibrationError with the question where it is."""
        if name not in self.poses:
            rows = "[[r, r, r, x], [r, r, r, y], [r, r, r, z], [0, 0, 0, 1]]"
            fix = f"Write its pose, camera to ego, to {MOUNTING} beside the calibration, poses: {{{name}: {rows}}}"
            raise CalibrationError(f"camera {name!r}: where is it on the vehicle? {fix}{instead}")
        return self.poses[name]

    def size(self, name: str) -> tuple[Any, Any]:
        """Width and height of a camera's images, or CalibrationError with the question how large they are."""
        size = self.sizes if "width" in self.sizes else self.sizes.get(name)
        if not isinstance(size, Mapping) or size.keys() != {"width", "height"}:
            fix = f"Write it to {MOUNTING} beside the calibration: sizes: {{{name}: {{width: 1600, height: 900}}}}"
            raise CalibrationError(f"camera {name!r}: how large are its images? {fix}; without the name it is for all")
        return size["width"], size["height"]

    def named(self, cameras: Sequence[Camera]) -> list[Camera]:
        """Cameras by their ``names``, and in that order."""
        places = {name: place for place, name in enumerate(self.names)}
        ordered = sorted(cameras, key=lambda camera: places.get(camera.name, len(places)))
        return [replace(camera, name=self.names.get(camera.name, camera.name)) for camera in ordered]

    def mounted(self, relative: Mapping[str, FloatArray]) -> dict[str, FloatArray]:
        """cam2ego of cameras whose poses (4, 4) in a common frame are known, by the pose of one of them."""
        if not relative:
            raise CalibrationError("expected at least one camera, got none")
        given = [name for name in relative if name in self.poses]
        if not given:
            self.pose(next(iter(relative)), "; one camera's is enough, the others follow")
        if len(given) == len(relative):
            return {name: self.poses[name] for name in relative}
        if len(given) > 1:
            got = ", ".join(given)
            raise CalibrationError(f"{MOUNTING}: poses: expected those of one camera or of all, got {got}")
        to_ego = self.poses[given[0]] @ np.linalg.inv(relative[given[0]])
        return {name: to_ego @ pose for name, pose in relative.items()}


def pose_of(where: str, value: Any, field: str = "pose") -> FloatArray:
    """(4, 4) pose of a matrix, or of tf's translation x y z and quaternion x y z w, which are mappings or lists."""
    if isinstance(value, Mapping):
        expected = "a 4x4 matrix, or {translation: {x, y, z}, rotation: {x, y, z, w}} or their lists [x, y, z, w]"
        try:
            (*position,), (x, y, z, w) = (
                [part[axis] for axis in axes] if isinstance(part, Mapping) else part
                for part, axes in ((value["translation"], "xyz"), (value["rotation"], "xyzw"))
            )
        except (LookupError, TypeError, ValueError):
            raise validation.refusal(where, field, expected, shown(value)) from None
        numbers = [*position, w, x, y, z]
        expected = "three finite numbers, and four of a quaternion that are not all 0"
        value = poses_from(checked_array(where, field, numbers, (7,), expected, lambda numbers: numbers[3:].any()))
    return checked_pose(where, value, field)
