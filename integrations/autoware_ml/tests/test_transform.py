"""The transform on dicts with the keys of Autoware-ML's ``LoadMultiViewImagesFromFiles``."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from arbiview_aug import SampleError, SampleKeys, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.integrations.autoware_ml import RigRetargetMultiViewImages
from integrations.mmdet3d.fake_results import FORMS, LIDAR2EGO, Recording, recording, source_rig
from integrations.mmdet3d.measure import worst_error_px

SIZE = (48, 136)
SOURCE = source_rig((64, 176))
TARGET = load_rig("waymo").undistorted().resized(SIZE)
README = (Path(__file__).parents[1] / "README.md").read_text()


@pytest.fixture(scope="module")
def given() -> Recording:
    return recording(SyntheticDrive(SOURCE, num_frames=1)[0])


def loaded(given: Recording) -> dict[str, Any]:
    """As ``LoadMultiViewImagesFromFiles()`` leaves the sample of a camera-lidar dataset."""
    sparse4d = FORMS["Sparse4D"](given)  # whose points and boxes are plain arrays too
    images = np.stack([image[..., ::-1].transpose(2, 0, 1) for image in given.arrays])
    return {
        "images": {name: {"img_path": f"{name}.jpg"} for name in given.rig.names},
        "camera_order": given.rig.names,
        "camera_names": given.rig.names,
        "img": images.astype(np.float32) / 255.0,
        "camera_intrinsics": given.K.astype(np.float32),
        "lidar2cam": given.lidar2cam.astype(np.float32),
        "lidar2img": (given.K @ given.lidar2cam).astype(np.float32),
        "gt_boxes": np.pad(sparse4d["gt_bboxes_3d"], [(0, 0), (0, 2)]).astype(np.float32),
        "points": sparse4d["points"],
        "scene_token": "scene",
        "prev_exists": np.float32(0),
    }


def test_matrices_images_and_geometry(given: Recording) -> None:
    sample = loaded(given)
    transform = RigRetargetMultiViewImages(TARGET, lidar2ego=LIDAR2EGO, geometry="boxes")
    changed = transform(sample, context=None)
    merged = sample | changed
    assert merged["img"].shape == (5, 3, *SIZE) and merged["img"].dtype == np.float32 and merged["img"].max() <= 1
    assert worst_error_px(merged, TARGET.in_frame_of(SOURCE)) <= 1e-3
    assert np.allclose(merged["camera_intrinsics"] @ merged["lidar2cam"], merged["lidar2img"], atol=1e-3)
    assert merged["camera_names"] == TARGET.names and merged["coverage"].shape == (5, *SIZE)
    assert set(changed) == {
        "img",
        "camera_intrinsics",
        "lidar2cam",
        "lidar2img",
        "camera_names",
        "points",
        "coverage",
        "generated",
    }
    expected = transform.step.retarget(given.sample)  # the same boxes, in the ego frame
    xyz = merged["points"][:, :3] @ LIDAR2EGO[:3, :3].T + LIDAR2EGO[:3, 3]
    assert merged["points"].shape == expected["points"].shape
    assert np.isclose(xyz, expected["points"][:, :3], atol=2e-3).mean() > 0.999
    off = np.abs(merged["img"] * 255 - expected["images"].numpy())
    assert off.mean() < 0.2


def test_other_entries_of_cameras(given: Recording) -> None:
    """The step rewrites what it knows; none of it may stay the source's in the merged dict."""
    sample = loaded(given)
    sample |= {"cam2ego": given.mounted, "img_shape": [(64, 176)] * 6, "filename": ["a.jpg"] * 6, "num_views": 6}
    transform = RigRetargetMultiViewImages(TARGET, lidar2ego=LIDAR2EGO, geometry="street")
    merged = sample | transform(sample)
    assert merged["num_views"] == 5 and merged["img_shape"] == [SIZE] * 5 and merged["filename"] == TARGET.names
    np.testing.assert_allclose(merged["cam2ego"], TARGET.in_frame_of(SOURCE).cam2ego, atol=1e-5)
    with (
        pytest.raises(SampleError, match="depth_maps: of the source's pixels; retarget before"),
        pytest.warns(UserWarning, match="drops depth_maps"),
    ):
        transform({**sample, "depth_maps": np.ones((6, 64, 176))})


def test_levels_and_messages(given: Recording) -> None:
    sample = loaded(given)
    transform = RigRetargetMultiViewImages(TARGET, lidar2ego=LIDAR2EGO, geometry="street")
    whole = {**sample, "img": np.rint(sample["img"] * 255).astype(np.uint8)}
    assert np.abs(transform(whole)["img"] / 255.0 - transform(sample)["img"]).max() < 1e-6
    with pytest.raises(SampleError, match="lidar2cam: expected after LoadMultiViewImagesFromFiles, found none"):
        transform({key: value for key, value in sample.items() if key != "lidar2cam"})
    for images in (sample["img"][0], sample["img"][:0], [np.zeros((3, 8, 8)), np.zeros((3, 9, 8))]):
        with pytest.raises(SampleError, match=r"img: expected \(N, 3, H, W\)"):
            transform({**sample, "img": images})


def test_config_of_the_readme(given: Recording, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Hydra instantiates it: ``_target_`` by its path, all else as arguments."""
    monkeypatch.chdir(tmp_path)
    TARGET.save("waymo_pinhole.yaml")
    (text,) = re.findall(r"```yaml\n(.*?)```", README, re.DOTALL)
    _, node = yaml.safe_load(text)
    assert node.pop("_convert_") == "all"
    module, name = node.pop("_target_").rsplit(".", 1)
    transform = getattr(import_module(module), name)(**node, geometry="street")
    assert transform(loaded(given))["img"].shape == (5, 3, 256, 704)
    more = RigRetargetMultiViewImages(**node, keys={"extra": ["confidence"]})
    assert more.step.retarget.keys == SampleKeys(extra=("confidence",))
    assert more(loaded(given))["confidence"].shape == (5, 256, 704)
