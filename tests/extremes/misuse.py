"""Mutated samples, settings and files for the misuse tests: deterministic by seed, one or two mutations each."""

from __future__ import annotations

import copy
import json
import random
from collections.abc import Callable, Container, Mapping, MutableMapping, Sequence
from typing import Any

import numpy as np
import torch

from arbiview_aug import Camera, FavsConfig, PaperConfig, Rig
from arbiview_aug.render.refinement import RefinementCache

SIZE = (18, 24)

JUNK: tuple[Callable[[], Any], ...] = (
    lambda: None,
    lambda: "x",
    lambda: "",
    lambda: b"\xff",
    lambda: True,
    lambda: 0,
    lambda: -1,
    lambda: 10**400,
    lambda: 1.5,
    lambda: float("nan"),
    lambda: float("inf"),
    lambda: -1e308,
    lambda: 1e-320,
    lambda: 1j,
    lambda: [],
    lambda: {},
    lambda: set(),
    lambda: object(),
    lambda: [None],
    lambda: [[1.0], [2.0, 3.0]],
    lambda: {"boxes": [[0, 0, 4, 4]], "labels": ["car"]},
    lambda: np.zeros((0, 3)),
    lambda: np.zeros((2, 7), np.complex64),
    lambda: np.array(["a", "b"]),
    lambda: np.array([object()]),
    lambda: torch.tensor(float("nan")),
    lambda: torch.zeros(0),
    lambda: torch.zeros(2, 3, *SIZE),
    lambda: torch.zeros(1, 2, 3, *SIZE, dtype=torch.uint8),
    lambda: torch.full((5, 3), float("nan")),
    lambda: torch.zeros(4, 7),
    lambda: torch.ones(2, 7) * 1e300,
    lambda: torch.zeros(2, 3, *SIZE, device="meta"),
    lambda: torch.zeros(2, 4, 4, device="meta"),
    lambda: torch.zeros(5, 3).to_sparse(),
    lambda: torch.zeros(2, 3, *SIZE).to(torch.float8_e5m2),
    lambda: torch.zeros(2, 3, 3, dtype=torch.complex64),
    lambda: torch.eye(4).expand(2, 4, 4),
    lambda: "a\0b",
    lambda: "\ud800",
    lambda: nested(200),
    lambda: circle(),
)
"""Values that no key expects, made anew each time."""


def nested(depth: int) -> Any:
    value: Any = []
    for _ in range(depth):
        value = [value]
    return value


def circle() -> Any:
    value: Any = {"boxes": []}
    value["boxes"].append(value)
    return value


_MEANT = {"digits": "7" * 5000, "deep": "[" * 3000 + "]" * 3000, "circle": "&a [*a]", "mappings": '{"a":' * 3000 + "}"}
"""Texts that stand in a file in place of a word, which no writer of JSON writes."""

TEXT_JUNK: tuple[Callable[[], Any], ...] = (
    *(lambda: None, lambda: "x", lambda: "", lambda: True, lambda: 0, lambda: -1, lambda: 1.5, lambda: 10**400),
    *(lambda: float("nan"), lambda: float("inf"), lambda: -1e308, lambda: 1e-320, lambda: 2**63, lambda: "7"),
    *(lambda: [], lambda: {}, lambda: [None], lambda: [[1.0], [2.0, 3.0]], lambda: {"name": "x", "file": {}}),
    *(lambda: "a\0b", lambda: "\ud800", lambda: "x" * 5000, lambda: "../x", lambda: "/dev/zero", lambda: nested(200)),
    *(lambda word=word: word for word in _MEANT),  # type: ignore[misc]
)
"""The same in files of JSON."""

TENSOR_CHANGES: tuple[Callable[[torch.Tensor], Any], ...] = (
    lambda t: t[:1],
    lambda t: t[None],
    lambda t: t[..., :-1],
    lambda t: t.transpose(-1, -2) if t.ndim > 1 else t,
    lambda t: t.reshape(-1),
    lambda t: t[:0],
    lambda t: torch.cat([t, t]),
    lambda t: t.half(),
    lambda t: t.bfloat16(),
    lambda t: t.double(),
    lambda t: t.to(torch.float8_e4m3fn),
    lambda t: t.to(torch.int64),
    lambda t: t.bool(),
    lambda t: t.to(torch.complex64),
    lambda t: t.to("meta"),
    lambda t: t.numpy(),
    lambda t: t.tolist(),
    lambda t: list(t.unbind(0)) if t.ndim else t,
    lambda t: t.float().requires_grad_(),
    lambda t: t.float() * -1,
    lambda t: t.float() * 1e30,
    lambda t: t.float() * 1e-30,
    lambda t: t.float() + float("nan"),
    lambda t: t.float().index_fill(0, torch.tensor([0]), float("inf")) if t.ndim and len(t) else t,
    lambda t: t.flip(0) if t.ndim else t,
    lambda t: t[0] if t.ndim and len(t) else t,
    lambda t: t.as_subclass(torch.nn.Parameter) if t.is_floating_point() else t,
)


def rig(names: tuple[str, ...] = ("left", "right"), spread_deg: float = 40.0) -> Rig:
    """Cameras side by side whose views overlap."""
    cameras = [
        Camera.looking(
            name=name,
            azimuth_deg=spread_deg * (0.5 - k),
            position_m=(1.5, 0.4 * (0.5 - k), 1.5),
            width_px=SIZE[1],
            height_px=SIZE[0],
            horizontal_fov_deg=80.0,
        )
        for k, name in enumerate(names)
    ]
    return Rig(cameras, name="fuzz")


def sample(rng: random.Random) -> dict[str, Any]:
    """A right sample with a random choice of the keys that a sample may have."""
    cameras = rig()
    generator = torch.Generator().manual_seed(rng.randrange(2**31))
    images = torch.randint(0, 256, (2, 3, *SIZE), generator=generator, dtype=torch.uint8)
    optional: dict[str, Any] = {
        "ground_z_m": 0.0,
        "points": torch.randn(50, 4, generator=generator) * 20,
        "depth_m": torch.rand(2, *SIZE, generator=generator) * 50,
        "boxes_3d": torch.tensor([[12.0, 1, 0.8, 4, 2, 1.6, 0.3], [20, -3, 1, 4, 2, 2, 1.5]]),
        "box_names": ["vehicle.car", "pedestrian"],
        "detections": [{"boxes": torch.tensor([[2.0, 2, 9, 9]]), "labels": ["car"]} for _ in range(2)],
        "coverage": torch.ones(2, *SIZE, dtype=torch.bool),
        "ignore": torch.zeros(2, *SIZE, dtype=torch.bool),
        "ego2world": torch.eye(4, dtype=torch.float64),
        "token": "t",
    }
    chosen = {key: value for key, value in optional.items() if rng.random() < 0.5}
    chosen |= {"scene": "s1", "labels": torch.zeros(2, *SIZE, dtype=torch.int64)}
    if rng.random() < 0.3:
        chosen |= {"lens": ["fisheye", "pinhole"], "distortion": torch.zeros(2, 4, dtype=torch.float64)}
    if rng.random() < 0.3:
        return {"images": images, "rig": cameras, **chosen}
    return {"images": images, "K": torch.from_numpy(cameras.K), "cam2ego": torch.from_numpy(cameras.cam2ego), **chosen}


def mutated(value: Any, rng: random.Random, junk: Sequence[Callable[[], Any]] = JUNK) -> Any:
    """A value with one thing wrong, somewhere inside it; containers are changed in place."""
    if isinstance(value, MutableMapping) and value and rng.random() < 0.95:
        key = rng.choice(list(value))
        roll = rng.random()
        if roll < 0.08:
            del value[key]
        elif roll < 0.12:
            value[rng.choice(["x", 1, None, ("a", 2)])] = value[key]
        else:
            value[key] = mutated(value[key], rng, junk)
        return value
    if isinstance(value, list) and value and rng.random() < 0.85:
        k = rng.randrange(len(value))
        roll = rng.random()
        if roll < 0.1:
            del value[k]
        elif roll < 0.2:
            value.insert(k, copy.copy(value[k]))
        else:
            changed = mutated(value[k], rng, junk)
            value[k : k + 1] = [changed]  # a circle may be shorter now
        return value
    readable = isinstance(value, torch.Tensor) and value.device.type == "cpu" and value.layout == torch.strided
    if readable and "float8" not in str(value.dtype) and rng.random() < 0.75:
        if rng.random() < 0.3 and value.numel():
            changed = value.clone().double()
            changed.view(-1)[rng.randrange(value.numel())] = rng.choice(NUMBERS)
            return changed if rng.random() < 0.5 else changed.to(value.dtype)
        return rng.choice(TENSOR_CHANGES)(value)
    if isinstance(value, float | int) and not isinstance(value, bool) and rng.random() < 0.6:
        return (
            rng.choice((*NUMBERS, -value, -value, value * 1000, 1e-7))
            if isinstance(value, int)
            else rng.choice((*NUMBERS, value * 1e3, value + 1e-7))
        )
    return rng.choice(junk)()


NUMBERS = (float("nan"), float("inf"), -1e308, 1e300, 1e30, -1.0, 0.0, 1e-30, 5e-324, 1e5, 0.5)


def settings(rng: random.Random, keys: Container[str]) -> dict[str, Any]:
    """Right settings of a ``RigRetarget`` for a sample with these keys."""
    quality = rng.choice(["fast"] * 4 + ["draft", "accurate", "accurate", "paper"])
    chosen: dict[str, Any] = {
        "quality": quality,
        "label_frame": rng.choice(["source", "source", "target"]),
        "label_keys": ("labels",),
    }
    if rng.random() < 0.2:
        chosen |= {"size": (12, 16), "p": 0.5}
    if quality == "paper":
        return chosen
    surfaces = ["auto", "auto", "far", "ground", "street"]
    surfaces += ["objects"] * ("boxes_3d" in keys) + ["lidar"] * ("points" in keys or "depth_m" in keys)
    chosen["surface"] = rng.choice(surfaces)
    chosen["harmonise"] = rng.choice([None, None, True, False, (1.1, 0.9)])
    chosen["execution"] = rng.choice(["auto", "auto", "auto", "torch"])
    chosen["outputs"] = rng.choice([(), (), ("confidence",), ("confidence", "source_camera")])
    if quality == "accurate" and rng.random() < 0.5:
        chosen["refinement"] = RefinementCache(key="scene")
    return chosen


SETTING_NAMES = (
    *("path", "quality", "surface", "harmonise", "refinement", "size", "p", "rng", "label_frame", "label_keys"),
    *("label_fill", "pass_keys", "outputs", "execution", "cache_bytes", "source_rig"),
)

SETTING_JUNK: tuple[Callable[[], Any], ...] = (
    lambda: (10.5, 20),
    lambda: (0, 5),
    lambda: (40_000, 5),
    lambda: ("8", "9"),
    lambda: [8, 9],
    lambda: ["fast"],
    lambda: {"quality": "fast"},
    lambda: FavsConfig(grid_step_px=1),
    lambda: PaperConfig(use_feature_matching=False),
    lambda: (1.0, "x"),
    lambda: (0.0, 1.0),
    lambda: (1.0,),
    lambda: ("nothing",),
    lambda: rig(),
    lambda: "nuscenes",
    lambda: Rig,
)


def mutated_settings(rng: random.Random, keys: Container[str]) -> dict[str, Any]:
    """Settings of a ``RigRetarget`` with one of them wrong."""
    chosen = settings(rng, keys)
    chosen[rng.choice(SETTING_NAMES)] = rng.choice((*JUNK, *SETTING_JUNK))()
    return chosen


def calibration() -> dict[str, Any]:
    """A right calib.json, which is a right rig file too."""
    cameras = rig().to_dict()["cameras"]
    for camera, distortion in zip(cameras, (None, {"model": "fisheye", "coeffs": [0.01, 0.0, 0.0, 0.0]}), strict=True):
        camera |= {"file": f"{camera['name']}.png", "distortion": distortion}
    cameras[1]["mask"] = "mask.png"
    boxes = [[12.0, 1, 0.8, 4, 2, 1.6, 0.3]]
    return {
        "name": "fuzz",
        "cameras": cameras,
        "ground_z_m": 0.0,
        "ego2world": np.eye(4).tolist(),
        "boxes_3d": boxes,
        "lidar": {"file": "lidar.npy"},
    }


def mutated_text(data: Any, rng: random.Random) -> bytes:
    """JSON with one or two things wrong: in its values, or in its bytes."""
    data = copy.deepcopy(data)
    for _ in range(rng.choice((1, 1, 2))):
        data = mutated(data, rng, TEXT_JUNK)
        if not isinstance(data, Mapping):
            break
    written = json.dumps(data, skipkeys=True)
    for word, meant in _MEANT.items():
        written = written.replace(f'"{word}"', meant)
    text = bytearray(written.encode())
    if rng.random() < 0.3:
        for _ in range(rng.randrange(1, 4)):
            k = rng.randrange(max(1, len(text)))
            text[k : k + rng.choice((0, 1, 1, 9))] = bytes(
                rng.choice(b'{}[]",:0e9-\x00\xff&*!%') for _ in range(rng.choice((0, 1)))
            )
    return bytes(text)
