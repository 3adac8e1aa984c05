"""Warnings name the user's line: in scripts, in workers of either kind, and inside a pipeline of transforms."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch.utils.data import DataLoader
from torchvision.transforms import v2

from arbiview_aug import RetargetedDataset, RigRetarget, load_rig


def test_a_warning_names_the_line_that_calls_torch() -> None:
    street = load_rig("nuscenes").undistorted().resized((16, 28))
    sample = {"images": torch.zeros((6, 3, 16, 28), dtype=torch.uint8), "rig": street}
    dataset = RetargetedDataset([sample], v2.Compose([RigRetarget(street.shifted(z_m=0.6))]))
    with pytest.warns(UserWarning, match="target cameras stand up to") as caught:
        next(iter(DataLoader(dataset, batch_size=None)))  # type: ignore[arg-type]
    assert [Path(one.filename) for one in caught] == [Path(__file__)]


SCRIPT = """
import sys

import torch
from torch.utils.data import DataLoader, Dataset
from torchvision.transforms import v2

from arbiview_aug import RetargetedDataset, RigRetarget, load_rig

RIG = load_rig("nuscenes").undistorted().resized((16, 28))


class Frames(Dataset):
    def __init__(self, transform=None):
        self.transform = transform

    def __len__(self):
        return 1

    def __getitem__(self, index):
        sample = {"images": torch.zeros((len(RIG), 3, 16, 28), dtype=torch.uint8), "rig": RIG}
        if self.transform is None:
            return sample
        return self.transform(sample)  # line: transform


if __name__ == "__main__":
    torch.set_num_threads(1)
    how, workers, context = sys.argv[1:]
    retarget = RigRetarget(RIG.shifted(z_m=0.6))
    dataset = RetargetedDataset(Frames(), retarget) if how == "wrapped" else Frames(v2.Compose([retarget]))
    options = {"num_workers": int(workers), "multiprocessing_context": None if context == "none" else context}
    for _ in DataLoader(dataset, batch_size=None, **options):  # line: loop
        pass
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("wrapped 0 none", "loop"),
        ("wrapped 1 fork", "loop"),
        ("composed 0 none", "transform"),
        ("composed 1 fork", "transform"),
        ("composed 1 spawn", "transform"),
    ],
)
def test_a_warning_names_the_users_line(arguments: str, line: str, tmp_path: Path) -> None:
    script = tmp_path / "training.py"
    script.write_text(SCRIPT)
    command = [sys.executable, "-W", "always", str(script), *arguments.split()]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    named = re.findall(r"^(.*):(\d+): \w+Warning: target cameras stand up to", done.stderr, re.MULTILINE)
    number = 1 + next(k for k, text in enumerate(SCRIPT.splitlines()) if text.endswith(f"# line: {line}"))
    assert named == [(str(script), str(number))], done.stderr
