"""What to run: sizes, arms, changes, seeds and the schedule; the presets of the command."""

from __future__ import annotations

from dataclasses import dataclass, field

from integrations.cross_rig.arm import Arm
from integrations.cross_rig.arms import ARMS, named_arms
from integrations.cross_rig.training import Schedule
from integrations.cross_rig.worlds import CHANGES, Size, named_changes


@dataclass(frozen=True, kw_only=True)
class Settings:
    """A run.

    Attributes:
        size: (h, w) of every image.
        train_frames, val_frames, test_frames: Of the three sets of streets.
        seeds: Of the trainings; each arm is trained once with each.
        changes: Names of ``worlds.CHANGES``.
        arms: Names of ``arms.ARMS``.
        schedule: Of every training.

    Raises:
        ValueError: Unknown names, or a count below 1.
    """

    size: Size = (96, 256)
    train_frames: int = 1000
    val_frames: int = 200
    test_frames: int = 1000
    seeds: tuple[int, ...] = (0, 1, 2)
    changes: tuple[str, ...] = tuple(CHANGES)
    arms: tuple[str, ...] = tuple(ARMS)
    schedule: Schedule = field(default_factory=lambda: Schedule(steps=900))

    def __post_init__(self) -> None:
        named_arms(self.arms)
        named_changes(self.changes)
        for name in ("train_frames", "val_frames", "test_frames"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name}: expected a whole number above 0, got {getattr(self, name)}")


@dataclass(frozen=True, kw_only=True)
class Job:
    """A training.

    Attributes:
        arm: How.
        change: For which vehicle B; None where B does not matter (raw frames): one training serves every change.
        seed: Of its initialisation and its draws, the same for every arm.
    """

    arm: Arm
    change: str | None
    seed: int

    @property
    def name(self) -> str:
        """For files and logs."""
        return f"{self.arm.name}-{self.change or 'any'}-{self.seed}"


def jobs(settings: Settings) -> list[Job]:
    """All trainings; a whole seed before the next, so that an interrupted run has every arm."""
    found = []
    for seed in settings.seeds:
        arms = named_arms(settings.arms)
        found += [Job(arm=arm, change=None, seed=seed) for arm in arms if arm.kind == "raw"]
        for change in settings.changes:
            found += [Job(arm=arm, change=change, seed=seed) for arm in arms if arm.kind != "raw"]
    return found


def quick() -> Settings:
    """One change, one seed, minutes: does everything run, and is the oracle above raw?"""
    return Settings(
        train_frames=100,
        val_frames=20,
        test_frames=60,
        seeds=(0,),
        changes=("up70",),
        arms=("raw", "auto", "oracle"),
        schedule=Schedule(steps=250),
    )


def pilot() -> Settings:
    """Three changes, the arms that decide, three seeds: an evening on two cores."""
    return Settings(
        changes=("fov50", "up70", "waymo"),
        arms=("raw", "scale_crop", "row_split", "street", "objects_mixed", "auto", "oracle"),
    )


def full() -> Settings:
    """Everything at the pilot's size."""
    return Settings()


def large() -> Settings:
    """Everything at 256×704 with a ResNet-34: for a data-centre GPU."""
    schedule = Schedule(steps=6000, batch=8, lr=1e-3, backbone="resnet34", device="cuda")
    return Settings(size=(256, 704), train_frames=4000, schedule=schedule)
