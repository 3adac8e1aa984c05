"""``python -m integrations.benchmarks.cost``: a step's cost follows its settings."""

from __future__ import annotations

import pytest

from arbiview_aug.generator.training.config import overridden, tiny
from integrations.benchmarks.cost import main, step_cost


@pytest.mark.slow
def test_a_steps_cost(capsys: pytest.CaptureFixture[str]) -> None:
    small = ["pseudo_views.p_translate=0"]
    one, two = (step_cost(overridden(tiny(), [*small, f"batch={n}"])) for n in (2, 4))
    assert two["flop"] == pytest.approx(2 * one["flop"], rel=0.1)
    assert one["frozen"] == 0 < one["trained"] == two["trained"] and one["vae"] == 0
    assert 22 * one["trained"] < one["bytes"] < two["bytes"]
    recomputed = step_cost(overridden(tiny(), [*small, "batch=2", "checkpointing=true"]))
    assert 1.2 * one["flop"] < recomputed["flop"] < 1.5 * one["flop"]
    assert main(["--config", "tiny", "--set", "batch=1"]) == 0
    assert "| `tiny` " in capsys.readouterr().out
