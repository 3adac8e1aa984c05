"""Settings of an experiment, its trainings, and the presets of the command."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Literal

from integrations.cross_rig.training import Schedule
from integrations.cross_rig.variants import VARIANTS, Variant
from integrations.cross_rig.worlds import CHANGES, STREETS, Size, Split, World

Length = Literal["short", "long"]
"""Names of schedules."""

LONGER = 2.6
"""Steps of the long schedule over those of the short one. It is long enough where B's own frames gain less than a point
of IoU by twice as many steps."""

REAL = "real"
"""The change from one recorded data set to another."""


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A run.

    Attributes:
        size: (h, w) of every image.
        train_frames, val_frames, test_frames: Sizes of the three sets of frames.
        streets: The world that all three come from, a whole hundred: ``worlds.street_seed``.
        world: Maker of the streets.
        recorded: ``open_data``'s names of the data sets of A and B, instead of streets.
        seeds: Seeds of the trainings; each variant is trained once with each.
        changes: Names of ``worlds.CHANGES``, or ``REAL`` alone.
        variants: Names of ``variants.VARIANTS``.
        families: Names of ``families.FAMILIES``.
        schedules: Every variant is trained on each.
        schedule: The short one of every training; each job's family and length replace its values.
    """

    size: Size = (96, 256)
    train_frames: int = 200
    val_frames: int = 100
    test_frames: int = 200
    streets: int = STREETS
    world: World = "drive"
    recorded: tuple[str, str] | None = None
    seeds: tuple[int, ...] = (0,)
    changes: tuple[str, ...] = ("up70",)
    variants: tuple[str, ...] = ("raw", "auto_fill", "auto_fill_mixed", "oracle")
    families: tuple[str, ...] = ("voxels",)
    schedules: tuple[Length, ...] = ("short",)
    schedule: Schedule = field(default_factory=lambda: Schedule(steps=400))

    def count(self, split: Split) -> int:
        """Number of frames of a split."""
        return int(getattr(self, f"{split}_frames"))


@dataclass(frozen=True, kw_only=True)
class Job:
    """A training.

    Attributes:
        variant: How.
        change: For which vehicle B; None where B does not matter: one training serves every change.
        seed: Seed of its initialisation and its draws, the same for every variant.
        family: Family of the detector.
        length: Length of its schedule.
    """

    variant: Variant
    change: str | None
    seed: int
    family: str = "voxels"
    length: Length = "short"

    @property
    def name(self) -> str:
        """For files and logs."""
        return "-".join([self.variant.name, self.change or "any", self.family, str(self.seed), self.length])


def jobs(settings: Settings) -> list[Job]:
    """All trainings; a whole seed before the next, so that an interrupted run has every variant."""
    found = []
    variants = [variant for name, variant in VARIANTS.items() if name in settings.variants]
    changes = [name for name in (*CHANGES, REAL) if name in settings.changes]
    for seed, length, family in product(settings.seeds, settings.schedules, settings.families):
        make = partial(Job, seed=seed, family=family, length=length)
        found += [make(variant=variant, change=None) for variant in variants if not variant.knows_target]
        found += [make(variant=v, change=change) for change in changes for v in variants if v.knows_target]
    return found


def quick() -> Settings:
    """One change, one seed, both schedules on the streets of cuboids, minutes: is the oracle above raw?"""
    return Settings(
        train_frames=100,
        val_frames=20,
        test_frames=60,
        variants=("raw", "auto_fill", "oracle"),
        world="cuboids",
        schedules=("short", "long"),
        schedule=Schedule(steps=150),
    )


def small() -> Settings:
    """One change on streets that no constant was chosen on, two seeds: the tables of the pages."""
    return Settings(streets=200, seeds=(0, 1))


def recorded(base: Settings, a: str, b: str) -> Settings:
    """A preset on recorded data, not on streets: the variants that need nothing but points and boxes."""
    variants = ("raw", "scale_crop", "auto_fill", "auto_fill_mixed", "auto_fill_random", "oracle")
    return replace(base, recorded=(a, b), world="drive", changes=(REAL,), variants=variants)
