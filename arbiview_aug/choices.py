"""Names that options take, and names that version 0.3 changed.

Nothing else of the package is imported: command lines show the names before anything is loaded. The tables of old
names stand behind the errors that they raise, and are those of the CHANGELOG.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from numbers import Integral, Real
from typing import Any, Literal

GeometryName = Literal["auto", "infinity", "ground", "street", "boxes", "lidar", "motion", "fused", "learned"]
"""Names in ``scene.GEOMETRIES``. ``auto`` decides per pair of target and source camera."""

Holes = Literal["continue", "telea", "mean", "black", "diffusion"]
"""Ways to fill pixels that no source sees."""

Quality = Literal["draft", "fast", "accurate", "paper"]
"""Presets of rendering; ``paper`` is ``arbiview_aug.favs.config.PaperConfig``."""

Reduce = Literal[1, 2, 4]
"""Factors by which images are decoded smaller."""

Reference = Literal["LiDAR", "motion", "road"]
"""References that a network's depth is fitted to, the best first."""

OnError = Literal["report", "skip", "fatal"]
"""Treatments of samples that cannot be converted: ``report`` converts the others and leaves the output unfinished,
``skip`` leaves the sample out and reports it, ``fatal`` stops."""

TARGET_SETS = ("paper", "yaw", "vehicles", "truck")
"""Sets of targets that ``evaluate`` renders."""

TRAINING_PRESETS = ("paper", "inpaint", "small", "compact", "tiny")
"""Presets of all settings of a training."""


OPTIONS = {
    "target_rig": "target",
    "source_rig": "source",
    "path": "holes='telea' or 'diffusion'",
    "generator": "holes=arbiview_aug.generator.Diffusion(generator), or an inpainter of arbiview_aug.inpaint",
    "steps": "holes=Diffusion(steps=...)",
    "guidance": "holes=Diffusion(guidance=...)",
    "min_confidence": "holes=Telea(min_confidence=...) or Diffusion(min_confidence=...)",
    "seed": "holes=Diffusion(seed=...)",
    "surface": "geometry",
    "strict": "warnings.simplefilter('error', arbiview_aug.GeometryWarning)",
    "harmonise": "match_exposure",
    "refinement": "cache=PlanCache(share_overlap=...)",
    "cache_bytes": "cache=PlanCache(max_bytes=...)",
    "rng": "torch.manual_seed: draws come from torch's global generator",
    "label_frame": "keys=SampleKeys(frame=...)",
    "label_keys": "keys=SampleKeys(labels=...)",
    "label_fill": "keys=SampleKeys(ignore_index=...)",
    "pass_keys": "keys=SampleKeys(keep=...)",
    "outputs": "keys=SampleKeys(extra=...)",
    "execution": "backend",
}
"""Options of transforms."""

VALUES = {
    ("geometry", "far"): "infinity",
    ("geometry", "objects"): "boxes",
    ("holes", "fill"): "continue",
    ("neighbours", "ground"): "road",
}
"""Values of options."""

KEYS = {"ignore": "ego_mask"}
"""Keys of samples."""

NAMES = {
    "FavsConfig": "RenderConfig",
    "RefinementCache": "PlanCache(share_overlap=...)",
    "generator.HoleFiller": "inpaint.NetworkInpainter",
    "generator.PipelineFiller": "inpaint.PipelineInpainter",
    "generator.TorchScriptFiller": "inpaint.TorchScriptInpainter",
    "generator.CompletedLoader": "inpaint.CompletedLoader",
    "generator.load_generator": "generator.load_inpainter",
}
"""Classes and functions, below ``arbiview_aug``."""

FLAGS = {
    "--surface": "--geometry",
    "--path": "--holes",
    "--motion-depth": "--depth",
    "--reduce": "--downscale",
    "--yaws": "--target-set SET, or --target FILE of Rig.turned(yaw_deg=...).save(FILE)",
    "--paper": "python -m integrations.benchmarks.paper, from a clone",
    "--figure": "python -m integrations.benchmarks.paper --figure, from a clone",
    "bench neighbours": "bench speed --only neighbour",
    "bench trade": "bench pareto",
}
"""Options and benchmarks of the command line."""

SETTINGS = {
    "clip": "max_grad_norm",
    "drop": "cond_drop_prob",
    "moved": "p_translate",
    "known": "known_weight",
    "transplanted": "p_mask_transfer",
    **dict.fromkeys(("leave_one_out", "virtual", "real_sources"), "gone: no measurement showed a gain"),
}
"""Settings of a training."""


def setting_hint(names: Iterable[str]) -> str:
    """The new names of old settings among ``names``, for the end of an error; empty where there are none."""
    return "".join(f"; since 0.3 {name} is {SETTINGS[name]}" for name in names if name in SETTINGS)


def refuse_old_options(of: str, options: Iterable[str]) -> None:
    """Raise TypeError for options that ``of`` does not have; old ones with their new name."""
    for option in options:
        new = f"since 0.3 it is {OPTIONS[option]}" if option in OPTIONS else "there is no such option"
        raise TypeError(f"{of}: {option!r}: {new}")


def choice(option: str, value: object, choices: Iterable[str]) -> Any:
    """``value`` as one of the choices of an option.

    Raises:
        ValueError: Another value; old ones with their new name.
    """
    allowed = tuple(choices)
    if isinstance(value, str) and value in allowed:
        return value
    new = VALUES.get((option, value)) if isinstance(value, str) else None
    hint = f"; since 0.3 it is {new!r}" if new else ""
    raise ValueError(f"{option}: expected one of {', '.join(allowed)}, got {value!r}{hint}")


def is_number(value: Any) -> bool:
    """Whether it is a real number, and not a bool."""
    return isinstance(value, Real) and not isinstance(value, bool)


def is_whole(value: Any, low: float = -math.inf, high: float = math.inf) -> bool:
    """Whether it is a whole number within bounds, and not a bool."""
    return isinstance(value, Integral) and not isinstance(value, bool) and low <= int(value) <= high


def checked_stride(name: str, value: Any) -> int:
    """A whole number of pixels from 1; ValueError for anything else."""
    if not is_whole(value, 1):
        raise ValueError(f"{name}: expected a number of pixels from 1, got {value!r}")
    return int(value)


def removed_name(module: str, name: str) -> AttributeError:
    """The error of a module that lacks a name; old ones with their new name."""
    full = f"{module}.{name}".removeprefix("arbiview_aug.")
    new = f": since 0.3 it is arbiview_aug.{NAMES[full]}" if full in NAMES else ""
    return AttributeError(f"module {module!r} has no attribute {name!r}{new}")
