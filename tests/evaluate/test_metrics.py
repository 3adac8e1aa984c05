"""Metrics worked out by hand: sparse LiDAR points, true views, scans; image conversions."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch

from arbiview_aug import Lidar
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.lidar import (
    ColouredPoints,
    coloured_points,
    equalised,
    lidar_split,
    sparse_metrics,
    visible_points,
)
from arbiview_aug.evaluate.metrics import as_arrays, as_tensors, errors, psnr_db, ssim_map, to_bytes, truth_metrics
from integrations.benchmarks.scans import chamfer_m, main, range_image, returns_of, scan_metrics
from tests import helpers

K = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])


camera = partial(helpers.camera, size=(81, 101), K=K, position_m=(5.0, 0.0, 1.5))


def plain(colour: tuple[int, int, int]) -> np.ndarray:
    return np.full((81, 101, 3), colour, np.uint8)


def wall(x_m: float = 15.0) -> np.ndarray:
    """Points on a plane ahead: 10 m from the camera."""
    y, z = np.meshgrid(np.linspace(-3, 3, 25), np.linspace(0.5, 3.5, 13))
    return np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], 1)


def test_visible_points_are_in_front_and_inside() -> None:
    points = np.array(
        [
            [15.0, 0.0, 1.5],  # on the axis: pixel (50, 40)
            [15.0, 1.0, 1.5],  # 1 m to the left: pixel (40, 40)
            [-5.0, 0.0, 1.5],  # behind
            [5.9, 0.0, 1.5],  # nearer than 1 m
            [15.0, 6.0, 1.5],  # outside the image
        ]
    )
    seen = visible_points(camera(), points)
    assert seen.indices.tolist() == [0, 1]
    np.testing.assert_allclose(seen.uv, [[50, 40], [40, 40]], atol=1e-9)
    np.testing.assert_allclose(seen.depth_m, 10.0)


def test_hidden_points_are_dropped() -> None:
    # A point right behind another one: 10 m against 12 m; the limit is 10 m * 1.1 + 0.3 m = 11.3 m.
    ahead, behind, near_enough = [15.0, 0.0, 1.5], [17.0, 0.0, 1.5], [16.2, 0.0, 1.5]
    seen = visible_points(camera(), np.array([ahead, behind, near_enough]))
    assert seen.indices.tolist() == [0, 2]
    # The neighbourhood reaches two cells to the side (16 px = 1.6 m at 10 m) and one up (0.8 m), not further.
    beside, above = np.array([30.0, -3.0, 1.5]), np.array([30.0, 0.0, 1.5 + 2.5 * 2.5])
    assert visible_points(camera(), np.array([ahead, beside])).indices.tolist() == [0]
    assert visible_points(camera(), np.array([ahead, above])).indices.tolist() == [0, 1]


def test_a_fisheye_sees_beside_itself() -> None:
    beside = np.array([[5.0, 8.0, 1.5], [5.0, -8.0, 1.5]])
    fisheye = camera(lens="fisheye", distortion=(0.0,) * 4, K=[[30, 0, 50], [0, 30, 40], [0, 0, 1]])
    assert visible_points(fisheye, beside).indices.tolist() == [0, 1]
    assert len(visible_points(camera(), beside).indices) == 0


def test_the_camera_closest_to_its_axis_colours_a_point() -> None:
    rig = Rig([camera("a"), camera("b", 20.0)])
    points = np.array([[15.0, 0.5, 1.5], [15.0, 3.0, 1.5], [1.0, 0.0, 0.5], [-20.0, 0.0, 0.0]])
    coloured = coloured_points(rig, [plain((200, 0, 0)), plain((0, 200, 0))], points)
    # 2.9 degrees from a's axis, 16.7 from b's; 17 degrees off the first is b's. Own car and unseen points are dropped.
    np.testing.assert_array_equal(coloured.points, points[:2])
    np.testing.assert_array_equal(coloured.colours, [[200, 0, 0], [0, 200, 0]])


def test_points_on_the_car_body_get_no_colour() -> None:
    mask = np.ones((81, 101), bool)
    mask[:, :50] = False
    coloured = coloured_points(Rig([camera(mask=mask)]), [plain((9, 9, 9))], wall())
    assert len(coloured) and (coloured.points[:, 1] <= 0).all()


def test_hand_computed_errors() -> None:
    points = ColouredPoints(
        points=np.array([[15.0, 0.0, 1.5], [15.0, 2.0, 1.5], [15.0, -2.0, 0.0]]),
        colours=np.array([[100.0, 100, 100], [110.0, 100, 100], [100.0, 100, 130]]),
        on_ground=np.array([False, False, True]),
    )
    image = plain((100, 100, 100))
    coverage = np.ones((81, 101), bool)
    coverage[:, :40] = False  # the second point falls on x = 30
    score = sparse_metrics(image, camera(), points, coverage=coverage)
    assert score is not None
    mse = (10**2 + 30**2) / 9
    assert score["psnr_db"] == pytest.approx(10 * np.log10(255**2 / mse)) and score["points"] == 3
    assert score["mae"] == pytest.approx(40 / 9) and score["rmse"] == pytest.approx(mse**0.5)
    assert score["coverage"] == pytest.approx(2 / 3) and score["covered_mae"] == pytest.approx(30 / 6)
    assert score["ground_mae"] == pytest.approx(10.0) and score["other_mae"] == pytest.approx(10 / 6)
    assert score["ground_rmse"] == pytest.approx((30**2 / 3) ** 0.5)
    assert 0.9 < score["ssim"] < 1


def test_uncovered_pixels_are_black_and_count() -> None:
    rig = Rig([camera()])
    points = coloured_points(rig, [plain((120, 120, 120))], wall())
    black = sparse_metrics(plain((0, 0, 0)), camera(), points)
    assert black is not None
    assert black["mae"] == pytest.approx(120) and black["coverage"] == 0 and "covered_mae" not in black
    exact = sparse_metrics(plain((120, 120, 120)), camera(), points)
    assert exact is not None
    assert exact["mae"] == 0 and exact["psnr_db"] > 100 and exact["ssim"] == pytest.approx(1)


def test_nothing_visible() -> None:
    rig = Rig([camera()])
    points = coloured_points(rig, [plain((1, 1, 1))], wall())
    away = camera(azimuth_deg=180.0)
    assert sparse_metrics(plain((1, 1, 1)), away, points) is None
    assert helpers.score_targets(lambda _: [plain((1, 1, 1))], points, [Rig([away])]) == {}
    assert len(coloured_points(rig, [plain((1, 1, 1))], np.zeros((0, 3)))) == 0


def test_gains_bring_shared_points_together() -> None:
    rig = Rig([camera("a", -8.0), camera("b", 8.0)])
    texture = np.random.default_rng(0).uniform(90, 110, (81, 101, 1)) * np.ones(3)
    # No texture is shared between the views, so only the mean brightness counts: one image is twice as bright.
    images = [texture.astype(np.uint8), (1.9 * texture).astype(np.uint8)]
    even = equalised(rig, images, wall())
    assert even[0].dtype == np.uint8
    gains = [after.mean() / before.mean() for before, after in zip(images, even, strict=True)]
    assert gains[0] * gains[1] == pytest.approx(1.0, rel=0.03), "the mean log-gain is zero"
    assert even[0].mean() / even[1].mean() == pytest.approx(1.0, rel=0.03)


def test_lidar_split_alternates_by_azimuth() -> None:
    azimuth = np.radians([0.5, 1.5, 2.5, -0.5, -1.5, 179.5])
    fit, test = lidar_split(np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1) * 20)
    assert fit.tolist() == [True, False, True, False, True, False]
    np.testing.assert_array_equal(test, ~fit)


# --- metrics against a true view on cases worked out by hand and by scikit-image --------------------------------------
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


# --- metrics of scans, by hand ----------------------------------------------------------------------------------------
LIDAR = Lidar("top", np.eye(4), (10.0, -10.0, 0.0), 90.0, (1.0, 50.0))


def at(distance_m: float, elevation_deg: float, azimuth_deg: float) -> list[float]:
    e, a = np.radians([elevation_deg, azimuth_deg])
    return (distance_m * np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])).tolist()


def test_points_fall_onto_their_rays() -> None:
    cloud = np.array([at(5, 0, 0), at(4, 2, 3), at(9, -10, 90), at(7, 10, 180), at(3, 30, 0), at(60, 0, -90)])
    image = range_image(LIDAR, cloud)
    expected = np.zeros((3, 4))
    expected[2, 2], expected[1, 3], expected[0, 0] = 4, 9, 7  # the nearest; past the edges and out of range are none
    np.testing.assert_allclose(image, expected, atol=1e-9)


def test_points_just_before_the_first_column_are_its() -> None:
    """Half a column on either side, as all around."""
    front = replace(LIDAR, azimuth_step_deg=1.0, azimuth_deg=(-30.0, 30.0))
    cloud = np.array([at(5, 0, azimuth) for azimuth in (-30.6, -30.4, -29.6, 29.4, 29.6)])
    assert front.shape[1] == 60
    assert returns_of(front, cloud)[1].tolist() == [0, 0, 59]
    around = np.array([at(5, 0, azimuth) for azimuth in (-136, -134, 134, 136, 180)])
    assert returns_of(LIDAR, around)[1].tolist() == [0, 1, 3, 0, 0]


def test_metrics() -> None:
    truth = np.array([at(10, 0, 0), at(20, 0, 90), at(30, 10, 0)])
    cloud = np.array([at(10.1, 0, 0), at(22, 0, 90), at(5, -10, 0)])
    metrics = scan_metrics(LIDAR, cloud, truth)
    assert metrics["recall"] == pytest.approx(1 / 3) and metrics["precision"] == pytest.approx(1 / 3)
    assert metrics["range_error_m"] == pytest.approx((0.1 + 2) / 2)
    where = np.zeros(LIDAR.shape, bool)
    where[2, 2] = True
    assert scan_metrics(LIDAR, cloud, truth, where)["recall"] == 1
    nothing = scan_metrics(LIDAR, np.zeros((0, 3)), truth)
    assert nothing["recall"] == 0 and np.isnan([nothing["precision"], nothing["chamfer_m"]]).all()


def test_numbers_of_points() -> None:
    truth = np.array([at(8, 0, 0), at(8, 0, 90), at(15, 10, 0), at(15, 10, 90)])
    cloud = np.array([at(8, 0, 0), at(8, 0, 0.5), at(8, 0, 90), at(8, -10, 0)])
    box = np.array([[8.0, 0, 0, 2, 2, 2, 0], [0, 8.0, 0, 2, 2, 2, 0.3], [30, 0, 0, 1, 1, 1, 0]])
    metrics = scan_metrics(LIDAR, cloud, truth, boxes=box)
    assert metrics["returns"] == 1
    assert metrics["in_boxes"] == pytest.approx(1 / 2)  # 2, 1 and 0 points instead of 1, 1 and 0
    nothing = scan_metrics(LIDAR, np.zeros((0, 3)), truth)
    assert nothing["returns"] == 0 and np.isnan(nothing["in_boxes"])


def test_chamfer() -> None:
    one, two = np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0.0, 0, 0]])
    assert chamfer_m(one, two) == pytest.approx((0.5 + 0) / 2)


POSE = np.eye(4)
POSE[:3, 3] = 0.9, 0.0, 2.2
TOP = Lidar("top", POSE, np.linspace(-20, 5, 36).tolist(), 0.4, (1.0, 80.0))
RIG = replace(demo_source_rig((16, 44)), lidars=[TOP])


def printed(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> dict[str, list[float]]:
    """Rows of the command's table."""
    assert main(arguments) == 0
    lines = [line.split("|")[1:-1] for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    return {cells[0].strip(): [float(cell.strip(" %")) for cell in cells[1:]] for cells in lines[2:]}


def test_the_next_frame_of_a_drive(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its scan is the truth, of all frames that have a next one; the scanner is that of calib.json."""
    drive = SyntheticDrive(RIG, num_frames=1, neighbours=Neighbours(count=2, step_m=1.5, direction="future"))
    sample = drive[0]
    recorded = (sample, *sample["neighbours"])
    frames = [{key: value for key, value in one.items() if key != "neighbours"} for one in recorded]
    helpers.write_drive(tmp_path / "drive", frames)
    scans = printed(["--data", str(tmp_path / "drive")], capsys)
    assert list(scans) == ["as they are", "scanned"] and scans["scanned"][0] > scans["as they are"][0]
    assert scans["scanned"][1] > 70, "precision in %"
    lost = [{key: value for key, value in frame.items() if key != "ego2world"} for frame in frames]
    helpers.write_drive(tmp_path / "lost", lost)
    assert main(["--data", str(tmp_path / "lost")]) == 2
    assert "expected a 'truth' camera in calib.json, or a later frame" in capsys.readouterr().err
    bare = [{**one, "rig": replace(RIG, lidars=())} for one in frames]
    helpers.write_drive(tmp_path / "bare", bare)
    assert main(["--data", str(tmp_path / "bare")]) == 2
    assert "expected lidars in calib.json, or --target" in capsys.readouterr().err
    asked = ["--data", str(tmp_path / "bare"), "--target", str(RIG.save(tmp_path / "rig.json"))]
    assert printed(asked, capsys) == scans
