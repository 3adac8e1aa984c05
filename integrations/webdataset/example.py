"""``python -m integrations.webdataset.example``: shards of a synthetic street, streamed as another vehicle's frames."""

from __future__ import annotations

import io
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from torch.utils.data import DataLoader

from arbiview_aug import Rig, RigRetarget, load_rig
from arbiview_aug.datasets.image_io import decode_bytes, encoded_image
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from integrations.environments import required


def to_entry(sample: dict[str, Any]) -> dict[str, Any]:
    """The files of a sample by their endings: calibration, images, boxes."""
    boxes = io.BytesIO()
    np.save(boxes, sample["boxes_3d"].numpy())
    images = {f"{k:02}.jpg": encoded_image(image) for k, image in enumerate(sample["images"])}
    rig = json.dumps(sample["rig"].to_dict()).encode()
    return {"__key__": sample["token"].replace(".", "-"), "rig.json": rig, "boxes.npy": boxes.getvalue(), **images}


def to_sample(entry: dict[str, Any]) -> dict[str, Any]:
    """The sample of an entry as WebDataset reads it: bytes by their endings."""
    rig = Rig.from_dict(json.loads(entry["rig.json"]), where=entry["__key__"])
    images = [decode_bytes(entry[f"{k:02}.jpg"], f"{entry['__key__']}: {camera.name}") for k, camera in enumerate(rig)]
    boxes = torch.from_numpy(np.load(io.BytesIO(entry["boxes.npy"])))
    stacked = torch.from_numpy(np.stack(images)).permute(0, 3, 1, 2)
    return {"images": stacked, "rig": rig, "boxes_3d": boxes, "token": entry["__key__"]}


def main() -> int:
    """Two shards, two workers: each frame comes once."""
    required("webdataset")
    import webdataset

    drive = SyntheticDrive(demo_source_rig((96, 256)), num_frames=4, lidar=False)
    with TemporaryDirectory() as folder:
        with webdataset.ShardWriter(str(Path(folder) / "%06d.tar"), maxcount=2, verbose=0) as writer:
            for k in range(len(drive)):
                writer.write(to_entry(drive[k]))
        shards = webdataset.WebDataset(f"{folder}/{{000000..000001}}.tar", shardshuffle=False, empty_check=False)
        retargeted = shards.shuffle(8).map(to_sample).map(RigRetarget(load_rig("waymo"), size=(96, 256)))
        samples = list(DataLoader(retargeted, batch_size=None, num_workers=2))
    for sample in samples:
        print(f"{sample['token']}: {tuple(sample['images'].shape)}, {sample['coverage'].float().mean():.1%} seen")
    assert sorted(s["token"] for s in samples) == sorted(drive[k]["token"].replace(".", "-") for k in range(len(drive)))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
