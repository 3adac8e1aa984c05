"""The same sample gives the same bits: twice in a process, and in processes with other memory, threads and hashes."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from arbiview_aug import RigRetarget, SampleKeys, load_rig
from arbiview_aug.datasets.synthetic import SyntheticDrive
from arbiview_aug.environment import repeatable_opencv

SETTINGS: dict[str, dict[str, Any]] = {
    "fast": {},
    "harmonised": {"match_exposure": True},
    "accurate": {"quality": "accurate", "geometry": "street", "keys": SampleKeys(extra=("confidence",))},
    "paper": {"quality": "paper", "keys": SampleKeys(extra=("source_camera",))},
}


def digest(out: Mapping[str, Any]) -> str:
    """Digest of all tensors of an output, bit for bit."""
    tensors = [out[key] for key in ("images", "coverage", "source_camera", "confidence") if key in out]
    return hashlib.sha256(b"".join(tensor.numpy().tobytes() for tensor in tensors)).hexdigest()


def digests(sample: Mapping[str, Any], repeats: int = 1) -> list[str]:
    """A line for each setting and image type; float images show what rounding to uint8 would hide."""
    target, rng, held, lines = sample["rig"].turned(yaw_deg=11.0), np.random.default_rng(0), [], []
    floats = {**sample, "images": sample["images"].float() / 255}
    for name, settings in SETTINGS.items():
        for kind, images in (("uint8", sample), ("float", floats)):
            results = set()
            for _ in range(repeats):
                held.append(np.empty(int(rng.integers(1, 300_000)), np.uint8))  # buffers lie elsewhere the next time
                results.add(digest(RigRetarget(target, **settings)(images)))
            lines.append(f"{name} {kind} {' '.join(sorted(results))}")
    return lines


def street() -> dict[str, Any]:
    """Six cameras on a synthetic street, one of them overexposed."""
    sample = SyntheticDrive(load_rig("nuscenes").undistorted().resized((180, 320)), num_frames=1, lidar=False)[0]
    sample["images"][2] = (sample["images"][2].float() * 1.2).clamp(0, 255).to(torch.uint8)
    return sample


def in_another_process(seed: int, *arguments: str) -> list[str]:
    """The digests by this file as a program, on memory that holds other rubbish (glibc) and on other threads."""
    environment = {
        **os.environ,
        "PYTHONHASHSEED": str(seed),
        "MALLOC_PERTURB_": str(85 * seed),
        "OPENCV_FOR_THREADS_NUM": str(seed),
        "OMP_NUM_THREADS": str(seed),
    }
    command = [sys.executable, __file__, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=500, env=environment)
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
