"""Metrics against a true view on cases worked out by hand and by scikit-image; image conversions."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.metrics import as_arrays, as_tensors, errors, psnr_db, ssim_map, to_bytes, truth_metrics


def test_regions() -> None:
    truth = np.full((40, 60, 3), 100, np.uint8)
    image = truth.copy()
    image[:, 30:] = 110  # right half: 10 off
    image[30:] = 140  # bottom quarter: 40 off
    coverage = np.zeros((40, 60), bool)
    coverage[:30] = True
    ground = np.zeros((40, 60), bool)
    ground[20:] = True
    sky = ~ground
    row = truth_metrics(image, truth, coverage=coverage, classes={"ground": ground, "sky": sky})
    assert row["mae"] == pytest.approx((0.75 * 0.5 * 10) + 0.25 * 40)
    assert row["covered_mae"] == pytest.approx(5.0) and row["hole_mae"] == pytest.approx(40.0)
    assert row["hole_psnr_db"] == pytest.approx(10 * np.log10(255**2 / 40**2))
    assert row["covered_ground_mae"] == pytest.approx(5.0) and row["ground_mae"] == pytest.approx((5 + 40) / 2)
    shares = {"": 1.0, "covered_": 0.75, "hole_": 0.25, "ground_": 0.5, "sky_": 0.5, "covered_ground_": 0.25}
    assert {k: row[f"{k}share"] for k in shares} == pytest.approx(shares)
    # A region without pixels has no errors, and does not spoil a mean.
    assert row["hole_sky_share"] == 0 and "hole_sky_psnr_db" not in row
    assert row["covered_ssim"] > row["hole_ssim"]


def test_own_car_does_not_count() -> None:
    truth = np.full((20, 20, 3), 50, np.uint8)
    image = truth.copy()
    image[10:] = 0
    valid = np.zeros((20, 20), bool)
    valid[:10] = True
    row = truth_metrics(image, truth, valid=valid)
    assert row["mae"] == 0 and row["share"] == 1.0


def test_errors_by_hand() -> None:
    found = errors(np.array([[10, 20, 30]], np.uint8), np.array([[13, 16, 30]], np.uint8), "a_")
    expected = {"a_psnr_db": 10 * np.log10(255**2 / (25 / 3)), "a_mae": 7 / 3, "a_rmse": (25 / 3) ** 0.5}
    assert found == pytest.approx(expected)
    assert errors(np.zeros((0, 3)), np.zeros((0, 3))) == {}
    assert psnr_db(255.0**2) == 0


def test_tensors_become_arrays_on_one_scale() -> None:
    tensors = torch.tensor([[[0, 51], [102, 255]]], dtype=torch.uint8).repeat(2, 3, 1, 1)
    from_bytes, from_floats = as_arrays(tensors), as_arrays(list(tensors.float() / 255))
    for a, b in zip(from_bytes, from_floats, strict=True):
        assert a.shape == (2, 2, 3) and a.dtype == np.uint8 and b.dtype == np.float32
        np.testing.assert_allclose(a, b, atol=1e-4)
    back = as_tensors(from_floats)
    assert all(torch.equal(x, y) for x, y in zip(back, tensors, strict=True))
    assert to_bytes(np.array([[[-3.0, 254.6, 300.0]]])).tolist() == [[[0, 255, 255]]]
    with pytest.raises(SampleError, match=r"images: expected \(3, h, w\) each, got \(2, 2, 3\)"):
        as_arrays([torch.zeros(2, 2, 3)])


@pytest.fixture(params=[2.0, 20.0])
def pair(request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray]:
    """A smooth picture with edges, and the same with noise."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:90, :130]
    picture = 128 + 60 * np.sin(row / 9.0) * np.cos(column / 14.0) + 50 * (column > 70)
    one = np.stack([picture, 0.7 * picture, 255 - picture], -1)
    two = one + rng.normal(0, request.param, one.shape)
    return tuple(np.clip(np.round(x), 0, 255).astype(np.uint8) for x in (one, two))  # type: ignore[return-value]


def test_ssim(pair: tuple[np.ndarray, np.ndarray]) -> None:
    from skimage.metrics import structural_similarity

    one, two = pair
    settings = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": 255}
    mean, full = structural_similarity(one, two, channel_axis=2, full=True, **settings)
    ours = ssim_map(one, two)
    inside = np.s_[5:-5, 5:-5]  # its mean leaves the border out, where windows reach past it
    np.testing.assert_allclose(ours[inside], full[inside], atol=1e-7)
    assert ours[inside].mean() == pytest.approx(mean, abs=1e-7)
    assert truth_metrics(one, two)["ssim"] == pytest.approx(ours.mean())
    assert 0.1 < mean < 0.999
