"""Depth of a network of transformers, fitted to metres by known points of the frame.

A network predicts depth up to a scale and a shift, or assumes a focal length. Both are fitted for each camera, robustly
and in inverse depth, to LiDAR points, else to depth from motion, else to the road below the camera. A camera whose fit
fails stays without learned depth.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import cv2
import numpy as np
import torch

from arbiview_aug.atomic_io import checksum
from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.choices import Reference
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import DataError
from arbiview_aug.files import check_regular
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import MOTION_KEY
from arbiview_aug.scene.boxes import draw_boxes
from arbiview_aug.scene.depth_map import motion_camera
from arbiview_aug.scene.surface import Layer, plane_inverse_distance
from arbiview_aug.temporal.motion_depth import FARTHEST_M, MotionDepth

LEAST_POINTS = 50
"""Minimum number of pixels to fit a camera to."""

MAX_RESIDUAL = 0.15
"""Maximum median error of a fit, relative to inverse depth."""

MAX_OF_CONSTANT = 0.5
"""Maximum residual, relative to fitting one depth for all pixels; above it the network is uninformative."""

_ROAD_M = 15.0  # the road is fitted up to this distance: farther on, slopes and traffic hide the plane
_RELATIVE_M = 50.0  # errors are relative to inverse depth, but not to less than that of this depth
_NEAREST_M = 0.5
_CELL_PX = 4  # of several LiDAR points in a cell, the nearest counts: the others may be occluded
_OUTLIER, _HUBER = 0.2, 0.02  # relative errors: beyond the first a point has no weight, below the second all of it
_PAIRS, _MOST_POINTS = 256, 4000


@dataclass(frozen=True, eq=False)
class LearnedDepth(MotionDepth):
    """Depth maps of a network; ``words`` name the model and each camera's fit."""

    def __str__(self) -> str:
        return f"learned depth: {self.density:.0%} of the pixels, {self.words}"


Output = Literal["depth", "inverse"] | None
"""Output of a network: depth, inverse depth, or None if the fit decides."""


class CameraFit(NamedTuple):
    """Fit of a camera's prediction to metres, or the reason why it was declined."""

    camera: str
    reference: Reference | None = None
    points: int = 0
    residual: float | None = None  # median error, relative to inverse depth
    declined: str = ""

    def __str__(self) -> str:
        fit = f"fitted to {self.points} points of {self.reference}, residual {self.residual or 0:.1%}"
        if not self.declined:
            return f"{self.camera}: {fit}"
        return f"{self.camera}: declined, {self.declined}{'' if self.residual is None else f' ({fit})'}"


def learned_depth(
    model: TransformersDepth,
    frames: Sequence[Frame],
    batch: int,
    wanted: Sequence[Reference] = get_args(Reference),
) -> Iterator[tuple[LearnedDepth, list[CameraFit]]]:
    """Predict the depth of frames, ``batch`` images at a time, and fit it to their geometry.

    Each camera is fitted to the first reference of ``wanted`` with enough points: (P, 3) points of the frame, its depth
    from motion at the size of ``motion_camera``, or the road without labelled objects (B, 7).
    """
    images = {(n, k): _pinhole_image(f.rig[k], f.images[k]) for n, f in enumerate(frames) for k in range(len(f.rig))}
    predictions: dict[tuple[int, int], Layer] = {}
    for shape in dict.fromkeys(image.shape for image in images.values()):
        keys = [key for key, image in images.items() if image.shape == shape]
        for part in (keys[start : start + batch] for start in range(0, len(keys), batch)):
            predictions |= zip(part, model.predict([images[key] for key in part]), strict=True)
    for n, frame in enumerate(frames):
        fitted = [_fit_camera(frame, k, predictions[n, k], model.output, wanted) for k in range(len(frame.rig))]
        depth_m, fits = zip(*fitted, strict=True)
        lines = [f"{model.name}, revision {model.revision}, licence {model.licence}", *map(str, fits)]
        yield LearnedDepth(depth_m, "\n  ".join(lines)), list(fits)


def _pinhole_image(camera: Camera, image: torch.Tensor) -> torch.Tensor:
    """A copy (3, h, w) uint8 of a camera's image, its lens taken out: networks know pinhole images."""
    image = image.clone() if image.dtype == torch.uint8 else (image * 255).round().to(torch.uint8)
    if camera.is_rectilinear:
        return image
    rays = camera.undistorted().unproject_cam(camera.pixel_grid()).directions
    uv = camera.project_cam(rays).uv.astype(np.float32)
    pixels: Any = cv2.remap(image.permute(1, 2, 0).numpy(), uv, None, cv2.INTER_LINEAR)  # type: ignore[call-overload]
    return torch.from_numpy(pixels).permute(2, 0, 1)


def _sampled(camera: Camera, values: Layer) -> tuple[Layer, BoolArray]:
    """A prediction over a camera's pinhole image at the pixels of its depth map, and where it is known."""
    pinhole, camera = camera.undistorted(), motion_camera(camera)
    rays, valid = camera.unproject_cam(camera.pixel_grid())
    uv, z, _ = pinhole.project_cam(np.where(valid[..., None], rays, [0.0, 0.0, 1.0]))
    seen = valid & (z > 0) & pinhole.contains(uv, 0.5)
    if camera.mask is not None:
        seen &= camera.mask
    scale = np.array(values.shape[::-1]) / pinhole.size[::-1]
    at = ((uv + 0.5) * scale - 0.5).astype(np.float32)
    layer: Any = cv2.remap(values, at, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[call-overload]
    return layer, seen & np.isfinite(layer)


# --- references of depth ----------------------------------------------------------------------------------------------
def measured_pixels(camera: Camera, points: FloatArray) -> tuple[Any, FloatArray]:
    """Pixels (rows, columns) of LiDAR points that a camera sees, and their z-depths."""
    uv, z, valid = camera.project(points[:, :3])
    seen = np.flatnonzero(valid & (z > _NEAREST_M) & (z < FARTHEST_M) & camera.contains(uv))
    column, row = np.round(uv[seen]).astype(int).T
    order = np.argsort(z[seen], kind="stable")
    cell = (row // _CELL_PX * camera.width_px + column // _CELL_PX)[order]
    nearest = order[np.unique(cell, return_index=True)[1]]
    return (row[nearest], column[nearest]), z[seen][nearest]


def _references(frame: Frame, k: int, seen: BoolArray) -> Iterator[tuple[Reference, Any, FloatArray]]:
    """Measurements that a camera may be fitted to: their name, pixels (rows, columns) and z-depths."""
    camera = motion_camera(frame.rig[k])
    if frame.points is not None:
        pixels, depth_m = measured_pixels(camera, frame.points)
        ask = seen[pixels]
        yield "LiDAR", tuple(index[ask] for index in pixels), depth_m[ask]
    if MOTION_KEY in frame.depth:
        moved_m = frame.depth[MOTION_KEY][k]
        pixels = np.nonzero(seen & (moved_m > 0))
        yield "motion", pixels, moved_m[pixels].astype(float)
    rays, _ = camera.unproject(camera.pixel_grid())
    q = plane_inverse_distance(camera.center_m, rays, frame.rig.ground_z_m)
    road_m = np.divide(rays @ camera.cam2ego[:3, 2], q, out=np.full(q.shape, np.inf), where=q > 0)  # inf above it
    near = seen & (road_m > _NEAREST_M) & (road_m < _ROAD_M)
    if frame.boxes is not None and len(frame.boxes):
        near &= draw_boxes(camera, frame.boxes)[1] < 0
    yield "road", np.nonzero(near), road_m[near]


# --- fits -------------------------------------------------------------------------------------------------------------
_Form = Literal["inverse", "depth", "affine depth"]
"""Inverse depth is affine in the output, or in its inverse; or depth is affine in it."""

_FORMS: Mapping[str | None, tuple[_Form, ...]] = {"inverse": ("inverse",), "depth": ("depth", "affine depth")}


class _Line(NamedTuple):
    """A fit ``scale * x + shift`` of inverse depth, or for ``affine depth`` of depth."""

    form: _Form
    scale: float
    shift: float

    def depth(self, values: FloatArray) -> FloatArray:
        """Metres of a network's output; inf where it is behind infinity, 0 where it is behind the camera."""
        depth = self.scale * _feature(self.form, values) + self.shift
        with np.errstate(divide="ignore"):
            return np.maximum(depth, 0) if self.form == "affine depth" else np.where(depth > 0, 1 / depth, np.inf)


def _feature(form: _Form, values: FloatArray) -> FloatArray:
    return 1 / np.maximum(values, 1e-6) if form == "depth" else values


def _fit_camera(
    frame: Frame, k: int, prediction: Layer, output: Output, wanted: Sequence[Reference]
) -> tuple[Layer, CameraFit]:
    """The depth map of a frame's camera and its fit; 0 everywhere if it is declined."""
    values, seen = _sampled(frame.rig[k], prediction)
    nothing, name = np.zeros(values.shape, np.float32), frame.rig[k].name
    references = _references(frame, k, seen)
    known = next((part for part in references if part[0] in wanted and len(part[2]) >= LEAST_POINTS), None)
    if known is None:
        return nothing, CameraFit(name, declined=f"fewer than {LEAST_POINTS} points of {', '.join(wanted)}")
    reference, pixels, depth_m = known
    step = -(-len(depth_m) // _MOST_POINTS)
    x, depth_m = values[pixels][::step].astype(float), depth_m[::step]
    line, residual, declined = fit_depth(x, depth_m, output)
    fit = CameraFit(name, reference, len(depth_m), residual, declined)
    if line is None or declined:
        return nothing, fit
    metres = line.depth(np.where(seen, values, 1.0).astype(float))
    return np.where(seen & (metres > _NEAREST_M), metres.clip(max=FARTHEST_M), 0).astype(np.float32), fit


def fit_depth(values: FloatArray, depth_m: FloatArray, output: Output) -> tuple[_Line | None, float | None, str]:
    """Fit a network's output (P,) to depths (P,): the fit, its residual, and why it is declined, or nothing."""
    if np.ptp(values) == 0:
        return None, None, "its output is the same everywhere"
    fits: list[tuple[float, float, _Line]] = []
    for form in _FORMS.get(output, get_args(_Form)):
        x, y = _feature(form, values), depth_m if form == "affine depth" else 1 / depth_m
        limit = np.minimum(y, _RELATIVE_M) if form == "affine depth" else np.maximum(y, 1 / _RELATIVE_M)
        scale, shift = _robust_line(x, y, 1 / limit)
        if scale > 0:
            residual = float(np.median(np.abs(scale * x + shift - y) / limit))
            fits.append((residual, float(np.median(np.abs(np.median(y) - y) / limit)), _Line(form, scale, shift)))
    if not fits:
        return None, None, "near and far are swapped, or look alike: the scale is not positive"
    residual, constant, line = min(fits)
    if residual > MAX_RESIDUAL:
        return line, residual, f"it errs by more than {MAX_RESIDUAL:.0%}"
    if residual > MAX_OF_CONSTANT * constant:  # a fit may turn noise into a constant
        return line, residual, "it is hardly better than one depth for all pixels"
    return line, residual, ""


def _robust_line(x: FloatArray, y: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Scale and shift by RANSAC with a truncated cost, refined by Huber weights on the inliers."""
    first, second = np.random.default_rng(0).integers(len(x), size=(2, _PAIRS))
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = (y[second] - y[first]) / (x[second] - x[first])
        shift = y[first] - scale * x[first]
        cost = np.minimum(np.abs(scale[:, None] * x + shift[:, None] - y) * weight, _OUTLIER).mean(1)
    best = int(np.nanargmin(cost))
    line = np.array([scale[best], shift[best]])
    columns = np.stack([x, np.ones_like(x)], 1)
    for _ in range(10):
        error = np.abs(columns @ line - y) * weight
        spread = float(np.median(error[error < _OUTLIER]))
        # A sidewalk is a plane too, a tenth nearer than the road: exact predictions must not be drawn to it.
        trusted = error < np.clip(4 * spread, _HUBER, _OUTLIER)
        trust = weight * np.sqrt(np.where(trusted, np.minimum(1, _HUBER / np.maximum(error, 1e-9)), 0))
        line = np.linalg.lstsq(columns * trust[:, None], y * trust, rcond=None)[0]
    return float(line[0]), float(line[1])


# --- networks of transformers -----------------------------------------------------------------------------------------
_PARTS = {
    "AutoConfig": "a folder with config.json, or a model of the Hugging Face Hub",
    "AutoModelForDepthEstimation": "a model that estimates depth, and its weights, "
    "for example depth-anything/Depth-Anything-V2-Metric-Outdoor-Small-hf",
    "AutoImageProcessor": "preprocessor_config.json next to the model",
}
"""Parts of a model, by their classes in transformers, and what each needs."""


class TransformersDepth:
    """A model of ``AutoModelForDepthEstimation``, with its image processor.

    Args:
        name: A folder, or a name on the Hugging Face Hub.
        device: Device that it runs on.

    Raises:
        DataError: transformers is not installed, there is no such model, or it does not estimate depth.
    """

    def __init__(self, name: str, device: torch.device | str = "cpu") -> None:
        try:
            transformers = optional_package("transformers", "depth")
        except ImportError as error:
            raise DataError(f"--model: {error}") from None
        folder, loaded = Path(name), []
        for kind, expected in _PARTS.items():
            try:
                check_regular(name)
                loaded.append(getattr(transformers, kind).from_pretrained(name))
            except Exception as error:  # of many types, some of many lines
                why = next((line for line in str(error).splitlines() if line.strip()), type(error).__name__)
                raise DataError(f"--model {name}: expected {expected}: {why.strip()[:300]}") from None
        config, model, self._processor = loaded
        self.model, self.device = model.float().eval().to(device), device
        commit = str(getattr(config, "_commit_hash", None) or "unknown")[:12]
        self.name, self.revision, card = name, commit, name
        if folder.is_dir():
            files = sorted(path for pattern in ("*.safetensors", "*.bin") for path in folder.glob(pattern))
            self.revision = hashlib.sha256("".join(map(checksum, files)).encode()).hexdigest()[:12]
            self.name, card = folder.resolve().name, str(folder / "README.md")
        try:
            self.licence = str(optional_package("huggingface_hub").ModelCard.load(card).data.license or "unknown")
        except Exception:  # no card, no network, a card that cannot be read
            self.licence = "unknown"
        stated = getattr(config, "depth_estimation_type", "")
        self.output: Output = {"metric": "depth", "relative": "inverse"}.get(stated)  # type: ignore[assignment]

    @torch.inference_mode()
    def predict(self, images: Sequence[torch.Tensor]) -> list[Layer]:
        """Predict the depth of images (3, h, w) uint8 of one size in one batch.

        Raises:
            DataError: The batch does not fit on the device.
        """
        inputs = self._processor(images=list(images), return_tensors="pt").to(self.device)
        try:
            out = self.model(**inputs)
        except torch.OutOfMemoryError:
            raise DataError(f"--batch: {len(images)} images do not fit on {self.device}; halve it") from None
        size = tuple(images[0].shape[-2:])
        done = self._processor.post_process_depth_estimation(out, [size] * len(images))  # takes padding away
        return [entry["predicted_depth"].float().cpu().numpy() for entry in done]
