"""``python -m arbiview_aug bench [WHAT]``: measurements that anyone can repeat, on their own data too.

``trade``, the default: speed against accuracy of all settings (``bench.trade``). ``speed``: milliseconds against bare
``cv2.remap`` calls (``bench.speed``). ``ablation``: each stage and setting on and off, dB and milliseconds
(``bench.ablation``). ``device``: batches by torch, on a GPU where there is one (``bench.device``). ``loader``: frames
per second out of a ``DataLoader`` (``bench.loader``). ``scene``: what is not done where a scene does not require it
(``bench.scene``). ``neighbours``: what other frames of the drive cost (``bench.neighbours``). ``generator``: what
made-up pixels cost, and how true they are (``bench.generator``).
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
    "scene": "only what a scene requires is done: counters and milliseconds",
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
