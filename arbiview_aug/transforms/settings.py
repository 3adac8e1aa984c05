"""Checks of a transform's settings."""

from __future__ import annotations

import operator
from collections.abc import Sequence
from numbers import Real
from typing import Any

from arbiview_aug.cameras.validation import MAX_SIZE_PX
from arbiview_aug.errors import SampleError
from arbiview_aug.generator import Generator, HoleFiller
from arbiview_aug.generator.batches import SOURCES_KEY, Completion

OUTPUTS = ("source_camera", "source_frame", "confidence", SOURCES_KEY)  # further keys of the output, on request


def completion_of(
    path: str,
    generator: Generator | HoleFiller | None,
    steps: int | None,
    guidance: float | None,
    min_confidence: float,
    seed: int,
) -> Completion | None:
    """Checked settings of inpainting or a generator, else ValueError; None for ``path="favs"``."""
    if path != "diffusion" and any(value is not None for value in (generator, steps, guidance)):
        raise ValueError(f"generator, steps, guidance: they are for path='diffusion', got path={path!r}")
    if path == "favs":
        if min_confidence or seed:
            raise ValueError("min_confidence, seed: they are for path='inpaint' or 'diffusion', got path='favs'")
        return None
    if generator is not None and not isinstance(generator, Generator | HoleFiller):
        expected = "Generator.from_pretrained(DIR), a PipelineFiller or a TorchScriptFiller"
        raise ValueError(f"generator: expected {expected}, got {type(generator).__name__}")
    if steps is not None and (not isinstance(steps, int) or isinstance(steps, bool) or steps < 1):
        raise ValueError(f"steps: expected a whole number from 1, got {steps!r}")
    if guidance is not None and not is_number(guidance):
        raise ValueError(f"guidance: expected a number, got {guidance!r}")
    if not is_number(min_confidence) or not 0 <= min_confidence <= 1:
        raise ValueError(f"min_confidence: expected a number from 0 to 1, got {min_confidence!r}")
    if not isinstance(seed, int):
        raise ValueError(f"seed: expected a whole number, got {seed!r}")
    if path == "diffusion" and generator is None:
        generator = Generator.shipped()
    return Completion(
        generator=generator, steps=steps, guidance=guidance, min_confidence=float(min_confidence), seed=seed
    )


def unseen_note(filler: str) -> str:
    """What becomes of pixels that no source sees, by ``path`` or ``holes``, and what to do about them in training."""
    if filler == "black":
        return "The rest stays black: train with 'coverage' as a mask."
    return f"The rest is {_FILLED[filler]} and marked in 'generated': leave it out of losses that compare pixels."


_FILLED = {
    "favs": "filled in from its surroundings",
    "mean": "given the mean colour of the views",
    "inpaint": "inpainted",
    "diffusion": "made up by the generator",
}


def one_of(name: str, value: Any, choices: Sequence[str]) -> None:
    """Raise ValueError unless ``value`` is one of the choices."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name}: expected one of {', '.join(choices)}, got {value!r}")


def checked_names(name: str, value: Any) -> tuple[str, ...]:
    """Names as a tuple; ValueError for anything else, a single string too."""
    if not isinstance(value, list | tuple) or not all(isinstance(entry, str) for entry in value):
        raise ValueError(f"{name}: expected names in a list or tuple, got {value!r}")
    return tuple(value)


def is_number(value: Any) -> bool:
    """Whether it is a real number, and not a bool."""
    return isinstance(value, Real) and not isinstance(value, bool)


def checked_params(params: Any) -> dict[str, float]:
    """``retarget_params`` as plain numbers; SampleError for anything else."""
    try:
        return {name: float(value) for name, value in params.items()}  # tensors in a collated batch
    except (AttributeError, TypeError, ValueError, RuntimeError):
        pass
    raise SampleError(f"params: expected the 'retarget_params' of an output, names and numbers, got {params!r}")


def checked_size(size: Any) -> tuple[int, int]:
    """(h, w) in pixels; ValueError for impossible sizes."""
    try:
        h, w = (operator.index(side) for side in size)  # 10.5 is refused, not cut
    except (TypeError, ValueError):
        h, w = 0, 0
    if not 1 <= min(h, w) <= max(h, w) <= MAX_SIZE_PX:
        raise ValueError(f"size: expected (h, w) in pixels, got {size!r}; whole numbers from 1 to {MAX_SIZE_PX}")
    return h, w
