"""OpenCV's stitching with known rotations: cameras at one place must give the true view."""

from __future__ import annotations

import numpy as np
import pytest

from arbiview_aug.cameras.rig import load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.images import as_arrays
from arbiview_aug.evaluate.metrics import truth_metrics
from arbiview_aug.evaluate.opencv_stitching import opencv_stitching
from tests.helpers import ring


@pytest.mark.slow
def test_cameras_at_one_centre_give_the_true_views() -> None:
    rig = ring(radius_m=0.0, size=(96, 160))  # nothing is seen from two places
    drive = SyntheticDrive(rig, num_frames=1, lidar=False)
    target = rig.turned(yaw_deg=25)
    views = opencv_stitching(rig, as_arrays(drive[0]["images"]), target)
    for view, true in zip(views, as_arrays(drive.render(0, target).images), strict=True):
        assert view.coverage.mean() > 0.9
        assert truth_metrics(view.image, true, coverage=view.coverage)["covered_psnr_db"] > 25
        middle = view.coverage[48]
        assert middle[8:-8].all(), "no gap where the panorama closes"


def test_lenses_are_refused() -> None:
    rig = load_rig("waymo").resized((32, 48))
    with pytest.raises(SampleError, match="expected pinhole cameras"):
        opencv_stitching(rig, [np.zeros((32, 48, 3), np.uint8)] * len(rig), rig)
