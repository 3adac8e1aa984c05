"""A generator's own folder: what is saved is loaded, what is broken is refused, what is half written is not seen."""

from __future__ import annotations

import hashlib
import json
import math
import os
import re
import socket
import zlib
from copy import deepcopy
from dataclasses import asdict
from pathlib import Path
from unittest import mock

import pytest
import safetensors.torch
import torch

from arbiview_aug.errors import GeneratorError, OutputError
from arbiview_aug.generator import Generator, compact, paper, small, tiny
from arbiview_aug.generator.checkpoint import write_checkpoint
from arbiview_aug.generator.config import AutoencoderConfig, GeneratorConfig, TrainedOn, UNetConfig, from_plain
from tests.generator.small import small_config


def weights(folder: Path) -> Path:
    (file,) = folder.glob("weights-*.safetensors")
    return file


def rewritten(folder: Path, tensors: dict[str, torch.Tensor]) -> None:
    """Other weights with the configuration of a folder."""
    config = json.loads((folder / "config.json").read_text())
    write_checkpoint(folder, {key: config[key] for key in config.keys() - {"format", "weights"}}, tensors)


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


def test_missing_extra_and_misshapen_weights_are_named(generator: Generator, tmp_path: Path) -> None:
    generator.save_pretrained(tmp_path)
    file = weights(tmp_path)
    good = safetensors.torch.load_file(file)

    def refused(tensors: dict[str, torch.Tensor], match: str) -> None:
        rewritten(tmp_path, tensors)
        with pytest.raises(GeneratorError, match=match):
            Generator.from_pretrained(tmp_path)

    name = "denoiser.unet.conv_in.weight"
    refused({k: v for k, v in good.items() if k != name}, rf'Missing key\(s\) in state_dict: "{name}"')
    refused({**good, "lora.up": torch.zeros(2)}, r'Unexpected key\(s\) in state_dict: "lora.up"')
    refused({**good, name: torch.zeros(32, 4, 3, 3)}, rf"size mismatch for {name}: .*\[32, 4, 3, 3\].*\[32, 14, 3, 3\]")
    rewritten(tmp_path, good)
    whole = file.read_bytes()
    flipped = whole[:-1] + bytes([whole[-1] ^ 1])
    for broken, message in (
        (whole[:1000], "expected readable weights"),
        (flipped, "expected the checksum in its name"),
    ):
        file.write_bytes(broken)
        with pytest.raises(GeneratorError, match=message):
            Generator.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda t: t * torch.nan, "conv_in.weight: expected finite weights, got NaN or infinity"),
        (lambda t: t / 0, "conv_in.weight: expected finite weights, got NaN or infinity"),
        (lambda t: t.to(torch.int32), "conv_in.weight: expected torch.float32 or alike, got torch.int32"),
        (lambda t: t.to(torch.complex64), "conv_in.weight: expected torch.float32 or alike, got torch.complex64"),
    ],
)
def test_weights_that_are_no_numbers_are_refused(generator: Generator, tmp_path: Path, change, match: str) -> None:
    generator.save_pretrained(tmp_path)
    tensors = safetensors.torch.load_file(weights(tmp_path))
    tensors["denoiser.unet.conv_in.weight"] = change(tensors["denoiser.unet.conv_in.weight"])
    rewritten(tmp_path, tensors)
    with pytest.raises(GeneratorError, match=match):
        Generator.from_pretrained(tmp_path)


@pytest.mark.parametrize("name", ["/etc/passwd", "../weights-0123456789ab.safetensors", "a/b.safetensors", 3, None])
def test_weights_elsewhere_are_refused(generator: Generator, tmp_path: Path, name: object) -> None:
    generator.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    (tmp_path / "config.json").write_text(json.dumps(config | {"weights": name}))
    with pytest.raises(GeneratorError, match="weights: expected the name of a file beside it"):
        Generator.from_pretrained(tmp_path)


@pytest.mark.parametrize(
    ("part", "key", "value"),
    [
        ("unet", "layers", 10**9),
        ("unet", "widths", [32] * 1000),
        ("unet", "widths", [2**40, 32, 32]),
        ("unet", "context_width", 10**12),
        ("autoencoder", "patch", 10**6),
        (None, "image_size", [10**7, 10**7]),
        (None, "prompt_tokens", -1),
    ],
)
def test_absurd_sizes_are_refused_before_they_are_built(
    generator: Generator, tmp_path: Path, part: str | None, key: str, value: object
) -> None:
    generator.save_pretrained(tmp_path)
    config = json.loads((tmp_path / "config.json").read_text())
    (config["generator"] if part is None else config["generator"][part])[key] = value
    (tmp_path / "config.json").write_text(json.dumps(config))
    with pytest.raises(GeneratorError, match=f"{key}: expected whole numbers up to") as error:
        Generator.from_pretrained(tmp_path)
    assert len(str(error.value)) < 300


@pytest.mark.parametrize(
    ("part", "key", "value", "expected"),
    [
        ("unet", "layers", 2.5, "int"),
        ("unet", "layers", [1], "int"),
        ("unet", "context_width", [32], "int"),
        (None, "prompt_tokens", [2], "int"),
        (None, "one_step", "no", "bool"),
        (None, "name", 7, "str"),
        (None, "prediction", [7], "epsilon or v_prediction"),
        (None, "image_size", [32, [56]], "tuple"),
        (None, "strength", True, "float"),
    ],
)
def test_values_of_another_type_are_refused(part: str | None, key: str, value: object, expected: str) -> None:
    config = json.loads(json.dumps(asdict(small_config())))
    (config if part is None else config[part])[key] = value
    with pytest.raises(GeneratorError, match=f"{key}: expected {expected}, got"):
        from_plain(GeneratorConfig, config, "x")
    with pytest.raises(GeneratorError, match="x: data: expected str, got 5"):
        from_plain(TrainedOn, {"data": 5, "seed": 0, "held_out": []}, "x")


def test_broken_configurations_are_named(generator: Generator, tmp_path: Path) -> None:
    with pytest.raises(GeneratorError, match=r"expected a generator's folder with config.json"):
        Generator.from_pretrained(tmp_path / "nothing")
    generator.save_pretrained(tmp_path)
    path = tmp_path / "config.json"
    good = json.loads(path.read_text())

    def refused(text: str, match: str) -> None:
        path.write_text(text)
        with pytest.raises(GeneratorError, match=match):
            Generator.from_pretrained(tmp_path)

    refused("{", "expected a generator's configuration")
    refused("[1]", "expected a generator's configuration")
    refused(json.dumps({**good, "format": 9}), "expected format 1, got 9")
    refused(json.dumps({**good, "weights": "elsewhere"}), "weights: expected the name of a file beside it")
    wide = {**good["generator"], "unet": {**good["generator"]["unet"], "context_width": 768}}
    refused(json.dumps({**good, "generator": wide}), r"size mismatch for denoiser.unet.*\[\d+, 768\]")
    refused(json.dumps({**good, "generator": {**good["generator"], "colour": 1}}), "expected keys among .*got colour")


@pytest.mark.parametrize("make", [paper, small, compact, tiny])
def test_configurations_survive_json(make) -> None:
    config = make()
    assert from_plain(GeneratorConfig, json.loads(json.dumps(asdict(config))), "config") == config


def test_impossible_configurations_are_refused() -> None:
    with pytest.raises(GeneratorError, match=r"image_size: expected two multiples of 4, got \(30, 56\)"):
        small_config(image_size=(30, 56), autoencoder=compact().autoencoder)
    with pytest.raises(GeneratorError, match="zero_snr: expected False with prediction 'epsilon'"):
        small_config(prediction="epsilon")
    with pytest.raises(GeneratorError, match="residual: expected False with prediction 'epsilon'"):
        small_config(prediction="epsilon", zero_snr=False)
    with pytest.raises(GeneratorError, match=r"temperature: expected a value in \[0, 1\], got 1.5"):
        small_config(temperature=1.5)
    with pytest.raises(GeneratorError, match="patch: expected 1"):
        small_config(autoencoder=AutoencoderConfig(patch=2, widths=(32,)))
    with pytest.raises(GeneratorError, match="latent_channels: expected 12, 3 patch², got 3"):
        AutoencoderConfig(patch=2)
    with pytest.raises(GeneratorError, match="cross_view: expected 2 values, one of them true"):
        UNetConfig(widths=(32, 32), transformers=(False, True), cross_view=(False, False))
    with pytest.raises(GeneratorError, match=r"heads: expected 2 values above 0, got \(8,\)"):
        UNetConfig(widths=(32, 32), transformers=(False, True), heads=(8,))
    for name, values in {"facing_m": (0.0, -5.0, math.nan), "image_size": (32, (64,), (32, 56, 3))}.items():
        for value in values:
            with pytest.raises(GeneratorError, match=f"{name}: expected .*, got {re.escape(str(value))}"):
                small_config(**{name: value})
    with pytest.raises(GeneratorError, match="prediction: expected epsilon or v_prediction, got 'sample'"):
        small_config(prediction="sample")
    with pytest.raises(GeneratorError, match="lora_rank: expected 0 without frozen_unet, got 4"):
        small_config(lora_rank=4)  # all but LoRA would stay random
    for name in ("layers", "context_width", "norm_groups"):
        with pytest.raises(GeneratorError, match=f"UNetConfig.{name}: expected at least 1, got 0"):
            UNetConfig(**{"widths": (32,), "transformers": (True,), name: 0})
    with pytest.raises(GeneratorError, match=r"AutoencoderConfig\.norm_groups: expected at least 1, got 0"):
        AutoencoderConfig(widths=(32,), norm_groups=0)
    with pytest.raises(GeneratorError, match=r"strength: expected a value in \(0, 1\], got 0.0"):
        small_config(strength=0.0)
    with pytest.raises(GeneratorError, match="expected multiples of 32"):
        small_config(unet={"widths": (48,)} and type(tiny().unet)(widths=(48,), transformers=(True,)))
