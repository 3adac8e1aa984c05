"""Settings of an experiment: sizes, variants, changes, seeds and the schedule; the presets of the command."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import product
from typing import Literal, TypeVar, get_args

from integrations.cross_rig.families import FAMILIES
from integrations.cross_rig.training import Schedule
from integrations.cross_rig.variant import Variant
from integrations.cross_rig.variants import VARIANTS
from integrations.cross_rig.worlds import CHANGES, STREETS, Size, Split, World

T = TypeVar("T")

Length = Literal["short", "long"]
"""Names of schedules."""

LONGER = 2.6
"""Steps of the long schedule over those of the short one. It is long enough where B's own frames gain less than a point
of IoU by twice as many steps."""

REAL = "real"
"""The change from one recorded data set to another."""


def named_rows(kind: str, names: Sequence[str], table: Mapping[str, T]) -> list[T]:
    """Rows of a table by name, in the order of the table.

    Raises:
        ValueError: An unknown name.
    """
    unknown = [name for name in names if name not in table]
    if unknown:
        raise ValueError(f"{kind}: expected some of {', '.join(table)}, got {', '.join(unknown)}")
    return [row for name, row in table.items() if name in names]


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A run.

    Attributes:
        size: (h, w) of every image.
        train_frames, val_frames, test_frames: Sizes of the three sets of streets.
        streets: The world that all three come from, a whole hundred: ``worlds.street_seed``.
        world: Maker of the streets.
        seeds: Seeds of the trainings; each variant is trained once with each.
        changes: Names of ``worlds.CHANGES``, or ``REAL`` alone.
        variants: Names of ``variants.VARIANTS``.
        families: Names of ``families.FAMILIES``.
        schedules: Every variant is trained on each.
        schedule: The short one of every training; each job's family and length replace its own.

    Raises:
        ValueError: Unknown names, or a count below 1.
    """

    size: Size = (96, 256)
    train_frames: int = 1000
    val_frames: int = 200
    test_frames: int = 1000
    streets: int = STREETS
    world: World = "drive"
    seeds: tuple[int, ...] = (0, 1, 2)
    changes: tuple[str, ...] = tuple(CHANGES)
    variants: tuple[str, ...] = tuple(VARIANTS)
    families: tuple[str, ...] = ("voxels",)
    schedules: tuple[Length, ...] = ("short",)
    schedule: Schedule = field(default_factory=lambda: Schedule(steps=900))

    def __post_init__(self) -> None:
        named_rows("variants", self.variants, VARIANTS)
        if self.changes != (REAL,):
            named_rows("changes", self.changes, CHANGES)
        named_rows("families", self.families, FAMILIES)
        named_rows("schedules", self.schedules, dict.fromkeys(get_args(Length)))
        named_rows("world", (self.world,), dict.fromkeys(get_args(World)))
        if self.streets % 100 or self.streets < STREETS:
            raise ValueError(f"streets: expected a whole hundred from {STREETS} on, got {self.streets}")
        for name in ("train_frames", "val_frames", "test_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a whole number above 0, got {getattr(self, name)}")

    def count(self, split: Split) -> int:
        """Number of frames of a set of streets."""
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
        longer = "" if self.length == "short" else f"-{self.length}"
        return f"{self.variant.name}-{self.change or 'any'}-{self.family}-{self.seed}{longer}"


def jobs(settings: Settings) -> list[Job]:
    """All trainings; a whole seed before the next, so that an interrupted run has every variant."""
    found = []
    variants = named_rows("variants", settings.variants, VARIANTS)
    for seed, length, family in product(settings.seeds, settings.schedules, settings.families):
        made = partial(Job, seed=seed, family=family, length=length)
        found += [made(variant=variant, change=None) for variant in variants if not variant.knows_target]
        for change in settings.changes:
            found += [made(variant=variant, change=change) for variant in variants if variant.knows_target]
    return found


def quick() -> Settings:
    """One change, one seed, both schedules on the streets of cuboids, minutes: is the oracle above raw?"""
    return Settings(
        train_frames=100,
        val_frames=20,
        test_frames=60,
        seeds=(0,),
        changes=("up70",),
        variants=("raw", "auto_fill", "oracle"),
        world="cuboids",
        schedules=("short", "long"),
        schedule=Schedule(steps=150),
    )


def small() -> Settings:
    """One change on streets that no constant was chosen on, two seeds: the tables of the pages."""
    return Settings(
        train_frames=200,
        val_frames=100,
        test_frames=200,
        streets=200,
        seeds=(0, 1),
        changes=("up70",),
        variants=("raw", "auto_fill", "auto_fill_mixed", "oracle"),
        schedule=Schedule(steps=400),
    )


def real(base: Settings) -> Settings:
    """A preset on recorded data, not on streets: the variants that need nothing but points and boxes."""
    variants = ("raw", "scale_crop", "auto_fill", "auto_fill_mixed", "auto_fill_random", "oracle")
    return replace(base, world="drive", changes=(REAL,), variants=variants)


def large() -> Settings:
    """Everything at 256×704 with a ResNet-34: for a data-centre GPU."""
    schedule = Schedule(steps=6000, batch=8, lr=1e-3, backbone="resnet34", device="cuda", precision="bf16")
    return Settings(size=(256, 704), train_frames=4000, schedule=schedule)
