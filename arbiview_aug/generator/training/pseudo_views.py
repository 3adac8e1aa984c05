"""Training items (Algorithm 1): a real view to reconstruct, from pseudo views beside it that FAVS makes of its frame.

For a real view, pseudo poses are drawn to its left and right, FAVS renders the frame's cameras there, and the pair is
what the model gets: its source branches, and, warped to the target pose, its condition. Never FAVS of all cameras at
the target pose: that is the answer. Besides, each by its own probability:

- *transplanted masks*: holes as targets have them, put on the real view before FAVS sees it, so that no branch shows
  what they hide; or on the condition alone, so that the branches do;
- *leave-one-out*: FAVS does not get the real view at all;
- *virtual targets*: the target is the real view under a random turn and focal length, the loss on valid pixels alone;
- *real sources*: the branches are the nearest real cameras, as at inference.

Item k is drawn from (seed, k) alone: a resumed run, or one with other workers, sees the same.
"""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch.utils.data import Dataset

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.favs.config import FavsConfig
from arbiview_aug.generator.completion import nearest_sources
from arbiview_aug.generator.config import GeneratorConfig
from arbiview_aug.generator.geometry import FrameGeometry, batched, frame_geometry
from arbiview_aug.generator.inpainting import telea
from arbiview_aug.generator.training.config import PseudoViewConfig
from arbiview_aug.generator.training.data import Frames
from arbiview_aug.generator.training.masks import one_of, uniform, with_focal
from arbiview_aug.render.confidence import confidence
from arbiview_aug.render.opencv_backend import render_opencv
from arbiview_aug.render.plan import build_plan
from arbiview_aug.render.torch_backend import render_torch

_VIRTUAL_YAW_DEG, _VIRTUAL_PITCH_DEG = 20.0, 8.0
_FAVS = FavsConfig(certainty=True)


class Batch(NamedTuple):
    """B items, each with N = 1 target view and S = 2 source branches; images in [0, 1], float32.

    Attributes:
        truth: (B, N, 3, H, W) the real view.
        valid: (B, N, H, W) bool, where it is known.
        favs: (B, N, 3, H, W) FAVS of the pair at the target pose, black where it shows nothing.
        condition: (B, N, 3, H, W) the same, its holes inpainted.
        known: (B, N, H, W) bool, what it shows.
        confidence: (B, N, H, W) in [0, 1].
        sources: (B, S, 3, H, W).
        seen: (B, S, H, W) bool, what they show.
        geometry: Of their cameras.
        tokens: Name the items.
    """

    truth: torch.Tensor
    valid: torch.Tensor
    favs: torch.Tensor
    condition: torch.Tensor
    known: torch.Tensor
    confidence: torch.Tensor
    sources: torch.Tensor
    seen: torch.Tensor
    geometry: FrameGeometry
    tokens: tuple[str, ...]

    def to(self, device: torch.device | str) -> Batch:
        """The same on a device."""
        moved: dict[str, Any] = {
            name: value.to(device) for name, value in self._asdict().items() if isinstance(value, torch.Tensor)
        }
        return self._replace(**moved, geometry=self.geometry.to(device))

    @property
    def holes(self) -> torch.Tensor:
        """(B, N, H, W) bool: known to us, not shown by FAVS."""
        return self.valid & ~self.known


def collate(items: Sequence[Batch]) -> Batch:
    """One batch of items."""
    named = items[0]._asdict().items()
    tensors: dict[str, Any] = {
        name: torch.cat([getattr(item, name) for item in items])
        for name, value in named
        if isinstance(value, torch.Tensor)
    }
    return items[0]._replace(
        **tensors,
        geometry=batched([item.geometry for item in items]),
        tokens=tuple(token for item in items for token in item.tokens),
    )


class Rendered(NamedTuple):
    """What FAVS shows of M target cameras: (M, 3, h, w) float32, (M, h, w) bool, (M, h, w) in [0, 1]."""

    images: torch.Tensor
    covered: torch.Tensor
    confidence: torch.Tensor


def favs(images: Sequence[torch.Tensor], rig: Rig, targets: Sequence[Camera]) -> Rendered:
    """FAVS of some cameras at target poses of the same ego frame.

    Far away where all centres coincide, else over the street: the paper's training gets images and poses alone. By
    OpenCV for images on the CPU, else by torch.

    Args:
        images: N images (3, H, W), uint8 or in [0, 1].
        rig: Their cameras.
        targets: M cameras of one size.
    """
    target = Rig([replace(c, name=str(k), mask=None) for k, c in enumerate(targets)], ground_z_m=rig.ground_z_m)
    moved = any(abs(c.center_m - rig[k].center_m).max() > 1e-6 for c in targets for k in nearest_sources(c, rig)[:1])
    plan = build_plan(rig, target, surface="street" if moved else "far", config=_FAVS)
    seams: list[torch.Tensor] = []
    if images[0].device.type == "cpu":
        views = render_opencv(plan, images, seams=seams)
    else:
        changes: list[torch.Tensor] = []
        views = [view[0] for view in render_torch(plan, [image[None] for image in images], seams=changes)]
        seams = [change[0] for change in changes]
    covered = [torch.from_numpy(c).to(views[0].device) for c in plan.coverage]
    trust = []
    for view, made, seen, seam in zip(views, plan.targets, covered, seams, strict=True):
        trust.append(seen.float() if made.certainty is None else confidence(view, made.certainty, seen, seam))
    unit = torch.stack(views).float()
    if views[0].dtype == torch.uint8:
        unit = unit / 255
    return Rendered(unit.clamp(0, 1), torch.stack(covered), torch.stack(trust))


class PseudoViews(Dataset[Batch]):
    """Items 0, 1, 2, …, without end.

    Args:
        frames: The data.
        indices: Which of the frames.
        config: Settings.
        generator: Of the generator: sizes and depth levels.
        masks: (n, h, w) bool to transplant.
        seed: Of all draws.
        device: Where FAVS renders: workers cannot use a GPU.
    """

    def __init__(
        self,
        frames: Frames,
        indices: Sequence[int],
        config: PseudoViewConfig,
        generator: GeneratorConfig,
        masks: torch.Tensor,
        seed: int,
        device: torch.device | str = "cpu",
    ) -> None:
        self.device = device
        self.frames, self.indices, self.config = frames, list(indices), config
        self.generator, self.masks, self.seed = generator, masks, seed

    def __getitem__(self, k: int) -> Batch:
        config, view = self.config, k // self.config.pairs
        rng = self._rng("view", view)
        frame = self.frames[self.indices[one_of(rng, len(self.indices))]]
        frame = frame._replace(images=[image.to(self.device) for image in frame.images])
        i = one_of(rng, len(frame.rig))
        target, truth, valid = self._target(frame.images[i], frame.rig[i], rng)
        rng = self._rng("pair", k)
        # --- what FAVS gets
        transplanted = uniform(rng, 0, 1) < config.transplanted
        hidden = uniform(rng, 0, 1) < config.hidden
        mask = self.masks[one_of(rng, len(self.masks))]
        left_out = uniform(rng, 0, 1) < config.leave_one_out and len(frame.rig) > 1
        images, cameras = list(frame.images), list(frame.rig)
        if left_out:
            del images[i], cameras[i]
        elif transplanted and hidden:
            cameras[i] = _masked(cameras[i], mask)
        rig = frame.rig.with_cameras(cameras)
        # --- the pair, and what it shows at the target pose
        pair = self._pair(target, rng)
        pseudo = favs(images, rig, pair)
        of_pair = Rig(
            [replace(c, mask=seen.cpu().numpy()) for c, seen in zip(pair, pseudo.covered, strict=True)],
            ground_z_m=rig.ground_z_m,
        )
        at_target = favs(list(pseudo.images), of_pair, [target])
        known, trust = at_target.covered[0], at_target.confidence[0]
        if transplanted and not hidden:
            known = known & mask.to(known.device)
        shown = at_target.images[0] * known
        filled = telea(shown, ~known)
        # --- the source branches
        sources, seen, branches = pseudo.images, pseudo.covered, list(pair)
        real = uniform(rng, 0, 1) < config.real_sources
        answer = not (left_out or (transplanted and hidden))
        if real and len(cameras) > 2:
            kept = [n for n in range(len(cameras)) if not (answer and n == i)]
            near = nearest_sources(target, rig.with_cameras([cameras[n] for n in kept]))
            used = [kept[n] for n in near]
            branches = [cameras[n] for n in used]
            seen = torch.stack([_seen(camera).to(known.device) for camera in branches])
            sources = torch.stack([images[n].float() / 255 for n in used])
        geometry = frame_geometry([target], branches, rig.ground_z_m, self.generator)
        return Batch(
            truth[None, None],
            valid[None, None],
            shown[None, None],
            filled[None, None],
            known[None, None],
            (trust * known)[None, None],
            (sources * seen[:, None])[None],
            seen[None],
            geometry,
            (f"{frame.token}/{frame.rig[i].name}/{k}",),
        )

    # --- draws --------------------------------------------------------------------------------------------------------
    def _rng(self, what: str, number: int) -> torch.Generator:
        digest = hashlib.sha256(repr((self.seed, what, number)).encode()).digest()
        return torch.Generator().manual_seed(int.from_bytes(digest[:8], "little") >> 1)

    def _target(
        self, image: torch.Tensor, camera: Camera, rng: torch.Generator
    ) -> tuple[Camera, torch.Tensor, torch.Tensor]:
        """The target camera, its true image (3, h, w) in [0, 1], and where that is known (h, w)."""
        virtual = uniform(rng, 0, 1) < self.config.virtual
        yaw, pitch = (uniform(rng, -limit, limit) for limit in (_VIRTUAL_YAW_DEG, _VIRTUAL_PITCH_DEG))
        focal = uniform(rng, *self.config.focal)
        if not virtual:
            return camera, image.float() / 255, _seen(camera).to(image.device)
        target = replace(with_focal(camera.turned(yaw_deg=yaw, pitch_deg=pitch), focal), mask=None)
        made = favs([image], Rig([camera]), [target])
        return target, made.images[0], made.covered[0]

    def _pair(self, target: Camera, rng: torch.Generator) -> list[Camera]:
        """A pseudo pose to the left and one to the right of a camera."""
        config = self.config
        moved = uniform(rng, 0, 1) < config.moved
        cameras = []
        for name, side in (("left", 1), ("right", -1)):
            yaw, pitch = side * uniform(rng, *config.yaw_deg), uniform(rng, -config.pitch_deg, config.pitch_deg)
            camera = with_focal(target.turned(yaw_deg=yaw, pitch_deg=pitch), uniform(rng, *config.focal))
            aside, up = (uniform(rng, -half, half) for half in (config.lateral_m, config.vertical_m))
            if moved:
                right = target.cam2ego[:3, 0]
                x_m, y_m = (-abs(aside) * side * right[:2]).tolist()  # to the pose's own side
                camera = camera.shifted(x_m, y_m, up)
            cameras.append(replace(camera, name=name, mask=None))
        return cameras


def _masked(camera: Camera, mask: torch.Tensor) -> Camera:
    seen = mask.numpy()
    return replace(camera, mask=seen if camera.mask is None else camera.mask & seen)


def _seen(camera: Camera) -> torch.Tensor:
    return torch.ones(camera.size, dtype=torch.bool) if camera.mask is None else torch.tensor(camera.mask)
