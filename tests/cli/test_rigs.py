"""``python -m arbiview_aug inspect``: tables, differences, and one rig for several vehicles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.utils.data import ConcatDataset, DataLoader

from arbiview_aug import RetargetedDataset, RigRetarget, collate
from arbiview_aug.__main__ import main
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.rigs import differences
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.errors import CalibrationError
from arbiview_aug.evaluate.common_rig import LEAST_SEEN, common_rig, seen_shares
from tests.helpers import camera


def test_prints_tables_and_differences_and_writes_the_picture(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "rigs.png"
    assert main(["inspect", "nuscenes", "waymo", "--output", str(output)]) == 0
    printed = capsys.readouterr().out
    assert repr(load_rig("nuscenes")) in printed and repr(load_rig("waymo")) in printed
    assert "From nuscenes to waymo:" in printed and f"picture: {output}" in printed
    assert cv2.imread(str(output)) is not None


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if line[:1] == "|"]


def test_differences_are_over_the_road() -> None:
    """Argoverse 2's origin is 0.33 m above the road: its front camera is 0.22 m higher, not 0.11 m lower."""
    table = differences(load_rig("nuscenes"), load_rig("argoverse2"))
    (row,) = [row for row in cells(table) if row[0] == "ring_front_center"]
    assert row[1] == "CAM_FRONT" and row[3:6] == ["-0.07", "-0.01", "+0.22"]


def test_same_rig_has_no_differences() -> None:
    rig = load_rig("ddad")
    for name, row in zip(rig.names, cells(differences(rig, rig))[2:], strict=True):
        assert row[:6] == [name, name, "0.0 deg", "+0.00", "+0.00", "+0.00"]


PRINCIPAL_PX = np.array([[0, 0, 0], [0, 0, 30.0], [0, 0, 0]])


def of_each(rig: Rig, changed: Callable[[Camera], Camera]) -> Rig:
    return rig.with_cameras([changed(camera) for camera in rig])


def test_differences_within_the_noise_of_calibration_are_named() -> None:
    rig = load_rig("nuscenes")
    fisheye = load_rig("fisheye_surround")
    pairs = [
        *((rig, rig.shifted(z_m=0.01), True), (rig, rig.shifted(z_m=0.03), False)),
        *((rig, rig.turned(yaw_deg=0.3), False), (rig, rig.resized(0.5), True)),
        *((rig, of_each(rig, lambda c: c.turned(roll_deg=10)), False), (fisheye, fisheye.resized(0.5), True)),
        *((one, of_each(one, lambda c: replace(c, K=c.K + PRINCIPAL_PX)), False) for one in (rig, fisheye)),
    ]
    for one, other, is_noise in pairs:
        assert ("do not retarget" in differences(one, other)) == is_noise, other


def test_files_and_folders(tmp_path: Path) -> None:
    load_rig("waymo").save(tmp_path / "calib.json")
    arguments = ["--output", str(tmp_path / "rig.png")]
    assert (
        main(["inspect", str(tmp_path), *arguments]) == main(["inspect", str(tmp_path / "calib.json"), *arguments]) == 0
    )


def test_unknown_rig_and_unwritable_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kind in ("nuscenes:", ""):
        assert main(["inspect", f"{kind}{tmp_path}"]) == 2
        assert ("another tool's calibration" in capsys.readouterr().err) == (not kind)
    assert main(["inspect", "tesla"]) == 2
    assert "expected a file or one of the shipped rigs" in capsys.readouterr().err
    for output in ("rig.words", "file/rig.png"):  # before any rig is read
        (tmp_path / "file").touch()
        assert main(["inspect", "tesla", "--output", str(tmp_path / output)]) == 2
        assert "--output" in capsys.readouterr().err


# --- inspect --common -------------------------------------------------------------------------------------------------
LOW = Rig([camera("front", 0, position_m=(1.0, 0.0, 1.2)), camera("left", 60, position_m=(1.0, 0.5, 1.2))], name="low")
HIGH = Rig([camera("fore", 5, position_m=(2.0, 0.0, 2.2), size=(90, 160))], name="high")


def test_every_rig_sees_it() -> None:
    common = common_rig([LOW, HIGH])
    assert len(common) == 1 and common[0].is_rectilinear  # what looks to the left has one rig alone
    assert common[0].center_m[2] == pytest.approx((1.2 + 2.2) / 2)
    for rig in (LOW, HIGH):
        out = RigRetarget(common, geometry="street", holes="black")(
            {"images": torch.zeros(len(rig), 3, *rig[0].size), "rig": rig}
        )
        assert seen_shares(rig, common)[0] >= LEAST_SEEN and out["coverage"].float().mean() > LEAST_SEEN - 0.02


def test_equal_rigs_keep_their_views() -> None:
    rig = load_rig("nuscenes")
    common = common_rig([rig, rig])
    assert common.names == rig.names
    np.testing.assert_allclose([c.fov_deg[0] for c in common], [c.fov_deg[0] for c in rig])


def test_rigs_that_share_no_view() -> None:
    with pytest.raises(CalibrationError, match="no view is seen by all of front, back"):
        common_rig([Rig([camera("f", 0)], name="front"), Rig([camera("b", 180)], name="back")])
    with pytest.raises(CalibrationError, match="two or more rigs, got 1"):
        common_rig([LOW])


def test_the_command_and_mixed_batches(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for rig in (LOW, HIGH):
        rig.save(tmp_path / f"{rig.name}.yaml")
    file = tmp_path / "common.yaml"
    rigs = [str(tmp_path / f"{rig.name}.yaml") for rig in (LOW, HIGH)]
    assert main(["inspect", *rigs, "--common", "--output", str(file)]) == 0
    assert "| seen by |" in capsys.readouterr().out
    retarget = RigRetarget(load_rig(file), size=(48, 96))
    data = ConcatDataset([RetargetedDataset(SyntheticDrive(rig, num_frames=2), retarget) for rig in (LOW, HIGH)])
    (batch,) = DataLoader(data, batch_size=4, collate_fn=collate)
    assert batch["images"].shape == (4, 1, 3, 48, 96)
    assert main(["inspect", *rigs, "--common", "--output", str(tmp_path / "common.png")]) == 2
