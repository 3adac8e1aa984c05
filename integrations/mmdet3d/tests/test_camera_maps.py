"""The README's detector with camera maps, of mmdet3d's own classes; run by the mark ``integrations``."""

import sys
from types import ModuleType

import numpy as np
import pytest
import torch

pytest.importorskip("mmdet3d")

from arbiview_aug import CalibrationError, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.integrations.mmdet3d import RigRetargetMultiView
from arbiview_aug.transforms.camera_maps import camera_maps
from integrations.mmdet3d.fake_results import FORMS, LIDAR2EGO, recording, source_rig
from integrations.snippets import snippets

SIZE, STRIDES, CHANNELS = (64, 176), (8, 16), 64
SOURCE = source_rig(SIZE)
TARGET = load_rig("waymo").undistorted().resized(SIZE, "crop").in_frame_of(SOURCE)
NETWORKS = {
    "img_backbone": {"type": "mmdet.ResNet", "depth": 18, "out_indices": (1, 2)},
    "img_neck": {"type": "mmdet.FPN", "in_channels": [128, 256], "out_channels": CHANNELS, "num_outs": 2},
}


class NoOperators(ModuleType):
    """In place of mmcv's compiled operators, which PyPI has no wheels of: all classes import, and none calls one."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        return None


@pytest.fixture
def detector(monkeypatch):
    monkeypatch.setitem(sys.modules, "mmcv._ext", NoOperators("mmcv._ext"))
    (code,) = (code for code in snippets("mmdet3d") if "MVXTwoStageDetector" in code)
    names = {}
    exec(code, names)
    torch.manual_seed(0)
    return names["WithCameraMaps"](strides=STRIDES, channels=CHANNELS, **NETWORKS).eval()


def metas(count, **settings):
    """Maps of retargeted samples, as the pipeline packs them."""
    step = RigRetargetMultiView(TARGET, lidar2ego=LIDAR2EGO, geometry="street", **settings)
    results = step(FORMS["mmdet3d"](recording(SyntheticDrive(SOURCE, num_frames=1)[0])))
    return [{"lidar2img": results["lidar2img"]} for _ in range(count)]


@pytest.mark.parametrize("batch", [1, 2])
def test_the_stems_read_the_maps_of_the_rig(detector, batch):
    read = []
    for stem in detector.stems:
        stem.register_forward_pre_hook(lambda _, inputs: read.append(inputs[1]))
    levels = detector.extract_img_feat(torch.rand(batch, len(TARGET), 3, *SIZE), metas(batch))
    cameras = [camera.moved(np.linalg.inv(LIDAR2EGO)) for camera in TARGET]
    for level, maps, stride in zip(levels, read, STRIDES, strict=True):
        expected = np.stack([camera_maps(camera, -1.84, stride=stride) for camera in cameras])
        assert level.shape[-3:] == (CHANNELS, SIZE[0] // stride, SIZE[1] // stride)
        np.testing.assert_allclose(maps, np.stack([expected] * batch), atol=1e-4)


def test_features_are_the_bases_at_first_and_then_those_of_a_rig(detector):
    images, of_target = torch.rand(2, len(TARGET), 3, *SIZE), metas(2)
    plain = super(type(detector), detector).extract_img_feat(images, of_target)
    levels = detector.extract_img_feat(images, of_target)
    assert all(torch.equal(level, of_base) for level, of_base in zip(levels, plain, strict=True))
    sum(level.square().sum() for level in levels).backward()
    for stem in detector.stems:
        last = stem.stem[-1]
        assert last.weight.grad.abs().sum() > 0
        torch.nn.init.normal_(last.weight)
    raised = [{"lidar2img": [m @ shift_up() for m in meta["lidar2img"]]} for meta in of_target]
    here, there = (detector.extract_img_feat(images, each)[0] for each in (of_target, raised))
    assert not torch.allclose(here, there, atol=1e-2)


def shift_up():
    """Half a metre, of all cameras."""
    up = np.eye(4)
    up[2, 3] = -0.5
    return up


def test_mirrored_images_are_refused(detector):
    mirror = np.diag([-1.0, 1, 1, 1])
    mirror[0, 2] = SIZE[1] - 1
    mirrored = [{"lidar2img": [mirror @ m for m in meta["lidar2img"]]} for meta in metas(1)]
    with pytest.raises(CalibrationError, match="expected a rotation"):
        detector.extract_img_feat(torch.rand(1, len(TARGET), 3, *SIZE), mirrored)
