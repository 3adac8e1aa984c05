"""Protocol of inpainters, which fill pixels that no source shows; black, and Telea's fast marching."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

import cv2
import numpy as np
import torch

from arbiview_aug.choices import is_number, is_whole
from arbiview_aug.errors import GeneratorError, SampleError, shown
from arbiview_aug.image_ops import bounding_box
from arbiview_aug.render.rendered import MAP_KEYS, LabelFill, Views
from arbiview_aug.sample.batching import gathered, leading_shape, rewrapped, split, stacked
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import read_frames

Tensors = Sequence[torch.Tensor]

RADIUS_PX = 3.0  # radius of Telea's neighbourhood, from OpenCV's example
_MARGIN_PX = 8  # margin around holes that Telea's method reads
GREY = 0.5  # value of images without known pixels

SOURCES_KEY = "sources"
"""Sample key of the source images and calibration, for inpainting after collating."""


class Inpainter:
    """Fills the holes of rendered views. A new one defines ``inpaint``; ``RigRetarget(holes=...)`` takes it.

    Attributes:
        min_confidence: Pixels that sources show with less confidence are filled too, 0 to 1.
        seed: Seed of random pixels, combined with the frame (its ``token``, else its images) and the camera.
        outcome: End of the warning "The rest is ...".
        is_random: Whether ``inpaint`` reads its seeds.
        needs_confidence: Whether frames must bring their confidence.
        needs_layers: Whether frames must bring what is in their holes (``Views.holes``).
        fills_own_car: Whether ``inpaint`` gets the own car, which is black, as a hole too, so that it does not bleed.
    """

    min_confidence: float = 0.0
    seed: int = 0
    outcome: ClassVar[str] = "inpainted"
    is_random: ClassVar[bool] = False
    needs_layers: ClassVar[bool] = False
    fills_own_car: ClassVar[bool] = False

    @property
    def needs_confidence(self) -> bool:
        return self.min_confidence > 0

    def inpaint(self, views: Tensors, holes: Tensors, seeds: Sequence[int]) -> list[torch.Tensor]:
        """Fill the holes (h, w) bool of views (3, h, w), uint8 or float in [0, 1], of any frames together.

        Args:
            views: Copies of the views, black where no source shows a pixel; they may differ in size.
            holes: Copies of the pixels to fill; all others of the result are ignored.
            seeds: A seed for each view.
        """
        raise NotImplementedError(f"{type(self).__name__} fills whole frames: call fill")

    def _inpaint(self, views: Tensors, holes: Tensors, seeds: Sequence[int], counts: Sequence[int]) -> Any:
        """``inpaint`` of copies, into which it may write; ``counts`` are how many views each frame has."""
        return self.inpaint([view.clone() for view in views], [hole.clone() for hole in holes], seeds)

    def fill(self, rendered: Sequence[Views], frames: Sequence[Frame]) -> list[Views]:
        """Fill rendered ``frames``.

        Filled pixels are no longer covered: ``coverage`` False, ``confidence`` 0, ``source_camera`` and
        ``source_frame`` -1, label maps as where nothing is covered. Gradients of the others stay.
        """
        parts = [holes_of(frame, self.min_confidence) for frame in rendered]
        unknown = [~seen if self.fills_own_car else hole for maps in parts for seen, hole in zip(*maps, strict=True)]
        names = frame_names(frames) if self.is_random else [""] * len(frames)
        named = zip(names, rendered, strict=True)
        seeds = [seeded(self.seed, name, str(k)).initial_seed() for name, frame in named for k in range(len(frame.rig))]
        views = [view for frame in rendered for view in frame.images]
        with torch.no_grad():
            images = self._inpaint(views, unknown, seeds, [len(frame.rig) for frame in rendered])
        filled = iter(_checked(type(self).__name__, images, views, unknown))
        frames_and_holes = zip(rendered, parts, strict=True)
        return [put(frame, [next(filled) for _ in holes], holes) for frame, (_, holes) in frames_and_holes]

    def complete_batch(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """Fill collated samples, on the device of a network: DataLoader workers cannot use a GPU.

        The pixels equal those of ``RigRetarget(holes=self)`` up to rounding, since frames are computed together.
        ``Continue``, and generators that correct its result, give other pixels: batches hold no layers of holes. Label
        maps are not named either: with ``min_confidence``, ignore labels where ``generated`` is True.

        Args:
            batch: From ``RigRetarget(..., keys=SampleKeys(extra=("sources", "confidence")))``: a sample or a batch.

        Returns:
            A new dict without ``sources``, with ``generated``. Bars and the own car (``ego_mask``) stay black.

        Raises:
            SampleError: The batch lacks the sources, the coverage or the confidence, or maps are not the views'.
            GeneratorError: Impossible settings.
        """
        missing = [key for key in ("images", "coverage", "confidence", SOURCES_KEY) if batch.get(key) is None]
        if missing:
            raise SampleError(
                f"complete: expected {', '.join(missing)} in the batch: retarget with "
                "keys=SampleKeys(extra=('sources', 'confidence'))"
            )
        sources = read_frames({**batch[SOURCES_KEY], "token": batch.get("token")}, None, names=("token",))
        views = read_frames({key: value for key, value in batch.items() if key != "coverage"}, None)
        lead = leading_shape(batch["images"])
        if len(sources) != len(views):
            raise SampleError(f"complete: expected sources of {len(views)} frames, got {len(sources)}")
        maps = {key: split(key, batch[key], lead) for key in MAP_KEYS if key in batch and key != "generated"}
        rendered = []
        for b, view in enumerate(views):
            frame_maps = {key: frames[b] for key, frames in maps.items()}
            for key, tensors in frame_maps.items():
                _check_maps(f"complete: {key}: frame {b}", tensors, view.images, key == "coverage")
            rendered.append(Views(_black_without(frame_maps["coverage"], view.images), view.rig, **frame_maps))
        done = []
        for frame in self.fill(rendered, sources):  # black and not marked where only the own car is
            _, holes = holes_of(frame, 0)
            shown = [seen | hole for seen, hole in zip(frame.coverage, holes, strict=True)]
            done.append(replace(frame, images=_black_without(shown, frame.images), generated=stacked(holes)))
        out = {key: value for key, value in batch.items() if key != SOURCES_KEY}
        for key in (*maps, "generated"):
            out[key] = gathered([getattr(frame, key) for frame in done], lead)
        out["images"] = rewrapped(gathered([stacked(frame.images) for frame in done], lead), batch["images"])
        return out


def _black_without(shown: Iterable[torch.Tensor], images: Tensors) -> list[torch.Tensor]:
    """Copies of images, black where they are not shown (h, w)."""
    return [torch.where(mask, image, 0) for mask, image in zip(shown, images, strict=True)]


def _check_maps(where: str, maps: Any, images: Tensors, is_mask: bool) -> None:
    """Raise SampleError unless maps are tensors (h, w) of the images' sizes, of bool if they are masks."""
    maps = maps if isinstance(maps, torch.Tensor | list | tuple) else [maps]
    got = [(getattr(m, "dtype", type(m)), tuple(getattr(m, "shape", ()))) for m in maps]
    sizes = [tuple(image.shape[-2:]) for image in images]
    is_typed = all(isinstance(kind, torch.dtype) and (kind == torch.bool) == is_mask for kind, _ in got)
    if not is_typed or [size for _, size in got] != sizes:
        expected = f"{'bool' if is_mask else 'numbers'} of the images' sizes {sizes}"
        found = [f"{kind} {size}" for kind, size in got]
        raise SampleError(f"{where}: expected {expected}, got {found}: pass what RigRetarget wrote")


def _checked(name: str, images: Any, views: Tensors, holes: Tensors) -> list[torch.Tensor]:
    """The images that an inpainter made of views, float ones cut to [0, 1]; GeneratorError if they do not fit."""
    images = list(images) if isinstance(images, Iterable) else [images]
    got, expected = (
        [f"{getattr(x, 'dtype', type(x).__name__)} {tuple(getattr(x, 'shape', ()))}" for x in tensors]
        for tensors in (images, views)
    )
    if got != expected:
        raise GeneratorError(f"{name}.inpaint: expected images as its views, {', '.join(expected)}, got {got}")
    for k, (image, hole) in enumerate(zip(images, holes, strict=True)):
        if image.is_floating_point():
            if not bool(image[:, hole].isfinite().all()):
                raise GeneratorError(f"{name}.inpaint: expected finite pixels in the holes, got NaN or infinity")
            images[k] = image.clamp(0, 1)
    return images


class Black(Inpainter):
    """Leaves holes black; ``generated`` is not written."""

    outcome = "black: train with 'coverage' as a mask"

    def fill(self, rendered: Sequence[Views], frames: Sequence[Frame]) -> list[Views]:
        return list(rendered)

    def complete_batch(self, batch: Mapping[str, Any]) -> dict[str, Any]:
        """The batch without ``sources`` and ``generated``; pixels that another inpainter filled are black again."""
        return {key: value for key, value in super().complete_batch(batch).items() if key != "generated"}


class Telea(Inpainter):
    """Fills holes by Telea's method; seen pixels of low confidence too, by ``min_confidence``."""

    fills_own_car = True

    def __init__(self, *, min_confidence: float = 0.0) -> None:
        self.min_confidence, _ = checked_settings(min_confidence)

    def inpaint(self, views: Tensors, holes: Tensors, seeds: Sequence[int]) -> list[torch.Tensor]:
        return [telea(view, hole) for view, hole in zip(views, holes, strict=True)]


def telea(image: torch.Tensor, hole: torch.Tensor) -> torch.Tensor:
    """Fill the holes (h, w) of an image (3, h, w), uint8 or float in [0, 1], by Telea's fast marching (2004).

    All other pixels are unchanged. Filled values have 8 bits and no gradients.
    """
    if not hole.any():
        return image
    is_uint8 = image.dtype == torch.uint8
    if hole.all():
        return torch.full_like(image, round(GREY * 255) if is_uint8 else GREY)
    box = bounding_box(hole.cpu().numpy(), _MARGIN_PX)
    part, marks = image[:, box[0], box[1]].detach(), hole[box]
    pixels = part if is_uint8 else (part.float() * 255).round().clamp(0, 255).to(torch.uint8)
    planes = np.ascontiguousarray(pixels.cpu().permute(1, 2, 0).numpy())
    inpainted = cv2.inpaint(planes, marks.cpu().numpy().astype(np.uint8), RADIUS_PX, cv2.INPAINT_TELEA)
    values = torch.from_numpy(inpainted).permute(2, 0, 1).to(image.device)
    filled = image.detach().clone()
    filled[:, box[0], box[1]] = torch.where(marks, values if is_uint8 else (values.float() / 255).to(image.dtype), part)
    return filled


# --- holes ------------------------------------------------------------------------------------------------------------
def holes_of(frame: Views, min_confidence: float) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Pixels (h, w) of each view seen with enough confidence, and the other pixels outside the own car."""
    trust = frame.coverage if frame.confidence is None else frame.confidence
    known = [seen & (c >= min_confidence) for seen, c in zip(frame.coverage, trust, strict=True)]
    views = zip(known, frame.rig, strict=True)
    return known, [~k if c.mask is None else ~k & torch.tensor(c.mask, device=k.device) for k, c in views]


def put(rendered: Views, images: Sequence[torch.Tensor], holes: Sequence[torch.Tensor]) -> Views:
    """The frame with images (3, h, w) in the holes (h, w) of its views, marked as generated."""

    def without_holes(maps: Sequence[torch.Tensor], empty: int) -> torch.Tensor | list[torch.Tensor]:
        return stacked([m.masked_fill(hole, empty) for m, hole in zip(maps, holes, strict=True)])

    def labels(maps: Sequence[torch.Tensor], fill: LabelFill) -> list[torch.Tensor]:
        assert rendered.labels is not None
        views = zip(rendered.labels(maps, fill), holes, strict=True)
        return [m.masked_fill(hole.to(m.device), fill(m.dtype)) if hole.any() else m for m, hole in views]

    pixels = zip(holes, images, rendered.images, strict=True)
    views = [torch.where(hole, filled, view) for hole, filled, view in pixels]
    return replace(rendered.with_maps(without_holes), images=views, generated=stacked(list(holes)), labels=labels)


# --- randomness -------------------------------------------------------------------------------------------------------
def frame_names(frames: Sequence[Frame]) -> list[str]:
    """Names of frames for seeds: their ``token``, else a digest of their images."""
    return [f.further["token"] if "token" in f.further else digest_of(f.images) for f in frames]


def digest_of(tensors: Iterable[torch.Tensor]) -> str:
    """A digest of the values of tensors, on any device."""
    digest = hashlib.blake2b()
    for tensor in tensors:
        digest.update(tensor.detach().cpu().contiguous().view(torch.uint8).numpy().tobytes())  # bfloat16 too
    return digest.hexdigest()


def seeded(*key: object) -> torch.Generator:
    """A CPU generator seeded by a key of plain values."""
    digest = hashlib.sha256(repr(key).encode()).digest()
    return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1)


# --- settings ---------------------------------------------------------------------------------------------------------
def checked_settings(
    min_confidence: float, seed: int = 0, steps: int | None = None, guidance: float | None = None
) -> tuple[float, int]:
    """Check settings of an inpainter; ValueError for impossible ones."""
    if steps is not None and not is_whole(steps, 1):
        raise ValueError(f"steps: expected a whole number from 1, got {shown(steps)}")
    if guidance is not None and not is_number(guidance):
        raise ValueError(f"guidance: expected a number, got {shown(guidance)}")
    if not is_number(min_confidence) or not 0 <= min_confidence <= 1:
        raise ValueError(f"min_confidence: expected a number from 0 to 1, got {shown(min_confidence)}")
    if not is_whole(seed):
        raise ValueError(f"seed: expected a whole number, got {shown(seed)}")
    return float(min_confidence), int(seed)


def check_device(network: Any) -> None:
    """Raise GeneratorError for a network on a GPU in a DataLoader worker."""
    if network.device.type == "cuda" and torch.utils.data.get_worker_info() is not None:
        raise GeneratorError(
            "a generator on a GPU cannot run in DataLoader workers: use num_workers=0, keep the generator on the "
            "CPU, or complete batches after they are collated"
        )
