"""Command lines of the studies."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence

from arbiview_aug.cli.arguments import command_parser
from arbiview_aug.errors import exit_status


def study_parser(name: str, description: str, example: str) -> argparse.ArgumentParser:
    """Create the parser of ``python -m integrations.benchmarks.NAME``, without its options."""
    return command_parser("", description, example, program=f"python -m integrations.benchmarks.{name}")


def run_study(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int | None],
    argv: Sequence[str] | None,
) -> int:
    """Parse the arguments and run a study; its exit status is that of ``errors.exit_status``."""
    arguments = parser.parse_args(argv)
    return exit_status(parser.prog, lambda: run(arguments))
