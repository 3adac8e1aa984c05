"""Samples as entries of WebDataset shards (tar files), and back: what a ``map`` needs before ``RigRetarget``."""

from __future__ import annotations

import io
import json
import tarfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arbiview_aug.atomic_io import BROKEN_ARRAY, whole_file
from arbiview_aug.cameras.plain_yaml import parse_json
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.drive import camera_fields
from arbiview_aug.datasets.image_io import decode_bytes, encoded, encoded_image
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import DataError, SampleError, SampleTypeError, calibration_of, one_line, shown
from arbiview_aug.sample.batching import stacked
from arbiview_aug.sample.inputs import as_array, read_frames

ARRAYS = ("points", "boxes_3d", "ego2world")
"""Entries that are stored as .npy files."""

NAMES = {"token": str, "scene_token": str, "time_s": float}
"""Entries of ``rig.json`` besides the rig, and their types."""

Entry = dict[str, Any]


def to_entry(sample: Mapping[str, Any], key: str) -> Entry:
    """A sample's files by their endings, as WebDataset's writers take them.

    Args:
        sample: With ``images``, uint8 (3, h, w) for each camera of ``rig``, or of ``K`` and ``cam2ego``; ``ARRAYS`` and
            ``NAMES`` where present.
        key: Unique, without dots.

    Raises:
        SampleError: A key with dots, no images, or some of other sizes or of another number than the rig's cameras.
        SampleTypeError: Images, a rig or ``NAMES`` of another type.
    """
    if not isinstance(key, str) or "." in key:
        raise SampleError(f"key: expected a text without dots, at which WebDataset splits names, got {shown(key)}")
    if sample.get("images") is None:
        raise SampleError(f"images: expected in the sample, found none beside {', '.join(map(str, sample))}")
    rig: Rig = read_frames(sample, None)[0].rig if sample.get("rig") is None else sample["rig"]
    if not isinstance(rig, Rig):
        raise SampleTypeError(f"rig: expected a Rig, got {shown(rig)}")
    try:
        images = [torch.as_tensor(image) for image in sample["images"]]
    except (TypeError, ValueError, RuntimeError) as error:
        raise SampleTypeError(f"images: expected a tensor of each camera, got {one_line(error)}") from None
    shapes = [tuple(image.shape) for image in images]
    if shapes != (expected := [(3, *size) for size in rig.sizes]):
        raise SampleError(f"images: expected {expected}, as the rig's cameras are, got {shapes}")
    try:
        names = {name: type_(sample[name]) for name, type_ in NAMES.items() if sample.get(name) is not None}
    except (TypeError, ValueError, RuntimeError) as error:
        raise SampleTypeError(f"time_s: expected seconds, got {one_line(error)}") from None
    entry: Entry = {"__key__": key, "rig.json": json.dumps({**rig.to_dict(), "token": key, **names})}
    for k, (camera, image) in enumerate(zip(rig, images, strict=True)):
        entry[f"{k:02}.jpg"] = encoded_image(image)
        if camera.mask is not None:
            entry[f"{k:02}.mask.png"] = encoded(camera.mask.astype(np.uint8) * 255, ".png")
    for name in ARRAYS:
        if sample.get(name) is not None:
            file = io.BytesIO()
            np.save(file, as_array(name, sample[name]))
            entry[f"{name}.npy"] = file.getvalue()
    return entry


def to_sample(entry: Mapping[str, Any]) -> dict[str, Any]:
    """The sample of an entry as WebDataset reads it, undecoded: bytes by their endings.

    Returns:
        ``images`` (N, 3, h, w) uint8 (a list where sizes differ), ``rig``, ``K``, ``cam2ego``, ``NAMES``, ``ARRAYS``.

    Raises:
        DataError: No ``rig.json``; that, an image or an array is missing or broken.
        CalibrationError: An impossible calibration.
    """
    where = f"shard entry {entry.get('__key__')!r}"
    if "rig.json" not in entry:
        raise DataError(f"{where}: expected rig.json, got {', '.join(map(str, entry))}; write shards with to_entry")
    try:
        described = parse_json(entry["rig.json"])
        names = {name: type_(described[name]) for name, type_ in NAMES.items() if name in described}
        token = names["token"]
    except (ValueError, TypeError, KeyError, RecursionError, OverflowError) as error:
        got = f"{type(error).__name__}: {error}"
        raise DataError(f"{where}: rig.json: expected a rig with its token, got {got}") from None
    rig = Rig.from_dict(described, where=where)
    images, cameras = [], []
    for k, camera in enumerate(rig):
        if f"{k:02}.jpg" not in entry:
            raise DataError(f"{where}: expected {k:02}.jpg, found none")
        image = decode_bytes(entry[f"{k:02}.jpg"], f"{where}: {k:02}.jpg")
        if (size := image.shape[:2]) != camera.size:
            raise DataError(f"{where}: {k:02}.jpg: expected (h, w) = {camera.size}, as in rig.json, got {size}")
        images.append(torch.from_numpy(image).permute(2, 0, 1))
        if (name := f"{k:02}.mask.png") in entry:
            with calibration_of(where):
                camera = replace(camera, mask=decode_bytes(entry[name], f"{where}: {name}")[..., 0] > 0)
        cameras.append(camera)
    rig = rig.with_cameras(cameras)
    sample = camera_fields(rig, stacked(images), token) | names
    for name in (name for name in ARRAYS if f"{name}.npy" in entry):
        try:
            sample[name] = torch.from_numpy(np.load(io.BytesIO(entry[f"{name}.npy"]), allow_pickle=False))
        except (*BROKEN_ARRAY, TypeError) as error:  # types that torch has not
            got = f"{type(error).__name__}: {error}"
            raise DataError(f"{where}: {name}.npy: expected a .npy array of numbers, got {got}") from None
    return sample


def write_shard(path: str | Path, samples: Iterable[Mapping[str, Any]]) -> Path:
    """Write samples as one shard, at once or not at all; webdataset itself is not needed. Returns the path."""
    path = Path(path)
    with whole_file(path) as file, tarfile.open(fileobj=file, mode="w") as tar:
        for k, sample in enumerate(samples):
            entry = to_entry(sample, f"{path.stem.replace('.', '-')}-{k:06}")
            key = entry.pop("__key__")
            for ending, content in entry.items():
                data = content.encode() if isinstance(content, str) else content
                info = tarfile.TarInfo(f"{key}.{ending}")
                info.size = len(data)
                tar.addfile(info, io.BytesIO(data))
    return path


def stream(urls: str | Sequence[str], retarget: Callable[[dict[str, Any]], dict[str, Any]], *, shuffle: int = 0) -> Any:
    """A ``wds.WebDataset`` of retargeted samples: shards are shared out among DataLoader workers, never repeated.

    Args:
        urls: Shards, as webdataset takes them: paths, ``{000..041}`` braces, ``pipe:`` commands.
        retarget: A ``RigRetarget``, or a composition around one.
        shuffle: Entries held back to shuffle among, as bytes: decoding comes after. 0 keeps the order.

    Raises:
        ImportError: webdataset is not installed.
    """
    shards = optional_package("webdataset").WebDataset(urls, shardshuffle=100 if shuffle else False, empty_check=False)
    return (shards.shuffle(shuffle) if shuffle else shards).map(to_sample).map(retarget)
