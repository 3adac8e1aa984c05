"""Inference: which pixels of a frame's target views are generated, and how (Sec. CVC-SSL).

Known is what FAVS covers with enough confidence; it is never changed. A view that is almost whole gets the rest by
Telea's inpainting, without a call of the denoiser. The others are denoised together, so that they agree.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch.nn import functional

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import GeneratorError, SampleError
from arbiview_aug.generator.conditioning import Views
from arbiview_aug.generator.config import GeneratorConfig
from arbiview_aug.generator.correspondence import TokenWindow
from arbiview_aug.generator.denoiser import REGRESSION
from arbiview_aug.generator.geometry import FrameGeometry, frame_geometry
from arbiview_aug.generator.inpainting import telea
from arbiview_aug.generator.networks import GeneratorNetworks
from arbiview_aug.generator.sampler import Solver, guided, noise_schedule, sample
from arbiview_aug.image_ops import resized
from arbiview_aug.sample.batching import stacked

ALMOST_WHOLE = 0.995
"""Views with this share of known pixels need no denoiser: what is left is a seam, which inpainting fills as well."""

SOURCES_A_TARGET = 2
"""Source branches for each target camera: two, as in training (Algorithm 1: left and right)."""


class Completed(NamedTuple):
    """Target views without holes.

    Attributes:
        images: (M, 3, h, w), or a list of (3, h, w) where sizes differ, of the given type; known pixels as they were.
        generated: (M, h, w) bool, or a list: every pixel that no camera saw and that was made up.
        denoised: Indices of the views that the denoiser saw; the others were whole, or inpainted.
    """

    images: torch.Tensor | list[torch.Tensor]
    generated: torch.Tensor | list[torch.Tensor]
    denoised: list[int]


class Sampling(NamedTuple):
    """How latents are sampled, see ``sampler.sample`` and ``sampler.guided``."""

    steps: int
    guidance: float
    strength: float
    solver: Solver


@torch.no_grad()
def complete(
    generator: GeneratorNetworks,
    views: torch.Tensor | Sequence[torch.Tensor],
    coverage: torch.Tensor | Sequence[torch.Tensor],
    targets: Rig,
    source_images: torch.Tensor | Sequence[torch.Tensor],
    sources: Rig,
    *,
    confidence: torch.Tensor | Sequence[torch.Tensor] | None = None,
    min_confidence: float = 0.0,
    steps: int | None = None,
    guidance: float | None = None,
    strength: float | None = None,
    solver: Solver = "dpm++",
    seed: int = 0,
    frame: str | int = 0,
) -> Completed:
    """Complete the target views of one frame.

    The result depends on the seed, the frame and the cameras' names, not on the order of the cameras or on what was
    completed before. It is computed on the generator's device and comes back on the views'.

    Args:
        generator: The model.
        views: (M, 3, h, w), or M tensors (3, h, w): FAVS at the target cameras, uint8 or float in [0, 1].
        coverage: (M, h, w) bool, or M tensors: what some source saw.
        targets: The M target cameras; what their masks call the own car is not generated.
        source_images: N images (3, H, W).
        sources: The N cameras that recorded them.
        confidence: (M, h, w) in [0, 1], or M tensors; full where not given.
        min_confidence: τ: covered pixels below it are generated again.
        steps: 1 is the one-step regression; the configuration's unless given.
        guidance: Classifier-free guidance; 1 is none.
        strength: How far the pre-filled latent is put back into noise.
        solver: ``dpm++`` or ``ddim``.
        seed: Of the noise.
        frame: Names the frame, for the noise.

    Raises:
        SampleError: Views, coverage and cameras that do not fit together.
        GeneratorError: Impossible settings, one step of a generator that was not trained for it, or a generator on a
            GPU in a DataLoader worker.
    """
    config = generator.config
    how = Sampling(
        config.steps if steps is None else steps,
        config.guidance if guidance is None else guidance,
        config.strength if strength is None else strength,
        solver,
    )
    if how.steps < 1 or not 0 < how.strength <= 1:
        got = f"{how.steps} and {how.strength}"
        raise GeneratorError(f"complete: expected steps >= 1 and strength in (0, 1], got {got}")
    if how.steps == 1 and not config.one_step:
        raise GeneratorError(
            f"complete: expected steps >= 2, got 1: the one-step regression of generator {config.name!r} was not "
            "trained (loss.regression=0)"
        )
    device = generator.denoiser.regression.weight.device
    if device.type == "cuda" and torch.utils.data.get_worker_info() is not None:
        raise GeneratorError(
            "a generator on a GPU cannot run in DataLoader workers: use num_workers=0, keep the generator on the "
            "CPU, or complete batches after they are collated"
        )
    targets = targets.in_frame_of(sources)
    if len(source_images) != len(sources):
        raise SampleError(f"complete: expected {len(sources)} source images, got {len(source_images)}")
    _check_sizes(views, coverage, targets)
    images = [image for image in views]
    trust = [seen.float() for seen in coverage] if confidence is None else [c.float() for c in confidence]
    known = [seen & (c >= min_confidence) for seen, c in zip(coverage, trust, strict=True)]
    holes = _holes(known, targets)
    todo = []
    for m, hole in enumerate(holes):
        share = float(hole.float().mean())
        if share > 1 - ALMOST_WHOLE:
            todo.append(m)
        elif share > 0:
            images[m] = _filled(images[m], known[m], hole)
    if todo:
        parts = [_prefilled(images[m], known[m], trust[m], config.image_size) for m in todo]
        prefilled, known_share, confident = (torch.stack(part)[None].to(device) for part in zip(*parts, strict=True))
        noise = torch.stack([_noise(generator, seed, frame, targets[m].name) for m in todo])[None].to(device)
        cameras = [targets[m] for m in todo]
        made = _denoised(generator, cameras, prefilled, known_share, confident, source_images, sources, noise, how)
        for m, image in zip(todo, made, strict=True):
            images[m] = _pasted(image, images[m], holes[m])
    return Completed(stacked(images), stacked(holes), todo)


@torch.no_grad()
def inpainted(
    views: torch.Tensor | Sequence[torch.Tensor],
    coverage: torch.Tensor | Sequence[torch.Tensor],
    targets: Rig,
    *,
    confidence: torch.Tensor | Sequence[torch.Tensor] | None = None,
    min_confidence: float = 0.0,
) -> Completed:
    """``complete`` without a generator: Telea's inpainting everywhere, the baseline that generators have to beat.

    Raises:
        SampleError: Views, coverage and cameras that do not fit together.
    """
    _check_sizes(views, coverage, targets)
    trust = coverage if confidence is None else confidence
    known = [seen & (c >= min_confidence) for seen, c in zip(coverage, trust, strict=True)]
    holes = _holes(known, targets)
    return Completed(
        stacked([_filled(*of_view) for of_view in zip(views, known, holes, strict=True)]), stacked(holes), []
    )


def _holes(known: Sequence[torch.Tensor], targets: Rig) -> list[torch.Tensor]:
    """(h, w) bool of each view: what is to be made up. Nobody needs the scene behind the own car."""
    return [
        ~k if c.mask is None else ~k & torch.tensor(c.mask, device=k.device)
        for k, c in zip(known, targets, strict=True)
    ]


def _denoised(
    generator: GeneratorNetworks,
    targets: Sequence[Camera],
    prefilled: torch.Tensor,
    known: torch.Tensor,
    confidence: torch.Tensor,
    source_images: torch.Tensor | Sequence[torch.Tensor],
    sources: Rig,
    noise: torch.Tensor,
    how: Sampling,
) -> torch.Tensor:
    """(n, 3, H, W) float32 images in [0, 1] of n targets together, at the generator's size.

    Args:
        generator: The model.
        targets: n cameras, in the sources' ego frame.
        prefilled: (1, n, 3, H, W) in [0, 1].
        known: (1, n, H, W) in [0, 1].
        confidence: (1, n, H, W) in [0, 1].
        source_images: Of all sources.
        sources: All of them.
        noise: (1, n, C, h, w).
        how: Settings.
    """
    config, device = generator.config, noise.device
    used = sorted({k for target in targets for k in nearest_sources(target, sources)})
    cameras = [sources[k] for k in used]
    images = torch.stack([_at_size(source_images[k], config.image_size) for k in used])[None].to(device)
    seen = torch.stack([_seen(camera, config.image_size) for camera in cameras])[None].to(device)
    geometry = frame_geometry(targets, cameras, sources.ground_z_m, config).to(device)
    return denoised(generator, geometry, prefilled, known, confidence, images, seen, noise, how)[0]


def denoised(
    generator: GeneratorNetworks,
    geometry: FrameGeometry,
    prefilled: torch.Tensor,
    known: torch.Tensor,
    confidence: torch.Tensor,
    images: torch.Tensor,
    seen: torch.Tensor,
    noise: torch.Tensor,
    how: Sampling,
) -> torch.Tensor:
    """(B, N, 3, H, W) float32 images in [0, 1] of the N targets of B frames, all on one device.

    Args:
        generator: The model.
        geometry: Of the targets and S sources.
        prefilled: (B, N, 3, H, W) in [0, 1].
        known: (B, N, H, W) bool, or shares in [0, 1].
        confidence: (B, N, H, W) in [0, 1].
        images: (B, S, 3, H, W) of the sources, in [0, 1].
        seen: (B, S, H, W) what they show, bool, or 0 and 1.
        noise: (B, N, C, h, w) standard normal.
        how: Settings.
    """
    config, denoiser, autoencoder = generator.config, generator.denoiser, generator.autoencoder
    latent = autoencoder.encode(shown_condition(config, prefilled, known)).float()
    views, windows = geometry.target_views(latent, known, confidence), geometry.target_windows()
    source_views = geometry.source_views(autoencoder.encode(images).float(), seen, seen)
    read = denoiser.read_sources(source_views, geometry.source_windows())
    everything = torch.ones(len(noise), dtype=torch.bool, device=noise.device)
    is_guided = how.guidance != 1 and how.steps > 1
    unconditional = (views.dropped(everything), geometry.target_windows(everything)) if is_guided else None

    def predict(x: torch.Tensor, t: int) -> torch.Tensor:
        def run(views: Views, windows: Sequence[TokenWindow]) -> torch.Tensor:
            generator.calls += 1
            return denoiser(x, torch.full((len(x),), t, device=x.device), views, windows, read).float()

        conditional = run(views, windows)
        if unconditional is None or t == REGRESSION:
            return conditional
        return guided(conditional, run(*unconditional), how.guidance, config.guidance_rescale)

    schedule = noise_schedule(prediction=config.prediction, zero_snr=config.zero_snr, solver=how.solver)
    begins_inpainted = not (config.prefilled or config.residual or how.steps == 1)
    x0 = sample(
        predict,
        autoencoder.encode(prefilled) if begins_inpainted else latent,
        noise,
        schedule,
        steps=how.steps,
        strength=how.strength,
        temperature=config.temperature,
        warm=config.residual,
    )
    return autoencoder.decode(x0).float().clamp(0, 1)


def shown_condition(config: GeneratorConfig, prefilled: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """The condition as a generator knows it from its training.

    Args:
        config: Settings.
        prefilled: (..., 3, H, W) in [0, 1], holes inpainted.
        known: (..., H, W) bool, or shares in [0, 1].
    """
    return prefilled if config.prefilled else torch.where(known[..., None, :, :] >= 0.5, prefilled, 0.5)


def nearest_sources(target: Camera, sources: Rig) -> list[int]:
    """The sources whose optical axes are nearest to a target's, by content where two are alike."""
    likeness = [(float(-s.cam2ego[:3, 2] @ target.cam2ego[:3, 2]), s.content_key, k) for k, s in enumerate(sources)]
    return [k for _, _, k in sorted(likeness)[:SOURCES_A_TARGET]]


# --- pixels -----------------------------------------------------------------------------------------------------------
def _prefilled(
    image: torch.Tensor, known: torch.Tensor, trust: torch.Tensor, size: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A view at the generator's size with its holes inpainted (3, H, W); what is known of it, its confidence (H, W).

    Unknown pixels do not bleed into known ones: colours are averaged over what is known alone.
    """
    unit = image.float() / 255 if image.dtype == torch.uint8 else image.float()
    weight = known.float()[None]
    planes = torch.cat([unit * weight, weight, (trust * known)[None]])[None]
    if tuple(image.shape[-2:]) != size:
        planes = functional.interpolate(planes, size=size, mode="bilinear", antialias=True, align_corners=False)
    colour, share, confidence = planes[0].split([3, 1, 1])
    here = share[0] >= 0.5
    return telea((colour / share.clamp(min=1e-3)).clamp(0, 1), ~here), share[0].clamp(0, 1), confidence[0].clamp(0, 1)


def _filled(image: torch.Tensor, known: torch.Tensor, hole: torch.Tensor) -> torch.Tensor:
    """A view with its hole inpainted; what is neither known nor a hole is not read."""
    return torch.where(hole, telea(image, ~known), image) if bool(hole.any()) else image


def _pasted(made: torch.Tensor, image: torch.Tensor, hole: torch.Tensor) -> torch.Tensor:
    """The view (3, h, w) with the generated image in its hole; every other pixel bit for bit as it was."""
    made = made.to(image.device)
    if made.shape != image.shape:
        size = tuple(image.shape[-2:])
        made = functional.interpolate(made[None], size=size, mode="bicubic", antialias=True, align_corners=False)[0]
    made = made.clamp(0, 1)
    made = (made * 255).round().to(torch.uint8) if image.dtype == torch.uint8 else made.to(image.dtype)
    return torch.where(hole, made, image)


def _at_size(image: torch.Tensor, size: tuple[int, int]) -> torch.Tensor:
    small = resized(image, size)
    return small.float() / 255 if small.dtype == torch.uint8 else small.float()


def _seen(camera: Camera, size: tuple[int, int]) -> torch.Tensor:
    """(H, W) float32: 1 where a source shows the scene, 0 on its own car."""
    mask = camera.resize(size).mask
    return torch.ones(size) if mask is None else torch.tensor(mask, dtype=torch.float32)


def _noise(generator: GeneratorNetworks, seed: int, frame: str | int, camera: str) -> torch.Tensor:
    """(C, h, w) standard normal of a (frame, camera), drawn on the CPU: the same on every device."""
    digest = hashlib.sha256(repr((seed, str(frame), camera)).encode()).digest()
    rng = torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1)
    config = generator.config
    return torch.randn(config.autoencoder.latent_channels, *config.latent_size, generator=rng)


def _check_sizes(
    views: torch.Tensor | Sequence[torch.Tensor], coverage: torch.Tensor | Sequence[torch.Tensor], targets: Rig
) -> None:
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
