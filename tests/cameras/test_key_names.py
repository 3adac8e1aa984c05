"""Keys under other names: "did you mean …", and no false alarm."""

from __future__ import annotations

import warnings
from typing import Any

import pytest
import torch

from arbiview_aug import Camera, Rig, RigRetarget, SampleError, SampleKeys
from arbiview_aug.cameras.key_names import USUAL_NAMES, meant_by

BOXES = torch.tensor([[8.0, 1.0, 0.8, 4.0, 2.0, 1.6, 0.1]])
RIG = Rig(
    [Camera.looking(name="front", azimuth_deg=0, width_px=16, height_px=12, horizontal_fov_deg=70)], ground_z_m=-0.2
)


def sample(**more: Any) -> dict[str, Any]:
    return {"images": torch.zeros(1, 3, 12, 16), "K": torch.tensor(RIG.K), "cam2ego": torch.tensor(RIG.cam2ego), **more}


def warned(entries: dict[str, Any], calls: int = 2, **settings: Any) -> list[str]:
    """Warnings about keys in so many calls."""
    retarget = RigRetarget(RIG.turned(yaw_deg=3), **settings)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(calls):
            retarget(entries)
    return [str(w.message) for w in caught if "did you mean" in str(w.message)]


@pytest.mark.parametrize(
    ("key", "value", "meant"),
    [
        ("gt_boxes", BOXES, "boxes_3d"),
        ("boxes", [BOXES], "boxes_3d"),
        ("boxes_3D", BOXES.numpy(), "boxes_3d"),
        ("lidar_points", torch.rand(5, 3), "points"),
        ("depth_map", torch.rand(1, 6, 8), "depth_m"),
        ("distortions", torch.zeros(1, 4), "distortion"),
        ("lenses", ["fisheye"], "lens"),
        ("ground_z", 0.3, "ground_z_m"),
        ("neighbors", [], "neighbours"),
    ],
)
def test_a_key_that_nobody_reads_is_named_once(key: str, value: Any, meant: str) -> None:
    (words,) = warned(sample(**{key: value}))
    assert words.startswith(f"{key}: expected the name {meant!r}, found a key that is not read; did you mean")


@pytest.mark.parametrize(
    ("more", "settings"),
    [
        ({"gt_boxes": BOXES, "boxes_3d": BOXES}, {}),  # the right key is there as well
        ({"gt_boxes": BOXES}, {"keys": SampleKeys(keep=("gt_boxes",))}),  # the user knows
        ({"gt_boxes": BOXES}, {"geometry": "street"}),  # nothing would read it
        ({"boxes": [torch.rand(3, 4)]}, {}),  # torchvision's, in pixels
        ({"boxes": 3, "lidar": "0001.bin", "depth_map": "0001.png"}, {}),
        ({"lenses": ["radtan"], "ground_z": 1.0, "rig": RIG}, {}),  # the rig says it
        ({"lenses": ["radtan"], "ground_z": 1.0}, {"source": RIG}),
        ({"token": "a", "timestamp": 1, "time_s": 0.1, "labels": [1], "labels_3d": [1], "boxes_2d": []}, {}),
        ({"gt_names": ["car"], "box_names": ["car"], "keypoints": 1, "joints": 1, "lidar2ego": 1}, {}),
    ],
)
def test_no_false_alarm(more: dict[str, Any], settings: dict[str, Any]) -> None:
    assert not warned(sample(**more), **settings)


def test_depth_that_is_dropped_is_named() -> None:
    (words,) = warned(sample(depth=torch.rand(1, 12, 16)))
    assert "drops depth: they speak of the source's pixels or cameras; found 'depth': did you mean 'depth_m'?" in words
    assert not warned(sample(depth=torch.rand(1, 12, 16), depth_m=torch.zeros(1, 12, 16)))


def test_labels_that_would_not_be_moved_are_named() -> None:
    (words,) = warned(sample(gt_boxes=BOXES), geometry="street", keys=SampleKeys(frame="target"))
    assert "'boxes_3d'" in words


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"K": "intrinsics"}, "missing K; found 'intrinsics': did you mean 'K'?"),
        ({"K": "intrinsics", "cam2ego": "camera2ego"}, "'K'?; found 'camera2ego': did you mean 'cam2ego'?"),
        ({"images": "imgs"}, "got imgs, K, cam2ego; found 'imgs': did you mean 'images'?"),
    ],
)
def test_errors_name_what_was_found_instead(change: dict[str, str], words: str) -> None:
    renamed = {change.get(key, key): value for key, value in sample().items()}
    with pytest.raises(SampleError) as caught:
        RigRetarget(RIG)(renamed)
    assert words in str(caught.value)


def test_surfaces_that_lack_their_geometry_name_it() -> None:
    with pytest.raises(SampleError, match="found 'pts': did you mean 'points'"):
        RigRetarget(RIG.shifted(z_m=1), geometry="lidar")(sample(pts=BOXES))


def test_the_table_is_of_other_names() -> None:
    for name, others in USUAL_NAMES.items():
        assert all(meant_by(other, (name,)) == name for other in others) and name not in others


@pytest.mark.parametrize(("alias", "lens"), [("opencv_radtan", "radtan"), ("opencv_fisheye", "fisheye")])
def test_opencvs_lenses_by_their_other_names(alias: str, lens: str) -> None:
    lensed = sample(distortion=torch.tensor([[0.1, -0.02, 0.003, 0.001, 0, 0, 0, 0]]), ground_z_m=-0.2)
    named, alike = (RigRetarget(RIG.turned(yaw_deg=3))({**lensed, "lens": [name]}) for name in (alias, lens))
    assert torch.equal(named["coverage"], alike["coverage"]) and named["coverage"].any()
