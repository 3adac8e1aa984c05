"""``python -m integrations.cross_rig --quick | --small``, from the repository's root."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from arbiview_aug.cli.arguments import count, seed, writable_folder
from arbiview_aug.errors import DataError, exit_status
from integrations.cross_rig.experiment import LONGER, Length, Run, Settings, fitted, jobs, quick, recorded, run, small
from integrations.cross_rig.families import FAMILIES
from integrations.cross_rig.frames import CHANGES, World
from integrations.cross_rig.report import summary, write_report
from integrations.cross_rig.variants import VARIANTS

PRESETS = {"quick": quick, "small": small}


def main(argv: Sequence[str] | None = None) -> int:
    """Make what is missing and write the report; killed, the same command continues."""
    commands = parser()
    arguments = commands.parse_args(argv)
    return exit_status(commands.prog, lambda: _run(arguments), resumable=True)


def _run(arguments: argparse.Namespace) -> None:
    output = writable_folder(arguments.output, str(arguments.output))
    setup = Run(settings=settings_of(arguments), output=output)
    began = time.monotonic()

    def log(line: str) -> None:
        print(f"[{time.monotonic() - began:6.0f} s] {line}", file=sys.stderr, flush=True)

    for left in run(setup, arguments.workers, log):
        log(f"{left} of {len(jobs(setup.settings))} trainings to do, in {output}")
    print(summary(write_report(setup)))
    print(f"{output / 'report.json'}, report.md")


def parser() -> argparse.ArgumentParser:
    """Create the command's parser."""
    parser = argparse.ArgumentParser(
        prog="python -m integrations.cross_rig",
        description="Does a detector trained on retargeted frames of vehicle A work on vehicle B? Everything that is "
        "made is kept in the output folder: a command that is killed continues.",
    )
    preset = parser.add_mutually_exclusive_group(required=True)
    for name, settings in PRESETS.items():
        preset.add_argument(f"--{name}", dest="preset", action="store_const", const=name, help=settings.__doc__)
    folder = Path("output/cross_rig")
    parser.add_argument("--output", type=Path, default=folder, metavar="DIR", help="(%(default)s)")
    cores, text = os.cpu_count() or 1, "processes of one thread (%(default)s)"
    parser.add_argument("--workers", type=count, default=cores, metavar="N", help=text)
    text = "two data sets as --data of other commands takes them, with named boxes and drives, instead of streets"
    parser.add_argument("--real", nargs=2, metavar=("A", "B"), help=text)
    change = parser.add_argument_group("instead of the preset's")
    for name, choices in (("changes", CHANGES), ("variants", VARIANTS), ("families", FAMILIES)):
        change.add_argument(f"--{name}", nargs="+", choices=choices, metavar="NAME", help=", ".join(choices))
    change.add_argument("--world", choices=get_args(World), help="what makes the streets")
    lengths = get_args(Length)
    change.add_argument("--schedules", nargs="+", choices=lengths, help=f"long: {LONGER} times the steps")
    change.add_argument("--seeds", nargs="+", type=seed, metavar="SEED")
    for option in ("--train-frames", "--val-frames", "--test-frames", "--steps"):
        change.add_argument(option, type=count, metavar="N")
    return parser


def settings_of(arguments: argparse.Namespace) -> Settings:
    """The preset with the options that were given."""
    settings = PRESETS[arguments.preset]()
    given = {name: value for name, value in vars(arguments).items() if value is not None}
    if arguments.real:
        settings = recorded(settings, *arguments.real)
        for name in {"changes", "world"} & given.keys():
            raise DataError(f"--{name} is for synthetic streets: leave it out with --real")
    schedule = replace(settings.schedule, steps=given.get("steps", settings.schedule.steps))
    values: dict[str, Any] = {name: given[name] for name in vars(settings) if name in given}
    values = {name: tuple(value) if isinstance(value, list) else value for name, value in values.items()}
    settings = replace(settings, schedule=schedule, **values)
    return fitted(settings) if arguments.real else settings


if __name__ == "__main__":
    sys.exit(main())
