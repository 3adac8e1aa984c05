"""Metrics as text: the columns of each table, Markdown tables, and ``report.html``: one self-contained page."""

from __future__ import annotations

import base64
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import jinja2
import numpy as np

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.image_io import encoded
from arbiview_aug.evaluate.frames import Evaluation, own_index
from arbiview_aug.evaluate.metrics import RenderedView, as_arrays
from arbiview_aug.evaluate.report.pictures import Picture, draw_rigs, hatched_view, left_to_right, shrunk

Columns = Sequence[tuple[str, str]]  # headings, and the format of the cells below them: fields of a row
Table = tuple[str, Mapping[str, Mapping[str, float]], Columns, str]  # title, metrics by row, columns and notes

SEEN = ("seen", "{seen:.1%}")
TRUTH_COLUMNS = (
    SEEN,
    ("PSNR dB", "{true_covered_psnr_db:.2f}"),
    ("ground", "{true_covered_ground_psnr_db:.2f}"),
    ("objects", "{true_covered_object_psnr_db:.2f}"),
    ("sky", "{true_covered_sky_psnr_db:.2f}"),
    ("MAE", "{true_covered_mae:.2f}"),
    ("SSIM", "{true_covered_ssim:.4f}"),
    ("holes", "{true_hole_psnr_db:.2f}"),
    ("hole MAE", "{true_hole_mae:.2f}"),
    ("whole view", "{true_psnr_db:.2f}"),
)
TRUTH_NOTES = (
    "seen: share of the target's pixels. ground, objects, sky: PSNR there. MAE in grey levels of 255. holes, hole MAE: "
    "pixels that no source saw. whole view: PSNR of all pixels; holes are black unless they are filled."
)
SPARSE_COLUMNS = (
    SEEN,
    ("raw dB", "{raw_psnr_db:.2f}"),
    ("even dB", "{even_psnr_db:.2f}"),
    ("covered", "{even_covered_psnr_db:.2f}"),
    ("ground", "{even_ground_psnr_db:.2f}"),
    ("other", "{even_other_psnr_db:.2f}"),
    ("MAE", "{even_mae:.2f}"),
    ("RMSE", "{even_rmse:.2f}"),
    ("SSIM", "{even_ssim:.4f}"),
    ("points", "{even_coverage:.1%}"),
)
SPARSE_NOTES = (
    "seen: share of the target's pixels. raw: PSNR of all points, with unseen pixels black. even and the columns after "
    "it: the cameras' exposures are made even first. covered: points on seen pixels; points: their share. ground: "
    "points on the road; other: all others."
)
DETECTION_COLUMNS = (
    ("objects", "{objects:.0f}"),
    ("AP", "{ap:.2f} [{ap_low:.2f}, {ap_high:.2f}]"),
    ("recall", "{recall:.2f} [{recall_low:.2f}, {recall_high:.2f}]"),
)
DETECTION_NOTES = (
    "objects: detections of score 0.5 or more in the true images. AP, recall: at IoU 0.5; recall: of detections of "
    "score 0.5 or more. "
)
INTERVAL_NOTES = "Intervals: 95 %, bootstrap over images."
_HELD_OUT = "Methods get the points of every other degree of azimuth; the points between score (the count above)."


def evaluation_table(done: Evaluation, methods: Sequence[str]) -> Table:
    """Tabulate views against their reference, a row per method."""
    rows = {name: done.means(name) for name in methods if name not in done.declined}
    first = done.first
    if first.truth is not None:
        return "Against the true views, where some source camera saw", rows, TRUTH_COLUMNS, TRUTH_NOTES
    if first.lidar:
        title = f"Against {len(first.lidar['raw'].points)} LiDAR points with the colours that the source cameras saw"
        return title, rows, SPARSE_COLUMNS, f"{SPARSE_NOTES} {_HELD_OUT}" if first.held_out else SPARSE_NOTES
    return "Views, no truth and no LiDAR points to compare with", rows, (SEEN,), ""


def verdict_tables(rows: Mapping[str, Mapping[str, float]]) -> list[Table]:
    """Tabulate a detector's and a segmenter's figures, by row, for the rows that have them."""
    detected, segmented = ({name: row for name, row in rows.items() if key in row} for key in ("objects", "images"))
    masks = sorted({int(key[4:]) for row in segmented.values() for key in row if re.fullmatch(r"iou_\d+", key)})
    columns = [(f"IoU of mask {k}", f"{{iou_{k}:.2f}} [{{iou_{k}_low:.2f}}, {{iou_{k}_high:.2f}}]") for k in masks]
    tables: list[Table] = [
        ("Objects that the detector finds", detected, DETECTION_COLUMNS, DETECTION_NOTES + INTERVAL_NOTES),
        ("Masks in views and true images", segmented, [("images", "{images:.0f}"), *columns], INTERVAL_NOTES),
    ]
    return [table for table in tables if table[1]]


def text_table(title: str, rows: Mapping[str, Mapping[str, float]], columns: Columns, notes: str = "") -> str:
    table = metric_table([{"name": name, **row} for name, row in rows.items()], columns)
    return f"{title}:\n\n{table}\n\n{notes}".rstrip()


def metric_table(rows: Sequence[Mapping[str, Any]], columns: Columns, names: Sequence[str] = ("name",)) -> str:
    """Markdown table of rows; a missing field is a dash. ``names``: fields of the first columns, without headings."""
    cells = [[*(str(row[name]) for name in names), *(cell(row, form) for _, form in columns)] for row in rows]
    return markdown_table([*("" for _ in names), *(heading for heading, _ in columns)], cells, left=len(names))


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """Aligned Markdown table; the first ``left`` columns are left-aligned, the others right-aligned."""
    widths = [max(3, *(len(line[k]) for line in (head, *rows))) for k in range(len(head))]
    rule = ["-" * width if k < left else "-" * (width - 1) + ":" for k, width in enumerate(widths)]
    lines = [
        [
            text.ljust(width) if k < left else text.rjust(width)
            for k, (text, width) in enumerate(zip(line, widths, strict=True))
        ]
        for line in (head, rule, *rows)
    ]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def cell(row: Mapping[str, Any], form: str) -> str:
    """Format fields of a row; a dash where one is missing or None."""
    try:
        return form.format_map(row)
    except (KeyError, TypeError):
        return "-"


# --- report.html: sliders between views, and the tables, by ``report.html.jinja`` -------------------------------------
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
    # Every camera offers the same layers: a view without holes is also its picture of holes.
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
    nearest = own_index(source, done.target[camera])
    pictures = {_SOURCE: shrunk(as_arrays([done.first.sample["images"][nearest]])[0], _HEIGHT_PX)}
    for method, views in shown.items():
        view = views[camera]
        pictures[method] = shrunk(view.image, _HEIGHT_PX)
        if not view.coverage.all():
            pictures[f"{method}: unseen"] = hatched_view(view, _HEIGHT_PX)
    true = done.first.true_images(done.target)
    if true is not None:
        pictures[_TRUTH] = shrunk(true[camera], _HEIGHT_PX)
    return pictures


def _data_url(picture: Picture) -> str:
    jpeg = encoded(np.ascontiguousarray(picture[..., ::-1]), ".jpg")
    return f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
