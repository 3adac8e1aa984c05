"""Stable Diffusion's weights: the published layout by key and shape, and small folders of the same layout."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import safetensors.torch
import torch
from diffusers import AutoencoderKL, UNet2DConditionModel

from arbiview_aug.errors import GeneratorError
from arbiview_aug.generator import PRESETS, Generator, GeneratorConfig
from arbiview_aug.generator.config import AutoencoderConfig, UNetConfig
from arbiview_aug.generator.denoiser import Denoiser
from arbiview_aug.generator.generator import embedded_empty_prompt
from tests.generator.small import small_config

UNET_15 = {
    "act_fn": "silu",
    "attention_head_dim": 8,
    "block_out_channels": [320, 640, 1280, 1280],
    "center_input_sample": False,
    "cross_attention_dim": 768,
    "down_block_types": ["CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D", "DownBlock2D"],
    "downsample_padding": 1,
    "flip_sin_to_cos": True,
    "freq_shift": 0,
    "in_channels": 4,
    "layers_per_block": 2,
    "mid_block_scale_factor": 1,
    "norm_eps": 1e-05,
    "norm_num_groups": 32,
    "out_channels": 4,
    "sample_size": 64,
    "up_block_types": ["UpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "CrossAttnUpBlock2D"],
}
"""unet/config.json of Stable Diffusion 1.5 as published, without its version entries."""

VAE_15 = {
    "act_fn": "silu",
    "block_out_channels": [128, 256, 512, 512],
    "down_block_types": ["DownEncoderBlock2D"] * 4,
    "in_channels": 3,
    "latent_channels": 4,
    "layers_per_block": 2,
    "norm_num_groups": 32,
    "out_channels": 3,
    "sample_size": 512,
    "up_block_types": ["UpDecoderBlock2D"] * 4,
}
"""vae/config.json of Stable Diffusion 1.5 as published."""


def shapes(module: torch.nn.Module) -> dict[str, tuple[int, ...]]:
    return {name: tuple(value.shape) for name, value in module.state_dict().items()}


def test_the_paper_configuration_has_stable_diffusions_layout() -> None:
    """Key by key; 859,520,964 and 83,653,863 parameters, as published, and only ``conv_in`` is wider."""
    with torch.device("meta"):
        unet, vae = UNet2DConditionModel.from_config(UNET_15), AutoencoderKL.from_config(VAE_15)
        plain, made = shapes(unet), Generator.from_config(PRESETS["paper"])
        attached = Denoiser(unet, PRESETS["paper"])
    assert sum(torch.Size(s).numel() for s in plain.values()) == 859_520_964 and len(plain) == 686
    assert sum(torch.Size(s).numel() for s in shapes(vae).values()) == 83_653_863
    wide = {**plain, "conv_in.weight": (320, 16, 3, 3)}
    assert shapes(made.denoiser.unet) == shapes(attached.unet) == wide
    assert shapes(made.autoencoder.vae) == shapes(vae)
    assert shapes(made.denoiser) == shapes(attached)
    assert tuple(made.denoiser.context.empty_prompt.shape) == (77, 768)
    assert [block.to_q.in_features for block in made.denoiser.cross_view.values()] == [
        320, 640, 1280, 1280, 1280, 1280, 1280, 640, 320,
    ]  # fmt: skip


def config() -> GeneratorConfig:
    """Stable Diffusion's layout, four levels and all, in the small."""
    return small_config(
        image_size=(32, 48),
        unet=UNetConfig(
            widths=(32, 32, 64, 64), transformers=(True, True, True, False), layers=1, context_width=24,
            heads=(2, 2, 2, 2), norm_groups=8,
        ),
        autoencoder=AutoencoderConfig(widths=(16, 16, 16, 16), layers=1, latent_channels=4, norm_groups=8),
        prediction="epsilon", zero_snr=False, residual=False, frozen_unet=True,
    )  # fmt: skip


def saved(folder: Path, settings: GeneratorConfig) -> Path:
    """A folder of diffusers with random weights for these settings."""
    torch.manual_seed(0)
    UNet2DConditionModel(**settings.unet.arguments(4, 4)).save_pretrained(folder / "unet")
    vae = {**settings.autoencoder.arguments(), "scaling_factor": 0.18215}
    AutoencoderKL(**vae).save_pretrained(folder / "vae")
    return folder


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return saved(tmp_path, config())


def test_a_folder_is_loaded_and_computes_what_it_did(folder: Path, tmp_path: Path) -> None:
    made = Generator.from_stable_diffusion(folder, config())
    plain = UNet2DConditionModel.from_pretrained(folder, subfolder="unet")
    expected = plain.state_dict()
    assert list(expected) == list(made.denoiser.unet.state_dict())
    for name, value in made.denoiser.unet.state_dict().items():
        assert torch.equal(value[:, :4] if name == "conv_in.weight" else value, expected[name]), name
    assert not made.denoiser.unet.conv_in.weight[:, 4:].any()
    assert made.autoencoder.scale == 0.18215
    trained = {name for name, p in made.named_parameters() if p.requires_grad}
    assert {name.split(".")[1] for name in trained} == {"unet", "cross_view", "context", "regression"}
    assert {name for name in trained if ".unet." in name} == {
        "denoiser.unet.conv_in.weight", "denoiser.unet.conv_in.bias",
    }  # fmt: skip
    made.save_pretrained(tmp_path / "own")
    loaded = Generator.from_pretrained(tmp_path / "own")
    assert all(torch.equal(a, b) for a, b in zip(made.state_dict().values(), loaded.state_dict().values(), strict=True))
    assert loaded.autoencoder.scale == 0.18215
    image = torch.rand(2, 1, 3, 32, 48)
    assert loaded.autoencoder.decode(loaded.autoencoder.encode(image)).shape == image.shape
    assert loaded.autoencoder.encode(image).shape == (2, 1, 4, 4, 6)


def refused(folder: Path, match: str) -> None:
    with pytest.raises(GeneratorError, match=match):
        Generator.from_stable_diffusion(folder, config())


def test_weights_that_do_not_fit_are_named(folder: Path) -> None:
    file = folder / "unet" / "diffusion_pytorch_model.safetensors"
    good = safetensors.torch.load_file(file)
    safetensors.torch.save_file({k: v for k, v in good.items() if k != "conv_out.bias"}, file)
    refused(folder, r"unet: expected exactly the weights of this UNet2DConditionModel; 1 missing: conv_out.bias")
    safetensors.torch.save_file({**good, "lora.up": torch.zeros(2)}, file)
    refused(folder, r"1 that do not belong: lora.up")
    safetensors.torch.save_file({**good, "conv_out.bias": torch.zeros(7)}, file)
    refused(folder, r"(?s)expected the weights of this UNet2DConditionModel.*conv_out.bias")
    file.unlink()
    torch.save(good, folder / "unet" / "diffusion_pytorch_model.bin")  # never unpickled
    refused(folder, r"unet: expected the weights of this UNet2DConditionModel as safetensors")


@pytest.mark.parametrize(
    ("part", "entry", "value", "match"),
    [
        ("unet", "in_channels", 9, "unet: expected in_channels 4, got 9"),
        ("unet", "cross_attention_dim", 1024, "unet: expected cross_attention_dim 24, got 1024"),
        ("unet", "block_out_channels", [32, 32], r"expected block_out_channels \(32, 32, 64, 64\), got \[32, 32\]"),
        ("unet", "down_block_types", ["AttnDownBlock2D"] * 4, r"expected down_block_types \(.*got \['AttnDownBlock2D"),
        ("unet", "use_linear_projection", True, "unet: expected use_linear_projection False, got True"),
        ("unet", "only_cross_attention", [False, False, False, True], "expected only_cross_attention False, got"),
        ("vae", "use_quant_conv", False, "vae: expected use_quant_conv True, got False"),
        ("vae", "block_out_channels", 16, "vae: expected the weights of this AutoencoderKL as safetensors"),
        ("vae", "scaling_factor", None, "vae: expected a number as scaling_factor, got None"),
        ("vae", "latent_channels", 16, "vae: expected latent_channels 4, got 16"),
    ],
)
def test_other_architectures_are_named(folder: Path, part: str, entry: str, value: object, match: str) -> None:
    path = folder / part / "config.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), entry: value}))
    refused(folder, match)


def test_a_prediction_that_the_unet_was_not_trained_for_is_named(folder: Path) -> None:
    path = folder / "scheduler" / "scheduler_config.json"
    path.parent.mkdir()
    path.write_text(json.dumps({"_class_name": "DDIMScheduler", "prediction_type": "v_prediction"}))
    refused(folder, "scheduler: expected prediction_type 'epsilon', as of config 'test', got 'v_prediction'")


def test_folders_as_they_were_published_are_read(folder: Path) -> None:
    """The entries of diffusers 0.2, and unknown ones; schedulers without a prediction."""
    own, unet = config(), UNET_15
    arguments = own.unet.arguments(4, 4) | {"attention_head_dim": 2}
    for part, published, sizes in (("unet", unet, arguments), ("vae", VAE_15, own.autoencoder.arguments())):
        given = {key: sizes.get(key, value) for key, value in published.items()}
        given |= {"_class_name": "Any", "_diffusers_version": "0.2.2", "_name_or_path": "x", "entry_of_tomorrow": 1}
        (folder / part / "config.json").write_text(json.dumps(given))
    (folder / "scheduler").mkdir()
    (folder / "scheduler" / "scheduler_config.json").write_text(json.dumps({"_class_name": "PNDMScheduler"}))
    made = Generator.from_stable_diffusion(folder, own)
    assert made.autoencoder.scale == 0.18215


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    refused(tmp_path / "nothing", "expected a diffusers folder or hub id with a UNet2DConditionModel")


def test_the_text_encoder_is_loaded_completely_or_not_at_all(folder: Path) -> None:
    transformers = pytest.importorskip("transformers")
    size = {"hidden_size": 24, "intermediate_size": 32, "num_attention_heads": 2, "num_hidden_layers": 2}

    def saved_encoder(**sizes: int) -> Any:
        encoder = transformers.CLIPTextModel(transformers.CLIPTextConfig(**size, **{"vocab_size": 49408, **sizes}))
        encoder.save_pretrained(folder / "text_encoder")
        return encoder.eval()

    encoder, file = saved_encoder(), folder / "text_encoder" / "model.safetensors"
    good = safetensors.torch.load_file(file)
    published = {f"text_model.{name}": value for name, value in good.items()}
    published["text_model.embeddings.position_ids"] = torch.arange(77)[None]  # as in Stable Diffusion 1.5
    safetensors.torch.save_file(published, file, metadata={"format": "pt"})
    with torch.no_grad():
        expected = encoder(torch.tensor([[49406, *[49407] * 76]])).last_hidden_state[0]
    assert torch.allclose(embedded_empty_prompt(folder), expected, atol=1e-5)
    made = Generator.from_stable_diffusion(folder, replace(config(), prompt_tokens=77))
    assert torch.allclose(made.denoiser.context.empty_prompt, expected, atol=1e-5)
    with pytest.raises(GeneratorError, match=r"text_encoder: .* empty prompt of shape \(5, 24\), got \(77, 24\)"):
        Generator.from_stable_diffusion(folder, replace(config(), prompt_tokens=5))
    layer = [name for name in good if "layers.1." in name]
    exactly = "text_encoder: expected exactly the weights of this CLIPTextModel; "
    for tensors, match in (
        ({n: t for n, t in good.items() if n not in layer}, rf"{exactly}{len(layer)} missing: encoder.layers.1"),
        ({**good, "lora.up": torch.zeros(2)}, f"{exactly}1 that do not belong: lora.up"),
        ({**good, layer[0]: torch.zeros(7)}, "expected the weights of this CLIPTextModel as safetensors"),
    ):
        safetensors.torch.save_file(tensors, file, metadata={"format": "pt"})
        with pytest.raises(GeneratorError, match=match):
            embedded_empty_prompt(folder)
    for other in ({"vocab_size": 1000}, {"max_position_embeddings": 40}):
        saved_encoder(**other)
        with pytest.raises(GeneratorError, match="text_encoder: expected CLIP's, which reads 77 of 49408 tokens"):
            embedded_empty_prompt(folder)
