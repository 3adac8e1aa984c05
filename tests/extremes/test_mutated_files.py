"""Mutated sequence files, depth files, records of a conversion and generators' folders: read, or refused by name."""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from arbiview_aug.__main__ import main
from arbiview_aug.datasets import FrameFolder, Neighbours
from arbiview_aug.datasets.depth_folder import DepthFolder
from arbiview_aug.errors import ArbiviewError, DataError, GeneratorError
from arbiview_aug.generator import Generator
from arbiview_aug.generator.training.checkpointing import load_state
from arbiview_aug.generator.training.config import TrainConfig
from arbiview_aug.temporal.motion_depth import MotionDepth
from arbiview_aug.transforms.warm_up import compile_kernels
from tests.cli.convert.drives import FRAMES, command, tree, write_frames
from tests.generator.small import small_config
from tests.helpers import examples
from tests.mutations import TEXT_JUNK, mutated_bytes, mutated_json, works

FOREIGN = re.compile(r"Traceback|\b[A-Za-z]+(Error|Exception)\b: ")
"""As commands describe exceptions that are not the package's own."""


class Target:
    """Sound files in a folder of their own, one of which is mutated at a time."""

    def __init__(self, root: Path) -> None:
        compile_kernels()
        self.drive, self.output, self.generator = root / "drive", root / "output", root / "generator"
        write_frames(self.drive, 2)
        self.asked = command(self.drive, self.output, "--neighbours", "1", "--size", "12x20")
        assert main(self.asked) == 0
        self.depths = DepthFolder(root / "depth")
        rig = FrameFolder(self.drive)[0]["rig"]
        self.depths.write("0000", rig, MotionDepth(tuple(np.ones(c.size, np.float32) for c in rig), "made"))
        Generator.from_config(small_config()).save_pretrained(self.generator)
        self.training = TrainConfig(generator=small_config(), steps=1, batch=1, lr=1e-3)
        config = json.loads((self.generator / "config.json").read_text())
        config |= {"training": asdict(self.training), "step": 1}  # as the state of a training run has it
        (self.generator / "config.json").write_text(json.dumps(config))
        self.optimiser = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))])
        (weights,) = self.generator.glob("*.safetensors")
        self.files: dict[str, tuple[list[Path], Callable[[], object]]] = {
            "sequence": ([self.drive / "sequence.json"], self._read_drive),
            "depth": ([self.depths.path("0000")], lambda: self.depths.read("0000", FRAMES)),
            "record": (sorted((self.output / "conversion").rglob("*.json")), self._go_on),
            "verified record": (sorted((self.output / "conversion").rglob("*.json")), lambda: self._go_on("--verify")),
            "config": ([self.generator / "config.json"], self._read_generator),
            "weights": ([weights], self._read_generator),
        }
        self.root, self.sound = root, tree(root)

    def _read_drive(self) -> None:
        for neighbour in FrameFolder(self.drive, neighbours=Neighbours())[0]["neighbours"]:
            _ = neighbour["images"], neighbour["rig"]

    def _read_generator(self) -> None:
        with contextlib.suppress(ArbiviewError):
            load_state(self.generator, asdict(self.training), {}, {}, mock.Mock(shadow_params=[]), self.optimiser)
        Generator.from_pretrained(self.generator)

    def _go_on(self, *more: str) -> None:
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


ARRAY_CHANGES: tuple[Callable[[np.ndarray], object], ...] = (
    *(lambda a: a[..., :-1] if a.ndim else a, lambda a: a[None], lambda a: a.reshape(-1)[:0]),
    *(lambda a: a.astype(str), lambda a: np.full(a.shape, np.nan), lambda a: np.full(a.shape, np.inf)),
    *(lambda a: a.astype("U5"), lambda a: np.full(a.shape, 10**15), lambda a: np.zeros(a.shape, complex)),
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


@pytest.fixture(scope="module")
def target(tmp_path_factory: pytest.TempPathFactory) -> Target:
    return Target(tmp_path_factory.mktemp("mutated"))


@examples(60, 1000, 4000, share=(0.02, 0.8), data=st.data())
def test_mutated_files(target: Target, data: st.DataObject) -> bool:
    paths, read = target.files[data.draw(st.sampled_from(sorted(target.files)))]
    path = data.draw(st.sampled_from(paths))
    sound, text = path.read_bytes(), data.draw(mutated_file(path))
    path.unlink()  # what links to it elsewhere stays
    path.write_bytes(text)
    try:
        return works(read)
    finally:
        path.write_bytes(sound)


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
