"""Completion of pixels that no camera saw, by CVC-SSL: latent diffusion with geometry-guided cross-view attention.

Needs diffusers and safetensors, imported where they are used: ``pip install arbiview_aug[generator]``.

- ``attention``: geometry-guided cross-view attention; ``conditioning``: conditions and cameras;
- ``denoiser``: the networks; ``generator``: ``Generator``, which loads and saves them;
- ``completion``: views from their conditions by the reverse process; ``Diffusion``, which fills frames by one.
"""

from typing import TYPE_CHECKING

from arbiview_aug.environment import lazy_names

if TYPE_CHECKING:
    from arbiview_aug.generator.completion import Diffusion as Diffusion
    from arbiview_aug.generator.completion import load_inpainter as load_inpainter
    from arbiview_aug.generator.config import PRESETS as PRESETS
    from arbiview_aug.generator.config import GeneratorConfig as GeneratorConfig
    from arbiview_aug.generator.generator import Generator as Generator
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
