"""Confidence against true views: pixels that claim less error have less.

Synthetic streets that no constant was fitted on (``arbiview_aug.render.confidence`` names those), the demo's six-camera
rig at 256x704, four vehicle changes; all covered pixels of all streets and changes together, and of each change alone.
Bins are of equal count, and of equal width; errors are mean absolute ones over the channels. Run with ``-s`` for the
tables.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
import torch

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
MOVES = {
    "0.7 m higher": ({"z_m": 0.7}, 0.0),
    "1 m sideways": ({"y_m": 1.0}, 0.0),
    "1 m forward": ({"x_m": 1.0}, 0.0),
    "turned by 20°": ({}, 20.0),
}
BINS = 10


class Pixels(NamedTuple):
    """(n,) float32 each, of covered pixels."""

    confidence: np.ndarray
    error: np.ndarray


class Calibration(NamedTuple):
    """Figures of the bins, the least confident first."""

    errors: list[float]
    spearman: float
    equal_width_errors: list[float]
    equal_width_spearman: float
    halving: float
    """Mean error of all pixels over that of the most confident half."""

    claimed: list[float]
    """The error that each bin's confidence claims."""


def spearman(errors: list[float]) -> float:
    """Rank correlation of the errors with the bins' order."""
    ranks = np.argsort(np.argsort(errors))
    return float(np.corrcoef(np.arange(len(errors)), ranks)[0, 1])


def calibration(pixels: Pixels) -> Calibration:
    # Ties (exact pixels) are in the order in which they came: no order of theirs is better than another.
    order = np.argsort(pixels.confidence, kind="stable")
    error = pixels.error[order]
    bins = [float(part.mean()) for part in np.array_split(error, BINS)]
    claims = -EXPECTED_ERROR_LEVELS * np.log(np.maximum(pixels.confidence[order], 1e-6))
    index = np.minimum((pixels.confidence * BINS).astype(int), BINS - 1)
    count = np.bincount(index, minlength=BINS)
    populated = count >= 1e-3 * len(index)
    wide = (np.bincount(index, pixels.error, minlength=BINS)[populated] / count[populated]).tolist()
    return Calibration(
        errors=bins,
        spearman=spearman(bins),
        equal_width_errors=wide,
        equal_width_spearman=spearman(wide),
        halving=float(error.mean() / error[len(error) // 2 :].mean()),
        claimed=[float(part.mean()) for part in np.array_split(claims, BINS)],
    )


def row(name: str, bins_of: Calibration) -> str:
    bins = " ".join(f"{error:5.1f}" for error in bins_of.errors)
    return f"  {name:<16}{bins}   rho {bins_of.spearman:+.3f}   error / that of the best half {bins_of.halving:.2f}"


@pytest.fixture(scope="module", params=SEEDS)
def all_pixels(request: pytest.FixtureRequest) -> dict[tuple[str, str], Pixels]:
    """By surface and vehicle change."""
    source = demo_source_rig(SIZE)
    parts: dict[tuple[str, str], list[Pixels]] = {(surface, move): [] for surface in GEOMETRIES for move in MOVES}
    for seed in range(request.param):
        drive = SyntheticDrive(source, num_frames=1, seed=seed, lidar=False)
        sample = drive[0]
        for move, (shift, yaw_deg) in MOVES.items():
            target = source.turned(yaw_deg=yaw_deg).shifted(**shift)
            truth = drive.render(0, target).images
            assert isinstance(truth, torch.Tensor)
            for surface in GEOMETRIES:
                out = RigRetarget(target, geometry=surface, keys=SampleKeys(extra=("confidence",)), holes="black")(
                    sample
                )
                error = (out["images"].float() - truth.float()).abs().mean(1)
                seen = out["coverage"]
                parts[surface, move].append(Pixels(out["confidence"][seen].numpy(), error[seen].numpy()))
    return {key: Pixels(*(np.concatenate(p) for p in zip(*part, strict=True))) for key, part in parts.items()}


@pytest.fixture(scope="module", params=GEOMETRIES)
def pixels(request: pytest.FixtureRequest, all_pixels: dict[tuple[str, str], Pixels]) -> dict[str, Pixels]:
    """By vehicle change, for one surface; printed as a table."""
    found = {move: all_pixels[request.param, move] for move in MOVES}
    whole = calibration(together(found))
    print(f"\nmean absolute error by tenths of confidence, {request.param}")
    print(row("all", whole))
    print("  (claimed)       " + " ".join(f"{claim:5.1f}" for claim in whole.claimed))
    wide = " ".join(f"{error:5.1f}" for error in whole.equal_width_errors)
    print(f"  (equal width)   {wide}   rho {whole.equal_width_spearman:+.3f}")
    for move, part in found.items():
        print(row(move, calibration(part)))
    return found


def together(found: dict[str, Pixels]) -> Pixels:
    return Pixels(*(np.concatenate(part) for part in zip(*found.values(), strict=True)))


def test_error_falls_with_confidence(pixels: dict[str, Pixels]) -> None:
    found = calibration(together(pixels))
    assert found.spearman <= -0.9
    assert found.equal_width_spearman <= -0.9


def test_the_most_confident_half_has_half_the_error(pixels: dict[str, Pixels]) -> None:
    assert calibration(together(pixels)).halving >= 2


@pytest.mark.parametrize("all_pixels", SEEDS[1:], indirect=True)  # of one street the means are too rough
def test_confidence_claims_the_error_that_there_is(pixels: dict[str, Pixels]) -> None:
    """exp(-e / 10): e is the mean error, within a third in the upper half of it."""
    found = calibration(together(pixels))
    for error, claim in list(zip(found.errors, found.claimed, strict=True))[: BINS // 2]:
        assert claim == pytest.approx(error, rel=1 / 3)
