"""The render plan: everything about a (source rig, target rig) pair but image content; and its settings.

A plan is plain data: the place of each source image in an atlas, and for every target camera the position of every
pixel in it, its winning source, and the pixels along seams that are blended.

Convention: a map holds, for every target pixel, the (x, y) of the atlas pixel to read; pixel centres are integers.
Maps are OpenCV's fixed-point pairs: ``xy`` (h, w, 2) int16 whole pixels and ``frac`` (h, w) uint16 with 32nds of a
pixel, (frac & 31) in x and (frac >> 5) in y. The torch path reads the same positions, so both executions agree.
``OUTSIDE`` marks pixels that read nothing and come out black.

An atlas holds the source images that a plan reads, in columns, some of them halved: one ``cv2.remap`` then serves a
target that sees several sources.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import BoolArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import MAX_SIZE_PX
from arbiview_aug.choices import is_number
from arbiview_aug.errors import CalibrationError, shown
from arbiview_aug.image_ops import level_size


@dataclass(frozen=True, kw_only=True)
class RenderConfig:
    """Settings of planned rendering. ``docs/decisions.md`` measures each one.

    Attributes:
        interpolation: Sampling of the sources. ``cubic`` applies only where a target camera magnifies what it reads at
            its own centre (``arbiview_aug.render.view_planner.MAGNIFIED``).
        antialias: Read from a source halved until the target no longer minifies it by two or more.
        seam_width: Width of the blended band along a seam, as a fraction of the target's width; 0 switches blending
            off. Wider bands show double images of near objects, narrower ones the exposure step.
        overlap_depth: Correct the street's distances in every frame by stereo between overlapping cameras.
        sky: Find sky in photographs where no scan line of LiDAR returned (``scene.sky``).
        certainty: Store the geometry's accuracy in plans, one byte a pixel, for ``SampleKeys(extra=("confidence",))``.
        layers: Store holes' contents (``ViewPlan.holes``); ``RigRetarget`` sets it by ``holes``.
    """

    interpolation: Literal["nearest", "linear", "cubic"] = "cubic"
    antialias: bool = True
    seam_width: float = 0.03
    overlap_depth: bool = False
    sky: bool = False
    certainty: bool = False
    layers: bool = True

    def __post_init__(self) -> None:
        check_ranges(self, {"seam_width": (0.0, 0.5)})
        if self.interpolation not in ("nearest", "linear", "cubic"):
            raise ValueError(
                f"RenderConfig.interpolation: expected 'nearest', 'linear' or 'cubic', got {self.interpolation!r}"
            )


def check_ranges(config: Any, ranges: dict[str, tuple[float, float]]) -> None:
    """Raise ValueError for fields of a config outside their (lowest, highest) value, and flags that are not bool."""
    for flag in (entry.name for entry in fields(config) if isinstance(entry.default, bool)):
        if not isinstance(value := getattr(config, flag), bool):
            raise ValueError(f"{type(config).__name__}.{flag}: expected True or False, got {shown(value)}")
    for name, (low, high) in ranges.items():
        value = getattr(config, name)
        if not is_number(value) or not low <= value <= high:
            raise ValueError(f"{type(config).__name__}.{name}: expected {low:g} to {high:g}, got {shown(value)}")


PRESETS = {
    "draft": RenderConfig(interpolation="nearest", seam_width=0.0),
    "fast": RenderConfig(),
    "accurate": RenderConfig(overlap_depth=True, sky=True),
}
"""Settings by ``quality``."""


GRID_STEP_PX = 8
"""Spacing of the nodes between which weights are interpolated; positions are evaluated for every pixel."""

OUTSIDE = -16
"""Whole-pixel coordinate of a map entry that reads nothing: far enough that no bilinear tap touches the atlas."""

_MAX_ROWS = 32000  # remap needs int16 coordinates, and sizes below 32767


@dataclass(frozen=True)
class FixedMap:
    """A fixed-point sampling map: ``xy`` (h, w, 2) int16 and ``frac`` (h, w) uint16 (see the module's convention)."""

    xy: npt.NDArray[np.int16]
    frac: npt.NDArray[np.uint16]

    def rounded(self) -> FixedMap:
        """The same map at the nearest whole pixels."""
        nearest = np.stack([(self.frac & 31) >= 16, (self.frac >> 5) >= 16], -1).astype(np.int16)
        return FixedMap(self.xy + nearest, np.zeros_like(self.frac))

    def to_float(self) -> npt.NDArray[np.float32]:
        """The (h, w, 2) positions that are read."""
        fraction = np.stack([self.frac & 31, self.frac >> 5], -1).astype(np.float32) / np.float32(32)
        return np.asarray(self.xy + fraction, np.float32)

    @property
    def packed(self) -> npt.NDArray[np.int32]:
        """``xy`` as one number for each pixel, (h, w): y in the upper half, x in the lower; the same memory."""
        return self.xy.view(np.int32)[..., 0]


@dataclass(frozen=True)
class Slot:
    """Place of one source image in the atlas: halved ``level`` times, first pixel at (``x``, ``y``)."""

    source: int
    level: int
    y: int
    x: int
    size: tuple[int, int]


@dataclass(frozen=True)
class AtlasLayout:
    """The places of the source images that a plan reads."""

    slots: tuple[Slot, ...]  # one for each (source, level) in use

    @cached_property
    def size(self) -> tuple[int, int]:
        """(h, w) of the atlas."""
        corners = [(slot.y + slot.size[0], slot.x + slot.size[1]) for slot in self.slots]
        return max((1, *(y for y, _ in corners))), max((1, *(x for _, x in corners)))

    @cached_property
    def is_stack(self) -> bool:
        """Whether all are sources at full size in their order: an (N, H, W, 3) block of images *is* the atlas."""
        return all(slot.level == slot.x == 0 and slot.y == slot.source * slot.size[0] for slot in self.slots)

    @classmethod
    def for_sources(cls, sizes: Sequence[tuple[int, int]], used: Sequence[tuple[int, int]]) -> AtlasLayout:
        """Lay out the used (source, level) pairs: below each other, in further columns where rows run out.

        Sources of one size take their rows in a block of images, which may then serve as the atlas.

        Raises:
            CalibrationError: There are no more columns: 29 images of 7680x4320 px, read at their full size.
        """
        used = sorted(set(used), key=lambda pair: (pair[1] > 0, pair))
        (h, w), slots, y, x, column_width = sizes[0], list[Slot](), 0, 0, 0
        if len(set(sizes)) == 1 and len(sizes) * h <= _MAX_ROWS and any(level == 0 for _, level in used):
            slots = [Slot(source, 0, source * h, 0, (h, w)) for source, level in used if level == 0]
            y, column_width = len(sizes) * h, w
        for source, level in used[len(slots) :]:
            h, w = level_size(sizes[source], level)
            if y and y + h > _MAX_ROWS:
                x, y, column_width = x + column_width, 0, 0
            slots.append(Slot(source, level, y, x, (h, w)))
            y, column_width = y + h, max(column_width, w)
        layout = cls(tuple(slots))
        if layout.size[1] > MAX_SIZE_PX:
            raise CalibrationError(
                f"rig: expected source images that fit {_MAX_ROWS} rows and {MAX_SIZE_PX} columns together, got "
                f"{len(slots)} to read at once, up to {max(w for _, w in sizes)}x{max(h for h, _ in sizes)}; resize "
                "them, and their cameras by Rig.resized"
            )
        return layout

    def slot(self, source: int, level: int) -> Slot:
        """The place of one source at one level."""
        return next(s for s in self.slots if (s.source, s.level) == (source, level))


@dataclass(frozen=True)
class SourceUse:
    """How one target uses one source; ``explain`` prints it."""

    source: int  # index of the source camera in the source rig
    surface: str  # the surface its pixels are read over
    reason: str  # why that surface
    baseline_m: float  # distance between the two optical centres
    parallax_px: float  # expected displacement from unknown depth: the median over the pixels that the source wins
    share: float  # share of the target's pixels that it wins
    level: int  # halvings of its image before it is read


@dataclass(frozen=True)
class Seam:
    """The n pixels of a view into which a second source is blended."""

    pixel: npt.NDArray[np.int64]  # (n,) into the flattened view
    source: npt.NDArray[np.int8]  # (n,) index of the second source
    at: FixedMap  # (1, n) position in the atlas, in the second source
    weight: npt.NDArray[np.float32]  # (n,) share of the second source, at most 0.5


BACKGROUND, OCCLUDED, OBJECT = range(3)
"""Layers of a view's pixels: background that is seen, or outside all images; background that something hides; objects,
and pixels nearer than occluded background next to them."""

ROAD_M = 0.3
"""Maximum height of background that belongs to the road: kerbs, sidewalks and noise of LiDAR, metres."""

NEARER, NEARER_REACH = 1.5, 1 / 16
"""Factor by which pixels are nearer than occluded background to belong to something else, and distance from it within
which they are compared, as a share of the view's shorter side."""


def nearer_cells(size: tuple[int, int], step: int) -> int:
    """``NEARER_REACH`` of a view (h, w) in cells of ``step`` pixels, at least one."""
    return max(1, round(NEARER_REACH * min(size) / step))


@dataclass(frozen=True)
class Paint:
    """Parts of objects that no source sees, and where their colours are read in the view."""

    pixel: npt.NDArray[np.int32]  # (n,) int32 unseen pixels of objects, into the flattened view
    part: npt.NDArray[np.int32]  # (n,) int32 their parts: ``scene.boxes.BoxSurface.face_parts``
    sample: npt.NDArray[np.int32]  # (m,) int32 seen pixels of objects, a sample
    sample_part: npt.NDArray[np.int32]  # (m,) int32 their parts
    nearest: npt.NDArray[np.int32]  # (4, n) int32 seen pixels next to the unseen ones, ``paint_kernels.nearest_seen``


class HoleContents(NamedTuple):
    """Contents of a view's holes, for fillers.

    Attributes:
        layers: (h, w) uint8 layer of each pixel; None if all are ``BACKGROUND``.
        paint: Unseen parts of objects; None without ``layers`` or objects.
        road: (ny + 1, nx + 1) whether the background is road, up to ``ROAD_M`` high, on the planner's nodes: one a
            pixel in small views; None without holes, or where all is infinitely far away.
    """

    layers: npt.NDArray[np.uint8] | None = None
    paint: Paint | None = None
    road: BoolArray | None = None


@dataclass(frozen=True)
class ViewPlan:
    """How one target view is rendered."""

    at: FixedMap  # position of each pixel in the atlas, in its winning source
    source_camera: npt.NDArray[np.int8]  # (h, w) int8 index of the winning source, -1 where no source sees the pixel
    seam: Seam  # pixels that are blended
    pairs: tuple[SourceUse, ...]  # one for each source that wins any pixel
    interpolation: str = "linear"  # ``nearest``, ``linear`` or ``cubic``
    # (h, w) ``confidence.certainty`` of the winning source in 255ths, 0 where uncovered; on request
    certainty: npt.NDArray[np.uint8] | None = None
    # (n,) int64 pixels of the flattened view, ascending, that are read bilinearly, since cubics would reach outside the
    # source or onto its mask; None unless the view is cubic
    edge: npt.NDArray[np.int64] | None = None
    holes: HoleContents = HoleContents()  # noqa: RUF009 - immutable
    # (h, w) float32 inverse distances along the view's rays over measured or labelled geometry; None over others
    measured: npt.NDArray[np.float32] | None = None

    @property
    def coverage(self) -> BoolArray:
        """(h, w) True where some source sees the pixel."""
        return self.source_camera >= 0

    @property
    def sources(self) -> set[int]:
        """Indices of the source cameras that are read."""
        return {pair.source for pair in self.pairs} | set(np.unique(self.seam.source).tolist())

    @cached_property
    def seam_interpolation(self) -> str:
        """Interpolation of second sources; never cubic: a mean of two sources is no sharper for it."""
        return "linear" if self.interpolation == "cubic" else self.interpolation

    @cached_property
    def runs(self) -> npt.NDArray[np.int32]:
        """(n, 4) runs of pixels of one source in a row: row, first column, end and source, -1 for none."""
        from arbiview_aug.render.photometry_kernels import list_runs

        runs = np.empty((self.source_camera.size, 4), np.int32)
        return runs[: list_runs(self.source_camera, runs)].copy()


SEAM_ROWS = 16
"""Parts of a view's height in which the sources along a seam are compared."""

_SEAM_SAMPLES = 90  # along a view's width


class SharedPixels(NamedTuple):
    """Pixels that two source cameras show, in G groups."""

    source: npt.NDArray[np.int64]  # (2, n) both cameras
    at: npt.NDArray[np.int64]  # (2, n, 2) row and column in each
    ends: npt.NDArray[np.int64]  # (G + 1,) first pixel of each group, and the end of the last group


class SeamSamples(NamedTuple):
    """A sample of the pixels that two sources of a view show, in groups by sources and part of the view's height.

    The better source, which comes first, wins more of the view. A seam is all groups of another source of the view.
    """

    shared: SharedPixels
    better: npt.NDArray[np.int64]  # (G,) the better source
    part: npt.NDArray[np.int64]  # (G,) part of the height
    seams: list[list[int]]  # view, other source, first group and end; sources that win more come first


def bytes_of(value: Any) -> int:
    """Memory in bytes of the arrays and tensors in plain data."""
    if hasattr(value, "nbytes"):
        return int(value.nbytes)
    parts = value if isinstance(value, tuple | list) else list(vars(value).values()) if is_dataclass(value) else ()
    return sum(map(bytes_of, parts))


@dataclass(frozen=True)
class RenderPlan:
    """Everything needed to render a target rig from a source rig's images; plain data, picklable."""

    source: Rig
    target: Rig  # in the source's ego frame, on the source's road
    layout: AtlasLayout  # the sources' places in the atlas
    targets: tuple[ViewPlan, ...]  # one plan for each target camera
    config: RenderConfig  # its settings
    # The maps as tensors, by device (``torch_backend.maps_on``); not pickled.
    on_devices: dict[Any, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "on_devices": {}}

    @property
    def nbytes(self) -> int:
        """Memory of the maps in bytes, on devices too."""
        return bytes_of((self.targets, list(self.on_devices.values())))

    @cached_property
    def seam_samples(self) -> SeamSamples:
        """A sample of the blended pixels, as two sources show them."""
        slots = np.array([(s.x, s.y, *s.size[::-1], s.source, s.level) for s in self.layout.slots])
        first, source, level = slots[:, :2], slots[:, 4], slots[:, 5]
        rank, samples = np.full((len(self.targets), len(self.source)), len(self.source)), []
        for number, plan in enumerate(self.targets):
            rank[number, [pair.source for pair in plan.pairs]] = range(len(plan.pairs))  # wins more: comes first
            (h, w), sampled = plan.source_camera.shape, np.zeros(plan.source_camera.shape, bool)
            sampled[:: max(1, w // _SEAM_SAMPLES), :: max(1, w // _SEAM_SAMPLES)] = True
            k = np.flatnonzero(sampled.reshape(-1)[plan.seam.pixel])
            pixel = plan.seam.pixel[k]
            both = plan.at.xy.reshape(-1, 2)[pixel], plan.seam.at.xy[0, k]
            samples.append(np.column_stack([np.full(len(k), number), pixel // w * SEAM_ROWS // h, *both]))
        view, part, *xy = np.concatenate(samples).T
        places = np.reshape(xy, (2, 2, -1)).transpose(0, 2, 1)  # (2, n, 2) in the atlas
        within = ((places[:, :, None] >= first) & (places[:, :, None] < first + slots[:, 2:4])).all(-1)
        known = within.any(-1).all(0)  # but rounded ones next to their slot
        slot, view, part = within[:, known].argmax(-1), view[known], part[known]
        halvings = level[slot][..., None]
        at = (places[:, known] - first[slot] << halvings)[..., ::-1] + (1 << halvings) // 2
        order = np.argsort(rank[view, source[slot]], axis=0, kind="stable")
        better, other = cameras = np.take_along_axis(source[slot], order, 0)
        at = np.take_along_axis(at, order[..., None], 0)
        shape = len(self.targets), *(len(self.source) + 1,) * 3, SEAM_ROWS
        keys = np.ravel_multi_index((view, rank[view, other], other, better, part), shape)
        order = np.argsort(keys, kind="stable")
        keys = keys[order]
        starts = np.flatnonzero(np.diff(keys, prepend=-1))
        views, _, other, better, part = np.unravel_index(keys[starts], shape)
        changes = np.flatnonzero(np.diff(keys[starts] // (shape[3] * SEAM_ROWS), prepend=-1))
        ends = np.append(changes, len(starts))[1:]
        seams = np.column_stack([views[changes], other[changes], changes, ends]).tolist()
        cameras, at = (np.take(part, order, axis=1) for part in (cameras, at))  # contiguous, for kernels
        shared = SharedPixels(cameras, at, np.append(starts, len(keys)))
        return SeamSamples(shared, better, part, seams)

    @property
    def coverage(self) -> list[BoolArray]:
        """(h, w) for each target camera."""
        return [t.coverage for t in self.targets]
