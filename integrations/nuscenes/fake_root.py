"""A small nuScenes root of a synthetic street, with all that nuscenes-devkit asks for."""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from arbiview_aug.datasets.synthetic import demo_source_rig
from tests.datasets.nuscenes_root import VERSION, Tables, streets, tables_of, write_root, write_views

SPEED_MPS = 9.0
_MAP_FILE = "maps/fake.png"
_SIZE = (72, 128)


def fake_root(root: Path) -> Path:
    """Write a drive of two keyframes at ``SPEED_MPS`` into a new folder; its sweeps are grey.

    Returns the root; its tables are of ``VERSION``.
    """
    rig = demo_source_rig(_SIZE)
    scenes = streets(2, made=lambda seconds: SPEED_MPS * seconds)
    data = tables_of(rig, scenes)
    complete(data)
    write_root(root, data, _SIZE)
    (root / "maps").mkdir()
    cv2.imwrite(str(root / _MAP_FILE), np.zeros((8, 8), np.uint8))
    write_views(root, rig, scenes[0], {row["filename"] for row in data["sample_data"] if row["is_key_frame"]})
    return root


def complete(data: Tables) -> None:
    """Add the tables and columns that the devkit reads and this package does not."""
    data["attribute"] = []
    data["visibility"] = [{"token": "4", "level": "v80-100", "description": ""}]
    data["log"] = [{"token": "log", "logfile": "", "vehicle": "", "date_captured": "", "location": "nowhere"}]
    data["map"] = [{"token": "map", "log_tokens": ["log"], "category": "semantic_prior", "filename": _MAP_FILE}]
    times = {row["token"]: row["timestamp"] for row in data["sample"]}
    in_scene, of_object = defaultdict(list), defaultdict(list)
    for row in sorted(data["sample"], key=lambda row: row["timestamp"]):
        in_scene[row["scene_token"]].append(row)
    for row in sorted(data["sample_annotation"], key=lambda row: times[row["sample_token"]]):
        row |= {"visibility_token": "4", "attribute_tokens": [], "num_lidar_pts": 1, "num_radar_pts": 0}
        of_object[row["instance_token"]].append(row)
    for rows in (*in_scene.values(), *of_object.values()):
        _link(rows)
    for scene in data["scene"]:
        rows = in_scene[scene["token"]]
        scene |= {"log_token": "log", "nbr_samples": len(rows), "description": ""}
        scene |= {"first_sample_token": rows[0]["token"], "last_sample_token": rows[-1]["token"]}
    for instance in data["instance"]:
        rows = of_object[instance["token"]]
        instance |= {"nbr_annotations": len(rows)}
        instance |= {"first_annotation_token": rows[0]["token"], "last_annotation_token": rows[-1]["token"]}
    for category in data["category"]:
        category["description"] = ""
    moments = {row["ego_pose_token"]: row["timestamp"] for row in data["sample_data"]}
    for pose in data["ego_pose"]:
        pose["timestamp"] = moments[pose["token"]]
    for row in data["sample_data"]:
        row["fileformat"] = row["filename"].rsplit(".", 1)[1]


def _link(rows: list[dict[str, Any]]) -> None:
    for k, row in enumerate(rows):
        row["prev"] = rows[k - 1]["token"] if k else ""
        row["next"] = rows[k + 1]["token"] if k + 1 < len(rows) else ""


__all__ = ["VERSION", "complete", "fake_root"]
