"""Two processes on gloo: they stay equal, see different items, and write once."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[3]

PROGRAM = """
import json
import sys
from pathlib import Path
import torch
from arbiview_aug.generator import Generator
from arbiview_aug.generator.training.trainer import Trainer
from tests.generator.training.small import config, frames

torch.set_num_threads(1)
torch.manual_seed(0)
settings = config(steps=3)
trainer = Trainer(settings, frames(), Generator.from_config(settings.generator), sys.argv[1], show=False)
rank, world = trainer.accelerator.process_index, trainer.accelerator.num_processes
seen = []
plain = trainer.train_step
trainer.train_step = lambda batch: (seen.extend(batch.tokens), plain(batch))[1]
trainer.train()
digest = sum(float(p.double().abs().sum()) for p in trainer.generator.denoiser.parameters())
seen = sorted(int(token.split("/")[-1]) for token in seen)
report = {"world": world, "digest": digest, "seen": seen}
Path(sys.argv[2], f"process-{rank}.json").write_text(json.dumps(report))
"""


@pytest.mark.slow
def test_two_processes_train_one_model(tmp_path: Path) -> None:
    program = tmp_path / "program.py"
    program.write_text(PROGRAM)
    # accelerate picks gloo on the CPU
    variables = {**os.environ, "PYTHONPATH": str(ROOT), "ACCELERATE_USE_CPU": "true", "OMP_NUM_THREADS": "1"}
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc_per_node", "2"]
    command = [*launch, str(program), str(tmp_path / "run"), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, env=variables, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-3000:]
    # Files, not standard output: the two processes share that, and their lines may run into one another.
    first, second = (json.loads((tmp_path / f"process-{rank}.json").read_text()) for rank in range(2))
    assert first["world"] == second["world"] == 2
    assert first["digest"] == second["digest"]
    assert first["seen"] == [0, 1, 4, 5, 8, 9] and second["seen"] == [2, 3, 6, 7, 10, 11]
    assert len(list((tmp_path / "run" / "state").iterdir())) == 1
