"""Predictions of networks brought to metres: networks that see the truth in a unit of their own, and wrong ones."""

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Rig
from arbiview_aug.datasets.synthetic import RenderedViews, SyntheticDrive, demo_source_rig
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import MOTION_KEY
from arbiview_aug.temporal.learned_depth import CameraFit, fit_depth, learned_depth
from arbiview_aug.temporal.motion_depth import MotionDepth
from tests.helpers import camera

RIG = demo_source_rig((96, 264))
RIG = RIG.with_cameras([RIG[0], RIG[1]])


@dataclass
class Oracle:
    """A network that knows the true depth of its images, in some form.

    ``form`` is given (h, w) z-depths; ``assumed_px`` is the focal length for which a metric network is right.
    """

    truth: dict[bytes, np.ndarray]
    form: Callable[[np.ndarray], np.ndarray]
    output: Any = None
    assumed_px: float | None = None
    name = "oracle"
    revision = "1"
    licence = "mit"

    def predict(self, images: Sequence[torch.Tensor]) -> list[np.ndarray]:
        self.batches = [*getattr(self, "batches", []), len(images)]
        predictions, focal_px = [], float(RIG[0].K[0, 0])
        for image in images:
            seen = self.truth[image.numpy().tobytes()] * (self.assumed_px or focal_px) / focal_px
            predictions.append(self.form(seen).astype(np.float32))
            image.zero_()  # a copy: the truth knows the images by their bytes
        return predictions


@cache
def street() -> tuple[dict[str, Any], RenderedViews]:
    drive = SyntheticDrive(RIG, num_frames=1, seed=3)
    return drive[0], drive.render(0)


def oracle(form: Callable[[np.ndarray], np.ndarray], output: Any = None, assumed_px: float | None = None) -> Oracle:
    sample, views = street()
    depths = np.where(np.isfinite(views.depth_m.numpy()), views.depth_m.numpy(), 1e4)
    return Oracle(
        {i.numpy().tobytes(): d for i, d in zip(sample["images"], depths, strict=True)}, form, output, assumed_px
    )


def inputs(**changes: Any) -> Frame:
    sample, _ = street()
    points, boxes = sample["points"].numpy().astype(float), sample["boxes_3d"].numpy().astype(float)
    return Frame(tuple(sample["images"]), RIG, **({"points": points, "boxes": boxes} | changes))


def depth_of(model: Oracle, frame: Frame, **settings: Any) -> tuple[MotionDepth, list[CameraFit]]:
    (one,) = learned_depth(model, [frame], **({"batch": 2} | settings))
    return one


def errors(depth: MotionDepth) -> np.ndarray:
    """Relative errors of the pixels nearer than 75 m, nine tenths of which have a depth; the sky is far away."""
    true, depth_of = street()[1].depth_m.numpy(), np.stack(depth.depth_m)
    near = true < 75
    assert (depth_of[near] > 0).mean() > 0.9 and depth_of[true > 1000].min() > 100
    return np.abs(depth_of[near & (depth_of > 0)] / true[near & (depth_of > 0)] - 1)


FORMS = {
    "relative inverse depth": (lambda z: 700 / z + 13, "inverse", None),
    "unknown: inverse": (lambda z: 0.02 / z - 0.001, None, None),
    "unknown: depth": (lambda z: 0.4 * z, None, None),
    "metric, another focal length": (lambda z: z, "depth", 721.0),
    "depth, scaled and shifted": (lambda z: 0.3 * z + 2, "depth", 721.0),
    "inverse depth, scaled and shifted": (lambda z: 1 / (0.6 / z + 0.004), "depth", 721.0),
    "inverse depth for one focal length": (lambda z: 1 / z, "inverse", 1000.0),
}


@pytest.mark.parametrize("reference", ["LiDAR", "motion", "road"])
@pytest.mark.parametrize("form", FORMS)
def test_an_affine_change_and_another_focal_length_come_back(form: str, reference: Any) -> None:
    """Within 2 % of the truth; the road is all that a fit needs."""
    true = street()[1].depth_m.numpy()
    motion = MotionDepth(tuple(np.where(true < 60, true, 0).astype(np.float32)), "")
    depth, fits = depth_of(oracle(*FORMS[form]), inputs(depth={MOTION_KEY: motion.depth_m}), wanted=[reference])
    assert [fit.reference for fit in fits] == [reference] * 2 and not any(fit.declined for fit in fits)
    assert np.quantile(errors(depth), 0.99) < 0.02
    assert "oracle, revision 1, licence mit" in str(depth) and f"of {reference}, residual 0." in str(depth)


def test_the_best_reference_is_taken() -> None:
    model = oracle(*FORMS["relative inverse depth"])
    assert {fit.reference for fit in depth_of(model, inputs())[1]} == {"LiDAR"}
    assert model.batches == [2]
    assert {fit.reference for fit in depth_of(model, inputs(points=None))[1]} == {"road"}
    few = inputs().points[:0]
    assert {fit.reference for fit in depth_of(model, inputs(points=few))[1]} == {"road"}


WRONG = "it errs by more than 15%|it is hardly better than one depth|near and far are swapped"


@pytest.mark.parametrize(
    ("form", "reason"),
    [
        (lambda z: np.random.default_rng(0).uniform(1, 50, z.shape), WRONG),
        (lambda z: np.full(z.shape, 7.0), "its output is the same everywhere"),
        (lambda z: z, "near and far are swapped"),
        (lambda z: 50 / z[::-1], WRONG),
    ],
    ids=["random", "constant", "depth for inverse depth", "upside down"],
)
@pytest.mark.parametrize("reference", ["LiDAR", "road"])
def test_wrong_networks_are_declined(form: Callable[[np.ndarray], np.ndarray], reason: str, reference: Any) -> None:
    depth, fits = depth_of(oracle(form, "inverse"), inputs(), wanted=[reference])
    assert depth.density == 0 and all(fit.declined for fit in fits)
    assert all(re.search(reason, fit.declined) for fit in fits), fits
    assert "front: declined, " in str(depth)


def test_outliers_do_not_move_a_fit() -> None:
    rng = np.random.default_rng(1)
    depth_m = rng.uniform(3, 60, 2000)
    values = 5 / depth_m + 0.7
    values[:700] = rng.uniform(values.min(), values.max(), 700)
    line, residual, declined = fit_depth(values, depth_m, None)
    assert residual is not None and line is not None and line.form == "inverse" and not declined and residual < 0.02
    assert line.scale == pytest.approx(1 / 5, rel=1e-3) and line.shift == pytest.approx(-0.14, rel=1e-3)


def test_a_camera_of_which_nothing_is_known_is_declined() -> None:
    up = camera("up", size=(96, 128), horizontal_fov_deg=40.0, position_m=(0, 0, 1.5)).turned(pitch_deg=60)
    image = torch.zeros(3, 96, 128, dtype=torch.uint8)
    model = Oracle({image.numpy().tobytes(): np.ones((96, 128))}, lambda z: z, "depth")
    depth, (fit,) = depth_of(model, Frame((image,), Rig([up])))
    assert fit.declined == "fewer than 50 points of LiDAR, motion, road" and not depth.density


def test_fisheye_images_are_shown_as_pinhole_ones() -> None:
    """Networks know pinhole images; the prediction is brought back to the lens."""
    lens = camera(
        "fish", size=(96, 128), lens="fisheye", K=[[50, 0, 63.5], [0, 50, 47.5], [0, 0, 1]], position_m=(0, 0, 1.5)
    )
    seen: list[torch.Tensor] = []

    class Road(Oracle):
        def predict(self, images: Sequence[torch.Tensor]) -> list[np.ndarray]:
            seen.extend(images)
            rays, _ = lens.undistorted().unproject(lens.pixel_grid())
            inverse = np.maximum(-rays[..., 2] / 1.5 / rays[..., 0], 0.0)
            return [inverse.astype(np.float32) for _ in images]

    image = torch.rand(3, 96, 128)
    depth, (fit,) = depth_of(Road({}, lambda z: z, "inverse"), Frame((image,), Rig([lens])))
    rays, _ = lens.unproject(lens.pixel_grid())
    true = np.where(rays[..., 2] < -0.1, -1.5 / np.minimum(rays[..., 2], -1e-3) * rays[..., 0], np.inf)
    known = (depth.depth_m[0] > 0) & np.isfinite(true)
    assert known.mean() > 0.2 and np.allclose(depth.depth_m[0][known], true[known], rtol=0.02)
    assert seen[0].dtype == torch.uint8 and seen[0].shape == image.shape and fit.residual < 0.02
