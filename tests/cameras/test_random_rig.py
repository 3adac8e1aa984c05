"""Random rigs: what is drawn, how often, and that the numbers give the same rig again."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import Camera, RandomRig, Rig, SampleError, load_rig
from arbiview_aug.errors import SampleTypeError
from arbiview_aug.sample.inputs import read_frames
from tests.helpers import sample_of
from tests.mutations import nested

NEUTRAL = dict.fromkeys(("yaw_deg", "pitch_deg", "roll_deg", "height_m", "forward_m", "lateral_m"), 0.0)
NEUTRAL["focal_scale"] = 1.0


def test_half_widths_and_ranges() -> None:
    random_rig = RandomRig("waymo", yaw_deg=5, height_m=(0.5, 1.0), focal_scale=0.2, roll_deg=(2, 2))
    torch.manual_seed(0)
    draws = [random_rig.draw() for _ in range(500)]
    bounds = {"yaw_deg": (-5, 5), "height_m": (0.5, 1.0), "focal_scale": (0.8, 1.2)}
    for name, (low, high) in bounds.items():
        values = np.array([draw[name] for draw in draws])
        assert low <= values.min() < low + 0.1 * (high - low) and high - 0.1 * (high - low) < values.max() <= high
        assert abs(values.mean() - (low + high) / 2) < 0.05 * (high - low)
    assert {draw["roll_deg"] for draw in draws} == {2.0}
    assert {draw["pitch_deg"] for draw in draws} == {0.0}


@pytest.mark.parametrize("name", NEUTRAL)
def test_convention_each_parameter_does_what_its_name_says(name: str) -> None:
    """Turns are those of ``Rig.turned``, whose signs ``test_camera`` shows; x is forward, y left, z up."""
    base = load_rig("nuscenes")
    shifts = {"forward_m": base.shifted(x_m=1.5), "lateral_m": base.shifted(y_m=1.5), "height_m": base.shifted(z_m=1.5)}
    scale = [[1.5, 1.5, 1.0], [1.5, 1.5, 1.0], [1.0, 1.0, 1.0]]
    zoomed = base.with_cameras([replace(camera, K=camera.K * scale) for camera in base])
    expected = shifts.get(name) or (zoomed if name == "focal_scale" else base.turned(**{name: 1.5}))
    assert RandomRig(base).rig({**NEUTRAL, name: 1.5}) == expected != base


def test_masks_follow_turned_and_zoomed_cameras() -> None:
    mask = np.ones((100, 200), bool)
    mask[80:, 50:150] = False  # a block in the middle, of 30 rows and 100 columns from the principal point on
    usual = {"width_px": 200, "height_px": 100, "horizontal_fov_deg": 60.0}
    rig = Rig([Camera.looking(name=n, azimuth_deg=0, **usual, mask=m) for n, m in (("a", mask), ("b", None))])
    random_rig = RandomRig(rig)
    zoomed, without = random_rig.rig({**NEUTRAL, "focal_scale": 0.5, "height_m": 1.0})
    want = np.ones((100, 200), bool)
    want[65:75, 75:125] = False  # lower than 100 rows the base shows nothing
    np.testing.assert_array_equal(zoomed.mask, want)
    assert without.mask is None and random_rig.rig(NEUTRAL) == rig
    turned = random_rig.rig({**NEUTRAL, "yaw_deg": 5.0})[0]
    assert turned == rig[0].turned(yaw_deg=5.0) and (turned.mask != mask).any()


def test_numbers_are_plain_and_replay() -> None:
    random_rig = RandomRig("nuscenes", yaw_deg=10, pitch_deg=3, height_m=0.5, focal_scale=0.1)
    params = random_rig.draw()
    collated = {name: torch.tensor(value, dtype=torch.float64) for name, value in params.items()}
    for again in (json.loads(json.dumps(params)), collated):
        assert random_rig.rig(again) == random_rig.rig(params)


def test_draws_follow_torchs_seed_or_a_generator() -> None:
    random_rig = RandomRig("waymo", yaw_deg=10)
    torch.manual_seed(3)
    one, two = random_rig.draw(), random_rig.draw()
    torch.manual_seed(3)
    assert (random_rig.draw(), random_rig.draw()) == (one, two) and one != two
    state = torch.get_rng_state()
    assert random_rig.draw(torch.Generator().manual_seed(1)) == random_rig.draw(torch.Generator().manual_seed(1))
    assert torch.equal(torch.get_rng_state(), state)


def by_sequence(**settings: Any) -> RandomRig:
    return RandomRig("waymo", yaw_deg=10, per="sequence", **settings)


def draw_for(random_rig: RandomRig, sample: dict[str, Any], rng: torch.Generator | None = None) -> dict[str, float]:
    return random_rig.draw(random_rig.rng_for(sample, rng))


def test_one_draw_a_sequence() -> None:
    torch.manual_seed(0)
    random_rig = by_sequence()
    state = torch.get_rng_state()
    first = draw_for(random_rig, {"scene_token": "a"})
    assert draw_for(random_rig, {"scene_token": "a"}) == first != draw_for(random_rig, {"scene_token": "b"})
    assert torch.equal(torch.get_rng_state(), state)  # nothing else that is random changes
    assert draw_for(by_sequence(), {"scene_token": "a"}) == first  # the same in every worker of a seed
    torch.manual_seed(1)
    assert draw_for(random_rig, {"scene_token": "a"}) != first
    assert draw_for(by_sequence(sequence_key="drive"), {"drive": 7})
    generators = [torch.Generator().manual_seed(seed) for seed in (5, 5, 6)]
    five, again, six = (draw_for(random_rig, {"scene_token": "a"}, rng) for rng in generators)
    assert five == again != six


def test_batches_of_sequences() -> None:
    random_rig = by_sequence()
    assert draw_for(random_rig, {"scene_token": ["a", "a"]}) == draw_for(random_rig, {"scene_token": "a"})
    assert draw_for(random_rig, {"scene_token": [{"a": 1}] * 2})  # names need no hash
    expected, tensor = draw_for(random_rig, {"scene_token": 3}), torch.tensor
    for same in (tensor(3), tensor([3]), tensor([3, 3, 3]), np.array([3, 3]), [tensor(3), tensor(3)], [[3, 3], [3, 3]]):
        assert draw_for(random_rig, {"scene_token": same}) == expected, "however a name is collated"
    for other in (["a", "b"], tensor([3, 4]), [("a", "b"), ("a", "b")], np.array([3, 4])):
        with pytest.raises(SampleError, match="scene_token: expected one sequence a batch, got 2"):
            draw_for(random_rig, {"scene_token": other})
    for more in ({}, {"scene_token": None}, {"scene_token": ["a", None]}):
        with pytest.raises(SampleError, match=r"expected 'scene_token' in the sample, .*, got images, token"):
            draw_for(random_rig, {"images": 0, "token": 0} | more)


CIRCLE: list[Any] = ["a"]
CIRCLE.append(CIRCLE)


@pytest.mark.parametrize("name", [nested(100, "a"), b"a", np.str_("a"), np.array("a"), {"b": np.int64(1)}])
def test_names_however_nested(name: Any) -> None:
    random_rig = by_sequence()
    assert draw_for(random_rig, {"scene_token": name}) == draw_for(random_rig, {"scene_token": copy.copy(name)})


NAMELESS = object(), {"a": object()}, {"a", "b"}, CIRCLE, {"a": CIRCLE}, nested(100_000), torch.zeros(2).to("meta")


@pytest.mark.parametrize(
    "name", NAMELESS, ids=["object", "in a dict", "set", "circle", "circle in a dict", "deep", "meta"]
)
def test_what_has_another_text_in_each_process_names_nothing(name: Any) -> None:
    with pytest.raises(SampleTypeError, match="scene_token: expected"):
        draw_for(by_sequence(), {"scene_token": name})
    with pytest.raises(SampleTypeError, match="token: expected"):
        read_frames(sample_of(load_rig("waymo").resized((8, 12))) | {"token": name}, None, names=("token",))


def test_nothing_varies_by_default() -> None:
    assert RandomRig("waymo").draw() == NEUTRAL and RandomRig("waymo").rig(NEUTRAL) == load_rig("waymo")
    assert repr(RandomRig("waymo", yaw_deg=5, focal_scale=0.1)) == (
        "RandomRig(waymo: yaw_deg -5..5, focal_scale 0.9..1.1; per sample)"
    )
    assert "nothing varies" in repr(RandomRig("waymo"))
