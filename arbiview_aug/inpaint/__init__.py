"""Inpainters fill pixels of rendered views that no source shows: one protocol, ``Inpainter``, and its implementations.

- ``continued``: the default, the background continued behind objects, and the mean colour;
- ``telea``: Telea's fast marching; ``networks``, ``crops``: inpainting networks that others trained;
- ``neighbours``: other frames of the drive, which fill before any of these;
- ``inpainter``: the protocol, and filling after collating.

The diffusion generator's inpainter is ``arbiview_aug.generator.Diffusion``.
"""

from arbiview_aug.inpaint.continued import Continue, Mean
from arbiview_aug.inpaint.inpainter import Black, CompletedLoader, Inpainter
from arbiview_aug.inpaint.networks import NetworkInpainter, PipelineInpainter, TorchScriptInpainter
from arbiview_aug.inpaint.telea import Telea

__all__ = [
    "Black",
    "CompletedLoader",
    "Continue",
    "Inpainter",
    "Mean",
    "NetworkInpainter",
    "PipelineInpainter",
    "Telea",
    "TorchScriptInpainter",
]
