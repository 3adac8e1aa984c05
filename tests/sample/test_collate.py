"""Batches of retargeted samples in a DataLoader; of source samples: the tests of the Lightning adapter."""

from dataclasses import replace

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
        assert batch["lens"] == sample["lens"]


def test_lenses_of_a_batch() -> None:
    """A name for each camera, over the frames where they differ: what a loader gives can be retargeted again."""
    plain = demo_source_rig((36, 64))
    bent = plain.with_cameras([replace(c, lens="radtan", distortion=(-0.1, 0.01, 0, 0)) for c in plain])
    step = RigRetarget(bent, size=(36, 64), p=0.5, geometry="street")
    sample = SyntheticDrive(plain, num_frames=1)[0]
    skipped, done = (step(sample, params={"skipped": value}) for value in (1.0, 0.0))
    assert collate([done, done])["lens"] == done["lens"] == ["radtan"] * len(plain)
    mixed = collate([skipped, done])
    assert mixed["lens"] == [["pinhole", "radtan"]] * len(plain)
    back = RigRetarget(plain, geometry="street")
    again = back(mixed)
    for k, single in enumerate((skipped, done)):
        assert torch.equal(again["images"][k], back(single)["images"])
