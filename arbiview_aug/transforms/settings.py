"""Settings of transforms, checked."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

from arbiview_aug import favs
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.framing import Fit
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import MAX_SIZE_PX, is_mounted
from arbiview_aug.choices import choice, is_number
from arbiview_aug.environment import imported
from arbiview_aug.errors import GeometryWarning, SampleError, WarnOnce, shown
from arbiview_aug.inpaint.inpainter import SOURCES_KEY, Black, Inpainter
from arbiview_aug.render.plan import PRESETS, RenderConfig
from arbiview_aug.sample.inputs import CALIBRATION_KEYS, camera_findings

T = TypeVar("T")

EXTRA_KEYS = ("source_camera", "source_frame", "confidence", SOURCES_KEY)


@dataclass(frozen=True, kw_only=True)
class SampleKeys:
    """How a transform treats the keys of a sample.

    Attributes:
        labels: Keys of label maps (..., N, H, W), or lists of them, to render besides ``tv_tensors.Mask``.
            ``RigRetarget`` refuses names of depth, disparity, flow and normals, which depend on the camera.
        ignore_index: Value of label pixels that no source sees (False for bool maps).
        keep: Keys to keep although they look bound to the source's pixels; those that the output writes are replaced.
        extra: Further maps (..., M, h, w) of the output: ``source_camera`` int8, -1 where uncovered; ``source_frame``
            int8, 0 for the current frame, n + 1 for number n of the neighbours; ``confidence`` float32 in [0, 1],
            exp(-e / 10) for an expected error of e grey levels of 255 (``arbiview_aug.render.confidence``). Also
            ``sources``: the source images and calibration, for ``Inpainter.complete_batch``.
        frame: Ego frame of output poses, points and boxes. ``target`` moves them, and ``ego2world``, into the target's
            and adds ``ego2ego`` (..., 4, 4).
        points: ``target``: as its scanners would have measured them, if it has any. ``source``: unchanged.

    Raises:
        ValueError: Impossible values.
    """

    labels: tuple[str, ...] = ()
    ignore_index: float = 255
    keep: tuple[str, ...] = ()
    extra: tuple[str, ...] = ()
    frame: Literal["source", "target"] = "source"
    points: Literal["source", "target"] = "target"

    def __post_init__(self) -> None:
        for name in ("labels", "keep", "extra"):
            value = getattr(self, name)
            if not isinstance(value, list | tuple) or not all(isinstance(key, str) for key in value):
                raise ValueError(f"SampleKeys.{name}: expected names in a list or tuple, got {shown(value)}")
            object.__setattr__(self, name, tuple(value))
        if keys := {*self.labels} & {*CALIBRATION_KEYS}:
            raise ValueError(f"SampleKeys.labels: expected keys of label maps, got {', '.join(sorted(keys))}")
        if keys := {*self.keep} & {"rig", "lens", "distortion"}:
            raise ValueError(f"SampleKeys.keep: expected no calibration of the source's, got {', '.join(sorted(keys))}")
        for key in self.extra:
            choice("SampleKeys.extra", key, EXTRA_KEYS)
        if not is_number(self.ignore_index):
            raise ValueError(f"SampleKeys.ignore_index: expected a number, got {self.ignore_index!r}")
        for name in ("frame", "points"):
            choice(f"SampleKeys.{name}", getattr(self, name), ("source", "target"))


@dataclass(frozen=True)
class PlanCache:
    """Plans of calibrations that come back. Pickles and copies are empty: each DataLoader worker fills its own.

    Attributes:
        max_bytes: Memory for these plans; the least recently used go first. ValueError if it is no number from 0.
    """

    max_bytes: int = 512 * 2**20

    def __post_init__(self) -> None:
        if not is_number(self.max_bytes) or not self.max_bytes >= 0:
            raise ValueError(f"PlanCache.max_bytes: expected a number of bytes from 0, got {shown(self.max_bytes)}")


def render_config(quality: Any) -> Any:
    """A preset by its name, or the ``RenderConfig`` or ``PaperConfig`` itself; ValueError for anything else."""
    if isinstance(quality, str) and quality in (*PRESETS, "paper"):
        return PRESETS[quality] if quality in PRESETS else favs.PaperConfig()
    if isinstance(quality, RenderConfig) or isinstance(quality, favs.PaperConfig):
        return quality
    expected = f"expected one of {', '.join(PRESETS)}, paper, a RenderConfig or a PaperConfig"
    raise ValueError(f"quality: {expected}, got {shown(quality)}")


def inpainter_of(holes: Any) -> Inpainter:
    """The inpainter of a name, or the inpainter itself; ValueError for anything else."""
    if isinstance(holes, Inpainter):
        return holes
    if not isinstance(holes, str):
        raise ValueError(f"holes: expected a name or an arbiview_aug.inpaint.Inpainter, got {type(holes).__name__}")
    inpainter: Inpainter = imported(f"arbiview_aug.{_INPAINTERS[choice('holes', holes, _INPAINTERS)]}")()
    return inpainter


_INPAINTERS = {
    "continue": "inpaint.continued:Continue",
    "telea": "inpaint.inpainter:Telea",
    "mean": "inpaint.continued:Mean",
    "black": "inpaint.inpainter:Black",
    "diffusion": "generator.completion:Diffusion",
}


def unseen_note(inpainter: Inpainter) -> str:
    """Note on pixels that no source sees, and on their use in training."""
    marked = " and marked in 'generated': leave it out of losses that compare pixels"
    return f"The rest is {inpainter.outcome}{'' if isinstance(inpainter, Black) else marked}."


def checked_instance(name: str, value: Any, kind: type[T]) -> T:
    """Return ``value`` if it is an instance of ``kind``; ValueError for anything else."""
    if not isinstance(value, kind):
        raise ValueError(f"{name}: expected a {kind.__name__}, got {type(value).__name__}")
    return value


def checked_probability(p: Any) -> float:
    """A number from 0 to 1; ValueError for anything else."""
    if not is_number(p) or not 0 <= p <= 1:
        raise ValueError(f"p: expected a probability from 0 to 1, got {shown(p)}")
    return float(p)


def checked_params(params: Any) -> dict[str, float]:
    """``retarget_params`` as plain numbers; SampleError for anything else."""
    try:
        return {name: float(value) for name, value in params.items()}  # tensors in a collated batch
    except (AttributeError, TypeError, ValueError, RuntimeError):
        pass
    raise SampleError(f"params: expected the 'retarget_params' of an output, names and numbers, got {shown(params)}")


def checked_pixels(value: Any) -> tuple[int, int]:
    """A size (h, w) in whole pixels; ValueError for others."""
    try:
        h, w = (operator.index(number) for number in value)  # 10.5 is refused, not cut
    except (TypeError, ValueError):
        h = w = -1
    if not 1 <= min(h, w) <= max(h, w) <= MAX_SIZE_PX:
        limits = f"whole numbers from 1 to {MAX_SIZE_PX}"
        raise ValueError(f"size: expected (h, w) in pixels, got {shown(value)}; {limits}")
    return h, w


_LEAST_KEPT = 0.5
"""Share of a view below which a size is probably a mistake. Rows may be fewer, down to the horizon: detectors cut the
sky."""


def size_mistake(rig: Rig, size: tuple[int, int], fit: Fit) -> str | None:
    """Say what (h, w) and ``fit`` cost most cameras of a target, and the fix; None if enough remains."""
    lost = [text for camera in rig if (text := _lost(camera, size, fit))]
    if len(lost) < len(rig) / 2:
        return None
    fix = "choose a size of the images' shape, or " + ("'pad' or 'stretch'" if fit == "crop" else "'crop'")
    if not any(_lost(camera, size[::-1], fit) for camera in rig):
        fix = f"size is (h, w): did you mean {size[::-1]}"
    return f"size={size}, fit={fit!r}: {lost[0]}; {fix}?"


def _lost(camera: Camera, size: tuple[int, int], fit: Fit) -> str:
    """Loss of a camera whose view keeps less than ``_LEAST_KEPT``, or not its optical axis; empty otherwise."""
    ratio = size[0] * camera.width_px / (size[1] * camera.height_px)
    share = min(ratio, 1 / ratio)
    if share >= _LEAST_KEPT:
        return ""
    if fit != "crop":
        how = f"are squeezed to {share:.0%} along one side" if fit == "stretch" else f"fill {share:.0%} of the view"
        return f"images of {camera.name!r} {how}"
    cropped = camera.resize(size, fit)
    if cropped.K[1, 2] < 0 <= camera.K[1, 2]:
        return f"{camera.name!r} loses its horizon, {-cropped.K[1, 2]:.0f} rows above the view"
    fov_deg, kept_deg = camera.fov_deg[0], cropped.fov_deg[0]  # of the outer edges, which a lens may crowd together
    if kept_deg >= _LEAST_KEPT * fov_deg:
        return ""
    return f"{camera.name!r} keeps {kept_deg:.0f} of its {fov_deg:.0f} degrees across"


def warn_of_target(target: Rig, warn: WarnOnce) -> None:
    """Warn once of target cameras that no vehicle has."""
    for camera, mounted in zip(target, is_mounted(target.cam2ego, target.ground_z_m), strict=True):
        if not mounted:
            x, y, z = camera.center_m - (0, 0, target.ground_z_m)
            got = f"({x:.1f}, {y:.1f}) m, {z:.1f} m above the road; are moves and poses in metres?"
            warn(
                "mounting", f"target camera {camera.name!r}: expected a place on a vehicle, got {got}", GeometryWarning
            )
    for finding in camera_findings(target):
        warn("target focal", f"target {finding}", GeometryWarning)
