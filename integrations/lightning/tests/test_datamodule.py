"""The data module in a Trainer: run by the mark ``integrations`` where lightning is installed."""

import pytest

pytest.importorskip("lightning")

import lightning

from arbiview_aug.datasets import NuScenesDataset
from integrations.lightning.example import NearestBox, main
from integrations.nuscenes.made import VERSION, made_root
from integrations.snippets import snippets


def test_example_trains_on_retargeted_and_validates_on_untouched_frames(capsys):
    assert main() == 0
    shapes = capsys.readouterr().out
    assert shapes.count("('train', (2, 5, 3, 64, 176))") == 4 and shapes.count("('val', (2, 5, 3, 64, 176))") == 2


def test_the_readmes_code_trains(tmp_path):
    root = made_root(tmp_path / "root")
    changes = {"data/nuscenes": str(root), "v1.0-trainval": VERSION, "batch_size=8": "batch_size=1"}
    (code,) = snippets("lightning", {**changes, "    num_workers=8,\n": ""})
    model = NearestBox()
    trainer = lightning.Trainer(
        max_epochs=1, limit_val_batches=1, logger=False, enable_checkpointing=False, enable_progress_bar=False
    )
    exec(code, {"model": model, "trainer": trainer, "frames_of_vehicle_b": NuScenesDataset(root, VERSION)})
    assert model.shapes.count(("train", (1, 5, 3, 256, 704))) == 2
