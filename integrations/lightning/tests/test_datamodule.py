"""The data module in a Trainer: run by the mark ``integrations`` where lightning is installed."""

import pytest

pytest.importorskip("lightning")

import lightning
import torch

from arbiview_aug import RigRetarget
from arbiview_aug.datasets import Neighbours, NuScenesDataset
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.integrations.lightning import RetargetDataModule
from integrations.lightning.example import NearestBox, main
from integrations.nuscenes.fake_root import VERSION, fake_root
from integrations.snippets import snippets


def test_example_trains_on_retargeted_and_validates_on_untouched_frames(capsys):
    assert main() == 0
    shapes = capsys.readouterr().out
    assert shapes.count("('train', (2, 5, 3, 64, 176))") == 4 and shapes.count("('val', (2, 5, 3, 64, 176))") == 2


def test_the_readmes_code_trains(tmp_path):
    root = fake_root(tmp_path / "root")
    changes = {"data/nuscenes": str(root), "v1.0-trainval": VERSION, "batch_size=8": "batch_size=1"}
    (code,) = snippets("lightning", {**changes, "    num_workers=8,\n": ""})
    model = NearestBox()
    trainer = lightning.Trainer(
        max_epochs=1, limit_val_batches=1, logger=False, enable_checkpointing=False, enable_progress_bar=False
    )
    exec(code, {"model": model, "trainer": trainer, "frames_of_vehicle_b": NuScenesDataset(root, VERSION)})
    assert model.shapes.count(("train", (1, 5, 3, 256, 704))) == 2


@pytest.mark.parametrize("precision", ["32-true", "bf16-true"])
def test_neighbours_and_precisions(precision):
    """Neighbours are no batch of Lightning's, and calibration rounded to bfloat16 would be none."""
    rig = demo_source_rig((48, 128))
    drive = SyntheticDrive(rig, num_frames=2, lidar=False, neighbours=Neighbours(count=1))
    seen = []

    class Looks(NearestBox):
        def training_step(self, batch, index):
            seen.append((batch["K"], batch["cam2ego"], batch["boxes_3d"]))
            return self.head(torch.ones(1, 8, dtype=self.head.weight.dtype)).sum()

    data = RetargetDataModule(drive, drive, RigRetarget(rig.turned(pitch_deg=-10), geometry="street"), batch_size=2)
    trainer = lightning.Trainer(
        max_epochs=1,
        limit_val_batches=0,
        precision=precision,
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        accelerator="cpu",
    )
    trainer.fit(Looks(), data)
    ((K, cam2ego, boxes),) = seen
    assert K.dtype == cam2ego.dtype == torch.float64 and torch.allclose(K[0], torch.from_numpy(rig.K))
    assert all(of_frame.dtype == torch.float32 for of_frame in boxes)
