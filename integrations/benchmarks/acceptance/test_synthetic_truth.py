"""Accuracy against true views: 20 synthetic streets, the demo's six-camera rig moved and turned, 256x704.

A move's PSNR on a street is over the pixels of all six views together that every surface covers; the tables hold means
over the streets.
Run with ``-s`` for the tables.
"""

from __future__ import annotations

import time
import warnings
from typing import NamedTuple

import numpy as np
import pytest

from arbiview_aug.choices import GeometryName
from arbiview_aug.datasets.synthetic import GROUND_CLASSES, SyntheticDrive, demo_source_rig
from arbiview_aug.transforms.rig_retarget import RigRetarget
from integrations.benchmarks.acceptance.protocol import MOVES, moved, psnr_of
from tests.helpers import few_or_all

pytestmark = pytest.mark.timeout(1800)

SEEDS = few_or_all(2, 20)
SIZE = (256, 704)
SINGLE: tuple[GeometryName, ...] = ("street", "ground", "infinity")
GEOMETRIES: tuple[GeometryName, ...] = ("auto", *SINGLE)
GAIN_OVER_FAR_DB = 3.0
LARGEST_LOSS_DB = 0.1
"""Largest loss of ``auto`` to the best single surface on covered pixels."""


class Psnr(NamedTuple):
    """(streets,) each: on the road and the pavements, and on all pixels that every surface covers."""

    ground: np.ndarray
    covered: np.ndarray


Scores = dict[tuple[str, str], Psnr]
"""By (move, surface)."""


@pytest.fixture(scope="module", params=SEEDS)
def scores(request: pytest.FixtureRequest) -> Scores:
    """All numbers, printed as tables."""
    start, source = time.perf_counter(), demo_source_rig(SIZE)
    targets = moved(source)
    retargets = {
        (m, s): RigRetarget(target, geometry=s, holes="black") for m, target in targets.items() for s in GEOMETRIES
    }
    rows: dict[tuple[str, str], list[list[float]]] = {key: [] for key in retargets}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in range(request.param):
            drive = SyntheticDrive(source, num_frames=1, seed=seed, lidar=False)
            sample, truth = drive[0], {move: drive.render(0, target) for move, target in targets.items()}
            for move in targets:
                ground = np.isin(truth[move].classes.numpy(), [int(c) for c in GROUND_CLASSES])
                outs = [retargets[move, surface](sample) for surface in GEOMETRIES]
                scores = psnr_of(outs, truth[move], (ground, np.ones_like(ground)))
                for surface, row in zip(GEOMETRIES, scores, strict=True):
                    rows[move, surface].append(row)
    psnr = {key: Psnr(*np.array(values).T) for key, values in rows.items()}
    for name in Psnr._fields:
        print(f"\n{table(name, psnr)}")
    print(f"({time.perf_counter() - start:.0f} s)")
    return psnr


def table(field: str, psnr: Scores) -> str:
    """Means over the streets; in brackets, by how much the worst street is below the best single surface."""
    title = f"PSNR in dB, {field} pixels (worst of {len(psnr[MOVES[0], SINGLE[0]].ground)} streets)"
    lines = [f"{title:<52}" + "".join(f"{move:>18}" for move in MOVES)]
    for surface in GEOMETRIES:
        cells = []
        for move in MOVES:
            values = {s: getattr(psnr[move, s], field) for s in GEOMETRIES}
            best = np.max([values[s] for s in SINGLE], axis=0)
            cells.append(f"{values[surface].mean():.2f} ({(values[surface] - best).min():+.2f})")
        lines.append(f"  {surface:<50}" + "".join(f"{cell:>18}" for cell in cells))
    return "\n".join(lines)


@pytest.mark.parametrize("move", MOVES)
@pytest.mark.parametrize("surface", ["ground", "street"])
def test_a_road_beats_far_on_the_ground(scores: Scores, move: str, surface: str) -> None:
    gain = scores[move, surface].ground - scores[move, "infinity"].ground
    assert gain.mean() >= GAIN_OVER_FAR_DB
    assert gain.min() > 0


@pytest.mark.parametrize("move", MOVES)
def test_auto_is_as_good_as_the_best_single_surface(scores: Scores, move: str) -> None:
    best = max(scores[move, surface].covered.mean() for surface in SINGLE)
    assert scores[move, "auto"].covered.mean() >= best - LARGEST_LOSS_DB
