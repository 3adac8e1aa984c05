"""What the studies share: their command lines, and scores and times of a list of ``Method``."""

from __future__ import annotations

import argparse
import itertools
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tqdm import tqdm

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.arguments import command_parser
from arbiview_aug.cli.bench.timing import Clock, process_ms
from arbiview_aug.errors import exit_status
from arbiview_aug.evaluate.agreement import OverlapScore, summary, target_consistency
from arbiview_aug.evaluate.frames import ScoredFrame, scores
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import Method, Sample
from arbiview_aug.evaluate.metrics import mean_of


def study_parser(name: str, description: str, example: str) -> argparse.ArgumentParser:
    """Create the parser of ``python -m integrations.benchmarks.NAME``, without its options."""
    return command_parser("", description, example, program=f"python -m integrations.benchmarks.{name}")


def run_study(
    parser: argparse.ArgumentParser,
    run: Callable[[argparse.Namespace], int | None],
    argv: Sequence[str] | None,
    *,
    resumable: bool = False,
) -> int:
    """Parse the arguments and run a study; its exit status is that of ``errors.exit_status``."""
    arguments = parser.parse_args(argv)
    return exit_status(parser.prog, lambda: run(arguments), resumable=resumable)


def study(
    methods: Sequence[Method],
    frames: Sequence[ScoredFrame],
    targets: Mapping[str, Sequence[Rig]],
    *,
    repeats: int = 1,
    clock: Clock = process_ms,
    consistency: bool = False,
    label: str = "",
) -> dict[str, dict[str, Any]]:
    """Score and time methods on sets of targets; they take turns on each frame and target.

    Methods with a plan are timed ``repeats`` more times after the first call.

    Returns:
        By method: mean metrics for each set of targets (``evaluate.frames.scores``, even exposures; ``consistency_...``
        if asked for), ``ms`` of every repeated call, and ``plan_ms``, the additional milliseconds of the first call.
    """
    rows: dict[str, dict[str, list[Any]]] = {m.name: {key: [] for key in (*targets, "ms", "plan_ms")} for m in methods}
    pairs: dict[tuple[str, str], list[OverlapScore]] = defaultdict(list)  # by method and set
    work = list(itertools.product(((kind, rig) for kind, rigs in targets.items() for rig in rigs), frames))
    with tqdm(total=len(work) * len(methods), desc=label, unit="row", leave=False) as progress:
        for (kind, target), frame in work:
            for method in methods:
                views, metrics, times = _timed(method, frame, target, repeats if method.plans else 0, clock)
                row = rows[method.name]
                row[kind] += metrics
                row["ms"] += times[1:] or times
                row["plan_ms"].append(times[0] - times[-1])
                if consistency:
                    pairs[method.name, kind] += target_consistency(target, views)
                progress.update()
    return {
        name: row | {kind: mean_of(row[kind]) | summary("consistency", pairs[name, kind]) for kind in targets}
        for name, row in rows.items()
    }


def _timed(
    method: Method, frame: ScoredFrame, target: Rig, repeats: int, clock: Clock
) -> tuple[list[RenderedView], list[dict[str, float]], list[float]]:
    times: list[float] = []

    def render(sample: Sample, rig: Rig) -> list[RenderedView]:
        views: list[list[RenderedView]] = []
        for _ in range(1 + repeats):
            times.append(clock(lambda: views.append(method.render(sample, rig))))
        return views[-1]

    views, metrics = scores(frame, render, target, ("even",))
    return views, metrics, times
