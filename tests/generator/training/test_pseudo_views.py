"""Training items: what they show, what they must not show, what counts, that they come from their number alone."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug.cameras.random_rig import RandomRig
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import TrainingError
from arbiview_aug.generator.config import CONFIGS, PseudoViewConfig
from arbiview_aug.generator.training.pseudo_views import Batch, Frames, PseudoViews, collate
from arbiview_aug.inpaint.inpainter import seeded
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.generator.small import SIZE, Pictures, config, frames

NO = (0.0, 0.0)
PAPER = CONFIGS["paper"].pseudo_views
STILL: dict[str, Any] = {
    **{"yaw_deg": NO, "pitch_deg": NO, "height_m": NO, "forward_m": NO, "lateral_m": NO},
    "focal_scale": (1.0, 1.0),
}


def items(seed: int = 0, data: Frames | None = None, **changes: Any) -> PseudoViews:
    return PseudoViews(data or frames(), [0, 1, 2], PseudoViewConfig(**changes), config().generator, seed)


def flat(item: Any) -> list[torch.Tensor]:
    """All tensors of an item."""
    return [item] if isinstance(item, torch.Tensor) else [value for part in item for value in flat(part)]


@pytest.mark.parametrize("changes", [{}, {"quality": "paper", "yaw_deg": (5.0, 35.0)}])
def test_an_item_is_its_number(changes: dict[str, Any]) -> None:
    first, second = items(**changes), items(**changes)
    for k in (3, 0, 17):
        torch.manual_seed(k)
        a, b = first[k], second[k]
        assert a.tokens == b.tokens
        assert all(torch.equal(x, y) for x, y in zip(flat(a[:-1]), flat(b[:-1]), strict=True))
    assert not torch.equal(items(**changes)[0].truth, items(seed=1, **changes)[0].truth)


@pytest.mark.parametrize("targets", [1, 2])
def test_shapes_and_ranges(targets: int) -> None:
    made = items(targets=targets)
    batch, (h, w) = collate([made[k] for k in range(6)]), SIZE
    shown, sources = batch.targets, batch.sources
    assert batch.truth.shape == batch.favs.shape == shown.images.shape == (6, targets, 3, h, w)
    assert sources.images.shape == (6, targets + 1, 3, h, w) and sources.known.shape == (6, targets + 1, h, w)
    assert shown.geometry.pose.shape == (6, targets, 16)
    for value in (batch.truth, batch.favs, shown.images, sources.images, shown.confidence):
        assert bool(torch.isfinite(value).all()) and float(value.min()) >= 0 and float(value.max()) <= 1
    assert bool((shown.confidence[~shown.known] == 0).all()) and bool((batch.favs.sum(2)[~shown.known] == 0).all())
    known = shown.known[:, :, None].expand_as(batch.truth)
    assert torch.equal(shown.images[known], batch.favs[known])
    assert bool(batch.holes.flatten(1).any(1).all()) and not bool((batch.holes & ~batch.valid).any())


def test_a_moved_view_has_holes_where_something_hides_the_scene_and_is_the_photograph_elsewhere() -> None:
    """What the pseudo cameras see is known from the true depth at both places."""
    size = (64, 112)
    drive = SyntheticDrive(demo_source_rig(size), num_frames=3, seed=5)
    move = {**STILL, "lateral_m": (1.0, 1.0), "height_m": (0.4, 0.4)}
    data = Frames(drive, size, ["0", "1", "2"])
    made = PseudoViews(data, [0, 1, 2], PseudoViewConfig(**move), replace(config().generator, image_size=size), 0)
    counts, errors = np.zeros((2, 2)), []
    for item in (made[k] for k in range(6)):
        frame, name, _ = item.tokens[0].split("/")
        index, rig = int(frame.rpartition("-")[2]), drive.rig
        moved = rig.shifted(0.0, 1.0, 0.4)
        camera, place = rig[name], rig.names.index(name)
        depth_m = drive.render(index).depth_m[place].numpy()
        points = camera.unproject(camera.pixel_grid()).directions
        scene = points / (points @ camera.cam2ego[:3, 2])[..., None] * depth_m[..., None] + camera.center_m
        visible, hidden = np.zeros(size, bool), np.isfinite(depth_m)
        for other, there_m in zip(moved, drive.render(index, moved).depth_m, strict=True):
            uv, z_m, in_front = other.project(np.where(np.isfinite(scene), scene, 1e6))
            x, y = (np.rint(uv[..., k]).astype(int) for k in (0, 1))
            inside = in_front & (x >= 1) & (x < size[1] - 1) & (y >= 1) & (y < size[0] - 1)
            near = there_m.numpy()[y.clip(0, size[0] - 1), x.clip(0, size[1] - 1)]
            visible |= inside & (np.abs(near - z_m) < 0.05 * z_m)
            hidden &= ~inside | (near < 0.8 * z_m)
        known = item.targets.known[0, 0].numpy()
        counts += [[known[visible].sum(), visible.sum()], [known[hidden].sum(), hidden.sum()]]
        errors.append((item.favs - item.truth)[0, 0, :, known & visible].square().mean())
    assert counts[0, 0] > 0.9 * counts[0, 1] and counts[1, 0] < 0.2 * counts[1, 1] and counts[1, 1] > 500
    assert -10 * np.log10(np.mean(errors)) > 28


def places(item: Batch, made: PseudoViews) -> list[tuple[int, int]]:
    """Frame and camera of an item's real views."""
    views = {(k, i): image for k in made.indices for i, image in enumerate(made.frames[k].images)}
    return [at for true in item.truth[0] for at, image in views.items() if torch.equal(true, image.float() / 255)]


@pytest.mark.parametrize("targets", [1, 2])
def test_the_answer_is_shown_nowhere(targets: int) -> None:
    """Another content of the holes of the real views changes neither the condition nor the source branches."""
    made = items(targets=targets, **{**STILL, "yaw_deg": (6.0, 6.0), "focal_scale": (2.0, 2.0)})
    plain = made[2]
    for (index, place), hole in zip(places(plain, made), plain.holes[0], strict=True):
        inner = -torch.nn.functional.max_pool2d(-hole[None].float(), 5, 1, 2)[0] > 0  # renderers interpolate
        image = made.frames[index].images[place]
        image[:, inner] = 255 - image[:, inner]
        assert bool(inner.any())
    changed = made[2]
    assert not torch.equal(plain.truth, changed.truth)
    assert torch.equal(plain.targets.images, changed.targets.images)
    assert torch.equal(plain.sources.images, changed.sources.images)


@pytest.mark.parametrize("k", range(3))
def test_views_read_nothing_where_a_branch_shows_nothing(k: int) -> None:
    item = items(focal_scale=(0.5, 0.5))[k]
    neighbour, centre, valid = item.targets.geometry.reads[0]
    _, query, slot, *_ = at = valid.nonzero(as_tuple=True)
    x, y = centre[at].round().long().unbind(-1)
    seen = item.sources.known[0, neighbour[0, query, slot], y.clamp(max=SIZE[0] - 1), x.clamp(max=SIZE[1] - 1)]
    assert len(seen) > 100 and bool(seen.all()) and not bool(item.sources.known.all())


def test_several_targets_are_neighbours_that_read_each_other() -> None:
    made = items(targets=2)
    batch = collate([made[k] for k in range(6)])
    for k in range(6):
        one, other = places(made[k], made)
        assert one[0] == other[0] and (one[1] - other[1]) % 6 in (1, 5)
    finest = batch.targets.geometry.reads[0]
    of_targets = finest.neighbour >= 3  # three sources, then the two targets
    assert bool((of_targets & finest.valid.flatten(3).any(3)).flatten(1).any(1).float().mean() > 0.5)
    # Further targets change nothing of the first.
    assert torch.equal(items()[0].targets.images[0, 0], batch.targets.images[0, 0])


def test_frames_with_fewer_cameras_than_others_are_named() -> None:
    made, narrow = items(targets=2), items(targets=2)
    for index in narrow.indices:
        frame = narrow.frames[index]
        single = replace(frame, images=frame.images[:1], rig=frame.rig.with_cameras([frame.rig[0]]))
        narrow.frames._cache._values[index] = single
    with pytest.raises(TrainingError, match=r"frame frame \d.*: expected 3 pseudo views as in others, got 1: train"):
        collate([made[0], narrow[1]])


class Traffic(Pictures):
    """A box 6 m ahead of each camera, with a velocity or with a place in the next frame; masks of the own car."""

    def __init__(self, speed_mps: float, moved_m: float) -> None:
        super().__init__(1)
        self.speed_mps, self.moved_m = speed_mps, moved_m
        own_car = np.ones(self.rig[0].size, bool)
        own_car[-6:] = False
        self.rig = self.rig.with_cameras([replace(camera, mask=own_car) for camera in self.rig])

    def __getitem__(self, index: int) -> dict[str, Any]:
        centre = [camera.center_m + 6 * camera.cam2ego[:3, 2] for camera in self.rig]
        boxes = torch.tensor([[*place, 1.0, 1.0, 1.0, 0.0, self.speed_mps, 0.0] for place in centre])
        sample = super().__getitem__(index) | {"boxes_3d": boxes, "ego2world": torch.eye(4).double(), "time_s": 0.0}
        later = {**sample, "boxes_3d": boxes + torch.tensor([self.moved_m, *[0.0] * 8]), "time_s": 0.5}
        later["ego2world"] = torch.eye(4).double()
        later["ego2world"][0, 3] = 2.0
        later["boxes_3d"][:, 0] -= 2.0
        return sample | {"neighbours": [later]}


@pytest.mark.parametrize(
    ("speed_mps", "moved_m", "counts"),
    [(0.0, 0.0, True), (5.0, 0.0, False), (float("nan"), 0.0, True), (0.0, 2.5, False)],
)
def test_what_moves_and_the_own_car_do_not_count(speed_mps: float, moved_m: float, counts: bool) -> None:
    item = PseudoViews(
        Frames(Traffic(speed_mps, moved_m), SIZE, ["0"]), [0], PseudoViewConfig(), config().generator, 0
    )[0]
    valid = item.valid[0, 0]
    assert bool(valid[SIZE[0] // 2, SIZE[1] // 2]) is counts and bool(valid[2, 2])
    assert not bool(valid[-1].any()) and not bool((item.holes & ~item.valid).any())


def test_paper_is_the_published_way() -> None:
    """Pair and condition are those of ``quality="paper"``: turned aside, never moved, and rendered back."""
    made = PseudoViews(frames(), [0, 1, 2], PAPER, config().generator, 0)
    item, k = made[1], 1
    (place,) = places(item, made)
    frame = made.frames[place[0]]
    target = frame.rig[place[1]]
    rng, pair = seeded(0, "pair", k), []
    for name, side in (("left", 1), ("right", -1)):
        around = RandomRig(Rig([target]), **PAPER.ranges)
        draws = around.draw(rng)
        pair.append(replace(around.rig({**draws, "yaw_deg": side * draws["yaw_deg"]})[0], name=name))
        turn = np.degrees(np.arccos(pair[-1].cam2ego[:3, 2] @ target.cam2ego[:3, 2]))
        assert np.allclose(pair[-1].center_m, target.center_m) and 4 < turn < 37
    sample = {"images": torch.stack(frame.images), "rig": frame.rig}
    there = RigRetarget(Rig(pair), quality="paper", holes="black")(sample)
    images = there["images"].float() / 255
    assert torch.equal(item.sources.images[0], images) and torch.equal(item.sources.known[0], there["coverage"])
    masked = [replace(c, mask=seen.numpy()) for c, seen in zip(pair, there["coverage"], strict=True)]
    back = RigRetarget(Rig([target]), quality="paper", holes="black")({"images": images, "rig": Rig(masked)})
    known = item.targets.known
    assert torch.equal(item.favs[0], back["images"]) and torch.equal(known[0], back["coverage"])
    assert torch.equal(item.targets.confidence, known.float()) and 0 < float(known.float().mean()) < 1
