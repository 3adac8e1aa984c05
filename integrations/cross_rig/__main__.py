"""``python -m integrations.cross_rig --quick | --small``, from the repository's root: its options and its report."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, get_args

import numpy as np

from arbiview_aug.cli.arguments import count, seed, writable_folder
from arbiview_aug.errors import DataError, exit_status
from integrations.cross_rig.experiment import LONGER, Length, Run, Settings, fitted, jobs, quick, recorded, run, small
from integrations.cross_rig.families import FAMILIES
from integrations.cross_rig.frames import CHANGES, World
from integrations.cross_rig.scoring import Interval, ap_scores, iou_scores, matches_of
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
    log = partial(print, file=sys.stderr, flush=True)
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


# --- report -----------------------------------------------------------------------------------------------------------
Results = Mapping[str, Mapping[int, Mapping[str, Any]]]
"""Results of one change by variant and seed."""


def write_report(setup: Run) -> dict[str, Any]:
    """Write ``report.json`` and ``report.md`` from the results that are there; returns the first."""
    settings, changes = setup.settings, {}
    for family, length in product(settings.families, settings.schedules):
        job = next(job for job in jobs(settings) if (job.family, job.length) == (family, length))
        schedule = setup.schedule(job)
        unusual = [name for name in (family, length) if name not in ("voxels", "short")]
        for name, results in setup.results(family, length).items():
            drives = setup.source("test", name).drives(settings.test_frames)
            title = " to ".join(Path(data).name for data in settings.recorded or ()) or CHANGES[name].title
            facts = {"title": ", ".join([title, *unusual]), "samples_seen": schedule.steps * schedule.batch}
            changes["-".join([name, *unusual])] = facts | _scored(results, drives)
    report = {"settings": asdict(settings), "changes": changes}
    setup.output.mkdir(parents=True, exist_ok=True)
    (setup.output / "report.json").write_text(json.dumps(report, indent=1))
    (setup.output / "report.md").write_text(summary(report))
    return report


def _scored(variants: Results, drives: Sequence[int] | None) -> dict[str, Any]:
    """Scores over the seeds that every variant has; frames of one drive are drawn together."""
    seeds = sorted(set.intersection(*map(set, variants.values()))) if variants else []  # type: ignore[arg-type]
    if not seeds:
        return {"seeds": [], "variants": {}}
    results = {name: [variants[name][seed] for seed in seeds] for name in VARIANTS if name in variants}
    ious = iou_scores({name: np.array([row["counts"] for row in rows]) for name, rows in results.items()}, drives)
    aps = ap_scores({name: matches_of(rows) for name, rows in results.items()}, drives)
    rows = {name: {"title": VARIANTS[name].title, **asdict(ious[name]), "ap": asdict(aps[name])} for name in results}
    return {"seeds": seeds, "variants": rows}


def summary(report: Mapping[str, Any]) -> str:
    """A row for each variant, between raw and the oracle."""
    head = ["B", "samples seen", "IoU", "closed gap %", "AP", "closed gap % by AP"]
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    for change in report["changes"].values():
        variants = change["variants"]
        for name in [name for name in variants if name not in ("raw", "oracle")] or list(variants)[:1]:
            cells = [f"{change['title']}; {variants[name]['title']}", str(change["samples_seen"])]
            shown = [variants[key] for key in ("raw", name, "oracle") if key in variants]
            for scored in (shown, [row["ap"] for row in shown]):
                cells.append(", ".join(f"{100 * row['value']:.1f}" for row in scored))
                share = scored[shown.index(variants[name])]["share"]
                cells.append("–" if share is None else Interval(**share).percent())
            rows.append(cells)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)


if __name__ == "__main__":
    sys.exit(main())
