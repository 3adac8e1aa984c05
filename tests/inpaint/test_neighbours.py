"""Filling holes from neighbouring frames: with real pixels, without repainting, and not beside moved objects."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, SampleKeys
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SceneClass, SyntheticDrive, demo_source_rig
from arbiview_aug.inpaint.merging import Candidate, merged
from arbiview_aug.sample.neighbours import ChangeRisk
from arbiview_aug.transforms.renderers import Explanation

RIG = demo_source_rig((96, 256))


def low() -> Rig:
    return RIG.turned(pitch_deg=-12)


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return SyntheticDrive(RIG, num_frames=8, seed=5, neighbours=Neighbours(count=2, step_m=1.5))


@pytest.fixture(scope="module")
def sample(drive: SyntheticDrive) -> dict[str, Any]:
    """Neighbours without points, which would change what the surface is made of."""
    sample = drive[1]
    return sample | {"neighbours": [{key: n[key] for key in n if key != "points"} for n in sample["neighbours"]]}


@pytest.fixture(scope="module")
def filled(sample: dict[str, Any]) -> dict[str, Any]:
    return RigRetarget(low(), keys=SampleKeys(extra=("source_frame", "source_camera", "confidence")))(sample)


@pytest.fixture(scope="module")
def alone(sample: dict[str, Any]) -> dict[str, Any]:
    return RigRetarget(low(), neighbours=None, keys=SampleKeys(extra=("source_frame", "source_camera", "confidence")))(
        sample
    )


def test_the_current_frame_is_never_repainted(filled: dict[str, Any], alone: dict[str, Any]) -> None:
    seen = alone["coverage"]
    assert (filled["coverage"] | ~seen).all()
    for key in ("images", "source_camera", "source_frame"):
        now, before = filled[key], alone[key]
        same = (now == before).all(1) if key == "images" else now == before
        assert same[seen].all(), key


def test_outputs_name_the_sources_of_pixels(filled: dict[str, Any], alone: dict[str, Any]) -> None:
    gained = filled["coverage"] & ~alone["coverage"]
    assert gained.float().mean() > 0.05
    assert ((filled["source_frame"] > 0) == gained).all() and int(filled["source_frame"].max()) <= 4
    assert (filled["source_frame"][~filled["coverage"]] == -1).all()
    assert (filled["source_camera"][gained] >= 0).all() and (filled["confidence"][gained] > 0).all()
    assert torch.equal(filled["generated"], ~filled["coverage"])
    assert "neighbours" not in filled


def test_filled_pixels_are_the_roads(drive: SyntheticDrive, filled: dict[str, Any]) -> None:
    truth = drive.render(1, low())
    there = filled["source_frame"] > 0
    road = there & ((truth.classes == SceneClass.GROUND) | (truth.classes == SceneClass.SIDEWALK))
    assert road.sum() > 0.98 * there.sum()
    error = (filled["images"].float() - truth.images.float()).square().mean(1)[there].mean()
    assert 10 * np.log10(255**2 / float(error)) > 27


def test_both_executions_fill_alike(sample: dict[str, Any], filled: dict[str, Any]) -> None:
    out = RigRetarget(low(), backend="torch", keys=SampleKeys(extra=("source_frame",)))(sample)
    same = out["source_frame"] == filled["source_frame"]
    assert same.float().mean() > 0.999
    off = (out["images"].int() - filled["images"].int()).abs().amax(1)[same]
    assert float((off > 2).float().mean()) < 1e-3


@pytest.mark.slow
def test_floats_fill_as_bytes_do(sample: dict[str, Any], filled: dict[str, Any]) -> None:
    floats = sample | {"images": sample["images"].float() / 255}
    floats["neighbours"] = [n | {"images": n["images"].float() / 255} for n in sample["neighbours"]]
    out = RigRetarget(low())(floats)
    assert (out["coverage"] == filled["coverage"]).float().mean() > 0.999
    assert (255 * out["images"] - filled["images"]).abs().mean() < 0.5


@pytest.mark.slow
def test_gradients_reach_the_current_images(sample: dict[str, Any]) -> None:
    images = (sample["images"].float() / 255).requires_grad_()
    near = [n | {"images": n["images"].float() / 255} for n in sample["neighbours"]]
    out = RigRetarget(low())(sample | {"images": images, "neighbours": near})
    out["images"].sum().backward()
    assert images.grad is not None and images.grad.isfinite().all() and images.grad.abs().sum() > 0


def test_explain_lists_each_neighbour(sample: dict[str, Any], alone: dict[str, Any], filled: dict[str, Any]) -> None:
    explanation = RigRetarget(low()).explain(sample)
    assert isinstance(explanation, Explanation) and explanation.fills is not None
    shares, _ = explanation.fills.shares(explanation.plan)
    gained = (filled["coverage"] & ~alone["coverage"]).double().mean((1, 2)).tolist()
    assert all(up_to >= share for up_to, share in zip(shares, gained, strict=True)) and sum(shares) < 1.3 * sum(gained)
    assert str(explanation).count("m of travel: ") == 4 and "more by other frames of the drive" in str(explanation)
    assert "more by other frames" not in str(RigRetarget(low(), neighbours=None).explain(sample))


@pytest.mark.slow
def test_a_labelled_object_is_not_read(sample: dict[str, Any], alone: dict[str, Any]) -> None:
    """Boxes over the whole road that a neighbour sees leave little to fill with."""
    wall = torch.tensor([[-8.0, 0.0, 1.0, 6.0, 40.0, 2.0, 0.0], [9.0, 0.0, 1.0, 6.0, 40.0, 2.0, 0.0]])
    everywhere = [
        n | {"boxes_3d": torch.cat([wall, wall + torch.tensor([0, 9, 0, 0, 0, 0, 1.57])])} for n in sample["neighbours"]
    ]
    out = RigRetarget(low())(sample | {"neighbours": everywhere})
    gained = (out["coverage"] & ~alone["coverage"]).float().mean()
    plain = (RigRetarget(low())(sample)["coverage"] & ~alone["coverage"]).float().mean()
    assert gained < 0.4 * plain


@pytest.mark.slow
def test_all_fills_more_than_the_ground(sample: dict[str, Any], filled: dict[str, Any]) -> None:
    out = RigRetarget(RIG.turned(yaw_deg=3, pitch_deg=6), neighbours="all")(sample)
    ground = RigRetarget(RIG.turned(yaw_deg=3, pitch_deg=6))(sample)
    assert out["coverage"].float().mean() >= ground["coverage"].float().mean()
    with pytest.raises(ValueError, match="neighbours: expected one of road, all"):
        RigRetarget(RIG, neighbours="sky")


# --- the merge --------------------------------------------------------------------------------------------------------
H, W = 24, 40
FREE, SEAM = np.zeros((H, W), bool), np.zeros((H, W), bool)
FREE[8:] = SEAM[4:8] = True
ROAD = torch.full((3, H, W), 90, dtype=torch.uint8)
HOLE = torch.where(torch.from_numpy(FREE), 0, ROAD)


def candidate(
    level: int,
    blur: int = 0,
    risk: ChangeRisk = ChangeRisk.UNLABELLED,
    later: bool = False,
    shows: np.ndarray | None = None,
) -> Candidate:
    whole = np.ones((H, W), bool) if shows is None else shows
    image = torch.full((3, H, W), level, dtype=torch.uint8)
    return Candidate(whole, *(np.full((H, W), n, np.uint8) for n in (blur, risk)), later, image)


def test_exposure_follows_the_seam() -> None:
    pixels, chosen = merged(HOLE, FREE, SEAM, [candidate(98)], 2)
    assert (chosen[FREE] == 0).all() and (pixels[:, FREE].int() - 90).abs().max() <= 1
    assert torch.equal(pixels[:, ~FREE], HOLE[:, ~FREE])


def passing(level: int, risk: ChangeRisk = ChangeRisk.UNLABELLED, later: bool = False) -> Candidate:
    """The road at the seam, something else farther in."""
    one = candidate(90, risk=risk, later=later)
    one.image[:, 12:] = level
    return one


def hidden(risk: ChangeRisk) -> Candidate:
    """A neighbour that does not see the hole."""
    return candidate(90, risk=risk, shows=np.zeros((H, W), bool))


INSIDE, FARTHER = slice(8, None), slice(16, None)
LORRY = [passing(200), passing(200), passing(200, later=True)]
DECIDED: dict[str, tuple[Callable[[ChangeRisk], list[Candidate]], slice, Callable[[ChangeRisk], int]]] = {
    "the sharper": (lambda _: [candidate(90, blur=3), candidate(91, blur=1)], INSIDE, lambda _: 1),
    "the first of two alike": (lambda _: [candidate(90, blur=1), candidate(91, blur=1)], INSIDE, lambda _: 0),
    "near the seam": (lambda r: [passing(200, r), candidate(90, risk=r)], slice(8, 10), lambda _: 0),
    "a contradiction": (lambda r: [passing(200, r), candidate(90, risk=r)], FARTHER, lambda _: -1),
    "a majority, with labels": (
        lambda r: [passing(200, r), candidate(90, risk=r), candidate(92, risk=r)], FARTHER,
        lambda r: 1 if r == ChangeRisk.NONE else -1,
    ),
    "one of three, unless something moved beside it": (
        lambda r: [candidate(90, risk=r), hidden(r), hidden(r)], INSIDE,
        lambda r: 0 if r <= ChangeRisk.SHADED else -1,
    ),
    "one of two": (lambda r: [candidate(90, risk=r), hidden(r)], INSIDE, lambda _: 0),
    "two of one side": (lambda r: [passing(200), passing(200), hidden(ChangeRisk.UNLABELLED)], FARTHER, lambda _: -1),
    "three of one side": (lambda _: [passing(200)] * 3, FARTHER, lambda _: 0),
    "before and after, whatever farther frames show": (
        lambda _: [candidate(90), candidate(90, later=True), *LORRY], FARTHER, lambda _: 0,
    ),
    "a lorry during most of them": (
        lambda _: [candidate(90), *LORRY, candidate(90, later=True)], FARTHER, lambda _: -1,
    ),
}  # fmt: skip
"""Candidates by the risk that something changed there, rows of the hole, and the candidate taken; -1 for none."""


@pytest.mark.parametrize("case", DECIDED)
def test_the_neighbour_that_fills(case: str) -> None:
    make, rows, expected = DECIDED[case]
    for risk in ChangeRisk:
        _, chosen = merged(HOLE, FREE, SEAM, make(risk), 2)
        assert (chosen[rows] == expected(risk)).all(), risk


def test_an_arrived_object_continues_into_the_hole() -> None:
    view = HOLE.clone()
    view[:, 4:8, :16] = 200
    for risk in ChangeRisk:
        several = [candidate(90, risk=risk), candidate(90, risk=risk, later=True)]
        _, chosen = merged(view, FREE, SEAM, several, 2)
        assert (chosen[8:12, 24:] == 0).all()
        assert (chosen[8:, :14] == (-1 if risk == ChangeRisk.UNLABELLED else 0)).all()


def test_an_implausible_exposure_is_rejected() -> None:
    """An object at the seam of one neighbour does not recolour the road."""
    blue = candidate(90, risk=ChangeRisk.NONE)
    blue.image[:, :8] = torch.tensor([20, 40, 100], dtype=torch.uint8)[:, None, None]
    pixels, _ = merged(HOLE, FREE, SEAM, [blue], 2)
    assert (pixels[:, FREE] == 90).all()


def test_a_neighbour_without_a_seam_takes_the_exposure_of_others() -> None:
    """A camera twice as bright sees the far half of the hole alone, and overlaps another one."""
    near, far = np.ones((H, W), bool), np.zeros((H, W), bool)
    near[18:], far[10:] = False, True
    several = [candidate(90, risk=ChangeRisk.NONE, shows=near), candidate(180, risk=ChangeRisk.NONE, shows=far)]
    pixels, chosen = merged(HOLE, FREE, SEAM, several, 2)
    assert (chosen[18:] == 1).all() and (pixels[:, FREE].int() - 90).abs().max() <= 1


@pytest.mark.slow
def test_labels_stand_in_holes_where_nothing_else_needs_geometry() -> None:
    """One camera that turns: no pixel of its own depends on labels, but what the neighbour may fill does."""
    rig = RIG.with_cameras([RIG[0]])
    drive = SyntheticDrive(rig, num_frames=1, seed=5, lidar=False, neighbours=Neighbours(count=2, step_m=4))
    target = rig.turned(yaw_deg=-45)
    sample = drive[0]
    ahead = torch.tensor([[7.0, -5.0, 0.9, 4.5, 2.0, 1.8, 0.0]])  # in the hole, on the road that a neighbour shows
    sample |= {"boxes_3d": ahead, "neighbours": [dict(one) | {"boxes_3d": ahead[:0]} for one in sample["neighbours"]]}
    by_auto, by_boxes = (
        RigRetarget(target, geometry=surface, keys=SampleKeys(extra=("source_frame",)))(sample)
        for surface in ("auto", "boxes")
    )
    empty = RigRetarget(target, geometry="boxes", keys=SampleKeys(extra=("source_frame",)))(
        sample | {"boxes_3d": ahead[:0]}
    )
    assert torch.equal(by_auto["source_frame"], by_boxes["source_frame"])
    assert (empty["source_frame"] > 0).sum() > (by_auto["source_frame"] > 0).sum() > 0
