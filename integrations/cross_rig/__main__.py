"""``python -m integrations.cross_rig --quick | --small | --large``, from the repository's root."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import get_args

from arbiview_aug.cli.arguments import count, device_named, seed
from arbiview_aug.errors import ArbiviewError
from integrations.cross_rig.experiment import Run, run
from integrations.cross_rig.families import FAMILIES
from integrations.cross_rig.real import recorded_run
from integrations.cross_rig.report import markdown, write_report
from integrations.cross_rig.settings import LONGER, Length, Settings, jobs, large, quick, real, small
from integrations.cross_rig.variants import VARIANTS
from integrations.cross_rig.worlds import CHANGES, World

_REPORT_S = 60.0
"""Least seconds between reports of a run that goes on: a large one takes as long as a training on a GPU."""

PRESETS = {"quick": quick, "small": small, "large": large}


def main(argv: Sequence[str] | None = None) -> int:
    """Make what is missing and write the report; killed, the same command goes on where it was."""
    arguments = _parser().parse_args(argv)
    try:
        settings = _settings(arguments)
        if arguments.output.exists() and not arguments.output.is_dir():
            raise ValueError(f"--output: expected a folder, got the file {arguments.output}")
        if not arguments.list:
            device_named(settings.schedule.device)  # before hours of rendering
        setup = _run(arguments, settings)
    except (ValueError, ArbiviewError) as error:
        print(error, file=sys.stderr)
        return 2
    settings = setup.settings
    missing = setup.missing()
    if arguments.list:
        waiting = {job.name for job in missing}
        for job in jobs(settings):
            print(f"{'missing' if job.name in waiting else 'done   '}  {job.name}")
        return 0
    began = time.monotonic()

    def log(line: str) -> None:
        print(f"[{time.monotonic() - began:6.0f} s] {line}", file=sys.stderr, flush=True)

    log(f"{len(missing)} of {len(jobs(settings))} trainings to do, in {arguments.output}")
    written = began
    for left in run(setup, arguments.workers, log):
        if time.monotonic() - written > _REPORT_S:
            write_report(setup)
            written = time.monotonic()
        log(f"{left} trainings left")
    print(markdown(write_report(setup)))
    print(f"{arguments.output / 'report.json'}, report.md, report.png")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m integrations.cross_rig",
        description="Does a detector trained on retargeted frames of vehicle A work on vehicle B? Everything that is "
        "made is kept in the output folder: a command that is killed goes on where it was.",
    )
    preset = parser.add_mutually_exclusive_group(required=True)
    for name, settings in PRESETS.items():
        preset.add_argument(f"--{name}", dest="preset", action="store_const", const=name, help=settings.__doc__)
    parser.add_argument("--output", type=Path, default=Path("output/cross_rig"), metavar="DIR", help="(%(default)s)")
    parser.add_argument(
        "--workers",
        type=count,
        default=os.cpu_count() or 1,
        metavar="N",
        help="processes of one thread (%(default)s)",
    )
    parser.add_argument("--list", action="store_true", help="only say which trainings are done")
    parser.add_argument(
        "--real",
        nargs=2,
        metavar=("A", "B"),
        help="two data sets as --data of other commands takes them, with named boxes and drives, instead of streets",
    )
    change = parser.add_argument_group("instead of the preset's")
    change.add_argument("--changes", nargs="+", choices=CHANGES, metavar="CHANGE", help=", ".join(CHANGES))
    change.add_argument("--variants", nargs="+", choices=VARIANTS, metavar="VARIANT", help=", ".join(VARIANTS))
    change.add_argument("--world", choices=get_args(World), help="what makes the streets")
    lengths = get_args(Length)
    change.add_argument("--schedules", nargs="+", choices=lengths, help=f"long: {LONGER} times the steps")
    change.add_argument("--families", nargs="+", choices=FAMILIES, metavar="FAMILY", help=", ".join(FAMILIES))
    change.add_argument("--seeds", nargs="+", type=seed, metavar="SEED")
    change.add_argument("--streets", type=count, metavar="N", help="another world of streets: 200, 300, …")
    for option in ("--train-frames", "--val-frames", "--test-frames", "--steps"):
        change.add_argument(option, type=count, metavar="N")
    change.add_argument("--precision", choices=("bf16", "fp32"))
    change.add_argument("--device", help="of the trainings, cpu or cuda")
    return parser


def _run(arguments: argparse.Namespace, settings: Settings) -> Run:
    return (
        recorded_run(arguments.real[0], arguments.real[1], settings, arguments.output)
        if arguments.real
        else Run(settings=settings, output=arguments.output)
    )


def _settings(arguments: argparse.Namespace) -> Settings:
    settings = PRESETS[arguments.preset]()
    if arguments.real:
        settings = real(settings)
        for name in ("changes", "world", "streets"):
            if getattr(arguments, name) is not None:
                raise ValueError(f"--{name.replace('_', '-')} is for synthetic streets: leave it out with --real")
    names = (
        *("changes", "variants", "families", "schedules", "seeds", "streets", "world"),
        *("train_frames", "val_frames", "test_frames"),
    )
    given = {name: getattr(arguments, name) for name in names if getattr(arguments, name) is not None}
    given = {name: tuple(value) if isinstance(value, list) else value for name, value in given.items()}
    of_schedule = {n: getattr(arguments, n) for n in ("steps", "precision", "device") if getattr(arguments, n)}
    return replace(settings, schedule=replace(settings.schedule, **of_schedule), **given)


if __name__ == "__main__":
    sys.exit(main())
