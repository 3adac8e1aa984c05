"""COLMAP's cameras and images, as text and binary ("Output Format" of its documentation)."""

from __future__ import annotations

import os
import re
import struct
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from arbiview_aug.cameras.formats.entries import WAY_OUT, camera_entry, focal_and_center, lens_of, matrix, refusal
from arbiview_aug.cameras.formats.mounting import MOUNTING, Mounting
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.plain_yaml import read_calibration_text
from arbiview_aug.cameras.rotations import poses_from, quaternion_from_rotation
from arbiview_aug.errors import CalibrationError, shown
from arbiview_aug.files import read_bytes

# src/colmap/sensor/models.h: number of the model, name, numbers of focal lengths and coefficients, our lens. Parameters
# are focal lengths, cx, cy, coefficients.
_MODELS = (
    (0, "SIMPLE_PINHOLE", 1, 0, "pinhole"),
    (1, "PINHOLE", 2, 0, "pinhole"),
    (2, "SIMPLE_RADIAL", 1, 1, "radtan"),
    (3, "RADIAL", 1, 2, "radtan"),
    (4, "OPENCV", 2, 4, "radtan"),
    (5, "OPENCV_FISHEYE", 2, 4, "fisheye"),
    (6, "FULL_OPENCV", 2, 8, "radtan"),
    (8, "SIMPLE_RADIAL_FISHEYE", 1, 1, "fisheye"),
    (9, "RADIAL_FISHEYE", 1, 2, "fisheye"),
    (10, "THIN_PRISM_FISHEYE", 2, 8, "fisheye"),  # k1 k2 p1 p2 k3 k4 sx1 sy1
    (14, "SIMPLE_FISHEYE", 1, 0, "fisheye"),
    (15, "FISHEYE", 2, 0, "fisheye"),
    (16, "EUCM", 2, 2, "eucm"),
)
_NOT_READ = {7: "FOV", 11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION", 17: "EQUIRECTANGULAR"}
_MOST_BYTES = 1 << 28  # of images with their points


class _Image(NamedTuple):
    name: str
    camera: int
    pose: FloatArray  # (4, 4) camera to world, in the reconstruction's units


def read_colmap(path: Path, mounting: Mounting) -> list[dict[str, Any]]:
    """Images of one moment as cameras: all, if each camera has one, or those that ``mounting.yaml`` names."""
    folder = path if path.is_dir() else path.parent
    end = path.suffix if path.is_file() else ".bin" if (folder / "images.bin").is_file() else ".txt"
    cameras_of, images_of = (_binary_cameras, _binary_images) if end == ".bin" else (_text_cameras, _text_images)
    models, images = dict(cameras_of(folder / f"cameras{end}")), list(images_of(folder / f"images{end}"))
    if not mounting.images and len({image.camera for image in images}) < len(images):
        camera, times = Counter(image.camera for image in images).most_common(1)[0]
        fix = f"Write one for each camera to {MOUNTING} beside the files: images: {{front: {images[0].name}, ...}}"
        raise CalibrationError(f"camera {camera} has {times} images: which were taken at one moment? {fix}")
    by_file = {image.name: image for image in images}
    if len(by_file) < len(images):
        (file, times), *_ = Counter(image.name for image in images).most_common(1)
        raise CalibrationError(f"images{end}: expected images with different names, got {shown(file)} {times} times")
    for file in mounting.images.values():
        if file not in by_file:
            expected = f"files that images{end} has, such as {images[0].name}"
            raise CalibrationError(f"{MOUNTING}: images: expected {expected}, got {shown(file)}")
    names = [os.path.dirname(file) or Path(file).stem for file in by_file]
    if len({*names}) < len(by_file):  # several cameras in a folder
        names = [Path(file).stem for file in by_file]
    if not mounting.images and len({*names}) < len(by_file):
        fix = f"write one for each to {MOUNTING} beside the files: images: {{front: {images[0].name}, ...}}"
        raise CalibrationError(f"expected images with different names, got {', '.join(names[:8])}: {fix}")
    chosen = {name: by_file[file] for name, file in (mounting.images or dict(zip(names, by_file, strict=True))).items()}
    if mounting.metres_per_unit is None:
        example = f"poses: {{{next(iter(chosen), 'front')}: [[r, r, r, x], ...]}}"
        fix = f"Write it and the pose of one camera to {MOUNTING} beside the files: metres_per_unit: 1.0, {example}"
        raise CalibrationError(f"how many metres is a unit of the reconstruction? {fix}")
    scale = np.ones((4, 4))
    scale[:3, 3] = mounting.metres_per_unit
    poses = mounting.mounted({name: image.pose * scale for name, image in chosen.items()})
    return [_camera(name, models[chosen[name].camera], cam2ego) for name, cam2ego in poses.items()]


def _camera(name: str, camera: tuple[Any, int, int, list[float]], cam2ego: FloatArray) -> dict[str, Any]:
    key, width, height, numbers = camera
    _, model, focals, bends, lens = _model(key)
    if len(numbers) != (expected := focals + 2 + bends):
        raise CalibrationError(f"camera {name!r}: expected {expected} parameters of {model}, got {len(numbers)}")
    cx, cy, *coefficients = numbers[focals:]
    if model == "THIN_PRISM_FISHEYE":
        k1, k2, p1, p2, k3, k4, *prism = coefficients
        if any((p1, p2, *prism)):
            raise refusal(name, f"{model} with p1, p2, sx1 and sy1 of 0", shown(coefficients), WAY_OUT)
        coefficients = [k1, k2, k3, k4]
    if lens != "pinhole":
        coefficients += [0.0] * (4 - len(coefficients)) if lens != "eucm" else []
    K = matrix(numbers[0], numbers[focals - 1], cx - 0.5, cy - 0.5)
    return camera_entry(name, (width, height), K, cam2ego, lens, coefficients)


def _model(key: int | str) -> tuple[int, str, int, int, str]:
    for model in _MODELS:
        if key in model[:2]:
            return model
    got = f"{_NOT_READ.get(int(key), key) if isinstance(key, int) else key}; {WAY_OUT}"
    raise CalibrationError(f"camera model: expected {', '.join(model[1] for model in _MODELS)}, got {got}")


def _text(path: Path) -> list[str]:
    return read_calibration_text(path, path.name, _MOST_BYTES).splitlines()


def _text_cameras(path: Path) -> Iterator[tuple[int, tuple[Any, int, int, list[float]]]]:
    for line in _text(path):
        if line.strip() and not line.startswith("#"):
            number, model, width, height, *numbers = line.split()
            yield int(number), (model, int(width), int(height), list(map(float, numbers)))


def _text_images(path: Path) -> Iterator[_Image]:
    lines = [line for line in _text(path) if not line.startswith("#")]
    for points in filter(str.strip, lines[1::2]):  # X, Y and a number of each point
        if len(points.split()) % 3 or not re.search(r"\s-?\d+\s*$", points):
            expected = "two lines for each image, the second with its points or empty"
            raise CalibrationError(f"{path.name}: expected {expected}, got {shown(points)}")
    for line in filter(str.strip, lines[::2]):
        _, *numbers, camera, name = line.split(maxsplit=9)
        yield _image(name, int(camera), list(map(float, numbers)))


def _binary_cameras(path: Path) -> Iterator[tuple[int, tuple[Any, int, int, list[float]]]]:
    data, at = read_bytes(path, _MOST_BYTES), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        number, key, width, height = struct.unpack_from("<iiQQ", data, at)
        length = _model(key)[2] + 2 + _model(key)[3]
        yield number, (key, width, height, list(struct.unpack_from(f"<{length}d", data, at + 24)))
        at += 24 + 8 * length


def _binary_images(path: Path) -> Iterator[_Image]:
    data, at = read_bytes(path, _MOST_BYTES), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        _, *numbers, camera = struct.unpack_from("<i7di", data, at)
        end = data.index(b"\0", at + 64)
        yield _image(data[at + 64 : end].decode(), camera, numbers)
        at = end + 9 + 24 * struct.unpack_from("<Q", data, end + 1)[0]  # x, y and a number of each point


def _image(name: str, camera: int, numbers: list[float]) -> _Image:
    """An image of a quaternion w x y z and a translation, world to camera."""
    world2cam = poses_from([*numbers[4:], *numbers[:4]])
    return _Image(name, camera, np.asarray(np.linalg.inv(world2cam), np.float64))


def colmap_files(data: Mapping[str, Any]) -> dict[str, Any]:
    """``cameras.txt``, ``images.txt`` and an empty ``points3D.txt``; the world is the ego frame, in metres."""
    cameras, images, files, names = [], [], dict[str, Any](), dict[str, str]()
    taken = {camera["name"] for camera in data["cameras"]}
    for number, camera in enumerate(data["cameras"], 1):
        lens, coefficients = lens_of(camera, "COLMAP", {"radtan": 8, "fisheye": 4})
        if len(coefficients) == 5:
            coefficients += [0.0] * 3
        model = "OPENCV_FISHEYE" if lens == "fisheye" else "OPENCV" if len(coefficients) == 4 else "FULL_OPENCV"
        fx, fy, cx, cy = focal_and_center(camera, "COLMAP")
        cameras.append((number, model, camera["width"], camera["height"], fx, fy, cx + 0.5, cy + 0.5, *coefficients))
        world2cam = np.linalg.inv(np.array(camera["cam2ego"]))
        pose = *quaternion_from_rotation(world2cam[:3, :3]).tolist(), *world2cam[:3, 3].tolist()
        free = (one for k in count(number) if (one := f"camera{k}") not in taken)
        name = camera["name"] if re.fullmatch(r"\S*[^\s/]", camera["name"]) else next(free)
        taken.add(name)
        names[name] = camera["name"]
        images.append((number, *pose, number, f"{name}/0.png\n"))  # and no points
    for file, head, rows in (
        ("cameras", "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", cameras),
        ("images", "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)", images),
        ("points3D", "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)", []),
    ):
        lines = (" ".join(map(str, row)) for row in rows)
        files[f"{file}.txt"] = "\n".join([f"# {head}", *lines, ""])
    poses = {next(iter(names)): data["cameras"][0]["cam2ego"]}
    mounting = {"metres_per_unit": 1.0, "poses": poses, "names": names}
    return files | {MOUNTING: {"ground_z_m": data["ground_z_m"], **mounting}}
