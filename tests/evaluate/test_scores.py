"""Dense PSNR and SSIM against scikit-image's, which takes a second to import."""

from __future__ import annotations

import numpy as np
import pytest

from arbiview_aug.evaluate.metrics import errors, psnr_db, ssim_map, truth_metrics


@pytest.fixture(params=[2.0, 20.0])
def pair(request: pytest.FixtureRequest) -> tuple[np.ndarray, np.ndarray]:
    """A smooth picture with edges, and the same with noise."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[:90, :130]
    picture = 128 + 60 * np.sin(row / 9.0) * np.cos(column / 14.0) + 50 * (column > 70)
    one = np.stack([picture, 0.7 * picture, 255 - picture], -1)
    two = one + rng.normal(0, request.param, one.shape)
    return tuple(np.clip(np.round(x), 0, 255).astype(np.uint8) for x in (one, two))  # type: ignore[return-value]


def test_psnr(pair: tuple[np.ndarray, np.ndarray]) -> None:
    from skimage.metrics import mean_squared_error, peak_signal_noise_ratio

    one, two = pair
    found = errors(one.reshape(-1, 3), two.reshape(-1, 3))
    assert found["psnr_db"] == pytest.approx(peak_signal_noise_ratio(two, one, data_range=255), abs=1e-9)
    assert found["rmse"] ** 2 == pytest.approx(mean_squared_error(two, one))
    assert psnr_db(found["rmse"] ** 2) == pytest.approx(found["psnr_db"])
    assert truth_metrics(one, two)["psnr_db"] == pytest.approx(found["psnr_db"])


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
