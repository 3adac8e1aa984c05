"""Cameras, rigs, samples and streets that several test modules are made of. Fixtures are in ``conftest.py``."""

from __future__ import annotations

import copy
import inspect
import itertools
import json
import math
import os
import re
import signal
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, Phase, given, settings

from arbiview_aug import Camera, Rig
from arbiview_aug.datasets.frame_folder import SEQUENCE_FILE, write_frame
from arbiview_aug.datasets.synthetic import Scene, SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.lidar import ColouredPoints, sparse_metrics
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.image_ops import at_level
from arbiview_aug.render.plan import Slot


def camera(
    name: str = "front", azimuth_deg: float = 0.0, *, size: tuple[int, int] = (72, 96), **changes: Any
) -> Camera:
    """A camera of (h, w) pixels, 80 degrees wide unless a ``K`` is given; changes are those of ``Camera.looking``."""
    usual: dict[str, Any] = {"height_px": size[0], "width_px": size[1]}
    if changes.get("K") is None:
        usual["horizontal_fov_deg"] = 80.0
    if changes.get("lens") == "fisheye":
        usual["distortion"] = (0.0,) * 4
    return Camera.looking(name=name, azimuth_deg=azimuth_deg, **(usual | changes))


def ring(
    count: int = 6,
    *,
    radius_m: float = 0.5,
    z_m: float = 1.5,
    yaw_deg: float = 0.0,
    name: str = "c",
    **changes: Any,
) -> Rig:
    """Cameras evenly around the vehicle that look outwards; changes are those of ``camera``, for all of them.

    Args:
        count: The number of cameras.
        radius_m: Distance of their centres from the ego origin.
        z_m: Height of their centres.
        yaw_deg: Turn of every camera about its own centre.
        name: Start of their names.
    """
    cameras = []
    for k in range(count):
        around = math.radians(360.0 / count * k)
        place = {"position_m": (radius_m * math.cos(around), radius_m * math.sin(around), z_m)}
        cameras.append(camera(f"{name}{k}", 360.0 * k / count + yaw_deg, **(place | changes)))
    return Rig(cameras)


def smooth_images(rig: Rig, dtype: torch.dtype = torch.uint8, seed: int = 0) -> Any:
    """Smooth random pictures, so that a small shift makes a small difference; a list where sizes differ."""
    generator = torch.Generator().manual_seed(seed)
    images = []
    for one in rig:
        coarse = torch.rand((1, 3, 5, 7), generator=generator)
        image = torch.nn.functional.interpolate(coarse, size=one.size, mode="bicubic", align_corners=True)[0]
        image = image.clamp(0, 1)
        images.append((image * 255).round().to(torch.uint8) if dtype == torch.uint8 else image.to(dtype))
    return torch.stack(images) if len(set(rig.sizes)) == 1 else images


def noise(rig: Rig, seed: int = 0) -> list[torch.Tensor]:
    """Random pictures (3, h, w) in [0, 1]."""
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(3, *one.size, generator=generator) for one in rig]


def sample_of(rig: Rig, dtype: torch.dtype = torch.uint8, seed: int = 0, **more: Any) -> dict[str, Any]:
    """A sample of smooth images with its calibration in tensors."""
    calibration = {"K": torch.from_numpy(rig.K), "cam2ego": torch.from_numpy(rig.cam2ego)}
    return {"images": smooth_images(rig, dtype, seed), **calibration, **more}


def same(one: Any, two: Any) -> bool:
    """Whether nested dicts and lists are equal in types and bits; unknown velocities are NaN."""
    if isinstance(one, torch.Tensor):
        alike = type(one) is type(two) and one.dtype == two.dtype and one.shape == two.shape
        return alike and bool(((one == two) | (one.isnan() & two.isnan())).all())
    if isinstance(one, dict):
        return list(one) == list(two) and all(same(one[key], two[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(two) and all(map(same, one, two))
    return bool(one == two)


def street_sample(size: tuple[int, int] = (64, 176), **settings: Any) -> dict[str, Any]:
    """One frame of the demo rig on a synthetic street; settings are those of ``SyntheticDrive``."""
    return copy.deepcopy(_street(size, **settings))


@cache
def _street(size: tuple[int, int], **settings: Any) -> dict[str, Any]:
    return SyntheticDrive(demo_source_rig(size), num_frames=1, **settings)[0]


def saved_depth_model(folder: Path, kind: str = "DepthAnything", **changes: Any) -> Path:
    """A tiny random depth model of transformers and its image processor."""
    transformers = pytest.importorskip("transformers")
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        **{"hidden_size": 16, "num_hidden_layers": 2, "num_attention_heads": 2, "mlp_ratio": 2, "image_size": 56},
        **{"patch_size": 14, "out_features": ["stage1", "stage2"], "reshape_hidden_states": False},
    )
    sizes = {"reassemble_hidden_size": 16, "neck_hidden_sizes": [8, 8], "fusion_hidden_size": 8, "head_hidden_size": 8}
    sizes |= {"reassemble_factors": [1, 0.5], "patch_size": 14}
    config = getattr(transformers, f"{kind}Config")(backbone_config=backbone, **(sizes | changes))
    getattr(transformers, f"{kind}ForDepthEstimation")(config).save_pretrained(folder)
    processor = getattr(transformers, {"DepthAnything": "DPT"}.get(kind, kind) + "ImageProcessor")
    size = {"height": 56, "width": 56}
    processor(size=size, keep_aspect_ratio=True, ensure_multiple_of=14).save_pretrained(folder)
    return folder


def assert_same_to_a_level(got: Any, expected: Any) -> None:
    """Compare uint8 images of a network: batch sizes, threads and CPUs move some of their pixels by one level."""
    difference = (torch.as_tensor(got).int() - torch.as_tensor(expected).int()).abs()
    assert difference.max() <= 1 and (difference != 0).float().mean() < 0.01


class HangError(BaseException):
    """The time is over; no handler of exceptions catches it."""


def latin(folder: Path) -> Path:
    """A folder in another, whose name is no UTF-8; skips the test where file systems have no such names."""
    try:
        (path := folder / os.fsdecode(b"d\xe9p\xf4t")).mkdir()
    except OSError:
        pytest.skip("names of files are UTF-8 here")
    return path


@contextmanager
def limited(seconds: float) -> Iterator[None]:
    """CPU time, so that a busy machine is no hang; not SIGALRM, which pytest-timeout has."""

    def over(*_: object) -> None:
        raise HangError

    before = signal.signal(signal.SIGVTALRM, over)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)


def few_or_all(few: int, every: int, what: str = "streets") -> list[Any]:
    """Fixture parameters: a guard of few streets for CI, all of them for the release check."""
    return [
        pytest.param(few, marks=pytest.mark.slow, id=f"{few} {what}"),
        pytest.param(every, marks=pytest.mark.release, id=f"{every} {what}"),
    ]


def sampled(*factors: Iterable[Any]) -> list[Any]:
    """All combinations as parameters, a sample of them in the default run and the others slow.

    The sample has every pair of values of three factors or more, and every value of two.
    """
    combinations = list(itertools.product(*factors))
    strength = min(2, len(combinations[0]) - 1)

    def parts(values: tuple[Any, ...]) -> set[Any]:
        return set(itertools.combinations(enumerate(values), strength))

    missing = set().union(*map(parts, combinations))
    chosen: Counter[tuple[Any, ...]] = Counter()
    used: Counter[tuple[int, Any]] = Counter()
    while missing:  # greedily, values that were rarely taken first
        best = max(combinations, key=lambda c: (len(parts(c) & missing), -sum(used[part] for part in enumerate(c))))
        missing -= parts(best)
        chosen[best] += 1
        used.update(enumerate(best))
    return [pytest.param(*c, marks=() if c in chosen else pytest.mark.slow) for c in combinations]


def examples(
    few: int, many: int, most: int | None = None, *, share: tuple[float, float] | None = None, **strategies: Any
) -> Callable[[Callable[..., Any]], Callable[..., None]]:
    """Run a property on some drawn examples by default, and on many of them as a slow test.

    Shrinking rigs takes minutes, past the time limit, and explains little: a failure shows what was drawn.

    Args:
        few: Examples of the default run.
        many: Examples of the slow one.
        most: Examples of the release check, if there is one.
        share: Range of the share of examples for which the property returns True.
        strategies: Strategies to draw from, by the property's parameters; others are fixtures.
    """
    drawing = settings(suppress_health_check=list(HealthCheck), phases=[Phase.generate])

    def decorate(holds: Callable[..., Any]) -> Callable[..., None]:
        def test(count: int, **fixtures: Any) -> None:
            results = []

            @settings(drawing, max_examples=count)
            @given(**strategies)
            def drawn(**values: Any) -> None:
                results.append(holds(**fixtures, **values))

            drawn()
            assert share is None or share[0] < sum(results) / len(results) < share[1], f"{sum(results)}/{len(results)}"

        known = inspect.signature(holds).parameters.values()
        count = inspect.Parameter("count", inspect.Parameter.POSITIONAL_OR_KEYWORD)
        asked = inspect.Signature([count, *(p for p in known if p.name not in strategies)])
        vars(test).update(__signature__=asked)  # what pytest reads the fixtures from
        test.__doc__, test.__name__ = holds.__doc__, holds.__name__
        counts = [few, pytest.param(many, marks=pytest.mark.slow)]
        if most is not None:
            counts.append(pytest.param(most, marks=[pytest.mark.release, pytest.mark.timeout(7200)]))
        return pytest.mark.parametrize("count", counts)(test)

    return decorate


class Standing(SyntheticDrive):
    """A street where only the vehicle moves."""

    def scene(self, index: int) -> Scene:
        scene = super().scene(index)
        return replace(scene, velocities=np.zeros_like(scene.velocities))


# --- the atlas --------------------------------------------------------------------------------------------------------
def in_atlas(slot: Slot, uv: Any) -> Any:
    """Atlas positions of source pixels (..., 2)."""
    return at_level(uv, slot.level) + np.array([slot.x, slot.y])


def in_source(slot: Slot, at: Any) -> Any:
    """Source pixels (..., 2) of atlas positions."""
    return (at - (slot.x, slot.y) + 0.5) * 2**slot.level - 0.5


# --- the evaluation protocol ------------------------------------------------------------------------------------------
def as_camera(name: str, K: Any, cam2ego: Any, size: tuple[int, int], mask: Any = None) -> Camera:
    """A camera in the protocol's words; its size is (h, w)."""
    return Camera(name=name, width_px=size[1], height_px=size[0], K=K, cam2ego=cam2ego, mask=mask)


def score_targets(
    render: Callable[[Rig], Iterable[Any]], points: ColouredPoints, targets: Iterable[Rig]
) -> dict[str, float]:
    """Mean sparse metrics over all cameras of all target rigs, rendered to one image per camera."""
    pairs = ((camera, image) for target in targets for camera, image in zip(target, render(target), strict=True))
    return mean_of([score for camera, image in pairs if (score := sparse_metrics(image, camera, points)) is not None])


def told_db(reason: str) -> tuple[float, float]:
    """PSNR before and after, as a report's reason tells them."""
    ((before, after),) = re.findall(r"([\d.]+) to ([\d.]+) dB", reason)
    return float(before), float(after)


def write_drive(root: Path, frames: Sequence[Mapping[str, Any]]) -> None:
    """Write the frames of one drive (with ``ego2world`` and ``time_s``) in order of time, and ``sequence.json``."""
    entries = []
    for k, frame in enumerate(sorted(frames, key=lambda frame: float(frame["time_s"]))):
        entries.append({"name": f"{k:04}", "time_s": float(frame["time_s"])})
        write_frame(root / f"{k:04}", frame)
    (root / SEQUENCE_FILE).write_text(json.dumps({"frames": entries}))
