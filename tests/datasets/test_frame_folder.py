"""Frame folders: the sample, real frames, DataLoader, and folders that are not right."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets import FrameFolder, open_data
from arbiview_aug.errors import CalibrationError, DataError
from arbiview_aug.sample.masks import without_specks
from tests.helpers import camera

Change = Callable[[dict[str, Any]], None]


def frame(folder: Path, change: Change | None = None, *, lidar: bool = True) -> Path:
    """A folder with two cameras of different lenses; ``change`` edits the calibration before it is written."""
    folder.mkdir(parents=True, exist_ok=True)
    lens = {"lens": "fisheye", "distortion": (0.01, 0.0, 0.0, 0.0)}
    back = camera("back", 180, size=(48, 64), horizontal_fov_deg=120, **lens)
    rig = Rig([camera("front", size=(48, 64)), back], ground_z_m=-0.3)
    calib = rig.to_dict()
    for k, entry in enumerate(calib["cameras"]):
        entry["file"] = f"{entry['name']}.png"
        cv2.imwrite(str(folder / entry["file"]), np.full((48, 64, 3), (10, 20, 30 + k), np.uint8))
    mask = np.full((48, 64), 255, np.uint8)
    mask[40:] = 0
    cv2.imwrite(str(folder / "mask.png"), mask)
    cv2.imwrite(str(folder / "small.png"), np.ones((24, 32), np.uint8))
    calib["cameras"][1]["mask"] = "mask.png"
    calib["boxes_3d"] = [[5, 1, 0.5, 4, 2, 1.5, 0.3]]
    calib["ego2world"] = np.diag([1.0, 1, 1, 1]).tolist()
    if lidar:
        np.save(folder / "lidar.npy", np.arange(12, dtype=np.float64).reshape(3, 4))
    if change:
        change(calib)
    (folder / "calib.json").write_text(json.dumps(calib))
    return folder


def test_the_sample(tmp_path: Path) -> None:
    sample = FrameFolder(frame(tmp_path / "one"))[0]
    assert sorted(sample) == ["K", "boxes_3d", "cam2ego", "ego2world", "images", "points", "rig", "token"]
    assert sample["images"].shape == (2, 3, 48, 64) and sample["images"].dtype == torch.uint8
    assert sample["images"][1, :, 0, 0].tolist() == [31, 20, 10]  # RGB
    rig = sample["rig"]
    assert rig.names == ["front", "back"] and rig.ground_z_m == -0.3
    assert rig["back"].lens == "fisheye" and rig["back"].distortion == (0.01, 0.0, 0.0, 0.0)
    assert rig["front"].mask is None and not rig["back"].mask[40:].any() and rig["back"].mask[:40].all()
    for key, expected in (("K", rig.K), ("cam2ego", rig.cam2ego), ("ego2world", np.eye(4))):
        assert sample[key].dtype == torch.float64 and np.array_equal(sample[key], expected)
    for key, shape in (("points", (3, 4)), ("boxes_3d", (1, 7))):
        assert sample[key].shape == shape and sample[key].dtype == torch.float32


def test_poses_of_quaternions(tmp_path: Path) -> None:
    sample = FrameFolder(frame(tmp_path / "matrices"))[0]
    forward = {"translation": sample["cam2ego"][0, :3, 3].tolist(), "rotation": [-0.5, 0.5, -0.5, 0.5]}

    def change(calib: dict[str, Any]) -> None:
        calib["cameras"][0]["cam2ego"] = forward
        calib["ego2world"] = {"translation": {"x": 1, "y": 2, "z": 0}, "rotation": {"x": 0, "y": 0, "z": 1, "w": 0}}

    read = FrameFolder(frame(tmp_path / "quaternions", change))[0]
    np.testing.assert_allclose(read["cam2ego"], sample["cam2ego"], atol=1e-12)
    assert read["ego2world"][:2, [0, 3]].tolist() == [[-1, 1], [0, 2]]


def test_a_folder_of_frames_in_the_order_of_their_names(tmp_path: Path) -> None:
    for name in ("c", "a", "b"):
        frame(tmp_path / name)
    (tmp_path / "notes").mkdir()
    dataset = FrameFolder(tmp_path)
    assert len(dataset) == 3 and dataset.by_token("b")["token"] == "b"
    assert dataset.tokens == [sample["token"] for sample in dataset] == ["a", "b", "c"]  # type: ignore[attr-defined]
    with pytest.raises(DataError, match="expected the token of one of 3 samples, got 'z'; they are a, b, c"):
        dataset.by_token("z")
    for error, index in ((TypeError, slice(0, 2)), (IndexError, 3)):
        with pytest.raises(error, match=r"index: expected (a whole number, got slice|one of 3 samples, got 3)"):
            dataset[index]  # type: ignore[call-overload]
    assert repr(dataset) == f"FrameFolder(3 samples in {tmp_path})"


def test_frames_of_one_calibration_share_their_rig(tmp_path: Path) -> None:
    def next_frame(calib: dict[str, Any]) -> None:
        calib["cameras"][0]["timestamp"] = 17
        calib["cameras"][1]["mask"] = "../a/mask.png"

    for name, change in (("a", None), ("b", next_frame), ("c", edit("name", "other", 0))):
        frame(tmp_path / name, change)
    a, b, c = (sample["rig"] for sample in FrameFolder(tmp_path))  # type: ignore[attr-defined]
    assert a is b and a != c


def test_optional_parts_may_be_absent(tmp_path: Path) -> None:
    bare = {"boxes_3d": None, "ego2world": None}
    sample = FrameFolder(frame(tmp_path / "a", lambda calib: calib.update(bare), lidar=False))[0]
    assert sorted(sample) == ["K", "cam2ego", "images", "rig", "token"]
    assert "points" not in FrameFolder(frame(tmp_path / "b"), load_points=False)[0]
    empty = FrameFolder(frame(tmp_path / "c", lambda calib: calib.update(boxes_3d=[])))[0]
    assert empty["boxes_3d"].shape == (0, 7)


def test_reduce_takes_the_rig_along(tmp_path: Path) -> None:
    sample = FrameFolder(frame(tmp_path), reduce=2)[0]
    assert sample["images"].shape == (2, 3, 24, 32) and sample["rig"].sizes == [(24, 32)] * 2
    full = FrameFolder(tmp_path)[0]
    A = np.array([[0.5, 0, -0.25], [0, 0.5, -0.25], [0, 0, 1]])
    np.testing.assert_allclose(sample["K"], A @ full["K"].numpy(), atol=1e-12)
    assert not sample["rig"]["back"].mask[20:].any() and sample["rig"]["back"].mask[:20].all()
    with pytest.raises(ValueError, match="reduce: expected 1, 2 or 4, got 8"):
        FrameFolder(tmp_path, reduce=8)  # type: ignore[arg-type]


# --- real frames ------------------------------------------------------------------------------------------------------
def test_real_masks_lens_and_ground(ddad_root: Path, fisheye_root: Path) -> None:
    sample = FrameFolder(ddad_root, reduce=4)[0]
    assert sample["rig"].ground_z_m == 0.09
    assert all(camera.mask is not None and 0.4 < camera.mask.mean() <= 1 for camera in sample["rig"])
    assert sample["points"].shape == (47230, 4)
    assert {camera.lens for camera in FrameFolder(fisheye_root)[0]["rig"]} == {"fisheye"}


# --- bad input --------------------------------------------------------------------------------------------------------
def swapped(calib: dict[str, Any]) -> None:
    for entry in calib["cameras"]:
        entry.update(width=48, height=64, mask=None)


def edit(key: str, value: Any, camera: int | None = None) -> Change:
    return lambda calib: (calib if camera is None else calib["cameras"][camera]).update({key: value})


def renamed(key: str, name: str, camera: int | None = None) -> Change:
    def change(calib: dict[str, Any]) -> None:
        entries = calib if camera is None else calib["cameras"][camera]
        entries[name] = entries.pop(key)

    return change


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (edit("K", [[np.nan, 0, 32], [0, 40, 24], [0, 0, 1]], 0), CalibrationError, "'front': K: expected finite"),
        (edit("cam2ego", np.diag([1, 1, -1, 1]).tolist(), 0), CalibrationError, "'front': cam2ego: expected right"),
        (edit("cam2ego", {"rotation": [1]}, 0), CalibrationError, "'front': cam2ego: expected a 4x4 matrix, or {trans"),
        (edit("ego2world", {"x": 1}), CalibrationError, "ego2world: expected a 4x4 matrix, or {translation"),
        (edit("distortion", {"model": "mei", "coeffs": [1]}, 1), CalibrationError, "'back': lens: expected one of"),
        (edit("width", 1600, 0), DataError, r"'front': image .*expected 1600x48 \(w x h\) as calibrated, got 64x48"),
        (swapped, DataError, "expected 48x64 .*got 64x48; the calibration's width and height look swapped"),
        (edit("cameras", None), DataError, "expected an object with a list 'cameras'"),
        (edit("cameras", ["front"]), CalibrationError, "camera 0: expected a mapping, got str"),
        (edit("file", None, 0), DataError, "'front': file: expected an image's file name, got None"),
        (edit("file", "gone.png", 1), DataError, r"'back': image .*gone\.png: expected an image file, found none"),
        (edit("mask", "gone.png", 0), CalibrationError, r"'front': mask: expected an image file .*gone\.png"),
        (edit("boxes_3d", [[1, 2, 3]]), DataError, r"boxes_3d: expected shape \(B, >= 7\).*got \(1, 3\)"),
        (edit("boxes_3d", [[0, 0, 0, 4, 2, 1, 0], [0]]), DataError, "boxes_3d: expected rows"),
        (edit("ego2world", [[1, 0], [0, 1]]), DataError, "ego2world: expected 4x4 finite numbers"),
        (edit("ego2world", (np.eye(4) + np.eye(4, k=-3)).tolist()), DataError, "ego2world: expected .*transposed"),
        (edit("ego2world", np.diag([1e200, 1, 1, 1]).tolist()), DataError, "ego2world: expected .* a rotation"),
        (edit("lidar", {"file": "gone.npy"}), DataError, r"lidar: expected the points .*gone\.npy, found no file"),
        (edit("lidar", 3), DataError, "lidar: expected {'file': name}, got 3"),
        (edit("ego2world", [[0.0] * 500] * 500), DataError, "ego2world: expected 4x4 finite numbers"),
        (edit("lidar", ["a"] * 999), DataError, "lidar: expected {'file': name}, got"),
        (edit("file", ["a"] * 999, 0), DataError, "'front': file: expected an image's file name"),
        (edit("lens", "fisheye", 0), CalibrationError, "'lens' is not read: write distortion: {model: LENS"),
        (edit("mask", "small.png", 1), CalibrationError, r"'back': mask: expected shape \(48, 64\)"),
        # what would change the meaning
        (renamed("K", "intrinsics", 0), CalibrationError, "missing K; found 'intrinsics': did you mean 'K'?"),
        (renamed("file", "filename", 0), DataError, "found 'filename': did you mean 'file'?"),
        (renamed("distortion", "distortions", 1), CalibrationError, "'distortions' is not read: did you mean"),
        (renamed("distortion", "dist_coeffs", 1), CalibrationError, "'dist_coeffs' is not read: did you mean"),
        (renamed("ground_z_m", "ground_z"), CalibrationError, "'ground_z' is not read: did you mean 'ground_z_m'?"),
        (renamed("cameras", "cams"), DataError, "found 'cams': did you mean 'cameras'?"),
        (edit("xi", 0.9, 0), CalibrationError, "camera 'front': xi: 0.9 is not read; write distortion"),
        (edit("rectified", False, 0), CalibrationError, "rectified: False is not read"),
        (edit("distortion_model", "equidistant", 0), CalibrationError, "'equidistant' is not read"),
        (edit("coverage", 3, 0), DataError, "coverage: expected an image's file name, got 3"),
        (edit("lidar", ""), DataError, "lidar: expected {'file': name}, got ''"),
    ],
)
def test_bad_calibrations(tmp_path: Path, change: Change, error: type[Exception], message: str) -> None:
    dataset = FrameFolder(frame(tmp_path / "broken", change))
    with pytest.raises(error, match=message) as raised:
        dataset[0]
    assert "broken" in str(raised.value)  # the frame is named, whatever went wrong
    assert len(str(raised.value).replace(str(tmp_path), "")) < 1000


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (renamed("boxes_3d", "boxes_3D"), "'boxes_3D' is not read; did you mean 'boxes_3d'?"),
        (edit("lidar_points", "points.npy"), "'lidar_points' is not read; did you mean 'lidar'?"),
        (edit("masks", "front_mask.png", 0), "'masks' is not read; did you mean 'mask'?"),
    ],
)
def test_keys_under_other_names_are_warned_of_once(tmp_path: Path, change: Change, words: str) -> None:
    data = FrameFolder(frame(tmp_path, change))
    with pytest.warns(UserWarning, match="calib.json") as said:
        assert data[0]["rig"].names == data[0]["rig"].names
    assert len(said) == 1 and words in str(said[0].message)


def test_a_mask_that_was_drawn_anew_is_read_again(tmp_path: Path) -> None:
    """In one process, as a notebook's, masks are held."""
    frame(tmp_path)
    dataset = FrameFolder(tmp_path)
    assert dataset[0]["rig"]["back"].mask[:40].all() and dataset[0]["rig"] is dataset[0]["rig"]
    cv2.imwrite(str(tmp_path / "mask.png"), np.zeros((48, 64), np.uint8))
    os.utime(tmp_path / "mask.png", (0, 0))  # another time, however coarse the clock
    assert not FrameFolder(tmp_path)[0]["rig"]["back"].mask.any() and not dataset[0]["rig"]["back"].mask.any()


def test_bad_points(tmp_path: Path) -> None:
    frame(tmp_path)
    dataset = FrameFolder(tmp_path)
    for array, message in (
        (np.zeros((5, 2)), r"points .*expected shape \(P, >= 3\), x y z in the ego frame, got \(5, 2\)"),
        (np.zeros((4, 500)), r"got \(4, 500\); transpose them: points\.T"),
        (np.array([{}]), r"lidar\.npy: expected a \.npy array of numbers"),
        (np.zeros((5, 3), int), r"got int64 \(5, 3\)"),
    ):
        np.save(tmp_path / "lidar.npy", array, allow_pickle=True)
        with pytest.raises(DataError, match=message):
            dataset[0]
    (tmp_path / "lidar.npy").write_bytes((tmp_path / "lidar.npy").read_bytes()[:-9])
    with pytest.raises(DataError, match=r"lidar\.npy: expected a \.npy array of numbers"):
        dataset[0]
    (tmp_path / "lidar.npy").unlink()
    (tmp_path / "lidar.npy").symlink_to(tmp_path / "gone.npy")
    with pytest.raises(DataError, match=r"lidar: expected the points .*npy, found no file"):
        dataset[0]


def test_missing_returns_are_left_out(tmp_path: Path) -> None:
    """As RigRetarget leaves them out of a sample of the user's own."""
    missing = [[0, 0, np.nan], [1, 2, 3], [np.inf, 0, 0], [0, 0, 1e300]]
    for points in (np.array(missing), np.array(missing[1:3], np.float16)):
        np.save(frame(tmp_path) / "lidar.npy", points)
        with pytest.warns(UserWarning, match="points: rows with NaN, infinity or over 1e.09 m are left out"):
            assert FrameFolder(tmp_path)[0]["points"].tolist() == [[1, 2, 3]]


def test_folders_that_are_none(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="expected a folder, found none"):
        FrameFolder(tmp_path / "gone")
    with pytest.raises(DataError, match=r"expected calib\.json, or folders that have one, found neither"):
        FrameFolder(tmp_path)
    frame(tmp_path)
    dataset = FrameFolder(tmp_path)
    for text, got in (("{", ""), ('{"cameras": [], "cameras": []}', " the key 'cameras' stands twice")):
        (tmp_path / "calib.json").write_text(text)
        with pytest.raises(DataError, match=rf"calib\.json: expected JSON, got{got}"):
            dataset[0]
    shutil.rmtree(tmp_path)
    with pytest.raises(DataError, match="expected a calibration, found no file"):
        dataset[0]


def test_notes_of_neutral_lenses_and_byte_order_marks(tmp_path: Path, recwarn: pytest.WarningsRecorder) -> None:
    notes = {"rectified": True, "camera_model": "FLIR BFS", "k1": 0, "distortion_model": "plumb_bob", "lens": "6 mm"}
    notes |= {"distortions": [0, 0, 0, 0], "cam2ego_static": np.eye(4).tolist()}

    def change(calib: dict[str, Any]) -> None:
        calib |= {"license": "as you like", "timestamp": 1, "labels": [1], "boxes_2d": [], "lidar_points": 12}
        calib["ground_z"] = 3
        calib["cameras"][0].update(notes)
        calib["cameras"][1]["distortion"]["model"] = "opencv_fisheye"
        calib["cameras"][1]["dist_coeffs"] = [0.1, 0, 0, 0]  # the right key is there as well

    frame(tmp_path / "000", change)
    (tmp_path / "sequence.json").write_text(json.dumps({"frames": ["000"]}))
    for path in (tmp_path / "sequence.json", tmp_path / "000" / "calib.json"):
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    sample = FrameFolder(tmp_path)[0]
    assert sample["scene_token"] == tmp_path.name and sample["rig"]["back"].lens == "fisheye" and not list(recwarn)


# --- masks that are cleaned -------------------------------------------------------------------------------------------
def test_specks_in_masks_are_cleaned_on_demand(ddad_root: Path) -> None:
    for reduce in (1, 4):
        raw, cleaned = (FrameFolder(ddad_root, reduce=reduce, clean_masks=clean)[0]["rig"] for clean in (False, True))
        for one, two in zip(raw, cleaned, strict=True):
            assert two.mask is not None and (without_specks(two.mask) == two.mask).all()
            assert (one.mask != two.mask).mean() < 3e-3
    assert any((one.mask != two.mask).any() for one, two in zip(raw, cleaned, strict=True))


@pytest.mark.slow
def test_rims_are_those_of_several_frames(fisheye_root: Path, tmp_path: Path) -> None:
    """A dark first frame neither hides the rim nor widens it, and every frame gets the same rig."""
    for name, gain in (("a", 0.1), ("b", 1.0), ("c", 0.5)):
        shutil.copytree(fisheye_root, tmp_path / name)
        for file in (tmp_path / name).glob("*.png"):
            cv2.imwrite(str(file), (cv2.imread(str(file)) * gain).astype(np.uint8))
    rigs = [open_data(tmp_path, clean_masks=True)[k]["rig"] for k in (2, 0, 1)]
    masks = [camera.mask for camera in rigs[0]]
    assert [mask is not None for mask in masks] == [True, False, True, True], "past the left lens's fold all is dark"
    assert all(0.15 < (~mask).mean() < 0.22 for mask in masks if mask is not None)
    assert rigs[0] == rigs[1] == rigs[2] == FrameFolder(fisheye_root, clean_masks=True)[0]["rig"]
    assert all(camera.mask is None for camera in open_data(tmp_path)[0]["rig"])
    (tmp_path / "b" / "front.png").write_bytes(b"broken")
    assert FrameFolder(tmp_path, clean_masks=True)[2]["rig"][1:] == rigs[0][1:], "its own message comes when it is read"
