"""Write where nuscenes-devkit sees the annotations: ``python devkit_boxes.py ROOT VERSION OUTPUT.json``.

Runs in the devkit's own environment, so it imports nothing of this repository.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
from nuscenes.nuscenes import NuScenes
from nuscenes.utils.geometry_utils import BoxVisibility, view_points

NEAREST_M = 0.1


def main(root: str, version: str, output: str) -> None:
    """Write an entry for each box that lies before a keyframe's camera: its centre and corners in pixels."""
    nusc = NuScenes(version, root, verbose=False)
    found = []
    for sample in nusc.sample:
        for channel, token in sample["data"].items():
            if nusc.get("sample_data", token)["sensor_modality"] != "camera":
                continue
            path, boxes, K = nusc.get_sample_data(token, box_vis_level=BoxVisibility.NONE)
            assert Path(path).is_file(), path
            for box in boxes:
                points = np.concatenate([box.center[:, None], box.corners()], axis=1)
                if points[2].min() > NEAREST_M:
                    pixels = view_points(points, K, normalize=True)[:2].T.tolist()
                    found.append({"sample": sample["token"], "channel": channel, "box": box.token, "pixels": pixels})
    Path(output).write_text(json.dumps(found))


if __name__ == "__main__":
    main(*sys.argv[1:])
