"""``python -m arbiview_aug inspect RIG [RIG ...]``: rigs as tables, their differences, and a picture."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import RIG_SUFFIXES, Rig, load_rig, read_rig, shipped_rigs
from arbiview_aug.cli.arguments import PICTURES, data, is_rig, output_file
from arbiview_aug.datasets.frame_folder import CALIBRATION_FILE
from arbiview_aug.datasets.registry import open_data, split_kind
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.common_rig import common_rig, seen_shares
from arbiview_aug.evaluate.report.pictures import draw_rigs, save_picture
from arbiview_aug.evaluate.report.tables import markdown_table

NOISE_DEG, NOISE_M = 0.2, 0.02  # errors of a maintained calibration: rigs that differ by less are the same


def run(arguments: argparse.Namespace) -> None:
    """Print the rigs and their differences from the first; write the picture, or the common rig."""
    default, endings = ("common.yaml", RIG_SUFFIXES) if arguments.common else ("inspect.png", PICTURES)
    path = output_file(arguments.output or default, endings)
    rigs, notes = zip(*(_load(name) for name in arguments.rigs), strict=True)
    print("\n\n".join(f"{rig!r}{note}" for rig, note in zip(rigs, notes, strict=True)))
    for rig in rigs[1:]:
        print(f"\n{differences(rigs[0], rig)}")
    if arguments.common:
        common = common_rig(rigs)
        shares = [[f"{share:.0%}" for share in seen_shares(rig, common)] for rig in rigs]
        rows = [[rig.name or f"rig {k}", *cells] for k, (rig, cells) in enumerate(zip(rigs, shares, strict=True), 1)]
        table = markdown_table(["seen by", *common.names], rows)
        print(f"\n{common!r}\n\n{table}\n\nrig: {common.save(path)}")
        return
    print(f"\npicture: {save_picture(path, draw_rigs(rigs))}")


def differences(source: Rig, target: Rig) -> str:
    """Table of each target camera against the source camera nearest in direction; heights are over each rig's road."""
    axes = source.cam2ego[:, :3, 2]
    rows, is_noise = [], len(source) == len(target)
    for camera in target.in_frame_of(source):
        cosine = axes @ camera.cam2ego[:3, 2]
        nearest = source[int(np.argmax(cosine))]
        turned = float(np.degrees(np.arccos(np.clip(cosine.max(), -1, 1))))
        away_m = camera.center_m - nearest.center_m
        off = np.nan_to_num(_corners(camera)) - np.nan_to_num(_corners(nearest))  # outside a lens both may be NaN
        is_noise &= bool(np.linalg.norm(off, axis=1).max() < np.radians(NOISE_DEG) and np.linalg.norm(away_m) < NOISE_M)
        density = []
        for view in (nearest, camera):  # columns per degree on the optical axis
            aside, ahead = view.project_cam(np.array([[np.radians(1e-3), 0, 1], [0, 0, 1]])).uv[:, 0]
            density.append(float(1e3 * (aside - ahead)))
        rows.append(
            [
                *(camera.name, nearest.name, f"{turned:.1f} deg"),
                *(f"{moved:+.2f}" for moved in away_m),
                f"{nearest.fov_deg[0]:.1f} > {camera.fov_deg[0]:.1f}",
                f"{density[0]:.1f} > {density[1]:.1f}",
            ]
        )
    head = ["camera", "nearest", "turned", "moved x", "y", "z", "field of view", "pixels per deg"]
    title = f"From {source.name or 'the first rig'} to {target.name or 'the other rig'}:"
    note = f"\n\nAll within {NOISE_DEG:g} deg and {100 * NOISE_M:g} cm, as much as calibrations err: do not retarget."
    return f"{title}\n\n{markdown_table(head, rows, left=2)}{note if is_noise else ''}"


def _corners(camera: Camera) -> FloatArray:
    """(4, 3) directions of the image's corners in the ego frame: they depend on lens, K and rotation."""
    w, h = camera.width_px - 0.5, camera.height_px - 0.5
    return camera.unproject([[-0.5, -0.5], [w, -0.5], [-0.5, h], [w, h]]).directions


def _load(name: str) -> tuple[Rig, str]:
    """A rig, and a line on how another tool's calibration was read."""
    if not name or name in shipped_rigs():  # an empty name would be the current folder
        return load_rig(name), ""
    if is_rig(name):
        rig, notes = read_rig(Path(name))
        return rig, f"\n  {notes}" if notes else ""
    kind, root = split_kind(name)
    if kind is None and os.path.isfile(root / CALIBRATION_FILE):  # its images need not be there
        return load_rig(root / CALIBRATION_FILE), ""
    try:
        recording = open_data(data(name), load_points=False)
    except DataError as error:
        if kind is not None:
            raise
        raise DataError(f"{error}; nor is it a folder of another tool's calibration (docs/rigs.md)") from None
    return recording[0]["rig"], ""
