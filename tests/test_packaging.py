"""A release has one version everywhere, and its public names are importable."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

import arbiview_aug

ROOT = Path(__file__).parents[1]
PUBLIC = {
    "arbiview_aug": """
        ArbiviewError CalibrationError Camera CropRig DataError RenderConfig ImageBoxes PaperConfig RandomRig
        PlanCache ResizeRig RetargetedDataset RetargetedIterable Rig RigRetarget SampleError SampleKeys SampleTypeError
        load_rig project_boxes_3d shipped_rigs""",
    "arbiview_aug.datasets": """
        FrameFolder LazyFrame Neighbours NuScenesDataset RetargetedDataset RetargetedIterable WithMotionDepth
        decode_images open_data reduced_camera reduced_rig""",
    "arbiview_aug.datasets.synthetic": """
        GROUND_CLASSES BoxClass RenderedViews Scene SceneClass SyntheticDrive demo_source_rig demo_target_rig
        make_scene""",
    "arbiview_aug.generator": "Diffusion Generator GeneratorConfig compact paper small tiny",
}


@pytest.mark.parametrize("module", PUBLIC)
def test_public_names_are_there(module: str) -> None:
    missing = [name for name in PUBLIC[module].split() if not hasattr(import_module(module), name)]
    assert not missing


def test_one_version_everywhere() -> None:
    (cited,) = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    newest, *older = re.findall(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert cited == newest == arbiview_aug.__version__ and older == ["0.3.0", "0.2.0", "0.1.0"]


def test_the_sdist_holds_what_its_tests_read() -> None:
    """By MANIFEST.in; built and installed before a release (docs/contributing.md)."""
    manifest = (ROOT / "MANIFEST.in").read_text().split()
    assert {"tests", "integrations", "docs", ".ci", "mkdocs.yml", "CHANGELOG.md", "CITATION.cff"} <= set(manifest)
