"""Random target rigs around a base rig, drawn per sample or per sequence."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import replace
from numbers import Number
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from arbiview_aug.cameras.camera import with_mask_of
from arbiview_aug.cameras.rig import Rig, load_rig
from arbiview_aug.cameras.validation import checked_array, refusal
from arbiview_aug.choices import is_whole
from arbiview_aug.errors import CalibrationError, SampleError, SampleTypeError, shown

Range = float | tuple[float, float]
"""A half-width about the neutral value (0, or 1 for scales: 0.2 means 0.8 to 1.2), or (low, high)."""


def sequence_rng(name: object, epoch: int = 0, rng: torch.Generator | None = None) -> torch.Generator:
    """Make a generator that is the same for all frames of a sequence, in all workers of a DataLoader's epoch.

    ``epoch`` changes the draws. Outside workers the initial seed of ``rng`` or torch's global generator is used.
    """
    worker = torch.utils.data.get_worker_info()
    if worker is not None:
        seed = worker.seed - worker.id  # the base seed that all workers of an epoch share
    else:
        seed = torch.initial_seed() if rng is None else rng.initial_seed()
    digest = hashlib.sha256(f"{seed} {epoch} {name}".encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1)


class Epochs:
    """Epoch of draws by sequence, shared by all copies of an object, in running workers too."""

    def __init__(self) -> None:
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        if not self._epoch.is_shared():  # copied or unpickled
            self._epoch.share_memory_()

    def set_epoch(self, epoch: int) -> None:
        """Change the draws by sequence, also in running workers; ValueError unless a whole number of 63 bits."""
        if not is_whole(epoch, -(2**63), 2**63 - 1):
            raise ValueError(f"set_epoch: expected a whole number below 2**63, got {shown(epoch)}")
        self._epoch.fill_(int(epoch))

    @property
    def epoch(self) -> int:
        """The epoch that was set last, 0 before."""
        return int(self._epoch)


class RandomRig(Epochs):
    """Target rigs around ``base``: the whole rig turned, moved and zoomed by random amounts; masks follow the ego car.

    Args:
        base: A rig, the name of a shipped one, or a rig file.
        yaw_deg: Every camera turned about the vertical through its centre; positive to the left.
        pitch_deg: Every camera turned about its x axis; positive up.
        roll_deg: Every camera turned about its optical axis.
        height_m: The rig moved up.
        forward_m: The rig moved forward.
        lateral_m: The rig moved to the left.
        focal_scale: Focal lengths scaled about the principal point.
        per: ``sample``: one draw per call, from torch's RNG (seeded per worker and epoch by the DataLoader).
            ``sequence``: one draw per value of ``sequence_key``, equal in all workers. It follows the DataLoader's
            seed. Without workers or with persistent ones, call ``set_epoch`` before each epoch: the wrapped dataset's,
            ``RigRetarget``'s or this one.
        sequence_key: The sample key that names its sequence.
    """

    def __init__(
        self,
        base: Rig | str | Path,
        *,
        yaw_deg: Range = 0.0,
        pitch_deg: Range = 0.0,
        roll_deg: Range = 0.0,
        height_m: Range = 0.0,
        forward_m: Range = 0.0,
        lateral_m: Range = 0.0,
        focal_scale: Range = 0.0,
        per: Literal["sample", "sequence"] = "sample",
        sequence_key: str = "scene_token",
    ) -> None:
        super().__init__()
        self.base = load_rig(base)
        self._unmasked = self.base.with_cameras([replace(camera, mask=None) for camera in self.base])
        if per not in ("sample", "sequence"):
            raise CalibrationError(f"RandomRig: per: expected 'sample' or 'sequence', got {shown(per)}")
        self.per, self.sequence_key = per, sequence_key
        ranges = {"yaw_deg": yaw_deg, "pitch_deg": pitch_deg, "roll_deg": roll_deg, "height_m": height_m}
        ranges |= {"forward_m": forward_m, "lateral_m": lateral_m, "focal_scale": focal_scale}
        self.ranges = {name: _range(name, value) for name, value in ranges.items()}

    def draw(self, rng: torch.Generator | None = None) -> dict[str, float]:
        """Random parameters, uniform in their ranges; from torch's global RNG unless ``rng`` is given."""
        u = torch.rand(len(self.ranges), generator=rng, dtype=torch.float64).tolist()
        return {name: low + (high - low) * x for (name, (low, high)), x in zip(self.ranges.items(), u, strict=True)}

    def rng_for(self, sample: Mapping[str, Any], rng: torch.Generator | None = None) -> torch.Generator | None:
        """Generator of a sample's draws: ``rng``, or that of its sequence; SampleError unless it names just one."""
        if self.per == "sample":
            return rng
        key = self.sequence_key
        names = set(names_in(key, sample.get(key)))
        if None in names:
            keys = ", ".join(map(str, sample))
            raise SampleError(f"RandomRig(per='sequence'): expected {key!r} in the sample, not None, got {keys}")
        if len(names) != 1:
            raise SampleError(f"RandomRig(per='sequence'): {key}: expected one sequence a batch, got {len(names)}")
        return sequence_rng(names.pop(), self.epoch, rng)

    def rig(self, params: Mapping[str, float]) -> Rig:
        """The rig of drawn parameters.

        Raises:
            CalibrationError: Unknown or missing parameters.
        """
        if set(params) != set(self.ranges):
            expected, got = ", ".join(self.ranges), ", ".join(map(str, params))
            raise CalibrationError(f"RandomRig: expected the parameters {expected}, got {got}")
        p = {name: float(value) for name, value in params.items()}
        rig = self._unmasked.turned(yaw_deg=p["yaw_deg"], pitch_deg=p["pitch_deg"], roll_deg=p["roll_deg"])
        rig = rig.shifted(p["forward_m"], p["lateral_m"], p["height_m"])
        scale = np.ones((3, 3))
        scale[:2, :2] = p["focal_scale"]
        pairs = zip(self.base, rig, strict=True)
        zoomed = [with_mask_of(base, replace(camera, K=camera.K * scale), outside=True) for base, camera in pairs]
        return rig.with_cameras(zoomed)

    def __repr__(self) -> str:
        moving = ", ".join(f"{n} {lo:g}..{hi:g}" for n, (lo, hi) in self.ranges.items() if hi > lo)
        return f"RandomRig({self.base.name or 'unnamed'}: {moving or 'nothing varies'}; per {self.per})"


def _range(name: str, value: Any) -> tuple[float, float]:
    is_scale = name == "focal_scale"
    expected = f"a {'half-width below 1 or a positive' if is_scale else 'half-width or a'} (low, high)"
    pair = isinstance(value, tuple | list)
    ends = checked_array("RandomRig", name, value, (2,) if pair else (), expected)
    low, high = ends.tolist() if pair else (is_scale - float(ends), is_scale + float(ends))
    if low > high or (is_scale and low <= 0):
        raise refusal("RandomRig", name, expected, shown(value))
    return low, high


def names_in(key: str, value: Any) -> list[str | None]:
    """Names of sequences or frames, or None, in nested lists, tensors and arrays, as in a collated batch.

    SampleTypeError for values whose text differs between processes, and for containers without end.
    """
    try:
        if isinstance(value, torch.Tensor | np.ndarray):
            value = value.tolist()
        if isinstance(value, list | tuple):
            return [name for entry in value for name in names_in(key, entry)]
        if value is None or isinstance(value, str | bytes | Number | np.generic):
            return [None if value is None else str(value)]
        return [json.dumps(value, sort_keys=True, default=lambda part: part.tolist())]
    except SampleTypeError:
        raise
    except (AttributeError, TypeError, ValueError, RuntimeError):  # no plain data, a circle, or on meta
        expected = "names: text or numbers, the same in all processes"
        raise SampleTypeError(f"{key}: expected {expected}, got {type(value).__name__}; pass its text") from None
