"""A generator's own folder: what is saved is loaded, what is broken is refused, what is half written is not seen."""

from __future__ import annotations

import hashlib
import json
import math
import os
import socket
import zlib
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import safetensors.torch
import torch

from arbiview_aug.errors import GeneratorError, OutputError
from arbiview_aug.generator import Generator, compact, paper, small, tiny
from arbiview_aug.generator.checkpoint import write_checkpoint
from arbiview_aug.generator.config import AutoencoderConfig, GeneratorConfig, UNetConfig, from_plain
from tests.generator.small import small_config


def weights(folder: Path) -> Path:
    (file,) = folder.glob("weights-*.safetensors")
    return file


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
    assert sorted(p.name for p in (tmp_path / "a" / "b").iterdir()) == ["config.json", weights(tmp_path / "a/b").name]


@pytest.mark.slow
def test_with_an_autoencoder_frozen_or_in_half_precision(tmp_path: Path) -> None:
    vae = AutoencoderConfig(widths=(16, 16), layers=1, latent_channels=4, norm_groups=8, scale=0.7)
    made = Generator.from_config(small_config(autoencoder=vae, frozen_unet=True, prompt_tokens=3))
    deepcopy(made).half().save_pretrained(tmp_path)
    loaded = Generator.from_pretrained(tmp_path)
    assert loaded.autoencoder.scale == loaded.config.autoencoder.scale == 0.7
    for name, value in made.state_dict().items():
        found = loaded.state_dict()[name]
        assert found.dtype == value.dtype == torch.float32 and torch.allclose(found, value, atol=1e-3), name
    own = {id(p) for p in made.denoiser.own_parameters()}
    assert all(p.requires_grad == (id(p) in own) for p in made.parameters())
    assert not any(p.requires_grad for p in loaded.parameters())  # to be used, not trained
    size = weights(tmp_path).stat().st_size
    assert size < 2.1 * sum(p.numel() for p in made.parameters()) + 1e5


def test_a_checkpoint_is_replaced_whole(generator: Generator, tmp_path: Path) -> None:
    generator.save_pretrained(tmp_path)
    other = Generator.from_config(small_config(name="other"))
    other.save_pretrained(tmp_path)
    assert_same(other, Generator.from_pretrained(tmp_path))
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("moment", ["weights", "flush", "config"])
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


def test_a_process_killed_while_writing_leaves_the_old_checkpoint(generator: Generator, tmp_path: Path) -> None:
    """Leftovers of a killed save are not read, and gone after the next save."""
    generator.save_pretrained(tmp_path)
    host = f"{zlib.crc32(socket.gethostname().encode()):08x}"
    part = tmp_path / f".weights-123456789abc.safetensors.-{host}-999999999-01234567.part"
    orphan = tmp_path / f"weights-{hashlib.sha256(b'whole').hexdigest()[:12]}.safetensors"
    part.write_bytes(b"half")
    orphan.write_bytes(b"whole")
    others = {tmp_path / "weights-best.safetensors", tmp_path / "weights-000000000000.safetensors"}
    for other in others:
        other.write_bytes(b"not ours")
    assert_same(generator, Generator.from_pretrained(tmp_path))
    generator.save_pretrained(tmp_path)
    assert not part.exists() and not orphan.exists()
    assert len(list(tmp_path.iterdir())) == 4 and all(other.exists() for other in others)


NAME = "denoiser.unet.conv_in.weight"


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t: {k: v for k, v in t.items() if k != NAME}, rf'Missing key\(s\) in state_dict: "{NAME}"'),
        (lambda t: {**t, "lora.up": torch.zeros(2)}, r'Unexpected key\(s\) in state_dict: "lora.up"'),
        (lambda t: {**t, NAME: torch.zeros(32, 4, 3, 3)}, rf"size mismatch for {NAME}: .*\[32, 4, 3.*\[32, 14, 3, 3\]"),
        (lambda t: {**t, NAME: t[NAME] * torch.nan}, "conv_in.weight: expected finite weights, got NaN or infinity"),
        (lambda t: {**t, NAME: t[NAME] / 0}, "conv_in.weight: expected finite weights, got NaN or infinity"),
        (lambda t: {**t, NAME: t[NAME].to(torch.int32)}, "expected torch.float32 or alike, got torch.int32"),
        (lambda t: {**t, NAME: t[NAME].to(torch.complex64)}, "expected torch.float32 or alike, got torch.complex64"),
    ],
)
def test_wrong_weights_are_named(generator: Generator, tmp_path: Path, change: Any, match: str) -> None:
    generator.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    tensors = change(safetensors.torch.load_file(weights(tmp_path)))
    write_checkpoint(tmp_path, {key: config[key] for key in config.keys() - {"format", "weights"}}, tensors)
    with pytest.raises(GeneratorError, match=match):
        Generator.from_pretrained(tmp_path)


def test_damaged_weights_are_named(generator: Generator, tmp_path: Path) -> None:
    generator.save_pretrained(tmp_path)
    file = weights(tmp_path)
    whole = file.read_bytes()
    flipped = whole[:-1] + bytes([whole[-1] ^ 1])
    for broken, message in ((whole[:1000], "expected readable"), (flipped, "expected the checksum in its name")):
        file.write_bytes(broken)
        with pytest.raises(GeneratorError, match=message):
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


ELSEWHERE = "/etc/passwd", "../weights-0123456789ab.safetensors", "a/b.safetensors", "elsewhere", 3, None


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda config: "{", "expected a generator's configuration"),
        (lambda config: [1], "expected a generator's configuration"),
        (changed("format", to=9), "expected format 1, got 9"),
        *((changed("weights", to=name), "weights: expected the name of a file beside it") for name in ELSEWHERE),
        (changed("generator", "colour", to=1), "expected keys among .*got colour"),
        (changed("generator", "unet", "context_width", to=768), r"size mismatch for denoiser.unet.*\[\d+, 768\]"),
        (changed("trained_on", to={"data": 5, "seed": 0, "held_out": []}), "data: expected str, got 5"),
        # absurd sizes, before they are built
        (changed("generator", "unet", "layers", to=10**9), "layers: expected whole numbers up to"),
        (changed("generator", "unet", "widths", to=[32] * 1000), "widths: expected whole numbers up to"),
        (changed("generator", "unet", "widths", to=[2**40, 32, 32]), "widths: expected whole numbers up to"),
        (changed("generator", "unet", "context_width", to=10**12), "context_width: expected whole numbers up to"),
        (changed("generator", "autoencoder", "patch", to=10**6), "patch: expected whole numbers up to"),
        (changed("generator", "image_size", to=[10**7, 10**7]), "image_size: expected whole numbers up to"),
        (changed("generator", "prompt_tokens", to=-1), "prompt_tokens: expected whole numbers up to"),
        # other types
        (changed("generator", "unet", "layers", to=2.5), "layers: expected int, got"),
        (changed("generator", "unet", "layers", to=[1]), "layers: expected int, got"),
        (changed("generator", "prompt_tokens", to=[2]), "prompt_tokens: expected int, got"),
        (changed("generator", "one_step", to="no"), "one_step: expected bool, got"),
        (changed("generator", "name", to=7), "name: expected str, got"),
        (changed("generator", "prediction", to=[7]), "prediction: expected epsilon or v_prediction, got"),
        (changed("generator", "image_size", to=[32, [56]]), "image_size: expected tuple"),
        (changed("generator", "strength", to=True), "strength: expected float, got"),
    ],
)
def test_wrong_configurations_are_named(generator: Generator, tmp_path: Path, change: Any, match: str) -> None:
    with pytest.raises(GeneratorError, match=r"expected a generator's folder with config.json"):
        Generator.from_pretrained(tmp_path)
    generator.save_pretrained(tmp_path)
    made = change(json.loads((tmp_path / "config.json").read_text()))
    (tmp_path / "config.json").write_text(made if isinstance(made, str) else json.dumps(made))
    with pytest.raises(GeneratorError, match=match) as error:
        Generator.from_pretrained(tmp_path)
    assert len(str(error.value).replace(str(tmp_path), "")) < 700


@pytest.mark.parametrize("make", [paper, small, compact, tiny])
def test_configurations_survive_json(make) -> None:
    config = make()
    assert from_plain(GeneratorConfig, json.loads(json.dumps(asdict(config))), "config") == config


LEVELS: dict[str, Any] = {"widths": (32, 32), "transformers": (False, True)}


@pytest.mark.parametrize(
    ("kind", "values", "match"),
    [
        (
            small_config,
            {"image_size": (30, 56), "autoencoder": compact().autoencoder},
            "two multiples of 4, got .30, 5",
        ),
        (small_config, {"image_size": 32}, "image_size: expected .*, got 32"),
        (small_config, {"image_size": (32, 56, 3)}, "image_size: expected two"),
        (small_config, {"prediction": "epsilon"}, "zero_snr: expected False with prediction 'epsilon'"),
        (small_config, {"prediction": "epsilon", "zero_snr": False}, "residual: expected False with prediction"),
        (small_config, {"prediction": "sample"}, "prediction: expected epsilon or v_prediction, got 'sample'"),
        (small_config, {"temperature": 1.5}, r"temperature: expected a value in \[0, 1\], got 1.5"),
        (small_config, {"strength": 0.0}, r"strength: expected a value in \(0, 1\], got 0.0"),
        (small_config, {"lora_rank": 4}, "lora_rank: expected 0 without frozen_unet, got 4"),  # the rest stays random
        *((small_config, {"facing_m": x}, "facing_m: expected a finite") for x in (0.0, -5.0, math.nan)),
        (AutoencoderConfig, {"patch": 2, "widths": (32,)}, "patch: expected 1"),
        (AutoencoderConfig, {"patch": 2}, "latent_channels: expected 12, 3 patch², got 3"),
        (AutoencoderConfig, {"widths": (32,), "norm_groups": 0}, "norm_groups: expected at least 1, got 0"),
        (UNetConfig, {**LEVELS, "cross_view": (False, False)}, "cross_view: expected 2 values, one of them true"),
        (UNetConfig, {**LEVELS, "heads": (8,)}, r"heads: expected 2 values above 0, got \(8,\)"),
        (UNetConfig, {"widths": (48,), "transformers": (True,)}, "expected multiples of 32"),
        *(
            (UNetConfig, {**LEVELS, n: 0}, f"{n}: expected at least 1")
            for n in ("layers", "context_width", "norm_groups")
        ),
    ],
)
def test_impossible_configurations_are_refused(kind: Any, values: Any, match: str) -> None:
    with pytest.raises(GeneratorError, match=match):
        kind(**values)
