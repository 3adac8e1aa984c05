"""Completion of pixels that no camera saw, by CVC-SSL: latent diffusion with geometry-guided cross-view attention.

Needs diffusers and safetensors, imported where they are used: ``pip install arbiview_aug[generator]``.

- ``correspondence``, ``attention``: geometry-guided cross-view attention;
- ``conditioning``, ``geometry``: conditions and cameras as tensors;
- ``denoiser``, ``autoencoder``, ``networks``: the networks; ``sampler``: the reverse process;
- ``completion``: inference on a frame; ``batches``: on the output of transforms;
- ``generator``: ``Generator``, which loads and saves them; ``fillers``, ``inpainting``: filling without a network;
- ``pretrained``, ``crops``: inpainting networks that others trained, on windows around the holes.
"""

from arbiview_aug.generator.batches import CompletedLoader
from arbiview_aug.generator.completion import Completed
from arbiview_aug.generator.config import GeneratorConfig, compact, inpaint, paper, small, tiny
from arbiview_aug.generator.generator import Generator, load_generator
from arbiview_aug.generator.pretrained import HoleFiller, PipelineFiller, TorchScriptFiller

__all__ = [
    "Completed",
    "CompletedLoader",
    "Generator",
    "GeneratorConfig",
    "HoleFiller",
    "PipelineFiller",
    "TorchScriptFiller",
    "compact",
    "inpaint",
    "load_generator",
    "paper",
    "small",
    "tiny",
]
