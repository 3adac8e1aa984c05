"""``python -m arbiview_aug COMMAND``: options are parsed before a command's module is imported."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence

from arbiview_aug import __version__
from arbiview_aug.cli.parsers import COMMANDS, check_together, parser_of
from arbiview_aug.environment import imported
from arbiview_aug.errors import exit_status


def usage() -> str:
    """The commands with their one-line help."""
    listed = "\n".join(f"  {name:<9} {command.description.partition(':')[0]}" for name, command in COMMANDS.items())
    head, tail = "usage: python -m arbiview_aug [--version] COMMAND ...", "python -m arbiview_aug COMMAND --help"
    return f"{head}\n\ncommands:\n{listed}\n\n{tail} explains each."


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command.

    Returns:
        The exit status: 0 done, 1 as the command says, 2 wrong usage or unusable data, 130 interrupted; the last two
        with one line on stderr.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments[:1] == ["--version"]:
        print(f"arbiview_aug {__version__}")
        return 0
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else 2
    name, *rest = arguments
    if name not in COMMANDS:
        print(f"python -m arbiview_aug: unknown command {name!r}\n\n{usage()}", file=sys.stderr)
        return 2

    def parsed_and_run() -> int | None:
        if isinstance(sys.stdout, io.TextIOWrapper):
            sys.stdout.reconfigure(errors="backslashreplace")  # names of files that are not UTF-8
        parser = parser_of(name)
        parsed = parser.parse_args(rest)
        check_together(name, parser, parsed)
        return imported(f"arbiview_aug.{COMMANDS[name].module}:run")(parsed)

    return exit_status(f"python -m arbiview_aug {name}", parsed_and_run, resumable=COMMANDS[name].resumable)


if __name__ == "__main__":
    sys.exit(main())
