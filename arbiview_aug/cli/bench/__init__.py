"""``python -m arbiview_aug bench [WHAT]``: measurements that anyone can repeat, on their own data too.

Each benchmark is a module of this package; ``BENCHMARKS`` says what it measures.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module

_PROG = "python -m arbiview_aug bench"

BENCHMARKS = {
    "trade": "speed against accuracy of all settings, and which to use (the default)",
    "speed": "milliseconds against bare cv2.remap calls; --device: batches by torch against a copy",
    "ablation": "each stage and setting on and off: dB and milliseconds",
    "loader": "frames per second of a DataLoader, memory per worker",
    "neighbours": "what other frames of the drive cost, and what they fill",
    "generator": "holes left black, inpainted, generated: milliseconds and PSNR",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark that is named first, else ``trade``; ``--help`` after its name explains it."""
    given = list(argv or ())
    if given[:1] in (["-h"], ["--help"]):
        listed = "\n".join(f"  {name:<11} {summary}" for name, summary in BENCHMARKS.items())
        print(f"usage: {_PROG} [BENCHMARK] ...\n\nMeasurements, as tables and JSON.\n\nbenchmarks:\n{listed}\n")
    if not given or given[0].startswith("-"):
        given = ["trade", *given]
    parser = argparse.ArgumentParser(prog=_PROG)
    parser.add_argument("what", choices=BENCHMARKS)
    name = parser.parse_args(given[:1]).what
    return int(import_module(f"arbiview_aug.cli.bench.{name}").main(given[1:]))
