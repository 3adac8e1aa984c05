"""Frame folders, read and written: each frame with calibration, images, and optional points, boxes and masks."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.atomic_io import check_name, inside
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.formats.entries import pose_of
from arbiview_aug.cameras.formats.fields import unread_lens
from arbiview_aug.cameras.key_names import USUAL_NAMES, hint, misnamed
from arbiview_aug.cameras.lens import LENSES, BoolArray, canonical_name
from arbiview_aug.cameras.plain_yaml import parse_json
from arbiview_aug.cameras.rig import MOST_CAMERAS, Rig, read_mask
from arbiview_aug.cameras.validation import is_rigid
from arbiview_aug.choices import Reduce
from arbiview_aug.datasets.drive import (
    Drive,
    LazyFrame,
    Neighbours,
    Recording,
    camera_fields,
    checked_index,
    parts_of_clock,
    warn_of_unfinished,
)
from arbiview_aug.datasets.image_io import VIEW_MASKS, decode_images, decode_view_masks, encoded_image, reduced_rig
from arbiview_aug.datasets.lidar_files import checked_points, read_cloud
from arbiview_aug.datasets.registry import CALIBRATION_FILE
from arbiview_aug.errors import (
    ArbiviewError,
    CalibrationError,
    DataError,
    SampleError,
    WarnOnce,
    calibration_of,
    shown,
    warn,
)
from arbiview_aug.files import read_text
from arbiview_aug.sample.masks import image_circle, without_specks
from arbiview_aug.scene.boxes import checked_boxes

SEQUENCE_FILE = "sequence.json"
POINTS_FILE, CLASSES_FILE = "lidar.npy", "class.npy"
MOST_BYTES = 1 << 26  # of a frame's or a sequence's JSON: 64 MiB, 200,000 boxes

_COLUMNS = 'say them in calib.json: "lidar": {"file": NAME, "columns": ["x", "y", "z", "intensity"]}'
_OF_POINTS = re.compile("(?i)2ego|2world|pose|transl|rotat|transf|extrin|unit|scale|type|order|layout|field")
"""Keys of ``lidar`` that would give its points another meaning, and are not read."""
_CLOCK = re.compile(r"^(?!time_s$)(?:time|stamp|t$|n?sec)", re.IGNORECASE)  # other keys of a sequence's times

_CACHED_MASKS = 16  # masks that a worker keeps: those of two eight-camera rigs, 2 MB each at full size


@dataclass(frozen=True)
class _Frame:
    """A frame's folder, a child of the data's root or the root itself; and its calibration once it is ``read``."""

    root: Path
    folder: Path
    calib: Mapping[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def where(self) -> str:
        """Name for messages."""
        return str(self.folder / CALIBRATION_FILE)

    @property
    def cameras(self) -> list[dict[str, Any]]:
        cameras: list[dict[str, Any]] = self.calib["cameras"]
        return cameras

    def read(self) -> _Frame:
        """Read the calibration, a mapping with a list of cameras; other entries are checked when they are used."""
        path = self.file(CALIBRATION_FILE)
        try:
            text = read_text(path, MOST_BYTES)
            if (count := text.count('"cam2ego"') // 2) > MOST_CAMERAS:  # of which each may name it in a note, too
                raise CalibrationError(f"{path}: expected at most {MOST_CAMERAS} cameras, got {count} or more")
            calib = parse_json(text)
        except CalibrationError:
            raise
        except FileNotFoundError:
            raise DataError(f"{path}: expected a calibration, found no file") from None
        except (OSError, ValueError, RecursionError) as error:  # ValueError: numbers of thousands of digits too
            raise DataError(f"{path}: expected JSON, got {getattr(error, 'strerror', None) or error}") from None
        if not isinstance(calib, dict) or not isinstance(calib.get("cameras"), list):
            got = type(calib).__name__ + (hint(calib, ("cameras",)) if isinstance(calib, dict) else "")
            raise DataError(f"{path}: expected an object with a list 'cameras', got {got}")
        for k, entry in enumerate(calib["cameras"]):
            if not isinstance(entry, dict):
                raise CalibrationError(f"{path}: camera {k}: expected a mapping, got {type(entry).__name__}")
            refused = "distortion", "lens", *USUAL_NAMES["distortion"]  # by ``Rig.from_dict``
            if entry.get("distortion") is None and (lens := unread_lens(entry, refused)):
                fix = "write distortion: {model, coeffs} (docs/formats.md), or remove it"
                raise CalibrationError(f"{path}: camera {shown(entry.get('name', k))}: {lens} is not read; {fix}")
        return replace(self, calib=calib)

    def file(self, name: str, what: str = "") -> Path:
        """Path of a file of this or another frame; DataError for names and links that leave the root."""
        if self.folder != self.root and not os.path.isabs(name):
            name = os.path.normpath(f"{self.name}/{name}")
        return inside(self.root, name, f"{self.where}: {what}" if what else self.where)

    def named(self, entry: Mapping[str, Any], key: str) -> Path | None:
        """The file that a camera names under a key; None without one, but each camera must name its image."""
        what, name = f"camera {shown(entry.get('name'))}: {key}", entry.get(key)
        if name is None and key != "file":
            return None
        if not isinstance(name, str) or not name:
            error = CalibrationError if key == "mask" else DataError
            raise error(f"{self.where}: {what}: expected an image's file name, got {shown(name)}{hint(entry, (key,))}")
        if key == "mask" and self.folder == self.root and "\0" not in name:  # a single frame may share a sibling's
            parts = os.path.normpath(name).split(os.sep, 2)
            if len(parts) == 3 and parts[0] == ".." and parts[1] != "..":
                check_name(os.sep.join(parts[1:]), f"{self.where}: {what}")
                sibling = self.root.parent / parts[1]
                if not sibling.is_symlink() and (sibling / CALIBRATION_FILE).is_file():
                    return inside(sibling, parts[2], f"{self.where}: {what}")
        return self.file(name, what)

    def of_cameras(self, key: str) -> list[Any]:
        """The file that each camera names under a key."""
        return [self.named(entry, key) for entry in self.cameras]

    def view_mask_files(self, keys: Sequence[str] = VIEW_MASKS) -> dict[str, list[Path | None]]:
        """Masks of converted views that are named and exist, for each camera."""
        paths = {key: self.of_cameras(key) for key in keys}
        return {key: [path and (path if os.path.lexists(path) else None) for path in paths[key]] for key in keys}

    def view_masks(self, reduce: Reduce, keys: Sequence[str] = VIEW_MASKS) -> dict[str, Any]:
        return decode_view_masks(self.view_mask_files(keys), **self._labels(), reduce=reduce)

    def images(self, reduce: Reduce) -> torch.Tensor | list[torch.Tensor]:
        return decode_images(self.of_cameras("file"), **self._labels(), reduce=reduce)

    def _labels(self) -> dict[str, Any]:
        sizes = [(int(entry["height"]), int(entry["width"])) for entry in self.cameras]
        return {"names": [str(entry["name"]) for entry in self.cameras], "sizes": sizes}

    def points_file(self) -> Path | None:
        entry = self.calib.get("lidar")
        named = entry.get("file") if isinstance(entry, Mapping) else entry
        if not (named is None or (isinstance(named, str) and named)):
            raise DataError(f"{self.where}: lidar: expected {{'file': name}}, got {shown(entry)}")
        path = self.file(named or POINTS_FILE, "lidar")
        if path.is_file():
            return path
        if named is None and not os.path.lexists(self.folder / POINTS_FILE):
            return None
        fix = "copy it, remove the key 'lidar', or pass load_points=False"
        raise DataError(f"{self.where}: lidar: expected the points {path}, found no file; {fix}")

    def points(self) -> torch.Tensor | None:
        path, entry = self.points_file(), self.calib.get("lidar")
        if path is None:
            return None
        entry = entry if isinstance(entry, Mapping) else {}
        unread = [key for key in entry if _OF_POINTS.search(key) and entry[key]]
        if unread or "ego" not in str(entry.get("frame") or "ego").lower():
            got = ", ".join(f"{key}: {shown(entry[key])}" for key in unread or ["frame"])
            expected = "file and columns of float32 points in the ego frame"
            raise DataError(f"{self.where}: lidar: expected {expected}, got {got}")
        return checked_points(read_cloud(path, entry.get("columns"), _COLUMNS), str(path))

    def pose(self) -> torch.Tensor | None:
        """``ego2world``, None without."""
        if (value := self.calib.get("ego2world")) is None:
            return None
        if isinstance(value, Mapping):
            value = pose_of(self.where, value, "ego2world")
        try:
            pose = np.array(value, dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            pose = np.zeros(0)
        if not is_rigid(pose):
            expected = "4x4 finite numbers, a rotation beside a position over 0 0 0 1 (not transposed)"
            raise DataError(f"{self.where}: ego2world: expected {expected}, got {shown(value)}")
        return torch.from_numpy(pose)

    def boxes(self) -> torch.Tensor | None:
        """``boxes_3d``, None without."""
        if (rows := self.calib.get("boxes_3d")) is None:
            return None
        try:
            with np.errstate(over="ignore"):  # infinite in float32, and refused below
                array = np.array(rows, dtype=np.float64).astype(np.float32)
            checked_boxes(array)
        except SampleError as error:
            raise DataError(f"{self.where}: {error}") from None
        except (TypeError, ValueError, OverflowError) as error:
            raise DataError(f"{self.where}: boxes_3d: expected rows of at least 7 numbers, got {error}") from None
        return torch.from_numpy(array if array.size else array.reshape(0, 7))


class FrameFolder(Recording):
    """A folder that is a frame (it has ``calib.json``), or a folder of such folders, in the order of their names.

    ``docs/formats.md`` describes ``calib.json``, the points (a float .npy of shape (P, >=3), x y z first, in the ego
    frame, metres) and ``sequence.json``, an optional list of the frames of one drive in the
    order of their recording. All files lie below ``root``, which may be a link: names and links that leave it are
    refused.

    A sample is a dict: ``images`` (N, 3, h, w) uint8 RGB, or a list if sizes differ; ``rig`` (names, lenses, masks,
    ground); ``K`` (N, 3, 3) and ``cam2ego`` (N, 4, 4) float64; ``token`` (the folder's name); and, if the frame has
    them, ``points`` (P, >=3) float32, ``boxes_3d`` (B, >=7) float32, ``ego2world`` (4, 4) float64 and ``time_s``;
    ``scene_token`` (the root's name) if ``sequence.json`` lists the frame; ``coverage`` and ``generated`` (N, h, w)
    bool, or lists, as ``RigRetarget`` returns them, if ``convert`` wrote them.
    ``neighbours`` are frames of ``sequence.json`` with a pose. The numbers of points and boxes vary: batch with
    ``collate_fn=arbiview_aug.collate``.

    Args:
        root: The folder.
        reduce: Decode the images at 1, 1/2 or 1/4 of their size; the rig follows (see ``decode_images``).
        load_points: Whether to read the points.
        neighbours: Selection of other frames of the drive to add; None for none.
        clean_masks: Invert specks in masks, and mask the dark rim of fisheye images that have no mask. The rim is
            found in the first, the middle and the last frame together (``cleaned_rig``).

    Raises:
        TypeError: ``neighbours`` is neither ``Neighbours`` nor None.
        DataError: No frame under ``root``; on access, a file that is missing, broken or inconsistent.
        CalibrationError: On access, an impossible calibration, by camera.
    """

    writer = "arbiview_aug.cli.convert.writer:FrameFolders"

    def __init__(
        self,
        root: str | Path,
        *,
        reduce: Reduce = 1,
        load_points: bool = True,
        neighbours: Neighbours | None = None,
        clean_masks: bool = False,
    ) -> None:
        super().__init__(root, reduce, load_points, neighbours)
        self.clean_masks = clean_masks
        if not os.path.isdir(self.root):  # unlike Path.is_dir, False for a name that is too long
            raise DataError(f"frame folder {root}: expected a folder, found none")
        is_frame, root = (self.root / CALIBRATION_FILE).is_file(), self.root.resolve()  # so that "." has a name
        folders = () if is_frame else sorted(self.root.iterdir())
        frames = [_Frame(self.root, folder) for folder in folders if (folder / CALIBRATION_FILE).is_file()]
        self._frames = [_Frame(root, root)] if is_frame else frames
        if not self._frames:
            expected = f"expected {CALIBRATION_FILE}, or folders that have one, found neither"
            raise DataError(f"frame folder {root}: {expected}; docs/formats.md has the format")
        self.tokens = [frame.name for frame in self._frames]
        warn_of_unfinished(self.root, len(self))
        self._last_rig: tuple[str, Rig] | None = None
        self._masks: dict[tuple[str, float], BoolArray] = {}
        self._rims: dict[tuple[Any, ...], BoolArray | None] = {}
        self._times_s, order = _read_sequence(self.root, self._index)
        self._order = dict.fromkeys(order)
        self._warn = WarnOnce()
        self._drive = None if neighbours is None else self._find_drive()

    def files(self, index: int) -> list[Path]:
        """Source files of a frame: calibration, images, masks, and last the points."""
        frame = self._frames[checked_index(index, len(self))].read()
        masks = [*frame.of_cameras("mask"), *chain.from_iterable(frame.view_mask_files().values())]
        paths = [frame.folder / CALIBRATION_FILE, *frame.of_cameras("file"), *masks]
        return [path for path in (*paths, frame.points_file() if self.load_points else None) if path is not None]

    def __getitem__(self, index: int) -> dict[str, Any]:
        index = checked_index(index, len(self))
        frame = self._frames[index].read()
        rig = self._rig(frame)
        keys = "boxes_3d", "ego2world", "lidar", "lidars"
        for entries, read in ((frame.calib, keys), *((c, ("mask",)) for c in frame.cameras)):
            for wrong, meant in misnamed(entries, read).items():
                self._warn(wrong, f"{frame.where}: {wrong!r} is not read; did you mean {meant!r}?")
        sample = camera_fields(rig, frame.images(self.reduce), frame.name) | frame.view_masks(self.reduce)
        if self.load_points and (points := frame.points()) is not None:
            sample["points"] = points
        sample |= self._boxes_pose_time(frame)
        if frame.name in self._order:
            sample["scene_token"] = self.root.resolve().name
        if self._drive is not None:
            sample["neighbours"] = self._neighbours(self._drive, index)
        return sample

    def truth(self, index: int) -> dict[str, Any] | None:
        """``rig`` and ``images`` of a frame's ``truth`` camera, by default of its first camera's size; or None."""
        frame = self._frames[checked_index(index, len(self))].read()
        entry = frame.calib.get("truth")
        if entry is None:
            return None
        if not isinstance(entry, dict):
            raise CalibrationError(f"{frame.where}: truth: expected a camera's mapping, got {type(entry).__name__}")
        size = {key: frame.cameras[0].get(key) for key in ("width", "height")} if frame.cameras else {}
        frame = replace(frame, calib={**frame.calib, "cameras": [size | entry]})
        return camera_fields(self._rig(frame), frame.images(self.reduce), frame.name)

    def point_classes(self, index: int, count: int) -> npt.NDArray[np.int64] | None:
        """Class of each of a frame's ``count`` LiDAR points, if ``class.npy`` lies next to ``calib.json``."""
        path = self._frames[checked_index(index, len(self))].file(CLASSES_FILE)
        if not os.path.lexists(path):
            return None
        classes = read_cloud(path, None, _COLUMNS)
        if classes.shape != (count,) or classes.dtype.kind not in "iu":
            expected = f"a whole number for each of {count} points"
            raise DataError(f"classes {path}: expected {expected}, got {classes.dtype} {classes.shape}")
        return classes.astype(np.int64)

    def _boxes_pose_time(self, frame: _Frame) -> dict[str, Any]:
        values = {"boxes_3d": frame.boxes(), "ego2world": frame.pose(), "time_s": self._times_s.get(frame.name)}
        return {key: value for key, value in values.items() if value is not None}

    def _find_drive(self) -> Drive:
        """Read the poses of the frames of ``sequence.json``; broken frames, and too few, give warnings."""
        positions_m = {}
        for name in self._order:
            frame = self._frames[self._index[name]]
            try:
                if (pose := frame.read().pose()) is not None:
                    positions_m[name] = pose.numpy()[:3, 3]
            except ArbiviewError as error:
                warn(f"{error}; this frame is no neighbour")
        names = list(positions_m)
        if len(names) < 2:
            found = "one" if names else "none"
            warn(f"{self.root}: neighbours: expected frames of a drive ({SEQUENCE_FILE} and ego2world), found {found}")
        times_s = self._times_s if all(name in self._times_s for name in names) else None
        parts = parts_of_clock(names, times_s, str(self.root / SEQUENCE_FILE))
        rows = [self._index[name] for name in names]
        return Drive(rows, np.array(list(positions_m.values())).reshape(-1, 3), parts)

    def _neighbour(self, row: int) -> LazyFrame:
        frame = self._frames[row].read()
        fields = {"token": frame.name, "rig": self._rig(frame), **self._boxes_pose_time(frame)}
        fields |= frame.view_masks(self.reduce, ("coverage",))
        return LazyFrame(fields, partial(frame.images, self.reduce), frame.points if self.load_points else None)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_last_rig": None, "_masks": {}}

    def _rig(self, frame: _Frame) -> Rig:
        """The frame's rig; the last one itself if the calibration is the same."""
        calib, masks, read = frame.calib, frame.of_cameras("mask"), ("name", "width", "height", "K", "cam2ego")
        bare = []  # entries that decide the rig, without timestamps and files
        for entry in frame.cameras:
            has_lens = canonical_name(str(entry.get("lens"))) in LENSES  # which is refused; other words are notes
            keys = (*read, "distortion", *["lens"] * has_lens, *misnamed(entry, (*read, "distortion")))
            bare.append({key: entry[key] for key in keys if key in entry})
        data = {"name": calib.get("name", calib.get("dataset", "")), "cameras": bare}
        data |= {key: calib[key] for key in ("ground_z_m", "lidars", *misnamed(calib, ("ground_z_m",))) if key in calib}
        key = json.dumps([data, [mask and (os.path.realpath(mask), _modified_s(mask)) for mask in masks]])
        last = self._last_rig  # read once, for threads
        if last is None or last[0] != key:
            rig = Rig.from_dict(data, where=frame.where)
            cameras = [self._with_mask(camera, file, frame) for camera, file in zip(rig, masks, strict=True)]
            cameras = list(map(self._without_rim, cameras)) if self.clean_masks else cameras
            last = self._last_rig = key, reduced_rig(rig.with_cameras(cameras), self.reduce)
        return last[1]

    def _with_mask(self, camera: Camera, path: Path | None, frame: _Frame) -> Camera:
        if path is None:
            return camera
        key = os.path.realpath(path), _modified_s(path)
        if (mask := self._masks.get(key)) is None:
            mask = read_mask(str(path), path.parent, f"{frame.where}: camera {camera.name!r}")
            mask = without_specks(mask) if self.clean_masks else mask
            self._masks = {key: mask} if len(self._masks) >= _CACHED_MASKS else {**self._masks, key: mask}
        with calibration_of(frame.where):
            return replace(camera, mask=mask)

    def _without_rim(self, camera: Camera) -> Camera:
        """The camera with a mask of the rim that is dark in several frames, if it has no mask."""
        if camera.mask is not None or camera.is_rectilinear:
            return camera
        key = camera.name, camera.size, camera.lens, camera.distortion, camera.K.tobytes()  # poses may differ by frame
        if key not in self._rims:
            images = []
            for k in sorted({0, len(self) // 2, len(self) - 1}):
                with suppress(ArbiviewError):  # raised when that frame is read
                    frame = self._frames[k].read()
                    for entry in (entry for entry in frame.cameras if entry.get("name") == camera.name):
                        file: Any = frame.named(entry, "file")
                        images.append(decode_images([file], names=[camera.name], sizes=[camera.size])[0])
            circle = image_circle(camera, torch.stack(images).amax(dim=0)) if images else None
            self._rims[key] = None if circle is None else circle.holds(camera)
        return replace(camera, mask=self._rims[key])


def entry_name(entry: Any) -> str:
    """The frame's name of an entry in ``sequence.json``."""
    return str(entry["name"] if isinstance(entry, Mapping) else entry)


def _read_sequence(root: Path, index: Mapping[str, int]) -> tuple[dict[str, float], list[str]]:
    """Read times (s) by frame and the frames in order; nothing without ``sequence.json``."""
    path = inside(root, SEQUENCE_FILE, str(root))
    if not os.path.lexists(path):
        return {}, []
    try:
        listed = parse_json(read_text(path, MOST_BYTES))["frames"]
        if not isinstance(listed, list):
            raise TypeError(f"frames of type {type(listed).__name__}")
        names = [*map(entry_name, listed)]
        mappings = [entry for entry in listed if isinstance(entry, Mapping)]
        if unread := sorted({key for entry in mappings for key in entry if _CLOCK.search(str(key))}):
            raise ValueError(f"{', '.join(unread)}, which is not read: time_s is in seconds")
        times_s = {entry_name(entry): float(entry["time_s"]) for entry in mappings if "time_s" in entry}
    except (OSError, ValueError, KeyError, TypeError, RecursionError, OverflowError) as error:
        expected = "{'frames': [names, or {'name': ..., 'time_s': ...}]}"
        got = f"no {error}" if isinstance(error, KeyError) else f"{type(error).__name__}: {error}"
        raise DataError(f"{path}: expected {expected}, got {got}") from None
    for name in names:
        if name not in index:
            raise DataError(f"{path}: expected names of the folders beside it, got {shown(name)}")
        if not np.isfinite(times_s.get(name, 0.0)):
            raise DataError(f"{path}: frame {name!r}: time_s: expected a finite number, got {times_s[name]}")
    if len(set(names)) < len(names):
        raise DataError(f"{path}: expected each frame once, got {len(names)} entries for {len(set(names))} frames")
    return times_s, names


def _modified_s(path: Path) -> float:
    return os.path.getmtime(path) if os.path.isfile(path) else 0.0


def write_frame(folder: Path, sample: Mapping[str, Any]) -> None:
    """Write a sample's uint8 images as JPEGs, its rig without masks, and its points, boxes and pose if it has them."""
    names = [{"file": f"{k:02}.jpg"} for k in range(len(sample["images"]))]
    files = {name["file"]: encoded_image(image) for name, image in zip(names, sample["images"], strict=True)}
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in (files | frame_files(sample["rig"], names, sample)).items():
        (folder / name).write_bytes(content)


def frame_files(
    rig: Rig, names: Sequence[Mapping[str, str]], sample: Mapping[str, Any], further: Mapping[str, Any] | None = None
) -> dict[str, bytes]:
    """A frame's points, and last its calibration with ``further`` entries, by their names in its folder.

    ``names`` are those of each camera's image and masks by their key. Boxes, their names and the pose are the sample's.
    """
    calib, files = rig.to_dict(), {}
    for entry, named in zip(calib["cameras"], names, strict=True):
        entry |= named
    if "points" in sample:
        np.save(file := BytesIO(), sample["points"].numpy())
        files = {POINTS_FILE: file.getvalue()}
    if "boxes_3d" in sample:  # JSON has no NaN
        calib["boxes_3d"] = [[None if x != x else x for x in box] for box in sample["boxes_3d"].tolist()]
    calib |= {"box_names": sample["box_names"]} if "box_names" in sample else {}
    calib |= {"ego2world": sample["ego2world"].tolist()} if "ego2world" in sample else {}
    return files | {CALIBRATION_FILE: json.dumps({**calib, **(further or {})}, indent=1).encode()}
