"""Frames written and read again."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.frame_folder import write_frame
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig


def test_a_street_comes_back(tmp_path: Path) -> None:
    sample = SyntheticDrive(demo_source_rig((48, 132)), num_frames=1)[0]
    write_frame(tmp_path / "frame", sample)
    again = FrameFolder(tmp_path)[0]
    assert again["rig"] == sample["rig"] and again["token"] == "frame"
    assert (again["images"].float() - sample["images"].float()).abs().mean() < 4  # JPEG
    for key in ("boxes_3d", "points"):
        assert np.array_equal(again[key].numpy(), sample[key].numpy())
