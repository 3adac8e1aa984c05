"""Metrics as text: the columns of each table, and how they are laid out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from arbiview_aug.evaluate.run import Evaluation


class Column(NamedTuple):
    """Heading, the metric below it, and how many digits follow the point; ``%`` for shares."""

    heading: str
    metric: str
    digits: int | str = 2


SEEN = Column("seen", "seen", "%")

TRUTH_COLUMNS = (
    SEEN,
    Column("PSNR dB", "true_covered_psnr_db"),
    Column("ground", "true_covered_ground_psnr_db"),
    Column("objects", "true_covered_object_psnr_db"),
    Column("sky", "true_covered_sky_psnr_db"),
    Column("MAE", "true_covered_mae"),
    Column("SSIM", "true_covered_ssim", 4),
    Column("holes", "true_hole_psnr_db"),
    Column("hole MAE", "true_hole_mae"),
    Column("sharp", "true_hole_gradient_ratio"),
    Column("whole view", "true_psnr_db"),
)
TRUTH_NOTES: tuple[str, ...] = (
    "seen: share of the target's pixels. ground, objects, sky: PSNR there. MAE in grey levels of 255.",
    "holes, hole MAE: where no source saw; sharp: gradient energy there against the truth. whole view: PSNR of all",
    "pixels; holes are black unless a path fills them.",
)
SPARSE_COLUMNS = (
    SEEN,
    Column("raw dB", "raw_psnr_db"),
    Column("even dB", "even_psnr_db"),
    Column("covered", "even_covered_psnr_db"),
    Column("ground", "even_ground_psnr_db"),
    Column("other", "even_other_psnr_db"),
    Column("MAE", "even_mae"),
    Column("RMSE", "even_rmse"),
    Column("SSIM", "even_ssim", 4),
    Column("points", "even_coverage", "%"),
)
SPARSE_NOTES: tuple[str, ...] = (
    "seen: share of the target's pixels; points: of the LiDAR points. raw: PSNR of all points, those on unseen pixels",
    "against black. even and all between: the cameras' exposures are made even first, since exposure is not geometry;",
    "covered: on seen pixels; ground: on the road; other: all but the road.",
)
OVERLAP_COLUMNS = (
    Column("raw dB", "overlap_raw_psnr_db"),
    Column("fitted dB", "overlap_fitted_psnr_db"),
    Column("worst pair", "overlap_worst_fitted_psnr_db"),
    Column("targets raw", "consistency_raw_psnr_db"),
    Column("fitted", "consistency_fitted_psnr_db"),
    Column("worst", "consistency_worst_fitted_psnr_db"),
)
OVERLAP_NOTES: tuple[str, ...] = (
    "Two neighbouring source cameras, each alone rendered to the view half-way between them: PSNR on odd tiles, raw",
    "and with a gain and an offset per channel fitted on the even ones. targets: neighbouring rendered views, brought",
    "to their half-way view over the street's surface: do they show the same scene? Compare methods of one surface:",
    "what is rendered over the street agrees there even where the street is wrong.",
)


Table = tuple[str, Mapping[str, Mapping[str, float]], Sequence[Column], Sequence[str]]
"""Title, rows, columns and notes."""


def evaluation_tables(done: Evaluation, methods: Sequence[str]) -> list[Table]:
    """Views against their reference, a row for each method and target; and agreement, a row for each method.

    Args:
        done: What was measured.
        methods: Names, in the order of the rows.
    """
    assert done.first is not None
    names = [name for name in methods if name not in done.declined]
    rows: dict[str, dict[str, float]] = {}
    for name in names:
        if len(done.targets) > 1:
            rows |= {f"{name}: {target}": done.means(name, target) for target in done.targets}
        rows[f"{name}: all" if len(done.targets) > 1 else name] = done.means(name)
    table: Table = ("Views, no truth and no LiDAR points to compare with", rows, (SEEN,), ())
    if done.first.truth is not None:
        table = ("Against the true views, where some source camera saw", rows, TRUTH_COLUMNS, TRUTH_NOTES)
    elif done.first.lidar:
        points = len(done.first.lidar["raw"].points)
        split = ("Methods get the points of every other degree of azimuth; those between score (the count above).",)
        table = (
            f"Against {points} LiDAR points with the colours that the source cameras saw",
            rows,
            SPARSE_COLUMNS,
            (*SPARSE_NOTES, *split) if done.first.held_out else SPARSE_NOTES,
        )
    agreement = {name: done.agreement(name) for name in names}
    return [table, ("Agreement of neighbours", agreement, OVERLAP_COLUMNS, OVERLAP_NOTES)]


def text_table(
    title: str, rows: Mapping[str, Mapping[str, float]], columns: Sequence[Column], notes: Sequence[str] = ()
) -> str:
    """A table with named rows; a metric that a row lacks is a dash."""
    name_width = max(7, *(len(name) for name in rows)) if rows else 7
    lines = [f"{title}:", f"  {'':<{name_width}}" + "".join(f"{c.heading:>{_width(c)}}" for c in columns)]
    for name, row in rows.items():
        lines.append(f"  {name:<{name_width}}" + "".join(f"{cell(row, c):>{_width(c)}}" for c in columns))
    return "\n".join([*lines, *(f"  {note}" for note in notes)])


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[str]], left: int = 1) -> str:
    """A Markdown table that reads well as it is: the first ``left`` columns to the left, the others to the right."""
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


def cell(row: Mapping[str, float], column: Column) -> str:
    """One number as it is printed."""
    value = row.get(column.metric)
    if value is None:
        return "-"
    return f"{value:.1%}" if column.digits == "%" else f"{value:.{column.digits}f}"


def _width(column: Column) -> int:
    return max(7, len(column.heading)) + 2
