"""Groups of kernels that several processes compile."""

from __future__ import annotations

import os
import subprocess
import sys
from typing import Any

import pytest


@pytest.mark.slow
def test_groups_hold_all_that_warming_up_compiles(tmp_path: Any) -> None:
    """In an empty cache: afterwards nothing is missing, and a process compiles nothing more, for frames neither."""
    code = """
import torch
from numba.core import event
from arbiview_aug import RigRetarget
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.transforms.warm_up import GROUPS, _named, compile_kernels, compiling
from arbiview_aug.environment import is_kept
if __name__ == "__main__":
    with compiling(*GROUPS):
        pass
    drive = SyntheticDrive(demo_source_rig((90, 160)), num_frames=1, lidar=True)
    sample = drive[0]
    sample["images"] = (sample["images"] * torch.linspace(0.5, 1, len(drive.rig))[:, None, None, None]).byte()
    sample["boxes_3d"] = torch.nn.functional.pad(sample["boxes_3d"], (0, 2))  # velocities
    last = sample["images"].contiguous(memory_format=torch.channels_last)
    with event.install_recorder("numba:compile") as recorded:
        compile_kernels()
        for images in (sample["images"], last, last / 255):
            for geometry in ("street", "lidar"):
                retarget = RigRetarget(drive.rig.shifted(z_m=0.4), quality="accurate", geometry=geometry)
                retarget({**sample, "images": images})
    print([str(e.data["dispatcher"].py_func.__name__) for _, e in recorded.buffer])
    print(all(is_kept(kernel) for _, last in GROUPS.values() for kernel in _named(last)))
"""
    (tmp_path / "cold.py").write_text(code)
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": ":".join(sys.path)}
    done = subprocess.run([sys.executable, tmp_path / "cold.py"], env=environment, capture_output=True, text=True)
    assert done.stdout == "[]\nTrue\n", done.stderr
    assert done.stderr == "arbiview_aug: compiling kernels that were not used before\n"
