"""Tiny data sets to convert, and what was written."""

from __future__ import annotations

import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arbiview_aug import Rig, load_rig
from arbiview_aug.datasets.synthetic import demo_source_rig
from tests.datasets.nuscenes_root import Tables, streets, tables_of, write_root
from tests.helpers import write_drive

SIZE = (32, 56)
FRAMES = Rig(demo_source_rig(SIZE).cameras[:2], ground_z_m=-0.1, name="two")
SURROUND = demo_source_rig(SIZE)
TARGET_FILE = Path(__file__).with_name("small.json")
"""Three cameras of argoverse2 and its scanners, with few beams and columns."""
TARGET = load_rig(TARGET_FILE)


def write_frames(root: Path, count: int) -> Path:
    """Frames of one drive: gradients that differ, a box and a few points."""
    rng = torch.Generator().manual_seed(0)
    frames = []
    for k in range(count):
        corners = torch.randint(0, 256, (len(FRAMES), 3, 2, 2), generator=rng).float()
        images = torch.nn.functional.interpolate(corners, SIZE, mode="bilinear", align_corners=True).round().byte()
        pose = torch.eye(4, dtype=torch.float64)
        pose[0, 3] = 1.5 * k
        sample = {"images": images, "rig": FRAMES, "ego2world": pose, "time_s": 0.5 * k}
        sample["boxes_3d"] = torch.tensor([[9.0 + k, 1.0, 0.7, 4.0, 2.0, 1.6, 0.2]])
        sample["points"] = torch.rand((60, 4), generator=rng) * torch.tensor([20.0, 8.0, 2.0, 1.0])
        frames.append(sample)
    write_drive(root, frames)
    for folder in root.glob("0*"):
        calib = json.loads((folder / "calib.json").read_text())
        (folder / "calib.json").write_text(json.dumps({**calib, "license": "as you like"}))
    return root


def write_nuscenes(root: Path, keyframes: int = 3) -> Path:
    """Two scenes with all columns that chains and counts have."""
    scenes = streets(keyframes, goes=lambda time_s: 8 * time_s, stays=lambda time_s: 0 * time_s)
    tables = tables_of(SURROUND, scenes)
    _with_chains(tables)
    write_root(root, tables, SIZE)
    azimuth, away_m = np.meshgrid(np.radians(np.arange(0, 360, 3)), np.arange(5.0, 20.0, 1.5))
    z = 0.8 * (np.arange(len(azimuth)) % 2)[:, None] + 0 * azimuth  # on the road and on what stands there
    points = np.stack([away_m * np.cos(azimuth), away_m * np.sin(azimuth), z, away_m, 0 * azimuth], axis=-1)
    for path in (root / "samples" / "LIDAR_TOP").iterdir():
        points.astype("<f4").tofile(path)
    (root / "maps").mkdir()
    (root / "maps" / "map.png").write_bytes(b"a map")
    tables_folder = root / "v1.0-mini"
    (tables_folder / "map.json").write_text(json.dumps([{"token": "map", "filename": "maps/map.png"}]))
    levels = [{"token": str(k + 1), "level": "", "description": ""} for k in range(4)]
    (tables_folder / "visibility.json").write_text(json.dumps(levels))
    (tables_folder / "image_annotations.json").write_text("[]")
    return root


def read_tables(root: Path) -> Tables:
    """Rows by table."""
    return {path.stem: json.loads(path.read_text()) for path in (root / "v1.0-mini").glob("*.json")}


def tree(root: Path) -> dict[str, bytes]:
    """All files by name, hidden ones too."""
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}


def command(source: str | Path, output: Path, *more: str) -> list[str]:
    """Arguments of ``main``, in one process."""
    fixed = ["--size", "24x40", "--geometry", "street", "--workers", "1"]
    return ["convert", "--data", str(source), "--target", str(TARGET_FILE), "--output", str(output), *fixed, *more]


def chained(rows: list[dict[str, Any]]) -> bool:
    """Whether ``prev`` and ``next`` of a table say the same, and nothing that is not there."""
    known = {row["token"]: row for row in rows}
    forth = all(not row["next"] or known[row["next"]]["prev"] == row["token"] for row in rows)
    return forth and all(not row["prev"] or known[row["prev"]]["next"] == row["token"] for row in rows)


def _with_chains(tables: Tables) -> None:
    times = {row["token"]: row["timestamp"] for row in tables["sample"]}
    for key, table in (("scene_token", "sample"), ("instance_token", "sample_annotation")):
        of: dict[str, list[dict[str, Any]]] = {}
        for row in sorted(tables[table], key=lambda row: times[row.get("sample_token", row["token"])]):
            row |= {"prev": "", "next": ""}
            of.setdefault(row[key], []).append(row)
        for rows in of.values():
            for one, two in pairwise(rows):
                one["next"], two["prev"] = two["token"], one["token"]
        ends = {"scene_token": ("scene", "sample"), "instance_token": ("instance", "annotation")}[key]
        for row in tables[ends[0]]:
            rows = of[row["token"]]
            row |= {f"first_{ends[1]}_token": rows[0]["token"], f"last_{ends[1]}_token": rows[-1]["token"]}
            row["nbr_samples" if ends[1] == "sample" else "nbr_annotations"] = len(rows)
    for k, row in enumerate(tables["sample_annotation"]):
        row["visibility_token"] = str(np.arange(1, 5)[k % 4])
