"""Inference on the target views of frames (Sec. CVC-SSL; appendix: The Multi-Branch U-Net).

Pixels that FAVS covers with enough confidence are known and never change. Views that are almost complete are inpainted
by Telea's method without the denoiser. A frame's others are denoised together, so that they agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch.nn import functional

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import GeneratorError, SampleError
from arbiview_aug.generator.autoencoder import Autoencoder
from arbiview_aug.generator.conditioning import Views
from arbiview_aug.generator.config import GeneratorConfig
from arbiview_aug.generator.correspondence import TokenWindow
from arbiview_aug.generator.denoiser import REGRESSION, GeneratorNetworks
from arbiview_aug.generator.geometry import FrameGeometry, batched, frame_geometry
from arbiview_aug.generator.sampler import guided, noise_schedule, sample
from arbiview_aug.image_ops import resized
from arbiview_aug.inpaint.inpainter import check_device, known_and_holes, seeded
from arbiview_aug.inpaint.telea import telea
from arbiview_aug.sample.batching import stacked

ALMOST_COMPLETE = 0.995  # share of known pixels from which a view is inpainted: what is left is a seam
SOURCES_PER_TARGET = 2  # source branches of a target camera, as in training (Algorithm 1: left and right)
VIEWS_AT_ONCE = 24  # views that the denoiser sees in one call; a whole frame in any case
Maps = torch.Tensor | Sequence[torch.Tensor]  # with a leading camera dimension, or a tensor per camera


class Completed(NamedTuple):
    """Target views without holes; tensors, or lists over the views if their sizes differ."""

    images: torch.Tensor | list[torch.Tensor]  # (M, 3, h, w) of the given dtype; known pixels unchanged
    generated: torch.Tensor | list[torch.Tensor]  # (M, h, w) bool, pixels that no camera saw and that were filled
    denoised: list[int]  # views that the denoiser completed; the others were complete or inpainted


class Conditions(NamedTuple):
    """Inputs of the generator for N targets and S sources of B frames, at its image size."""

    prefilled: torch.Tensor  # (B, N, 3, H, W) in [0, 1], FAVS at the targets with holes inpainted
    known: torch.Tensor  # (B, N, H, W) bool, or shares in [0, 1]
    confidence: torch.Tensor  # (B, N, H, W) in [0, 1]
    sources: torch.Tensor  # (B, S, 3, H, W) in [0, 1]
    seen: torch.Tensor  # (B, S, H, W) valid pixels of the sources, bool, or 0 and 1

    def encoded(
        self, config: GeneratorConfig, autoencoder: Autoencoder, geometry: FrameGeometry
    ) -> tuple[Views, Views]:
        """The denoiser's conditions of the targets and of the sources."""
        latent = autoencoder.encode(shown_condition(config, self.prefilled, self.known)).float()
        sources = autoencoder.encode(self.sources).float()
        targets = geometry.target_views(latent, self.known, self.confidence)
        return targets, geometry.source_views(sources, self.seen, self.seen)


class FrameViews(NamedTuple):
    """A frame to complete.

    Attributes:
        views: (M, 3, h, w), or M tensors (3, h, w): FAVS at the target cameras, uint8 or float in [0, 1].
        coverage: (M, h, w) bool, or M tensors: pixels that some source saw.
        targets: The M target cameras; pixels of their own car (masks) are not generated.
        source_images: N images (3, H, W).
        sources: The N cameras that recorded them.
        confidence: (M, h, w) in [0, 1], or M tensors; 1 by default.
        frame: Name of the frame, for the noise.
    """

    views: Maps
    coverage: Maps
    targets: Rig
    source_images: Maps
    sources: Rig
    confidence: Maps | None = None
    frame: str | int = 0


class _Draft(NamedTuple):
    """A frame with its almost complete views inpainted; the others are left to the generator."""

    images: list[torch.Tensor]
    known: list[torch.Tensor]
    holes: list[torch.Tensor]
    left: list[int]  # numbers of the views
    branches: list[int]  # numbers of the sources that they read


def complete(
    generator: GeneratorNetworks | None,
    views: Maps,
    coverage: Maps,
    targets: Rig,
    source_images: Maps,
    sources: Rig,
    *,
    confidence: Maps | None = None,
    frame: str | int = 0,
    **settings: Any,
) -> Completed:
    """Complete the target views of one frame: ``FrameViews``, and the settings of ``complete_together``."""
    one = FrameViews(views, coverage, targets, source_images, sources, confidence, frame)
    return complete_together(generator, [one], **settings)[0]


@torch.no_grad()
def complete_together(
    generator: GeneratorNetworks | None,
    frames: Sequence[FrameViews],
    *,
    min_confidence: float = 0.0,
    steps: int | None = None,
    guidance: float | None = None,
    seed: int = 0,
) -> list[Completed]:
    """Complete the target views of frames; those with as many views to denoise share the denoiser's calls.

    The result depends on the seed, the frame and the cameras' names, not on the order of the cameras or on earlier
    calls. It is computed on the generator's device and returned on the views'.

    Args:
        generator: The model; None inpaints all holes by Telea's method.
        frames: The frames.
        min_confidence: Covered pixels below this confidence are generated too.
        steps: Denoising steps; 1 is the one-step regression. Default: the generator's.
        guidance: Classifier-free guidance; 1 is none. Default: the generator's.
        seed: Seed of the noise.

    Raises:
        SampleError: Views, coverage and cameras that do not fit together.
        GeneratorError: Impossible settings, one step of a generator that was not trained for it, or a generator on a
            GPU in a DataLoader worker.
    """
    config = None if generator is None else _settings(generator, steps, guidance)
    frames = [frame._replace(targets=frame.targets.in_frame_of(frame.sources)) for frame in frames]
    drafts = [_draft(frame, min_confidence, inpaints_all=generator is None) for frame in frames]
    alike: dict[tuple[int, int], list[int]] = {}
    for k, draft in enumerate(drafts):
        if draft.left:
            alike.setdefault((len(draft.left), len(draft.branches)), []).append(k)
    for (count, _), numbers in alike.items():
        assert generator is not None and config is not None
        batch = max(1, VIEWS_AT_ONCE // count)
        for together in (numbers[start : start + batch] for start in range(0, len(numbers), batch)):
            inputs = [_inputs(frames[k], drafts[k], config, seed) for k in together]
            conditions = Conditions(*(torch.cat(part) for part in zip(*(one for one, *_ in inputs), strict=True)))
            conditions = Conditions(*(part.to(generator.device) for part in conditions))
            geometry = batched([one for _, one, _ in inputs]).to(generator.device)
            noise = torch.cat([one for *_, one in inputs]).to(generator.device)
            for k, images in zip(together, denoised(generator, config, geometry, conditions, noise), strict=True):
                current = drafts[k]
                for m, image in zip(current.left, images, strict=True):
                    current.images[m] = _paste(image, current.images[m], current.holes[m])
    return [Completed(stacked(current.images), stacked(current.holes), current.left) for current in drafts]


def _draft(frame: FrameViews, min_confidence: float, inpaints_all: bool) -> _Draft:
    """Inpaint the views of a frame that are almost complete, or all."""
    targets, sources = frame.targets, frame.sources
    if len(frame.source_images) != len(sources):
        raise SampleError(f"complete: expected {len(sources)} source images, got {len(frame.source_images)}")
    _check_sizes(frame.views, frame.coverage, targets)
    images, trust = list(frame.views), frame.coverage if frame.confidence is None else frame.confidence
    known, holes = known_and_holes(targets, frame.coverage, trust, min_confidence)
    left = []
    for m, hole in enumerate(holes):
        if not inpaints_all and float(hole.float().mean()) > 1 - ALMOST_COMPLETE:
            left.append(m)
        elif bool(hole.any()):
            images[m] = torch.where(hole, telea(images[m], ~known[m]), images[m])
    branches = sorted({k for m in left for k in nearest_sources(targets[m], sources)})
    return _Draft(images, known, holes, left, branches)


def _inputs(
    frame: FrameViews, draft: _Draft, config: GeneratorConfig, seed: int
) -> tuple[Conditions, FrameGeometry, torch.Tensor]:
    """Conditions, cameras and noise of a frame's views that are left, on the CPU."""
    size, sources = config.image_size, [frame.sources[k] for k in draft.branches]
    targets = [frame.targets[m] for m in draft.left]
    trust = frame.coverage if frame.confidence is None else frame.confidence
    views = zip(*(_prefilled(draft.images[m], draft.known[m], trust[m], size) for m in draft.left), strict=True)
    seen = [valid_pixels(camera.resize(size)).float() for camera in sources]
    parts = [*views, [_at_size(frame.source_images[k], size) for k in draft.branches], seen]
    conditions = Conditions(*(torch.stack(list(part))[None] for part in parts))
    geometry = frame_geometry(targets, sources, frame.sources.ground_z_m, config)
    return conditions, geometry, torch.stack([_noise(config, seed, frame.frame, one.name) for one in targets])[None]


def _settings(generator: GeneratorNetworks, steps: int | None, guidance: float | None) -> GeneratorConfig:
    config = generator.config
    config = replace(
        config,
        steps=config.steps if steps is None else steps,
        guidance=config.guidance if guidance is None else guidance,
    )
    if config.steps == 1 and not config.one_step:
        raise GeneratorError(
            f"complete: expected steps >= 2, got 1: the one-step regression of generator {config.name!r} was not "
            "trained (loss.regression=0)"
        )
    check_device(generator)
    return config


def denoised(
    generator: GeneratorNetworks,
    config: GeneratorConfig,
    geometry: FrameGeometry,
    conditions: Conditions,
    noise: torch.Tensor,
) -> torch.Tensor:
    """Sample the N targets of B frames from noise (B, N, C, h, w): (B, N, 3, H, W) float32 in [0, 1].

    ``config`` may differ from the generator's in ``steps`` and ``guidance``.
    """
    denoiser, autoencoder = generator.denoiser, generator.autoencoder
    views, source_views = conditions.encoded(config, autoencoder, geometry)
    sources = denoiser.read_sources(source_views, geometry.source_windows())
    windows = geometry.target_windows()
    all_frames = torch.ones(len(noise), dtype=torch.bool, device=noise.device)
    is_guided = config.guidance != 1 and config.steps > 1
    unconditional = (views.dropped(all_frames), geometry.target_windows(all_frames)) if is_guided else None

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        def run(views: Views, windows: Sequence[TokenWindow]) -> torch.Tensor:
            generator.calls += 1
            return denoiser(x, torch.full((len(x),), t, device=x.device), views, windows, sources).float()

        conditional = run(views, windows)
        if unconditional is None or t == REGRESSION:
            return conditional
        return guided(conditional, run(*unconditional), config.guidance, config.guidance_rescale)

    starts_inpainted = not (config.prefilled or config.residual or config.steps == 1)
    x0 = sample(
        predict,
        autoencoder.encode(conditions.prefilled) if starts_inpainted else views.latent,
        noise,
        noise_schedule(prediction=config.prediction, zero_snr=config.zero_snr),
        steps=config.steps,
        strength=config.strength,
        temperature=config.temperature,
        warm_start=config.residual,
    )
    return autoencoder.decode(x0).float().clamp(0, 1)


def shown_condition(config: GeneratorConfig, prefilled: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """The condition (..., 3, H, W) as in training: inpainted, or with grey holes if the config is not ``prefilled``."""
    return prefilled if config.prefilled else torch.where(known[..., None, :, :] >= 0.5, prefilled, 0.5)


def nearest_sources(target: Camera, sources: Rig) -> list[int]:
    """Indices of the sources whose optical axes are nearest to a target's; ties are broken by content."""
    likeness = [(float(-s.cam2ego[:3, 2] @ target.cam2ego[:3, 2]), s.content_key, k) for k, s in enumerate(sources)]
    return [k for _, _, k in sorted(likeness)[:SOURCES_PER_TARGET]]


# --- pixels -----------------------------------------------------------------------------------------------------------
def _prefilled(
    image: torch.Tensor, known: torch.Tensor, trust: torch.Tensor, size: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A view at the generator's size with holes inpainted (3, H, W), its known share and its confidence (H, W).

    Colours are averaged over known pixels alone.
    """
    unit = image.float() / 255 if image.dtype == torch.uint8 else image.float()
    weight = known.float()[None]
    planes = torch.cat([unit * weight, weight, (trust.float() * known)[None]])[None]
    if tuple(image.shape[-2:]) != size:
        planes = functional.interpolate(planes, size, mode="bilinear", antialias=True)
    colour, share, confidence = planes[0].split([3, 1, 1])
    filled = telea((colour / share.clamp(min=1e-3)).clamp(0, 1), share[0] < 0.5)
    return filled, share[0].clamp(0, 1), confidence[0].clamp(0, 1)


def _paste(generated: torch.Tensor, image: torch.Tensor, hole: torch.Tensor) -> torch.Tensor:
    """The view (3, h, w) with the generated image in its hole; all other pixels are unchanged."""
    generated = generated.to(image.device)
    if generated.shape != image.shape:
        size = tuple(image.shape[-2:])
        generated = functional.interpolate(generated[None], size, mode="bicubic", antialias=True)[0]
    generated = generated.clamp(0, 1)
    generated = (generated * 255).round() if image.dtype == torch.uint8 else generated
    return torch.where(hole, generated.to(image.dtype), image)


def _at_size(image: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    small = resized(image, size)
    return small.float() / 255 if small.dtype == torch.uint8 else small.float()


def valid_pixels(camera: Camera) -> torch.Tensor:
    """(H, W) bool: True on the scene, False on the camera's own car."""
    return torch.ones(camera.size, dtype=torch.bool) if camera.mask is None else torch.tensor(camera.mask)


def _noise(config: GeneratorConfig, seed: int, frame: str | int, camera: str) -> torch.Tensor:
    """(C, h, w) standard normal of a (frame, camera), drawn on the CPU: the same on every device."""
    rng = seeded(seed, str(frame), camera)
    return torch.randn(config.autoencoder.latent_channels, *config.latent_size, generator=rng)


def _check_sizes(views: Maps, coverage: Maps, targets: Rig) -> None:
    counts = {"views": len(views), "coverage": len(coverage), "target cameras": len(targets)}
    if len(set(counts.values())) > 1:
        raise SampleError(f"complete: expected as many of each, got {counts}")
    for camera, view, seen in zip(targets, views, coverage, strict=True):
        if tuple(view.shape) != (3, *camera.size) or tuple(seen.shape) != camera.size:
            got = f"{tuple(view.shape)} and {tuple(seen.shape)}"
            raise SampleError(
                f"camera {camera.name!r}: expected a view (3, h, w) and coverage of {camera.size}, got {got}"
            )
        if seen.dtype != torch.bool:
            raise SampleError(f"camera {camera.name!r}: coverage: expected bool, got {seen.dtype}; pass coverage > 0")
