"""Entries of shards: a sample comes back as it was, but for JPEG; what is broken is named."""

from __future__ import annotations

import sys
import tarfile
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import CalibrationError, Camera, DataError, Rig, RigRetarget, SampleError
from arbiview_aug.datasets.image_io import encoded
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import SampleTypeError
from arbiview_aug.integrations.webdataset import ARRAYS, stream, to_entry, to_sample, write_shard

SMALL = encoded(np.zeros((4, 4), np.uint8), ".png")


@pytest.fixture(scope="module")
def sample() -> dict:
    rig = demo_source_rig((64, 176))
    masked = replace(rig[0], mask=np.arange(64)[:, None].repeat(176, 1) < 60)
    drive = SyntheticDrive(rig.with_cameras([masked, *rig.cameras[1:]]), num_frames=1)
    return {**drive[0], "ego2world": torch.eye(4, dtype=torch.float64), "time_s": 1.25, "scene_token": "drive"}


def test_there_and_back(sample: dict) -> None:
    again = to_sample(to_entry(sample, "a"))
    assert again["rig"] == sample["rig"] and again["token"] == sample["token"]  # masks too
    assert (again["images"].float() - sample["images"].float()).abs().mean() < 3
    for key in (*ARRAYS, "K", "cam2ego"):
        assert torch.equal(again[key], sample[key])
    assert sample["time_s"] == again["time_s"] and again["scene_token"] == "drive"
    assert to_entry({**sample, "images": sample["images"].numpy()}, "a") == to_entry(sample, "a")


def test_retargeted_samples(sample: dict, tmp_path) -> None:
    """They have no ``rig``."""
    out = RigRetarget(sample["rig"].turned(yaw_deg=5))(sample)
    again = to_sample(to_entry(out, "a"))
    assert torch.allclose(again["cam2ego"], out["cam2ego"]) and torch.equal(again["points"], out["points"])
    assert write_shard(str(tmp_path / "a.tar"), [out]) == tmp_path / "a.tar"


def test_lenses_and_sizes() -> None:
    fisheye = Camera.looking(
        name="a",
        azimuth_deg=0,
        width_px=40,
        height_px=30,
        horizontal_fov_deg=150,
        lens="fisheye",
        distortion=(0.1, 0, 0, 0),
    )
    rig = Rig([fisheye, replace(fisheye.resize((60, 80)), name="b")], ground_z_m=-0.3)
    again = to_sample(
        to_entry({"rig": rig, "images": [torch.zeros(3, *size, dtype=torch.uint8) for size in rig.sizes]}, "k")
    )
    assert again["rig"] == rig and [tuple(i.shape[1:]) for i in again["images"]] == rig.sizes and again["token"] == "k"


def test_a_shard_read_by_hand_retargets_as_the_sample(sample: dict, tmp_path) -> None:
    """Names are key, dot, ending: as WebDataset splits them."""
    with tarfile.open(write_shard(tmp_path / "000.tar", [sample, sample])) as tar:
        entries: dict[str, dict] = {}
        for member in tar:
            key, ending = member.name.split(".", 1)
            file = tar.extractfile(member)
            assert file is not None
            entries.setdefault(key, {"__key__": key})[ending] = file.read()
    assert list(entries) == ["000-000000", "000-000001"]
    target = sample["rig"].turned(yaw_deg=15).undistorted()
    one, two = (RigRetarget(target, geometry="boxes")(s) for s in (to_sample(entries["000-000001"]), sample))
    assert torch.equal(one["coverage"], two["coverage"])
    assert (one["images"].float() - two["images"].float()).abs().mean() < 2


def test_messages(sample: dict, monkeypatch) -> None:
    entry = to_entry(sample, "a")
    with pytest.raises(DataError, match=r"shard entry 'a': expected rig.json"):
        to_sample({"__key__": "a", "jpg": b""})
    with pytest.raises(DataError, match=r"'a': 03.jpg: expected a JPEG or PNG, got a file that begins"):
        to_sample({**entry, "03.jpg": b"short"})
    with pytest.raises(DataError, match=r"'a': expected 05.jpg, found none"):
        to_sample({key: value for key, value in entry.items() if key != "05.jpg"})
    with pytest.raises(DataError, match=r"01.jpg: expected \(h, w\) = \(64, 176\)"):
        to_sample(
            {
                **entry,
                "01.jpg": to_entry(
                    {
                        **sample,
                        "rig": Rig([sample["rig"][0].resize((8, 9))]),
                        "images": [torch.zeros(3, 8, 9, dtype=torch.uint8)],
                    },
                    "b",
                )["00.jpg"],
            }
        )
    monkeypatch.setitem(sys.modules, "webdataset", None)
    with pytest.raises(ImportError, match="pip install webdataset"):
        stream("x.tar", RigRetarget(sample["rig"]))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("rig.json", "{", "rig.json: expected a rig with its token"),
        ("rig.json", "[]", "rig.json: expected a rig with its token"),
        ("rig.json", '{"token": "a", "time_s": "noon"}', "rig.json: expected a rig with its token"),
        pytest.param("00.jpg", np.zeros((64, 176, 3), np.uint8), "00.jpg: expected a file's bytes", id="decoded"),
        ("00.jpg", b"", "00.jpg: expected a JPEG or PNG, got an empty file"),
        ("00.mask.png", b"", "00.mask.png: expected a JPEG or PNG, got an empty file"),
        pytest.param("00.mask.png", SMALL, r"camera 'front': mask: expected shape \(64, 176\)", id="a smaller mask"),
        ("points.npy", b"PK\x03\x04 no array", "points.npy: expected a .npy array of numbers"),
        ("boxes_3d.npy", b"", "boxes_3d.npy: expected a .npy array of numbers"),
    ],
)
def test_what_is_broken_is_named(sample: dict, name: str, content: Any, message: str) -> None:
    with pytest.raises((DataError, CalibrationError), match=f"shard entry 'a': {message}"):
        to_sample({**to_entry(sample, "a"), name: content})


def test_shards_are_whole_and_keys_without_dots(sample: dict, tmp_path) -> None:
    with tarfile.open(write_shard(tmp_path / "train.v1.tar", [sample])) as tar:
        assert {name.split(".")[0] for name in tar.getnames()} == {"train-v1-000000"}
    with pytest.raises(SampleError, match=r"images: expected \[.*as the rig's cameras are, got"):
        write_shard(tmp_path / "half.tar", [sample, {**sample, "images": sample["images"][:5]}])
    assert [path.name for path in tmp_path.iterdir()] == ["train.v1.tar"]
    for key in ("a.b", 5):
        with pytest.raises(SampleError, match=f"key: expected a text without dots.*{key!r}"):
            to_entry(sample, key)


def test_orientations_are_ignored(sample: dict) -> None:
    """As for files: the calibration is of the pixels as they are stored."""
    entry = to_entry(sample, "a")
    turned = (
        b"\xff\xe1\x00\x22Exif\x00\x00MM\x00\x2a\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01\x00\x06\x00\x00"
        + bytes(4)
    )
    rotated = {**entry, "00.jpg": entry["00.jpg"][:2] + turned + entry["00.jpg"][2:]}
    assert torch.equal(to_sample(rotated)["images"], to_sample(entry)["images"])


def test_images_of_another_type_are_refused(sample: dict) -> None:
    """Encoded as they are they would be black."""
    with pytest.raises(SampleTypeError, match=r"images: expected uint8 to write, got torch\.float32"):
        to_entry({**sample, "images": sample["images"] / 255}, "a")
    with pytest.raises(SampleError, match="images: expected in the sample, found none beside rig"):
        to_entry({"rig": sample["rig"]}, "a")
    with pytest.raises(SampleTypeError, match="points: expected a tensor of numbers"):
        to_entry({**sample, "points": [[1, 2, 3], [4, 5]]}, "a")
    for entries, message in (
        ({"time_s": "x"}, "time_s: expected seconds"),
        ({"rig": "x"}, "rig: expected a Rig, got 'x'"),
        ({"images": 3}, "images: expected a tensor of each camera"),
        ({"images": ["a"] * 6}, "images: expected a tensor of each camera"),
    ):
        with pytest.raises(SampleTypeError, match=message):
            to_entry({**sample, **entries}, "a")
