"""Whatever a user passes by mistake works or is refused by name: no foreign exception, no hang, bounded memory."""

from __future__ import annotations

import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from arbiview_aug import (
    ArbiviewError,
    Camera,
    PaperConfig,
    PlanCache,
    RandomRig,
    RenderConfig,
    Rig,
    RigRetarget,
    load_rig,
)
from arbiview_aug import check as find_mistakes
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.errors import CalibrationError, SampleError, SampleTypeError
from arbiview_aug.sample.batching import is_readable
from arbiview_aug.transforms.warm_up import compile_kernels
from tests.extremes import misuse
from tests.extremes.conftest import Worst
from tests.helpers import examples, limited
from tests.mutations import HANG_S, mutated_json, nested, works

TARGET = misuse.rig(spread_deg=30.0).shifted(z_m=0.3)
GROWTH_KB = 1024**2  # of the process's peak memory: 1 GiB beyond what the tests before it needed


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Compiling takes longer than any case may."""
    compile_kernels()


@contextmanager
def bounded(worst: Worst) -> Iterator[None]:
    """Fails on an input that needs a GiB more memory than the process had."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    growth_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    worst("MiB more memory, mutated input", growth_kb / 1024)
    assert growth_kb < GROWTH_KB


@pytest.fixture
def frame_folder(tmp_path: Path) -> Path:
    for name in ("left", "right"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((*misuse.SIZE, 3), 100, np.uint8))
    cv2.imwrite(str(tmp_path / "mask.png"), np.full(misuse.SIZE, 255, np.uint8))
    np.save(tmp_path / "lidar.npy", np.zeros((4, 3), np.float32))
    return tmp_path


@examples(60, 1100, 5500, share=(0.2, 0.8), data=st.data())
def test_mutated_samples_and_settings(worst: Worst, data: st.DataObject) -> bool:
    sample = data.draw(misuse.samples())
    if data.draw(st.sampled_from(["sample", "sample", "sample", "settings"])) == "settings":
        settings = data.draw(misuse.wrong_settings(sample))
    else:
        settings, sample = data.draw(misuse.settings(sample)), data.draw(misuse.wrong_samples())
    retargets: list[RigRetarget] = []
    if not works(lambda: retargets.append(RigRetarget(TARGET, **settings)), (ArbiviewError, ValueError)):
        return False

    def render() -> None:
        images = retargets[0](sample)["images"]
        assert all(is_readable(image) and bool(image.isfinite().all()) for image in images)

    with bounded(worst):
        return works(render)


@examples(50, 900, 4500, share=(0.05, 0.8), text=mutated_json(misuse.calibration()), yaml=st.integers(0, 7))
def test_mutated_calibrations(frame_folder: Path, worst: Worst, text: bytes, yaml: int) -> bool:
    for name in ("calib.json", "rig.yaml"):
        (frame_folder / name).write_bytes(text)
    readable = "rig.yaml" if yaml == 0 else "calib.json"  # YAML's reader is slow
    with bounded(worst):
        return works(lambda: FrameFolder(frame_folder)[0]) & works(lambda: repr(load_rig(frame_folder / readable)))


@examples(50, 500, sample=misuse.wrong_samples())
def test_mutated_samples_are_checked(sample: dict[str, Any]) -> None:
    works(lambda: str(find_mistakes(sample)))


@pytest.mark.parametrize("key", ["lens", "K", "images", "token", "boxes_3d", "points", "detections"])
def test_values_too_deep_to_print(key: str) -> None:
    sample = {"images": torch.zeros(2, 3, *misuse.SIZE), "K": torch.eye(3), "cam2ego": torch.eye(4)}
    for value in (nested(100_000), [nested(100_000, "a")] * 2):
        with pytest.raises(ArbiviewError):
            RigRetarget(TARGET, geometry="boxes")({**sample, key: value})
        with pytest.raises(ValueError, match="expected"):
            RigRetarget(TARGET, quality=value)  # type: ignore[arg-type]


def test_samples_that_hold_themselves() -> None:
    """Their containers are read once: two references in each of 60 lists would be 2^60 paths."""
    many: list[Any] = []
    for _ in range(60):
        many = [many, many]
    sample = {"images": torch.zeros(2, 3, *misuse.SIZE), "rig": misuse.rig(), "meta": [misuse.circle(), many]}
    with limited(HANG_S):
        assert RigRetarget(TARGET)(sample)["images"].isfinite().all()


def test_huge_entries_are_no_rotation() -> None:
    pose = np.eye(4)
    pose[:3, :3] = [[1e308, -1e308, 0], [1e308, 1e308, 0], [0, 0, 1e308]]
    with pytest.raises(CalibrationError, match="nearest rotation"):
        Camera(name="c", width_px=9, height_px=7, K=np.eye(3), cam2ego=pose)


def test_configs_refuse_by_name() -> None:
    with pytest.raises(ValueError, match=r"PlanCache\.max_bytes"):
        PlanCache(max_bytes=None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"PlanCache\.share_overlap"):
        PlanCache(share_overlap=3)  # type: ignore[arg-type]
    for wrong in ("a", 10**400, False):
        with pytest.raises(ValueError, match=r"RenderConfig\.seam_width"):
            RenderConfig(seam_width=wrong)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"PaperConfig\.beta"):
        PaperConfig(beta=None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"PaperConfig\.type_weights: expected pairs"):
        PaperConfig(type_weights=None)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"PaperConfig\.use_feature_matching: expected True or False, got 'off'"):
        PaperConfig(use_feature_matching="off")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"RenderConfig\.antialias: expected True or False"):
        RenderConfig(antialias="no")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="yaw_deg"):
        RandomRig(TARGET, yaw_deg="x")  # type: ignore[arg-type]


@pytest.mark.parametrize("params", [{"yaw_deg": "x"}, {"skipped": None}, 3, ["yaw_deg"]])
def test_params_refuse_what_is_no_number(params: Any) -> None:
    with pytest.raises(ArbiviewError, match="params"):
        RigRetarget(RandomRig(TARGET, yaw_deg=5.0))({"images": torch.zeros(2, 3, *misuse.SIZE), "rig": TARGET}, params)


@pytest.mark.parametrize(
    "change", [lambda t: t.to("meta"), lambda t: t.to(torch.float8_e4m3fn), lambda t: t.to_sparse()]
)
def test_tensors_that_cannot_be_read(change: Callable[[torch.Tensor], torch.Tensor]) -> None:
    cameras: Rig = misuse.rig()
    right = torch.zeros(2, 3, *misuse.SIZE)
    with pytest.raises(SampleTypeError, match=r"images\[0\]"):
        RigRetarget(TARGET)({"images": change(right), "rig": cameras})
    sample = {"images": right, "rig": cameras, "points": change(torch.rand(20, 3)), "boxes_3d": torch.zeros(0, 7)}
    retarget = RigRetarget(TARGET, geometry="lidar")
    with suppress(SampleTypeError):  # 8 bit floats can be read as numbers
        assert retarget(sample)["images"].isfinite().all()
    with pytest.raises(SampleError, match="points"):
        retarget({**sample, "points": torch.rand(20, 2)})
