"""Report of the results: JSON, and a table in Markdown."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import product
from typing import Any

import numpy as np

from integrations.cross_rig.experiment import Run, jobs
from integrations.cross_rig.scoring import Interval, ap_scores, iou_scores, matches_of
from integrations.cross_rig.variants import VARIANTS

Results = Mapping[str, Mapping[int, Mapping[str, Any]]]
"""Results of one change by variant and seed."""


def write_report(setup: Run) -> dict[str, Any]:
    """Write ``report.json`` and ``report.md`` from the results that are there; returns the first."""
    settings, changes = setup.settings, {}
    for family, length in product(settings.families, settings.schedules):
        job = next(job for job in jobs(settings) if (job.family, job.length) == (family, length))
        schedule = setup.schedule(job)
        unusual = [name for name in (family, length) if name not in ("voxels", "short")]
        for name, results in setup.results(family, length).items():
            drives = setup.source("test", name).drives(settings.test_frames)
            changes["-".join([name, *unusual])] = {
                "title": ", ".join([setup.title(name), *unusual]),
                "samples_seen": schedule.steps * schedule.batch,
                **_scored(results, drives),
            }
    report = {"settings": asdict(settings), "changes": changes}
    setup.output.mkdir(parents=True, exist_ok=True)
    (setup.output / "report.json").write_text(json.dumps(report, indent=1))
    (setup.output / "report.md").write_text(summary(report))
    return report


def _scored(variants: Results, drives: Sequence[int] | None) -> dict[str, Any]:
    """Scores over the seeds that every variant has; frames of one drive are drawn together."""
    seeds = sorted(set.intersection(*map(set, variants.values()))) if variants else []  # type: ignore[arg-type]
    if not seeds:
        return {"seeds": [], "variants": {}}
    results = {name: [variants[name][seed] for seed in seeds] for name in VARIANTS if name in variants}
    ious = iou_scores({name: np.array([row["counts"] for row in rows]) for name, rows in results.items()}, drives)
    aps = ap_scores({name: matches_of(rows) for name, rows in results.items()}, drives)
    return {
        "seeds": seeds,
        "variants": {
            name: {"title": VARIANTS[name].title, **asdict(ious[name]), "ap": asdict(aps[name])} for name in results
        },
    }


def summary(report: Mapping[str, Any]) -> str:
    """A row for each variant, between raw and the oracle."""
    head = ["B", "samples seen", "IoU", "closed gap %", "AP", "closed gap % by AP"]
    rows = [head, ["---", *["---:"] * (len(head) - 1)]]
    for change in report["changes"].values():
        variants = change["variants"]
        for name in [name for name in variants if name not in ("raw", "oracle")] or list(variants)[:1]:
            cells = [f"{change['title']}; {variants[name]['title']}", str(change["samples_seen"])]
            shown = [variants[key] for key in ("raw", name, "oracle") if key in variants]
            for scored in (shown, [row["ap"] for row in shown]):
                cells.append(", ".join(f"{100 * row['value']:.1f}" for row in scored))
                share = scored[shown.index(variants[name])]["share"]
                cells.append("–" if share is None else Interval(**share).percent())
            rows.append(cells)
    return "".join(f"| {' | '.join(cells)} |\n" for cells in rows)
