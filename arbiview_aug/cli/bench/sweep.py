"""The sweep of ``bench trade``: quality, surface, decoded size, execution, and depth from overlap held or not.

Times are CPU time of a ``RigRetarget`` call on one thread: with the plan where every frame needs its own (``objects``,
``lidar``, ``accurate`` without a cache), without it where it is held. Decoding is not in them, but beside them.

Accuracy is the mean PSNR of the views where some source sees, which the coverage mask tells: against LiDAR points in
the source cameras' colours (exposures made even; surfaces that may read the points get every other degree of them, the
others score), or on synthetic streets against the true views. The colours are those of the images decoded at
1 / ``REFERENCE``, whatever the setting decodes. What is seen, and the PSNR of whole views with the rest black, stand
beside: a surface that knows what objects hide covers less, and is right to.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any, Literal, get_args

import torch
from tqdm import tqdm

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cli.bench.data import REDUCES, Recorded, as_of_another_frame
from arbiview_aug.cli.bench.front import Point
from arbiview_aug.cli.bench.speed import remap_floor
from arbiview_aug.cli.bench.timing import Quartiles, peak_mib, quartiles, timed_rounds
from arbiview_aug.datasets.image_io import Reduce
from arbiview_aug.evaluate.frames import ScoredFrame, scores
from arbiview_aug.evaluate.images import RenderedView
from arbiview_aug.evaluate.methods import views_of
from arbiview_aug.evaluate.metrics import mean_of
from arbiview_aug.favs.config import Quality
from arbiview_aug.render.refinement import RefinementCache
from arbiview_aug.scene.surface import SurfaceName
from arbiview_aug.transforms.rig_retarget import RigRetarget

Execution = Literal["opencv", "torch", "cuda"]

REPEATS = 9
REFERENCE: Reduce = 2
"""Decoded size whose colours score: every published figure is at half resolution."""
_ENOUGH_MS = 1000.0  # a sweep of 63 settings takes three minutes, not twelve
_LEARNS_ON = ("street", "objects")
"""Surfaces that depth from overlap can correct: the others are measured, or nothing can be corrected."""


@dataclass(frozen=True)
class Setting:
    """A point of the sweep.

    Attributes:
        quality: As in ``RigRetarget``.
        surface: As in ``RigRetarget``.
        reduce: Images are decoded at 1 / this.
        execution: ``opencv`` and ``torch`` on the CPU, ``cuda``: torch on a GPU.
        held: Depth from overlap is held, not computed in every frame.
    """

    quality: Quality
    surface: SurfaceName
    reduce: Reduce
    execution: Execution
    held: bool = False

    @property
    def name(self) -> str:
        """For tables."""
        held = ["depth held"] if self.held else []
        return ", ".join([self.quality, self.surface, *held, f"1/{self.reduce}", self.execution])

    def transform(self, target: Rig) -> RigRetarget:
        """The setting as a transform; without a store of plans but for the last."""
        return RigRetarget(
            target,
            quality=self.quality,
            surface=self.surface,
            execution="torch" if self.execution == "cuda" else self.execution,
            refinement=RefinementCache() if self.held else None,
            cache_bytes=0,
            holes="black",
        )


@dataclass(frozen=True)
class Measured:
    """A setting's figures.

    Attributes:
        setting: The setting.
        time: Of a call, milliseconds.
        floor_ratio: Time over that of bare remaps.
        decode_ms: What decoding its images takes.
        peak_mib: Growth of the process over its first call, planning included; None where the system does not tell.
        psnr_db: Where some source sees.
        whole_psnr_db: Everywhere, unseen pixels black.
        seen: Share of what some source sees.
    """

    setting: Setting
    time: Quartiles
    floor_ratio: float
    decode_ms: float
    peak_mib: float | None
    psnr_db: float
    whole_psnr_db: float
    seen: float

    @property
    def point(self) -> Point:
        """For the front."""
        return Point(self.setting.name, self.time, self.psnr_db)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        times = self.time._asdict() | {"decode_ratio": self.time.median_ms / self.decode_ms}
        own = {key: value for key, value in asdict(self).items() if key not in ("setting", "time")}
        return {"name": self.setting.name, **asdict(self.setting), **times, **own}


def settings(
    surfaces: Sequence[SurfaceName],
    *,
    qualities: Sequence[Quality] = get_args(Quality),
    reduces: Sequence[Reduce] = REDUCES,
    executions: Sequence[Execution] = ("opencv", "torch"),
) -> list[Setting]:
    """All combinations that differ: ``paper`` has its own surface and runs on the CPU, and depth from overlap is
    nothing where the surface is measured or infinitely far."""
    found = []
    for quality, reduce, execution in itertools.product(qualities, reduces, executions):
        if quality == "paper":
            found += [Setting(quality, "far", reduce, execution)] if execution == "opencv" else []
            continue
        for surface in surfaces:
            learns = quality == "accurate"
            if not learns or surface in _LEARNS_ON:
                found += [Setting(quality, surface, reduce, execution, held) for held in ((False, True)[: 1 + learns])]
    return found


# --- the sweep --------------------------------------------------------------------------------------------------------
class Sweep:
    """Measures settings on the frames of a data set for one target.

    Args:
        data: The frames.
        target: The rig to render, its cameras of the views' size.
        frames: How many frames accuracy is the mean of; times are of the first.
        repeats: Rounds of timing.
    """

    def __init__(self, data: Recorded, target: Rig, *, frames: int = 1, repeats: int = REPEATS) -> None:
        self.data, self.target, self.frames, self.repeats = data, target, frames, repeats
        self._frames: dict[tuple[int, Reduce], ScoredFrame] = {}

    def frame(self, index: int, reduce: Reduce) -> ScoredFrame:
        """A frame at a decoded size."""
        key = index, reduce
        if key not in self._frames:
            self._frames[key] = self.data.frame(index, reduce, REFERENCE)
        return self._frames[key]

    @cached_property
    def surfaces(self) -> list[SurfaceName]:
        """Those that the frames have the geometry for."""
        sample = self.frame(0, REFERENCE).scored_sample
        found: list[SurfaceName] = ["far", "ground", "street"]
        found += ["objects"] if "boxes_3d" in sample else []
        return found + (["lidar"] if "points" in sample else [])  # type: ignore[list-item]

    def measure(self, wanted: Sequence[Setting]) -> list[Measured]:
        """Accuracy and memory of each setting, then the times of all in turn."""
        accuracy, memory = {}, {}
        for setting in tqdm(wanted, desc="accuracy", unit="setting", leave=False):
            memory[setting] = peak_mib(self._call(setting))
            accuracy[setting] = self._accuracy(setting)
        floor, reads = "floor", {f"decode 1/{r}": self.data.reader(r) for r in {s.reduce for s in wanted}}
        calls = {setting.name: self._call(setting) for setting in wanted}
        images = self._rendered_images()
        candidates = {floor: remap_floor(images, self.target.sizes[0]), **reads, **calls}
        times = timed_rounds(candidates, self.repeats, "times", enough_ms=_ENOUGH_MS)
        found = []
        for setting in wanted:
            own = times[setting.name]
            decode = quartiles(times[f"decode 1/{setting.reduce}"])
            ratio = float(quartiles(own / times[floor][: len(own)]).median_ms)
            found.append(
                Measured(setting, quartiles(own), ratio, decode.median_ms, memory[setting], **accuracy[setting])
            )
        return found

    def time_again(self, setting: Setting) -> Quartiles:
        """A setting's times alone, with a transform of its own."""
        return quartiles(timed_rounds({setting.name: self._call(setting)}, self.repeats, "again")[setting.name])

    def _call(self, setting: Setting) -> Callable[[], Any]:
        """Calls that alternate between two frames with one calibration."""
        sample = _on_device(self.frame(0, setting.reduce).scored_sample, setting)
        retarget = setting.transform(self.target)
        samples = itertools.cycle([sample, as_of_another_frame(sample)])

        def run() -> None:
            retarget(next(samples))
            if setting.execution == "cuda":
                torch.cuda.synchronize()

        return run

    def _accuracy(self, setting: Setting) -> dict[str, float]:
        retarget = setting.transform(self.target)

        def render(sample: Mapping[str, Any], _: Rig) -> list[RenderedView]:
            return views_of(retarget(_on_device(sample, setting)))

        rows: list[dict[str, float]] = []
        for index in range(self.frames):
            rows += scores(self.frame(index, setting.reduce), render, self.target, ("even",))[1]
        means = mean_of(rows)
        prefix = "true" if self.data.truth is not None else "even"
        return {
            "psnr_db": means[f"{prefix}_covered_psnr_db"],
            "whole_psnr_db": means[f"{prefix}_psnr_db"],
            "seen": means["seen"],
        }

    def _rendered_images(self) -> torch.Tensor:
        """(M, 3, h, w): something of the views' size that the floor can read."""
        h, w = self.target.sizes[0]
        generator = torch.Generator().manual_seed(0)
        return torch.randint(0, 256, (len(self.target), 3, h, w), dtype=torch.uint8, generator=generator)


def _on_device(sample: Mapping[str, Any], setting: Setting) -> dict[str, Any]:
    if setting.execution != "cuda":
        return dict(sample)
    return {**sample, "images": [image.to("cuda") for image in sample["images"]]}
