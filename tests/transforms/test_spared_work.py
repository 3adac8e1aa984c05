"""Only the work that a scene requires is done, by the plan's counters; the view stays the same.

Each situation is compared with the same work where the shortcut cannot be taken. Mostly that is the target moved by
``NEARLY_M``: the picture stays, but no camera centre coincides with another, so every pair of cameras needs the
surface.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest

from arbiview_aug.cameras.overlap import adjacent_pairs
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cli.bench.data import as_of_another_frame
from arbiview_aug.evaluate.targets import without_masks
from arbiview_aug.favs.config import FavsConfig, favs_config
from arbiview_aug.transforms.explain import Explanation
from arbiview_aug.transforms.rig_retarget import RigRetarget
from tests.helpers import street_sample

NEARLY_M = 1e-5
"""Ten times the distance at which centres coincide; points 2 m away move by less than a hundredth of a pixel."""

SIZE = (72, 200)
YAW_DEG, ZOOM, UP_M = 22.0, 1.25, 0.5
_GEOMETRY = ("points", "boxes_3d", "box_names", "depth_m")


@dataclass(frozen=True)
class Case:
    """One way to render a sample.

    Attributes:
        sample: Images, rig and what it says of the geometry.
        target: The rig to render.
        settings: Arguments of ``RigRetarget`` besides.
    """

    sample: Mapping[str, Any] = field(repr=False)
    target: Rig
    settings: Mapping[str, Any] = field(default_factory=dict)

    def retarget(self) -> RigRetarget:
        """A transform that holds nothing yet."""
        return RigRetarget(self.target, holes="black", **self.settings)


@dataclass(frozen=True)
class Situation:
    """A scene that requires less, and the same without the shortcut.

    Attributes:
        name: For tables.
        spared: What is not required.
        required: The situation.
        otherwise: The same, where it cannot be spared.
    """

    name: str
    spared: str
    required: Case
    otherwise: Case


@dataclass(frozen=True)
class Counters:
    """Work done for a case.

    Attributes:
        planned_each_frame: Whether a frame with other points or images needs a plan of its own.
        pairs: Pairs of cameras by surface.
        cells: Cells of 8x8 pixels that were evaluated, summed over the sources of each view.
        dense_pixels: Pixels at which measured points were made dense.
        bands: Blended rectangles.
        sources: Source images that are read for each view, summed.
        overlaps: Pairs of neighbours matched for depth.
    """

    planned_each_frame: bool
    pairs: dict[str, int]
    cells: int
    dense_pixels: int
    bands: int
    sources: int
    overlaps: int


def counters(case: Case) -> Counters:
    retarget = case.retarget()
    first, second = (retarget.explain(frame) for frame in (case.sample, as_of_another_frame(case.sample)))
    assert isinstance(first, Explanation) and isinstance(second, Explanation)
    counts, depth = first.plan.counters, first.depth
    return Counters(
        planned_each_frame=second.plan is not first.plan,
        pairs={key.removeprefix("pairs_"): n for key, n in counts.items() if key.startswith("pairs_")},
        cells=counts.get("cells", 0),
        dense_pixels=counts.get("dense_pixels", 0),
        bands=counts["bands"],
        sources=sum(len(view.sources) for view in first.plan.targets),
        overlaps=0 if depth is None else depth.matched,
    )


def situations(sample: Mapping[str, Any]) -> list[Situation]:
    """The situations that a frame can be brought into: those about LiDAR where it has points."""
    rig = without_masks(sample["rig"])  # of what the own car hides no source sees all
    bare = {key: value for key, value in sample.items() if key not in _GEOMETRY} | {"rig": rig}
    turned, cut = rig.turned(yaw_deg=YAW_DEG), zoomed(rig, ZOOM)
    # The cameras beside theirs, which look everything over, magnify nothing at their own centres: compared is one kind
    # of reading.
    bilinear = FavsConfig(interpolation="linear")

    def over(name: str, target: Rig, frame: Mapping[str, Any], **settings: Any) -> Case:
        return Case(frame, nearly(target), {"surface": name, **settings})

    found = [
        Situation(
            f"cameras turned by {YAW_DEG:g} deg",
            "the own camera needs no surface",
            Case(bare, turned),
            over("street", turned, bare),
        ),
        Situation(
            "target = source",
            "no neighbour is looked at, no seam is blended",
            Case(bare, rig),
            over("street", rig, bare),
        ),
        Situation(
            f"one source sees all (zoom {ZOOM:g})",
            "no neighbour is looked at, no seam is blended",
            Case(bare, cut, {"quality": bilinear}),
            over("street", cut, bare, quality=bilinear),
        ),
        Situation(
            "the same, accurate",
            "no overlap is matched",
            Case(bare, cut, {"quality": replace(favs_config("accurate"), interpolation="linear")}),
            over("street", cut, bare, quality=replace(favs_config("accurate"), interpolation="linear")),
        ),
    ]
    if "points" in sample:
        points = bare | {"points": sample["points"]}
        shared = points | {"rig": at_one_centre(rig)}
        found += [
            Situation(
                f"LiDAR, turned by {YAW_DEG:g} deg",
                "points matter only where the own camera does not see",
                Case(points, turned),
                over("lidar", turned, points),
            ),
            Situation(
                f"LiDAR, one source sees all (zoom {ZOOM:g})",
                "no point is read, the plan is held",
                Case(points, cut, {"quality": bilinear}),
                over("lidar", cut, points, quality=bilinear),
            ),
            Situation(
                f"LiDAR, all cameras at one centre, turned by {YAW_DEG:g} deg",
                "no point is read, the plan is held",
                Case(shared, shared["rig"].turned(yaw_deg=YAW_DEG)),
                over("lidar", shared["rig"].turned(yaw_deg=YAW_DEG), shared),
            ),
        ]
    apart, together = subsets(rig)
    if len(apart) > 1:
        settings: dict[str, Any] = {"quality": "accurate", "harmonise": True}
        raised = [_only(bare, cameras, settings) for cameras in (apart, together)]
        found.append(
            Situation(
                f"{len(apart)} cameras without overlap, raised by {UP_M:g} m, accurate, harmonised",
                "nothing is matched, no seam is blended",
                *raised,
            )
        )
    size = (rig.sizes[0][0] // 2, rig.sizes[0][1] // 2)
    skipping: dict[str, Any] = {"size": size, "fit": "stretch"}
    found.append(
        Situation(
            "a sample that p skips, at half size",
            "it is resized",
            Case(bare, rig, skipping | {"p": 0.0}),
            Case(bare, rig, skipping),
        )
    )
    return found


def nearly(rig: Rig) -> Rig:
    """The rig so little aside that it shows the same, and enough that no centre coincides with another."""
    return rig.shifted(x_m=NEARLY_M)


def zoomed(rig: Rig, factor: float) -> Rig:
    """The middle of every camera's view, at the same size: each sees all of its own."""
    scale = np.diag([factor, factor, 1.0])
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


def _only(sample: Mapping[str, Any], cameras: Sequence[int], settings: Mapping[str, Any]) -> Case:
    """The frame of some cameras, raised."""
    rig = sample["rig"].with_cameras([sample["rig"][k] for k in cameras])
    images = [sample["images"][k] for k in cameras]
    return Case({"images": images, "rig": rig}, rig.shifted(z_m=UP_M), {"surface": "street", **settings})


@pytest.fixture(scope="module")
def sample() -> dict[str, Any]:
    return street_sample(SIZE)


@pytest.fixture(scope="module")
def found(sample: dict[str, Any]) -> dict[str, tuple[Situation, Counters, Counters]]:
    result = {}
    for situation in situations(sample):
        result[situation.name] = situation, counters(situation.required), counters(situation.otherwise)
    return result


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_what_is_done(found: dict[str, tuple[Situation, Counters, Counters]]) -> None:
    def of(start: str) -> tuple[Counters, Counters]:
        (name,) = (name for name in found if name.startswith(start))
        return found[name][1:]

    required, otherwise = of("cameras turned")
    assert required.pairs["far"] == 6 and "far" not in otherwise.pairs and otherwise.pairs["street"] >= 12

    for start in ("target = source", "one source sees all"):
        required, otherwise = of(start)
        assert required.pairs == {"far": 6} and required.bands == 0 and required.sources == 6
        assert otherwise.pairs["street"] > 6 and otherwise.cells > required.cells

    required, otherwise = of("the same, accurate")
    assert required.overlaps == 0 and not required.planned_each_frame and required.pairs == {"far": 6}
    assert otherwise.overlaps == 6 and otherwise.planned_each_frame

    required, otherwise = of("LiDAR, turned")
    pixels = 6 * SIZE[0] * SIZE[1]
    assert 0 < required.dense_pixels < 0.6 * pixels < otherwise.dense_pixels == pixels
    assert required.pairs["far"] == 6 and "far" not in otherwise.pairs

    for start in ("LiDAR, one source", "LiDAR, all cameras"):
        required, otherwise = of(start)
        assert set(required.pairs) == {"far"} and required.dense_pixels == 0 and not required.planned_each_frame
        assert set(otherwise.pairs) == {"lidar"} and otherwise.dense_pixels > 0 and otherwise.planned_each_frame

    required, otherwise = of("3 cameras without overlap")
    assert required.overlaps == required.bands == 0 and required.sources == 3 and not required.planned_each_frame
    assert otherwise.overlaps == 2 and otherwise.bands > 0 and otherwise.planned_each_frame


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_sparing_work_changes_no_view(found: dict[str, tuple[Situation, Counters, Counters]]) -> None:
    """But where a source was exact: there the street, or points, were a guess."""
    compared = 0
    for name, (situation, *_) in found.items():
        if "without overlap" in name or "LiDAR" in name:
            continue  # other cameras; points hide pixels from sources that do not stand at the target's centre
        one, two = (case.retarget()(case.sample) for case in (situation.required, situation.otherwise))
        both = (one["coverage"] & two["coverage"])[:, None].expand_as(one["images"])
        assert both.float().mean() > 0.7
        off = (one["images"].double() - two["images"].double()).abs()[both]
        assert off.quantile(0.9) <= 2, name
        compared += 1
    assert compared == 5


def test_subsets() -> None:
    rig = load_rig("nuscenes")
    apart, together = subsets(rig)
    assert len(apart) == len(together) == 3
    assert not adjacent_pairs(rig.with_cameras([rig[k] for k in apart]))
    assert len(adjacent_pairs(rig.with_cameras([rig[k] for k in together]))) == 2
