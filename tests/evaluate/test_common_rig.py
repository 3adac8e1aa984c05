"""``inspect --common``: one rig for several vehicles."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import ConcatDataset, DataLoader

from arbiview_aug import RetargetedDataset, RigRetarget, collate, load_rig
from arbiview_aug.__main__ import main
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.errors import CalibrationError
from arbiview_aug.evaluate.common_rig import LEAST_SEEN, common_rig, seen_shares
from tests.helpers import camera

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
