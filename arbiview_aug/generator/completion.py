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
from arbiview_aug.generator.conditioning import FrameGeometry, Views, batched, frame_geometry, nearest_sources
from arbiview_aug.generator.config import GeneratorConfig
from arbiview_aug.generator.correspondence import TokenWindow
from arbiview_aug.generator.denoiser import REGRESSION, Autoencoder, GeneratorNetworks
from arbiview_aug.generator.sampler import guided, noise_schedule, sample
from arbiview_aug.image_ops import resized
from arbiview_aug.inpaint.inpainter import check_device, checked_settings, holes_of, seeded
from arbiview_aug.inpaint.telea import telea
from arbiview_aug.render.rendered import Maps, RenderedFrame
from arbiview_aug.sample.batching import stacked
from arbiview_aug.sample.inputs import Frame

ALMOST_COMPLETE = 0.995  # share of known pixels from which a view is inpainted: what is left is a seam
VIEWS_AT_ONCE = 24  # views that the denoiser sees in one call; a whole frame in any case


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
    sources: torch.Tensor  # (B, S, 3, H, W) in [0, 1], read where they are seen
    seen: torch.Tensor  # (B, S, H, W) valid pixels of the sources, bool, or 0 and 1

    def encoded(
        self, config: GeneratorConfig, autoencoder: Autoencoder, geometry: FrameGeometry
    ) -> tuple[Views, Views]:
        """The denoiser's conditions of the targets and of the sources."""
        latent = autoencoder.encode(shown_condition(config, self.prefilled, self.known)).float()
        sources = autoencoder.encode(self.sources * self.seen[:, :, None]).float()
        targets = geometry.target_views(latent, self.known, self.confidence)
        return targets, geometry.source_views(sources, self.seen, self.seen)


class _Draft(NamedTuple):
    """A frame with its almost complete views inpainted; the others are left to the generator."""

    rig: Rig  # the target cameras
    trust: Maps
    source: Frame
    name: str
    images: list[torch.Tensor]
    known: list[torch.Tensor]
    holes: list[torch.Tensor]
    left: list[int]  # numbers of the views
    branches: list[int]  # numbers of the sources that they read


def complete(
    generator: GeneratorNetworks,
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
    """Complete the target views of one frame.

    Args:
        views: (M, 3, h, w), or M tensors (3, h, w): FAVS at the target cameras, uint8 or float in [0, 1].
        coverage: (M, h, w) bool, or M tensors: pixels that some source saw.
        targets: The M target cameras; pixels of their own car (masks) are not generated.
        source_images: N images (3, H, W).
        sources: The N cameras that recorded them.
        confidence: (M, h, w) in [0, 1], or M tensors; 1 by default.
        frame: Name of the frame, for the noise.
        settings: Those of ``complete_together``.
    """
    rendered = RenderedFrame(list(views), targets, coverage, confidence=confidence)
    return complete_together(generator, [rendered], [Frame(tuple(source_images), sources)], [str(frame)], **settings)[0]


@torch.no_grad()
def complete_together(
    generator: GeneratorNetworks,
    rendered: Sequence[RenderedFrame],
    sources: Sequence[Frame],
    names: Sequence[str],
    *,
    min_confidence: float = 0.0,
    steps: int | None = None,
    guidance: float | None = None,
    seed: int = 0,
) -> list[Completed]:
    """Complete rendered frames of ``sources``; those with as many views to denoise share the denoiser's calls.

    The result depends on the seed, the frame and the cameras' names, not on the order of the cameras or on earlier
    calls. It is computed on the generator's device and returned on the views'.

    Args:
        names: Names of the frames, for the noise.
        min_confidence: Covered pixels below this confidence are generated too.
        steps: Denoising steps; 1 is the one-step regression. Default: the generator's.
        guidance: Classifier-free guidance; 1 is none. Default: the generator's.
        seed: Seed of the noise.

    Raises:
        SampleError: Images, maps and cameras that do not fit together.
        ValueError: Impossible ``min_confidence`` or ``seed``.
        GeneratorError: Impossible settings, one step of a generator that was not trained for it, a generator on a GPU
            in a DataLoader worker, or generated pixels that are not finite.
    """
    config = with_sampling(generator.config, steps, guidance)
    check_device(generator)
    checked_settings(min_confidence, seed)
    drafts = [_draft(*frame, min_confidence) for frame in zip(rendered, sources, names, strict=True)]
    alike: dict[tuple[int, int], list[_Draft]] = {}
    for draft in drafts:
        if draft.left:
            alike.setdefault((len(draft.left), len(draft.branches)), []).append(draft)
    for (count, _), group in alike.items():
        size = max(1, VIEWS_AT_ONCE // count)
        for together in (group[start : start + size] for start in range(0, len(group), size)):
            inputs, geometries, noise = zip(*(_inputs(draft, config, seed) for draft in together), strict=True)
            conditions = Conditions(*(torch.cat(part).to(generator.device) for part in zip(*inputs, strict=True)))
            geometry = batched(geometries).to(generator.device)
            done = denoised(generator, config, geometry, conditions, torch.cat(noise).to(generator.device))
            for draft, images in zip(together, done, strict=True):
                for m, image in zip(draft.left, images, strict=True):
                    if not bool(image.isfinite().all()):
                        raise GeneratorError(
                            f"frame {draft.name:.40}, camera {draft.rig[m].name!r}: expected finite pixels from "
                            f"generator {config.name!r}, got NaN or infinity: pass finite images, no float16, less "
                            "guidance"
                        )
                    draft.images[m] = _paste(image.clamp(0, 1), draft.images[m], draft.holes[m])
    return [Completed(stacked(draft.images), stacked(draft.holes), draft.left) for draft in drafts]


def with_sampling(config: GeneratorConfig, steps: int | None, guidance: float | None) -> GeneratorConfig:
    """The config with steps and guidance where given; GeneratorError where its generator cannot sample so."""
    own = config.guidance
    steps, guidance = config.steps if steps is None else steps, own if guidance is None else guidance
    config = replace(config, steps=steps, guidance=guidance)
    if config.steps == 1 and not config.one_step:
        raise GeneratorError(
            f"complete: expected steps >= 2, got 1: the one-step regression of generator {config.name!r} was not "
            "trained (loss.regression=0)"
        )
    if config.steps == 1 and guidance not in (1, own):
        raise GeneratorError(f"complete: expected no guidance with one step, which it cannot change, got {guidance}")
    return config


def _draft(rendered: RenderedFrame, source: Frame, name: str, min_confidence: float) -> _Draft:
    """Inpaint the views of a frame that are almost complete."""
    rig, images, left = rendered.rig.in_frame_of(source.rig), list(rendered.images), []
    if len(source.images) != len(source.rig):
        raise SampleError(f"complete: expected {len(source.rig)} source images, got {len(source.images)}")
    trust = rendered.coverage if rendered.confidence is None else rendered.confidence
    for one in (*images, *rendered.coverage, *trust, *source.images):
        if not isinstance(one, torch.Tensor):
            raise SampleError(f"complete: expected tensors, got {type(one).__name__}; pass torch.as_tensor(...)")
    _check_sizes(images, rendered.coverage, trust, rig)
    for camera, image in zip(source.rig, source.images, strict=True):
        if tuple(image.shape) != (3, *camera.size):
            expected, got = (3, *camera.size), tuple(image.shape)
            raise SampleError(f"camera {camera.name!r}: expected a source image {expected}, got {got}")
    types = {image.dtype for image in (*images, *source.images)}
    if any(dtype != torch.uint8 and not dtype.is_floating_point for dtype in types):
        raise SampleError(f"complete: expected images of uint8, or of floats in [0, 1], got {types}")
    known, holes = holes_of(rendered, min_confidence)
    for m, hole in enumerate(holes):
        if float(hole.float().mean()) > 1 - ALMOST_COMPLETE:
            left.append(m)
        elif bool(hole.any()):
            images[m] = torch.where(hole, telea(images[m], ~known[m]), images[m])
    branches = sorted({k for m in left for k in nearest_sources(rig[m], source.rig.cameras)})
    return _Draft(rig, trust, source, name, images, known, holes, left, branches)


def _inputs(draft: _Draft, config: GeneratorConfig, seed: int) -> tuple[Conditions, FrameGeometry, torch.Tensor]:
    """Conditions, cameras and noise of a frame's views that are left, on the CPU."""
    source, size = draft.source, config.image_size
    sources, targets = [source.rig[k] for k in draft.branches], [draft.rig[m] for m in draft.left]
    views = [_prefilled(draft.images[m], draft.known[m], draft.trust[m], size) for m in draft.left]
    images = [unit(resized(source.images[k], size)) for k in draft.branches]
    seen = [valid_pixels(camera.resize(size)).float() for camera in sources]
    conditions = Conditions(*(torch.stack(list(part))[None] for part in (*zip(*views, strict=True), images, seen)))
    # Noise of a (frame, camera) is drawn on the CPU: the same on every device.
    shape = config.autoencoder.latent_channels, *config.latent_size
    noise = [torch.randn(shape, generator=seeded(seed, draft.name, one.name)) for one in targets]
    return conditions, frame_geometry(targets, sources, source.rig.ground_z_m, config), torch.stack(noise)[None]


def denoised(
    generator: GeneratorNetworks,
    config: GeneratorConfig,
    geometry: FrameGeometry,
    conditions: Conditions,
    noise: torch.Tensor,
) -> torch.Tensor:
    """Sample the N targets of B frames from noise (B, N, C, h, w): (B, N, 3, H, W) float32, not yet cut to [0, 1].

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
    return autoencoder.decode(x0).float()


def shown_condition(config: GeneratorConfig, prefilled: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    """The condition (..., 3, H, W) as in training: inpainted, or with grey holes if the config is not ``prefilled``."""
    return prefilled if config.prefilled else torch.where(known[..., None, :, :] >= 0.5, prefilled, 0.5)


# --- pixels -----------------------------------------------------------------------------------------------------------
def _prefilled(
    image: torch.Tensor, known: torch.Tensor, trust: torch.Tensor, size: tuple[int, int]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A view at the generator's size with holes inpainted (3, H, W), its known share and its confidence (H, W).

    Colours are averaged over known pixels alone.
    """
    weight = known.float()[None]
    planes = torch.cat([unit(image) * weight, weight, (trust.float() * known)[None]])[None]
    if tuple(image.shape[-2:]) != size:
        planes = functional.interpolate(planes, size, mode="bilinear", antialias=True)
    colour, share, confidence = planes[0].split([3, 1, 1])
    filled = telea((colour / share.clamp(min=1e-3)).clamp(0, 1), share[0] < 0.5)
    return filled, share[0].clamp(0, 1), confidence[0].clamp(0, 1)


def _paste(generated: torch.Tensor, image: torch.Tensor, hole: torch.Tensor) -> torch.Tensor:
    """The view (3, h, w) with the generated image in its hole; all other pixels are unchanged."""
    generated = generated.to(image.device)
    if generated.shape != image.shape:
        generated = functional.interpolate(generated[None], image.shape[-2:], mode="bicubic", antialias=True)[0]
    generated = generated.clamp(0, 1)
    generated = (generated * 255).round() if image.dtype == torch.uint8 else generated
    return torch.where(hole, generated.to(image.dtype), image)


def unit(image: torch.Tensor) -> torch.Tensor:
    """An image, uint8 or in [0, 1], as float32 in [0, 1]."""
    return image.float() / 255 if image.dtype == torch.uint8 else image.float()


def valid_pixels(camera: Camera) -> torch.Tensor:
    """(H, W) bool: True on the scene, False on the camera's own car."""
    return torch.ones(camera.size, dtype=torch.bool) if camera.mask is None else torch.tensor(camera.mask)


def _check_sizes(views: Maps, coverage: Maps, trust: Maps, targets: Rig) -> None:
    counts = {"views": len(views), "coverage": len(coverage), "confidence": len(trust), "target cameras": len(targets)}
    if len(set(counts.values())) > 1:
        raise SampleError(f"complete: expected as many of each, got {counts}")
    for camera, *maps in zip(targets, views, coverage, trust, strict=True):
        got, seen = [tuple(one.shape) for one in maps], maps[1]
        if got != [(3, *camera.size), camera.size, camera.size]:
            expected = f"a view (3, h, w), coverage and confidence of {camera.size}"
            raise SampleError(f"camera {camera.name!r}: expected {expected}, got {got[0]}, {got[1]} and {got[2]}")
        if seen.dtype != torch.bool:
            raise SampleError(f"camera {camera.name!r}: coverage: expected bool, got {seen.dtype}; pass coverage > 0")
        low, high = float(maps[2].min()), float(maps[2].max())
        if not -0.01 < low <= high < 1.01:  # rounding aside
            raise SampleError(f"camera {camera.name!r}: confidence: expected 0 to 1, got {low:g} to {high:g}")
