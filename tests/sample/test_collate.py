"""Batches of retargeted samples in a DataLoader; of source samples: the tests of the Lightning adapter."""

import torch
from torch.utils.data import DataLoader

from arbiview_aug import RetargetedDataset, RigRetarget, collate
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig


def test_retargeted_samples_of_differing_numbers_of_objects() -> None:
    rig = demo_source_rig((36, 64))
    drive = SyntheticDrive(rig, num_frames=3, seed=2)
    samples = [drive[k] for k in range(3)]
    assert len({len(sample["boxes_3d"]) for sample in samples}) > 1
    data = RetargetedDataset(samples, RigRetarget(rig.shifted(z_m=0.2), size=(36, 64), p=0.5))
    torch.manual_seed(1)
    (batch,) = DataLoader(data, batch_size=3, collate_fn=collate)
    torch.manual_seed(1)
    alone = list(DataLoader(data, batch_size=None))
    for k, sample in enumerate(alone):
        assert torch.equal(batch["images"][k], sample["images"]) and torch.equal(batch["K"][k], sample["K"])
        assert torch.equal(batch["boxes_3d"][k], sample["boxes_3d"])
        assert [of_camera[k] for of_camera in batch["lens"]] == list(sample["lens"])
