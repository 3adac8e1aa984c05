"""Halved images and cubics against what they replace, by truth."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.evaluate.metrics import psnr_db
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.view_planner import build_plan
from tests.render.test_backends import zoomed


@pytest.mark.slow
def test_halving_when_minifying_beats_direct_sampling(nuscenes_root: Path) -> None:
    """Truth: rendered at four times the size and averaged."""
    sample = FrameFolder(nuscenes_root)[0]
    rig, images = sample["rig"], list(sample["images"])
    small = rig.turned(yaw_deg=4).resized((256, 704))
    fine = render_opencv(
        build_plan(rig, small.resized((1024, 2816)), config=RenderConfig(interpolation="linear")), images
    )

    def psnr(antialias: bool) -> float:
        plan = build_plan(rig, small, config=RenderConfig(antialias=antialias, interpolation="linear"))
        errors = []
        for view, truth, target in zip(render_opencv(plan, images), fine, plan.targets, strict=True):
            mean = cv2.resize(truth.permute(1, 2, 0).numpy(), (704, 256), interpolation=cv2.INTER_AREA)
            inner = cv2.erode(target.coverage.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0
            errors.append(((view.permute(1, 2, 0).numpy().astype(float) - mean)[inner] ** 2).mean())
        return psnr_db(float(np.mean(errors)))

    assert psnr(True) > psnr(False) + 2


@pytest.mark.slow
def test_magnified_views_are_sharper() -> None:
    """65 to 50 degrees: what took the detector of ``integrations/cross_rig`` from 77 to 91 % of the gap."""
    rig = demo_source_rig((96, 256))
    target, drive = zoomed(rig, 1.37), SyntheticDrive(rig, num_frames=3, seed=7, lidar=False)
    streets = [(list(drive[k]["images"]), drive.render(k, target).images.float()) for k in range(len(drive))]
    psnr = []
    for interpolation in ("linear", "cubic"):
        plan = build_plan(rig, target, config=RenderConfig(interpolation=interpolation))
        views = [torch.stack(render_opencv(plan, images)).float() for images, _ in streets]
        errors = [(view - truth).square().mean().item() for view, (_, truth) in zip(views, streets, strict=True)]
        psnr.append(psnr_db(float(np.mean(errors))))
    assert psnr[1] > psnr[0] + 0.4
