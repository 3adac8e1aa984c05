"""Completion of pixels that no camera saw, by CVC-SSL: latent diffusion with geometry-guided cross-view attention.

Needs diffusers and safetensors, imported where they are used: ``pip install arbiview_aug[generator]``.

- ``correspondence``, ``attention``: geometry-guided cross-view attention; ``conditioning``: conditions and cameras;
- ``denoiser``: the networks; ``sampler``: the reverse process; ``completion``: inference on frames;
- ``generator``: ``Generator``, which loads and saves them; ``inpainter``: ``Diffusion``, which fills views by one.
"""

from typing import Any

from arbiview_aug.choices import removed_name
from arbiview_aug.generator.completion import Completed
from arbiview_aug.generator.config import GeneratorConfig, compact, inpaint, paper, small, tiny
from arbiview_aug.generator.generator import Generator
from arbiview_aug.generator.inpainter import Diffusion, load_inpainter

__all__ = [
    "Completed",
    "Diffusion",
    "Generator",
    "GeneratorConfig",
    "compact",
    "inpaint",
    "load_inpainter",
    "paper",
    "small",
    "tiny",
]


def __getattr__(name: str) -> Any:
    """Old names raise an error that gives the new one."""
    raise removed_name(__name__, name)
