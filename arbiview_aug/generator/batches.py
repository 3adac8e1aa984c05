"""Completion of a transform's output: one frame, a batch, or a loader's batches."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch

from arbiview_aug.errors import SampleError, WarnOnce
from arbiview_aug.generator.completion import (
    FrameViews,
    Maps,
    check_device,
    complete_together,
    known_and_holes,
    seeded,
)
from arbiview_aug.generator.networks import GeneratorNetworks
from arbiview_aug.generator.pretrained import HoleFiller
from arbiview_aug.render.rendered import MAP_KEYS, RenderedFrame
from arbiview_aug.sample.batching import gathered, leading_shape, rewrapped, split, stacked
from arbiview_aug.sample.inputs import Frame, read_frames

SOURCES_KEY = "sources"  # holds the source sample of a retargeted one, for completion after collating


@dataclass(frozen=True, kw_only=True)
class Completion:
    """Settings of completion, as in ``completion.complete``; without a generator, holes are inpainted."""

    generator: GeneratorNetworks | HoleFiller | None = None
    steps: int | None = None
    guidance: float | None = None
    min_confidence: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        own = self.generator.config if isinstance(self.generator, GeneratorNetworks) else None
        if own is not None and own.steps == 1 < (self.steps or 1):
            _warn(
                own.name,
                f"steps={self.steps}: generator {own.name!r} was trained for one step; more add noise (the package's "
                "own loses 0.3 to 0.8 dB in the holes of synthetic streets). Pass steps=1, or a model made for more",
            )


_warn = WarnOnce()


def complete_frames(
    rendered: Sequence[RenderedFrame], frames: Sequence[Frame], names: Sequence[str], how: Completion
) -> list[RenderedFrame]:
    """Fill the pixels of rendered ``frames`` that no camera saw, or saw with too little confidence.

    Filled pixels are no longer covered: ``coverage`` False, ``confidence`` 0, ``source_camera`` and ``source_frame``
    -1. Gradients of the others stay. ``names`` decide the noise. Frames share a network's calls.
    """
    if isinstance(how.generator, HoleFiller):
        return _filled(how.generator, rendered, names, how)
    jobs = []
    for one, frame, name in zip(rendered, frames, names, strict=True):
        # Noise by camera number: cameras have no names in a batch.
        rig = one.rig.with_cameras([replace(camera, name=str(k)) for k, camera in enumerate(one.rig)])
        jobs.append(FrameViews(one.images, one.coverage, rig, frame.images, frame.rig, one.confidence, name))
    done = complete_together(
        how.generator,
        jobs,
        min_confidence=how.min_confidence,
        steps=how.steps,
        guidance=how.guidance,
        seed=how.seed,
    )
    return [_put(one, found.images, list(found.generated)) for one, found in zip(rendered, done, strict=True)]


def _filled(
    filler: HoleFiller, rendered: Sequence[RenderedFrame], names: Sequence[str], how: Completion
) -> list[RenderedFrame]:
    check_device(filler)
    holes, seeds = [], []
    for frame, name in zip(rendered, names, strict=True):
        trust = frame.coverage if frame.confidence is None else frame.confidence
        holes.append(known_and_holes(frame.rig, frame.coverage, trust, how.min_confidence)[1])
        seeds += [seeded(how.seed, name, str(k)).initial_seed() for k in range(len(frame.rig))]
    views = [view for frame in rendered for view in frame.images]
    done = iter(filler.fill(views, [hole for of_frame in holes for hole in of_frame], seeds, how.steps, how.guidance))
    return [
        _put(frame, [next(done) for _ in of_frame], of_frame) for frame, of_frame in zip(rendered, holes, strict=True)
    ]


def _put(rendered: RenderedFrame, images: Maps, holes: Sequence[torch.Tensor]) -> RenderedFrame:
    def without_holes(maps: Sequence[torch.Tensor], empty: int) -> torch.Tensor | list[torch.Tensor]:
        return stacked([m.masked_fill(hole, empty) for m, hole in zip(maps, holes, strict=True)])

    pixels = zip(holes, images, rendered.images, strict=True)
    views = [torch.where(hole, filled, view) for hole, filled, view in pixels]
    return replace(rendered.with_maps(without_holes), images=views, generated=stacked(list(holes)))


def frame_names(samples: Sequence[Frame], frames: Sequence[Frame], how: Completion) -> list[str]:
    """Keys of the frames' noise: ``token`` of their ``samples``, else a digest of their images; empty if inpainted."""
    if how.generator is None:  # hashing six images of 1600 x 900 takes 33 ms
        return [""] * len(frames)
    pairs = zip(samples, frames, strict=True)
    return [s.name("token") if s.sample.get("token") is not None else _digest(frame.images) for s, frame in pairs]


def _digest(images: Sequence[torch.Tensor]) -> str:
    digest = hashlib.blake2b()
    for image in images:
        digest.update(image.detach().cpu().contiguous().view(torch.uint8).numpy().tobytes())  # bfloat16 too
    return digest.hexdigest()


@torch.no_grad()
def complete_batch(
    generator: GeneratorNetworks | HoleFiller | None,
    batch: Mapping[str, Any],
    *,
    steps: int | None = None,
    guidance: float | None = None,
    min_confidence: float = 0.0,
    seed: int = 0,
) -> dict[str, Any]:
    """Complete collated samples on the generator's device: DataLoader workers cannot use a GPU.

    The pixels are those of ``RigRetarget(path="diffusion")``, but for rounding: frames are computed together.

    Args:
        generator: The model; None inpaints. The settings are those of ``RigRetarget``.
        batch: From ``RigRetarget(..., outputs=("sources", "confidence"))``, one sample or a batch of them.

    Returns:
        A new dict without ``sources``, with ``generated``.

    Raises:
        SampleError: The batch lacks the sources, the coverage or the confidence.
        GeneratorError: Impossible settings.
    """
    how = Completion(generator=generator, steps=steps, guidance=guidance, min_confidence=min_confidence, seed=seed)
    needs = ("coverage", "confidence") if min_confidence or isinstance(generator, GeneratorNetworks) else ("coverage",)
    missing = [key for key in (SOURCES_KEY, *needs) if batch.get(key) is None]
    if missing:
        raise SampleError(
            f"complete: expected {', '.join(missing)} in the batch: retarget with outputs=('sources', 'confidence')"
        )
    sources = read_frames(batch[SOURCES_KEY], None)
    views = read_frames({key: value for key, value in batch.items() if key != "coverage"}, None)
    lead = leading_shape(batch["images"])
    if len(sources) != len(views):
        raise SampleError(f"complete: expected sources of {len(views)} frames, got {len(sources)}")
    maps = {key: split(batch[key], lead) for key in MAP_KEYS if key in batch}
    filled = maps.pop("generated", None) is not None  # by ``holes`` of the transform
    rendered = []
    for b, view in enumerate(views):
        images = list(view.images)
        if filled:
            images = [torch.where(seen, image, 0) for seen, image in zip(maps["coverage"][b], images, strict=True)]
        seen = {key: frames[b] for key, frames in maps.items()}
        rendered.append(RenderedFrame(images, view.rig, **seen))
    done = complete_frames(rendered, sources, frame_names(views, sources, how), how)
    out = {key: value for key, value in batch.items() if key != SOURCES_KEY}
    for key in (*maps, "generated"):
        out[key] = gathered([getattr(frame, key) for frame in done], lead)
    out["images"] = rewrapped(gathered([stacked(frame.images) for frame in done], lead), batch["images"])
    return out


class CompletedLoader:
    """Loader that completes the batches of another one in this process, on the generator's device.

    ``loader`` yields batches from ``RigRetarget(..., outputs=("sources", "confidence"))``. The other arguments are
    those of ``complete_batch``.
    """

    def __init__(
        self, loader: Iterable[Mapping[str, Any]], generator: GeneratorNetworks | HoleFiller | None, **settings: Any
    ) -> None:
        self.loader, self.generator, self.settings = loader, generator, settings

    def __iter__(self) -> Iterator[dict[str, Any]]:
        for batch in self.loader:
            yield complete_batch(self.generator, batch, **self.settings)

    def __len__(self) -> int:
        return len(self.loader)  # type: ignore[arg-type]
