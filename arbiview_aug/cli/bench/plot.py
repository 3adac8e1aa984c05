"""The plot of ``bench trade``: milliseconds across, decibels up, the front joined."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_COLOURS = {"draft": "#7f7f7f", "fast": "#1f77b4", "accurate": "#2ca02c", "paper": "#d62728"}
_MARKERS = {"opencv": "o", "torch": "^", "cuda": "s"}


def save_plot(rows: Sequence[Mapping[str, Any]], steps: Sequence[str], title: str, path: Path) -> None:
    """Write the plot as a PNG, with the names of ``steps`` beside their points."""
    # Without pyplot: no global state and no display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 6.2), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    for row in rows:
        middle, colour, on_front = row["median_ms"], _COLOURS[row["quality"]], row["front"]
        axes.errorbar(
            middle,
            row["psnr_db"],
            xerr=[[middle - row["q1_ms"]], [row["q3_ms"] - middle]],
            fmt=_MARKERS[row["execution"]],
            color=colour,
            markersize=8 if on_front else 5,
            markerfacecolor=colour if on_front else "none",
            alpha=1 if on_front else 0.55,
            elinewidth=1,
        )
    front = sorted((row["median_ms"], row["psnr_db"]) for row in rows if row["front"])
    axes.step(*zip(*front, strict=True), where="post", color="black", linewidth=0.8, alpha=0.6)
    named = sorted((row for row in rows if row["name"] in steps), key=lambda row: row["median_ms"])
    for k, row in enumerate(named):
        left = k < len(named) / 2
        axes.annotate(
            row["name"],
            (row["median_ms"], row["psnr_db"]),
            # One line apart, below and above the front: steps may lie close together.
            xytext=(14, -14 - 12 * (len(named) // 2 - k)) if left else (-14, 6 + 12 * (k - len(named) // 2)),
            textcoords="offset points",
            fontsize=8,
            ha="left" if left else "right",
            arrowprops={"arrowstyle": "-", "linewidth": 0.5, "alpha": 0.6},
        )
    times = "CPU milliseconds a frame, one thread (median, quartiles)"
    axes.set(title=title, xscale="log", xlabel=times, ylabel="PSNR where some source sees, dB")
    axes.grid(True, which="both", alpha=0.2)
    for label in dict.fromkeys(row["quality"] for row in rows):
        axes.plot([], [], "o", color=_COLOURS[label], label=label)
    for label in dict.fromkeys(row["execution"] for row in rows):
        axes.plot([], [], _MARKERS[label], color="black", markerfacecolor="none", label=label)
    axes.legend(fontsize=8, loc="best")
    figure.savefig(path)
