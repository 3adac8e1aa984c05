"""``python -m arbiview_aug COMMAND``: options are parsed before a command's module is imported."""

from __future__ import annotations

import io
import sys
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from arbiview_aug.cli import parsers
from arbiview_aug.environment import imported, installed_version, warn_about_cv2_wheels
from arbiview_aug.errors import exit_status


class Command(NamedTuple):
    """A command, whose function in ``cli.parsers`` has its name."""

    summary: str
    module: str  # with ``run``, a function of the parsed arguments
    resumable: bool = False


COMMANDS = {
    "bench": Command("measure speed against accuracy, on your own data too", "cli.bench.pareto"),
    "check": Command("find silent mistakes in a data set, and draw its labels into its images", "cli.check"),
    "convert": Command(
        "write a data set as another vehicle's cameras would have seen it", "cli.convert.command", resumable=True
    ),
    "demo": Command("retarget a synthetic street or real frames, with numbers and a picture", "cli.demo"),
    "depth": Command("compute the depth of a drive's frames, from motion or by a network", "cli.depth", resumable=True),
    "doctor": Command("check this installation, and time one frame", "cli.doctor"),
    "evaluate": Command("measure the quality of rendered views: metrics, pictures, a report", "cli.evaluate"),
    "inspect": Command("show rigs: tables, differences, a picture", "cli.rigs"),
    "train": Command(
        "train the generator that completes what no camera saw", "generator.training.command", resumable=True
    ),
    "view": Command("write a recording of frames and their views for Rerun's viewer", "cli.view"),
}


def usage() -> str:
    """The commands with their one-line help."""
    head, tail = "usage: python -m arbiview_aug [--version] COMMAND ...", "python -m arbiview_aug COMMAND --help"
    return f"{head}\n\ncommands:\n{_listed(COMMANDS)}\n\n{tail} explains each."


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        The exit status: 0 done, 1 as the command says, 2 wrong usage or unusable data, 130 interrupted; the last two
        with one line on stderr.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["--version"]:
        print(f"arbiview_aug {installed_version('arbiview_aug') or '(not installed)'}")
        return 0
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else 2
    name, *rest = arguments
    if name not in COMMANDS:
        print(f"python -m arbiview_aug: unknown command {name!r}\n\n{usage()}", file=sys.stderr)
        return 2
    warn_about_cv2_wheels()
    return run(f"python -m arbiview_aug {name}", name, COMMANDS[name], rest)


def run(program: str, name: str, command: Command, argv: Sequence[str] | None) -> int:
    """Parse a command's arguments, import it and run it; the exit status of ``main``."""

    def parsed_and_run() -> int | None:
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # names of files that are not UTF-8
        parser = getattr(parsers, name)()
        arguments = parser.parse_args(argv)
        parsers.check_together(name, parser, arguments)
        return imported(f"arbiview_aug.{command.module}:run")(arguments)

    return exit_status(program, parsed_and_run, resumable=command.resumable)


def _listed(commands: Mapping[str, Command]) -> str:
    return "\n".join(f"  {name:<9} {command.summary}" for name, command in commands.items())


if __name__ == "__main__":
    sys.exit(main())
