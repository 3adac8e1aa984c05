"""Decoding: layout, half pixels of the reduced decode, and files that must not pass as pictures."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug.datasets.image_io import decode_images, decode_view_masks, reduced_camera
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.report.pictures import save_picture
from tests.helpers import camera, latin


def ramp(height_px: int, width_px: int) -> np.ndarray:
    """(h, w, 3) float RGB whose channels are different linear functions of the pixel."""
    y, x = np.mgrid[:height_px, :width_px].astype(np.float64)
    # Odd slopes, so that rounding to whole grey levels averages out.
    return np.stack([20 + 0.5173 * x + 0.2119 * y, 40 + 0.31 * x + 0.41 * y, 220 - 0.41 * x - 0.31 * y], -1)


def write(path: Path, rgb: np.ndarray) -> Path:
    parameters = [cv2.IMWRITE_JPEG_QUALITY, 100, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    pixels = rgb.round().astype(np.uint8)[..., ::-1]
    assert cv2.imwrite(str(path), pixels, parameters if path.suffix == ".jpg" else [])
    return path


@pytest.fixture
def jpeg(tmp_path: Path) -> Path:
    return write(tmp_path / "front.jpg", ramp(90, 160))


# --- what comes back --------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_rgb_in_channels_last_memory_of_one_block(tmp_path: Path, suffix: str) -> None:
    files = [write(tmp_path / f"{k}{suffix}", ramp(90, 160) / (k + 1)) for k in range(3)]
    images: Any = decode_images(files)
    assert images.shape == (3, 3, 90, 160) and images.dtype == torch.uint8
    assert images.permute(0, 2, 3, 1).is_contiguous()
    for k in range(3):
        error = images[k].permute(1, 2, 0).numpy() - ramp(90, 160) / (k + 1)
        assert np.abs(error).max() <= (6 if suffix == ".jpg" else 0.51)


def test_different_sizes_give_a_list(tmp_path: Path) -> None:
    files = [write(tmp_path / "a.jpg", ramp(90, 160)), write(tmp_path / "b.png", ramp(64, 100))]
    assert [tuple(image.shape) for image in decode_images(files, reduce=2)] == [(3, 45, 80), (3, 32, 50)]


def test_exif_orientation_does_not_turn_the_image_away_from_its_calibration(jpeg: Path) -> None:
    upright: Any = decode_images([jpeg])
    # APP1 with one EXIF tag: Orientation (0x0112) = 6, turn by 90 degrees to show.
    tag = b"\x12\x01\x03\x00\x01\x00\x00\x00\x06\x00\x00\x00"
    exif = b"Exif\x00\x00II*\x00\x08\x00\x00\x00\x01\x00" + tag + b"\x00\x00\x00\x00"
    data = jpeg.read_bytes()
    jpeg.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    assert cv2.imread(str(jpeg)).shape[:2] == (160, 90)  # OpenCV's default would turn it
    assert torch.equal(upright, decode_images([jpeg], sizes=[(90, 160)]))  # type: ignore[arg-type]


# --- reduced decode ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
@pytest.mark.parametrize("reduce", [2, 4])
@pytest.mark.parametrize("size", [(100, 200), (101, 203), (102, 206), (103, 201)])
def test_convention_reduced_pixels_and_camera_agree(
    tmp_path: Path, suffix: str, reduce: int, size: tuple[int, int]
) -> None:
    """The ramp's value at a reduced pixel is the ramp at the full pixel that sees the same ray."""
    grey = ramp(*size)[..., :1].repeat(3, axis=-1)
    image = decode_images([write(tmp_path / f"ramp{suffix}", grey)], reduce=reduce)[0].permute(1, 2, 0).numpy()
    full, small = camera(size=size), reduced_camera(camera(size=size), reduce)
    assert image.shape == (*small.size, 3) == (-(-size[0] // reduce), -(-size[1] // reduce), 3)

    inside = np.s_[1:-1, 1:-1]  # the last row and column may reach past the image
    uv = small.pixel_grid()[inside]
    back = full.project(small.unproject(uv).directions + small.center_m).uv
    expected = 20 + 0.5173 * back[..., 0] + 0.2119 * back[..., 1]
    error = image[inside][..., 0] - expected
    # Half a pixel would be 0.36. Averaging PNGs by two rounds halves up: + 0.125.
    assert abs(error.mean()) < (0.06 if suffix == ".jpg" else 0.18)
    assert np.abs(error).max() < 1.5


def test_a_reduced_mask_is_scene_where_all_of_its_pixels_are() -> None:
    mask, expected = np.ones((5, 7), bool), np.ones((3, 4), bool)
    mask[3, 2] = mask[0, 6] = expected[1, 1] = expected[0, 3] = False
    np.testing.assert_array_equal(reduced_camera(camera(size=(5, 7), mask=mask), 2).mask, expected)


# --- bad files --------------------------------------------------------------------------------------------------------
def half(data: bytes) -> bytes:
    return data[: len(data) // 2]


def one_byte_off(data: bytes) -> bytes:
    return half(data) + bytes([data[len(data) // 2] ^ 255]) + data[len(data) // 2 + 1 :]


def without_tables(data: bytes) -> bytes:
    """OpenCV hands such a JPEG's given array back untouched, as if it had worked."""
    table = data.find(b"\xff\xc4")
    return data[: table + 5] + b"\xff" * 16 + data[table + 21 :]


def without_rows(data: bytes) -> bytes:
    """A JPEG may leave its height to a later marker, which OpenCV does not read."""
    header = data.find(b"\xff\xc0")
    return data[: header + 5] + bytes(2) + data[header + 7 :]


def sixteen_bits(data: bytes) -> bytes:
    """Ten of them, as sensors give: OpenCV would make it black."""
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    return cv2.imencode(".png", image.astype(np.uint16) * 4)[1].tobytes()


@pytest.mark.parametrize(
    ("suffix", "damage", "message"),
    [
        (".jpg", None, "expected an image file, found none"),
        (".jpg", Path.mkdir, "got a folder, pipe, socket or device"),
        (".jpg", os.mkfifo, "got a folder, pipe, socket or device"),
        (".jpg", lambda data: b"", "got an empty file"),
        (".jpg", lambda data: b"<html>404</html>", "expected a JPEG or PNG, got a file that begins with b'<html>40'"),
        (".jpg", lambda data: half(data) + bytes(len(data) - len(half(data))), "truncated file"),
        *((suffix, lambda data: data[: len(data) * 99 // 100], "got a ") for suffix in (".jpg", ".png")),
        *((suffix, lambda data: data[: max(3, len(data) // 100)], "got a ") for suffix in (".jpg", ".png")),
        (".jpg", without_rows, "expected an image, got a JPEG of 160x0 pixels"),
        (".jpg", without_tables, "got a JPEG that cannot be decoded"),
        (".png", one_byte_off, "got a PNG that cannot be decoded"),
        (".png", sixteen_bits, "expected 8 bits a channel, got a PNG of 16; scale it to 8 bits"),
    ],
)
@pytest.mark.timeout(20)
def test_bad_files(tmp_path: Path, suffix: str, damage: Callable[[Any], Any] | None, message: str) -> None:
    """A pipe is not waited for."""
    file = tmp_path / f"left{suffix}"
    if damage in (Path.mkdir, os.mkfifo):
        damage(file)
    elif damage is not None:
        file.write_bytes(damage(write(file, ramp(90, 160)).read_bytes()))
    with pytest.raises(DataError, match=rf"camera 'left': image .*left\{suffix}: .*{re.escape(message)}") as caught:
        decode_images([file], names=["left"])
    assert str(caught.value).count("camera 'left'") == 1


@pytest.mark.timeout(20)
def test_view_masks_that_are_no_images(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "text.png").write_text("none")
    for name in ("pipe", "text", "none"):
        with pytest.raises(DataError, match=r"camera 'left': coverage .*: expected"):
            decode_view_masks({"coverage": [tmp_path / f"{name}.png"]}, names=["left"], sizes=[(4, 6)])


@pytest.mark.parametrize("reduce", [1, 2])
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_paths_that_are_not_utf_8(tmp_path: Path, suffix: str, reduce: Any) -> None:
    """OpenCV's own functions crash on them."""
    plain = write(tmp_path / f"a{suffix}", ramp(90, 160))
    file = latin(tmp_path) / f"a{suffix}"
    file.write_bytes(plain.read_bytes())
    decoded, expected = (decode_images([path], reduce=reduce) for path in (file, plain))
    assert torch.equal(decoded, expected)  # type: ignore[arg-type]
    picture = ramp(8, 9).astype(np.uint8)
    save_picture(file, picture)
    if suffix == ".png":
        assert torch.equal(decode_images([file])[0].permute(1, 2, 0), torch.from_numpy(picture))
        seen = decode_view_masks({"coverage": [file]}, names=["a"], sizes=[(8, 9)])["coverage"]
        assert seen.shape == (1, 8, 9)  # type: ignore[union-attr]


def test_bytes_after_the_end_fill_bytes_and_thumbnails(jpeg: Path) -> None:
    """They are no fault, and a thumbnail's end in the header does not hide a truncation."""
    expected, data, thumbnail = decode_images([jpeg]), jpeg.read_bytes(), b"\xff\xe1\0\x06\xff\xd8\xff\xd9"
    for changed in (data[:2] + b"\xff\xff" + data[2:] + b"\0" * 100, data[:2] + thumbnail + data[2:]):
        jpeg.write_bytes(changed)
        assert torch.equal(expected, decode_images([jpeg]))  # type: ignore[arg-type]
    jpeg.write_bytes(changed[:-20])
    with pytest.raises(DataError, match="truncated file"):
        decode_images([jpeg])


def test_size_that_is_not_the_calibrations(jpeg: Path) -> None:
    with pytest.raises(DataError, match=r"camera 'front': .*expected 200x100 \(w x h\) as calibrated, got 160x90"):
        decode_images([jpeg], sizes=[(100, 200)])
    with pytest.raises(DataError, match="width and height look swapped"):
        decode_images([jpeg], sizes=[(160, 90)], reduce=2)
    for given in ({"names": ["front"]}, {"sizes": [(90, 160)]}):
        with pytest.raises(ValueError, match=f"{next(iter(given))}: expected one for each of 2 images, got 1"):
            decode_images([jpeg, jpeg], **given)  # type: ignore[arg-type]
