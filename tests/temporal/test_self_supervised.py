"""A network that learns from a synthetic drive alone, against the drive's true depth."""

from functools import cache
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import DataError
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import demo_source_rig
from arbiview_aug.temporal.learned_depth import DepthInputs, View
from arbiview_aug.temporal.self_supervised import FittedDepth, fit_to_drive, loss_of_depth, read_targets, size_for
from tests.helpers import Standing

pytestmark = pytest.mark.slow

RIG = demo_source_rig((64, 176))
RIG = RIG.with_cameras([RIG[0], RIG[1]])
FRAMES = 4


@cache
def frame(index: int) -> tuple[dict[str, Any], torch.Tensor]:
    """A frame with decoded neighbours, and its true depth."""
    near = Neighbours(count=2, step_m=0.6)
    drive = Standing(RIG, num_frames=FRAMES, seed=9, lidar=False, neighbours=near, supersampling=1)
    sample = drive[index]
    decoded = [{**entry, "images": entry["images"]} for entry in sample["neighbours"]]
    return sample | {"neighbours": decoded}, drive.render(index).depth_m


def relative_error(model: FittedDepth) -> float:
    """Mean relative error of pixels nearer than 60 m."""
    errors = []
    for index in range(FRAMES):
        sample, true = frame(index)
        given = DepthInputs(RIG, list(sample["images"]))
        found = model.predict([View.of(given, k) for k in range(len(RIG))])
        depth = 1 / np.stack([one.values for one in found])
        errors.append(np.abs(depth / true.numpy() - 1)[true.numpy() < 60])
    return float(np.concatenate(errors).mean())


def test_true_depth_explains_a_frame_by_its_sources() -> None:
    """The loss is least at the truth: of the street, and of depths a tenth larger and smaller."""
    sample, true = frame(0)
    targets = read_targets(sample, (64, 176))
    assert targets is not None and targets.sources.shape == (2, 5, 3, 64, 176)
    assert targets.is_later.tolist() == [[True] * 4 + [False]] * 2
    inverse = (1 / true)[:, None].float()
    losses = [float(loss_of_depth(targets, one)) for one in (inverse, targets.street, 1.1 * inverse, 0.9 * inverse)]
    assert losses[0] < 0.5 * losses[1] and losses[0] < 0.85 * min(losses[2:]), losses


def test_moving_objects_do_not_count() -> None:
    sample, _ = frame(0)
    standing = read_targets(sample, (64, 176))
    boxes = sample["neighbours"][0]["boxes_3d"].clone()
    boxes[:, 0] += 1.5
    near = [sample["neighbours"][0] | {"boxes_3d": boxes}, *sample["neighbours"][1:]]
    moving = read_targets(sample | {"neighbours": near}, (64, 176))
    assert moving is not None and standing is not None
    assert standing.masks.all() and standing.source_masks.all()
    seen = moving.source_masks.flatten(2).all(2)
    assert not moving.masks.all() and (~seen[:, :4]).any(0).sum() == 1
    assert read_targets(sample | {"neighbours": []}, (64, 176)) is None
    with pytest.raises(DataError, match="--fit: expected frames with others"):
        next(fit_to_drive(FittedDepth((64, 176)), [sample | {"neighbours": []}], 1))


def test_untrained_it_is_the_street(tmp_path: Any) -> None:
    torch.manual_seed(0)
    model, (sample, _) = FittedDepth(size_for(RIG[0])), frame(0)
    assert model.size == (64, 176)
    targets = read_targets(sample, model.size)
    views = [View.of(DepthInputs(RIG, list(sample["images"])), k) for k in range(2)]
    assert targets is not None
    assert np.allclose([one.values for one in model.predict(views)], targets.street[:, 0].clamp(1e-3), atol=1e-6)
    model.save(tmp_path / "fitted.pt")
    again = FittedDepth(model.size)
    again.load(tmp_path / "fitted.pt")
    assert again.revision == model.revision and len(model.revision) == 12
    (tmp_path / "fitted.pt").write_bytes(b"broken")
    with pytest.raises(DataError, match=r"fitted\.pt: expected a fitted network, got .*; delete it"):
        again.load(tmp_path / "fitted.pt")


def test_it_learns_the_depth_of_a_drive() -> None:
    """The relative error falls by more than a third of the untrained network's, which is the street's."""
    torch.manual_seed(0)
    model = FittedDepth(size_for(RIG[0]))
    before = relative_error(model)
    list(fit_to_drive(model, [frame(index)[0] for index in range(FRAMES)], 100))
    after = relative_error(model)
    print(f"\nmean relative error {before:.3f} -> {after:.3f}")
    assert after < before * 2 / 3
