"""Photographs as truth: of held-out cameras, rendered from the others, or of the next frame; of holes cut into them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import GeometryName
from arbiview_aug.datasets.depth_folder import WithDepth
from arbiview_aug.datasets.frame_folder import FrameFolder
from arbiview_aug.errors import DataError, warn
from arbiview_aug.evaluate.frames import ScoredFrame, photographed, scene_mask, without_masks
from arbiview_aug.evaluate.judges import Segmenter, draws_of, interval
from arbiview_aug.evaluate.lidar import visible_points
from arbiview_aug.evaluate.metrics import RenderedView, as_arrays, errors, mean_of, ssim_map, to_bytes
from arbiview_aug.evaluate.report.tables import Columns, Table
from arbiview_aug.sample.boxes_2d import rig_of
from arbiview_aug.sample.frame import Frame, Neighbour
from arbiview_aug.sample.inputs import DEPTH_KEYS, LEARNED_KEY, read_frames
from arbiview_aug.sample.neighbours import STILL_M
from arbiview_aug.temporal.motion_depth import without_objects
from arbiview_aug.transforms.rig_retarget import RigRetarget

_BY_CAMERA = ("images", "K", "cam2ego", "distortion", "lens", "coverage", "generated", "ego_mask", *DEPTH_KEYS)
_WINDOW_PX = 9  # side of the square around a point that belongs to its class

MOST_APART_S = 2.0
"""Longest time to the photograph that is the truth: after a longer stop, traffic has moved."""

NO_PHOTOGRAPH = (
    "--held-out next: expected a 'truth' camera in calib.json, or a later frame of the drive (sequence.json and "
    "ego2world), found none; see docs/formats.md"
)
NOTES = (
    "Each camera is rendered from the others (next: from the frame before) and compared with its photograph. seen: "
    "share of its pixels that the method covers. PSNR and SSIM: of the pixels that all methods cover ({common:.0%}), "
    "means over cameras and frames; one gain: each view times the number that fits it best. difference: of one gain, "
    "to the first row, with a 95 % interval, bootstrap over frames. Frames of one drive are alike: the interval says "
    "little about other drives. Tone curves and calibration of the cameras limit all PSNR here: read the differences."
)
HOLE_NOTES = (
    "Fills of the holes that the target's place would leave in the photographs, which are the truth. Means over "
    "cameras and frames; gradients: as a share of the photographs'. difference: PSNR to the first row, with a 95 % "
    "interval, bootstrap over frames. Frames of one drive are alike."
)
_COLUMNS: Columns = (
    ("seen", "{seen:.1%}"),
    ("PSNR dB", "{psnr_db:.2f}"),
    ("one gain", "{gain_psnr_db:.2f}"),
    ("difference", "{difference_db:+.2f} [{difference_db_low:+.2f}, {difference_db_high:+.2f}]"),
    ("SSIM", "{ssim:.4f}"),
)
_HOLE_COLUMNS: Columns = (_COLUMNS[1], *_COLUMNS[3:], ("gradients", "{gradients:.0%}"))


class WithoutCamera(Mapping[str, Any]):
    """A sample without one of its cameras, also in its neighbours; entries are read on access."""

    def __init__(self, sample: Mapping[str, Any], place: int) -> None:
        self._sample, self._place = sample, place

    def __getitem__(self, key: str) -> Any:
        value, place = self._sample[key], self._place
        if key == "rig":
            return value.with_cameras([camera for k, camera in enumerate(value) if k != place])
        if key == "neighbours":
            return [WithoutCamera(frame, place) for frame in value]
        if key not in _BY_CAMERA:
            return value
        kept = [entry for k, entry in enumerate(value) if k != place]
        return torch.stack(kept) if isinstance(value, torch.Tensor) else kept

    def __contains__(self, key: object) -> bool:
        return key in self._sample  # the images need not be decoded

    def __iter__(self) -> Iterator[str]:
        return iter(self._sample)

    def __len__(self) -> int:
        return len(self._sample)


def held_out_frames(
    data: Any,
    indices: Iterable[int],
    cameras: Sequence[str],
    segmenter: Segmenter | None = None,
    place_of: Rig | None = None,
) -> Iterator[tuple[str, ScoredFrame]]:
    """Frame's name, inputs and truth of each held-out camera (``all``: of every camera) of the samples at ``indices``.

    ``["next"]`` holds out a ``FrameFolder``'s ``truth`` camera, else the cameras of the nearest neighbour recorded
    later. With ``place_of`` they are all cameras that have holes from the places of that rig's cameras, as sources too.
    Regions of the truth are the classes of LiDAR points in it (``FrameFolder.point_classes``), and the segmenter's
    masks. DataError for a camera that a sample lacks, or that is its only one, and if no sample has a photograph.
    """
    recorded = data.dataset if isinstance(data, WithDepth) else data
    problems, count = list[str](), 0
    for index in indices:
        sample = data[index]
        rig, frame = rig_of(sample), str(sample.get("token", index))
        views: list[tuple[Camera, torch.Tensor, Mapping[str, Any]]] = []  # camera, photograph, and the methods' sample
        if place_of is not None:
            sample, holes = _with_holes(sample, rig, place_of)
            for camera, image, hole in zip(rig, sample["images"], holes, strict=True):
                views += [(replace(camera, mask=hole), image, sample)] if hole.any() else []
        elif cameras == ["next"]:
            views = _displaced(sample, recorded.truth(index) if isinstance(recorded, FrameFolder) else None, problems)
        elif unknown := {*cameras} - {*rig.names, "all"}:
            expected = f"all, next, or cameras of frame {frame}, {', '.join(rig.names)}"
            raise DataError(f"--held-out: expected {expected}, got {', '.join(sorted(unknown))}")
        elif len(rig) < 2:
            raise DataError(f"--held-out: expected frames of several cameras, frame {frame} has one")
        else:
            for place, (camera, image) in enumerate(zip(rig, sample["images"], strict=True)):
                views += [(camera, image, WithoutCamera(sample, place))] if {camera.name, "all"} & {*cameras} else []
        points, classes = sample.get("points"), None
        if points is not None and isinstance(recorded, FrameFolder) and cameras != ["next"]:
            classes = recorded.point_classes(index, len(points))
        for camera, image, inputs in views:
            (photograph,) = as_arrays([image])
            masks = () if segmenter is None else segmenter(to_bytes(photograph))
            regions = {f"mask {k}": mask for k, mask in enumerate(masks, 1)}
            regions |= {} if points is None or classes is None else _windows(camera, points, classes)
            yield frame, photographed(inputs, camera, photograph, rig.ground_z_m, regions)
        count += len(views)
    if cameras == ["next"] and not count:
        raise DataError(problems[0] if problems else NO_PHOTOGRAPH)


def _displaced(
    sample: Mapping[str, Any], truth: Mapping[str, Any] | None, problems: list[str]
) -> list[tuple[Camera, torch.Tensor, Mapping[str, Any]]]:
    """Cameras and photographs of ``truth``, or of the next frame with moved objects masked; and the methods' sample."""
    if truth is not None:
        return [(camera, image, sample) for camera, image in zip(truth["rig"], truth["images"], strict=True)]
    if (found := later_neighbour(sample, problems)) is None:
        return []
    frame, later, others = found
    moved = later.labelled if later.moved is None else later.moved
    sample = {**sample, **({"neighbours": others} if others else {})}
    photographs = zip(later.rig, later.images(frame.images), strict=True)
    return [(without_objects(camera, moved), image, sample) for camera, image in photographs]


def later_neighbour(sample: Mapping[str, Any], problems: list[str]) -> tuple[Frame, Neighbour, list[Any]] | None:
    """A sample's frame, its nearest neighbour up to ``MOST_APART_S`` later, and the neighbours elsewhere; or None."""
    (frame,) = read_frames(sample, None, further=("neighbours",), warn=lambda _, message: problems.append(message))
    neighbours = frame.neighbours or ()
    later = next((neighbour for neighbour in neighbours if neighbour.is_later), None)
    if later is None:
        return None
    if (later.seconds or 0.0) > MOST_APART_S:
        problems.append(
            f"frame {str(sample.get('token', ''))!r} is left out, since its vehicle stands: the next frame from "
            f"elsewhere is {later.seconds:.1f} s later"
        )
        warn(problems[-1])
        return None
    apart_m = {frame.number: np.linalg.norm((frame.ego2ego - later.ego2ego)[:3, 3]) for frame in neighbours}
    others = [entry for k, entry in enumerate(sample["neighbours"]) if apart_m.get(k, np.inf) > STILL_M]
    return frame, later, others


def surfaces_for(sample: Mapping[str, Any]) -> list[GeometryName]:
    """Surfaces that a sample has the geometry for, from the least to the most."""
    names: list[GeometryName] = ["ground", "street"]
    names += ["boxes"] if sample.get("boxes_3d") is not None else []
    names += ["learned"] if sample.get(LEARNED_KEY) is not None else []
    measured: list[GeometryName] = ["lidar"] if sample.get("points") is not None else []
    return names + measured + ((["motion", "fused"] if measured else ["motion"]) if sample.get("neighbours") else [])


def _with_holes(sample: Mapping[str, Any], rig: Rig, target: Rig) -> tuple[dict[str, Any], list[BoolArray]]:
    """Sample whose cameras do not see the holes (h, w) that they would have at the centres of the target's nearest."""
    centres = [camera.center_m for camera in target.in_frame_of(rig)]
    moved = [camera.shifted(*min(centres - camera.center_m, key=np.linalg.norm)) for camera in rig]
    there = RigRetarget(without_masks(rig.with_cameras(moved)), holes="black", match_exposure=False, neighbours=None)
    seen = [covered.numpy() for covered in there(sample)["coverage"]]
    pairs = list(zip(seen, map(scene_mask, rig), strict=True))
    coverage = [torch.from_numpy(covered & mask) for covered, mask in pairs]
    return {**sample, "coverage": coverage}, [mask & ~covered for covered, mask in pairs]


def _gradients(image: npt.NDArray[Any], pixels: BoolArray) -> float:
    """Sum of the differences of the pixels (h, w) to their right and lower neighbours among them."""
    steps = [np.abs(np.diff(image.astype(np.float64), axis=axis)).sum(-1) for axis in (0, 1)]
    return float(steps[0][pixels[1:] & pixels[:-1]].sum() + steps[1][pixels[:, 1:] & pixels[:, :-1]].sum())


def _windows(camera: Camera, points: torch.Tensor, classes: npt.NDArray[np.int64]) -> dict[str, BoolArray]:
    """(h, w) pixels around the points (P, >=3) of each class (P,) that a camera sees."""
    seen, regions = visible_points(camera, points.numpy().astype(np.float64)), dict[str, BoolArray]()
    column, row = np.round(seen.uv).astype(int).T
    for number in np.unique(classes[seen.indices]):
        at = classes[seen.indices] == number
        around = np.zeros(camera.size, np.uint8)
        around[row[at], column[at]] = 1
        regions[f"class {number}"] = np.asarray(cv2.dilate(around, np.ones((_WINDOW_PX,) * 2, np.uint8)) > 0)
    return regions


def common_scores(
    name: str, frame: ScoredFrame, shown: Mapping[str, Sequence[RenderedView]], *, in_holes: bool = False
) -> list[dict[str, Any]]:
    """Score each method's view of a held-out camera on the pixels that all methods cover.

    With ``in_holes`` the pixels that no method covers score, at their own exposure.
    """
    assert frame.truth is not None and frame.target is not None
    (true,), (valid,), (regions,) = frame.truth(frame.target)
    views = {method: view for method, (view,) in shown.items()}
    common = valid & np.all([view.coverage != in_holes for view in views.values()], axis=0)
    rows = []
    for method, view in views.items():
        row: dict[str, Any] = {"frame": name, "camera": frame.target[0].name, "method": method}
        row |= {"seen": float(view.coverage[valid].mean()), "common": float(common[valid].mean())}
        if common.any():
            shown_px, true_px = view.image[common].astype(np.float64), true[common].astype(np.float64)
            gain = 1.0 if in_holes else (shown_px * true_px).sum() / max((shown_px**2).sum(), 1.0)
            row["psnr_db"] = errors(shown_px, true_px)["psnr_db"]
            row["gain_psnr_db"] = errors(gain * shown_px, true_px)["psnr_db"]
            row["ssim"] = float(ssim_map(view.image, true).mean(-1)[common].mean())
            row["gradients"] = _gradients(view.image, common) / max(_gradients(true, common), 1.0)
            for region, mask in regions.items():
                metrics = errors(gain * view.image[common & mask], true[common & mask])
                row |= {region: metrics["psnr_db"]} if metrics else {}
        rows.append(row)
    return rows


def photograph_tables(scored: Sequence[Mapping[str, Any]], methods: Sequence[str], *, in_holes: bool) -> list[Table]:
    """Tables of ``common_scores`` by method, and of one-gain PSNR by class."""
    frames = list(dict.fromkeys(row["frame"] for row in scored))
    means, by_frame = {}, {}
    for method in methods:
        rows = [row for row in scored if row["method"] == method]
        means[method] = mean_of(rows)
        frame_means = [mean_of(row for row in rows if row["frame"] == frame) for frame in frames]
        by_frame[method] = np.array([row.get("gain_psnr_db", np.nan) for row in frame_means])
    drawn = draws_of(len(frames))
    for method in methods[1:]:
        difference = by_frame[method] - by_frame[methods[0]]
        known = np.isfinite(difference)
        draws = drawn[:, known] @ difference[known] / np.maximum(drawn[:, known].sum(1), 1)
        means[method] |= interval("difference_db", draws)
    title, notes, columns = "Against the photographs of held-out cameras", NOTES, _COLUMNS
    if in_holes:
        title, notes, columns = "Against the photographs in held-out holes", HOLE_NOTES, _HOLE_COLUMNS
    if len(frames) == 1:  # one frame has no interval
        columns = tuple((name, text.split(" [")[0]) for name, text in columns)
    tables: list[Table] = [(title, means, columns, notes.format(common=mean_of(scored).get("common", 0.0)))]
    regions = {key for row in scored for key in row if key.startswith(("class ", "mask "))}
    if names := sorted(regions, key=lambda name: (name.split()[0], int(name.split()[1]))):
        notes = "PSNR of these pixels (cameras: after one gain), by class of points around or segmenter's mask."
        tables.append(("The same by class", means, [(name, f"{{{name}:.2f}}") for name in names], notes))
    return tables
