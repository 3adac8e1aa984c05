"""Pixels that no source sees: filled by default, marked, and never mistaken for what was seen."""

from __future__ import annotations

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import default_collate

from arbiview_aug import Camera, Rig, RigRetarget, SampleError, SampleKeys
from arbiview_aug.errors import GeneratorError
from arbiview_aug.inpaint import continued as holes_module
from arbiview_aug.inpaint.continued import Continue, Mean, fill_holes, object_colours
from arbiview_aug.inpaint.inpainter import Inpainter, Telea
from arbiview_aug.render.paint_kernels import find_paint
from arbiview_aug.render.plan import OBJECT, OCCLUDED, HoleContents, Paint
from arbiview_aug.render.rendered import Views
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.scene.boxes import PARTS, TOP_PART
from tests.helpers import camera, ring, street_sample

SETTINGS = ("continue", "mean", "black")
MAPS = ("source_camera", "source_frame", "confidence")


@pytest.fixture(scope="module")
def street() -> dict[str, Any]:
    return street_sample()


def raised(sample: dict[str, Any]) -> Rig:
    """Cameras from which roofs, and the road behind cars, come into view."""
    return sample["rig"].shifted(z_m=0.7)


def gradient(height: int, width: int) -> torch.Tensor:
    """(1, 3, h, w) uint8, brighter from row to row."""
    rows = torch.linspace(40, 200, height).round().to(torch.uint8)
    return rows[:, None].expand(1, 3, height, width).contiguous()


def fill_hole(
    view: torch.Tensor, seen: torch.Tensor, seen_by: Camera | None = None, **plan: np.ndarray | Paint
) -> torch.Tensor:
    """A view with its hole filled by what is known of it: ``HoleContents``."""
    rig = Rig([camera(size=tuple(seen.shape)) if seen_by is None else seen_by])
    contents: Any = plan
    (out,) = fill_holes(Views([view * seen], rig, [seen], holes=[HoleContents(**contents)]))
    return out


# --- what is filled, and how ------------------------------------------------------------------------------------------
@pytest.mark.parametrize("execution", ["opencv", "torch"])
@pytest.mark.parametrize("dtype", [torch.uint8, torch.float32, torch.float16, torch.bfloat16])
def test_only_holes_differ_and_they_are_marked(street: dict[str, Any], dtype: torch.dtype, execution: str) -> None:
    images = street["images"] if dtype == torch.uint8 else (street["images"].float() / 255).to(dtype)
    outs = {
        how: RigRetarget(raised(street), geometry="boxes", holes=how, keys=SampleKeys(extra=MAPS), backend=execution)(  # type: ignore[arg-type]
            street | {"images": images}
        )
        for how in SETTINGS
    }
    black = outs["black"]
    hole = ~black["coverage"]
    pixels = hole[:, None].expand_as(images)
    assert hole.any(dim=(1, 2)).all() and not black["images"][pixels].any() and "generated" not in black
    for how in ("continue", "mean"):
        out = outs[how]
        assert torch.equal(out["generated"], hole) and out["images"].dtype == dtype
        assert torch.equal(out["images"][~pixels], black["images"][~pixels])
        for key in ("coverage", *MAPS):
            assert torch.equal(out[key], black[key])
        assert (out["source_camera"][hole] == -1).all() and not out["confidence"][hole].any()
    filled = outs["mean"]["images"].movedim(1, -1)[hole].float()
    assert (filled == filled[0]).all()
    expected = black["images"].movedim(1, -1)[~hole].float().mean(0)
    assert (filled[0] - expected).abs().max() < (1.5 if dtype == torch.uint8 else 0.01)
    assert outs["continue"]["images"][pixels].float().std() > 0


@pytest.mark.slow
def test_filled_holes_are_nearer_to_the_truth_than_black_ones() -> None:
    from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig

    errors = dict.fromkeys(SETTINGS, 0.0)
    for seed in range(3):
        drive = SyntheticDrive(demo_source_rig((64, 176)), num_frames=1, seed=seed)
        sample = drive[0]
        target = raised(sample)
        truth = drive.render(0, target).images
        assert isinstance(truth, torch.Tensor)
        for how in SETTINGS:
            out = RigRetarget(target, geometry="boxes", holes=how)(sample)  # type: ignore[arg-type]
            hole = ~out["coverage"][:, None].expand_as(truth)
            errors[how] += float((out["images"].float() - truth.float())[hole].square().mean())
    assert errors["continue"] < 0.6 * errors["mean"] < 0.6 * errors["black"]


def test_holes_have_the_detail_of_their_border_but_not_that_of_objects() -> None:
    """Rows alternate in brightness, at a tenth of a cell's side; an object to the right of a hole is black."""
    view = torch.full((3, 640, 640), 40, dtype=torch.uint8)
    view[:, ::2] = 200
    seen, layers = torch.ones(640, 640, dtype=torch.bool), np.zeros((640, 640), np.uint8)
    seen[:, 300:310], layers[:, 310:340] = False, OBJECT
    view[:, :, 310:340] = 0
    out = fill_hole(view, seen, layers=layers)
    contrast = out[0, ::2].float().mean(0) - out[0, 1::2].float().mean(0)
    assert contrast[300] > 100 and contrast[309] > 30 and (contrast[301:310] < contrast[300:309]).all()
    assert out[0, :, 300:310].float().mean(0).sub(120).abs().max() < 2 and torch.equal(out[:, seen], view[:, seen])


def test_beyond_the_sources_views_columns_go_on_and_fade() -> None:
    source = Rig([camera(size=(64, 64))])
    upwards = source.turned(pitch_deg=40)
    out = RigRetarget(upwards, holes="continue")({"images": gradient(64, 64), "rig": source})
    image, seen = out["images"][0].float(), out["coverage"][0]
    column = seen[:, 32]
    border = int(column.nonzero().min())
    assert 24 < border < 64 and not column[:border].any()
    at_border, mean = image[:, border, 32].mean(), out["images"][0][:, seen].float().mean()
    beside, far = (image[:, rows, 32].mean() for rows in (slice(border - 3, border), slice(0, 3)))
    assert abs(beside - at_border) < 15 < abs(mean - at_border)
    assert abs(beside - at_border) < abs(far - at_border) <= abs(mean - at_border) + 1


def test_what_the_own_car_hides_is_continued() -> None:
    hood = np.ones((64, 64), bool)
    hood[44:, 10:54] = False
    source = Rig([replace(camera(size=(64, 64)), mask=hood)])
    target = Rig([camera(size=(64, 64))])
    for quality in ("fast", "paper"):
        out = RigRetarget(target, quality=quality)({"images": gradient(64, 64), "rig": source})  # type: ignore[arg-type]
        hidden = ~torch.from_numpy(hood)
        assert torch.equal(out["generated"][0], hidden)
        mean = out["images"][0][:, ~hidden].float().mean()
        filled = out["images"][0][:, hidden].float()
        assert filled.min() > mean + 20  # the road around it, not the frame's mean colour


# --- the transform ----------------------------------------------------------------------------------------------------
def test_a_whole_target_asks_for_no_filling(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(holes_module, "object_colours", None)
    source = ring()
    assert all(view.holes == HoleContents() for view in build_plan(source, source).targets)
    images = torch.randint(0, 255, (6, 3, 72, 96), dtype=torch.uint8)
    out = RigRetarget(source)({"images": images, "rig": source})
    assert out["coverage"].all() and not out["generated"].any() and torch.equal(out["images"], images)


@pytest.mark.parametrize("how", SETTINGS)
def test_skipped_samples_collate_and_have_nothing_made_up(street: dict[str, Any], how: Any) -> None:
    retarget = RigRetarget(raised(street), geometry="street", size=(48, 132), p=0.5, holes=how)
    outs = [retarget(street, params={"skipped": skipped}) for skipped in (0.0, 1.0)]
    for out in outs:
        out.pop("retarget_params")
    assert list(outs[0]) == list(outs[1]) and ("generated" in outs[0]) == (how != "black")
    if how != "black":
        assert outs[0]["generated"].any() and not outs[1]["generated"].any()
        default_collate([{key: out[key] for key in ("images", "coverage", "generated")} for out in outs])


def test_gradients_of_seen_pixels_stay() -> None:
    source = Rig([camera(size=(64, 64))])
    images = (gradient(64, 64).float() / 255).requires_grad_()
    target = source.turned(yaw_deg=30)
    out = RigRetarget(target)({"images": images, "rig": source})
    gradients = []
    for how in ("continue", "telea", "black"):
        out = RigRetarget(target, holes=how)({"images": images, "rig": source})  # type: ignore[arg-type]
        weights = torch.arange(out["images"].numel()).reshape(out["images"].shape) % 7
        gradients.append(torch.autograd.grad((out["images"] * weights).sum(), images)[0])
    assert gradients[0].any() and torch.equal(gradients[0], gradients[2]) and torch.equal(gradients[1], gradients[2])


def test_made_up_pixels_are_never_sources(street: dict[str, Any]) -> None:
    first = RigRetarget(raised(street), geometry="street")(street)
    other = dict(first) | {"images": torch.where(first["generated"][:, None], 255, first["images"])}
    back = RigRetarget(street["rig"], geometry="street", holes="black")
    assert torch.equal(back(first)["images"], back(other)["images"]) and "generated" not in back(first)


# --- the functions ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(1, 1), (1, 9), (5, 3), (70, 131), (257, 129)])
def test_any_size_and_any_hole_is_filled(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(0)
    for share in (0.0, 0.01, 0.5, 0.99, 1.0):
        seen = torch.from_numpy(rng.random(size) < share)
        view = torch.full((3, *size), 77, dtype=torch.uint8) * seen
        layers = (~seen).numpy().view(np.uint8), rng.integers(0, 3, size, np.uint8)
        for plan in ({}, *({"layers": of_view} for of_view in layers)):
            out = fill_hole(view, seen, **plan)
            assert (out[:, ~seen] == (77 if seen.any() else 128)).all() and (out[:, seen] == 77).all()


# --- objects and what they hide ---------------------------------------------------------------------------------------
def test_the_nearer_side_is_never_smeared_into_what_it_hides() -> None:
    view = torch.full((3, 64, 96), 120, dtype=torch.uint8)
    view[:, 30:, 20:70] = torch.tensor([255, 0, 0], dtype=torch.uint8)[:, None, None]
    layers = np.zeros((64, 96), np.uint8)
    layers[30:, 20:70], layers[10:30, 20:70] = OBJECT, OCCLUDED
    seen = torch.from_numpy(layers != OCCLUDED)
    out = fill_hole(view, seen, layers=layers)
    assert torch.equal(out[:, seen], view[:, seen]) and ((out[:, ~seen].int() - 120).abs() <= 1).all()


# --- lines of the scene -----------------------------------------------------------------------------------------------
def striped_road(viewpoint: Camera) -> tuple[torch.Tensor, np.ndarray]:
    """A grey view with a white lane mark 0.8 m to 1.6 m left of the heading; and the pixels that see the road."""
    rays = viewpoint.unproject(viewpoint.pixel_grid()).directions
    down = rays[..., 2] < -0.02
    left_m = rays[..., 1] / np.where(down, -rays[..., 2], 1) * viewpoint.center_m[2] + viewpoint.center_m[1]
    view = np.where(down & (left_m > 0.8) & (left_m < 1.6), 220, 90).astype(np.uint8)
    return torch.from_numpy(np.stack([view] * 3)), down


@pytest.mark.parametrize(("lens", "distortion"), [("pinhole", ()), ("fisheye", (-0.02, 0.003, 0.0, 0.0))])
def test_lane_marks_go_on_along_the_heading(lens: str, distortion: tuple[float, ...]) -> None:
    viewpoint = camera(size=(128, 160), lens=lens, distortion=distortion)
    view, _ = striped_road(viewpoint)
    seen = torch.ones((128, 160), dtype=torch.bool)
    seen[104:] = False
    truth = view[0, 104:].float()
    out = fill_hole(view, seen, viewpoint)
    columns = fill_hole(view, seen, viewpoint, road=np.zeros((33, 41), bool))
    errors = [(filled[0, 104:].float() - truth).square().mean() for filled in (out, columns)]
    assert (truth > 200).any() and errors[0] < errors[1] / 3


def test_posts_go_on_vertically_and_joints_of_the_road_along_the_heading() -> None:
    viewpoint = camera(size=(64, 64))
    view = torch.full((3, 64, 64), 100, dtype=torch.uint8)
    view[:, :, 44:48] = 200
    seen = torch.ones((64, 64), dtype=torch.bool)
    seen[56:] = False
    nodes = np.zeros((17, 17), bool)
    wall, road = (fill_hole(view, seen, viewpoint, road=on_road) for on_road in (nodes, ~nodes))
    # The lines of the road start at the middle of the image: that through (45.5, 55.5) is at 49.8 in the row 62.5.
    assert wall[0, 62, 45] > wall[0, 62, 50] + 20 and road[0, 62, 50] > road[0, 62, 45] + 20


def test_batches_without_a_plan_are_filled(street: dict[str, Any]) -> None:
    keys = SampleKeys(extra=("sources", "confidence"))
    batch = default_collate([RigRetarget(raised(street), holes="black", keys=keys)(street)])
    black = batch["images"].clone()
    done = Continue().complete_batch(batch)
    assert torch.equal(batch["images"], black), "the batch itself is not written to"
    hole = ~done["coverage"]
    assert torch.equal(done["generated"], hole) and hole.any()
    assert torch.equal(done["images"].movedim(2, -1)[~hole], black.movedim(2, -1)[~hole])
    assert (done["images"].movedim(2, -1)[hole].float().mean(-1) > 0).float().mean() > 0.99


@pytest.mark.parametrize("holes", ["continue", "mean", "telea"])
def test_the_own_car_of_a_batch_is_neither_filled_nor_marked(street: dict[str, Any], holes: str) -> None:
    masks = [np.arange(camera.height_px)[:, None].repeat(camera.width_px, 1) < 20 for camera in street["rig"]]
    cameras = [replace(camera, mask=mask) for camera, mask in zip(raised(street), masks, strict=True)]
    keys = SampleKeys(extra=("sources", "confidence"))
    black = RigRetarget(Rig(cameras), holes="black", keys=keys)(street)
    inpainter = {"continue": Continue, "mean": Mean, "telea": Telea}[holes]()
    out = inpainter.complete_batch(black)
    own = out["ego_mask"] & ~out["coverage"]
    assert own.any() and not out["images"].movedim(1, -1)[own].any()
    assert torch.equal(out["generated"], ~out["coverage"] & ~own) and out["generated"].any()


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        ("coverage", torch.ones(3, 4, dtype=torch.bool), "coverage: frame 0: expected bool of the images' sizes"),
        ("coverage", torch.ones(3, 64, 96), "coverage: frame 0: expected bool"),
        ("confidence", "x", "confidence: frame 0: expected numbers of the images' sizes .*, got .*str"),
    ],
)
def test_maps_of_a_batch_that_are_not_its_views_are_refused(
    street: dict[str, Any], key: str, value: object, message: str
) -> None:
    keys = SampleKeys(extra=("sources", "confidence"))
    batch = RigRetarget(raised(street), holes="black", keys=keys)(street)
    with pytest.raises(SampleError, match=message):
        Continue().complete_batch({**batch, key: value})


class Painter(Inpainter):
    """Gives holes one value."""

    def __init__(self, value: float) -> None:
        self.value = value

    def inpaint(self, views: Any, holes: Any, seeds: Any) -> list[torch.Tensor]:
        return [torch.full_like(view, self.value) for view in views]


def test_what_an_inpainter_makes_is_finite_and_in_range(street: dict[str, Any]) -> None:
    sample = street | {"images": street["images"].float() / 255}
    out = RigRetarget(raised(street), holes=Painter(7.5))(sample)
    assert (out["images"].movedim(1, -1)[out["generated"]] == 1).all()
    with pytest.raises(GeneratorError, match=r"Painter\.inpaint: expected finite pixels"):
        RigRetarget(raised(street), holes=Painter(float("nan")))(sample)


def test_unlabelled_things_before_a_hole_are_found_by_their_distance() -> None:
    q = np.full((64, 64), 0.05, np.float32)
    q[:, 26:30] = 0.2  # a post, and the background that it hides to its right
    winner, layers = np.zeros((64, 64), np.int8), np.zeros((64, 64), np.uint8)
    winner[:, 30:33], layers[:, 30:33] = -1, OCCLUDED
    assert find_paint(q, np.zeros((0, 0), np.int32), FACE_PARTS, winner, 4, layers) is None
    assert (layers[:, 26:30] == OBJECT).all() and (layers[:, 30:33] == OCCLUDED).all()
    assert not layers[:, :26].any() and not layers[:, 33:].any()


FACE_PARTS = np.array([1, 2, 3, 4, 0, 5, 8, 9, 10, 11, 7, 12], np.int32)  # two boxes, whose last faces are tops
Seen = tuple[torch.Tensor, torch.Tensor, Paint]


def objects(*painted: tuple[Any, int, Any], hidden: Any = (), parts: np.ndarray = FACE_PARTS) -> Seen:
    """A view (3, 64, 64) of 200 with faces painted into places, what is seen of it, and its paint."""
    face, view = np.full((64, 64), -1, np.int32), torch.full((3, 64, 64), 200, dtype=torch.uint8)
    for place, number, colour in painted:
        face[place] = number
        view[(slice(None), *place)] = torch.tensor(np.broadcast_to(colour, 3).copy())[:, None, None]
    seen = np.ones(face.shape, bool)
    for place in hidden:
        seen[place] = False
    winner, layers = np.where(seen, 0, -1).astype(np.int8), np.zeros(face.shape, np.uint8)
    paint = find_paint(np.ones(face.shape, np.float32), face, parts, winner, 8, layers)
    assert paint is not None and ((layers == OBJECT) == (face >= 0)).all()
    return view * torch.from_numpy(seen), torch.from_numpy(seen), paint


def filled(view: torch.Tensor, seen: torch.Tensor, paint: Paint, layer: int = OBJECT) -> torch.Tensor:
    """The view, all of whose pixels are objects, or whose unseen ones are of another layer."""
    return fill_hole(view, seen, layers=np.where(seen | (layer == OBJECT), OBJECT, layer).astype(np.uint8), paint=paint)


BOX, TOP = np.s_[20:50, 4:28], np.s_[10:20, 4:28]
OTHER, OTHERS_TOP, WINDOWS = np.s_[20:50, 36:60], np.s_[10:20, 36:60], np.s_[22:32, 36:60]
TWO = [
    (TOP, 5, 80),
    (BOX, 0, 40),
    (OTHERS_TOP, 11, 150),
    (OTHER, 6, 100),
    (WINDOWS, 6, 30),
    (np.s_[10:20, 53:54], 11, 10),
]
"""The first box shows its top (80 on 40); the second has windows (30 in 100), and a column of its top mixes colours."""

ROOF = [(np.s_[20:35, 36:60], 10, 30), (np.s_[35:50, 36:60], 6, (160, 60, 60))]  # a cabin, and a red body
CABIN, SIDE, RED = np.s_[10:30, 4:60], np.s_[30:50, 4:60], (180, 50, 10)
TOP_OF_OTHER = PARTS + TOP_PART


@pytest.mark.parametrize(
    ("painted", "hidden", "expected"),
    [
        (TWO, [np.s_[10:20, 54:60]], {**dict.fromkeys(range(5), 40), **dict.fromkeys(range(PARTS, PARTS + 5), 100)}),
        (TWO, [TOP, OTHERS_TOP], {TOP_OF_OTHER: 100}),
        ([(OTHERS_TOP, 11, 9), (OTHER, 10, 100), (WINDOWS, 10, 30)], [OTHERS_TOP], {TOP_OF_OTHER: 100}),
        *[
            ([(OTHERS_TOP, 11, 9), *ROOF, (np.s_[20:23, 36:60], 10, rim)], [OTHERS_TOP], {TOP_OF_OTHER: roof})
            for rim, roof in [(30, ROOF[1][2]), (95, ROOF[1][2]), ((40, 160, 40),) * 2, (230, 230)]
        ],
        ([(CABIN, 4, 30), (SIDE, 0, 150)], [np.s_[:, 56:]], {0: 30, **dict.fromkeys(range(1, 5), 150)}),
        ([(CABIN, 4, (40, 60, 90)), (np.s_[12:20, 4:60], 4, RED), (SIDE, 0, 9)], [SIDE], {1: RED}),
        ([(np.s_[20:50, 10:54], 0, 60)], [np.s_[21:50, 10:54]], {1: 60}),
    ],
    ids=[
        "sides take the median of their body", "tops are as bright as their bodies where no top is seen",
        "all that is seen is a cabin", "glass up to the roof", "glass and body", "another paint", "a white roof",
        "cabins and bodies have separate colours", "a body takes the paint around the windows, no mixture",
        "one row remains",
    ],
)  # fmt: skip
def test_colours_of_objects(painted: Any, hidden: Any, expected: dict[int, Any]) -> None:
    parts = np.where(np.arange(12) == 10, PARTS, FACE_PARTS).astype(np.int32)
    view, _, paint = objects(*painted, hidden=hidden, parts=parts)
    colours = object_colours([view.numpy()], [paint])
    for part, colour in expected.items():
        np.testing.assert_allclose(colours[part], np.broadcast_to(colour, 3), atol=1e-2)


def test_unseen_sides_take_no_colour_of_what_stands_before_them() -> None:
    """A dark object before the side of a bright one, which is hidden to the right of it, below a seen cabin."""
    side, dark, cabin = (np.s_[20:50, 10:54], 0, 180), (np.s_[10:50, 26:30], 6, 10), (np.s_[10:20, 30:54], 4, 90)
    view, seen, paint = objects(side, dark, cabin, hidden=[np.s_[20:50, 30:54]])
    assert len(paint.pixel) == 30 * 24 and (paint.nearest == -1).all()
    assert (filled(view, seen, paint)[:, ~seen] == 180).all()


def test_objects_that_nobody_sees_are_background() -> None:
    behind = np.s_[20:50, 30:44]
    view, seen, paint = objects((np.s_[20:50, 10:30], 0, 10), (behind, 6, 9), hidden=[behind])
    layers = np.zeros(seen.shape, np.uint8)
    layers[20:50, 10:44] = OBJECT
    out = fill_hole(view, seen, layers=layers, paint=paint)
    assert (out[:, 22:48, 31:42].float() - 200).abs().max() <= 1


@pytest.mark.slow
def test_both_executions_and_types_fill_alike_with_held_plans(street: dict[str, Any]) -> None:
    as_float = street | {"images": street["images"].float() / 255}
    for surface in ("boxes", "lidar"):
        retarget = RigRetarget(raised(street), geometry=surface)  # type: ignore[arg-type]
        first = retarget(street)
        assert torch.equal(pickle.loads(pickle.dumps(retarget))(street)["images"], first["images"])
        assert torch.equal(retarget(street)["images"], first["images"])  # by the plan that is held
        of_torch = RigRetarget(raised(street), geometry=surface, backend="torch")(street)  # type: ignore[arg-type]
        filled = first["generated"]
        assert torch.equal(of_torch["generated"], filled)
        for other in (of_torch["images"].float(), 255 * retarget(as_float)["images"]):
            apart = (other - first["images"].float()).abs().amax(1)[filled]
            assert (apart > 1.5).float().mean() < 0.002
