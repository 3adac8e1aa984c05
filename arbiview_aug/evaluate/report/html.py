"""``report.html``: one self-contained page with sliders between views, and the tables; ``report.html.jinja`` is it."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from pathlib import Path

import jinja2
import numpy as np

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.image_io import encoded
from arbiview_aug.evaluate.frames import Evaluation
from arbiview_aug.evaluate.images import RenderedView, as_arrays
from arbiview_aug.evaluate.report.pictures import (
    Picture,
    draw_rigs,
    hatched_view,
    left_to_right,
    overlay_confidence,
    shrunk,
)
from arbiview_aug.evaluate.report.tables import Table, cell

_SOURCE, _TRUTH = "nearest source camera", "truth"  # layers
_HEIGHT_PX = 300


def html_report(
    title: str, done: Evaluation, methods: Sequence[str], tables: Sequence[Table], notes: Sequence[str] = ()
) -> str:
    """Build the page: title, notes, tables, the first frame's views with a slider between two layers, and both rigs."""
    rig, source = done.target, done.first.sample["rig"]
    shown = {name: done.pictures[name] for name in methods if name in done.pictures}
    by_camera = [layers(k, done, shown) for k in range(len(rig))] if shown else []
    cameras = []
    for k in left_to_right(rig) if shown else ():
        seen = "; ".join(f"{method} {views[k].coverage.mean():.1%}" for method, views in shown.items())
        pictures = {name: _data_url(picture) for name, picture in by_camera[k].items()}
        cameras.append({"name": rig[k].name, "size": rig[k].size, "seen": seen, "pictures": pictures})
    # Every camera offers the same layers: a view without holes stands for its holes.
    names = [*dict.fromkeys(name for pictures in by_camera for name in pictures)]
    sides = {"before": _TRUTH if _TRUTH in names else _SOURCE, "after": next(iter(shown), "")}
    template = jinja2.Environment(autoescape=True, trim_blocks=True).from_string(
        Path(__file__).with_name("report.html.jinja").read_text(encoding="utf-8")
    )
    plan = _data_url(draw_rigs([source, rig])) if shown else ""
    views = {"label": done.label, "names": names, "sides": sides, "cameras": cameras, "plan": plan}
    page = template.render(title=title, notes=notes, tables=tables, cell=cell, **views)
    return page.encode(errors="backslashreplace").decode()  # names of files that are not UTF-8


def layers(camera: int, done: Evaluation, shown: Mapping[str, Sequence[RenderedView]]) -> dict[str, Picture]:
    """Pictures that the slider of one target camera can show, by name."""
    source: Rig = done.first.sample["rig"]
    nearest = int(np.argmax(source.cam2ego[:, :3, 2] @ done.target[camera].cam2ego[:3, 2]))
    pictures = {_SOURCE: shrunk(as_arrays([done.first.sample["images"][nearest]])[0], _HEIGHT_PX)}
    for method, views in shown.items():
        view = views[camera]
        pictures[method] = shrunk(view.image, _HEIGHT_PX)
        if not view.coverage.all():
            pictures[f"{method}: unseen"] = hatched_view(view, _HEIGHT_PX)
        if view.confidence is not None:
            pictures[f"{method}: confidence"] = shrunk(overlay_confidence(view.image, view.confidence), _HEIGHT_PX)
    true = done.first.true_images(done.target)
    if true is not None:
        pictures[_TRUTH] = shrunk(true[camera], _HEIGHT_PX)
    return pictures


def _data_url(picture: Picture) -> str:
    jpeg = encoded(np.ascontiguousarray(picture[..., ::-1]), ".jpg")
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
