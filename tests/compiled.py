"""``python -m tests.compiled``: compile nearly all kernels that tests call, or load them from numba's cache."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from arbiview_aug.__main__ import main
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.transforms.warm_up import GROUPS, compile_kernels, compiling
from tests.cli.convert.drives import FRAMES, command, write_frames

if __name__ == "__main__":
    with compiling(*GROUPS):
        pass
    compile_kernels()
    SyntheticDrive(FRAMES, num_frames=1)[0]
    with TemporaryDirectory() as folder:  # those of depth from motion, and of points and boxes in float32
        drive = write_frames(Path(folder) / "drive", 3)
        main(["depth", "--data", str(drive)])
        main(command(drive, Path(folder) / "new", "--geometry", "auto"))
