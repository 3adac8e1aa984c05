"""ResizeRig and CropRig: what a pixel shows is where K says, before and after."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import CropRig, ResizeRig, Rig, RigRetarget, SampleError, SampleKeys, SampleTypeError
from arbiview_aug.image_ops import nearest_resized, resized
from tests.helpers import camera

SIZE = (60, 100)
LENS = {"lens": "radtan", "distortion": (-0.05, 0.01, 0.0, 0.0)}
MASK = np.arange(60)[:, None].repeat(100, 1) < 48
RIG = Rig([camera("a", size=SIZE), camera("b", 70, size=SIZE, mask=MASK, **LENS)])
TRANSFORMS = [ResizeRig((30, 50)), ResizeRig((90, 110)), CropRig(10, 20, (40, 70))]


def blobs(rig: Rig = RIG, **entries: object) -> dict:
    """A bright blob 9 px wide in every image, at the pixel of one point of the scene."""
    v, u = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in SIZE), indexing="ij")
    images = [torch.exp(-((u - x) ** 2 + (v - y) ** 2) / 18).expand(3, *SIZE) for x, y in _pixels(rig)]
    return {"images": torch.stack(images), "K": torch.from_numpy(rig.K), "rig": rig, **entries}


def _points(rig: Rig) -> list[np.ndarray]:
    """For each camera, a point 10 m away near the middle of its image."""
    return [camera.center_m + 10 * camera.unproject([52.0, 33.0]).directions for camera in rig]


def _pixels(rig: Rig) -> list[np.ndarray]:
    return [camera.project(point).uv for camera, point in zip(rig, _points(RIG), strict=True)]


@pytest.mark.parametrize("transform", TRANSFORMS, ids=str)
def test_the_point_is_where_the_calibration_says(transform: torch.nn.Module) -> None:
    out = transform(blobs())
    h, w = transform.size
    assert out["images"].shape == (2, 3, h, w) and out["rig"].sizes == [(h, w)] * 2
    assert np.allclose(out["K"].numpy(), out["rig"].K, atol=1e-12)
    v, u = torch.meshgrid(torch.arange(h), torch.arange(w), indexing="ij")
    for image, uv in zip(out["images"], _pixels(out["rig"]), strict=True):
        weight = image[0] / image[0].sum()
        assert np.allclose([(weight * u).sum(), (weight * v).sum()], uv, atol=0.02)


@pytest.mark.parametrize("transform", TRANSFORMS, ids=str)
def test_maps_and_masks_follow(transform: torch.nn.Module) -> None:
    """Each row of a map holds its own number: after, the row of the image that the camera's mask of it comes from."""
    rows = torch.arange(60)[:, None].expand(2, 60, 100)
    sample = blobs(coverage=rows < 50, labels=rows.to(torch.uint8), token="x")
    transform.keys = SampleKeys(labels=("labels",))
    out = transform(sample)
    transform.label_keys = ()
    assert torch.equal(out["coverage"], out["labels"] < 50) and out["token"] == "x"
    assert np.array_equal(out["rig"]["b"].mask, (out["labels"][1] < 48).numpy())
    assert out["coverage"].dtype == torch.bool and out["labels"].dtype == torch.uint8
    assert sample["images"].shape[-2:] == SIZE  # the input is as it was


def test_resizing_before_or_after_is_the_same_calibration() -> None:
    target = RIG.turned(yaw_deg=12).undistorted()
    before = RigRetarget(target.resized((30, 50)), geometry="infinity", holes="black")(blobs())
    after = ResizeRig((30, 50))(RigRetarget(target, geometry="infinity", holes="black")(blobs()))
    assert torch.allclose(before["K"], after["K"]) and after["coverage"].shape == (2, 30, 50)
    both = before["coverage"] & after["coverage"]
    assert (before["images"] - after["images"]).abs().mean(1)[both].mean() < 0.005
    again = RigRetarget(target.resized((30, 50)), geometry="infinity", holes="black")(
        after
    )  # an output is an input again
    assert torch.allclose(again["images"], after["images"], atol=0.02)


@pytest.mark.parametrize(
    ("size", "to", "per_pixel", "most"),  # stripes of that many a pixel, and the largest deviation that is left of them
    [
        *((size, (47, 155), (1 / 5.3, 1 / 5.3), 0.07) for size in ((375, 1242), (376, 1240))),
        ((64, 512), (64, 65), (0, 1 / 2), 0.15),
        ((401, 701), (250, 430), (0, 1 / 2), 0.15),
    ],
)
@pytest.mark.parametrize("white", [255, 1.0])
def test_sides_that_do_not_halve_evenly_are_antialiased(
    size: Any, to: Any, per_pixel: Any, most: float, white: float
) -> None:
    y, x = torch.arange(size[0])[:, None] + 0.25, torch.arange(size[1]) + 0.25
    stripes = (torch.sin((per_pixel[0] * y + per_pixel[1] * x) * 2 * np.pi) > 0).expand(3, *size) * white
    planes = stripes.to(torch.uint8 if white == 255 else torch.float32).contiguous()
    for image in (planes, planes.permute(1, 2, 0).contiguous().permute(2, 0, 1)):
        assert resized(image, to).double().std() / white < most


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float16])
def test_labels_are_those_of_the_nearest_pixels_whatever_the_default_dtype_and_device(dtype: torch.dtype) -> None:
    columns = torch.arange(1600)[None]
    torch.set_default_dtype(dtype)
    try:
        assert torch.equal(nearest_resized(columns, (1, 1600)), columns)
        assert torch.equal(nearest_resized(columns, (1, 800)), columns[:, 1::2])
    finally:
        torch.set_default_dtype(torch.float32)
    sample = blobs()
    with torch.device("meta"):
        assert ResizeRig((30, 50))(sample)["images"].device.type == "cpu"


def test_label_maps_are_checked_and_keep_their_channels() -> None:
    resize = ResizeRig((30, 50), keys=SampleKeys(labels=("seg",)))
    for maps in (torch.zeros(2, 3, *SIZE), [torch.zeros(3, *SIZE)] * 2):
        assert resize(blobs(seg=maps))["seg"].shape == (2, 3, 30, 50)
    mixed = Rig([RIG["a"], RIG["b"].resize((30, 50))])
    parts = {"images": [torch.rand(3, 60, 100), torch.rand(3, 30, 50)], "rig": mixed}
    assert resize({**parts, "seg": [torch.zeros(60, 100), torch.zeros(30, 50)]})["seg"].shape == (2, 30, 50)
    with pytest.raises(SampleError, match=r"seg: camera 'a': expected a map of \(h, w\) = \(60, 100\), got \(30, 50\)"):
        resize({**parts, "seg": [torch.zeros(30, 50), torch.zeros(60, 100)]})
    with pytest.raises(SampleError, match="seg: expected 2 label maps, one an image, got 1"):
        resize(blobs(seg=torch.zeros(1, *SIZE)))
    with pytest.raises(ValueError, match="keys: expected a SampleKeys, got tuple"):
        ResizeRig((30, 50), keys=("seg",))  # type: ignore[arg-type]


def test_batches_lists_and_other_types() -> None:
    sample = blobs()
    batch = {"images": sample["images"].expand(3, -1, -1, -1, -1), "rig": RIG, "coverage": torch.ones(3, 2, *SIZE) > 0}
    out = CropRig(1, 2, (20, 30))(batch)
    assert out["images"].shape == (3, 2, 3, 20, 30) and out["coverage"].shape == (3, 2, 20, 30)
    lists = {**batch, "images": list(batch["images"].unbind(1))}
    assert torch.equal(CropRig(1, 2, (20, 30))(lists)["images"], out["images"])
    mixed = Rig([RIG["a"], RIG["b"].resize((30, 50))])
    parts = {"images": [torch.rand(3, 60, 100), torch.rand(3, 30, 50)], "rig": mixed, "K": mixed.K}
    out = ResizeRig((30, 50))(parts)
    assert out["images"].shape == (2, 3, 30, 50) and np.allclose(out["K"].numpy(), out["rig"].K)
    assert pickle.loads(pickle.dumps(CropRig(1, 2, (20, 30)))).size == (20, 30)


def test_what_cannot_follow_is_dropped_and_misuse_is_named() -> None:
    with pytest.warns(UserWarning, match="ResizeRig drops boxes_2d: it speaks of pixels that have moved"):
        assert "boxes_2d" not in ResizeRig((30, 50))(blobs(boxes_2d=torch.zeros(1, 4)))
    with pytest.warns(UserWarning, match="ResizeRig drops neighbours"):  # which are of the old size
        assert "neighbours" not in ResizeRig((30, 50))(blobs(neighbours=[{}]))
    for transform in (ResizeRig((30, 50)), CropRig(0, 0, (30, 50))):
        with pytest.raises(SampleError, match=r"depth_m: .* expected a map of .* = \(60, 100\), got \(30"):
            transform(blobs(depth_m=torch.zeros(2, 30, 50)))
        with pytest.raises(SampleTypeError, match="sample: expected a dict, got list"):
            transform([1, 2])
        out = transform(blobs(coverage=None, depth_m=None, K=torch.eye(4).repeat(2, 1, 1)))
        assert out["coverage"] is None and np.allclose(out["K"].numpy(), out["rig"].K)
    for size in ((0, 5), (2.5, 5), 7, "ab"):
        with pytest.raises(ValueError, match=r"size: expected \(h, w\) in pixels.* whole numbers from 1"):
            ResizeRig(size)
    with pytest.raises(ValueError, match=r"top, left: expected two numbers in pixels.* whole numbers from 0"):
        CropRig(-1, 0, (4, 4))


@pytest.mark.parametrize(
    ("transform", "sample", "message"),
    [
        (CropRig(30, 0, (40, 10)), blobs(), r"within the image of \(h, w\) = \(60, 100\), got rows 30 to 70"),
        (ResizeRig((30, 50)), blobs(classes=torch.zeros(2, *SIZE)), "looks like a map"),
        (ResizeRig((30, 50)), {"images": torch.zeros(1, 3, 4, 4)}, "missing K, cam2ego"),
        (ResizeRig((30, 50), keys=SampleKeys(labels=("seg",))), blobs(seg=None), "as tensors, got NoneType"),
    ],
)
def test_what_is_refused(transform: torch.nn.Module, sample: dict[str, Any], message: str) -> None:
    with pytest.raises((SampleError, SampleTypeError), match=message):
        transform(sample)
