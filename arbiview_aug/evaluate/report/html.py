"""``report.html``: one self-contained page with sliders between views, and the tables."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

import cv2
import numpy as np

from arbiview_aug.cameras.rig import Rig
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
from arbiview_aug.evaluate.report.tables import Columns, Table, cell

SOURCE_LAYER = "nearest source camera"
TRUTH_LAYER = "truth"

_HEIGHT_PX = 300
_JPEG_QUALITY = 85


def html_report(
    title: str, done: Evaluation, methods: Sequence[str], tables: Sequence[Table], notes: Sequence[str] = ()
) -> str:
    """Build the page: title, notes as paragraphs, tables, and the first frame's views.

    It shows one picture per target camera, with a slider between two layers (source, methods in their order, holes,
    confidence, truth), and both rigs from above.
    """
    parts = [f"<h1>{escape(title)}</h1>", *(f"<p>{escape(note)}</p>" for note in notes)]
    parts += [_table(*table) for table in tables]
    shown = {name: done.pictures[name] for name in methods if name in done.pictures}
    if shown:
        parts.append(_views(done, shown))
    page = _PAGE.replace("{title}", escape(title)).replace("{body}", "\n".join(parts))
    return page.encode(errors="backslashreplace").decode()  # names of files that are not UTF-8


def layers(camera: int, done: Evaluation, shown: Mapping[str, Sequence[RenderedView]]) -> dict[str, Picture]:
    """Pictures that the slider of one target camera can show, by name."""
    source: Rig = done.first.sample["rig"]
    nearest = int(np.argmax(source.cam2ego[:, :3, 2] @ done.target[camera].cam2ego[:3, 2]))
    pictures = {SOURCE_LAYER: shrunk(as_arrays([done.first.sample["images"][nearest]])[0], _HEIGHT_PX)}
    for method, views in shown.items():
        view = views[camera]
        pictures[method] = shrunk(view.image, _HEIGHT_PX)
        if not view.coverage.all():
            pictures[f"{method}: unseen"] = hatched_view(view, _HEIGHT_PX)
        if view.confidence is not None:
            pictures[f"{method}: confidence"] = shrunk(overlay_confidence(view.image, view.confidence), _HEIGHT_PX)
    true = done.first.true_images(done.target)
    if true is not None:
        pictures[TRUTH_LAYER] = shrunk(true[camera], _HEIGHT_PX)
    return pictures


def _views(done: Evaluation, shown: Mapping[str, Sequence[RenderedView]]) -> str:
    rig = done.target
    by_camera = [layers(camera, done, shown) for camera in range(len(rig))]
    # Every camera offers the same layers: a view without holes stands for its own holes.
    names = list(dict.fromkeys(name for of_camera in by_camera for name in of_camera))
    sides = {"before": TRUTH_LAYER if TRUTH_LAYER in names else SOURCE_LAYER, "after": next(iter(shown))}
    choices = "".join(
        f'<label>{where} of the bar <select data-side="{side}">'
        + "".join(f"<option{' selected' * (name == sides[side])}>{escape(name)}</option>" for name in names)
        + "</select></label> "
        for where, side in (("left", "before"), ("right", "after"))
    )
    cells = []
    for k in left_to_right(rig):
        pictures = []
        for name in names:
            picture = by_camera[k].get(name, by_camera[k].get(name.split(": ")[0]))
            assert picture is not None
            side = next((f" {side}" for side, chosen in sides.items() if name == chosen), "")
            pictures.append(
                f'<img class="layer{side}" data-layer="{escape(name)}" alt="{escape(name)}" src="{_data_url(picture)}">'
            )
        h, w = rig[k].size
        seen = "; ".join(f"{m} {views[k].coverage.mean():.1%}" for m, views in shown.items())
        cells.append(
            f'<figure><div class="slider" style="aspect-ratio:{w}/{h}">{"".join(pictures)}<i></i></div>'
            f'<input type="range" min="0" max="100" value="50" aria-label="{escape(rig[k].name)}">'
            f"<figcaption>{escape(rig[k].name)} &middot; seen: {escape(seen)}</figcaption></figure>"
        )
    plan = _data_url(draw_rigs([done.first.sample["rig"], rig]))
    return (
        f'<section><h2>{escape(done.label)}</h2><p>{choices}</p><div class="sheet">{"".join(cells)}</div>'
        f'<img class="plan" alt="both rigs from above and from the side" src="{plan}"></section>'
    )


def _table(title: str, rows: Mapping[str, Mapping[str, float]], columns: Columns, notes: str) -> str:
    head = "".join(f"<th>{escape(heading)}</th>" for heading, _ in columns)
    body = "".join(
        f"<tr><th>{escape(name)}</th>" + "".join(f"<td>{cell(row, form)}</td>" for _, form in columns) + "</tr>"
        for name, row in rows.items()
    )
    return f"<h3>{escape(title)}</h3><table><tr><th></th>{head}</tr>{body}</table><p>{escape(notes)}</p>"


def _data_url(picture: Picture) -> str:
    _, coded = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(coded.tobytes()).decode()


_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
body { font: 15px/1.45 system-ui, sans-serif; margin: 1.5rem auto; max-width: 1700px; padding: 0 1rem; color: #282828 }
table { border-collapse: collapse; font-variant-numeric: tabular-nums }
td, th { padding: .15rem .8rem; text-align: right; border-bottom: 1px solid #e4e4e4; font-weight: 400 }
tr:first-child th { font-weight: 600 } tr th:first-child { text-align: left }
.sheet { display: grid; grid-template-columns: repeat(auto-fill, minmax(420px, 1fr)); gap: 1rem }
figure { margin: 0 } input[type=range] { width: 100%; margin: .2rem 0 }
.slider { position: relative; overflow: hidden; background: #000; --at: 50% }
.slider img { position: absolute; background: #000; width: 100%; height: 100%; object-fit: contain; visibility: hidden }
.slider img.after, .slider img.before { visibility: visible }
.slider img.before { z-index: 1; clip-path: inset(0 calc(100% - var(--at)) 0 0) }
.slider i { position: absolute; z-index: 2; top: 0; bottom: 0; left: var(--at); width: 2px; background: #ff00a0 }
.plan { max-width: 100%; margin-top: 1rem } figcaption { font-size: 13px }
</style></head><body>
{body}
<script>
for (const range of document.querySelectorAll('input[type=range]'))
  range.addEventListener('input', () =>
    range.previousElementSibling.style.setProperty('--at', range.value + '%'));
for (const choice of document.querySelectorAll('select'))
  choice.addEventListener('change', () => {
    for (const image of choice.closest('section').querySelectorAll('.layer'))
      image.classList.toggle(choice.dataset.side, image.dataset.layer === choice.value);
  });
</script></body></html>
"""
