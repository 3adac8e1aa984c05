"""One training and its test, on frames that lie on disk."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import nn

from arbiview_aug import Rig
from integrations.cross_rig.augmentation import scaled_and_cropped
from integrations.cross_rig.boxes import box_loss, decode, match, real_boxes
from integrations.cross_rig.cache import FrameStore
from integrations.cross_rig.cell_counts import Counts, Tally, iou, tally
from integrations.cross_rig.encoders import Backbone
from integrations.cross_rig.families import Batch
from integrations.cross_rig.labels import HIDDEN, VEHICLE, Grid
from integrations.cross_rig.model import Answer, Detector
from integrations.cross_rig.pillars import PillarDetector, PointBatch, PointSet

THRESHOLDS = tuple(round(0.05 * k, 2) for k in range(1, 20))
FIXED_THRESHOLD = 0.3
"""Threshold for those who have no frames of B to choose one on."""

_EVAL_BATCH = 4
_BOXES = 0.05
"""Share of the boxes' loss, which is some twenty times that of the cells."""


def fast_precision() -> Literal["bf16", "fp32"]:
    """bfloat16 on CPUs that have instructions for it (AMX, AVX-512 BF16): others take forty times as long for it."""
    has: dict[str, bool] = getattr(torch.cpu, "get_capabilities", dict)()  # torch 2.6 has none
    return "bf16" if has.get("amx_bf16") or has.get("avx512_bf16") else "fp32"


@dataclass(frozen=True, kw_only=True)
class Schedule:
    """The same for every variant.

    Attributes:
        family: Family of the model.
        steps: Steps of the optimiser.
        batch: Frames a step.
        lr: The peak of a one-cycle schedule; AdamW's default decay.
        backbone: Backbone of the model.
        precision: ``bf16`` runs the networks in bfloat16 (autocast): twice as fast on CPUs with AMX. By default
            ``fast_precision``.
        device: Device to train on.
    """

    steps: int
    family: str = "voxels"
    batch: int = 4
    lr: float = 3e-3
    backbone: Backbone = "small"
    precision: Literal["bf16", "fp32"] = field(default_factory=fast_precision)
    device: str = "cpu"


@dataclass(frozen=True)
class FrameSet:
    """Frames with labels, as the model gets them.

    Attributes:
        store: Images; with coverage and calibration where a rig's own do not hold.
        rig: The cameras of frames that bring no calibration.
        state: (F, cells, cells) of ``labels``.
        counts: (cells, cells) bool, the cells that count.
        boxes: (F, n, 7) vehicles, padded with NaN.
        retargeted: Whether the store has coverage and calibration.
        masked: Whether its coverage is used; otherwise every pixel counts as seen.
    """

    store: FrameStore
    rig: Rig
    state: npt.NDArray[np.uint8]
    counts: npt.NDArray[np.bool_]
    boxes: npt.NDArray[np.float32]
    retargeted: bool = False
    masked: bool = True

    def frame(self, index: int) -> _Frame:
        """One frame's arrays."""
        images = self.store.read(index, "images")
        covered = np.ones((len(images), *images.shape[-2:]), bool)
        K, cam2ego = self.rig.K.astype(np.float32), self.rig.cam2ego.astype(np.float32)
        if self.retargeted:
            K, cam2ego = self.store.read(index, "K"), self.store.read(index, "cam2ego")
            if self.masked:
                packed = self.store.read(index, "coverage")
                covered = np.unpackbits(packed, axis=-1, count=images.shape[-1]).astype(bool)
        return _Frame(images, covered, K, cam2ego, self.state[index], self.counts, self.boxes[index])

    @staticmethod
    def joined(frames: Sequence[_Frame]) -> Batch:
        """Frames as one batch."""
        return batched(frames)


Frames = FrameSet | PointSet


@dataclass(frozen=True)
class _Frame:
    images: npt.NDArray[np.uint8]
    coverage: npt.NDArray[np.bool_]
    K: npt.NDArray[np.float32]
    cam2ego: npt.NDArray[np.float32]
    state: npt.NDArray[np.uint8]
    counts: npt.NDArray[np.bool_]
    boxes: npt.NDArray[np.float32]


def batched(frames: Sequence[_Frame]) -> Batch:
    """Frames of any number of cameras as one batch."""

    def joined(name: str) -> torch.Tensor:
        return torch.from_numpy(np.concatenate([getattr(frame, name) for frame in frames]))

    lengths = [len(frame.images) for frame in frames]
    return Batch(
        images=joined("images"),
        coverage=joined("coverage"),
        K=joined("K"),
        cam2ego=joined("cam2ego"),
        frame=torch.arange(len(frames)).repeat_interleave(torch.tensor(lengths)),
        state=torch.from_numpy(np.stack([frame.state for frame in frames])),
        counts=torch.from_numpy(np.stack([frame.counts for frame in frames])),
        boxes=torch.from_numpy(np.stack([frame.boxes for frame in frames])),
    )


class Draws:
    """The batches of a training: which frames they hold depends on the seed alone, so that variants are paired.

    Args:
        own: The variant's frames, images or scans.
        raw: A's frames, half of which are drawn instead; None: none.
        num_frames: Frames of each.
        seed: Seed of the training.
        augmented: Frames are scaled and cropped.

    Attributes:
        augment_s: CPU seconds that scaling and cropping took so far.
    """

    def __init__(self, own: Frames, raw: Frames | None, num_frames: int, seed: int, *, augmented: bool = False) -> None:
        self.own, self.raw, self.num_frames, self.augmented = own, raw, num_frames, augmented
        self.order = np.random.default_rng([seed, 0])
        self.rng = np.random.default_rng([seed, 1])
        self.left: list[int] = []
        self.augment_s = 0.0

    def batch(self, size: int) -> Batch | PointBatch:
        """The next batch; every frame once before any comes again."""
        frames: list[Any] = []
        for _ in range(size):
            if not self.left:
                self.left = [int(k) for k in self.order.permutation(self.num_frames)]
            index = self.left.pop()
            drawn_from = self.raw if self.raw is not None and self.rng.random() < 0.5 else self.own
            frame: Any = drawn_from.frame(index)
            if self.augmented:
                start = time.process_time()
                images, coverage, K = scaled_and_cropped(frame.images, frame.K, self.rng)
                frame = replace(frame, images=images, coverage=coverage, K=K)
                self.augment_s += time.process_time() - start
            frames.append(frame)
        return self.own.joined(frames)


def loss(answer: Answer, batch: Batch | PointBatch) -> torch.Tensor:
    """Mean binary cross-entropy over the cells that count, and a share of the boxes' loss."""
    counts = batch.counts & (batch.state != HIDDEN)
    truth = (batch.state == VEHICLE)[counts].float()
    cells = F.binary_cross_entropy_with_logits(answer.occupancy.float()[counts], truth)
    return cells + _BOXES * box_loss(answer.boxes, batch.boxes, batch.state, batch.counts, Grid())


def untrained(schedule: Schedule) -> nn.Module:
    """A detector of a schedule's family."""
    if schedule.family == "pillars":
        return PillarDetector(Grid())
    return Detector(Grid(), schedule.family, schedule.backbone)


def train(draws: Draws, schedule: Schedule, seed: int) -> tuple[nn.Module, list[float]]:
    """A trained detector and its mean loss over each tenth of the steps."""
    torch.manual_seed(seed)
    device = torch.device(schedule.device)
    model = untrained(schedule).to(device).to(memory_format=torch.channels_last)
    optimizer = torch.optim.AdamW(model.parameters(), lr=schedule.lr)
    cycle = torch.optim.lr_scheduler.OneCycleLR(optimizer, schedule.lr, total_steps=schedule.steps)
    losses = []
    model.train()
    for _ in range(schedule.steps):
        batch = _on(device, draws.batch(schedule.batch))
        with _autocast(schedule):
            answer = model(batch)
        value = loss(answer, batch)
        optimizer.zero_grad(set_to_none=True)
        value.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        cycle.step()
        losses.append(float(value.detach()))
    return model.eval(), [float(np.mean(part)) for part in np.array_split(losses, min(10, len(losses)))]


def _on(device: torch.device, batch: Batch | PointBatch) -> Batch | PointBatch:
    """A batch on a device."""
    return type(batch)(*(getattr(batch, name).to(device) for name in batch.__dataclass_fields__))


def _autocast(schedule: Schedule) -> torch.autocast:
    device = torch.device(schedule.device).type
    return torch.autocast(device, torch.bfloat16, enabled=schedule.precision == "bf16")


@torch.no_grad()
def answers(
    model: nn.Module, frames: Frames, num_frames: int, schedule: Schedule
) -> tuple[npt.NDArray[np.float16], npt.NDArray[np.float32]]:
    """Probabilities of cells (F, cells, cells), and detections (F, k, 8) of ``boxes.decode``."""
    cells, detections = [], []
    for start in range(0, num_frames, _EVAL_BATCH):
        indices = range(start, min(start + _EVAL_BATCH, num_frames))
        own: Any = [frames.frame(k) for k in indices]
        batch = _on(torch.device(schedule.device), frames.joined(own))
        with _autocast(schedule):
            answer = model(batch)
        cells.append(answer.occupancy.float().sigmoid().cpu().numpy().astype(np.float16))
        detections.append(decode(answer.boxes, Grid(), apart=schedule.family != "queries").cpu().numpy())
    return np.concatenate(cells), np.concatenate(detections)


def best_threshold(probability: np.ndarray, frames: Frames) -> tuple[float, float]:
    """The threshold with the highest IoU on these frames, and that IoU."""
    counts = frames.counts[None] & (frames.state != HIDDEN)
    p, truth = probability[counts], (frames.state == VEHICLE)[counts]
    found = [((p > t) & truth, (p > t) & ~truth, ~(p > t) & truth) for t in THRESHOLDS]
    scores = iou(np.array([[kind.sum() for kind in kinds] for kinds in found]))
    best = int(scores.argmax())
    return THRESHOLDS[best], float(scores[best])


@dataclass(frozen=True)
class Tested:
    """Scores that a model reached on vehicle B.

    Attributes:
        threshold, val_iou: Best threshold on validation streets, and the IoU there.
        tally: Counts of cells, at that threshold.
        fixed: (F, 3) counts at ``FIXED_THRESHOLD``.
        matched: (F, k, 5) of ``boxes.match``.
        positives: (F,) boxes that count.
    """

    threshold: float
    val_iou: float
    tally: Tally
    fixed: Counts
    matched: npt.NDArray[np.floating]
    positives: npt.NDArray[np.integer]
    cpu_s: float


def evaluate(model: nn.Module, val: Frames, test_set: Frames, height_dm: np.ndarray, schedule: Schedule) -> Tested:
    """Threshold on validation streets, counts on test streets; both as B sees them, with B's calibration."""
    start = time.process_time()
    threshold, val_iou = best_threshold(answers(model, val, len(val.state), schedule)[0], val)
    probability, detections = answers(model, test_set, len(test_set.state), schedule)
    counts, fixed = (
        tally(probability > level, test_set.state, height_dm, test_set.counts) for level in (threshold, FIXED_THRESHOLD)
    )
    frames = list(zip(detections, test_set.boxes, test_set.state, strict=True))
    matched = np.stack([match(*frame, test_set.counts) for frame in frames])
    positives = np.array([real_boxes(boxes, state, test_set.counts).sum() for _, boxes, state in frames])
    return Tested(threshold, val_iou, counts, fixed.by_distance.sum(1), matched, positives, time.process_time() - start)
