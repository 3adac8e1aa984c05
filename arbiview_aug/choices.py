"""Names that options take, without other imports: command lines show them before anything is loaded."""

from __future__ import annotations

from typing import Literal

GeometryName = Literal["auto", "infinity", "ground", "street", "boxes", "lidar", "motion", "fused", "learned"]
"""Names in ``scene.GEOMETRIES``. ``auto`` decides per pair of target and source camera."""

Holes = Literal["continue", "telea", "mean", "black", "diffusion"]
"""Ways to fill pixels that no source sees."""

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
