"""Other methods on the same work: kornia's warp, UniDrive's row split, OpenCV's stitching."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import torch
from tqdm import tqdm

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import Reduce
from arbiview_aug.cli.bench.data import Recorded
from arbiview_aug.cli.bench.timing import quartiles, timed_rounds
from arbiview_aug.errors import SampleError
from arbiview_aug.evaluate.frames import scores
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Method, retargeting
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.evaluate.report.tables import markdown_table
from arbiview_aug.evaluate.targets import named_targets, without_masks
from arbiview_aug.favs.stage1_geometry import h_geom
from arbiview_aug.image_ops import Scratch
from arbiview_aug.render.plan import RenderPlan
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.view_planner import build_plan
from integrations.benchmarks.baselines import method_of, row_split
from integrations.benchmarks.opencv_stitching import opencv_stitching

YAW_DEG = 22.0
OURS, ROW_SPLIT, STITCHING = "fast, street", "row split (UniDrive)", "OpenCV stitching"


def same_rotation(source: Rig, images: torch.Tensor, size: tuple[int, int], repeats: int) -> dict[str, Any]:
    """kornia's ``warp_perspective`` of every camera by its rotation, and ours: milliseconds, and how far they differ.

    kornia gets float images, converted before the clock starts, and one homography for each. ``own camera`` does
    exactly its work: each view from the one camera that was turned. ``all cameras`` fills what that one does not see.

    Args:
        source: The rig, pinhole cameras of one size.
        images: (N, 3, h, w) uint8.
        size: (h, w) of the views.
        repeats: Rounds of timing.

    Raises:
        SampleError: Lenses other than pinhole.
    """
    from kornia.geometry.transform import warp_perspective

    if any(not camera.is_rectilinear for camera in source):
        raise SampleError("the same rotation by kornia: expected pinhole cameras")
    source = without_masks(source)
    target = source.turned(yaw_deg=YAW_DEG).resized(size)
    H = torch.from_numpy(np.stack([h_geom(one, two) for one, two in zip(source, target, strict=True)])).float()
    floats = images.float().contiguous() / 255
    plans = [
        build_plan(source.with_cameras([one]), target.with_cameras([two]), geometry="infinity")
        for one, two in zip(source, target, strict=True)
    ]
    whole, scratch = build_plan(source, target), Scratch()

    def by_kornia() -> torch.Tensor:
        # Pixel centres are integers: corners are aligned.
        return warp_perspective(floats, H, size, mode="bilinear", padding_mode="zeros", align_corners=True)

    def by_own_camera() -> list[torch.Tensor]:
        return [render_opencv(plan, [image], scratch)[0] for plan, image in zip(plans, images, strict=True)]

    names = ("kornia warp_perspective", "own camera", "all cameras")
    runs: tuple[Callable[[], Any], ...] = (
        by_kornia,
        by_own_camera,
        lambda: render_opencv(whole, list(images), scratch),
    )
    times = timed_rounds(dict(zip(names, runs, strict=True)), repeats, "the same rotation")
    kornia_ms = times[names[0]]
    differences = [
        _difference(theirs, ours, plan) for theirs, ours, plan in zip(by_kornia(), by_own_camera(), plans, strict=True)
    ]
    return {
        "size": list(size),
        "yaw_deg": YAW_DEG,
        "times": {name: quartiles(times[name])._asdict() for name in names},
        "ratio": {name: float(np.median(times[name] / kornia_ms)) for name in names[1:]},
        "mean_difference": float(np.mean(differences)),
    }


def _difference(theirs: torch.Tensor, ours: torch.Tensor, plan: RenderPlan) -> float:
    """Mean absolute difference in grey levels where both see, a pixel within the border."""
    inside = cv2.erode(plan.coverage[0].astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    difference: npt.NDArray[np.float64] = np.abs(theirs.double().numpy() * 255 - ours.double().numpy())
    return float(difference[:, inside].mean())


def rivals() -> list[Method]:
    """Ours, and what others have that can render any pinhole rig."""
    return [
        retargeting("fast", "street", OURS),
        retargeting("accurate", "street", "accurate, street"),
        method_of(ROW_SPLIT, row_split),
        method_of(STITCHING, opencv_stitching),
    ]


def every_move(data: Recorded, frames: int, reduce: Reduce, moves: Sequence[str]) -> dict[str, dict[str, Any]]:
    """PSNR of each rival for each frame and move: over all pixels (unseen ones black), and over common ones.

    Common are the pixels that a rival and ``OURS`` both cover: what each leaves black is not compared there.

    Args:
        data: The frames, of pinhole cameras.
        frames: How many.
        reduce: Images are decoded at 1 / this.
        moves: Names of sets of targets (``evaluate.targets.named_targets``).
    """
    prefix = "true" if data.truth is not None else "even"
    found: dict[str, dict[str, Any]] = {}
    for index in range(frames):
        frame = data.frame(index, reduce, reduce)
        targets = {name: t for kind in moves for name, t in named_targets(kind, frame.sample["rig"]).items()}
        for move, target in tqdm(targets.items(), desc="every move", unit="move", leave=False):
            views = {method.name: method.render(frame.scored_sample, target) for method in rivals()}
            row = found.setdefault(f"frame {index}: {move}", {})
            for name, own in views.items():
                common = [a.coverage & b.coverage for a, b in zip(views[OURS], own, strict=True)]
                parts = {"": own, "common_": _shown(own, common), "ours_common_": _shown(views[OURS], common)}
                row[name] = {"seen": float(np.mean([view.coverage.mean() for view in own]))}
                for part, shown in parts.items():
                    means = mean_of(scores(frame, lambda *_, shown=shown: shown, target, ("even",))[1])
                    row[name][f"{part}psnr_db"] = means[f"{prefix}_{'covered_' if part else ''}psnr_db"]
    return found


def _shown(views: Sequence[RenderedView], pixels: Sequence[BoolArray]) -> list[RenderedView]:
    return [RenderedView(view.image, some) for view, some in zip(views, pixels, strict=True)]


def lost_moves(found: Mapping[str, Mapping[str, Any]], metric: str, other: str = ROW_SPLIT) -> list[str]:
    """Moves at which a rival has at least the dB of ``OURS``, with both figures.

    Args:
        found: By ``every_move``.
        metric: ``psnr_db``, or ``common_psnr_db``, where ours is over the same pixels.
        other: The rival.
    """
    lost = []
    for move, row in found.items():
        ours = row[OURS][metric] if metric == "psnr_db" else row[other][f"ours_{metric}"]
        if ours <= row[other][metric]:
            lost.append(f"{move} {ours:.2f} against {row[other][metric]:.2f} dB")
    return lost


def rotation_line(found: Mapping[str, Any]) -> str:
    ms = {name: f"{time['median_ms']:.1f} ms" for name, time in found["times"].items()}
    ours = ", ".join(f"{name} {ms[name]} ({ratio:.2f} of it)" for name, ratio in found["ratio"].items())
    return (
        f"Turned by {found['yaw_deg']:g} degrees at {found['size'][1]}x{found['size'][0]}: kornia's warp_perspective "
        f"{ms['kornia warp_perspective']}; ours, {ours}; mean difference {found['mean_difference']:.2f} grey levels."
    )


def moves_table(moves: Mapping[str, Mapping[str, Any]]) -> str:
    names = list(next(iter(moves.values())))
    cell = "{psnr_db:.2f} / {common_psnr_db:.2f} ({ours_common_psnr_db:.2f})"
    rows = [[move, *(cell.format(**row[name]) for name in names)] for move, row in moves.items()]
    lines = [
        f"dB: all pixels / those that {OURS} covers as well (and {OURS} there)",
        "",
        markdown_table(["", *names], rows),
        "",
    ]
    for other in (ROW_SPLIT, STITCHING):
        for metric, what in (("psnr_db", "all pixels"), ("common_psnr_db", "common pixels")):
            lost = lost_moves(moves, metric, other)
            better = f"{OURS} against {other}, {what}: better at {len(moves) - len(lost)} of {len(moves)} moves"
            lines.append(f"{better}; not at {'; '.join(lost)}" if lost else better)
    return "\n".join(lines)
