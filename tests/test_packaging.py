"""A release has one version everywhere, and its public names are importable."""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from pathlib import Path

import pytest

import arbiview_aug
from arbiview_aug import choices

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
    "arbiview_aug.generator": "Completed Diffusion Generator GeneratorConfig compact paper small tiny",
}


@pytest.mark.parametrize("module", PUBLIC)
def test_public_names_are_there(module: str) -> None:
    missing = [name for name in PUBLIC[module].split() if not hasattr(import_module(module), name)]
    assert not missing


def test_one_version_everywhere() -> None:
    (cited,) = re.findall(r"^version: (.+)$", (ROOT / "CITATION.cff").read_text(), re.MULTILINE)
    newest, *older = re.findall(r"^## (\S+)$", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert cited == newest == arbiview_aug.__version__ and older == ["0.2.0", "0.1.0"]


def test_the_changelog_lists_what_old_names_became() -> None:
    (table,) = re.findall(r"### Moving from 0.2\n(.*?)\n#", (ROOT / "CHANGELOG.md").read_text(), re.DOTALL)
    rows = dict(re.findall(r"^\| (?:the key |the setting )?`(.+?)` \| `(.+?)` \|$", table, re.MULTILINE))
    values = {f'{option}="{old}"': f'{option}="{new}"' for (option, old), new in choices.VALUES.items()}
    assert rows == choices.OPTIONS | values | choices.KEYS | choices.NAMES | choices.FLAGS | choices.SETTINGS


@pytest.mark.parametrize("option", choices.OPTIONS)
def test_an_old_option_raises_an_error_that_gives_the_new_one(option: str) -> None:
    with pytest.raises(
        TypeError, match=re.escape(f"RigRetarget: {option!r}: since 0.3 it is {choices.OPTIONS[option]}")
    ):
        arbiview_aug.RigRetarget("waymo", **{option: None})


def test_other_calls_refuse_old_options_too() -> None:
    for call in (arbiview_aug.check, arbiview_aug.datasets.WithDepth):
        with pytest.raises(TypeError, match=r"'source_rig': since 0\.3 it is source"):
            call([], source_rig=None, **({"folder": "."} if call is not arbiview_aug.check else {}))


@pytest.mark.parametrize("name", choices.NAMES)
def test_an_old_name_raises_an_error_that_gives_the_new_one(name: str) -> None:
    module, _, old = f"arbiview_aug.{name}".rpartition(".")
    with pytest.raises(AttributeError, match=re.escape(choices.NAMES[name])):
        getattr(import_module(module), old)


def test_the_front_door_is_narrow() -> None:
    parameters = inspect.signature(arbiview_aug.RigRetarget).parameters.values()
    assert sum(parameter.kind is parameter.KEYWORD_ONLY for parameter in parameters) <= 12
    assert len((inspect.getdoc(arbiview_aug.RigRetarget) or "").splitlines()) <= 50
    assert len(inspect.getsource(arbiview_aug.RigRetarget.__init__).splitlines()) <= 40


def test_the_sdist_holds_what_its_tests_read() -> None:
    """By MANIFEST.in; built and installed before a release (docs/contributing.md)."""
    manifest = (ROOT / "MANIFEST.in").read_text().split()
    assert {"tests", "integrations", "docs", ".ci", "mkdocs.yml", "CHANGELOG.md", "CITATION.cff"} <= set(manifest)
