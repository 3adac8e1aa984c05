"""``python -m arbiview_aug bench [WHAT]``: measurements that anyone can repeat, on their own data too.

Each benchmark is a module of this package; ``BENCHMARKS`` says what it measures.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module

BENCHMARKS = {
    "trade": "speed against accuracy of all settings, and which to use (the default)",
    "speed": "milliseconds against bare cv2.remap calls",
    "device": "batches by torch, on a GPU where there is one: milliseconds, share of copy bandwidth",
    "ablation": "each stage and setting on and off: dB and milliseconds",
    "loader": "frames per second of a DataLoader, memory per worker",
    "neighbours": "what other frames of the drive cost, and what they fill",
    "generator": "holes left black, inpainted, generated: milliseconds and PSNR",
}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark that is named first; ``--help`` after its name explains it."""
    parser = argparse.ArgumentParser(
        prog="python -m arbiview_aug bench", description="Measurements, as tables and JSON."
    )
    words = "; ".join(f"{name}: {summary}" for name, summary in BENCHMARKS.items())
    given = list(argv or ())
    if not given or (given[0].startswith("-") and given[0] not in ("-h", "--help")):
        given = ["trade", *given]
    parser.add_argument("what", choices=BENCHMARKS, help=words)
    parser.add_argument("rest", nargs=argparse.REMAINDER, metavar="...", help="its options")
    arguments = parser.parse_args(given)
    return int(import_module(f"arbiview_aug.cli.bench.{arguments.what}").main(arguments.rest))
