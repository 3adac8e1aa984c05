"""Converted, read again and scored: the same as rendered on the fly, but for JPEG. Run with -s for the numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from arbiview_aug import Rig, RigRetarget, load_rig
from arbiview_aug.__main__ import main
from arbiview_aug.datasets import open_data
from arbiview_aug.evaluate.frames import make_frame, scores, views_of

MOST_DB = 0.1


@pytest.mark.parametrize(
    ("name", "target"),
    [
        pytest.param("nuscenes", load_rig("waymo").undistorted(), marks=pytest.mark.slow),
        pytest.param("nuscenes", load_rig("argoverse2"), marks=pytest.mark.release),
        pytest.param("frames", load_rig("fisheye_surround"), marks=pytest.mark.release),
    ],
    ids=lambda value: value if isinstance(value, str) else value.name,
)
def test_it_scores_as_on_the_fly(name: Any, target: Rig, nuscenes_root: Path, tmp_path: Path) -> None:
    """Against LiDAR points at the exposures that were recorded; the points made the views, here as there."""
    file = target.save(tmp_path / "rig.yaml")
    output = tmp_path / "new"
    asked = ["convert", "--data", f"{name}:{nuscenes_root}", "--target", str(file), "--output", str(output)]
    assert main([*asked, "--workers", "1"]) == 0
    sample, target = open_data(nuscenes_root, kind=name)[0], load_rig(file)
    written = open_data(output, kind=name, load_points=False)[0]
    order = [written["rig"].names.index(camera) for camera in target.names]

    read = views_of({key: written[key] for key in ("images", "coverage")})
    converted = [read[k] for k in order]
    frame, means = make_frame(sample, exposures=("raw",)), {}
    for label, views in (("on the fly", views_of(RigRetarget(target)(sample))), ("converted", converted)):
        _, rows = scores(frame, lambda *_, views=views: views, target)
        keys = ("raw_psnr_db", "raw_covered_psnr_db", "seen")
        means[label] = {key: float(np.mean([row[key] for row in rows if key in row])) for key in keys}
        print(f"{name} as {target.name}, {label}: {means[label]}")
    assert means["converted"]["seen"] == pytest.approx(means["on the fly"]["seen"], abs=1e-6)
    for key in ("raw_psnr_db", "raw_covered_psnr_db"):
        assert abs(means["converted"][key] - means["on the fly"][key]) <= MOST_DB
