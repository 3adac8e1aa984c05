"""Training items: what they show, what they must not show, that they come from their number alone."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import TrainingError
from arbiview_aug.generator.training.config import PseudoViewConfig
from arbiview_aug.generator.training.pseudo_views import Batch, PseudoViews, collate, favs, mask_bank
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.generator.training.small import SIZE, config, frames

AS_WRITTEN: Mapping[str, Any] = {
    "p_mask_transfer": 0.0,
    "hidden": 0.0,
    "p_translate": 0.0,
    "mask_bank": 4,
}
HOLE = torch.ones(1, *SIZE, dtype=torch.bool)
HOLE[:, 4:10, 6:14] = False


def items(masks: torch.Tensor = HOLE, seed: int = 0, **changes: Any) -> PseudoViews:
    settings = PseudoViewConfig(**{**AS_WRITTEN, **changes})
    return PseudoViews(frames(), [0, 1, 2], settings, config().generator, masks, seed)


def flat(item: Batch) -> list[torch.Tensor]:
    geometry = item.geometry
    return [*item[:8], *geometry[:4], *(value for reads in geometry[4:] for c in reads for value in c)]


def test_an_item_is_its_number() -> None:
    every = {"p_mask_transfer": 0.5, "hidden": 0.5, "p_translate": 0.5}
    first, second = items(**every), items(**every)
    for k in (3, 0, 17):
        torch.manual_seed(k)
        a, b = first[k], second[k]
        assert a.tokens == b.tokens
        assert all(torch.equal(x, y) for x, y in zip(flat(a), flat(b), strict=True))
    assert not torch.equal(items(**every)[0].truth, items(seed=1, **every)[0].truth)


def test_shapes_and_ranges() -> None:
    made = items(p_mask_transfer=0.8, hidden=0.5, p_translate=0.5)
    batch = collate([made[k] for k in range(12)])
    h, w = SIZE
    assert batch.truth.shape == batch.favs.shape == batch.condition.shape == (12, 1, 3, h, w)
    assert batch.sources.shape == (12, 2, 3, h, w) and batch.seen.shape == (12, 2, h, w)
    assert batch.geometry.target_pose.shape == (12, 1, 16)
    for value in (batch.truth, batch.favs, batch.condition, batch.sources, batch.confidence):
        assert bool(torch.isfinite(value).all()) and float(value.min()) >= 0 and float(value.max()) <= 1
    assert bool((batch.confidence[~batch.known] == 0).all()) and bool((batch.favs.sum(2)[~batch.known] == 0).all())
    known = batch.known[:, :, None].expand_as(batch.truth)
    assert torch.equal(batch.condition[known], batch.favs[known])
    assert bool(batch.holes.flatten(1).any(1).float().mean() > 0.5)
    assert not bool((batch.holes & ~batch.valid).any())


def test_the_condition_is_made_of_the_pair_alone() -> None:
    """All cameras at the target pose would be the answer: what the pair does not show must be unknown."""
    made = items(yaw_deg=(35.0, 35.0), pitch_deg=0.0, focal=(3.0, 3.0))  # a narrow pair, turned away: 19 to 51 degrees
    batch = collate([made[k] for k in range(4)])
    middle = slice(SIZE[1] // 2 - 4, SIZE[1] // 2 + 4)
    assert not bool(batch.known[..., middle].any())
    assert bool((batch.favs[..., middle] == 0).all())
    assert bool(batch.known.flatten(1).any(1).all())


def places(item: Batch, made: PseudoViews) -> list[tuple[int, int]]:
    """Frame and camera of an item's real views."""
    views = {(k, i): image for k in made.indices for i, image in enumerate(made.frames[k].images)}
    return [at for true in item.truth[0] for at, image in views.items() if torch.equal(true, image.float() / 255)]


def answer_is_shown(k: int, **changes: Any) -> tuple[bool, bool]:
    """Whether another content of the holes of the real views changes the condition, and the source branches."""
    made = items(**changes)
    plain = made[k]
    for index, place in places(plain, made):
        image = made.frames[index].images[place].clone()
        image[:, ~HOLE[0]] = 255 - image[:, ~HOLE[0]]
        made.frames[index].images[place] = image
    changed = made[k]
    assert not torch.equal(plain.truth, changed.truth)
    return not torch.equal(plain.condition, changed.condition), not torch.equal(plain.sources, changed.sources)


@pytest.mark.parametrize("k", range(4))
def test_hidden_holes_are_shown_nowhere(k: int) -> None:
    assert answer_is_shown(k, p_mask_transfer=1.0, hidden=1.0) == (False, False)


@pytest.mark.parametrize("k", range(3))
def test_views_read_nothing_where_a_branch_shows_nothing(k: int) -> None:
    item = items(p_mask_transfer=1.0, hidden=1.0)[k]
    neighbour, centre, valid = item.geometry.target_reads[0]
    _, query, slot, *_ = places = valid.nonzero(as_tuple=True)
    x, y = centre[places].round().long().unbind(-1)
    seen = item.seen[0, neighbour[0, query, slot], y.clamp(max=SIZE[0] - 1), x.clamp(max=SIZE[1] - 1)]
    assert len(seen) > 100 and bool(seen.all())


@pytest.mark.parametrize("k", range(2))
def test_no_target_shows_the_answer_of_another(k: int) -> None:
    assert answer_is_shown(k, targets=2, p_mask_transfer=1.0, hidden=1.0) == (False, False)


def test_several_targets_are_neighbours_that_read_each_other() -> None:
    made = items(targets=2)
    batch, (h, w) = collate([made[k] for k in range(6)]), SIZE
    assert batch.truth.shape == (6, 2, 3, h, w) and batch.sources.shape == (6, 4, 3, h, w)
    for k in range(6):
        one, other = places(made[k], made)
        assert one[0] == other[0] and (one[1] - other[1]) % 6 in (1, 5)
    finest = batch.geometry.target_reads[0]
    of_targets = finest.neighbour >= 4  # four sources, then the two targets
    assert bool((of_targets & finest.valid.flatten(3).any(3)).flatten(1).any(1).float().mean() > 0.5)
    alone = items()[0]
    assert torch.equal(alone.truth[0, 0], batch.truth[0, 0])  # further targets change nothing of the first


def test_frames_with_fewer_cameras_than_others_are_named() -> None:
    made, narrow = items(targets=2), items(targets=2)
    for index in narrow.indices:
        frame = narrow.frames[index]
        single = frame._replace(images=frame.images[:1], rig=frame.rig.with_cameras([frame.rig[0]]))
        narrow.frames._cache._values[index] = single
    with pytest.raises(TrainingError, match=r"frame frame \d.*: expected 2 cameras as in others, got 1: train on"):
        collate([made[0], narrow[1]])


def test_masks_have_holes_of_all_sizes_and_repeat() -> None:
    rig = frames()[0].rig
    bank = mask_bank(rig, 6, seed=3)
    assert bank.shape == (6, *SIZE) and bank.dtype == torch.bool
    holes = (~bank).float().mean((1, 2))
    assert float(holes.min()) >= 0.02 and float(holes.max()) <= 0.75
    assert torch.equal(bank, mask_bank(rig, 6, seed=3)) and not torch.equal(bank, mask_bank(rig, 6, seed=4))


def test_favs_by_torch_is_favs_by_opencv() -> None:
    frame = frames()[0]
    target = replace(frame.rig[0].turned(yaw_deg=20), name="t")
    by_opencv = favs(frame.images, frame.rig, [target])
    images = [(image.float() / 255).requires_grad_() for image in frame.images]  # gradients need torch
    by_torch = favs(images, frame.rig, [target])
    assert by_torch.images.requires_grad and torch.equal(by_opencv.covered, by_torch.covered)
    assert float((by_opencv.images - by_torch.images).detach().abs().max()) < 0.02
    assert torch.allclose(by_opencv.confidence, by_torch.confidence.detach(), atol=0.05)


def test_pseudo_views_by_the_published_stages() -> None:
    """Pair and condition are those of ``quality="paper"``, whose images are the package's own where nothing moves."""
    made, plain = items(quality="paper", p_translate=1.0), items(p_translate=1.0)
    item, again, other = made[0], made[0], plain[0]
    assert all(torch.equal(x, y) for x, y in zip(flat(item), flat(again), strict=True))
    assert torch.equal(item.truth, other.truth) and not torch.equal(item.sources, other.sources)
    assert torch.equal(item.confidence, item.known.float()) and 0 < float(item.known.float().mean()) < 1
    frame = made.frames[places(item, made)[0][0]]
    pair = [frame.rig[0].turned(yaw_deg=yaw) for yaw in (10, -10)]
    published = RigRetarget(Rig([replace(c, name=str(k)) for k, c in enumerate(pair)]), quality="paper", holes="black")
    expected = published({"images": torch.stack(frame.images), "rig": frame.rig})
    rendered = favs(frame.images, frame.rig, pair, "paper")
    assert torch.equal((rendered.images * 255).round().byte(), expected["images"])
    assert torch.equal(rendered.covered, expected["coverage"])
