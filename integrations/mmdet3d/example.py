"""``python -m integrations.mmdet3d.example``: a synthetic street in the form of each framework, through the step.

With mmengine installed it runs in ``mmengine.dataset.Compose``, built from a config.
"""

from __future__ import annotations

from importlib.util import find_spec
from typing import Any

import numpy as np

from arbiview_aug import load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.integrations.mmdet3d import RigRetargetMultiView
from integrations.mmdet3d.fake_results import FORMS, LIDAR2EGO, recording, source_rig
from integrations.mmdet3d.measure import worst_error_px

SIZE = (64, 176)


def main() -> int:
    """Retarget a frame in each form and say what came of its keys."""
    source = source_rig((128, 352))
    given = recording(SyntheticDrive(source, num_frames=1)[0])
    target = load_rig("waymo").undistorted().resized(SIZE, "crop")
    config: dict[str, Any] = {"type": "RigRetargetMultiView", "target": target, "lidar2ego": LIDAR2EGO}
    if find_spec("mmengine"):
        from mmengine.dataset import Compose

        step, how = Compose([config]), "mmengine.dataset.Compose"
    else:
        settings = {key: value for key, value in config.items() if key != "type"}
        step, how = RigRetargetMultiView(**settings), "called without mmengine, which is not installed"
    print(how)
    for name, form in FORMS.items():
        results = step(form(given))
        seen = float(np.mean(results["coverage"]))
        error_px = worst_error_px(results, target.in_frame_of(source))
        count = len(results["img_inputs"][0] if "img_inputs" in results else results["img"])
        assert error_px <= 1e-3, name
        print(f"{name:22} {count} views, {seen:.1%} seen, lidar2img within {error_px:.1e} px of the rig's")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
