"""``python -m arbiview_aug bench ablation``: what each stage and setting is worth, in dB and in milliseconds.

Every row is a configuration of ``RigRetarget``; all render the same targets: the paper's six configurations (each
camera turned by a share of the spacing to its neighbour) and the rig raised by 0.6 m. On a real frame they are scored
by the paper's measure, LiDAR points with the colours that the source cameras saw (``evaluate.sparse``), after making
the exposures even; on the synthetic street against the true views. Pixels that no source sees are black and count.

Milliseconds are CPU time of a frame on one thread, the median over the targets, without the plan that a calibration
needs once. The paper's own numbers are printed beside: of nuScenes, raw exposures, and another renderer.
"""

from __future__ import annotations

import argparse
import statistics
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from arbiview_aug.bench.timing import cpu_model, one_thread, write_json
from arbiview_aug.camera import BoolArray, Camera
from arbiview_aug.datasets import FrameFolder
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import DataError
from arbiview_aug.evaluate.images import Image, as_arrays, as_tensors
from arbiview_aug.evaluate.methods import paper_stages
from arbiview_aug.evaluate.overlap import overlap_scores
from arbiview_aug.evaluate.paper_tables import PUBLISHED
from arbiview_aug.evaluate.scores import mean_of
from arbiview_aug.evaluate.sparse import coloured_points, equalised, sparse_metrics
from arbiview_aug.evaluate.targets import UP_M, paper_targets, shifted_target
from arbiview_aug.evaluate.truth import truth_metrics
from arbiview_aug.favs.config import FavsConfig, PaperConfig
from arbiview_aug.favs.refinement import RefinementCache
from arbiview_aug.rig import Rig
from arbiview_aug.transforms import RigRetarget

_WEIGHTS = ("distance", "gradient", "quality", "primary")
_NO_WEIGHTS: dict[str, Any] = {f"use_{name}_weight": False for name in _WEIGHTS}
_NO_STAGES_2_3: dict[str, Any] = {"use_feature_matching": False, "use_object_alignment": False}


def _without_weight(name: str) -> PaperConfig:
    off: dict[str, Any] = {f"use_{name}_weight": False}
    return PaperConfig(**_NO_STAGES_2_3, **off)


ROWS: dict[str, dict[str, Any]] = {
    **{name: {"quality": config} for name, config in paper_stages().items()},
    **{f"... and without w_{w}": {"quality": _without_weight(w)} for w in _WEIGHTS},
    "paper, stage 1 alone": {"quality": PaperConfig(**_NO_STAGES_2_3, **_NO_WEIGHTS)},
    "draft": {"quality": "draft"},
    "fast": {"quality": "fast"},
    "fast on the far surface": {"quality": "fast", "surface": "far"},
    "fast on the ground surface": {"quality": "fast", "surface": "ground"},
    "fast on the street surface": {"quality": "fast", "surface": "street"},
    "fast without blended seams": {"quality": FavsConfig(seam_width=0.0)},
    "fast, harmonised": {"quality": "fast", "harmonise": True},
    "accurate": {"quality": "accurate"},
    "accurate, depth held": {"quality": "accurate", "refinement": True},
}
"""Settings of ``RigRetarget`` by name; ``refinement``: with a cache of its own."""


def settings_of(name: str) -> dict[str, Any]:
    """A row's arguments of ``RigRetarget``."""
    settings = ROWS[name]
    return {**settings, "refinement": RefinementCache()} if "refinement" in settings else settings


OWN_CAMERA = "own camera only, far surface"
"""A row of its own: each target view from the source camera that it was made of."""

_PUBLISHED = {f"published: {row.name.split(',')[0]}": row._asdict() for row in PUBLISHED.values()}
"""The paper's Tables 1 and 2."""

_COLUMNS = (
    ("PSNR dB", "psnr_db", 2),
    ("SSIM", "ssim", 4),
    ("MAE", "mae", 2),
    ("RMSE", "rmse", 2),
    ("covered dB", "covered_psnr_db", 2),
    ("raised dB", "raised_psnr_db", 2),
    ("ms", "ms", 1),
)

Score = Callable[[Camera, Image, BoolArray], dict[str, float]]


@dataclass(frozen=True)
class _Work:
    """A frame, what to render of it, and how views are scored.

    Attributes:
        sample: Images and rig, and boxes where there are any. No points: the score is made of them.
        turned: The paper's six configurations.
        raised: The rig raised.
        scores: For each target rig, in the order of ``turned`` and ``raised``, the score of a view; empty without one.
        raw: The images as recorded.
    """

    sample: dict[str, Any]
    turned: list[Rig]
    raised: Rig
    scores: list[Score]
    raw: Any = field(repr=False)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the table, write the JSON."""
    parser = argparse.ArgumentParser(
        prog="python -m arbiview_aug bench ablation",
        description="Each stage and setting on and off: accuracy and milliseconds on one thread.",
    )
    parser.add_argument("--data", metavar="FOLDER", help="a frame folder with LiDAR (default: a synthetic street)")
    parser.add_argument(
        "--reduce", type=int, choices=(1, 2, 4), default=2, help="decode its images at 1/N (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the synthetic street (default: %(default)s)")
    parser.add_argument("--only", metavar="TEXT", default="", help="rows whose names contain it")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--output", default="output/ablation.json", metavar="FILE", help="(default: %(default)s)")
    arguments = parser.parse_args(argv)
    names = [name for name in (*ROWS, OWN_CAMERA) if arguments.only in name]
    if not names:
        parser.error(f"argument --only: expected part of one of {', '.join((*ROWS, OWN_CAMERA))}")
    with one_thread(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of targets that are half outside: the paper's are
        report = measure(arguments.data, names, reduce=arguments.reduce, seed=arguments.seed)
    path = Path(arguments.output)
    text = write_json(report, path)
    print(text if arguments.json else table(report))
    if not arguments.json:
        print(f"report: {path}")
    return 0


def measure(
    data: str | Path | None,
    names: Sequence[str],
    *,
    reduce: int = 2,
    seed: int = 0,
    size: tuple[int, int] = (256, 704),
) -> dict[str, Any]:
    """All rows asked for, as plain data for JSON.

    Args:
        data: A frame folder with LiDAR; None for a synthetic street.
        names: Names out of ``ROWS``, or ``OWN_CAMERA``.
        reduce: The frame's images are decoded at 1 / this.
        seed: Of the street.
        size: (h, w) of its images.
    """
    work = _street(seed, size) if data is None else _real(Path(data), reduce)
    rows = {name: _row(name, work) for name in tqdm(names, unit="row", leave=False)}
    overlap = None
    if data is not None:
        rig = work.sample["rig"]
        overlap = {h: _raw_overlap_db(rig, work.raw, h == "harmonised") for h in ("as recorded", "harmonised")}
    return {
        "benchmark": "ablation",
        "data": "synthetic street" if data is None else Path(data).name,
        "size": list(work.sample["rig"].sizes[0]),
        "cpu": cpu_model(),
        "rows": rows,
        "raw_overlap_db": overlap,
        "published": _PUBLISHED,
    }


def table(report: Mapping[str, Any]) -> str:
    """The report to read."""
    h, w = report["size"]
    against = "true views" if report["data"] == "synthetic street" else "LiDAR colours, exposures even"
    lines = [
        f"{report['data']} at {w}x{h}, against {against}; {report['cpu']}, one thread",
        f"{'':<34}" + "".join(f"{heading:>12}" for heading, *_ in _COLUMNS),
    ]
    for name, row in (report["rows"] | report["published"]).items():
        cells = [f"{row[key]:.{digits}f}" if key in row else "-" for _, key, digits in _COLUMNS]
        lines.append(f"{name:<34}" + "".join(f"{cell:>12}" for cell in cells))
    if report["raw_overlap_db"]:
        found = ", ".join(f"{name} {value:.2f}" for name, value in report["raw_overlap_db"].items())
        lines.append(f"Overlaps of neighbours on the raw frame, odd tiles, street surface, PSNR in dB: {found}")
    lines.append(f"The paper's six turns; raised by {UP_M} m; unseen pixels black, except in 'covered'.")
    return "\n".join(lines)


# --- what is measured -------------------------------------------------------------------------------------------------
def _real(folder: Path, reduce: int) -> _Work:
    frame = FrameFolder(folder, reduce=reduce)[0]  # type: ignore[arg-type]
    if "points" not in frame:
        raise DataError(f"--data {folder}: expected LiDAR points to score by, got none")
    rig, points = frame["rig"], frame["points"].numpy().astype(np.float64)
    even: list[Image] = list(equalised(rig, as_arrays(frame["images"]), points))
    coloured = coloured_points(rig, even, points)

    def score(camera: Camera, view: Image, coverage: BoolArray) -> dict[str, float]:
        found = sparse_metrics(view, camera, coloured, coverage=coverage)
        return {} if found is None else found.as_dict()

    targets = paper_targets(rig)
    sample = {"images": as_tensors(even), "rig": rig}
    sample |= {key: frame[key] for key in ("boxes_3d", "box_names") if key in frame}
    return _Work(sample, targets, shifted_target(rig, z_m=UP_M), [score] * (len(targets) + 1), frame["images"])


def _street(seed: int, size: tuple[int, int]) -> _Work:
    source = demo_source_rig(size)
    drive = SyntheticDrive(source, num_frames=1, seed=seed, lidar=False)
    frame, targets, raised = drive[0], paper_targets(source), shifted_target(source, z_m=UP_M)

    def against(target: Rig) -> Score:
        truth = dict(zip(target.names, as_arrays(drive.render(0, target).images), strict=True))
        return lambda camera, view, coverage: truth_metrics(view, truth[camera.name], coverage=coverage)

    sample = {key: frame[key] for key in ("images", "rig", "boxes_3d")}
    return _Work(sample, targets, raised, [against(target) for target in (*targets, raised)], frame["images"])


def _row(name: str, work: _Work) -> dict[str, float]:
    times: list[float] = []
    turned: list[dict[str, float]] = []
    raised: list[dict[str, float]] = []
    for k, (target, score) in enumerate(zip((*work.turned, work.raised), work.scores, strict=True)):
        views, coverage, seconds = _own_camera(work, target) if name == OWN_CAMERA else _rendered(name, work, target)
        times.append(1e3 * seconds)
        mounted = target.in_frame_of(work.sample["rig"])
        rows = [score(*view) for view in zip(mounted, views, coverage, strict=True)]
        (turned if k < len(work.turned) else raised).extend(row for row in rows if row)
    wanted = [key for _, key, _ in _COLUMNS]
    means = {key: value for key, value in mean_of(turned).items() if key in wanted}
    return means | {"raised_psnr_db": mean_of(raised)["psnr_db"], "ms": statistics.median(times)}


def _rendered(name: str, work: _Work, target: Rig) -> tuple[list[Image], list[BoolArray], float]:
    retarget = RigRetarget(target, **settings_of(name))
    if not isinstance(retarget.config, PaperConfig):  # which plans nothing
        retarget(work.sample)
    start = time.process_time()
    out = retarget(work.sample)
    return as_arrays(out["images"]), [seen.numpy() for seen in out["coverage"]], time.process_time() - start


def _own_camera(work: _Work, target: Rig) -> tuple[list[Image], list[BoolArray], float]:
    rig = work.sample["rig"]
    views, coverage, seconds = [], [], 0.0
    for k, camera in enumerate(target):
        retarget = RigRetarget(target.with_cameras([camera]), surface="far")
        sample = {"images": [work.sample["images"][k]], "rig": rig.with_cameras([rig[k]])}
        retarget(sample)
        start = time.process_time()
        out = retarget(sample)
        seconds += time.process_time() - start
        views.extend(as_arrays(out["images"]))
        coverage.append(out["coverage"][0].numpy())
    return views, coverage, seconds


def _raw_overlap_db(rig: Rig, images: Any, harmonised: bool) -> float:
    """Mean PSNR over the pairs of neighbours between their renderings of the view between them."""
    gains = RigRetarget(rig, harmonise=harmonised).harmonisation({"images": images, "rig": rig}).gains

    def render(view: Camera, source: int) -> tuple[Image, BoolArray]:
        one, target = rig.with_cameras([rig[source]]), rig.with_cameras([view])
        retarget = RigRetarget(target, surface="street", harmonise=[gains[source]])
        out = retarget({"images": [images[source]], "rig": one})
        return as_arrays(out["images"])[0], out["coverage"][0].numpy()

    found = [score.raw_psnr_db for score in overlap_scores(rig, render)]
    return float(np.mean([value for value in found if value is not None]))
