"""Mutated sequence files, depth files, records of a conversion and generators' folders: read, or refused by name."""

from __future__ import annotations

import contextlib
import io
import json
import os
import random
import re
import warnings
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from arbiview_aug.__main__ import main
from arbiview_aug.datasets import FrameFolder, Neighbours
from arbiview_aug.datasets.depth_folder import DepthFolder
from arbiview_aug.errors import ArbiviewError, DataError, GeneratorError
from arbiview_aug.generator import Generator
from arbiview_aug.generator.training.checkpointing import saved_config
from arbiview_aug.generator.training.config import TrainConfig
from arbiview_aug.render.plan import compile_kernels
from arbiview_aug.temporal.motion_depth import MotionDepth
from tests.cli.convert.drives import FRAMES, command, tree, write_frames
from tests.extremes.misuse import TEXT_JUNK, mutated_text
from tests.extremes.test_misuse import works_or_refuses
from tests.generator.small import small_config
from tests.helpers import few_or_all

FOREIGN = re.compile(r"Traceback|\b[A-Za-z]+(Error|Exception)\b: ")
"""As commands describe exceptions that are not the package's own."""


class Target:
    """Sound files in a folder of their own, one of which is mutated at a time."""

    def __init__(self, root: Path) -> None:
        compile_kernels()
        self.drive, self.output, self.generator = root / "drive", root / "output", root / "generator"
        write_frames(self.drive, 2)
        self.asked = command(self.drive, self.output, "--neighbours", "1")
        self.asked[self.asked.index("--size") + 1] = "12x20"
        assert main(self.asked) == 0
        self.depths = DepthFolder(root / "depth")
        rig = FrameFolder(self.drive)[0]["rig"]
        self.depths.write("0000", rig, MotionDepth(tuple(np.ones(c.size, np.float32) for c in rig), "made"))
        Generator.from_config(small_config()).save_pretrained(self.generator)
        self.training = TrainConfig(generator=small_config(), steps=1, batch=1, lr=1e-3)
        config = json.loads((self.generator / "config.json").read_text())
        config["training"] = asdict(self.training)  # as the state of a training run has it
        (self.generator / "config.json").write_text(json.dumps(config))
        self.records = sorted((self.output / "conversion").rglob("*.json"))
        self.root, self.sound = root, tree(root)

    def try_out(self, seed: int) -> bool:
        """Whether what reads a mutated file works; the file is mended again."""
        rng = random.Random(seed)
        ways = (self._sequence, self._sequence, self._depth, self._depth, self._record, self._config, self._weights)
        path, call = rng.choice(ways)(rng)
        sound = path.read_bytes()
        text = _mutated_arrays(sound, rng) if path.suffix == ".npz" else None
        if path.suffix == ".json":
            text = mutated_text(json.loads(sound), rng)
        path.unlink()  # what links to it elsewhere stays
        path.write_bytes(text or _mutated_bytes(sound, rng))
        try:
            return works_or_refuses(call, seed, (ArbiviewError,))
        finally:
            path.write_bytes(sound)

    def _sequence(self, rng: random.Random) -> tuple[Path, Callable[[], object]]:
        return self.drive / "sequence.json", self._read_drive

    def _depth(self, rng: random.Random) -> tuple[Path, Callable[[], object]]:
        return self.depths.path("0000"), lambda: self.depths.read("0000", FRAMES)

    def _record(self, rng: random.Random) -> tuple[Path, Callable[[], object]]:
        more = rng.choice(([], ["--verify"]))
        return rng.choice(self.records), lambda: self._converted(more)

    def _config(self, rng: random.Random) -> tuple[Path, Callable[[], object]]:
        return self.generator / "config.json", self._read_generator

    def _weights(self, rng: random.Random) -> tuple[Path, Callable[[], object]]:
        (weights,) = self.generator.glob("*.safetensors")
        return weights, self._read_generator

    def _read_drive(self) -> None:
        for neighbour in FrameFolder(self.drive, neighbours=Neighbours())[0]["neighbours"]:
            _ = neighbour["images"], neighbour["rig"]

    def _read_generator(self) -> None:
        with contextlib.suppress(ArbiviewError):
            saved_config(self.generator, self.training)
        Generator.from_pretrained(self.generator)

    def _converted(self, more: list[str]) -> None:
        """Go on with the conversion, or verify it; nothing changes outside its own folder."""
        said, before = io.StringIO(), self._outside()
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(said), mock.patch.object(os, "fsync"):
            status = main([*self.asked, *more])
        assert status in (0, 1, 2) and not FOREIGN.search(said.getvalue()), said.getvalue()
        assert self._outside() == before
        if status:
            raise ArbiviewError(said.getvalue())

    def _outside(self) -> dict[str, bytes]:
        return {name: content for name, content in tree(self.root).items() if not name.startswith("output/conversion/")}


def _mutated_bytes(sound: bytes, rng: random.Random) -> bytes:
    found = bytearray(sound[: rng.choice((len(sound), len(sound), rng.randrange(len(sound))))])
    for _ in range(rng.randrange(1, 6)):
        found[rng.randrange(min(len(found), rng.choice((300, len(found))))) if found else slice(0)] = rng.randrange(256)
    return bytes(found)


def _mutated_arrays(sound: bytes, rng: random.Random) -> bytes | None:
    """A file of arrays, one of which is missing, of another type or shape, or not finite; None for mutated bytes."""
    if rng.random() < 0.3:
        return None
    with np.load(io.BytesIO(sound)) as file:
        arrays = {name: file[name] for name in file.files}
    name = rng.choice(sorted(arrays))
    array = arrays.pop(name)
    if rng.random() < 0.9:
        ways: tuple[Callable[[], object], ...] = (
            *(lambda: array[..., :-1] if array.ndim else array, lambda: array[None], lambda: array.reshape(-1)[:0]),
            *(lambda: array.astype(str), lambda: np.full(array.shape, np.nan), lambda: np.full(array.shape, np.inf)),
            *(lambda: array.astype("U5"), lambda: np.full(array.shape, 10**15), lambda: np.zeros(array.shape, complex)),
            lambda: np.array(str(rng.choice(TEXT_JUNK)())),
        )
        arrays[name] = np.asarray(rng.choice(ways)())
    written = io.BytesIO()
    np.savez(written, **arrays)  # type: ignore[arg-type]
    return written.getvalue()


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Target:
    return Target(tmp_path_factory.mktemp("mutated"))


def check(target: Target, seeds: range) -> None:
    with warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        worked = sum(map(target.try_out, seeds))
    assert 0.02 < worked / len(seeds) < 0.8, "the mutations reach what is behind the first check"


def test_mutated_files(target: Target) -> None:
    check(target, range(60))


def test_what_the_mutations_found(target: Target) -> None:
    """Each was another package's exception."""
    frames = [{"name": "0000", "time_s": 10**400}, {"name": "0001", "time_s": 1.0}]
    (target.drive / "sequence.json").write_text(json.dumps({"frames": frames}))
    with pytest.raises(DataError, match=r"sequence\.json: expected .* got OverflowError"):
        FrameFolder(target.drive)
    (target.generator / "config.json").write_text("[" * 3000)
    with pytest.raises(GeneratorError, match=r"config\.json: expected a generator's configuration"):
        Generator.from_pretrained(target.generator)
    with np.load(target.depths.path("0000")) as file:
        arrays = {name: file[name] for name in file.files}
    np.savez(target.depths.path("0000"), **{**arrays, "format": np.array(np.inf)})
    with pytest.raises(DataError, match=r"0000\.npz: expected depth of a frame, got OverflowError; delete it"):
        target.depths.read("0000", FRAMES)
    for name in ("drive/sequence.json", "generator/config.json", "depth/0000.npz"):
        (target.root / name).write_bytes(target.sound[name])


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("thousands", few_or_all(1, 4, "thousand"))
def test_thousands_of_mutated_files(target: Target, thousands: int) -> None:
    check(target, range(60, 60 + 1000 * thousands))
