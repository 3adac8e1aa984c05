"""Whatever a user passes by mistake works or is refused by name: no foreign exception, no hang, bounded memory.

One property over every boundary: samples, settings, calibrations, and the files that the package writes itself. And
one ``RigRetarget`` in several threads gives what it gives in one.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import resource
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from arbiview_aug import ArbiviewError, Camera, PaperConfig, PlanCache, RandomRig, RenderConfig, RigRetarget, load_rig
from arbiview_aug import check as find_mistakes
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import FrameFolder, Neighbours
from arbiview_aug.datasets.depth_folder import DepthFolder
from arbiview_aug.errors import CalibrationError
from arbiview_aug.generator import Generator
from arbiview_aug.generator.config import TrainConfig
from arbiview_aug.generator.generator import read_checkpoint, write_checkpoint
from arbiview_aug.generator.training.trainer import RunState
from arbiview_aug.image_ops import Memory
from arbiview_aug.sample.batching import is_readable
from arbiview_aug.temporal.motion_depth import MotionDepth
from arbiview_aug.transforms.warm_up import compile_kernels
from tests.cameras.calibrations import sound_calibrations
from tests.cli.convert.drives import FRAMES, command, tree, write_frames
from tests.extremes import misuse
from tests.extremes.conftest import Worst
from tests.generator.small import small_config
from tests.helpers import examples, limited
from tests.mutations import HANG_S, TEXT_JUNK, mutated_bytes, mutated_json, nested, works

TARGET = misuse.rig(spread_deg=30.0).shifted(z_m=0.3)
GROWTH_KB = 1024**2  # of the process's peak memory: 1 GiB beyond what the tests before it needed
FOREIGN = re.compile(r"Traceback|\b[A-Za-z]+(Error|Exception)\b: ")
"""As commands describe exceptions that are not the package's own."""

ARRAY_CHANGES: tuple[Callable[[np.ndarray], object], ...] = (
    *(lambda a: a[..., :-1] if a.ndim else a, lambda a: a[None], lambda a: a.reshape(-1)[:0]),
    *(lambda a: a.astype(str), lambda a: np.full(a.shape, np.nan), lambda a: np.full(a.shape, np.inf)),
    *(lambda a: np.full(a.shape, 10**15), lambda a: np.zeros(a.shape, complex)),
    *((lambda a, junk=junk: np.array(str(junk))) for junk in TEXT_JUNK),
)


@st.composite
def mutated_arrays(draw: st.DrawFn, sound: bytes) -> bytes:
    """A file of arrays, one of which is missing, of another type or shape, or not finite."""
    with np.load(io.BytesIO(sound)) as file:
        arrays: dict[str, Any] = {name: file[name] for name in file.files}
    name = draw(st.sampled_from(sorted(arrays)))
    array = arrays.pop(name)
    if draw(st.integers(0, 9)):
        arrays[name] = np.asarray(draw(st.sampled_from(ARRAY_CHANGES))(array))
    changed = io.BytesIO()
    np.savez(changed, **arrays)
    return changed.getvalue()


@st.composite
def mutated_file(draw: st.DrawFn, path: Path) -> bytes:
    sound = path.read_bytes()
    if path.suffix == ".json":
        return draw(mutated_json(json.loads(sound)))
    return draw(mutated_arrays(sound) | mutated_bytes(sound) if path.suffix == ".npz" else mutated_bytes(sound))


class Boundaries:
    """Sound files in a folder of their own, one of which is mutated at a time, and samples and settings."""

    def __init__(self, root: Path) -> None:
        compile_kernels()  # compiling takes longer than any case may
        self.root, self.drive, self.output, self.generator = root, root / "drive", root / "output", root / "generator"
        write_frames(self.drive, 2)
        self.asked = command(self.drive, self.output, "--neighbours", "1", "--size", "12x20")
        assert main(self.asked) == 0
        self.depths = DepthFolder(root / "depth")
        rig = FrameFolder(self.drive)[0]["rig"]
        self.depths.write("0000", rig, MotionDepth(tuple(np.ones(c.size, np.float32) for c in rig), "made"))
        Generator.from_config(small_config()).save_pretrained(self.generator)
        self.training = TrainConfig(generator=small_config(), steps=1, batch=1, lr=1e-3)
        config, weights = read_checkpoint(self.generator)
        config |= {"training": asdict(self.training), "step": 1}  # as the state of a training run has it
        write_checkpoint(self.generator, config, weights)
        self.optimiser = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))])
        self.frame = root / "frame"
        self.frame.mkdir()
        for name in ("left", "right"):
            cv2.imwrite(str(self.frame / f"{name}.png"), np.full((*misuse.SIZE, 3), 100, np.uint8))
        cv2.imwrite(str(self.frame / "mask.png"), np.full(misuse.SIZE, 255, np.uint8))
        np.save(self.frame / "lidar.npy", np.zeros((4, 3), np.float32))
        for name in ("calib.json", "rig.json"):
            (self.frame / name).write_text(json.dumps(misuse.calibration()))
        records = sorted((self.output / "conversion").rglob("*.json"))
        self.files: dict[str, tuple[list[Path], Callable[[Path], object]]] = {
            "frame": ([self.frame / "calib.json"], lambda _: FrameFolder(self.frame)[0]),
            "rig file": ([self.frame / "rig.json"], lambda path: repr(load_rig(path))),
            "calibration": (sound_calibrations(root / "sound"), lambda path: load_rig(path.parent)),
            "sequence": ([self.drive / "sequence.json"], self._read_drive),
            "depth": ([self.depths.path("0000")], lambda _: self.depths.read("0000", FRAMES)),
            "record": (records, lambda _: self._go_on()),
            "generator": ([*self.generator.glob("*.safetensors")], self._read_generator),
        }

    def holds(self, name: str, data: st.DataObject) -> bool:
        """Whether a drawn input of a boundary worked."""
        if name in self.files:
            paths, read = self.files[name]
            path = data.draw(st.sampled_from(paths))
            sound, text = path.read_bytes(), data.draw(mutated_file(path))
            path.unlink()  # what links to it elsewhere stays
            path.write_bytes(text)
            try:
                return works(lambda: read(path))
            finally:
                path.write_bytes(sound)
        sample = data.draw(misuse.samples() if name == "settings" else misuse.wrong_samples())
        if name == "check":
            return works(lambda: str(find_mistakes(sample)))
        drawn = misuse.wrong_settings(sample) if name == "settings" else misuse.settings(sample)
        settings, retargets = data.draw(drawn), list[RigRetarget]()
        if not works(lambda: retargets.append(RigRetarget(TARGET, **settings)), (ArbiviewError, ValueError)):
            return False

        def render() -> None:
            images = retargets[0](sample)["images"]
            assert all(is_readable(image) and bool(image.isfinite().all()) for image in images)

        return works(render)

    def _read_drive(self, _: Path) -> None:
        for neighbour in FrameFolder(self.drive, neighbours=Neighbours())[0]["neighbours"]:
            _ = neighbour["images"], neighbour["rig"]

    def _read_generator(self, _: Path) -> None:
        with contextlib.suppress(ArbiviewError):
            RunState(self.generator, asdict(self.training), {}, {}, mock.Mock(shadow_params=[]), self.optimiser).load()
        Generator.from_pretrained(self.generator)

    def _go_on(self) -> None:
        """Go on with the conversion; nothing changes outside its own folder."""
        said, before = io.StringIO(), self._outside()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said), mock.patch.object(os, "fsync"):
            status = main(self.asked)
        assert status in (0, 1, 2) and not FOREIGN.search(said.getvalue()), said.getvalue()
        assert self._outside() == before
        if status:
            raise ArbiviewError(said.getvalue())

    def _outside(self) -> dict[str, bytes]:
        return {name: content for name, content in tree(self.root).items() if not name.startswith("output/conversion/")}


NAMES = (
    *("sample", "sample", "sample", "settings", "check", "frame", "rig file", "calibration", "calibration"),
    *("sequence", "depth", "record", "verified record", "generator"),
)


@pytest.fixture(scope="module")
def boundaries(tmp_path_factory: pytest.TempPathFactory) -> Boundaries:
    return Boundaries(tmp_path_factory.mktemp("hostile"))


@examples(220, 4000, 20_000, share=(0.05, 0.7), name=st.sampled_from(NAMES), data=st.data())
def test_every_boundary_works_or_refuses(boundaries: Boundaries, worst: Worst, name: str, data: st.DataObject) -> bool:
    before_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    worked = boundaries.holds(name, data)
    growth_kb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before_kb
    worst("MiB more memory, mutated input", growth_kb / 1024)
    assert growth_kb < GROWTH_KB
    return worked


def sample(**more: Any) -> dict[str, Any]:
    return {"images": torch.zeros(2, 3, *misuse.SIZE), "rig": misuse.rig(), **more}


@pytest.mark.parametrize("key", ["lens", "K", "images", "token", "boxes_3d", "points", "detections"])
def test_values_too_deep_to_print(key: str) -> None:
    calibrated = {"images": torch.zeros(2, 3, *misuse.SIZE), "K": torch.eye(3), "cam2ego": torch.eye(4)}
    for value in (nested(100_000), [nested(100_000, "a")] * 2):
        with pytest.raises(ArbiviewError):
            RigRetarget(TARGET, geometry="boxes")({**calibrated, key: value})
        with pytest.raises(ValueError, match="expected"):
            RigRetarget(TARGET, quality=value)  # type: ignore[arg-type]


def test_samples_that_hold_themselves() -> None:
    """Their containers are read once: two references in each of 60 lists would be 2^60 paths."""
    many: list[Any] = []
    for _ in range(60):
        many = [many, many]
    with limited(HANG_S):
        assert RigRetarget(TARGET)(sample(meta=[misuse.circle(), many]))["images"].isfinite().all()


HUGE = np.array([[1e308, -1e308, 0, 0], [1e308, 1e308, 0, 0], [0, 0, 1e308, 0], [0, 0, 0, 1]])
REFUSED: tuple[tuple[Callable[[], object], str], ...] = (
    (lambda: Camera(name="c", width_px=9, height_px=7, K=np.eye(3), cam2ego=HUGE), "nearest rotation"),
    (lambda: PlanCache(max_bytes=None), r"PlanCache\.max_bytes"),  # type: ignore[arg-type]
    (lambda: RenderConfig(seam_width="a"), r"RenderConfig\.seam_width"),  # type: ignore[arg-type]
    (lambda: RenderConfig(seam_width=10**400), r"RenderConfig\.seam_width"),
    (lambda: RenderConfig(antialias="no"), r"RenderConfig\.antialias: expected True or False"),  # type: ignore[arg-type]
    (lambda: PaperConfig(far_weight=None), r"PaperConfig\.far_weight: expected 0"),  # type: ignore[arg-type]
    (lambda: PaperConfig(beta=1.5), r"PaperConfig\.beta: expected 0 to 1, got 1\.5"),
    (lambda: PaperConfig(min_matches=3), r"PaperConfig\.min_matches: expected 4 to"),
    (lambda: PaperConfig(consistent_px=30.0), r"consistent_px: expected less than inconsistent_px=24"),
    (lambda: PaperConfig(far_weight=-1.0), r"PaperConfig\.far_weight: expected 0 to"),
    (lambda: PaperConfig(use_feature_matching="off"), "use_feature_matching: expected True or False, got 'off'"),  # type: ignore[arg-type]
    *((lambda p=params: RigRetarget(RandomRig(TARGET, yaw_deg=5.0))(sample(), p), "params")  # type: ignore[misc]
      for params in ({"yaw_deg": "x"}, {"skipped": None}, 3, ["yaw_deg"])),
)  # fmt: skip


@pytest.mark.parametrize(("call", "message"), REFUSED)
def test_configs_refuse_by_name(call: Callable[[], object], message: str) -> None:
    with pytest.raises((CalibrationError, ValueError, ArbiviewError), match=message):
        call()


# --- threads ----------------------------------------------------------------------------------------------------------
@pytest.fixture
def switches_often() -> Any:
    """Threads take turns a thousand times as often as they would."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(5e-6)
    yield
    sys.setswitchinterval(before)


def moving(k: int) -> dict[str, Any]:
    """One of several calibrations, so that plans are built, found and dropped."""
    generator = torch.Generator().manual_seed(k)
    images = torch.randint(0, 256, (2, 3, *misuse.SIZE), generator=generator, dtype=torch.uint8)
    return {"images": images, "rig": misuse.rig(spread_deg=30.0 + k % 7), "scene": f"s{k}"}


@pytest.mark.usefixtures("switches_often")
def test_memory_comes_back_while_its_lock_is_held() -> None:
    """The garbage collector may free an array in the thread that asks for another."""
    memory = Memory()

    def free_within() -> None:
        array = memory.empty((1 << 20,), np.uint8)
        with memory._lock:
            del array

    thread = threading.Thread(target=free_within, daemon=True)
    thread.start()
    thread.join(10)
    assert not thread.is_alive()


@pytest.mark.usefixtures("switches_often")
@pytest.mark.parametrize(
    "settings",
    [
        {"cache": PlanCache(max_bytes=2**30)},
        {"cache": PlanCache(max_bytes=20_000)},  # plans are dropped all the time
        pytest.param(
            {"match_exposure": True, "quality": "accurate", "cache": PlanCache(max_bytes=1)}, marks=pytest.mark.slow
        ),
    ],
)
def test_threads_do_not_disturb_each_other(settings: dict[str, Any]) -> None:
    retarget = RigRetarget(misuse.rig().shifted(z_m=0.2), geometry="street", **settings)
    count = 70 if "quality" not in settings else 20
    fresh = RigRetarget(
        misuse.rig().shifted(z_m=0.2), geometry="street", **{**settings, "cache": PlanCache(max_bytes=2**29)}
    )
    with ThreadPoolExecutor(4) as threads:
        rendered = list(threads.map(lambda k: retarget(moving(k % 35))["images"], range(count)))
    for k, images in enumerate(rendered):
        assert torch.equal(images, fresh(moving(k % 35))["images"])
    assert retarget.renderer.plans.misses <= count
    assert retarget.renderer.plans.size <= retarget.cache.max_bytes or len(retarget.renderer.plans) == 1


def test_files_that_mutations_found(boundaries: Boundaries) -> None:
    """Each was another package's exception."""
    frames = [{"name": "0000", "time_s": 10**400}, {"name": "0001", "time_s": 1.0}]
    infinite = io.BytesIO()
    with np.load(boundaries.depths.path("0000")) as file:
        np.savez(infinite, **{**file, "format": np.array(np.inf)})
    for file, content, read, message in (
        ("drive/sequence.json", json.dumps({"frames": frames}).encode(), FrameFolder, "expected .* got OverflowError"),
        ("depth/0000.npz", infinite.getvalue(), None, "expected depth of a frame, got OverflowError; delete it"),
    ):
        path = boundaries.root / file
        sound = path.read_bytes()
        path.write_bytes(content)
        with pytest.raises(ArbiviewError, match=rf"{path.name}: {message}"):
            read(path.parent) if read else boundaries.depths.read("0000", FRAMES)
        path.write_bytes(sound)
