"""Rigs: the cameras of one vehicle, their files, and the vehicles that ship with the package.

A rig file (YAML or JSON) holds ``name``, ``ground_z_m`` and ``cameras``, each with ``name``, ``width``, ``height``,
``K`` (3x3), ``cam2ego`` (4x4, or ``translation`` and ``rotation`` x y z w), ``distortion`` (null or
``{model: LENS, coeffs: [...]}``) and optionally ``mask`` (a PNG next to the file, white = scene);
optionally ``lidars``, each with the arguments of ``Lidar``.
``source``, ``notes``, ``ego_frame``, ``ground_source``, ``dataset``, ``kind`` and ``license`` document it.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arbiview_aug.atomic_io import write_whole
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.formats.entries import pose_of
from arbiview_aug.cameras.framing import Fit
from arbiview_aug.cameras.key_names import USUAL_NAMES, check_keys, lens_called, misnamed, refuse_unknown
from arbiview_aug.cameras.lens import FloatArray, canonical_name
from arbiview_aug.cameras.lidar import Lidar
from arbiview_aug.cameras.plain_yaml import dump_yaml, parse_yaml
from arbiview_aug.cameras.shipped import shipped_rigs
from arbiview_aug.cameras.validation import MAX_SIZE_PX, MOST_M, doubts
from arbiview_aug.errors import CalibrationError, calibration_of, shown, warn
from arbiview_aug.files import read_bytes

MOST_CAMERAS, MOST_LIDARS = 128, 32  # largest rig: winning sources are int8
RIG_SUFFIXES = ".yaml", ".yml", ".json"  # of rig files
_CAMERA_KEYS = {"name", "width", "height", "K", "cam2ego", "distortion", "mask"}
_NOTES = ("source", "notes", "ego_frame", "ground_source", "dataset", "kind", "license")
_MOST_MASK_BYTES = 1 << 28
_ORDERS = {"radtan": "k1 k2 p1 p2 k3 k4 k5 k6", "fisheye": "k1 k2 k3 k4"}  # of a file's coefficients


@dataclass(frozen=True, eq=False)
class Rig:
    """The cameras of one vehicle, and its LiDAR scanners.

    Args:
        cameras: One or more cameras with different names; all ``cam2ego`` are in this rig's ego frame.
        ground_z_m: Height of the road in that frame (-0.33 where the origin is a rear axle 0.33 m above it).
        name: A label for tables and messages.
        lidars: Scanners with different names, in the same frame.

    Raises:
        CalibrationError: No cameras or more than 128, duplicate names, or a ground height that is not finite.
    """

    cameras: Sequence[Camera]
    ground_z_m: float = field(default=0.0, kw_only=True)
    name: str = field(default="", kw_only=True)
    lidars: Sequence[Lidar] = field(default=(), kw_only=True)

    def __post_init__(self) -> None:
        cameras = tuple(self.cameras) if isinstance(self.cameras, Iterable) else (self.cameras,)
        where = f"rig {self.name!r}" if self.name else "rig"
        if not 0 < len(cameras) <= MOST_CAMERAS:
            expected = f"at most {MOST_CAMERAS} cameras" if cameras else "at least one camera"
            raise CalibrationError(f"{where}: expected {expected}, got {len(cameras) or 'none'}")
        lidars = tuple(self.lidars) if isinstance(self.lidars, Sequence) else (self.lidars,)
        sensors: tuple[Any, ...]
        for kind, sensors in ((Camera, cameras), (Lidar, lidars)):
            if wrong := [type(sensor).__name__ for sensor in sensors if not isinstance(sensor, kind)]:
                raise CalibrationError(f"{where}: expected {kind.__name__} objects, got {wrong[0]}")
            twice = sorted(name for name, count in Counter(sensor.name for sensor in sensors).items() if count > 1)
            if twice:
                kinds, got = kind.__name__.lower(), ", ".join(name[:100] for name in twice[:5])
                raise CalibrationError(f"{where}: expected different {kinds} names, got {got} more than once")
        try:
            ground = math.nan if isinstance(self.ground_z_m, bool) else float(self.ground_z_m)
        except (TypeError, ValueError, OverflowError, RuntimeError):  # RuntimeError: tensors of several heights
            ground = math.nan
        if not abs(ground) <= MOST_M:
            got = f"{shown(self.ground_z_m)}; at most {MOST_M:g} m"
            raise CalibrationError(f"{where}: ground_z_m: expected a finite height in metres, got {got}")
        name = str(self.name or "")  # numpy's text is no plain YAML
        self.__dict__.update(name=name, cameras=cameras, lidars=lidars, ground_z_m=ground)

    def __len__(self) -> int:
        return len(self.cameras)

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    def __getitem__(self, key: int | str) -> Camera:
        if isinstance(key, str):
            if key not in self.names:
                raise KeyError(f"no camera {key!r} in rig {self.name!r}: it has {', '.join(self.names)}")
            key = self.names.index(key)
        return self.cameras[key]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Rig):
            return NotImplemented
        return (self.cameras, self.lidars, self.ground_z_m) == (other.cameras, other.lidars, other.ground_z_m)

    def __hash__(self) -> int:
        return hash((self.cameras, self.lidars, self.ground_z_m))

    def __repr__(self) -> str:
        """A table with one line per camera and scanner, as ``inspect`` prints it."""
        lines = [f"Rig {self.name or '(unnamed)'}: {len(self)} cameras, road at z = {self.ground_z_m:+.2f} m"]
        width, lens = max(map(len, self.names)), max(7, *(len(c.lens) for c in self.cameras))
        lines.append(
            f"  {'camera':<{width}}  {'size':>9}  {'lens':<{lens}}  {'fov h x v':>13}  {'azimuth':>7}  {'elev.':>6}"
            f"  {'x':>6} {'y':>6} {'above road':>10}"
        )
        for c in self.cameras:
            h_fov, v_fov = c.fov_deg
            x, y, z = c.center_m
            lines.append(
                f"  {c.name:<{width}}  {c.width_px:>4}x{c.height_px:<4}  {c.lens:<{lens}}  {h_fov:5.1f} x {v_fov:5.1f}"
                f"  {c.azimuth_deg:+7.1f}  {c.elevation_deg:+6.1f}  {x:6.2f} {y:6.2f} {z - self.ground_z_m:8.2f} m"
                + ("" if c.mask is None else f"  mask: {1 - c.mask.mean():.0%} own car")
            )
        for lidar in self.lidars:
            x, y, z = lidar.center_m
            place = f"at ({x:.2f}, {y:.2f}), {z - self.ground_z_m:.2f} m above the road"
            lines.append(f"  lidar {lidar.name}: {lidar.words}, {place}")
        return "\n".join(lines)

    @property
    def names(self) -> list[str]:
        """Camera names in order."""
        return [camera.name for camera in self.cameras]

    @property
    def sizes(self) -> list[tuple[int, int]]:
        """(h, w) of each camera."""
        return [camera.size for camera in self.cameras]

    @property
    def K(self) -> FloatArray:
        """(N, 3, 3) intrinsics."""
        return np.stack([camera.K for camera in self.cameras])

    @property
    def cam2ego(self) -> FloatArray:
        """(N, 4, 4) poses."""
        return np.stack([camera.cam2ego for camera in self.cameras])

    @cached_property
    def content_key(self) -> bytes:
        """Digest of the calibration, without names."""
        keys = *(camera.content_key for camera in self.cameras), *(lidar.content_key for lidar in self.lidars)
        return hashlib.sha256(np.float64(self.ground_z_m).tobytes() + b"".join(keys)).digest()

    @cached_property
    def named_key(self) -> bytes:
        """``content_key`` and names, for cached values that show names."""
        names = self.name, *(camera.name for camera in self.cameras), *(lidar.name for lidar in self.lidars)
        return self.content_key + repr(names).encode()

    def with_cameras(self, cameras: Sequence[Camera]) -> Rig:
        """The same rig with other cameras."""
        return replace(self, cameras=cameras)

    def resized(self, size: tuple[int, int] | float, fit: Fit = "stretch") -> Rig:
        """All cameras resized to (h, w), see ``Camera.resize``, or by a scale."""
        if not isinstance(size, int | float | np.number):
            return self.with_cameras([c.resize(size, fit) for c in self])
        if not 0 < size <= MAX_SIZE_PX:
            expected = f"(h, w) or a positive scale up to {MAX_SIZE_PX}"
            raise CalibrationError(f"rig {self.name!r}: size: expected {expected}, got {size}")
        sizes = [(max(1, round(h * size)), max(1, round(w * size))) for h, w in self.sizes]
        return self.with_cameras([c.resize(to, fit) for c, to in zip(self, sizes, strict=True)])

    def turned(self, *, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Rig:
        """Turn each camera about its centre, see ``Camera.turned``; scanners stay."""
        return self.with_cameras([c.turned(yaw_deg=yaw_deg, pitch_deg=pitch_deg, roll_deg=roll_deg) for c in self])

    def shifted(self, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0) -> Rig:
        """All cameras and scanners moved along the ego axes; the road stays."""
        cameras = [c.shifted(x_m, y_m, z_m) for c in self]
        return replace(self, cameras=cameras, lidars=[lidar.shifted(x_m, y_m, z_m) for lidar in self.lidars])

    def undistorted(self) -> Rig:
        """The rig with pinhole cameras of the same K, sizes and poses."""
        return self.with_cameras([c.undistorted() for c in self])

    def ego2ego(self, other: Rig) -> FloatArray:
        """(4, 4) from this rig's ego frame to ``other``'s; both roads and both x-y origins coincide."""
        T = np.eye(4)
        T[2, 3] = other.ground_z_m - self.ground_z_m
        return T

    def in_frame_of(self, other: Rig) -> Rig:
        """This rig as mounted on ``other``'s vehicle: poses in ``other``'s ego frame, on ``other``'s road."""
        if self.ground_z_m == other.ground_z_m:
            return self
        T = self.ego2ego(other)
        cameras, lidars = [c.moved(T) for c in self], [lidar.moved(T) for lidar in self.lidars]
        return replace(self, cameras=cameras, lidars=lidars, ground_z_m=other.ground_z_m)

    def to_dict(self) -> dict[str, Any]:
        """Plain data in the rig file's format, without masks, which ``save`` writes as files."""
        lidars = {"lidars": [lidar.to_dict() for lidar in self.lidars]} if self.lidars else {}
        cameras = []
        for c in self.cameras:
            lens = None if c.is_rectilinear else {"model": c.lens, "coeffs": list(c.distortion)}
            entry = {"name": c.name, "width": c.width_px, "height": c.height_px, "K": c.K.tolist()}
            cameras.append({**entry, "distortion": lens, "cam2ego": c.cam2ego.tolist()})
        return {"name": self.name, "ground_z_m": self.ground_z_m, **lidars, "cameras": cameras}

    @classmethod
    def from_dict(cls, data: Any, *, folder: Path | None = None, where: str = "rig") -> Rig:
        """A rig from data in the rig file's format, with masks from ``folder``; ``where`` is named in errors.

        CalibrationError for missing keys or impossible values, by camera.
        """
        if not isinstance(data, Mapping) or not isinstance(data.get("cameras"), list):
            raise CalibrationError(f"{where}: expected a mapping with a list 'cameras', got {type(data).__name__}")
        _refuse_misnamed(data, ("ground_z_m", "lidars"), where)
        cameras = [_camera_from_dict(entry, k, folder, where) for k, entry in enumerate(data["cameras"])]
        entries = [] if data.get("lidars") is None else data["lidars"]
        if not isinstance(entries, list) or len(entries) > MOST_LIDARS:
            raise CalibrationError(f"{where}: lidars: expected a list of at most {MOST_LIDARS}, got {shown(entries)}")
        lidars = [
            Lidar.from_dict(entry, f"{where}: lidar {shown(entry.get('name', k) if isinstance(entry, Mapping) else k)}")
            for k, entry in enumerate(entries)
        ]
        name = next((str(data[key]) for key in ("name", "dataset") if data.get(key) is not None), "")
        with calibration_of(where):
            return cls(cameras, ground_z_m=data.get("ground_z_m", 0.0), name=name, lidars=lidars)

    def save(self, path: str | Path) -> Path:
        """Write the rig to a .yaml, .yml or .json file, and masks to PNGs next to it. Returns the path.

        The folder is created. CalibrationError for another suffix, OutputError for a file that cannot be written.
        """
        path = Path(path)
        if path.suffix not in RIG_SUFFIXES:
            raise CalibrationError(f"rig file {path}: expected the suffix .yaml, .yml or .json, got {path.suffix!r}")
        data, files = self.to_dict(), dict[Path, bytes]()
        for k, (entry, camera) in enumerate(zip(data["cameras"], self.cameras, strict=True)):
            if camera.mask is not None:
                stem = camera.name if re.fullmatch(r"[A-Za-z0-9_.-]{1,64}", camera.name) else f"camera {k}"
                file = path.with_name(f"{path.name}.{stem}.mask.png")
                files[file] = cv2.imencode(".png", camera.mask.astype(np.uint8) * 255)[1].tobytes()
                entry["mask"] = file.name
        text = json.dumps(data, indent=1) if path.suffix == ".json" else dump_yaml(data)
        write_whole({**files, path: text.encode()})
        return path


def load_rig(name_or_path: Rig | str | Path) -> Rig:
    """A shipped rig by name (see ``shipped_rigs``), a rig file (YAML or JSON), or another tool's calibration.

    Other tools are ROS and Foxglove (CameraInfo, with tf), OpenCV, Python scripts, Kalibr, COLMAP, nuScenes,
    Argoverse 2, Waymo and WoodScape; a file ``mounting.yaml`` next to theirs completes them (docs/rigs.md). Cameras
    that are likely wrong give one warning. Files are read by safe parsers. A ``Rig`` is returned unchanged.

    Raises:
        CalibrationError: An unknown name, a missing or unreadable file, or an impossible or ambiguous calibration.
        ImportError: Argoverse 2's files without pyarrow.
    """
    if isinstance(name_or_path, Rig):
        return name_or_path
    if not isinstance(name_or_path, str | Path):
        got = type(name_or_path).__name__
        raise CalibrationError(f"rig: expected a shipped rig's name or the path of a rig file, got {got}")
    if isinstance(name_or_path, str) and name_or_path in shipped_rigs():
        text = (resources.files("arbiview_aug.cameras") / "rigs" / f"{name_or_path}.yaml").read_text()
        return Rig.from_dict(parse_yaml(text), where=f"rig {name_or_path}")
    return read_rig(Path(name_or_path) if str(name_or_path) else Path("no name"))[0]


def read_rig(path: Path) -> tuple[Rig, str]:
    """Load a rig from a file or folder as ``load_rig``, with a note on how it was read."""
    where = f"rig file {path}"
    if not os.path.exists(path):  # unlike Path.exists, False for a name that is too long
        expected = f"a file or one of the shipped rigs ({', '.join(shipped_rigs())})"
        raise CalibrationError(f"{where}: expected {expected}, found neither")
    from arbiview_aug.cameras.formats.calibration import read_calibration

    data = read_calibration(path, where)
    if any(isinstance(entry, Mapping) and "file" in entry for entry in data["cameras"]):  # a frame's, with other keys
        data = {key: value for key, value in data.items() if key != "lidar"}
    else:
        refuse_unknown(data, ("name", "ground_z_m", "cameras", "lidars", *_NOTES), where)
        known = (*_CAMERA_KEYS, *_NOTES, "lens", *USUAL_NAMES["lens"])
        for entry in (entry for entry in data["cameras"] if isinstance(entry, Mapping)):
            refuse_unknown(entry, known, f"{where}: camera {shown(entry.get('name'))}")
    rig = Rig.from_dict(data, folder=path.parent, where=where)
    if found := doubts(rig.cameras, rig.ground_z_m):
        more = f"; and {len(found) - 4} more" if len(found) > 4 else ""
        warn(f"{where}: {'; '.join(map(str, found[:4]))}{more}. If this is meant so, ignore the warning (docs/rigs.md)")
    return rig, data.get("notes", "")


def _camera_from_dict(entry: Any, index: int, folder: Path | None, where: str) -> Camera:
    if isinstance(entry, Camera):
        return entry
    label = f"{where}: camera {shown(entry.get('name', index) if isinstance(entry, Mapping) else index)}"
    check_keys(entry, ("name", "width", "height", "K", "cam2ego"), sorted(_CAMERA_KEYS), label)
    _refuse_misnamed(entry, ("distortion", "mask"), label)
    calibration = {key: entry[key] for key in ("name", "K", "cam2ego")}
    distortion = entry.get("distortion")
    if distortion is not None:
        if not isinstance(distortion, Mapping) or not {"model", "coeffs"} <= distortion.keys():
            raise CalibrationError(f"{label}: distortion: expected null or {{model, coeffs}}, got {shown(distortion)}")
        calibration |= {"lens": distortion["model"], "distortion": distortion["coeffs"]}
        refuse_unknown(distortion, ("model", "coeffs", "order"), f"{label}: distortion")
        order = distortion.get("order")
        usual = _ORDERS.get(canonical_name(str(distortion["model"])), "").split()
        named = re.findall(r"[a-z]+\d", str(order).partition("(")[0])  # k1..k4 (cv2.fisheye)
        is_usual = order is None or named == usual[: len(named)] or (named == ["k1", "k4"] and len(usual) > 3)
        if not is_usual:
            raise CalibrationError(f"{label}: distortion: order: expected {' '.join(usual)}, got {shown(order)}")
    for key in ("lens", *USUAL_NAMES["lens"]):
        lens = lens_called(entry.get(key) or "pinhole")
        if lens != "pinhole" and (distortion is None or lens != canonical_name(str(distortion["model"]))):
            fix = "write distortion: {model: LENS, coeffs: [...]}, or remove it if it is something else"
            raise CalibrationError(f"{label}: {key!r} is not read: {fix}; got {shown(entry[key])}")
    mask = None if entry.get("mask") is None else read_mask(entry["mask"], folder, label)
    with calibration_of(where):
        if isinstance(entry["cam2ego"], Mapping):
            calibration["cam2ego"] = pose_of(f"camera {shown(entry['name'])}", entry["cam2ego"], "cam2ego")
        return Camera(width_px=entry["width"], height_px=entry["height"], mask=mask, **calibration)


def _refuse_misnamed(entries: Mapping[str, Any], keys: Sequence[str], label: str) -> None:
    """Refuse misspelt names of absent keys, which would not be read; text may be a note."""
    for wrong, key in misnamed(entries, keys).items():
        value = entries[wrong]
        is_zero = not any(value) if isinstance(value, list) else not value
        if (key == "mask" or isinstance(value, Mapping | list | int | float)) and not is_zero:
            fix = f"did you mean {key!r}? Rename it, or remove it if it is something else"
            raise CalibrationError(f"{label}: {key!r} is absent or null, and {wrong!r} is not read: {fix}")


def read_mask(file: Any, folder: Path | None, label: str) -> np.ndarray:
    """Read an (H, W) bool car-body mask from an image file: bright = scene."""
    if not isinstance(file, str) or folder is None:
        raise CalibrationError(f"{label}: mask: expected a file name beside the rig file, got {shown(file)}")
    try:  # by bytes, as OpenCV ends the process at paths that are not UTF-8
        content = np.frombuffer(read_bytes(folder / file, _MOST_MASK_BYTES), np.uint8)
        image = cv2.imdecode(content, cv2.IMREAD_GRAYSCALE) if content.size else None
    except (OSError, cv2.error):
        image = None
    if image is None:
        raise CalibrationError(f"{label}: mask: expected an image file {folder / file}, found none that can be read")
    return np.asarray(image > 0)


def content_order(cameras: Sequence[Camera]) -> list[int]:
    """Indices of cameras in an order that depends on their calibrations alone, not on their order in the list."""
    return sorted(range(len(cameras)), key=lambda k: (cameras[k].content_key, k))
