"""Confidence against true views: pixels that claim less error have less.

Synthetic streets that no constant was fitted on (``arbiview_aug.render.confidence`` names those), the demo's six-camera
rig at 256x704, four vehicle changes; all covered pixels of all streets and changes together. Errors are mean absolute
ones over the channels. Run with ``-s`` for the tables.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from arbiview_aug import SampleKeys
from arbiview_aug.choices import GeometryName
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.render.confidence import EXPECTED_ERROR_LEVELS
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.helpers import few_or_all

pytestmark = pytest.mark.timeout(1800)

SEEDS = few_or_all(1, 5)
SIZE = (256, 704)
GEOMETRIES: tuple[GeometryName, ...] = ("street", "boxes")
RIG = demo_source_rig(SIZE)
TARGETS = (RIG.shifted(z_m=0.7), RIG.shifted(y_m=1.0), RIG.shifted(x_m=1.0), RIG.turned(yaw_deg=20.0))
BINS = 10


class Bins(NamedTuple):
    """Bins of equal numbers of pixels, the least confident first."""

    errors: list[float]  # mean error of each bin
    claimed: list[float]  # the error that the confidence claims
    rank_correlation: float  # of the errors' ranks with the bins' order
    halving: float  # mean error of all pixels over that of the most confident half


@pytest.fixture(scope="module", params=SEEDS)
def all_pixels(request: pytest.FixtureRequest) -> dict[str, list[np.ndarray]]:
    """Confidence and error (n,) of covered pixels, by surface."""
    parts: dict[str, list[tuple[np.ndarray, np.ndarray]]] = {surface: [] for surface in GEOMETRIES}
    for seed in range(request.param):
        drive = SyntheticDrive(RIG, num_frames=1, seed=seed, lidar=False)
        sample, keys = drive[0], SampleKeys(extra=("confidence",))
        for target in TARGETS:
            truth = drive.render(0, target).images
            for surface in GEOMETRIES:
                out = RigRetarget(target, geometry=surface, keys=keys, holes="black")(sample)
                error = (out["images"].float() - truth.float()).abs().mean(1)
                seen = out["coverage"]
                parts[surface].append((out["confidence"][seen].numpy(), error[seen].numpy()))
    return {surface: [*map(np.concatenate, zip(*part, strict=True))] for surface, part in parts.items()}


@pytest.fixture(scope="module", params=GEOMETRIES)
def bins(request: pytest.FixtureRequest, all_pixels: dict[str, list[np.ndarray]]) -> Bins:
    """All changes together, for one surface; printed."""
    confidence, error = all_pixels[request.param]
    order = np.argsort(confidence, kind="stable")  # exact pixels, which tie, as they came
    error = error[order]
    claims = -EXPECTED_ERROR_LEVELS * np.log(np.maximum(confidence[order], 1e-6))
    errors, claimed = ([float(part.mean()) for part in np.array_split(values, BINS)] for values in (error, claims))
    rho = np.corrcoef(np.arange(BINS), np.argsort(np.argsort(errors)))[0, 1]
    found = Bins(errors, claimed, float(rho), float(error.mean() / error[len(error) // 2 :].mean()))
    print(f"\nmean absolute error by tenths of confidence, {request.param}: {np.round(found.errors, 1)}")
    print(f"rho {found.rank_correlation:+.3f}, 1/{found.halving:.1f}, claimed {np.round(found.claimed, 1)}")
    return found


def test_error_falls_with_confidence(bins: Bins) -> None:
    """The most confident half has half the error."""
    assert bins.rank_correlation <= -0.9 and bins.halving >= 2


@pytest.mark.parametrize("all_pixels", SEEDS[1:], indirect=True)  # of one street the means are too rough
def test_confidence_claims_the_error_that_there_is(bins: Bins) -> None:
    """exp(-e / 10): e is the mean error, within a third in the upper half of it."""
    for error, claim in list(zip(bins.errors, bins.claimed, strict=True))[: BINS // 2]:
        assert claim == pytest.approx(error, rel=1 / 3)
