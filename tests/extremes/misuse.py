"""Samples, settings and calibrations for the misuse tests, right ones and wrong ones."""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection
from typing import Any

import numpy as np
import torch
from hypothesis import strategies as st

from arbiview_aug import PaperConfig, RenderConfig, Rig, SampleKeys
from tests.helpers import camera
from tests.mutations import NUMBERS, TEXT_JUNK, mutated

SIZE = (18, 24)


def circle() -> Any:
    value: Any = {"boxes": []}
    value["boxes"].append(value)
    return value


JUNK: tuple[Callable[[], Any], ...] = (
    *(lambda value=value: copy.deepcopy(value) for value in TEXT_JUNK),  # type: ignore[misc]
    *(lambda: b"\xff", lambda: 1j, lambda: set(), lambda: object(), lambda: circle()),
    *(lambda: {"boxes": [[0, 0, 4, 4]], "labels": ["car"]}, lambda: np.zeros((0, 3))),
    *(lambda: np.zeros((2, 7), np.complex64), lambda: np.array(["a", "b"]), lambda: np.array([object()])),
    *(lambda: torch.tensor(float("nan")), lambda: torch.zeros(0), lambda: torch.zeros(2, 3, *SIZE)),
    *(lambda: torch.zeros(1, 2, 3, *SIZE, dtype=torch.uint8), lambda: torch.full((5, 3), float("nan"))),
    *(lambda: torch.zeros(4, 7), lambda: torch.ones(2, 7) * 1e300, lambda: torch.zeros(5, 3).to_sparse()),
    *(lambda: torch.zeros(2, 3, *SIZE, device="meta"), lambda: torch.zeros(2, 4, 4, device="meta")),
    *(lambda: torch.zeros(2, 3, *SIZE).to(torch.float8_e5m2), lambda: torch.zeros(2, 3, 3, dtype=torch.complex64)),
    lambda: torch.eye(4).expand(2, 4, 4),
    *(lambda: np.array(3.0), lambda: np.eye(4)[::-1], lambda: np.ones((2, 5, 3), np.float32)[:, ::-1]),
)
"""Values that no key expects, made anew each time."""

TENSOR_CHANGES: tuple[Callable[[torch.Tensor], Any], ...] = (
    *(lambda t: t[:1], lambda t: t[None], lambda t: t[..., :-1], lambda t: t[:0], lambda t: t.reshape(-1)),
    *(lambda t: torch.cat([t, t]) if t.ndim else t, lambda t: t.transpose(-1, -2) if t.ndim > 1 else t),
    *(lambda t: t.flip(0) if t.ndim else t, lambda t: t[0] if t.ndim and len(t) else t),
    *((lambda t, dtype=dtype: t.to(dtype)) for dtype in (torch.half, torch.bfloat16, torch.double, torch.int64)),
    *((lambda t, dtype=dtype: t.to(dtype)) for dtype in (torch.float8_e4m3fn, torch.bool, torch.complex64)),
    *(lambda t: t.to("meta"), lambda t: t.numpy(), lambda t: np.flip(t.numpy()), lambda t: t.tolist()),
    lambda t: list(t.unbind(0)) if t.ndim else t,
    *(lambda t: t.float().requires_grad_(), lambda t: t.float() * -1, lambda t: t.float() * 1e30),
    *(lambda t: t.float() * 1e-30, lambda t: t.float() + float("nan")),
    lambda t: t.float().index_fill(0, torch.tensor([0]), float("inf")) if t.ndim and len(t) else t,
    lambda t: t.as_subclass(torch.nn.Parameter) if t.is_floating_point() else t,
)
"""Other shapes, types and values of a right tensor."""


def rig(names: tuple[str, ...] = ("left", "right"), spread_deg: float = 40.0) -> Rig:
    """Cameras side by side whose views overlap."""
    cameras = [
        camera(name, spread_deg * (0.5 - k), size=SIZE, position_m=(1.5, 0.4 * (0.5 - k), 1.5))
        for k, name in enumerate(names)
    ]
    return Rig(cameras, name="fuzz")


def fresh(makers: tuple[Callable[[], Any], ...]) -> st.SearchStrategy[Any]:
    """One of the values, made anew."""
    return st.sampled_from(makers).map(lambda make: make())


@st.composite
def changes(draw: st.DrawFn, part: Any) -> Any:
    """A tensor of another shape, type or kind, or with a number that is wrong; junk in place of anything else."""
    if not isinstance(part, torch.Tensor) or part.device.type != "cpu" or part.layout != torch.strided:
        return draw(fresh(JUNK))
    if "float8" in str(part.dtype) or not part.numel() or draw(st.integers(0, 2)):
        return draw(st.sampled_from(TENSOR_CHANGES))(part)
    changed = part.clone(memory_format=torch.contiguous_format).double()
    changed.view(-1)[draw(st.integers(0, part.numel() - 1))] = draw(st.sampled_from(NUMBERS))
    return changed if draw(st.booleans()) else changed.to(part.dtype)


OPTIONAL: dict[str, Callable[[], Any]] = {
    "ground_z_m": lambda: 0.0,
    "points": lambda: torch.randn(50, 4, generator=torch.Generator().manual_seed(0)) * 20,
    "depth_m": lambda: torch.rand(2, *SIZE, generator=torch.Generator().manual_seed(0)) * 50,
    "boxes_3d": lambda: torch.tensor([[12.0, 1, 0.8, 4, 2, 1.6, 0.3], [20, -3, 1, 4, 2, 2, 1.5]]),
    "box_names": lambda: ["vehicle.car", "pedestrian"],
    "detections": lambda: [{"boxes": torch.tensor([[2.0, 2, 9, 9]]), "labels": ["car"]} for _ in range(2)],
    "coverage": lambda: torch.ones(2, *SIZE, dtype=torch.bool),
    "ego_mask": lambda: torch.zeros(2, *SIZE, dtype=torch.bool),
    "ego2world": lambda: torch.eye(4, dtype=torch.float64),
    "token": lambda: "t",
    **{f"{kind}_depth_m": lambda: torch.full((2, *SIZE), 12.0) for kind in ("motion", "learned")},
    "neighbours": lambda: [{"images": torch.zeros(2, 3, *SIZE), "ego2ego": torch.eye(4), "time_s": -0.5}],
}
"""Keys that a sample may have."""


@st.composite
def samples(draw: st.DrawFn) -> dict[str, Any]:
    """A right sample with some of the optional keys."""
    cameras = rig()
    generator = torch.Generator().manual_seed(draw(st.integers(0, 99)))
    sample = {
        "images": torch.randint(0, 256, (2, 3, *SIZE), generator=generator, dtype=torch.uint8),
        **{key: OPTIONAL[key]() for key in OPTIONAL if draw(st.booleans())},
        "scene": "s1",
        "labels": torch.zeros(2, *SIZE, dtype=torch.int64),
    }
    if draw(st.integers(0, 2)) == 0:
        sample |= {"lens": ["fisheye", "pinhole"], "distortion": torch.zeros(2, 4, dtype=torch.float64)}
    if draw(st.integers(0, 2)) == 0:
        return sample | {"rig": cameras}
    return sample | {"K": torch.from_numpy(cameras.K), "cam2ego": torch.from_numpy(cameras.cam2ego)}


@st.composite
def wrong_samples(draw: st.DrawFn) -> dict[str, Any]:
    """A sample with one or two things wrong."""
    sample: dict[str, Any] = draw(mutated(draw(samples()), fresh(JUNK), changes))
    return sample if draw(st.integers(0, 2)) else draw(mutated(sample, fresh(JUNK), changes))


@st.composite
def settings(draw: st.DrawFn, keys: Collection[str]) -> dict[str, Any]:
    """Right settings of a ``RigRetarget`` for a sample with these keys."""

    surfaces = ["auto", "auto", "infinity", "ground", "street"]
    surfaces += ["boxes"] * ("boxes_3d" in keys) + ["lidar"] * ("points" in keys or "depth_m" in keys)
    surfaces += [kind for kind in ("motion", "learned", "fused") if {f"{kind}_depth_m", "neighbours"} & {*keys}]
    choices: dict[str, tuple[Any, ...]] = {
        "quality": ("fast", "fast", "fast", "fast", "draft", "accurate", "accurate", "paper"),
        "frame": ("source", "source", "target"),
        "size": ({}, {}, {}, {}, {"size": (12, 16), "p": 0.5}),
        "geometry": tuple(surfaces),
        "match_exposure": (True, True, True, False, (1.1, 0.9)),
        "backend": ("auto", "auto", "auto", "torch"),
        "extra": ((), (), ("confidence",), ("confidence", "source_camera")),
    }
    chosen = {name: draw(st.sampled_from(values)) for name, values in choices.items()}
    is_paper, extra, frame = chosen["quality"] == "paper", chosen.pop("extra"), chosen.pop("frame")
    chosen |= chosen.pop("size") | {
        "keys": SampleKeys(frame=frame, labels=("labels",), extra=() if is_paper else extra)
    }
    unused = ("geometry", "match_exposure", "backend") if is_paper else ()
    return {name: value for name, value in chosen.items() if name not in unused}


SETTING_NAMES = (
    *("source", "geometry", "holes", "quality", "neighbours", "match_exposure"),
    *("size", "fit", "p", "keys", "cache", "backend"),
)

SETTING_JUNK: tuple[Callable[[], Any], ...] = (
    *(lambda: (10.5, 20), lambda: (0, 5), lambda: (40_000, 5), lambda: ("8", "9"), lambda: [8, 9], lambda: ["fast"]),
    *(lambda: {"quality": "fast"}, lambda: RenderConfig(seam_width=0.0), lambda: "nuscenes", lambda: Rig),
    *(lambda: rig(), lambda: (1.0, "x"), lambda: (0.0, 1.0), lambda: (1.0,), lambda: ("nothing",)),
    lambda: PaperConfig(use_feature_matching=False),
)


def wrong_settings(keys: Collection[str]) -> st.SearchStrategy[dict[str, Any]]:
    """Settings of a ``RigRetarget`` with one of them wrong."""
    wrong = st.tuples(st.sampled_from(SETTING_NAMES), fresh((*JUNK, *SETTING_JUNK)))
    return st.tuples(settings(keys), wrong).map(lambda drawn: {**drawn[0], drawn[1][0]: drawn[1][1]})


def calibration() -> dict[str, Any]:
    """A right calib.json, which is a right rig file too."""
    cameras = rig().to_dict()["cameras"]
    for entry, distortion in zip(cameras, (None, {"model": "fisheye", "coeffs": [0.01, 0.0, 0.0, 0.0]}), strict=True):
        entry |= {"file": f"{entry['name']}.png", "distortion": distortion}
    cameras[1]["mask"] = "mask.png"
    further = {"ground_z_m": 0.0, "ego2world": np.eye(4).tolist(), "boxes_3d": [[12.0, 1, 0.8, 4, 2, 1.6, 0.3]]}
    return {"name": "fuzz", "cameras": cameras, "lidar": {"file": "lidar.npy"}, **further}
