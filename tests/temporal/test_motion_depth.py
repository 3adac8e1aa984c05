"""Depth from motion on static streets: accuracy, density, and when it declines."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget
from arbiview_aug.datasets import Neighbours
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import SampleError
from arbiview_aug.sample.frame import Frame, Neighbour
from arbiview_aug.sample.inputs import read_frames
from arbiview_aug.scene.boxes import draw_boxes
from arbiview_aug.scene.depth_map import motion_camera
from arbiview_aug.temporal.motion_depth import MotionDepth, motion_depth
from tests.helpers import Standing

SIDE = demo_source_rig((96, 256))
SIDE = SIDE.with_cameras([SIDE[0], SIDE[1]])  # front and front left: two cameras are quick


@pytest.fixture(scope="module")
def drive() -> SyntheticDrive:
    return Standing(SIDE, num_frames=4, seed=5, lidar=False, neighbours=Neighbours())


@pytest.fixture(scope="module")
def sample(drive: SyntheticDrive) -> dict[str, Any]:
    frame = drive[1]
    del frame["boxes_3d"]
    frame["neighbours"] = [
        {k: torch.as_tensor(n[k]) if k == "images" else n[k] for k in n if k != "boxes_3d"} for n in frame["neighbours"]
    ]
    return frame


def read(sample: dict[str, Any]) -> Frame:
    (frame,) = read_frames(sample, None, further=("neighbours",), warn=lambda topic, message: pytest.fail(message))
    return frame


def depth_of(sample: dict[str, Any], **changes: Any) -> MotionDepth:
    frame = read(sample)
    settings: dict[str, Any] = {"neighbours": frame.neighbours, "boxes": None, "load": lambda n: n.images(frame.images)}
    return motion_depth(frame.rig, frame.images, **(settings | changes))


def turned(sample: dict[str, Any], degrees: float) -> dict[str, Any]:
    """Turn the neighbours' poses."""
    entries = []
    for k, entry in enumerate(sample["neighbours"]):
        pose = entry["ego2world"].numpy().copy()
        pose[:3, :3] = pose[:3, :3] @ cv2.Rodrigues(np.radians(degrees) * np.eye(3)[2 - k])[0]
        entries.append({**entry, "ego2world": torch.from_numpy(pose)})
    return {**sample, "neighbours": entries}


def right(drive: SyntheticDrive, depth: MotionDepth) -> tuple[float, float]:
    """Share of pixels with a depth, among those nearer than 80 m and 6 degrees off the motion; and the share of these
    within a tenth of the truth."""
    kept = good = pixels = 0
    for camera, one, true in zip(drive.rig, depth.depth_m, drive.render(1).depth_m, strict=True):
        rays, _ = camera.unproject(camera.pixel_grid())
        aside = np.abs(rays[..., 0]) < np.cos(np.radians(6))
        ask = aside & (true.numpy() < 80)
        kept, pixels = kept + (ask & (one > 0)).sum(), pixels + ask.sum()
        good += (ask & (one > 0) & (np.abs(one - true.numpy()) <= 0.1 * true.numpy())).sum()
    return kept / pixels, good / kept


@pytest.fixture(scope="module")
def exact(sample: dict[str, Any]) -> MotionDepth:
    return depth_of(sample)


def test_most_pixels_have_the_right_depth(drive: SyntheticDrive, exact: MotionDepth) -> None:
    density, share = right(drive, exact)
    assert density > 0.6 and share > 0.9
    assert "synthetic-5-1" in str(exact) and "%" in str(exact)


@pytest.mark.slow
def test_wrong_poses_are_corrected_or_declined(
    drive: SyntheticDrive, sample: dict[str, Any], exact: MotionDepth
) -> None:
    corrected = depth_of(turned(sample, 0.3))
    assert "poses corrected by" in corrected.words
    density, share = right(drive, corrected)
    assert density > right(drive, exact)[0] - 0.05 and share > 0.9
    lost = depth_of(turned(sample, 4.0))
    assert lost.density == 0 and "what else the sample offers stands" in str(lost)
    assert "the pose of frame" in lost.words or "too little of frame" in lost.words


@pytest.mark.slow
def test_one_side_alone(drive: SyntheticDrive, sample: dict[str, Any]) -> None:
    density, share = right(drive, depth_of({**sample, "neighbours": sample["neighbours"][:1]}))
    assert density > 0.4 and share > 0.85


def test_without_frames_nearby_it_declines(sample: dict[str, Any]) -> None:
    assert "no frame 0.4 to 3 m before or after" in depth_of({**sample, "neighbours": []}).words
    assert depth_of(sample, load=lambda neighbour: None).density == 0


def test_a_lost_frame_leaves_the_other_side(sample: dict[str, Any]) -> None:
    (frame,) = read_frames(sample, None)

    def load(neighbour: Neighbour) -> Any:
        return None if "-0." in neighbour.name else neighbour.images(frame.images)

    one = depth_of(sample, load=load)
    assert one.density > 0.2 and "-0." not in one.words and " and " not in one.words.partition(";")[0]


PARKED = np.array([[8.0, 6.0, 1.0, 4.0, 2.0, 2.0, 0.0]])  # a label at the kerb, front left


def with_labels(sample: dict[str, Any], moved_m: float | None) -> MotionDepth:
    """Depth with the label, which moved along the street in the neighbours; None for neighbours without labels."""
    then = None if moved_m is None else PARKED + np.array([moved_m, 0, 0, 0, 0, 0, 0])
    return depth_of(sample, boxes=PARKED, neighbours=[replace(one, boxes=then) for one in read(sample).neighbours])


def test_labels_of_what_moved_are_left_out(sample: dict[str, Any], exact: MotionDepth) -> None:
    less = with_labels(sample, 1.0).depth_m[1]
    shown = draw_boxes(SIDE[1], PARKED)[1] >= 0
    around = cv2.dilate(shown.astype(np.uint8), np.ones((3, 3))) > 0
    assert shown.sum() > 300 and not less[around].any() and exact.depth_m[1][around].any()
    far = cv2.dilate(shown.astype(np.uint8), np.ones((41, 41))) == 0
    assert (less[far] > 0).mean() > 0.95 * (exact.depth_m[1][far] > 0).mean()


@pytest.mark.parametrize("moved_m", [None, 0.3], ids=["neighbours without labels", "less than labels jitter"])
def test_depth_must_agree_with_labels_that_may_have_moved(
    sample: dict[str, Any], exact: MotionDepth, moved_m: float | None
) -> None:
    found, unlabelled = with_labels(sample, moved_m).depth_m[1], exact.depth_m[1]
    face, _ = draw_boxes(SIDE[1], PARKED)
    z = SIDE[1].unproject(SIDE[1].pixel_grid())[0] @ SIDE[1].cam2ego[:3, 2]
    off = np.abs(z / np.maximum(found, 1e-6) - face) > 0.101 * face
    assert not (found[face > 0] > 0)[off[face > 0]].any() and np.array_equal(
        found[face == 0] > 0, unlabelled[face == 0] > 0
    )


def test_labels_that_stand_change_nothing(drive: SyntheticDrive, exact: MotionDepth) -> None:
    labelled = drive[1]  # every object of this street stands
    boxes = labelled["boxes_3d"].numpy().astype(float)
    assert sum((draw_boxes(camera, boxes)[1] >= 0).sum() for camera in SIDE) > 1000
    same = depth_of(labelled, boxes=boxes)
    assert all(map(np.array_equal, same.depth_m, exact.depth_m))


def test_as_a_surface(drive: SyntheticDrive, sample: dict[str, Any], exact: MotionDepth) -> None:
    target = SIDE.shifted(y_m=1.0)
    motion = RigRetarget(target, geometry="motion", neighbours=None)
    online = motion(sample)
    offline = motion({**sample, "neighbours": [], "motion_depth_m": torch.from_numpy(np.stack(exact.depth_m))})
    assert torch.equal(online["images"], offline["images"])
    assert "motion_depth_m" not in offline and "neighbours" not in online
    true = drive.render(1, target).images.float()
    static = RigRetarget(target, geometry="street")(sample)
    both = (online["coverage"] & static["coverage"])[:, None]
    errors = [float(((out["images"] - true) ** 2 * both).sum()) for out in (online, static)]
    assert errors[0] < 0.6 * errors[1]  # 2.2 dB
    assert "depth from motion: " in str(motion.explain(sample))
    assert "over the motion surface" in str(motion.explain(sample))


def test_the_street_replaces_declined_depth_with_a_warning(sample: dict[str, Any]) -> None:
    target = SIDE.shifted(y_m=0.5)
    motion = RigRetarget(target, geometry="motion")
    with pytest.warns(UserWarning, match="depth from motion: none, no frame .* what else the sample offers stands"):
        out = motion({**sample, "neighbours": []})
    assert torch.equal(out["images"], RigRetarget(target, geometry="street")(sample | {"neighbours": []})["images"])
    nothing: Any = [torch.zeros(motion_camera(camera).size) for camera in sample["rig"]]
    for geometry in ("motion", "learned"):
        brought = {**sample, f"{geometry}_depth_m": nothing}
        for words, extra in (("depth_m: 0 every", {}), ("none, why", {f"{geometry}_depth_words": "none, why"})):
            with pytest.warns(UserWarning, match=words):
                RigRetarget(target, geometry=geometry)(brought | extra)


@pytest.mark.parametrize("size", [(1, 8), (8, 1)])
def test_images_of_one_pixel_are_declined(size: tuple[int, int]) -> None:
    tiny = depth_of(Standing(SIDE.resized(size), num_frames=3, lidar=False, neighbours=Neighbours())[1])
    assert "images one pixel wide or high" in str(tiny) and not tiny.density


def test_messages(sample: dict[str, Any]) -> None:
    bare = {key: value for key, value in sample.items() if key != "neighbours"}
    motion = RigRetarget(SIDE.shifted(y_m=0.5), geometry="motion")
    with pytest.raises(SampleError, match=r"geometry='motion': expected 'neighbours' .* 'motion_depth_m'"):
        motion(bare)
    with pytest.raises(SampleError, match=r"motion_depth_m: camera 'front': expected a map of \(96, 256\)"):
        motion({**bare, "motion_depth_m": torch.zeros(2, 10, 10)})
    same = RigRetarget(SIDE, geometry="motion")(bare)  # nothing depends on distances: nothing is needed
    assert torch.equal(same["images"], sample["images"])
