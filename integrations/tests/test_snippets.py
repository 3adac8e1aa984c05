"""The code of the integrations' READMEs runs as it stands; lightning's and webdataset's where these are installed."""

from __future__ import annotations

import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.integrations.mmdet3d import RigRetargetMultiView
from integrations.mmdet3d.fake_results import FORMS, LIDAR2EGO, bevdet4d, recorded_drive, recording, source_rig
from integrations.nuscenes.fake_root import VERSION, fake_root
from integrations.snippets import snippets


class Registry:
    """The face of mmdet 2's."""

    def __init__(self) -> None:
        self.held: dict[str, Any] = {}

    def register_module(self, *, name: str, module: Any, force: bool) -> None:
        self.held[name] = module


def stand_in(monkeypatch: pytest.MonkeyPatch, module: str, **names: Any) -> None:
    """Make a module that is not to be had, and the packages around it."""
    parts = module.split(".")
    for count in range(1, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:count]), ModuleType(module))
    vars(sys.modules[module]).update(names)


def test_kornia() -> None:
    (code,) = snippets("kornia")
    names: dict[str, Any] = {"sample": SyntheticDrive(demo_source_rig((72, 128)), num_frames=1, lidar=False)[0]}
    exec(code, names)
    for pipeline in ("by_torchvision", "by_kornia"):
        out = names[pipeline](names["sample"])
        assert out["images"].shape == (5, 3, 128, 352) and out["images"].dtype == torch.uint8


@pytest.mark.slow
def test_nuscenes(tmp_path: Path) -> None:
    root = fake_root(tmp_path / "root")
    (code,) = snippets("nuscenes", {"data/nuscenes": str(root), "v1.0-mini": VERSION, "num_workers=8": ""})
    names: dict[str, Any] = {}
    exec(code, names)
    assert names["images"].shape == (5, 3, 256, 704)
    assert len(names["labels_2d"]) == 5


def test_mmdet3d(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The rig file, then each framework's step on its own form; mmdet 2 is not to be had, only its registry's face."""
    monkeypatch.chdir(tmp_path)
    rig_file, new, old, others, several, *_ = snippets("mmdet3d")
    exec(rig_file, {})
    registry = Registry()
    stand_in(monkeypatch, "mmdet.datasets.builder", PIPELINES=registry)
    exec(old, {})
    assert registry.held == {"RigRetargetMultiView": RigRetargetMultiView}
    steps: list[dict[str, Any]] = []
    names = {"dict": lambda **entries: steps.append(entries) or entries}
    for code in (new, others):
        exec(code, names)
    steps = [step for step in steps if step.get("type") == "RigRetargetMultiView"]
    forms = ("mmdet3d", "mit-han-lab BEVFusion", "BEVDet", "PETR")
    assert len(steps) == len(forms)
    sample = recording(SyntheticDrive(source_rig((64, 176)), num_frames=1)[0])
    for step, form in zip(steps, forms, strict=True):
        kind = step.pop("type")
        out = registry.held[kind](**step)(FORMS[form](sample))
        assert out["coverage"].shape == (6, *step["size"])
        assert step.get("p") == (0.5 if form in ("mmdet3d", "PETR") else None)  # the recipe: not for lifting by depths
    steps.clear()
    exec(several, names)
    drive = recorded_drive([sample.sample] * 2)
    one = {"lidar2ego": LIDAR2EGO, "scene_token": "drive"}
    given = bevdet4d(drive), FORMS["DETR3D"](drive[0]) | one, FORMS["Sparse4D"](drive[0])
    for step, results in zip(steps, given, strict=True):
        out = registry.held[step.pop("type")](**{**step, "size": (48, 132)})(results)
        assert out["coverage"].shape[-3:] == (6, 48, 132)
