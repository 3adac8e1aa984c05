"""Decoding of a frame's images into one block, in the renderer's memory layout, and encoding.

OpenCV crashes on paths that are not UTF-8, so files are read here and it gets their bytes. It fills truncated JPEGs
with grey and rotates images by their EXIF orientation, which is prevented here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera, resize_matrix
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import Reduce
from arbiview_aug.errors import DataError, SampleTypeError
from arbiview_aug.files import read_bytes
from arbiview_aug.sample.batching import stacked

ByteArray = npt.NDArray[np.uint8]

_MOST_BYTES = 1 << 28  # of an image file: more than 9,000 by 9,000 pixels take, uncompressed

# Without the bit of BGR, which excludes IMREAD_COLOR_RGB.
_REDUCED_FLAGS = {1: 0, 2: cv2.IMREAD_REDUCED_GRAYSCALE_2, 4: cv2.IMREAD_REDUCED_GRAYSCALE_4}
_FLAGS = cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_COLOR_RGB

_JPEG_START, _JPEG_END = b"\xff\xd8", b"\xff\xd9"
_PNG_START, _PNG_END = b"\x89PNG\r\n\x1a\n", b"IEND\xaeB`\x82"
_FRAME_HEADERS = frozenset(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # SOF0..15, without DHT, JPG and DAC


def decode_images(
    paths: Sequence[str | Path],
    *,
    names: Sequence[str] | None = None,
    sizes: Sequence[tuple[int, int]] | None = None,
    reduce: Reduce = 1,
) -> torch.Tensor | list[torch.Tensor]:
    """Decode JPEG and PNG files as RGB.

    The result is a permuted view of one (N, h, w, 3) block (channels last in memory), which the CPU renderer takes
    without a copy. EXIF orientations are ignored, grey images get three equal channels, alpha channels are dropped.

    With ``reduce`` 2 or 4 each side becomes ceil(side / reduce) and a pixel covers exactly reduce by reduce pixels of
    the full image, counted from its top-left corner (see ``reduced_camera``). JPEGs are decoded at the smaller size,
    which is faster. A complete JPEG with corrupt data is not detected.

    Args:
        paths: The files.
        names: Camera names for the messages; the file's stem by default.
        sizes: Calibrated (h, w) of each full image; unchecked if None.
        reduce: 1, 2 or 4.

    Returns:
        (N, 3, h, w) uint8, or a list of (3, h_i, w_i) if the sizes differ.

    Raises:
        DataError: A file that is missing, empty, truncated, undecodable or of another size, by camera and file.
        ValueError: Another ``reduce``, or not as many names or sizes as files.
    """
    check_reduce(reduce)
    files = [Path(path) for path in paths]
    for argument, values in (("names", names), ("sizes", sizes)):
        if values is not None and len(values) != len(files):
            raise ValueError(f"{argument}: expected one for each of {len(files)} images, got {len(values)}")
    labels = [f"camera {(names[k] if names else file.stem)!r}: image {file}" for k, file in enumerate(files)]
    contents = [_content(file, label) for file, label in zip(files, labels, strict=True)]
    headers = [_header(content, label) for content, label in zip(contents, labels, strict=True)]
    for (_, (h, w)), label, size in zip(headers, labels, sizes, strict=True) if sizes is not None else ():
        if (h, w) != size:
            fix = "use the calibration of these images, or resize its camera (Camera.resize) with them"
            fix = "the calibration's width and height look swapped" if (w, h) == size else fix
            raise DataError(f"{label}: expected {size[1]}x{size[0]} (w x h) as calibrated, got {w}x{h}; {fix}")
    shapes = [(*reduced_size(size, reduce), 3) for _, size in headers]
    is_block = len(set(shapes)) == 1
    images: Any = np.empty((len(files), *shapes[0]), np.uint8) if is_block else [np.empty(s, np.uint8) for s in shapes]
    for content, label, (format, _), out in zip(contents, labels, headers, images, strict=True):
        image = _decoded(content, label, format, _FLAGS | (_REDUCED_FLAGS[reduce] if format == "JPEG" else 0))
        if format == "PNG":  # cv2's reduced flags round sizes down, to another scale than for JPEGs
            image = area_reduced(image, reduce)
        if image.shape != out.shape:
            raise DataError(f"{label}: expected {out.shape} as its header says, decoded {image.shape}; write it again")
        out[...] = image
    if is_block:
        return torch.from_numpy(images).permute(0, 3, 1, 2)
    return [torch.from_numpy(image).permute(2, 0, 1) for image in images]


def check_reduce(reduce: int) -> None:
    """Raise ValueError unless ``reduce`` is 1, 2 or 4."""
    if reduce not in get_args(Reduce):
        raise ValueError(f"reduce: expected 1, 2 or 4, got {reduce!r}")


def reduced_size(size: tuple[int, int], reduce: int) -> tuple[int, int]:
    """(h, w) of an image decoded with ``reduce``: rounded up, as libjpeg does."""
    return -(-size[0] // reduce), -(-size[1] // reduce)


def reduced_camera(camera: Camera, reduce: Reduce) -> Camera:
    """The camera of an image decoded with ``reduce``.

    Pixels scale by exactly 1 / reduce about the outer top-left corner, x' = (x + 1/2) / reduce - 1/2, even if an odd
    side is rounded up and its last pixel reaches past the image (``Camera.resize`` aligns outer edges instead). A
    reduced pixel's mask is True only if all of its pixels' are.
    """
    check_reduce(reduce)
    if reduce == 1:
        return camera
    A = resize_matrix((reduce, reduce), (1, 1))
    height_px, width_px = reduced_size(camera.size, reduce)
    mask = None if camera.mask is None else _reduced_mask(camera.mask, reduce)
    return replace(camera, width_px=width_px, height_px=height_px, K=A @ camera.K, mask=mask)


def _reduced_mask(mask: BoolArray, reduce: int) -> BoolArray:
    """A mask whose reduced pixels are True only if all of their pixels are."""
    height_px, width_px = reduced_size(mask.shape[:2], reduce)
    mask = np.pad(mask, [(0, -side % reduce) for side in mask.shape], mode="edge")
    return np.asarray(mask.reshape(height_px, reduce, width_px, reduce).all(axis=(1, 3)))


def reduced_rig(rig: Rig, reduce: Reduce) -> Rig:
    """The rig of images decoded with ``reduce``."""
    return rig if reduce == 1 else rig.with_cameras([reduced_camera(camera, reduce) for camera in rig])


VIEW_MASKS = ("coverage", "generated")
"""Masks that ``convert`` writes next to its views; readers add them to samples."""


def decode_view_masks(
    files: Mapping[str, Sequence[Path | None]],
    *,
    names: Sequence[str],
    sizes: Sequence[tuple[int, int]],
    reduce: Reduce = 1,
) -> dict[str, torch.Tensor | list[torch.Tensor]]:
    """Read some of ``VIEW_MASKS``, given a file for each camera, or None; ``sizes`` are (h, w) of the full images.

    Returns (N, h, w) bool by name, or a list of (h_i, w_i) if the sizes differ; DataError for a file that is no image,
    or of another size. Pixels without a file are covered and not generated. With ``reduce``, a pixel is covered if all
    of its pixels are, and generated if any is. Masks without any file are left out.
    """
    masks = {}
    for key, paths in files.items():
        if any(paths):
            is_filled = key == "coverage"  # a reduced pixel is as its filled ones are only if all of its pixels are
            views = []
            for name, size, path in zip(names, sizes, paths, strict=True):
                mask, label = np.full(size, is_filled), f"camera {name!r}: {key} {path}"
                if path is not None:
                    mask = _decoded(_content(path, label), label, "file", cv2.IMREAD_GRAYSCALE) > 0
                if mask.shape != size:
                    got = f"{mask.shape[1]}x{mask.shape[0]}; convert again"
                    raise DataError(f"{label}: expected an image of {size[1]}x{size[0]} (w x h), got {got}")
                views.append(mask if reduce == 1 else _reduced_mask(mask == is_filled, reduce) == is_filled)
            masks[key] = stacked([torch.from_numpy(view) for view in views])
    return masks


def _content(path: Path, label: str) -> bytes:
    try:
        return read_bytes(path, _MOST_BYTES)
    except FileNotFoundError:
        raise DataError(f"{label}: expected an image file, found none; check the path and the data root") from None
    except OSError as error:
        raise DataError(f"{label}: expected a readable image file, got {error.strerror}") from None


def _header(data: bytes, label: str) -> tuple[str, tuple[int, int]]:
    if not data:
        raise DataError(f"{label}: expected a JPEG or PNG, got an empty file (0 bytes); copy it again")
    if data.startswith(_JPEG_START):
        # Segments before the scan may hold thumbnails with other ends; padding or maker notes may follow the end.
        format, size, at = "JPEG", (0, 0), len(_JPEG_START)
        while data[at : at + 1] == b"\xff" and (marker := _number(data, at + 1, 1)) != 0xDA:
            if marker in _FRAME_HEADERS:
                size = _number(data, at + 5, 2), _number(data, at + 7, 2)
            at += 1 if marker == 0xFF else 2 + _number(data, at + 2, 2)  # fill bytes may precede a marker
        ended = size != (0, 0) and data.rfind(_JPEG_END) >= at
    elif data.startswith(_PNG_START):
        format, size, ended = "PNG", (_number(data, 20, 4), _number(data, 16, 4)), data.rfind(_PNG_END) > 0
    else:
        raise DataError(f"{label}: expected a JPEG or PNG, got a file that begins with {data[:8]!r}")
    if not ended:
        raise DataError(f"{label}: expected a complete {format}, got a truncated file; copy it again")
    if 0 in size:
        raise DataError(f"{label}: expected an image, got a {format} of {size[1]}x{size[0]} pixels; write it again")
    # OpenCV keeps the upper 8 bits of 16, which are 0 where a sensor fills the lower ones.
    if format == "PNG" and (depth := _number(data, 24, 1)) > 8:
        fix = "scale it to 8 bits by the sensor's range, such as (image >> 4).astype('uint8') from 12"
        raise DataError(f"{label}: expected 8 bits a channel, got a PNG of {depth}; {fix}")
    return format, size


def decode_bytes(data: bytes, label: str) -> ByteArray:
    """Decode the bytes of a JPEG or PNG file as (h, w, 3) RGB, as ``decode_images`` does; DataError by ``label``."""
    if not isinstance(data, bytes | bytearray):
        raise DataError(f"{label}: expected a file's bytes, got {type(data).__name__}; do not decode before")
    format, _ = _header(data, label)
    return _decoded(data, label, format, _FLAGS)


def _decoded(data: bytes, label: str, format: str, flags: int) -> ByteArray:
    try:
        image: Any = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # no bytes, or more pixels than OpenCV decodes
        image = None
    if image is None:
        raise DataError(f"{label}: expected an image, got a {format} that cannot be decoded; copy it again")
    return image  # type: ignore[no-any-return]


def _number(data: bytes, at: int, length: int) -> int:
    return int.from_bytes(data[at : at + length], "big")


def area_reduced(image: npt.NDArray[Any], reduce: int) -> npt.NDArray[Any]:
    """(h, w, 3) reduced about the outer top-left corner, as ``reduced_camera`` says; contiguous."""
    if reduce == 1:
        return np.ascontiguousarray(image)
    h, w = image.shape[:2]
    image = cv2.copyMakeBorder(image, 0, -h % reduce, 0, -w % reduce, cv2.BORDER_REPLICATE)
    return cv2.resize(image, reduced_size((h, w), reduce)[::-1], interpolation=cv2.INTER_AREA)


JPEG_QUALITY = 96  # quality at 4:4:4 chroma, hardly below lossless (acceptance/test_converted.py)

_JPEG = (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, 0x111111)


def encoded_image(image: torch.Tensor, suffix: str = ".jpg") -> bytes:
    """Encode an RGB image (3, h, w) as ``.jpg`` or lossless ``.png``; SampleTypeError for images that are not uint8."""
    if image.dtype != torch.uint8:
        fix = "convert [0, 1] by (images * 255).round().byte()"
        raise SampleTypeError(f"images: expected uint8 to write, got {image.dtype}; {fix}")
    planes = [np.ascontiguousarray(image[channel].numpy()) for channel in (2, 1, 0)]
    return encoded(np.asarray(cv2.merge(planes), np.uint8), suffix)


def encoded(picture: npt.NDArray[np.uint8], suffix: str) -> bytes:
    """Encode a grey picture (h, w) or a BGR one (h, w, 3)."""
    _, coded = cv2.imencode(suffix, picture, _JPEG if suffix == ".jpg" else [])
    return coded.tobytes()
