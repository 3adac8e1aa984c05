"""``python -m arbiview_aug bench WHAT``: measurements that anyone can repeat, on their own data too.

``speed``: milliseconds against bare ``cv2.remap`` calls (``bench.speed``).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

BENCHMARKS = ("speed",)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark that is named first; ``--help`` after its name explains it."""
    parser = argparse.ArgumentParser(
        prog="python -m arbiview_aug bench", description="Measurements, as tables and JSON."
    )
    parser.add_argument("what", choices=BENCHMARKS, help="speed: milliseconds against bare cv2.remap calls")
    parser.add_argument("rest", nargs=argparse.REMAINDER, metavar="...", help="its options")
    arguments = parser.parse_args(argv)
    from arbiview_aug.bench import speed

    return speed.main(arguments.rest)
