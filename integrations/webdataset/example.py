"""``python -m integrations.webdataset.example``: shards of a synthetic street, streamed as another vehicle's frames."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from torch.utils.data import DataLoader

from arbiview_aug import RigRetarget, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.integrations.webdataset import stream, write_shard
from integrations.environments import required

SHARDS, FRAMES = 2, 2


def main() -> int:
    """Two shards, two workers: each frame comes once."""
    required("webdataset")
    drive = SyntheticDrive(demo_source_rig((96, 256)), num_frames=SHARDS * FRAMES, lidar=False)
    with TemporaryDirectory() as folder:
        for k in range(SHARDS):
            write_shard(Path(folder) / f"{k:06}.tar", (drive[k * FRAMES + n] for n in range(FRAMES)))
        retarget = RigRetarget(load_rig("waymo"), size=(96, 256))
        urls = f"{folder}/{{000000..{SHARDS - 1:06}}}.tar"
        samples = list(DataLoader(stream(urls, retarget, shuffle=8), batch_size=None, num_workers=2))
    for sample in samples:
        seen = sample["coverage"].float().mean()
        print(f"{sample['token']}: {tuple(sample['images'].shape)}, {seen:.1%} seen, {len(sample['boxes_3d'])} boxes")
    tokens = [sample["token"] for sample in samples]
    assert sorted(tokens) == [drive[k]["token"] for k in range(len(drive))], tokens
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
