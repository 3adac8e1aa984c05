"""One training and its test, on frames that lie on disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import nn

from integrations.cross_rig.families import Batch
from integrations.cross_rig.frames import Arrays, FrameStore
from integrations.cross_rig.labels import HIDDEN, VEHICLE, Grid, box_loss, decode, match, real_boxes
from integrations.cross_rig.model import Answer, Detector, PillarDetector, PointBatch, PointSet
from integrations.cross_rig.scoring import cell_counts, iou
from integrations.cross_rig.variants import scaled_and_cropped

THRESHOLDS = tuple(round(0.05 * k, 2) for k in range(1, 20))

_EVAL_BATCH = 4
_BOXES = 0.05
"""Share of the boxes' loss, which is some twenty times that of the cells."""


def fast_precision() -> Literal["bf16", "fp32"]:
    """bfloat16 on CPUs that have instructions for it (AMX, AVX-512 BF16): others take forty times as long for it."""
    has: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.6 has none
    return "bf16" if has.get("amx_bf16") or has.get("avx512_bf16") else "fp32"


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """The same for every variant."""

    steps: int  # of the optimiser
    family: str = "voxels"
    batch: int = 4  # frames a step
    lr: float = 3e-3  # the peak of a one-cycle schedule; AdamW's default decay
    precision: Literal["bf16", "fp32"] = field(default_factory=fast_precision)

    def autocast(self) -> torch.autocast:
        """Networks run in bfloat16 where it is fast."""
        return torch.autocast("cpu", torch.bfloat16, enabled=self.precision == "bf16")


@dataclass(frozen=True)
class FrameSet:
    """Frames with labels, as the model gets them; every pixel counts as seen, as in stock detectors."""

    store: FrameStore  # of the images
    K: npt.NDArray[np.float32]  # (F, N, 3, 3)
    cam2ego: npt.NDArray[np.float32]  # (F, N, 4, 4)
    state: npt.NDArray[np.uint8]  # (F, cells, cells) of ``labels``
    counts: npt.NDArray[np.bool_]  # (cells, cells), the cells that count
    boxes: npt.NDArray[np.float32]  # (F, n, 7) vehicles, padded with NaN

    def frame(self, index: int) -> Arrays:
        """One frame's arrays: a ``Batch`` without its first dimension."""
        images = self.store.read("images", index)
        calibration = {"K": self.K[index], "cam2ego": self.cam2ego[index]}
        covered = {"images": images, "coverage": np.ones((len(images), *images.shape[-2:]), bool)}
        labels = {"state": self.state[index], "counts": self.counts, "boxes": self.boxes[index]}
        return covered | calibration | labels

    @staticmethod
    def joined(frames: Sequence[Arrays]) -> Batch:
        """Frames of any number of cameras as one batch."""

        def joined(name: str) -> torch.Tensor:
            join = np.stack if name in ("state", "counts", "boxes") else np.concatenate
            return torch.from_numpy(join([frame[name] for frame in frames]))

        lengths = torch.tensor([len(frame["images"]) for frame in frames])
        frame = torch.arange(len(frames)).repeat_interleave(lengths)
        return Batch(frame=frame, **{name: joined(name) for name in frames[0]})


Frames = FrameSet | PointSet


class Draws:
    """The batches of a training: which frames they hold depends on the seed alone, so that variants are paired.

    Half of them are of ``raw``, A's own, where it is given; with ``augmented`` frames are scaled and cropped.
    """

    def __init__(
        self, frames: Frames, raw: Frames | None, num_frames: int, seed: int, *, augmented: bool = False
    ) -> None:
        self.frames, self.raw, self.num_frames, self.augmented = frames, raw, num_frames, augmented
        self.order = np.random.default_rng([seed, 0])
        self.rng = np.random.default_rng([seed, 1])
        self.left: list[int] = []

    def batch(self, size: int) -> Batch | PointBatch:
        """The next batch; every frame once before any comes again."""
        frames: list[Arrays] = []
        for _ in range(size):
            if not self.left:
                self.left = [int(k) for k in self.order.permutation(self.num_frames)]
            index = self.left.pop()
            drawn_from = self.raw if self.raw is not None and self.rng.random() < 0.5 else self.frames
            frame = drawn_from.frame(index)
            if self.augmented:
                moved = scaled_and_cropped(frame["images"], frame["K"], self.rng)
                frame |= dict(zip(("images", "coverage", "K"), moved, strict=True))
            frames.append(frame)
        return self.frames.joined(frames)


def train(draws: Draws, schedule: Schedule, seed: int) -> tuple[nn.Module, list[float]]:
    """A trained detector and its mean loss over each tenth of the steps."""
    torch.manual_seed(seed)
    pillars = schedule.family == "pillars"
    untrained: nn.Module = PillarDetector(Grid()) if pillars else Detector(Grid(), schedule.family)
    model = untrained.to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(model.parameters(), lr=schedule.lr)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, schedule.lr, total_steps=schedule.steps)
    losses = []
    model.train()
    for _ in range(schedule.steps):
        batch = draws.batch(schedule.batch)
        with schedule.autocast():
            answer: Answer = model(batch)
        counts = batch.counts & (batch.state != HIDDEN)
        truth = (batch.state == VEHICLE)[counts].float()
        value = F.binary_cross_entropy_with_logits(answer.occupancy.float()[counts], truth)
        value = value + _BOXES * box_loss(answer.boxes, batch.boxes, batch.state, batch.counts, Grid())
        optimizer.zero_grad(set_to_none=True)
        value.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        cycle.step()
        losses.append(float(value.detach()))
    return model.eval(), [float(np.mean(part)) for part in np.array_split(losses, min(10, len(losses)))]


@torch.no_grad()
def answers(
    model: nn.Module, frames: Frames, schedule: Schedule
) -> tuple[npt.NDArray[np.float16], npt.NDArray[np.float32]]:
    """Probabilities of cells (F, cells, cells), and detections (F, k, 8) of ``labels.decode``."""
    cells, detections = [], []
    indices = range(len(frames.state))
    for start in indices[::_EVAL_BATCH]:
        batch = frames.joined([frames.frame(k) for k in indices[start : start + _EVAL_BATCH]])
        with schedule.autocast():
            answer = model(batch)
        cells.append(answer.occupancy.float().sigmoid().numpy().astype(np.float16))
        detections.append(decode(answer.boxes, Grid(), apart=schedule.family != "queries").numpy())
    return np.concatenate(cells), np.concatenate(detections)


def evaluate(model: nn.Module, val: Frames, test: Frames, schedule: Schedule) -> dict[str, Any]:
    """Plain data: the best ``threshold`` and ``val_iou`` of validation frames; ``counts`` (F, 3) of test frames' cells.

    ``matched`` (F, k, 5) is of ``labels.match``, with -1 for NaN, which JSON has not; ``positives`` (F,) counts boxes.
    """
    probability, _ = answers(model, val, schedule)
    ious = [iou(cell_counts(probability > t, val.state, val.counts).sum(0)) for t in THRESHOLDS]
    threshold = THRESHOLDS[int(np.argmax(ious))]
    probability, detections = answers(model, test, schedule)
    frames = list(zip(detections, test.boxes, test.state, strict=True))
    matched = np.stack([match(*frame, test.counts) for frame in frames])
    return {
        "threshold": threshold,
        "val_iou": float(max(ious)),
        "counts": cell_counts(probability > threshold, test.state, test.counts).tolist(),
        "matched": np.nan_to_num(np.round(matched, 4), nan=-1).tolist(),
        "positives": [int(real_boxes(boxes, state, test.counts).sum()) for _, boxes, state in frames],
    }
