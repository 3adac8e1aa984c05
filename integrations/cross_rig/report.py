"""Reports of the results: JSON, a Markdown table, a plot."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import pairwise, product
from pathlib import Path
from typing import Any

import numpy as np

from integrations.cross_rig.cell_counts import DISTANCES_M, HEIGHTS_M, iou
from integrations.cross_rig.experiment import Run, jobs_of, load_results, rendering_seconds, same_frames
from integrations.cross_rig.scoring import ap_scores, iou_scores, matches_of, percent
from integrations.cross_rig.settings import jobs
from integrations.cross_rig.variants import VARIANTS
from integrations.cross_rig.worlds import CHANGES

Results = Mapping[str, Mapping[int, Mapping[str, Any]]]
"""Results of one change by variant and seed."""


def write_report(setup: Run) -> dict[str, Any]:
    """Write ``report.json``, ``report.md`` and ``report.png`` from the results that are there; returns the first."""
    changes, there = {}, 0
    for family, length in product(setup.settings.families, setup.settings.schedules):
        results = load_results(setup, family, length)
        there += sum(len(seeds) for variants in results.values() for seeds in variants.values())
        schedule = setup.schedule(jobs_of(setup, family, length)[0])
        unusual = [name for name in (family, length) if name not in ("voxels", "short")]
        for name in (name for name in setup.settings.changes if name in results):
            changes["-".join([name, *unusual])] = {
                "title": ", ".join([setup.title(name), *unusual]),
                "samples_seen": schedule.steps * schedule.batch,
                **_of_change(results[name], rendering_seconds(setup, name), setup.drives(name)),
                "same_frames": same_frames(setup, name, family, length),
            }
    total = sum(len(setup.tested_on(job)) for job in jobs(setup.settings))
    report = {
        "settings": asdict(setup.settings),
        "tests_done": there,
        "tests": total,
        "changes": changes,
    }
    setup.output.mkdir(parents=True, exist_ok=True)
    (setup.output / "report.json").write_text(json.dumps(report, indent=1))
    (setup.output / "report.md").write_text(markdown(report))
    if changes:
        save_plot(report, setup.output / "report.png")
    return report


def _of_change(variants: Results, rendering: Mapping[str, float], drives: Sequence[int] | None) -> dict[str, Any]:
    """Scores over the seeds that every variant has; frames of one drive are drawn together."""
    seeds = sorted(set.intersection(*(set(by_seed) for by_seed in variants.values())))
    if not seeds:
        return {"seeds": [], "variants": {}}
    cells = {name: np.array([variants[name][s]["by_distance"] for s in seeds]) for name in variants}  # [S, F, bins, 3]
    scores = iou_scores({name: array.sum(2) for name, array in cells.items()}, drives)
    precisions = ap_scores({name: matches_of([variants[name][s] for s in seeds]) for name in variants}, drives)
    rows = {}
    for name in (n for n in VARIANTS if n in variants):
        heights = np.array([variants[name][s]["by_height"] for s in seeds]).sum((0, 1))
        trained = [variants[name][s]["trained"] for s in seeds]
        rows[name] = {
            "title": VARIANTS[name].title,
            **{"iou" if key == "value" else key: figure for key, figure in asdict(scores[name]).items()},
            "ap": asdict(precisions[name]),
            "fixed_iou": float(iou(np.array([variants[name][s]["fixed"] for s in seeds]).sum((0, 1)))),
            "by_distance_iou": iou(cells[name].sum((0, 1))).tolist(),
            "by_height_recall": (heights[:, 0] / np.maximum(heights[:, 1], 1)).tolist(),
            "thresholds": [variants[name][s]["threshold"] for s in seeds],
            "training_cpu_s": float(np.median([t["cpu_s"] for t in trained])),
            # A mixed variant renders every other frame.
            "loading_cpu_s": rendering.get(name, 0.0) * (0.5 if VARIANTS[name].mixed else 1)
            + float(np.median([t["augment_cpu_s"] for t in trained])),
        }
    return {"seeds": seeds, "variants": rows}


def markdown(report: Mapping[str, Any]) -> str:
    """The tables, one for each change."""
    s = report["settings"]
    streets = f" on streets of {s['world']}" if s["world"] != "drive" else ""
    lines = [
        f"{s['train_frames']} training and {s['test_frames']} test frames{streets} at {s['size'][0]}×{s['size'][1]}, "
        f"batches of {s['schedule']['batch']}, {report['tests_done']} of {report['tests']} "
        f"tests done. IoU of vehicle cells in %, [95 % interval] over seeds and frames; closed gap: (variant − raw) / "
        "(oracle − raw), where oracle − raw is at least 5 points; loading: CPU ms that the variant adds to a frame "
        "that is drawn.",
    ]
    distances = [f"{a:g}–{b:g} m" for a, b in pairwise(DISTANCES_M)]
    heights = [f"{a:g}–{b:g} m high" for a, b in pairwise(HEIGHTS_M)]
    scored = any("ap" in row for change in report["changes"].values() for row in change["variants"].values())
    head = [
        "variant",
        "IoU",
        "over raw",
        "closed gap %",
        *(["IoU at 0.3", "AP", "closed gap % by AP"] if scored else []),
    ]
    head += [*(f"IoU {d}" for d in distances)]
    head += [*(f"recall {h}" for h in heights), "loading"]
    for name, change in report["changes"].items():
        if not change["variants"]:
            continue
        title, seeds = change.get("title") or CHANGES[name].title, ", ".join(map(str, change["seeds"]))
        lines += ["", f"**{title}**, {_samples_seen(report, name)} samples seen, seeds {seeds}", ""]
        lines += ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
        for variant, row in change["variants"].items():
            same = change["same_frames"].get(variant)
            title = row["title"] + (f" (the frames of {change['variants'][same]['title']})" if same else "")
            cells = [title, _text(row["iou"], 1), _text(row["over_raw"], 1, "+")]
            cells.append(_text(row["share"], 0))
            if scored:
                cells += [f"{100 * row['fixed_iou']:.1f}", _text(row["ap"]["value"], 1), _text(row["ap"]["share"], 0)]
            cells += [f"{100 * value:.1f}" for value in (*row["by_distance_iou"], *row["by_height_recall"])]
            cells.append(f"{1000 * row['loading_cpu_s']:.1f}")
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def summary(report: Mapping[str, Any]) -> str:
    """A short table: every variant of a single change; of several changes, each variant between raw and the oracle.

    Shares are means of the seeds with t-intervals, from three seeds on; with fewer they have those of the bootstrap.
    """
    changes = {name: change for name, change in report["changes"].items() if change["variants"]}
    lone = len(changes) == 1
    head = ["trained on" if lone else "B", "samples seen", "IoU", "closed gap %", "AP", "closed gap % by AP"]
    table = [head, ["---", *["---:"] * (len(head) - 1)]]
    for change_name, change in changes.items():
        title, variants = change["title"], change["variants"]
        named = [name for name in variants if lone or name not in ("raw", "oracle")]
        for name in named:
            row = variants[name]
            shown = [row] if lone else [variants[one] for one in ("raw", name, "oracle") if one in variants]
            table.append([row["title"] if lone else title if len(named) == 1 else f"{title}; {row['title']}"])
            table[-1] += [str(_samples_seen(report, change_name))]
            table[-1] += [", ".join(f"{100 * one['iou']['value']:.1f}" for one in shown), _share(row)]
            table[-1] += [", ".join(f"{100 * one['ap']['value']['value']:.1f}" for one in shown), _share(row["ap"])]
    return "".join("| " + " | ".join(cells) + " |\n" for cells in table)


def _samples_seen(report: Mapping[str, Any], change: str) -> int:
    """Samples that each training of a change drew; reports from before the long schedule have one for all."""
    schedule = report["settings"]["schedule"]
    return int(report["changes"][change].get("samples_seen", schedule["steps"] * schedule["batch"]))


def _share(score: Mapping[str, Any]) -> str:
    return _text(score.get("share_t") or score["share"], 0)


def _text(value: Mapping[str, float] | None, digits: int, sign: str = "") -> str:
    return "–" if value is None else percent(value["value"], value["low"], value["high"], digits, sign)


def save_plot(report: Mapping[str, Any], path: Path) -> None:
    """A panel for each change: IoU of each variant with its interval; raw and oracle as lines."""
    # Without pyplot: no global state, and no display is looked for.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    changes = {name: change["variants"] for name, change in report["changes"].items() if change["variants"]}
    if not changes:
        return
    titles = {name: row["title"] for variants in changes.values() for name, row in variants.items()}
    names = list(titles)
    figure = Figure(figsize=(2 + 3 * len(changes), 1.4 + 0.32 * len(names)), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(1, len(changes), sharey=True, squeeze=False)[0]
    for panel, (change, variants) in zip(panels, changes.items(), strict=True):
        for name, colour in (("raw", "#d62728"), ("oracle", "#2ca02c")):
            if name in variants:
                panel.axvline(100 * variants[name]["iou"]["value"], color=colour, linewidth=0.8, alpha=0.6)
        for k, name in enumerate(names):
            if name not in variants:
                continue
            score = variants[name]["iou"]
            middle, low, high = (100 * score.get(part, score["value"]) for part in ("value", "low", "high"))
            panel.errorbar(middle, k, xerr=[[max(middle - low, 0)], [max(high - middle, 0)]], fmt="o", color="#1f77b4")
        panel.set_title(report["changes"][change]["title"], fontsize=10)
        panel.set_xlabel("IoU, %")
        panel.grid(True, axis="x", alpha=0.2)
    panels[0].set_yticks(range(len(names)), list(titles.values()))
    panels[0].invert_yaxis()
    figure.savefig(path)
