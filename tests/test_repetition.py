"""The same sample gives the same bits: twice in a process, and in processes with other memory, threads and hashes."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget, SampleKeys, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.environment import repeatable_opencv
from tests.digests import digest

SETTINGS: dict[str, dict[str, Any]] = {
    "fast": {},
    "harmonised": {"match_exposure": True},
    "accurate": {"quality": "accurate", "geometry": "street", "keys": SampleKeys(extra=("confidence",))},
    "paper": {"quality": "paper", "keys": SampleKeys(extra=("source_camera",))},
}


KEYS = ("images", "coverage", "source_camera", "confidence")


def digests(sample: Mapping[str, Any]) -> list[str]:
    """A line for each setting and image type; float images show what rounding to uint8 would hide."""
    target, rng, kept, lines = sample["rig"].turned(yaw_deg=11.0), np.random.default_rng(0), [], []
    floats = {**sample, "images": sample["images"].float() / 255}
    for name, settings in SETTINGS.items():
        for kind, images in (("uint8", sample), ("float", floats)):
            kept.append(np.empty(int(rng.integers(1, 300_000)), np.uint8))  # buffers lie elsewhere the next time
            out = RigRetarget(target, **settings)(images)
            lines.append(f"{name} {kind} {digest({key: out[key] for key in KEYS if key in out})}")
    return lines


def street() -> dict[str, Any]:
    """Six cameras on a synthetic street, one of them overexposed."""
    sample = SyntheticDrive(load_rig("nuscenes").undistorted().resized((180, 320)), num_frames=1, lidar=False)[0]
    sample["images"][2] = (sample["images"][2].float() * 1.2).clamp(0, 255).to(torch.uint8)
    return sample


def in_another_process(seed: int) -> list[str]:
    """The digests by this file as a program, on memory that holds other rubbish (glibc) and on other threads."""
    environment = {
        **os.environ,
        "PYTHONHASHSEED": str(seed),
        "MALLOC_PERTURB_": str(85 * seed),
        "OPENCV_FOR_THREADS_NUM": str(seed),
        "OMP_NUM_THREADS": str(seed),
    }
    command = [sys.executable, "-m", "tests.test_repetition"]
    root = Path(__file__).parents[1]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, env=environment, cwd=root)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_opencv_is_left_as_it_was() -> None:
    before = cv2.getNumThreads(), cv2.ipp.useIPP()
    with pytest.raises(ZeroDivisionError), repeatable_opencv():
        assert (cv2.getNumThreads(), cv2.ipp.useIPP()) == (1, False)
        raise ZeroDivisionError
    assert (cv2.getNumThreads(), cv2.ipp.useIPP()) == before


@pytest.mark.slow
def test_a_street_in_two_processes() -> None:
    one, two = (in_another_process(seed) for seed in (1, 2))
    assert one == two and len(set(one)) == 2 * len(SETTINGS)


if __name__ == "__main__":
    print("\n".join(digests(street())))
