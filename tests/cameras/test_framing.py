"""Views of another shape: what ``crop``, ``pad`` and ``stretch`` keep, cut and add, and that ``K`` says so."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
import torch

from arbiview_aug import ArbiviewError, CalibrationError, Camera, Rig, RigRetarget, SampleKeys
from arbiview_aug.cameras.framing import Fit, Framing, framing
from arbiview_aug.inpaint import Telea
from arbiview_aug.sample.batching import framed
from tests.helpers import same

OWN = (24, 48)
WIDE, TALL = (16, 64), (40, 32)
FITS: tuple[Fit, ...] = get_args(Fit)


def rig(masked: bool = False, lens: str = "pinhole") -> Rig:
    """Three overlapping cameras, which stand as one, so that any turn renders exactly."""
    h, w = OWN
    mask = np.ones(OWN, bool)
    mask[-4:, :20] = False
    lenses: dict[str, Any] = {} if lens == "pinhole" else {"lens": lens, "distortion": (0.05, -0.02, 0.01, 0.0)}
    cameras = [
        Camera.looking(name=f"c{k}", azimuth_deg=40.0 * k, width_px=w, height_px=h, horizontal_fov_deg=70, **lenses)
        for k in range(3)
    ]
    return Rig([replace(c, mask=mask) for c in cameras] if masked else cameras, name="three")


def sample(masked: bool = False) -> dict[str, Any]:
    rng = torch.Generator().manual_seed(0)
    coarse = torch.rand(3, 3, 6, 12, generator=rng)
    images = torch.nn.functional.interpolate(coarse, size=OWN, mode="bicubic").clamp(0, 1)
    labels = torch.randint(0, 9, (3, *OWN), generator=rng, dtype=torch.uint8)
    return {"images": images, "classes": labels, "rig": rig(masked), "token": "a"}


def transform(size: tuple[int, int], fit: Fit, **settings: Any) -> RigRetarget:
    keys = SampleKeys(extra=("source_camera", "source_frame", "confidence"), labels=("classes",))
    return RigRetarget(rig().turned(yaw_deg=9), size=size, fit=fit, **{"keys": keys, **settings})


@pytest.mark.parametrize(
    ("to", "fit", "expected"),
    [
        ((256, 704), "crop", Framing((469, 704), 213, 0, (256, 704))),  # 704 / 1920 of 1280 rows is 469.3
        ((256, 704), "pad", Framing((256, 384), 0, -160, (256, 704))),
        ((256, 704), "stretch", Framing((256, 704), 0, 0, (256, 704))),
        ((640, 301), "crop", Framing((640, 960), 0, 329, (640, 301))),
        ((640, 301), "pad", Framing((201, 301), -439, 0, (640, 301))),
        ((853, 1280), "crop", Framing((853, 1280), 0, 0, (853, 1280))),  # 853.3 rows
    ],
)
def test_the_last_row_stays_and_the_columns_are_centred(to: tuple[int, int], fit: Fit, expected: Framing) -> None:
    assert framing("front", (1280, 1920), to, fit) == expected


@pytest.mark.parametrize("lens", ["pinhole", "radtan", "fisheye"])
@pytest.mark.parametrize("to", [WIDE, TALL, (60, 61)])
@pytest.mark.parametrize("fit", FITS)
def test_k_says_where_points_fall(fit: Fit, to: tuple[int, int], lens: str) -> None:
    source = rig(lens=lens)[0]
    f, resized = framing("c", source.size, to, fit), source.resize(to, fit)
    points = source.center_m + np.array([[5.0, 1.0, 0.3], [9.0, -2.0, -1.0], [3.0, 0.1, 1.0]])
    sy, sx = f.scaled[0] / OWN[0], f.scaled[1] / OWN[1]
    # Outer edges at -0.5 stay edges of what is scaled; then the window's first pixel becomes (0, 0).
    expected = (source.project(points).uv + 0.5) * (sx, sy) - 0.5 - (f.left, f.top)
    np.testing.assert_allclose(resized.project(points).uv, expected, atol=1e-9)
    np.testing.assert_array_equal(resized.cam2ego, source.cam2ego)
    assert resized.size == to and (resized.lens, resized.distortion) == (source.lens, source.distortion)


def test_masks_follow_and_bars_are_no_scene() -> None:
    (camera, *_), f = rig(masked=True), framing("c", OWN, TALL, "pad")
    padded, bare = camera.resize(TALL, "pad"), rig()[0].resize(TALL, "pad")
    assert f.top == -24 and padded.mask is not None and bare.mask is not None
    assert not padded.mask[:24].any() and not bare.mask[:24].any() and bare.mask[24:].all()
    np.testing.assert_array_equal(padded.mask[24:], camera.resize(f.scaled).mask)
    cut = camera.resize(WIDE, "crop")
    np.testing.assert_array_equal(cut.mask, camera.resize((32, 64)).mask[16:])
    assert rig()[0].resize(WIDE, "crop").mask is None


@pytest.mark.parametrize("params", [None, {"skipped": 1.0}])
@pytest.mark.parametrize("size", [OWN, (12, 24), (36, 72)])
def test_all_fits_agree_bit_by_bit_where_the_aspect_is_equal(size: tuple[int, int], params: Any) -> None:
    first, *others = (transform(size, fit, p=0.5 if params else 1.0)(sample(), params) for fit in FITS)
    assert all(same(first, other) for other in others)


@pytest.mark.parametrize("skipped", [0.0, 1.0])
@pytest.mark.parametrize("size", [WIDE, TALL])
def test_a_crop_is_the_window_of_the_scaled_view(size: tuple[int, int], skipped: float) -> None:
    params = {"skipped": skipped}
    f = framing("c", OWN, size, "crop")
    cut = transform(size, "crop", p=0.5, holes="black")(sample(masked=True), params)
    whole = transform(f.scaled, "stretch", p=0.5, holes="black")(sample(masked=True), params)
    exact = bool(skipped)  # a target's maps are interpolated on another grid
    for key in ("images", "classes", "coverage", "source_camera", "confidence", "ego_mask"):
        expected = framed(whole[key], f)
        if exact:
            assert torch.equal(cut[key], expected), key
        else:
            off = (cut[key].float() - expected.float()).abs()
            assert off.mean() < (2e-3 if key == "images" else 0.05 if key == "classes" else 0.02), key
    shift = torch.tensor([[0, 0, f.left], [0, 0, f.top], [0, 0, 0]])
    assert torch.equal(cut["K"], whole["K"] - shift)


@pytest.mark.parametrize("skipped", [0.0, 1.0])
@pytest.mark.parametrize("size", [WIDE, TALL])
def test_bars_are_black_unseen_and_ignored(size: tuple[int, int], skipped: float) -> None:
    params = {"skipped": skipped}
    f = framing("c", OWN, size, "pad")
    padded = transform(size, "pad", p=0.5)(sample(masked=True), params)
    whole = transform(f.scaled, "stretch", p=0.5)(sample(masked=True), params)
    fills = {"images": 0, "coverage": 0, "ego_mask": 1, "classes": 255, "source_camera": -1, "source_frame": -1}
    for key, fill in {**fills, "confidence": 0}.items():
        assert torch.equal(padded[key], framed(whole[key], f, fill)), key
    bars = framed(torch.zeros(f.scaled), f, 1).bool()
    assert 0 < bars.sum() == size[0] * size[1] - f.scaled[0] * f.scaled[1]
    assert not padded["images"][..., bars].any() and not padded["coverage"][:, bars].any()
    assert padded["ego_mask"][:, bars].all()


@pytest.mark.filterwarnings("ignore:the target rig")
def test_no_filler_touches_bars() -> None:
    unlabelled = {key: value for key, value in sample().items() if key != "classes"}
    size, f = (40, 64), framing("c", OWN, (40, 64), "pad")
    wide = Rig([replace(c, K=c.K * [[0.5, 1, 1], [1, 0.5, 1], [1, 1, 1]]) for c in rig()])  # holes above and below
    bars = framed(torch.zeros(f.scaled), f, 1).bool()
    for path in ("continue", "telea"):
        out = RigRetarget(wide, size=size, fit="pad", holes=path)(unlabelled)  # type: ignore[arg-type]
        assert out["generated"].any() and not out["generated"][:, bars].any() and not out["images"][..., bars].any()
        assert not torch.logical_or(out["coverage"], out["generated"])[:, bars].any()
        assert torch.logical_or(out["coverage"], out["generated"])[:, ~bars].all()
    later = RigRetarget(wide, size=size, fit="pad", keys=SampleKeys(extra=("sources", "confidence")))(unlabelled)
    completed = Telea().complete_batch(later)["images"]  # after collating, with bars around
    assert (completed - out["images"]).abs().max() < 0.1
    # Black does not bleed in from the bars: they are not read.
    whole = RigRetarget(wide, size=f.scaled, fit="stretch", holes="telea")(unlabelled)
    assert (out["images"] - framed(whole["images"], f)).abs().max() < 0.1


def test_what_would_be_cut_from_too_large_an_image_is_refused_by_name() -> None:
    with pytest.raises(CalibrationError, match=r"camera 'c0': size=\(30000, 2\), .*32766 .*\(30000, 60000\)"):
        framing("c0", (1, 2), (30000, 2), "crop")
    with pytest.raises(ArbiviewError, match=r"camera 'c0': size=\(20000, 2\), fit='crop'"):
        RigRetarget(rig(), size=(20000, 2))
    assert rig()[0].resize((20000, 2), "pad").size == (20000, 2)
