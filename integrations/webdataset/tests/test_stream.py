"""Streaming by webdataset: run by the mark ``integrations`` where it is installed."""

import pytest
import torch
from torch.utils.data import DataLoader

pytest.importorskip("webdataset")

from arbiview_aug import RigRetarget
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.integrations.webdataset import stream, write_shard
from integrations.snippets import snippets
from integrations.webdataset.example import main


@pytest.mark.parametrize("workers", [0, 2])
def test_each_frame_comes_once_and_retargeted(tmp_path, workers):
    rig = demo_source_rig((48, 128))
    drive = SyntheticDrive(rig, num_frames=4, lidar=False)
    urls = [str(write_shard(tmp_path / f"{k}.tar", [drive[2 * k], drive[2 * k + 1]])) for k in range(2)]
    retarget = RigRetarget(rig.turned(yaw_deg=20), geometry="street")
    samples = list(DataLoader(stream(urls, retarget), batch_size=None, num_workers=workers))
    by_token = {sample["token"]: sample for sample in samples}
    assert len(samples) == 4 and set(by_token) == {drive[k]["token"] for k in range(4)}
    for k in range(4):
        expected, got = retarget(drive[k]), by_token[drive[k]["token"]]
        assert torch.equal(got["coverage"], expected["coverage"]) and torch.equal(got["K"], expected["K"])
        assert (got["images"].float() - expected["images"].float()).abs().mean() < 2


def test_example(capsys):
    assert main() == 0
    assert "(5, 3, 96, 256)" in capsys.readouterr().out


def test_the_readmes_code_streams(tmp_path):
    drive = SyntheticDrive(demo_source_rig((48, 128)), num_frames=2, lidar=False)
    for k in range(2):
        write_shard(tmp_path / f"{k:06}.tar", [drive[k]])
    changes = {"data/{000000..000041}.tar": f"{tmp_path}/{{000000..000001}}.tar", "num_workers=8": "num_workers=2"}
    (code,) = snippets("webdataset", changes)
    names = {}
    exec(code, names)
    assert sorted(sample["token"] for sample in names["loader"]) == sorted(drive[k]["token"] for k in range(2))
