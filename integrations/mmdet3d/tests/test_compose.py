"""The step in ``mmengine.dataset.Compose``: run by the mark ``integrations`` where mmengine is."""

import numpy as np
import pytest

pytest.importorskip("mmengine")

from mmengine.config import Config
from mmengine.dataset import Compose

import arbiview_aug.integrations.mmdet3d  # noqa: F401 - registers the step
from arbiview_aug import load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from integrations.mmdet3d.fake_results import FORMS, LIDAR2EGO, recording, source_rig
from integrations.mmdet3d.measure import worst_error_px

SIZE = (48, 136)
SOURCE = source_rig((64, 176))


@pytest.mark.parametrize("form", FORMS)
def test_compose_of_a_config(form, tmp_path):
    """As a user writes it: a config file, custom_imports, a rig file."""
    rig = load_rig("waymo").undistorted()
    file = rig.save(tmp_path / "waymo.yaml")
    text = f"""
custom_imports = dict(imports=["arbiview_aug.integrations.mmdet3d"], allow_failed_imports=False)
pipeline = [
    dict(type="RigRetargetMultiView", target={str(file)!r}, size={SIZE}, lidar2ego={LIDAR2EGO.tolist()}),
]
"""
    (tmp_path / "config.py").write_text(text)
    config = Config.fromfile(tmp_path / "config.py")
    assert "RigRetargetMultiView" in config.pretty_text
    results = Compose(config.pipeline)(FORMS[form](recording(SyntheticDrive(SOURCE, num_frames=1)[0])))
    error_px = worst_error_px(results, rig.resized(SIZE, "crop").in_frame_of(SOURCE))
    print(f"{form}: {error_px:.1e} px, coverage {np.mean(results['coverage']):.2f}")
    assert error_px <= 1e-3
