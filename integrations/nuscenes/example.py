"""``python -m integrations.nuscenes.example --data ROOT``: nuScenes in a DataLoader, as another vehicle's frames."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch.utils.data import DataLoader

from arbiview_aug import RetargetedDataset, RigRetarget, load_rig, project_boxes_3d
from arbiview_aug.datasets import NuScenesDataset
from integrations.nuscenes.fake_root import fake_root


def main(argv: Sequence[str] | None = None) -> int:
    """Run through two keyframes; without ``--data``, of a small synthetic root."""
    parser = argparse.ArgumentParser(prog="python -m integrations.nuscenes.example", description=__doc__)
    parser.add_argument("--data", type=Path, help="folder with samples and tables; default: a small synthetic one")
    parser.add_argument("--version", default="v1.0-mini", help="folder of tables")
    parser.add_argument("--target", default="waymo", help="rig, by name or file")
    parser.add_argument("--size", type=int, nargs=2, default=(128, 352), metavar=("H", "W"), help="of the views")
    arguments = parser.parse_args(argv)
    retarget = RigRetarget(load_rig(arguments.target).resized(tuple(arguments.size), "crop"))
    with TemporaryDirectory() as folder:
        dataset = NuScenesDataset(arguments.data or fake_root(Path(folder) / "root"), arguments.version)
        print(retarget.explain(dataset[0]))
        chosen = torch.utils.data.Subset(RetargetedDataset(dataset, retarget), range(2))
        for sample in DataLoader(chosen, batch_size=None):
            labels = project_boxes_3d(sample["boxes_3d"], sample)
            visible = sum(int((in_view.visibility > 0.4).sum()) for in_view in labels)
            seen = float(sample["coverage"].float().mean())
            print(f"{sample['token']}: {tuple(sample['images'].shape)}, {seen:.1%} seen, {visible} boxes visible in 2D")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
