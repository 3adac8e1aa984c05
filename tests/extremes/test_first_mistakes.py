"""First-time mistakes: each gives an error, a warning or a finding of ``check`` that names the fix.

``tests/sample/test_mistakes.py`` has the silent ones in more forms, on real frames too.
"""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from typing import Any

import pytest
import torch

from arbiview_aug import ArbiviewError, RigRetarget, check
from tests.helpers import street_sample
from tests.sample.mistakes import MISTAKES, Sample, millimetres, poses, turned, without


@pytest.fixture(scope="module")
def street() -> Sample:
    return turned(street_sample(), 30)


def tensors(sample: Sample, **changes: Any) -> Sample:
    """The sample calibrated by K and cam2ego."""
    K, cam2ego = torch.from_numpy(sample["rig"].K), torch.from_numpy(sample["rig"].cam2ego)
    return {**without("rig")(sample), "K": K, "cam2ego": cam2ego, **changes}


def hwc(sample: Sample) -> Sample:
    return {**sample, "images": [image.permute(1, 2, 0).numpy() for image in sample["images"]]}


ERRORS: dict[str, tuple[Callable[[Sample], Sample], str]] = {
    "images as numpy arrays (h, w, 3)": (hwc, "permute"),
    "float images from 0 to 255": (lambda s: {**s, "images": s["images"].float()}, r"\[0, 1\]"),
    "K of images of twice the size": (lambda s: tensors(s, K=torch.from_numpy(s["rig"].K) * 2), "K"),
    "coefficients without a lens": (lambda s: tensors(s, distortion=torch.ones(6, 4) * 0.01), "lens"),
    "ROS axes": (MISTAKES["ROS axes"][0], "ROS.*multiply cam2ego"),
    "positions in millimetres": (poses(millimetres), "millimetres: divide"),
    "a mask of 0 and 255": (
        lambda s: {**s, "ego_mask": torch.zeros(6, 64, 176, dtype=torch.uint8)},
        "ego_mask: .*bool",
    ),
    "images under another key": (lambda s: {**without("images")(s), "imgs": s["images"]}, "did you mean 'images'"),
}
WARNINGS: dict[str, tuple[Callable[[Sample], Sample], str]] = {
    "an inverted cam2ego": (MISTAKES["inverted cam2ego"][0], r"ego2cam, the inverse: pass np\.linalg\.inv"),
    "boxes as gt_boxes": (MISTAKES["gt_boxes"][0], "gt_boxes.*did you mean 'boxes_3d'"),
}
FINDINGS = (
    *("yaw in degrees", "width before length", "height first", "yaw from the y axis", "z at the bottom"),
    *("LiDAR's frame", "ground_z_m too low", "K of a smaller image", "OpenGL's axes", "specks in a mask"),
)


def test_there_are_ten_and_more() -> None:
    assert len(ERRORS) + len(WARNINGS) + len(FINDINGS) >= 10


@pytest.mark.parametrize("mistake", ERRORS)
def test_an_error_names_the_fix(mistake: str, street: Sample) -> None:
    make, message = ERRORS[mistake]
    with warnings.catch_warnings(), pytest.raises(ArbiviewError, match=message):
        warnings.simplefilter("ignore")
        RigRetarget("waymo", size=(32, 64), geometry="street")(make(street))


@pytest.mark.parametrize("mistake", WARNINGS)
def test_a_warning_names_the_fix(mistake: str, street: Sample) -> None:
    make, message = WARNINGS[mistake]
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        RigRetarget("waymo", size=(32, 64))(make(street))
    assert any(re.search(message, str(warning.message)) for warning in told), list(map(str, told))


@pytest.mark.parametrize("mistake", FINDINGS)
def test_a_finding_names_the_fix(mistake: str, street: Sample) -> None:
    """Silent while rendering."""
    make, _ = MISTAKES[mistake]
    report = check(make(street))
    assert not report.ok and all(finding.fix for finding in report.findings)


def test_the_right_sample_has_none(street: Sample) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        RigRetarget(street["rig"].turned(yaw_deg=10))(street)
    assert check(street).ok
