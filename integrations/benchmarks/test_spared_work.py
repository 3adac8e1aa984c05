"""Only the work that a scene requires is done, by the plan's counters; the view stays the same.

Each situation is compared with the same work where the shortcut cannot be taken. Mostly that is the target moved by
``NEARLY_M``: the picture stays, but no camera centre coincides with another, so every pair of cameras needs the
surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest

from arbiview_aug.cameras.rays import adjacent_pairs
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.evaluate.targets import without_masks
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.transforms.explain import Explanation
from arbiview_aug.transforms.rig_retarget import RigRetarget
from arbiview_aug.transforms.settings import render_config
from tests.helpers import street_sample

NEARLY_M = 1e-5
"""Ten times the distance at which centres coincide; points 2 m away move by less than a hundredth of a pixel."""

SIZE = (72, 200)
YAW_DEG, ZOOM, UP_M = 22.0, 1.25, 0.5


class Case(NamedTuple):
    """One way to render a sample."""

    sample: Mapping[str, Any]
    target: Rig
    settings: Mapping[str, Any] = {}

    def retarget(self) -> RigRetarget:
        """A transform that holds nothing yet."""
        return RigRetarget(self.target, holes="black", **self.settings)


class Work(NamedTuple):
    """Work done for a case."""

    planned_each_frame: bool  # every call plans anew
    pairs: dict[str, int]  # of cameras, by surface
    cells: int  # of 8x8 pixels that were evaluated, summed over the sources of each view
    dense_pixels: int  # at which measured points were made dense
    bands: int  # blended rectangles
    sources: int  # images that are read for each view, summed
    overlaps: int  # pairs of neighbours matched for depth


def work(case: Case) -> Work:
    retarget = case.retarget()
    first, second = (retarget.explain(case.sample) for _ in range(2))
    assert isinstance(first, Explanation) and isinstance(second, Explanation)
    counts = first.plan.counters
    return Work(
        planned_each_frame=second.plan is not first.plan,
        pairs={key.removeprefix("pairs_"): n for key, n in counts.items() if key.startswith("pairs_")},
        cells=counts.get("cells", 0),
        dense_pixels=counts.get("dense_pixels", 0),
        bands=counts["bands"],
        sources=sum(len(view.sources) for view in first.plan.targets),
        overlaps=0 if first.planned.overlap is None else first.planned.overlap.matched,
    )


def situations(sample: Mapping[str, Any]) -> dict[str, tuple[Case, Case]]:
    """Scenes that require less, and the same without the shortcut."""
    rig = without_masks(sample["rig"])  # of what the own car hides no source sees all
    bare = {"images": sample["images"], "rig": rig}
    points = bare | {"points": sample["points"]}
    centred = points | {"rig": at_one_centre(rig)}
    turned, cut, around = (rig.turned(yaw_deg=YAW_DEG), zoomed(rig), at_one_centre(rig).turned(yaw_deg=YAW_DEG))
    # Cameras beside theirs magnify nothing at their own centres: compared is one kind of reading.
    fast, accurate = {"quality": RenderConfig(interpolation="linear")}, render_config("accurate")
    accurate_too = {"quality": replace(accurate, interpolation="linear")}

    def pair(surface: str, frame: Mapping[str, Any], target: Rig, **settings: Any) -> tuple[Case, Case]:
        nearly = target.shifted(x_m=NEARLY_M)  # shows the same
        return Case(frame, target, settings), Case(frame, nearly, {"geometry": surface, **settings})

    halved = {"size": (SIZE[0] // 2, SIZE[1] // 2), "fit": "stretch"}
    apart, together = (_only(bare, cameras) for cameras in subsets(rig))
    return {
        "turned": pair("street", bare, turned),
        "target = source": pair("street", bare, rig),
        "one source sees all": pair("street", bare, cut, **fast),
        "one source sees all, accurate": pair("street", bare, cut, **accurate_too),
        "LiDAR, turned": pair("lidar", points, turned),
        "LiDAR, one source sees all": pair("lidar", points, cut, **fast),
        "LiDAR, all cameras at one centre": pair("lidar", centred, around),
        "cameras without overlap": (apart, together),
        "skipped by p": (Case(bare, rig, halved | {"p": 0.0}), Case(bare, rig, halved)),
    }


def zoomed(rig: Rig) -> Rig:
    """The middle of every camera's view, at the same size: each sees all of its own."""
    scale = np.diag([ZOOM, ZOOM, 1.0])
    cameras = []
    for camera in rig:
        h, w = camera.size
        middle = np.array([[1, 0, (w - 1) / 2], [0, 1, (h - 1) / 2], [0, 0, 1]])
        cameras.append(replace(camera, K=middle @ scale @ np.linalg.inv(middle) @ camera.K))
    return rig.with_cameras(cameras)


def at_one_centre(rig: Rig) -> Rig:
    """The rig as if all of its cameras stood at their mean centre."""
    centre = np.mean([camera.center_m for camera in rig], axis=0)
    cameras = []
    for camera in rig:
        cam2ego = camera.cam2ego.copy()
        cam2ego[:3, 3] = centre
        cameras.append(replace(camera, cam2ego=cam2ego))
    return rig.with_cameras(cameras)


def subsets(rig: Rig) -> tuple[list[int], list[int]]:
    """As many cameras as can be without any two that overlap; and as many that stand side by side."""
    around = sorted(range(len(rig)), key=lambda k: rig[k].azimuth_deg)
    apart: list[int] = []
    for k in around:
        if not adjacent_pairs(rig.with_cameras([rig[j] for j in (*apart, k)])):
            apart.append(k)
    return apart, around[: len(apart)]


def _only(sample: Mapping[str, Any], cameras: Sequence[int]) -> Case:
    """The frame of some cameras, raised."""
    rig = sample["rig"].with_cameras([sample["rig"][k] for k in cameras])
    images = [sample["images"][k] for k in cameras]
    settings = {"geometry": "street", "quality": "accurate", "match_exposure": True}
    return Case({"images": images, "rig": rig}, rig.shifted(z_m=UP_M), settings)


@pytest.fixture(scope="module")
def scenes() -> dict[str, tuple[Case, Case]]:
    return situations(street_sample(SIZE))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_what_is_done(scenes: dict[str, tuple[Case, Case]]) -> None:
    def of(name: str) -> tuple[Work, Work]:
        spared, otherwise = map(work, scenes[name])
        return spared, otherwise

    spared, otherwise = of("turned")
    assert spared.pairs["infinity"] == 6 and "infinity" not in otherwise.pairs and otherwise.pairs["street"] >= 12

    for name in ("target = source", "one source sees all"):
        spared, otherwise = of(name)
        assert spared.pairs == {"infinity": 6} and spared.bands == 0 and spared.sources == 6
        assert otherwise.pairs["street"] > 6 and otherwise.cells > spared.cells

    spared, otherwise = of("one source sees all, accurate")
    assert spared.overlaps == 0 and not spared.planned_each_frame and spared.pairs == {"infinity": 6}
    assert otherwise.overlaps == 6 and otherwise.planned_each_frame

    spared, otherwise = of("LiDAR, turned")
    pixels = 6 * SIZE[0] * SIZE[1]
    assert 0 < spared.dense_pixels < 0.6 * pixels < otherwise.dense_pixels == pixels
    assert spared.pairs["infinity"] == 6 and "infinity" not in otherwise.pairs

    for name in ("LiDAR, one source sees all", "LiDAR, all cameras at one centre"):
        spared, otherwise = of(name)
        assert set(spared.pairs) == {"infinity"} and spared.dense_pixels == 0 and not spared.planned_each_frame
        assert set(otherwise.pairs) == {"lidar"} and otherwise.dense_pixels > 0 and otherwise.planned_each_frame

    spared, otherwise = of("cameras without overlap")
    assert spared.overlaps == spared.bands == 0 and spared.sources == 3 and not spared.planned_each_frame
    assert otherwise.overlaps == 2 and otherwise.bands > 0 and otherwise.planned_each_frame


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["turned", "target = source", "one source sees all", "one source sees all, accurate", "skipped by p"]
)
def test_sparing_work_changes_no_view(name: str, scenes: dict[str, tuple[Case, Case]]) -> None:
    """But where a source was exact: there the street was a guess. (Points hide pixels from other sources.)"""
    one, two = (case.retarget()(case.sample) for case in scenes[name])
    both = (one["coverage"] & two["coverage"])[:, None].expand_as(one["images"])
    assert both.float().mean() > 0.7
    assert (one["images"].double() - two["images"].double()).abs()[both].quantile(0.9) <= 2


def test_subsets() -> None:
    rig = load_rig("nuscenes")
    apart, together = subsets(rig)
    assert len(apart) == len(together) == 3
    assert not adjacent_pairs(rig.with_cameras([rig[k] for k in apart]))
    assert len(adjacent_pairs(rig.with_cameras([rig[k] for k in together]))) == 2
