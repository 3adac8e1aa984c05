"""Accuracy against true views: 20 synthetic streets, three moves, two neighbouring cameras of the demo's rig.

PSNR on the pixels that every method covers: all of them, road and pavements, near objects, labelled objects; means over
the streets. Run with ``-s`` for the table.
"""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from arbiview_aug.choices import GeometryName, Quality
from arbiview_aug.datasets.synthetic import GROUND_CLASSES, SyntheticDrive, demo_source_rig
from arbiview_aug.transforms.rig_retarget import RigRetarget
from integrations.benchmarks.acceptance.protocol import psnr_of
from tests.helpers import few_or_all

pytestmark = pytest.mark.timeout(1800)

SIZE = (128, 352)
MOVES = ("0.6 m higher", "0.5 m forward", "turned by 20°")
NEAR_M = 20.0
SINGLE = ("street", "ground", "infinity")
METHODS: tuple[tuple[GeometryName, Quality], ...] = (
    *(("street", quality) for quality in ("draft", "fast", "accurate")),
    *(("boxes", quality) for quality in ("fast", "accurate")),
    *((geometry, "fast") for geometry in ("auto", "ground", "infinity")),
)
ALL, GROUND, NEAR, LABELLED = range(4)
GAIN_OVER_FAR_DB = 3.0
LARGEST_LOSS_DB = 0.1
"""Largest loss of ``auto`` to the best single surface."""

Truth = dict[tuple[str, str, str], np.ndarray]
"""(streets, parts) PSNR in dB by move, geometry and quality."""


@pytest.fixture(scope="module", params=few_or_all(3, 20))
def truth(request: pytest.FixtureRequest) -> Truth:
    """All numbers, printed as a table."""
    source = demo_source_rig(SIZE)
    rigs = [source.with_cameras([source[k], source[k + 1]]) for k in (0, 2, 4)]
    targets = [(rig.shifted(z_m=0.6), rig.shifted(x_m=0.5), rig.turned(yaw_deg=20)) for rig in rigs]
    pairs = [dict(zip(MOVES, moved, strict=True)) for moved in targets]
    retargets = {
        (pair, move, geometry, quality): RigRetarget(target, quality=quality, geometry=geometry, holes="black")
        for pair, targets in enumerate(pairs)
        for move, target in targets.items()
        for geometry, quality in METHODS
    }
    rows: dict[tuple[str, str, str], list[list[float]]] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for seed in range(request.param):
            drive = SyntheticDrive(source, num_frames=1, seed=seed, lidar=False)
            sample = drive[0]
            for move, target in pairs[seed % 3].items():
                views = drive.render(0, target)
                ground = np.isin(views.classes.numpy(), [int(c) for c in GROUND_CLASSES])
                near, labelled = (views.depth_m.numpy() < NEAR_M) & ~ground, views.instances.numpy() >= 0
                outs = [retargets[(seed % 3, move, *method)](sample) for method in METHODS]
                scores = psnr_of(outs, views, (np.ones_like(near), ground, near, labelled))
                for method, row in zip(METHODS, scores, strict=True):
                    rows.setdefault((move, *method), []).append(row)
    psnr = {key: np.array(values) for key, values in rows.items()}
    print("\nPSNR in dB against truth: all pixels that every method covers, ground, near objects, labelled")
    for (move, geometry, quality), values in psnr.items():
        print(f"  {move:<16}{geometry:<9}{quality:<10}{np.nanmean(values, axis=0).round(2)}")
    return psnr


@pytest.mark.parametrize("move", MOVES)
def test_a_road_beats_far_on_the_ground(truth: Truth, move: str) -> None:
    for geometry in ("ground", "street"):
        gain = (truth[move, geometry, "fast"] - truth[move, "infinity", "fast"])[:, GROUND]
        assert gain.mean() >= GAIN_OVER_FAR_DB and gain.min() > 0


@pytest.mark.parametrize("move", MOVES)
def test_auto_is_as_good_as_the_best_single_surface(truth: Truth, move: str) -> None:
    best = max(truth[move, geometry, "fast"][:, ALL].mean() for geometry in SINGLE)
    assert truth[move, "auto", "fast"][:, ALL].mean() >= best - LARGEST_LOSS_DB


@pytest.mark.parametrize("move", MOVES)
def test_slower_is_better(truth: Truth, move: str) -> None:
    """Means over the streets, overall and on near objects; on labelled objects, which are where their labels say,
    within 0.03 dB around boxes: wheels and mirrors stand out of shapes, over what is measured."""
    means = [np.nanmean(truth[(move, *method)], axis=0)[[ALL, NEAR, LABELLED]] for method in METHODS[:5]]
    draft, fast, accurate, fast_boxes, accurate_boxes = means
    assert (fast[:2] >= draft[:2]).all() and (accurate[:2] >= fast[:2]).all()
    assert (accurate_boxes >= fast_boxes - [0, 0, 0.03]).all()
