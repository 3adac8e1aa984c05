"""``python -m arbiview_aug.train``: the command ``train``."""

import sys

from arbiview_aug.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
