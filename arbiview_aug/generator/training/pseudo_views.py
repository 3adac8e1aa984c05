"""Training items (Algorithm 1): a real view to reconstruct, and FAVS's pseudo views beside it.

For a real view, pseudo poses are drawn to its left and right, and FAVS renders the frame's cameras there. The pair is
the model's source branches and, warped to the target pose, its condition. FAVS of all cameras at the target pose would
be the answer itself. An item may have several targets, of neighbouring cameras, each with its pair. Added to it are
*transferred masks*: holes of real targets, imposed on the real view before FAVS, which hides them from the branches
too, or on the condition alone.

Item k is drawn from (seed, k) alone: a resumed run, or one with other workers, sees the same items.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch.utils.data import Dataset

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.errors import TrainingError
from arbiview_aug.favs.renderer import render_paper
from arbiview_aug.generator.completion import Conditions, unit, valid_pixels
from arbiview_aug.generator.conditioning import FrameGeometry, batched, frame_geometry, nearest_sources
from arbiview_aug.generator.config import GeneratorConfig
from arbiview_aug.generator.training.config import PseudoQuality, PseudoViewConfig
from arbiview_aug.generator.training.data import Frames
from arbiview_aug.inpaint.inpainter import seeded
from arbiview_aug.inpaint.telea import telea
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.render.rendered import Renderer
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.sample.frame import Frame

_YAW_DEG = (13.75, 35.0)  # the paper's rotations
_PITCH_DEG = (5.0, 12.0)
_FOCAL = (0.4, 0.85)  # of a 65° lens: 74 to 115°
_MIN_HOLES, _MAX_HOLES = 0.02, 0.75
_TRIES = 8
_FAVS = RenderConfig(certainty=True)


def uniform(rng: torch.Generator, low: float, high: float) -> float:
    """Draw a number from [low, high)."""
    return low + (high - low) * float(torch.rand((), generator=rng, dtype=torch.float64))


def one_of(rng: torch.Generator, count: int) -> int:
    """Draw an index below ``count``."""
    return int(torch.randint(count, (), generator=rng))


def retarget(camera: Camera, rng: torch.Generator) -> Camera:
    """Draw a target camera without a mask: turned aside, pitched, or with a wider lens."""
    camera = replace(camera, mask=None)
    kind, sign = one_of(rng, 3), 1 if one_of(rng, 2) else -1
    if kind == 0:
        return camera.turned(yaw_deg=sign * uniform(rng, *_YAW_DEG))
    if kind == 1:
        return camera.turned(pitch_deg=sign * uniform(rng, *_PITCH_DEG), yaw_deg=uniform(rng, -8, 8))
    return with_focal(camera, uniform(rng, *_FOCAL))


def with_focal(camera: Camera, factor: float) -> Camera:
    """The camera with its focal lengths scaled about the principal point."""
    K = camera.K.copy()
    K[:2, :2] *= factor
    return replace(camera, K=K)


def mask_bank(rig: Rig, count: int, seed: int) -> torch.Tensor:
    """Draw hole masks: (count, h, w) bool FAVS coverage of cameras from the retarget distribution, holes of 2 to 75 %.

    Algorithm 1 alone hardly trains hole filling: its pseudo pair shows 89 to 100 % of the real view. All cameras of the
    rig have one size.
    """
    rng = torch.Generator().manual_seed(seed)
    masks: list[np.ndarray] = []
    while len(masks) < count:
        for _ in range(_TRIES):
            camera = retarget(rig[one_of(rng, len(rig))], rng)
            covered = build_plan(rig, Rig([camera], ground_z_m=rig.ground_z_m), geometry="infinity").coverage[0]
            if _MIN_HOLES <= 1 - covered.mean() <= _MAX_HOLES:
                break
        else:  # the rig covers everything or almost nothing: a hole at the side
            covered = np.ones(rig[0].size, bool)
            covered[:, : max(1, round(covered.shape[1] * uniform(rng, 0.1, 0.5)))] = False
        masks.append(covered)
    return torch.from_numpy(np.stack(masks))


class Batch(NamedTuple):
    """B items, each with N target views and S = 2 N source branches; images in [0, 1], float32."""

    truth: torch.Tensor  # (B, N, 3, H, W) the real views
    valid: torch.Tensor  # (B, N, H, W) bool, their valid pixels
    favs: torch.Tensor  # (B, N, 3, H, W) FAVS of the pair at the target pose, black in holes
    condition: torch.Tensor  # (B, N, 3, H, W) the same, with holes inpainted
    known: torch.Tensor  # (B, N, H, W) bool, coverage of ``favs``
    confidence: torch.Tensor  # (B, N, H, W) in [0, 1]
    sources: torch.Tensor  # (B, S, 3, H, W)
    seen: torch.Tensor  # (B, S, H, W) bool, valid pixels of the sources
    geometry: FrameGeometry  # of their cameras
    tokens: tuple[str, ...]  # names of the items

    def to(self, device: torch.device | str) -> Batch:
        return Batch._make([*(value.to(device) for value in self[:-1]), self.tokens])

    @property
    def conditions(self) -> Conditions:
        return Conditions(self.condition, self.known, self.confidence, self.sources, self.seen)

    @property
    def holes(self) -> torch.Tensor:
        """(B, N, H, W) bool: valid pixels that FAVS does not show."""
        return self.valid & ~self.known


def collate(items: Sequence[Batch]) -> Batch:
    """One batch of items with as many targets; TrainingError, which names the frame, if they have not."""
    for item in items:
        expected, got = items[0].truth.shape[1], item.truth.shape[1]
        if got != expected:
            fix = "train on frames of as many cameras, or with pseudo_views.targets=1"
            raise TrainingError(f"frame {item.tokens[0]}: expected {expected} cameras as in others, got {got}: {fix}")
    *tensors, geometries, tokens = zip(*items, strict=True)
    return Batch._make([*map(torch.cat, tensors), batched(geometries), tuple(itertools.chain(*tokens))])


class Rendered(NamedTuple):
    """FAVS at M target cameras: images (M, 3, h, w) in [0, 1], coverage (M, h, w) bool, confidence (M, h, w)."""

    images: torch.Tensor
    covered: torch.Tensor
    confidence: torch.Tensor


def favs(
    images: Sequence[torch.Tensor], rig: Rig, targets: Sequence[Camera], quality: PseudoQuality = "fast"
) -> Rendered:
    """Render N images (3, H, W), uint8 or in [0, 1], at M target cameras of one size in the rig's ego frame by FAVS.

    Over ``infinity`` if all centres coincide, else over ``street``: training has images and poses alone. The
    published stages (``paper``) know ``infinity`` alone, run on the CPU and have no confidence: it is 1 where they see.
    """
    target = Rig([replace(c, name=str(k), mask=None) for k, c in enumerate(targets)], ground_z_m=rig.ground_z_m)
    if quality == "paper":
        published = render_paper(rig, target, [image.cpu() for image in images])
        covered = torch.from_numpy(np.stack(published.coverage)).to(images[0].device)
        views = unit(torch.stack([view.image for view in published.targets])).clamp(0, 1)
        return Rendered(views.to(covered.device), covered, covered.float())
    is_moved = any(
        abs(c.center_m - rig[k].center_m).max() > 1e-6 for c in targets for k in nearest_sources(c, rig.cameras)[:1]
    )
    plan = build_plan(rig, target, geometry="street" if is_moved else "infinity", config=_FAVS)
    (rendered,) = Renderer().render([plan], [Frame(tuple(images), rig)], [None], ("confidence",))
    assert isinstance(rendered.coverage, torch.Tensor) and isinstance(rendered.confidence, torch.Tensor)  # one size
    return Rendered(unit(torch.stack(rendered.images)).clamp(0, 1), rendered.coverage, rendered.confidence)


@dataclass(eq=False)
class PseudoViews(Dataset[Batch]):
    """Items 0, 1, 2, …, without end, drawn from the frames ``indices``.

    Masks (n, h, w) bool are transferred. FAVS renders on ``device``, which is the CPU in workers.
    """

    frames: Frames
    indices: Sequence[int]
    config: PseudoViewConfig
    generator: GeneratorConfig
    masks: torch.Tensor
    seed: int
    device: torch.device | str = "cpu"

    def __getitem__(self, k: int) -> Batch:
        config, rng = self.config, seeded(self.seed, "view", k)
        frame = self.frames[self.indices[one_of(rng, len(self.indices))]]
        frame = frame._replace(images=[image.to(self.device) for image in frame.images])
        first = one_of(rng, len(frame.rig))
        axes = [camera.cam2ego[:3, 2] for camera in frame.rig]
        places = sorted(range(len(axes)), key=lambda i: (i != first, -float(axes[i] @ axes[first])))[: config.targets]
        targets = [frame.rig[i] for i in places]
        rng = seeded(self.seed, "pair", k)
        # --- FAVS's sources
        is_transferred = uniform(rng, 0, 1) < config.p_mask_transfer
        is_hidden = uniform(rng, 0, 1) < config.hidden
        masks = [self.masks[one_of(rng, len(self.masks))] for _ in places]
        cameras = list(frame.rig)
        for i, mask in zip(places, masks, strict=True) if is_transferred and is_hidden else ():
            own_mask = cameras[i].mask
            cameras[i] = replace(cameras[i], mask=mask.numpy() if own_mask is None else own_mask & mask.numpy())
        rig = frame.rig.with_cameras(cameras)
        # --- the pairs, and their views at the target poses
        branches: list[Camera] = []
        shown, pseudo = [], []
        for target, mask in zip(targets, masks, strict=True):
            pair = self._pair(target, rng)
            pseudo.append(favs(frame.images, rig, pair, config.quality))
            masked = [replace(c, mask=seen.cpu().numpy()) for c, seen in zip(pair, pseudo[-1].covered, strict=True)]
            branches += masked  # views must not read each other's holes
            at_target = favs(list(pseudo[-1].images), Rig(masked, ground_z_m=rig.ground_z_m), [target], config.quality)
            if is_transferred and not is_hidden:
                at_target = at_target._replace(covered=at_target.covered & mask.to(at_target.covered.device))
            shown.append(at_target)
        view_at, known, confidence = (torch.cat(maps) for maps in zip(*shown, strict=True))
        view_at = view_at * known[:, None]
        sources, seen, _ = (torch.cat(maps) for maps in zip(*pseudo, strict=True))
        geometry = frame_geometry(targets, branches, rig.ground_z_m, self.generator)
        return Batch(
            torch.stack([unit(frame.images[i]) for i in places])[None],
            torch.stack([valid_pixels(camera).to(known.device) for camera in targets])[None],
            view_at[None],
            torch.stack([telea(image, ~is_known) for image, is_known in zip(view_at, known, strict=True)])[None],
            known[None],
            (confidence * known)[None],
            (sources * seen[:, None])[None],
            seen[None],
            geometry,
            (f"{frame.token}/{frame.rig[first].name}/{k}",),
        )

    def _pair(self, target: Camera, rng: torch.Generator) -> list[Camera]:
        """Draw a pseudo pose to the left and one to the right of a camera, without masks."""
        config, target = self.config, replace(target, mask=None)
        is_moved = uniform(rng, 0, 1) < config.p_translate
        cameras = []
        for name, side in (("left", 1), ("right", -1)):
            yaw, pitch = side * uniform(rng, *config.yaw_deg), uniform(rng, -config.pitch_deg, config.pitch_deg)
            camera = with_focal(target.turned(yaw_deg=yaw, pitch_deg=pitch), uniform(rng, *config.focal))
            aside, up = (uniform(rng, -half, half) for half in (config.lateral_m, config.vertical_m))
            if is_moved:
                x_m, y_m = (-abs(aside) * side * target.cam2ego[:2, 0]).tolist()  # to the pose's own side
                camera = camera.shifted(x_m, y_m, up)
            cameras.append(replace(camera, name=name))
        return cameras
