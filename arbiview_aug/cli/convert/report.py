"""``report.html`` of a conversion: the written views, scored as ``evaluate`` scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from arbiview_aug.atomic_io import write_whole
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.convert.job import coverage_of
from arbiview_aug.cli.convert.manifest import Manifest
from arbiview_aug.cli.convert.settings import FOLDER, Settings
from arbiview_aug.datasets.depth_folder import FOLDERS
from arbiview_aug.datasets.drive import Recording
from arbiview_aug.datasets.registry import kinds_of, open_data
from arbiview_aug.evaluate.frames import Evaluation, evaluate, make_frame
from arbiview_aug.evaluate.images import RenderedView, as_arrays
from arbiview_aug.evaluate.methods import Method, retargeting
from arbiview_aug.evaluate.report.html import html_report
from arbiview_aug.evaluate.report.tables import evaluation_tables
from arbiview_aug.scene.scene import GEOMETRIES

CONVERTED = "converted"  # name of the written views in tables


def converted(settings: Settings) -> Method:
    """Wrap the written views as a method; for other rigs than the target it renders anew."""
    # Scored frames hold their points back, and depth on disk is not read again.
    anew = retargeting(
        settings.quality, "auto" if GEOMETRIES[settings.geometry].needs in ("points", *FOLDERS) else settings.geometry
    )
    manifest, target = Manifest(settings.output), settings.sized_target
    kind = settings.kind if settings.kind in kinds_of(settings.output) else None  # logs become frame folders
    written = open_data(settings.output, kind=kind, version=settings.version)
    written.load_points = False  # they may be links that leave the output

    def render(sample: Mapping[str, Any], rig: Rig) -> list[RenderedView]:
        record = manifest.record(sample["token"])
        if rig != target or record is None:
            return anew.render(sample, rig)
        stored = written.by_token(sample["token"])
        images = dict(
            zip(stored["rig"].names, as_arrays(stored["images"]), strict=True)
        )  # the reader has its own order
        files = {camera["name"]: settings.output / camera["file"] for camera in record["cameras"]}
        return [RenderedView(images[name], coverage_of(files[name])) for name in rig.names]

    return Method(CONVERTED, render, anew.reads_points, anew.render_alone)


def write_report(settings: Settings, data: Recording, tokens: Sequence[str], count: int) -> Evaluation:
    """Score ``count`` converted frames, spread evenly over ``tokens``, and write the page."""
    picked = [tokens[int(k)] for k in np.unique(np.linspace(0, len(tokens) - 1, min(count, len(tokens))).round())]
    target = settings.sized_target
    # The views were rendered at the recorded exposures.
    frames = ((token, make_frame(data.by_token(token), exposures=("raw",))) for token in picked)
    done = evaluate(frames, lambda _: {target.name or "target": target}, [converted(settings)])
    title = f"{data.root.resolve().name} as {target.name or 'the target'} would have seen it"
    notes = [f"{len(picked)} of {len(tokens)} frames, as they were written to {settings.output}."]
    if settings.holes != "black":
        notes.append("Pixels that no camera saw are scored as filled; covered figures leave them out.")
    if "points" in GEOMETRIES[settings.geometry].reads:
        notes.append("LiDAR points score views that were made with them: evaluate holds half of them out.")
    notes += [f"Not everything could be scored: {words}." for words in done.declined.values()]
    page = html_report(title, done, [CONVERTED], evaluation_tables(done, [CONVERTED]), notes)
    write_whole({settings.output / FOLDER / "report.html": page.encode()})
    return done
