"""Explanations of a render plan, or of a rendering by ``quality="paper"``."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from arbiview_aug import favs
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.inpaint.neighbours import Fills
from arbiview_aug.render.harmonise import PhotometricReport
from arbiview_aug.render.plan import RenderPlan, SourceUse
from arbiview_aug.render.requirements import harm_remedies
from arbiview_aug.sample.inputs import DEPTH_WORDS
from arbiview_aug.scene.scene import Scene
from arbiview_aug.transforms.renderers import FramePlan


@dataclass(frozen=True)
class Explanation:
    """Why a frame is rendered as it is; ``str`` prints it, ``as_dict`` gives plain data."""

    planned: FramePlan
    outcome: str  # of pixels that no camera saw
    harmonisation: PhotometricReport | None = None  # the sources' gains and why, if they are harmonised
    fills: Fills | None = None  # how other frames of the drive fill holes, if there are any
    points: str | None = None  # what the target's scanners measure, if it has any

    @property
    def plan(self) -> RenderPlan:
        """The render plan."""
        return self.planned.plan

    def as_dict(self) -> list[dict[str, Any]]:
        """One entry for each target camera: coverage, share to invent, and its sources with surface and reason.

        With other frames of the drive also ``filled``: at most this share is filled from them.
        """
        entries = [
            _entry(camera, target.coverage, [self._source(pair) for pair in target.pairs])
            for camera, target in zip(self.plan.target, self.plan.targets, strict=True)
        ]
        if self.fills is not None:
            for entry, share in zip(entries, self.fills.shares(self.plan), strict=True):
                entry["filled"] = share
        return entries

    def _source(self, pair: SourceUse) -> dict[str, Any]:
        return {
            "camera": self.plan.source[pair.source].name,
            "share": pair.share,
            "surface": pair.surface,
            "reason": pair.reason,
            "baseline_m": pair.baseline_m,
            "parallax_px": pair.parallax_px,
            "halved": pair.level,
        }

    def __str__(self) -> str:
        lines = []
        if self.harmonisation is not None:
            lines.append(self.harmonisation.of_cameras(self.plan.source.names))
        if self.planned.harm is not None:
            lines += [self.planned.harm, f"better: {harm_remedies(self.plan.source, self.plan.target)}"]
        if self.planned.overlap is not None:
            lines += str(self.planned.overlap).splitlines()
        if known := list(_known(self.planned.scene)):
            lines.append(f"geometry: {', '.join(known)}; the street elsewhere")
        if self.planned.motion is not None:
            lines.append(str(self.planned.motion))
        for key in DEPTH_WORDS.values():
            lines += self.planned.frame.further.get(key, "").splitlines()
        if self.fills is not None:
            lines += self.fills.lines(self.plan)
        if self.points is not None:
            lines.append(self.points)
        head = [_head(self.plan.source, self.plan.target), *(f"  {line}" for line in lines)]
        return "\n".join([*head, *_lines(self.as_dict(), self.outcome, _source_line)])

    __repr__ = __str__


@dataclass(frozen=True)
class PaperExplanation:
    """Record of what the published stages did to a frame; ``str`` prints it, ``as_dict`` gives plain data."""

    rendering: favs.PaperRendering
    outcome: str  # of pixels that no camera saw

    def as_dict(self) -> list[dict[str, Any]]:
        """One entry for each target camera: coverage, share to invent, and what each stage made of its sources."""
        return [
            _entry(camera, view.coverage, [self._source(report, camera.center_m) for report in view.reports])
            for camera, view in zip(self.rendering.target, self.rendering.targets, strict=True)
        ]

    def _source(self, report: favs.SourceReport, center_m: FloatArray) -> dict[str, Any]:
        camera = self.rendering.source[report.source]
        return {
            "camera": camera.name,
            "share": report.share,
            "surface": "infinity",
            "primary": report.primary,
            "baseline_m": float(np.linalg.norm(camera.center_m - center_m)),
            "matches": report.features.good_matches,
            "inliers": report.features.inliers,
            "consistency_px": report.features.consistency_px,
            "alpha": report.features.alpha,
            "features": report.features.reason,
            "shift_px": report.objects.shift_px.tolist(),
            "objects": report.objects.reason,
        }

    def __str__(self) -> str:
        head = f"{_head(self.rendering.source, self.rendering.target)}, stages 1 to 4 as published, far surface"
        return "\n".join([head, *_lines(self.as_dict(), self.outcome, _stages)])

    __repr__ = __str__


def _known(scene: Scene) -> Iterator[str]:
    """How much of which geometry a scene has: numbers of points and boxes, or of the pixels that depth maps know."""
    parts: dict[str, Any] = {"boxes": scene.boxes, "points": scene.points}
    parts |= {"pixels of depth from motion": scene.motion, "points of neighbouring frames": scene.sweeps}
    parts |= {f"pixels of {key}": maps for key, maps in scene.further.items() if isinstance(maps, tuple)}
    for name, part in parts.items():
        if part is not None and len(part):
            pixels = sum(np.count_nonzero(one.depth_m) for one in part) if isinstance(part, tuple) else len(part)
            yield f"{pixels} {name}"


def _head(source: Rig, target: Rig) -> str:
    return f"{source.name or 'source'} -> {target.name or 'target'}: {len(source)} cameras to {len(target)}"


def _entry(camera: Camera, coverage: BoolArray, sources: list[dict[str, Any]]) -> dict[str, Any]:
    covered = float(coverage.mean())
    return {"camera": camera.name, "coverage": covered, "to_invent": 1 - covered, "sources": sources}


def _lines(entries: list[dict[str, Any]], outcome: str, words: Callable[[dict[str, Any]], str]) -> Iterator[str]:
    for entry in entries:
        to_invent = entry["to_invent"]
        note = f", {to_invent:.1%} that no camera saw, {outcome}" if to_invent else ""
        if entry.get("filled"):
            note = f", up to {entry['filled']:.1%} more by other frames of the drive{note}"
        yield f"  {entry['camera']}: {entry['coverage']:.1%} covered{note}"
        if not entry["sources"]:
            yield "    no source camera looks there"
        for source in entry["sources"]:
            yield f"    {source['share']:6.1%} from {source['camera']}{words(source)}"


def _stages(source: dict[str, Any]) -> str:
    if source["primary"]:
        return ": the primary camera, the reference of the others"
    return f": features: {source['features']}; objects: {source['objects']}"


def _source_line(source: dict[str, Any]) -> str:
    why = [source["reason"]]
    if source["parallax_px"]:
        why.append(f"about {source['parallax_px']:.1f} px of parallax where depth is unknown")
    if source["halved"]:
        why.append(f"read at 1/{2 ** source['halved']} size")
    return f" over the {source['surface']} surface ({', '.join(why)})"
