"""Target rigs of the studies, made from the source rig and without its car-body masks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.datasets.nuscenes.reader import CAMERA_RING
from arbiview_aug.evaluate.frames import without_masks

TARGET_SETS = ("paper", "yaw", "vehicles", "truck")
PAPER_SHARES = (0.2, -0.2, 0.4, -0.4, 0.5, -0.25)  # of the azimuth spacing: 11/14, 22/28, 27.5/35, 13.75/17.5°

YAWS_DEG = (11.0, -11.0, 22.0, -22.0, 35.0)
UP_M = 0.6

_SAME_DIRECTION_DEG = 5.0


def spacing_deg(rig: Rig) -> FloatArray:
    """(N,) azimuth spacing of each camera to its neighbour.

    The paper's figures on rigs with nuScenes' camera names: 55 degrees, 70 for CAM_BACK. Otherwise the gap to the
    nearest camera that is not within 5 degrees (a telephoto beside a wide camera), or the camera's own field of view.
    """
    if set(CAMERA_RING).issuperset(rig.names):
        return np.array([70.0 if name == "CAM_BACK" else 55.0 for name in rig.names])
    azimuth = np.array([camera.azimuth_deg for camera in rig])
    spacing = []
    for k, camera in enumerate(rig):
        gaps = np.abs((azimuth - azimuth[k] + 180) % 360 - 180)
        gaps = gaps[gaps > _SAME_DIRECTION_DEG]
        spacing.append(float(gaps.min()) if len(gaps) else camera.fov_deg[0])
    return np.array(spacing)


def paper_target(rig: Rig, share: float) -> Rig:
    """One configuration of the paper: each camera yawed by a share of its spacing, positive to the left."""
    cameras = [
        camera.turned(yaw_deg=share * float(spacing)) for camera, spacing in zip(rig, spacing_deg(rig), strict=True)
    ]
    return without_masks(rig.with_cameras(cameras))


VEHICLES = ("waymo", "argoverse2", "lyft_l5", "nuplan")  # shipped rigs used as other vehicles
TRUCK_UP_M = 1.0  # height of a truck's cameras over a sedan's


def vehicle_targets(rig: Rig) -> dict[str, Rig]:
    """``VEHICLES`` by name, as pinhole rigs with the source's image width."""
    width = float(np.median([camera.width_px for camera in rig]))
    rigs = {}
    for name in VEHICLES:
        vehicle = load_rig(name).undistorted()
        scaled = [c.resize((max(1, round(c.height_px * width / c.width_px)), round(width))) for c in vehicle]
        rigs[name] = without_masks(vehicle.with_cameras(scaled))
    return rigs


def named_targets(kind: str, rig: Rig) -> dict[str, Rig]:
    """Targets of a set, by name: ``paper`` (six), ``yaw`` (``YAWS_DEG``), ``vehicles`` or ``truck``."""
    if kind == "vehicles":
        return vehicle_targets(rig)
    if kind == "paper":
        targets = {f"paper {share:+g}": paper_target(rig, share) for share in PAPER_SHARES}
    elif kind == "yaw":
        targets = {f"yaw {yaw:+g}": without_masks(rig.turned(yaw_deg=yaw)) for yaw in YAWS_DEG}
    else:
        targets = {"truck": without_masks(rig.shifted(z_m=TRUCK_UP_M))}
    return {name: replace(target, name=f"{rig.name}, {name}".lstrip(", ")) for name, target in targets.items()}
