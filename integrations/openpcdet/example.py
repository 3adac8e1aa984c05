"""``python -m integrations.openpcdet.example``: a synthetic street in KITTI's and nuScenes' form, retargeted."""

from __future__ import annotations

from arbiview_aug import load_rig
from arbiview_aug.integrations.openpcdet import RigRetargetDataDict
from integrations.mmdet3d.fake_results import LIDAR2EGO
from integrations.openpcdet.fake_data import KITTI_LIDAR2EGO, kitti, nuscenes, street


def main() -> int:
    """Retarget both forms and say what came of them."""
    given = street()
    target = load_rig("waymo").undistorted().resized((36, 132), "crop")
    for name, form, lidar2ego in (("KITTI", kitti, KITTI_LIDAR2EGO), ("nuScenes", nuscenes, LIDAR2EGO)):
        data = form(given)
        out = RigRetargetDataDict(target, lidar2ego=lidar2ego, min_points_in_gt=1)(data)
        counts = " ".join(f"{key} {len(data[key])} -> {len(out[key])}" for key in ("points", "gt_boxes"))
        print(f"{name:8} {counts}" + (f", {len(out['camera_imgs'])} images" if "camera_imgs" in out else ""))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
