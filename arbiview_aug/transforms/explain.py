"""Explanations of a render plan, or of a rendering by ``quality="paper"``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from arbiview_aug import favs
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.inpaint.neighbours import Fills
from arbiview_aug.render.harmonise import PhotometricReport
from arbiview_aug.render.plan import RenderPlan, SourceUse
from arbiview_aug.render.requirements import harm_remedies
from arbiview_aug.sample.inputs import DEPTH_WORDS
from arbiview_aug.transforms.renderers import FramePlan


@dataclass(frozen=True, repr=False)
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
        for entry, share in zip(entries, self.fills.shares(self.plan) if self.fills else (), strict=False):
            entry["filled"] = share
        return entries

    def _source(self, pair: SourceUse) -> dict[str, Any]:
        known = {key: getattr(pair, key) for key in ("share", "surface", "reason", "baseline_m", "parallax_px")}
        return {"camera": self.plan.source[pair.source].name, **known, "halved": pair.level}

    def __str__(self) -> str:
        source, target, scene = self.plan.source, self.plan.target, self.planned.scene
        lines = [] if self.harmonisation is None else [self.harmonisation.of_cameras(source.names)]
        if (harm := self.planned.harm) is not None:
            lines += [harm, f"better: {harm_remedies(source, target)}"]
        if self.planned.overlap is not None:
            lines += str(self.planned.overlap).splitlines()
        parts: dict[str, Any] = {"boxes": scene.boxes, "points": scene.points}
        parts |= {"pixels of depth from motion": scene.motion, "points of neighbouring frames": scene.sweeps}
        parts |= {f"pixels of {key}": maps for key, maps in scene.further.items() if isinstance(maps, tuple)}
        known = [
            f"{sum(np.count_nonzero(m.depth_m) for m in part) if isinstance(part, tuple) else len(part)} {name}"
            for name, part in parts.items()
            if part is not None and len(part)
        ]
        lines += [f"geometry: {', '.join(known)}; the street elsewhere"] if known else []
        lines += [] if self.planned.motion is None else [str(self.planned.motion)]
        for key in DEPTH_WORDS.values():
            lines += self.planned.frame.further.get(key, "").splitlines()
        lines += [] if self.fills is None else self.fills.lines(self.plan)
        lines += [] if self.points is None else [self.points]
        return _text("\n  ".join([_head(source, target), *lines]), self)

    __repr__ = __str__

    def _reason(self, source: dict[str, Any]) -> str:
        why = [source["reason"]]
        if source["parallax_px"]:
            why.append(f"about {source['parallax_px']:.1f} px of parallax where depth is unknown")
        if source["halved"]:
            why.append(f"read at 1/{2 ** source['halved']} size")
        return f" over the {source['surface']} surface ({', '.join(why)})"


@dataclass(frozen=True, repr=False)
class PaperExplanation:
    """Record of what the published stages did to a frame; ``str`` prints it, ``as_dict`` gives plain data."""

    rendering: favs.PaperRendering
    outcome: str  # of pixels that no camera saw

    def as_dict(self) -> list[dict[str, Any]]:
        """One entry for each target camera: coverage, share to invent, and what each stage made of its sources."""
        return [
            _entry(camera, view.coverage, [self._source(report, camera) for report in view.reports])
            for camera, view in zip(self.rendering.target, self.rendering.targets, strict=True)
        ]

    def _source(self, report: favs.SourceReport, target: Camera) -> dict[str, Any]:
        camera = self.rendering.source[report.source]
        return {
            "camera": camera.name,
            "share": report.share,
            "surface": "infinity",
            "primary": report.primary,
            "baseline_m": float(np.linalg.norm(camera.center_m - target.center_m)),
            "matches": report.features.good_matches,
            "inliers": report.features.inliers,
            "consistency_px": report.features.consistency_px,
            "alpha": report.features.alpha,
            "features": report.features.reason,
            "shift_px": report.objects.shift_px.tolist(),
            "objects": report.objects.reason,
        }

    def __str__(self) -> str:
        head = _head(self.rendering.source, self.rendering.target)
        return _text(f"{head}, stages 1 to 4 as published, far surface", self)

    __repr__ = __str__

    def _reason(self, source: dict[str, Any]) -> str:
        if source["primary"]:
            return ": the primary camera, the reference of the others"
        return f": features: {source['features']}; objects: {source['objects']}"


def _head(source: Rig, target: Rig) -> str:
    return f"{source.name or 'source'} -> {target.name or 'target'}: {len(source)} cameras to {len(target)}"


def _entry(camera: Camera, coverage: BoolArray, sources: list[dict[str, Any]]) -> dict[str, Any]:
    covered = float(coverage.mean())
    return {"camera": camera.name, "coverage": covered, "to_invent": 1 - covered, "sources": sources}


def _text(heading: str, explanation: Explanation | PaperExplanation) -> str:
    lines = [heading]
    for entry in explanation.as_dict():
        to_invent, sources = entry["to_invent"], entry["sources"]
        note = f", {to_invent:.1%} that no camera saw, {explanation.outcome}" if to_invent else ""
        if entry.get("filled"):
            note = f", up to {entry['filled']:.1%} more by other frames of the drive{note}"
        lines.append(f"  {entry['camera']}: {entry['coverage']:.1%} covered{note}")
        lines += [f"    {s['share']:6.1%} from {s['camera']}{explanation._reason(s)}" for s in sources]
        lines += [] if sources else ["    no source camera looks there"]
    return "\n".join(lines)
