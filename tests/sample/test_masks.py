"""Masks without specks, and image circles of fisheye lenses."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug import Camera, Rig, RigRetarget, SampleError
from arbiview_aug.datasets import FrameFolder, cleaned_rig
from arbiview_aug.sample import inputs
from arbiview_aug.sample.masks import image_circle, without_specks
from tests.helpers import camera


def fisheye(size: tuple[int, int] = (160, 240)) -> Camera:
    return camera("fish", size=size, K=[[80.0, 0, 119.5], [0, 84.0, 79.5], [0, 0, 1]], lens="fisheye")


def vignetted(circle: Camera, radius_px: float = 110.0, center: tuple[float, float] = (122.0, 78.0)) -> torch.Tensor:
    """A textured image that fades to black at an ellipse, as pixels are not square."""
    offset = (circle.pixel_grid() - center) / (radius_px, radius_px * 84 / 80)
    radius = np.linalg.norm(offset, axis=-1)
    texture = np.random.default_rng(0).uniform(60, 255, circle.size)
    fading = np.clip((1 - radius) / 0.1 + 0.1, 0, 1)
    return torch.from_numpy((texture * fading).astype(np.uint8)).expand(3, -1, -1)


def test_specks_are_turned_over_and_regions_stay() -> None:
    mask = np.ones((100, 200), bool)
    mask[80:, 50:150] = False
    cleaned = mask.copy()
    mask[3, 4] = mask[10, 100] = mask[11, 101] = False
    mask[90, 60] = True
    assert (without_specks(mask) == cleaned).all()
    assert (without_specks(cleaned) == cleaned).all()


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.bfloat16])
def test_the_image_circle_is_found(dtype: torch.dtype) -> None:
    fish = fisheye()
    image = vignetted(fish)
    circle = image_circle(fish, image if dtype == torch.uint8 else (image / 255).to(dtype))
    assert circle is not None
    assert np.abs(circle.center_px - (122, 78)).max() < 2
    assert np.abs(circle.radii_px / (110, 110 * 84 / 80) - 0.93).max() < 0.05
    hidden = ~circle.holds(fish)
    assert image[0].numpy()[hidden].mean() < 40 and 0.2 < hidden.mean() < 0.3


@pytest.mark.parametrize("gain", [1.0, 0.3, 0.1, 0.0])
def test_a_scene_without_rim_has_none(gain: float) -> None:
    fish, rng = fisheye(), np.random.default_rng(1)
    blocks = np.kron(rng.uniform(0, 255, (10, 15)), np.ones((16, 16)))
    assert image_circle(fish, torch.from_numpy((gain * blocks).astype(np.uint8)).expand(3, -1, -1)) is None
    tiny = camera("t", size=(1, 2), K=np.eye(3), lens="fisheye")
    assert image_circle(tiny, torch.zeros(3, 1, 2)) is None
    assert image_circle(camera(size=(160, 240)), vignetted(fish)) is None, "not for lenses without a circle"


def test_a_rim_is_warned_of_once_and_masked(monkeypatch: pytest.MonkeyPatch) -> None:
    fish = fisheye()
    rig, image = Rig([fish]), vignetted(fish)[None]
    retarget = RigRetarget(Rig([camera("t", 0.0)]))
    with pytest.warns(UserWarning, match=r"camera 'fish': image: .* dark rim .* clean_masks=True"):
        before = retarget({"images": image, "rig": rig})
    cleaned = cleaned_rig(rig, image)
    assert cleaned[0].mask is not None and cleaned_rig(cleaned, image)[0] is cleaned[0]
    with pytest.raises(SampleError, match="images: expected 1 for cameras fish, got 2"):
        cleaned_rig(rig, [image[0], image[0]])
    with warnings.catch_warnings(), monkeypatch.context() as unsearched:
        warnings.simplefilter("error")
        retarget({"images": image, "rig": rig, "token": "a"})
        after = RigRetarget(Rig([camera("t", 0.0)]))({"images": image, "rig": cleaned})
        unsearched.setattr(inputs, "dark_rims", None)  # types of samples that alternate are known
        retarget({"images": image, "rig": rig})
        retarget({"images": image, "rig": rig, "token": "a"})
    assert after["coverage"].sum() <= before["coverage"].sum()


def test_real_rims_leave_four_pinhole_views(fisheye_root: Path) -> None:
    """The pixels that the views lose were dark; the others stay."""
    angles = {"front": 0, "left": 90, "back": 180, "right": 270}
    target = Rig([camera(name, angle, size=(120, 200), horizontal_fov_deg=120.0) for name, angle in angles.items()])
    views = []
    for clean in (False, True):
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="camera 'front'|target cameras")
            sample = FrameFolder(fisheye_root, clean_masks=clean)[0]
            views.append(RigRetarget(target, holes="black")(sample))
    before, after = views
    lost = before["coverage"] & ~after["coverage"]
    brightness = before["images"].amax(dim=1).float()
    assert brightness[lost].median() < 60 < brightness[after["coverage"]].median()
