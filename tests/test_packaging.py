"""What a release says of itself is one version, and public names of releases before stay importable."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

import pytest

import arbiview_aug

ROOT = Path(__file__).parents[1]
PUBLIC_IN_0_1_0 = {
    "arbiview_aug": """
        ArbiviewError CalibrationError Camera CropRig DataError FavsConfig ImageBoxes PaperConfig RandomRig
        RefinementCache ResizeRig RetargetedDataset RetargetedIterable Rig RigRetarget SampleError SampleTypeError
        load_rig project_boxes_3d shipped_rigs""",
    "arbiview_aug.datasets": """
        FrameFolder LazyFrame Neighbours NuScenesDataset RetargetedDataset RetargetedIterable WithMotionDepth
        decode_images open_data reduced_camera reduced_rig""",
    "arbiview_aug.datasets.synthetic": """
        GROUND_CLASSES BoxClass RenderedViews Scene SceneClass SyntheticDrive demo_source_rig demo_target_rig
        make_scene""",
    "arbiview_aug.generator": "Completed CompletedLoader Generator GeneratorConfig compact paper small tiny",
}


@pytest.mark.parametrize("module", PUBLIC_IN_0_1_0)
def test_public_names_of_the_first_release_are_there(module: str) -> None:
    missing = [name for name in PUBLIC_IN_0_1_0[module].split() if not hasattr(import_module(module), name)]
    assert not missing


def test_one_version_everywhere() -> None:
    (cited,) = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    newest, *older = re.findall(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert cited == newest == arbiview_aug.__version__ and older == ["0.2.0", "0.1.0"]


def test_modules_that_the_changelog_names_exist() -> None:
    (table,) = re.findall(r"### Moved\n(.*?)###", (ROOT / "CHANGELOG.md").read_text(), re.DOTALL)
    now = re.findall(
        r"`([a-z0-9_.]+)`", " ".join(row.split("|")[2] for row in table.splitlines() if row.startswith("|"))
    )
    named = [name for name in now if "." in name and name != "arbiview_aug."]
    assert len(named) > 30
    for name in named:
        path = ROOT / "arbiview_aug" / name.replace(".", "/")
        assert path.with_suffix(".py").is_file() or path.is_dir(), name


def test_the_sdist_holds_what_its_tests_read() -> None:
    """By MANIFEST.in; built and installed before a release (docs/contributing.md)."""
    manifest = (ROOT / "MANIFEST.in").read_text().split()
    assert {"tests", "integrations", "docs", ".ci", "mkdocs.yml", "CHANGELOG.md", "CITATION.cff"} <= set(manifest)
