"""Inpainters fill pixels of rendered views that no source shows: one protocol, ``Inpainter``, and its implementations.

- ``continued``: the default, the background continued behind objects, and the mean colour;
- ``networks``: inpainting networks that others trained;
- ``neighbours``: other frames of the drive, which fill before any of these;
- ``inpainter``: the protocol, filling after collating, and Telea's fast marching.

The diffusion generator's inpainter is ``arbiview_aug.generator.Diffusion``.
"""

from typing import TYPE_CHECKING

from arbiview_aug.environment import lazy_names

if TYPE_CHECKING:
    from arbiview_aug.inpaint.continued import Continue as Continue
    from arbiview_aug.inpaint.continued import Mean as Mean
    from arbiview_aug.inpaint.inpainter import Black as Black
    from arbiview_aug.inpaint.inpainter import Inpainter as Inpainter
    from arbiview_aug.inpaint.inpainter import Telea as Telea
    from arbiview_aug.inpaint.networks import NetworkInpainter as NetworkInpainter
    from arbiview_aug.inpaint.networks import PipelineInpainter as PipelineInpainter
    from arbiview_aug.inpaint.networks import TorchScriptInpainter as TorchScriptInpainter
else:
    __getattr__, __dir__, __all__ = lazy_names(__name__)
