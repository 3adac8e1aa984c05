"""Photometric transforms after ours: colours change, geometry, calibration and holes do not."""

from __future__ import annotations

import kornia
import kornia.augmentation as K
import pytest
import torch
from torchvision import transforms as v1
from torchvision import tv_tensors
from torchvision.transforms import v2

from arbiview_aug import RigRetarget
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.integrations.kornia import OnImages, check_photometric

SOURCE = demo_source_rig((64, 176))
TARGET = SOURCE.turned(pitch_deg=-12)


@pytest.fixture(scope="module")
def sample() -> dict:
    sample = SyntheticDrive(SOURCE, num_frames=1, lidar=False)[0]
    return {**sample, "images": tv_tensors.Image(sample["images"])}


def test_inside_v2_compose(sample: dict) -> None:
    """A solarising curve is known for each pixel: each image is ours with that curve, K and boxes are ours."""
    ours = RigRetarget(TARGET, geometry="infinity")
    out = v2.Compose([ours, v2.RandomSolarize(threshold=0, p=1.0)])(sample)
    expected = ours(sample)
    assert type(out["images"]) is tv_tensors.Image and torch.equal(out["images"], 255 - expected["images"])
    for key in ("K", "cam2ego", "coverage", "boxes_3d"):
        assert torch.equal(out[key], expected[key])


def test_a_module_that_writes_into_its_images_leaves_the_sample(sample: dict) -> None:
    before = {**sample, "images": sample["images"].float() / 255}
    out = OnImages(lambda images: images.mul_(0))(before)
    assert not out["images"].any() and before["images"].any()


def test_kornias_image_sequential(sample: dict) -> None:
    """Known again by inverting; black holes stay black; one draw for all cameras where it is asked for."""
    expected = RigRetarget(TARGET, geometry="infinity", holes="black")(sample)
    invert = torch.nn.Sequential(
        RigRetarget(TARGET, geometry="infinity", holes="black"), OnImages(K.ImageSequential(K.RandomInvert(p=1.0)))
    )
    out = invert(sample)
    seen = out["coverage"].unsqueeze(1).expand_as(out["images"])
    assert 0.1 < (~seen).float().mean() < 0.9
    assert torch.equal(out["images"][seen], 255 - expected["images"].as_subclass(torch.Tensor)[seen])
    assert not out["images"][~seen].any() and torch.equal(out["K"], expected["K"])
    jiggle = OnImages(K.ImageSequential(K.RandomBrightness((0.4, 0.9), p=1.0, same_on_batch=True)))
    flat = jiggle({"images": torch.full((2, 3, 3, 8, 8), 0.5)})["images"]
    assert flat.shape == (2, 3, 3, 8, 8) and flat.unique().numel() == 1


@pytest.mark.parametrize(
    "module",
    [
        K.RandomAffine(5.0),
        K.ImageSequential(K.ColorJiggle(), K.RandomHorizontalFlip()),
        K.RandomResizedCrop((8, 8)),
        K.RandomPerspective(),
        K.RandomThinPlateSpline(),
        K.RandomFisheye(*(torch.tensor([-0.1, 0.1]),) * 3),
        K.RandomElasticTransform(),
        K.RandomJigsaw(),
        K.RandomMosaic((8, 8)),
        kornia.geometry.Hflip(),
        v1.RandomHorizontalFlip(),
        v1.RandomAffine(5),
        v2.RandomCrop(8),
        v2.RandAugment(),
        v2.Compose([v2.ColorJitter(), v2.Resize(8)]),
        v1.Compose([v1.ColorJitter(), v1.CenterCrop(8)]),
    ],
    ids=lambda module: type(module).__name__,
)
def test_what_moves_pixels_is_refused(module: torch.nn.Module) -> None:
    with pytest.raises(ValueError, match=r"moves pixels and leaves K unchanged; .* RigRetarget's size and fit"):
        OnImages(module)


def test_photometric_ones_pass() -> None:
    kornias = K.ColorJiggle(), K.RandomGaussianBlur((3, 3), (0.1, 1.0)), K.RandomErasing()
    composed = v1.Compose([v1.ColorJitter()]), v2.Compose([lambda images: images, v2.ColorJitter()])
    for module in (*kornias, *composed, v1.ColorJitter(), v2.ColorJitter(), v2.GaussianBlur(3)):
        check_photometric(module)


WIDE, NOISE = torch.rand(2, 3, 8, 8) * 255, torch.randn(2, 3, 8, 8)
SMALL = torch.rand(2, 3, 8, 8)
BYTES = (SMALL * 255).to(torch.uint8)
REFUSED = (
    (torch.nn.AvgPool2d(2), {"images": SMALL}, r"expected images of shape \(2, 3, 8, 8\).*got \(2, 3, 4, 4\)"),
    (K.ColorJiggle(), {"images": [torch.zeros(3, 4, 4)]}, r"got a list in .*; pass size=\(h, w\)"),
    (K.ColorJiggle(), {"K": torch.eye(3)}, "expected a tensor 'images', of one size, got a NoneType in a sample"),
    *((module, {"images": images}, r"expected floats in \[0, 1\] of its module, got .*; normalise after")
      for module in (v2.Normalize((0.48,) * 3, (0.23,) * 3), v2.ToDtype(torch.uint8, scale=True))
      for images in (SMALL, BYTES)),
    # Modules that cut at 1 would make them white.
    (K.ColorJiggle(), {"images": WIDE}, r"images\[0\]: expected floats in \[0, 1\], got .*; divide by 255"),
    (K.ColorJiggle(), {"images": NOISE}, r"images\[0\]: expected floats in \[0, 1\], got .*; normalise after"),
)  # fmt: skip


@pytest.mark.parametrize(("module", "given", "message"), REFUSED)
def test_other_images_are_refused(module: torch.nn.Module, given: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        OnImages(module)(given)


def test_images_keep_their_type(sample: dict) -> None:
    assert type(OnImages(K.ColorJiggle())(sample)["images"]) is tv_tensors.Image
    for images in (SMALL, BYTES):
        noisy = OnImages(lambda images: images + 0.15 * torch.randn_like(images))({"images": images})["images"]
        assert noisy.dtype == images.dtype


def test_what_was_filled_stays(sample: dict) -> None:
    filled = RigRetarget(TARGET, geometry="infinity", holes="telea")(sample)
    out = OnImages(K.ImageSequential(K.RandomInvert(p=1.0)))(filled)
    shown = (out["coverage"] | out["generated"]).unsqueeze(1).expand_as(out["images"])
    assert out["generated"].any()
    before = filled["images"].as_subclass(torch.Tensor)
    assert torch.equal(out["images"].as_subclass(torch.Tensor)[shown], 255 - before[shown])
