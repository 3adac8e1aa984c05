"""Completing what no camera saw: the CVC-SSL model, a latent diffusion with geometry-guided cross-view attention.

Needs diffusers and safetensors, imported where they are used: ``pip install arbiview_aug[generator]``.

- ``correspondence``: where a token looks in other views; ``attention``: how it reads them;
- ``conditioning``: what else the denoiser is told; ``geometry``: a frame's cameras for both;
- ``denoiser``: the U-Net with all of it; ``autoencoder``: between images and latents;
- ``sampler``: the reverse process; ``completion``: inference on a frame; ``batches``: on what transforms give;
- ``networks``: denoiser and autoencoder; ``generator``: ``Generator``, which loads and saves them.
"""

from arbiview_aug.generator.batches import CompletedLoader
from arbiview_aug.generator.completion import Completed
from arbiview_aug.generator.config import GeneratorConfig, compact, paper, small, tiny
from arbiview_aug.generator.generator import Generator

__all__ = ["Completed", "CompletedLoader", "Generator", "GeneratorConfig", "compact", "paper", "small", "tiny"]
