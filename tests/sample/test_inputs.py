"""Bad samples: each is refused with a message that names the entry, what was expected and how to mend it."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from arbiview_aug import ArbiviewError, Rig, RigRetarget, SampleError, SampleTypeError, load_rig, shipped_rigs
from arbiview_aug.sample.inputs import check_other_keys, read_frames
from tests.helpers import camera

H, W = 36, 64


def rig(count: int = 2) -> Rig:
    return Rig([camera(f"c{k}", 90.0 * k, size=(H, W), horizontal_fov_deg=100) for k in range(count)])


def sample(**changes: Any) -> dict[str, Any]:
    """A good sample of two cameras, with changes; None removes a key."""
    good = {
        "images": torch.zeros((2, 3, H, W), dtype=torch.uint8),
        "K": torch.from_numpy(rig().K),
        "cam2ego": torch.from_numpy(rig().cam2ego),
    }
    return {key: value for key, value in {**good, **changes}.items() if value is not None}


def edited(key: str, index: Any, value: float) -> dict[str, Any]:
    changed = sample()[key].clone()
    changed[index] = value
    return sample(**{key: changed})


def with_distortion(coefficients: Any, lens: Any = None) -> dict[str, Any]:
    return sample(distortion=torch.tensor(coefficients, dtype=torch.float64), lens=lens)


ARRAY = np.zeros((H, W, 3), np.uint8)
FROM_NUMPY = r"expected torch tensors, got ndarray; use torch.from_numpy\(array\).permute\(2, 0, 1\) for an \(H, W, 3\)"
IMAGES: dict[str, tuple[Any, str]] = {
    "an array": (np.stack([ARRAY] * 2), rf"images: {FROM_NUMPY} RGB array"),
    "arrays": ([ARRAY] * 2, rf"images\[0\]: {FROM_NUMPY}"),
    "a file": ("front.jpg", r"images: expected torch tensors, got str; use a \(N, 3, H, W\) tensor"),
    "PIL": ([Image.new("RGB", (W, H))] * 2, r"images\[0\]: expected torch tensors, got Image; use .*pil_to_tensor"),
    "no images": (None, "sample: expected a key 'images', got K, cam2ego"),
    "no cameras": (torch.zeros(0, 3, H, W), "images: expected at least one image, got none"),
    "an empty batch": (torch.zeros(0, 2, 3, H, W), r"images: expected at least one frame, got .* \(0,\)"),
    "one image": (torch.zeros(3, H, W), r"images: expected shape \(..., N, 3, H, W\), got \(3, 36, 64\)"),
    "grey": (torch.zeros(2, 1, H, W), r"images\[0\]: expected an RGB image .* got shape \(1, 36, 64\); expand grey"),
    "RGBA": (torch.zeros(2, 4, H, W), r"got shape \(4, 36, 64\); drop the alpha channel: image\[:3\]"),
    "HWC": (torch.zeros(2, H, W, 3), r"got shape \(36, 64, 3\); permute\(2, 0, 1\) puts the channels first"),
    "no pixels": (torch.zeros(2, 3, 0, W), r"images\[0\]: expected pixels, got shape \(3, 0, 64\)"),
    "integers": (torch.zeros((2, 3, H, W), dtype=torch.int32), r"expected uint8 or float, got torch.int32; convert"),
    "0 to 255 as float": (torch.full((2, 3, H, W), 200.0), r"floats in \[0, 1\], got 200 to 200; divide by 255"),
    "normalised": (torch.full((2, 3, H, W), -1.5), r"got -1.5 to -1.5; normalise after retargeting, not before"),
    "NaN": (torch.full((2, 3, H, W), torch.nan), r"floats in \[0, 1\], got nan to nan; .*nan_to_num"),
    "two dtypes": ([torch.zeros(3, H, W), torch.zeros((3, H, W), dtype=torch.uint8)], "one dtype and device, got sev"),
    "another count": (torch.zeros(3, 3, H, W), r"K: expected shape \(3, 3, 3\) for 3 images, got \(2, 3, 3\)"),
    "ragged batch": ([torch.zeros(2, 3, H, W), torch.zeros(3, 3, H, W)], r"images: expected the .* dimensions \(2,\)"),
}


@pytest.mark.parametrize("case", IMAGES)
def test_bad_images(case: str) -> None:
    images, message = IMAGES[case]
    with pytest.raises(ArbiviewError, match=message):
        read_frames(sample(images=images), None)
    with pytest.raises(SampleTypeError, match="sample: expected a dict, got list"):
        read_frames([sample()], None)


HALF = torch.from_numpy(rig().K) * torch.tensor([[0.5], [0.5], [1.0]])
CALIBRATION: dict[str, tuple[dict[str, Any], str]] = {
    "none": (sample(K=None, cam2ego=None), "expected calibration, 'rig' or 'K' and 'cam2ego', missing K, cam2ego"),
    "no poses": (sample(cam2ego=None), "missing cam2ego; or give RigRetarget the rig as source="),
    "no rotation": (edited("cam2ego", (1, 0, 0), 2.0), "'camera 1': cam2ego: expected a rotation .* the nearest"),
    "NaN K": (edited("K", (0, 0, 0), torch.nan), "camera 'camera 0': K: expected finite numbers of shape .*, got NaN"),
    "negative focal length": (edited("K", (0, 1, 1), -5.0), "camera 'camera 0': K: expected positive focal lengths"),
    "K of a larger image": (sample(K=HALF * torch.tensor([[5.0], [5.0], [1.0]])), r"K\[0\]: .* inside the image of"),
    "K of a smaller image": (sample(K=HALF), r"K\[0\]: .* near the middle of the image of \(h, w\) = \(36, 64\)"),
    "K of one camera": (sample(K=torch.eye(3)), r"K: expected shape \(2, 3, 3\) for 2 images, got \(3, 3\)"),
    "4x4": (sample(K=torch.eye(4).repeat(2, 1, 1)), r"got \(2, 4, 4\); pass K\[..., :3, :3\]"),
    "text": (sample(K="pinhole"), "K: expected a tensor of numbers, got str"),
    "unknown lens": (with_distortion(np.zeros((2, 4)), ["cubic"] * 2), "lens: expected one of pinhole, .* got 'cubic'"),
    "one lens": (sample(lens=["radtan"]), r"lens: expected a list of 2 names, one for each camera, got \['radtan'\]"),
    "a number for a lens": (sample(lens=5), "lens: expected a list of 2 names, one for each camera, got 5"),
    "no coefficients": (sample(lens=["radtan"] * 2), r"distortion: expected shape \(2, up to 8\) .* got none"),
    "coefficients of one": (with_distortion([0.1] * 4, ["radtan"] * 2), r"distortion: expected shape \(2, up to 8\)"),
    "five for a fisheye": (with_distortion([[0.1] * 5] * 2, ["fisheye"] * 2), "expected 4 coefficients .* got 5"),
    "no lens": (with_distortion([[0.1] * 4] * 2), "distortion: expected 'lens' beside it, one of pinhole, radtan"),
    "a mask of bytes": (sample(ego_mask=torch.zeros(2, H, W, dtype=torch.uint8)), "ego_mask: .*bool"),
    "images under another key": (sample(images=None, imgs=torch.zeros(2, 3, H, W)), "did you mean 'images'"),
    "road": (sample(ground_z_m=float("nan")), "ground_z_m: expected a finite height"),
    "rig file": (sample(rig="nuscenes"), r"rig: expected an arbiview_aug.Rig, got str; use load_rig\(path\)"),
    "rig of three": (sample(rig=rig(3)), "images: expected 3 images for cameras c0, c1, c2, got 2"),
    "rig of another size": (sample(rig=rig().resized(0.5)), r"camera 'c0': .*\(18, 32\), as calibrated, got \(36"),
    "swapped": (sample(images=torch.zeros(2, 3, W, H), rig=rig()), r"'c0': .* got \(64, 36\); height and width"),
    "swapped, no rig": (sample(images=torch.zeros(2, 3, W, H)), r"K\[0\]: .*; height and width are swapped"),
    "coverage": (sample(coverage=0.7), "coverage: expected a bool tensor of each image's size, .* rename the key"),
    "ego_mask": (sample(ego_mask=torch.zeros(2, 5, 5, dtype=torch.bool)), "ego_mask: expected a bool tensor of each"),
}


@pytest.mark.parametrize("case", CALIBRATION)
def test_bad_calibration(case: str) -> None:
    bad, message = CALIBRATION[case]
    with pytest.raises(ArbiviewError, match=message):
        read_frames(bad, None)
    with pytest.raises(ArbiviewError, match=message):
        RigRetarget(rig())(bad)


def test_entries_that_say_nothing_of_their_shape() -> None:
    nested = torch.nested.nested_tensor([torch.ones(2), torch.ones(3)])
    for odd in (nested, SimpleNamespace(shape=None)):
        assert check_other_keys(sample(mine=odd), [(H, W)], (), ()) == []
    batch = sample(images=torch.zeros(1, 2, 3, H, W), rig=rig(), scene=torch.arange(1))
    assert read_frames(batch, None, names=("scene",))[0].further == {"scene": "0"}
    batch = sample(images=torch.zeros(2, 2, 3, H, W), rig=rig(), scene=torch.arange(3))
    with pytest.raises(SampleError, match="scene: expected a name for each of 2 frames, got Tensor"):
        read_frames(batch, None, names=("scene",))


@pytest.mark.parametrize("size", [(256, 704), (320, 800), (96, 264)])
def test_rendered_and_cropped_samples_of_shipped_rigs_are_read(size: tuple[int, int]) -> None:
    for name in shipped_rigs():
        target = load_rig(name).resized(size, "crop")
        images = torch.zeros((len(target), 3, *size), dtype=torch.uint8)
        given = {"images": images, "K": target.K, "cam2ego": target.cam2ego}
        assert read_frames(given, None)
        moved = target.K + np.array([[0, 0, size[1]], [0, 0, size[0]], [0, 0, 0]])
        coverage = torch.ones((len(target), *size), dtype=torch.bool)
        assert read_frames(given | {"K": moved, "coverage": coverage}, None)  # a target that is really like this


@pytest.mark.parametrize("key", ["K", "cam2ego"])
def test_the_source_of_a_transform_overrides_no_sample(key: str) -> None:
    source = rig()
    rounded = {k: torch.from_numpy(getattr(source, k)).float() for k in ("K", "cam2ego")}
    assert read_frames(sample(**rounded), source) and read_frames(sample(**{key: None}), source)
    other = {"K": source.resized((72, 128)).K, "cam2ego": source.turned(yaw_deg=1).cam2ego}[key]
    for bad in (other, other[:1]):
        with pytest.raises(SampleError, match=rf"{key}: expected the calibration of source=, got another; drop source"):
            read_frames(sample(**{key: torch.from_numpy(bad)}), source)
    assert read_frames(sample(**{key: torch.from_numpy(other)}, rig=source), rig(3))[0].rig is source


@pytest.mark.parametrize("key", ["lens", "ground_z_m"])
def test_lenses_and_road_of_a_sample_are_those_of_the_source(key: str) -> None:
    bent = [replace(camera, lens="radtan", distortion=(0.1, 0.0, 0.0, 0.0)) for camera in rig()]
    same = {"lens": ["radtan"] * 2, "distortion": torch.tensor([[0.1] + [0.0] * 7] * 2), "ground_z_m": -0.3}
    source = Rig(bent, ground_z_m=-0.3)
    assert read_frames(sample(**same, K=None, cam2ego=None), source)[0].rig is source
    other = {"lens": same | {"distortion": torch.full((2, 4), 0.2)}, "ground_z_m": same | {"ground_z_m": 0.0}}[key]
    with pytest.raises(SampleError, match=rf"{key}: expected the calibration of source=, got another; drop source"):
        read_frames(sample(**other), source)


def test_a_key_of_a_batch_that_is_something_else() -> None:
    batch = sample(images=torch.zeros((3, 2, 3, H, W), dtype=torch.uint8), rig=rig(), coverage=["a"] * 3)
    with pytest.raises(SampleError, match=r"coverage: expected the images' leading dimensions \(3,\), got str; rename"):
        read_frames(batch, None)


def test_frames_of_a_window_share_their_lenses() -> None:
    """A sample is a window of frames; ``default_collate`` gives each camera a name over the batch alone."""
    images = torch.zeros((2, 3, 2, 3, H, W), dtype=torch.uint8)
    bent = torch.zeros((2, 3, 2, 5))
    bent[0, :, 0, 0] = -0.1
    batch = sample(images=images, lens=[("radtan", "pinhole"), ("pinhole", "pinhole")], distortion=bent)
    batch |= {key: batch[key].expand(2, 3, *batch[key].shape) for key in ("K", "cam2ego")}
    lenses = [[camera.lens for camera in frame.rig] for frame in read_frames(batch, None)]
    assert lenses == [["radtan", "pinhole"]] * 3 + [["pinhole", "pinhole"]] * 3


def test_calibration_without_the_images_leading_dimensions() -> None:
    images = torch.zeros((3, 2, 3, H, W), dtype=torch.uint8)
    with pytest.raises(SampleError, match=r"K: expected a tensor \(3,\) \+ \(n, ...\), .* got shape \(2, 3, 3\)"):
        read_frames(sample(images=images), None)
    wide = torch.zeros((2, 3, 2, 3, H, W), dtype=torch.uint8)
    with pytest.raises(SampleError, match=r"cam2ego: expected a tensor \(2, 3\) \+ .*, got shape \(2, 4, 4\)"):
        read_frames(sample(images=wide), None)


def test_unusual_but_right_calibrations() -> None:
    # A camera whose principal point is off its middle in one direction alone, as after a crop.
    for y in (2.0, 40.0, -80.0):
        assert read_frames(edited("K", (0, 1, 2), y), None)
    assert read_frames(sample(ground_z_m=None) | {"ground_z_m": None}, None)[0].rig.ground_z_m == 0
    # Beyond that a rig says that it is meant.
    moved = rig()[0].crop(0, 0, (10, 10))
    assert read_frames({"images": torch.zeros(1, 3, 10, 10), "rig": Rig([moved])}, None)
    # Coefficients padded with zeros, as this package writes them.
    padded = torch.zeros(2, 8)
    padded[0, :4] = torch.tensor([0.01, 0.0, 0.0, 0.0])
    (frame,) = read_frames(sample(distortion=padded, lens=["fisheye", "pinhole"]), None)
    assert [len(camera.distortion) for camera in frame.rig] == [4, 0]
    assert read_frames(sample(distortion=torch.zeros(2, 5)), None)[0].rig[0].lens == "pinhole"
    assert read_frames(sample(K=sample()["K"].tolist(), cam2ego=sample()["cam2ego"].numpy()), None)
