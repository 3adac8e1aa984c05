"""Rigs that ship with the package."""

from __future__ import annotations

from importlib import resources


def shipped_rigs() -> list[str]:
    """Names of the rigs that ship with the package, for ``load_rig``."""
    folder = resources.files("arbiview_aug.cameras") / "rigs"
    return sorted(f.name.removesuffix(".yaml") for f in folder.iterdir() if f.name.endswith(".yaml"))
