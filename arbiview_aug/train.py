"""``python -m arbiview_aug.train``: train a generator, or score it on held-out frames."""

from __future__ import annotations

import sys
from collections.abc import Sequence

from arbiview_aug.__main__ import COMMANDS, run


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns 0 if done, 2 after an error, 130 after Ctrl-C."""
    return run("python -m arbiview_aug.train", "train", COMMANDS["train"], argv)


if __name__ == "__main__":
    sys.exit(main())
