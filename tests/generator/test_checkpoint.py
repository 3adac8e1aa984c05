"""A generator's own folder: what is saved is loaded, what is broken is refused, what is half written is not seen."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import safetensors.torch
import torch

from arbiview_aug.errors import GeneratorError, OutputError
from arbiview_aug.generator import PRESETS, Generator
from arbiview_aug.generator.config import AutoencoderConfig, UNetConfig
from arbiview_aug.generator.generator import FILE, read_checkpoint, write_checkpoint
from tests.generator.small import small_config


def assert_same(one: Generator, other: Generator) -> None:
    assert one.config == other.config
    expected, found = one.state_dict(), other.state_dict()
    assert list(expected) == list(found)
    assert all(torch.equal(expected[name], found[name]) for name in expected)


def test_what_is_saved_is_loaded(generator: Generator, tmp_path: Path) -> None:
    generator.save_pretrained(tmp_path / "a" / "b")
    loaded = Generator.from_pretrained(tmp_path / "a" / "b")
    assert_same(generator, loaded)
    assert not loaded.training
    assert not any(p.is_meta for p in [*loaded.parameters(), *loaded.buffers()])
    assert sorted(p.name for p in (tmp_path / "a" / "b").iterdir()) == [FILE]


def test_a_checkpoint_is_replaced_whole(generator: Generator, tmp_path: Path) -> None:
    generator.save_pretrained(tmp_path)
    other = Generator.from_config(small_config(name="other"))
    other.save_pretrained(tmp_path)
    assert_same(other, Generator.from_pretrained(tmp_path))
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("moment", ["checkpoint", "flush"])
def test_a_full_disk_leaves_the_old_checkpoint(generator: Generator, tmp_path: Path, moment: str) -> None:
    generator.save_pretrained(tmp_path)
    other = Generator.from_config(small_config(name="other"))
    full, plain = OSError(28, "No space left on device"), os.replace

    def replace(part: Path, path: Path) -> None:
        if path.name.startswith(moment):
            raise full
        plain(part, path)

    failing = mock.patch("os.fsync", side_effect=full) if moment == "flush" else mock.patch("os.replace", replace)
    with failing, pytest.raises(OutputError, match="No space left"):
        other.save_pretrained(tmp_path)
    assert_same(generator, Generator.from_pretrained(tmp_path))
    assert not list(tmp_path.glob(".*"))


NAME = "denoiser.unet.conv_in.weight"


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t: {k: v for k, v in t.items() if k != NAME}, rf'Missing key\(s\) in state_dict: "{NAME}"'),
        (lambda t: {**t, "lora.up": torch.zeros(2)}, r'Unexpected key\(s\) in state_dict: "lora.up"'),
        (lambda t: {**t, NAME: torch.zeros(32, 4, 3, 3)}, rf"size mismatch for {NAME}: .*\[32, 4, 3.*\[32, 14, 3, 3\]"),
        (lambda t: {**t, NAME: t[NAME] * torch.nan}, "conv_in.weight: expected finite weights, got NaN or infinity"),
        (lambda t: {**t, NAME: t[NAME].to(torch.int32)}, "expected torch.float32 or alike, got torch.int32"),
    ],
)
def test_wrong_weights_are_named(generator: Generator, tmp_path: Path, change: Any, match: str) -> None:
    generator.save_pretrained(tmp_path)
    config, tensors = read_checkpoint(tmp_path)
    write_checkpoint(tmp_path, config, change(tensors))
    with pytest.raises(GeneratorError, match=match):
        Generator.from_pretrained(tmp_path)


def test_damaged_weights_are_named(generator: Generator, tmp_path: Path) -> None:
    generator.save_pretrained(tmp_path)
    file = tmp_path / FILE
    bare = safetensors.torch.save({NAME: torch.zeros(2)})
    nested = safetensors.torch.save({}, {"config": "[" * 3000})
    for broken in (file.read_bytes()[:1000], bare, nested, b"{"):
        file.write_bytes(broken)
        with pytest.raises(GeneratorError, match="expected a readable checkpoint, got "):
            Generator.from_pretrained(tmp_path)


def changed(*path: str, to: Any) -> Any:
    """A change of one value of a configuration as plain data."""

    def change(config: dict[str, Any]) -> dict[str, Any]:
        part = config
        for name in path[:-1]:
            part = part[name]
        part[path[-1]] = to
        return config

    return change


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (changed("format", to=9), "expected format 2, got 9"),
        (changed("generator", "colour", to=1), "expected keys among .*got colour"),
        (changed("generator", "unet", "context_width", to=768), r"size mismatch for denoiser.unet.*\[\d+, 768\]"),
        # absurd sizes, before they are built
        (changed("generator", "unet", "layers", to=10**9), "layers: expected whole numbers from 1 to 16"),
        (changed("generator", "image_size", to=[10**7, 10**7]), "image_size: expected whole numbers from 1 to"),
        (changed("generator", "prompt_tokens", to=-1), "prompt_tokens: expected whole numbers from 0 to"),
        # other types
    ],
)
def test_wrong_configurations_are_named(generator: Generator, tmp_path: Path, change: Any, match: str) -> None:
    with pytest.raises(GeneratorError, match=r"expected a generator's folder with checkpoint.safetensors"):
        Generator.from_pretrained(tmp_path)
    generator.save_pretrained(tmp_path)
    config, tensors = read_checkpoint(tmp_path)
    write_checkpoint(tmp_path, change(config), tensors)
    with pytest.raises(GeneratorError, match=match) as error:
        Generator.from_pretrained(tmp_path)
    assert len(str(error.value).replace(str(tmp_path), "")) < 700


LEVELS: dict[str, Any] = {"widths": (32, 32), "transformers": (False, True)}


@pytest.mark.parametrize(
    ("kind", "values", "match"),
    [
        (
            small_config,
            {"image_size": (30, 56), "autoencoder": PRESETS["compact"].autoencoder},
            "two multiples of 4, got .30, 5",
        ),
        (small_config, {"prediction": "epsilon"}, "zero_snr: expected False with prediction 'epsilon'"),
        (small_config, {"strength": 0.0}, r"strength: expected a value in \(0, 1\], got 0.0"),
        (AutoencoderConfig, {"patch": 2, "widths": (32,)}, "patch: expected 1"),
        (UNetConfig, {**LEVELS, "cross_view": (False, False)}, "cross_view: expected 2 values, one of them true"),
        (UNetConfig, {"widths": (48,), "transformers": (True,)}, "expected multiples of 32"),
        *(
            (UNetConfig, {**LEVELS, n: 0}, f"{n}: expected whole numbers from 1 to")
            for n in ("layers", "context_width", "norm_groups")
        ),
    ],
)
def test_impossible_configurations_are_refused(kind: Any, values: Any, match: str) -> None:
    with pytest.raises(GeneratorError, match=match):
        kind(**values)


@pytest.mark.slow
def test_nothing_is_imported_while_tensors_are_made_on_meta(generator: Generator, tmp_path: Path) -> None:
    """In a process where nothing was imported before: torch 2.6 cannot import ``torch._dynamo`` then."""
    code = """
import sys
import torch
from arbiview_aug.generator import Generator

class Watch:
    def find_spec(self, name, path=None, target=None):
        if torch.empty(0).device.type == "meta":
            found.append(name)

found = []
sys.meta_path.insert(0, Watch())
Generator.from_pretrained(sys.argv[1])
assert "diffusers" in sys.modules and not found, found
"""
    generator.save_pretrained(tmp_path)
    command = [sys.executable, "-c", code, str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500)
    assert done.returncode == 0, done.stderr
