"""``python -m integrations.nuscenes.example --data ROOT``: nuScenes in a DataLoader, as another vehicle's frames."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch.utils.data import DataLoader

from arbiview_aug import Rig, RigRetarget, load_rig
from arbiview_aug.integrations.nuscenes import NuScenesDataset, RetargetedDataset, project_boxes_3d


def main(argv: Sequence[str] | None = None) -> int:
    """Run through some keyframes; without ``--data``, of a small synthetic root."""
    parser = argparse.ArgumentParser(prog="python -m integrations.nuscenes.example", description=__doc__)
    parser.add_argument("--data", type=Path, help="folder with samples and tables; default: a small synthetic one")
    parser.add_argument("--version", default="v1.0-mini", help="folder of tables")
    parser.add_argument("--target", default="waymo", help="rig, by name or file")
    parser.add_argument("--size", type=int, nargs=2, default=(128, 352), metavar=("H", "W"), help="of the views")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--workers", type=int, default=0)
    arguments = parser.parse_args(argv)
    target = load_rig(arguments.target).resized(tuple(arguments.size), "crop")
    if arguments.data is not None:
        return _run(arguments.data, arguments.version, target, arguments.frames, arguments.workers)
    from integrations.nuscenes.fake_root import fake_root

    with TemporaryDirectory() as folder:
        return _run(fake_root(Path(folder) / "root"), arguments.version, target, arguments.frames, arguments.workers)


def _run(root: Path, version: str, target: Rig, frames: int, workers: int) -> int:
    dataset = NuScenesDataset(root, version)
    retarget = RigRetarget(target)
    print(retarget.explain(dataset[0]))
    chosen = torch.utils.data.Subset(RetargetedDataset(dataset, retarget), range(min(frames, len(dataset))))
    for sample in DataLoader(chosen, batch_size=None, num_workers=workers):
        labels = project_boxes_3d(sample["boxes_3d"], sample)
        visible = sum(int((of_camera.visibility > 0.4).sum()) for of_camera in labels)
        seen = float(sample["coverage"].float().mean())
        print(f"{sample['token']}: {tuple(sample['images'].shape)}, {seen:.1%} seen, {visible} boxes visible in 2D")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
