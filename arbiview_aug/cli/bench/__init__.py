"""``python -m arbiview_aug bench [WHAT]``: repeatable measurements, one module each."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module

BENCHMARKS = {
    "trade": "speed against accuracy of all settings, and which to use (the default)",
    "speed": "milliseconds against bare cv2.remap calls; --device: batches by torch against a copy",
    "ablation": "each stage and setting on and off: dB and milliseconds",
    "loader": "frames per second of a DataLoader, memory per worker",
    "neighbours": "what other frames of the drive cost, and what they fill",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark that is named first, else ``trade``; ``--help`` after its name explains it."""
    given = list(argv or ())
    program = "python -m arbiview_aug bench"
    if given[:1] in (["-h"], ["--help"]):
        listed = "\n".join(f"  {name:<11} {summary}" for name, summary in BENCHMARKS.items())
        print(f"usage: {program} [BENCHMARK] ...\n\nMeasurements, as tables and JSON.\n\nbenchmarks:\n{listed}\n")
    if not given or given[0].startswith("-"):
        given = ["trade", *given]
    parser = argparse.ArgumentParser(prog=program)
    parser.add_argument("what", choices=BENCHMARKS)
    name = parser.parse_args(given[:1]).what
    return int(import_module(f"arbiview_aug.cli.bench.{name}").main(given[1:]))
