"""Plans as plain arrays: OpenCV gives what ``RigRetarget`` gives."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
import torch

from arbiview_aug import Rig, RigRetarget, export_plan
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.choices import Quality
from arbiview_aug.errors import OutputError


def rig(size: tuple[int, int], azimuths: tuple[float, ...], lens: Any = "pinhole") -> Rig:
    cameras = [
        Camera.looking(
            name=f"camera {azimuth:g}",
            azimuth_deg=azimuth,
            width_px=size[1],
            height_px=size[0],
            horizontal_fov_deg=70,
            lens=lens,
            distortion=(-0.05, 0.01, 0, 0) if lens == "fisheye" else (),
        )
        for azimuth in azimuths
    ]
    return Rig(cameras)


AROUND = (0.0, 60.0, 120.0, 180.0, 240.0, 300.0)
CASES: dict[str, tuple[Rig, Rig, Quality]] = {
    "seams": (rig((80, 140), AROUND), rig((48, 96), (20.0, 100.0)), "fast"),
    "cubic": (rig((40, 70), AROUND), rig((80, 140), (10.0,)), "fast"),
    "halved, of an odd size": (rig((181, 323), (0.0, 60.0)), rig((24, 40), (0.0, 30.0)), "fast"),
    "nearest, fisheye": (rig((80, 140), AROUND, "fisheye"), rig((48, 96), (20.0, 190.0), "fisheye"), "draft"),
    "views of two sizes": (rig((80, 140), AROUND), rig((48, 96), (20.0,)), "fast"),
}


def by_opencv(path: Path, images: torch.Tensor) -> list[npt.NDArray[np.uint8]]:
    """Views (3, h, w) by the example of ``docs/deploy.md``."""
    names: dict[str, Any] = {"path": path, "images": [image.permute(1, 2, 0).numpy() for image in images]}
    page = (Path(__file__).parents[2] / "docs" / "deploy.md").read_text()
    (code,) = (code for code in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "np.load" in code)
    exec(code, names)
    return [view.transpose(2, 0, 1) for view in names["views"]]


@pytest.mark.parametrize("case", CASES)
def test_opencv_gives_the_views(case: str, tmp_path: Path) -> None:
    source, target, quality = CASES[case]
    if case == "views of two sizes":
        target = Rig([*target, replace(target[0].resize((32, 40)).turned(yaw_deg=50.0), name="small")])
    retarget = RigRetarget(target, geometry="street", holes="black", match_exposure=False, quality=quality)
    rng, (h, w) = np.random.default_rng(0), source.sizes[0]
    smooth = [cv2.GaussianBlur(rng.integers(0, 256, (h, w, 3), np.uint8), (0, 0), 2) for _ in source]
    images = torch.from_numpy(np.stack(smooth)).permute(0, 3, 1, 2).contiguous()
    plan = retarget.prepare(source)
    export_plan(plan, tmp_path / "new" / "plan.npz")
    views = by_opencv(tmp_path / "new" / "plan.npz", images)
    expected = retarget({"images": images, "rig": source})["images"]
    assert len(views) == len(target) and (case != "seams" or any(len(view.seam.pixel) for view in plan.targets))
    assert (plan.targets[0].interpolation == "cubic") == (case == "cubic")
    for view, of_transform in zip(views, expected, strict=True):
        assert of_transform.any()
        assert np.abs(view.astype(int) - of_transform.numpy()).max() <= 1


def test_what_cannot_be_written_is_named(tmp_path: Path) -> None:
    plan = RigRetarget(CASES["seams"][1], geometry="street").prepare(CASES["seams"][0])
    with pytest.raises(ValueError, match=r"path: expected a file name that ends in \.npz, got 'plan\.txt'"):
        export_plan(plan, "plan.txt")
    with pytest.raises(ValueError, match=r"plan: expected what RigRetarget\.prepare returns, got RigRetarget"):
        export_plan(RigRetarget("waymo"), "plan.npz")  # type: ignore[arg-type]
    accurate = RigRetarget(CASES["seams"][1], geometry="street", quality="accurate").prepare(CASES["seams"][0])
    with pytest.raises(ValueError, match=r"plan: expected one that all frames share, got one of quality='accurate'"):
        export_plan(accurate, tmp_path / "plan.npz")
    with pytest.raises(ValueError, match=r"path: expected a file name that ends in \.npz, got None"):
        export_plan(plan, None)  # type: ignore[arg-type]
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        export_plan(plan, tmp_path / "file" / "plan.npz")
