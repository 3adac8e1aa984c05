"""Training frames of any reader, split by scenes (Sec. Dataset), and the items made of them (Algorithm 1).

An item is a real view to reconstruct, and pseudo views of its frame.

The frame is rendered at a pseudo rig: the frame's rig turned, zoomed and moved, drawn as ``RandomRig`` draws. The
pseudo views nearest to the real view are the model's source branches. Rendered back to the real camera, the pseudo
views are its condition, with the holes, smears and seams that retargeting makes. The real view itself is the target.
With ``quality="paper"`` the pseudo rig is a pair, turned to the left and to the right of one camera, as published.

Item k is drawn from (seed, k) alone: a resumed run, or one with other workers, sees the same items.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch.utils._pytree import tree_map
from torch.utils.data import Dataset, get_worker_info

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.random_rig import RandomRig
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.datasets.drive import Neighbours
from arbiview_aug.datasets.frame_folder import SEQUENCE_FILE
from arbiview_aug.datasets.nuscenes.reader import NuScenesDataset
from arbiview_aug.datasets.registry import READERS, open_data
from arbiview_aug.datasets.synthetic import SyntheticDrive, demo_source_rig
from arbiview_aug.errors import TrainingError
from arbiview_aug.favs.renderer import as_rendered, render_paper
from arbiview_aug.generator.attention import joined
from arbiview_aug.generator.completion import unit, valid_pixels
from arbiview_aug.generator.conditioning import SOURCES_PER_TARGET, Branches, frame_geometry
from arbiview_aug.generator.config import GeneratorConfig, PseudoQuality, PseudoViewConfig
from arbiview_aug.image_ops import resized
from arbiview_aug.inpaint.continued import Continue
from arbiview_aug.inpaint.inpainter import seeded
from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.plan import RenderConfig
from arbiview_aug.render.rendered import Renderer, Views
from arbiview_aug.render.view_planner import build_plan
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import read_frames, read_scene
from arbiview_aug.temporal.motion_depth import without_objects

# --- frames -----------------------------------------------------------------------------------------------------------
SHARES = (0.6, 0.2)  # shares of the scenes for training and validation; the rest are held out (Sec. Dataset)
_BLOCKS = 10  # number of scenes into which a drive without scenes is cut
_MOVING_MPS = 0.5  # of a box: noise of labels between two annotations is slower
CACHE_BYTES = 4 * 2**30  # memory for frames, of all workers together: 8,000 of six 128 x 224 images


class Split(NamedTuple):
    training: list[int]
    validation: list[int]
    held_out: list[int]


class Frames:
    """Frames of a map-style data set at the training size (h, w), cached in memory.

    A frame's ``further`` holds its ``token``, and as ``moving`` the boxes (M, 7) that move by velocities or neighbours.
    ``scenes`` names each frame's, ``name`` the data set as ``TrainedOn.data`` does.
    """

    def __init__(
        self, dataset: Dataset[dict[str, Any]], size: tuple[int, int], scenes: Sequence[str], name: str = ""
    ) -> None:
        self.dataset, self.size, self.scenes, self.name = dataset, size, list(scenes), name
        self._cache: LRUCache[int, Frame] = LRUCache(
            CACHE_BYTES, lambda frame: sum(part.nbytes for part in (*frame.images, frame.points) if part is not None)
        )

    def __len__(self) -> int:
        return len(self.scenes)

    def __getitem__(self, index: int) -> Frame:
        worker = get_worker_info()
        if worker is not None:
            self._cache.limit = CACHE_BYTES // worker.num_workers
        return self._cache.get(index, lambda: self._read(index))

    def _read(self, index: int) -> Frame:
        (frame,) = read_frames(self.dataset[index], None, "auto", further=("neighbours",), names=("token",))
        moving = [near.moved for near in frame.neighbours or () if near.moved is not None]
        points, boxes = (None if part is None else np.asarray(part) for part in (frame.points, frame.boxes))
        if boxes is not None and boxes.ndim == 2:
            moving.append(boxes[np.linalg.norm(boxes[:, 7:9], axis=1) > _MOVING_MPS, :7])  # unknown speeds are NaN
        further = {**frame.further, "moving": np.concatenate([np.zeros((0, 7)), *moving])}
        images, rig = tuple(resized(image, self.size) for image in frame.images), frame.rig.resized(self.size)
        return Frame(images, rig, points, boxes, further=further)

    def split(self, seed: int = 0) -> Split:
        """Split 60/20/20 by whole scenes; depends on the seed and the scenes' names alone.

        One of at least two scenes is held out; two and three have no validation part.
        """
        names = sorted(set(self.scenes))
        order = torch.randperm(len(names), generator=torch.Generator().manual_seed(seed)).tolist()
        first = max(1, round(SHARES[0] * len(names)))
        second = max(first, min(first + round(SHARES[1] * len(names)), len(names) - 1))
        parts = ({names[k] for k in part} for part in (order[:first], order[first:second], order[second:]))
        return Split(*([index for index, scene in enumerate(self.scenes) if scene in part] for part in parts))


def open_frames(data: str, size: tuple[int, int], *, scenes: int, seed: int = 0) -> Frames:
    """Open the frames (h, w) that ``--data`` names: ``KIND:PATH``, or a number of synthetic ``scenes``.

    TrainingError for an unknown kind, DataError for a folder without such data.
    """
    kind, _, folder = data.partition(":")
    if data == "synthetic":
        drive = SyntheticDrive(demo_source_rig(size), num_frames=scenes, seed=seed)
        return Frames(drive, size, [str(k) for k in range(scenes)], data)
    if kind not in READERS or not folder:
        raise TrainingError(f"--data {data}: expected synthetic, {' or '.join(f'{name}:PATH' for name in READERS)}")
    dataset = open_data(data, neighbours=Neighbours())
    is_drive, names = (dataset.root / SEQUENCE_FILE).is_file(), dataset.tokens
    if kind == "py123d":
        names = [token.rpartition("-")[0] for token in names]  # of the logs
        is_drive = len(set(names)) == 1
    if isinstance(dataset, NuScenesDataset):
        names = dataset.scene_tokens
    elif is_drive:  # cut into blocks: frames next to each other show the same street
        names = [f"block {_BLOCKS * k // len(dataset)}" for k in range(len(dataset))]
    return Frames(dataset, size, names, f"{kind}:{Path(folder).resolve()}")


# --- items ------------------------------------------------------------------------------------------------------------
_CONFIG = RenderConfig(certainty=True, layers=True)  # layers are for the default fill


class Batch(NamedTuple):
    """B items, each with N target views and S source branches; images in [0, 1], float32."""

    truth: torch.Tensor  # (B, N, 3, H, W) the real views
    valid: torch.Tensor  # (B, N, H, W) bool, the pixels that count: no own car, nothing that moves
    favs: torch.Tensor  # (B, N, 3, H, W) the pseudo views rendered at the target poses, black in holes
    targets: Branches  # the same, with holes filled as by default
    sources: Branches  # the pseudo views
    tokens: tuple[str, ...]  # names of the items

    def to(self, device: torch.device | str) -> Batch:
        tensors: Any = tree_map(lambda tensor: tensor.to(device, non_blocking=True), self[:-1])
        return Batch._make((*tensors, self.tokens))

    @property
    def holes(self) -> torch.Tensor:
        """(B, N, H, W) bool: valid pixels that no pseudo view shows."""
        return self.valid & ~self.targets.known


def collate(items: Sequence[Batch]) -> Batch:
    """One batch of items with as many targets and sources; TrainingError, which names the frame, if they have not."""
    for item in items:
        expected, got = (views.sources.images.shape[1] for views in (items[0], item))  # one more than targets, at best
        if got != expected:
            fix = "train on frames of as many cameras, or with fewer pseudo_views.targets"
            raise TrainingError(
                f"frame {item.tokens[0]}: expected {expected} pseudo views as in others, got {got}: {fix}"
            )
    return Batch(*joined([item[:-1] for item in items]), tuple(token for item in items for token in item.tokens))


def rendered(frame: Frame, targets: Sequence[Camera], quality: PseudoQuality = "fast") -> Views:
    """Render a frame at M target cameras of one size in its ego frame, over the geometry that it has (``auto``).

    The published stages (``paper``) are limited to ``infinity``, run on the CPU and give no confidence: it is 1 where
    they see.
    """
    target = Rig([replace(camera, name=str(k)) for k, camera in enumerate(targets)], ground_z_m=frame.rig.ground_z_m)
    device = frame.images[0].device
    if quality == "paper":
        views = as_rendered(render_paper(frame.rig, target, [image.cpu() for image in frame.images]))
        views = replace(views, confidence=views.coverage)
    else:
        plan = build_plan(frame.rig, target, geometry="auto", config=_CONFIG, scene=read_scene(frame, "auto"))
        (views,) = Renderer().render([plan], [frame], [None], ("confidence",))
    images = [unit(image).clamp(0, 1).to(device) for image in views.images]
    return replace(views.with_maps(lambda maps, _: [view.to(device) for view in maps]), images=images)


@dataclass(eq=False)
class PseudoViews(Dataset[Batch]):
    """Items 0, 1, 2, …, without end, drawn from the frames ``indices``.

    Pseudo views are rendered on ``device``, which is the CPU in workers.
    """

    frames: Frames
    indices: Sequence[int]
    config: PseudoViewConfig
    generator: GeneratorConfig
    seed: int
    device: torch.device | str = "cpu"

    def __getitem__(self, k: int) -> Batch:
        config, rng = self.config, seeded(self.seed, "view", k)
        frame = self.frames[self.indices[int(torch.randint(len(self.indices), (), generator=rng))]]
        frame = replace(frame, images=tuple(image.to(self.device) for image in frame.images))
        rig, first = frame.rig, int(torch.randint(len(frame.rig), (), generator=rng))
        axes = np.stack([camera.cam2ego[:3, 2] for camera in rig])
        places = sorted(range(len(rig)), key=lambda i: (i != first, -float(axes[i] @ axes[first])))[: config.targets]
        targets = [replace(rig[i], mask=None) for i in places]
        pseudo_rig = self._pseudo_rig(rig, targets[0], seeded(self.seed, "pair", k))
        pseudo = rendered(frame, pseudo_rig.cameras, config.quality)
        # Views must not read each other's holes.
        masked = [replace(c, mask=seen.cpu().numpy()) for c, seen in zip(pseudo_rig, pseudo.coverage, strict=True)]
        there = replace(frame, images=tuple(pseudo.images), rig=pseudo_rig.with_cameras(masked))
        back = rendered(there, targets, config.quality)
        maps = back.coverage, back.confidence or (), pseudo.coverage
        known, confidence, seen = (torch.stack([*part]) for part in maps)
        favs = torch.stack(back.images) * known[:, None]
        (filled,) = Continue().fill([replace(back, images=list(favs.clone()))], [there])
        likeness = [max(float(camera.cam2ego[:3, 2] @ axes[i]) for i in places) for camera in masked]
        nearest = sorted(sorted(range(len(masked)), key=lambda i: -likeness[i])[: SOURCES_PER_TARGET + len(places) - 1])
        sources, seen = torch.stack(pseudo.images)[nearest], seen[nearest]
        moving = frame.further["moving"]
        valid = [valid_pixels(without_objects(rig[i], moving)).to(self.device) for i in places]
        geometry = frame_geometry(targets, [masked[i] for i in nearest], rig.ground_z_m, self.generator)
        return Batch(
            torch.stack([unit(frame.images[i]) for i in places])[None],
            torch.stack(valid)[None],
            favs[None],
            Branches(torch.stack(filled.images)[None], known[None], (confidence.float() * known)[None], geometry[0]),
            Branches((sources * seen[:, None])[None], seen[None], seen[None], geometry[1]),
            (f"{frame.further['token']}/{rig[first].name}/{k}",),
        )

    def _pseudo_rig(self, rig: Rig, target: Camera, rng: torch.Generator) -> Rig:
        """Draw a pseudo rig; as published, a pose to the left of the target and one to its right."""
        if self.config.quality == "fast":
            around = RandomRig(rig, **self.config.ranges)
            return around.rig(around.draw(rng))
        around = RandomRig(Rig([target], ground_z_m=rig.ground_z_m), **self.config.ranges)
        left, right = around.draw(rng), around.draw(rng)
        pair = [around.rig(left)[0], around.rig({**right, "yaw_deg": -right["yaw_deg"]})[0]]
        return around.base.with_cameras([replace(c, name=n) for c, n in zip(pair, ("left", "right"), strict=True)])
