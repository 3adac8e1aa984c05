"""``python -m arbiview_aug COMMAND``: each command is a module with ``main(argv)``, imported on use."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib import import_module

from arbiview_aug.environment import installed_version, warn_about_cv2_wheels
from arbiview_aug.errors import exit_status

COMMANDS = {
    "bench": ("arbiview_aug.cli.bench", "measure speed against accuracy, on your own data too"),
    "check": ("arbiview_aug.cli.check", "find silent mistakes in a data set, and draw its labels into its images"),
    "convert": ("arbiview_aug.cli.convert.command", "write a data set as another vehicle's cameras would have seen it"),
    "demo": ("arbiview_aug.cli.demo", "retarget a synthetic street or real frames, with numbers and a picture"),
    "depth": ("arbiview_aug.cli.depth", "compute the depth of a drive's frames, from motion or by a network"),
    "evaluate": ("arbiview_aug.cli.evaluate", "measure the quality of rendered views: metrics, pictures, a report"),
    "inspect": ("arbiview_aug.cli.rigs", "show rigs: tables, differences, a picture"),
    "train": ("arbiview_aug.train", "train the generator that completes what no camera saw"),
}
"""Module and one-line help of each command."""

_RESUMABLE = ("convert", "depth", "train")


def usage() -> str:
    """The commands with their one-line help."""
    commands = "\n".join(f"  {name:<9} {summary}" for name, (_, summary) in COMMANDS.items())
    head, tail = "usage: python -m arbiview_aug [--version] COMMAND ...", "python -m arbiview_aug COMMAND --help"
    return f"{head}\n\ncommands:\n{commands}\n\n{tail} explains each."


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

    def command() -> int | None:
        return import_module(COMMANDS[name][0]).main(rest)

    return exit_status(f"python -m arbiview_aug {name}", command, resumable=name in _RESUMABLE)


if __name__ == "__main__":
    sys.exit(main())
