"""SyntheticDrive: a map-style dataset of street scenes seen by any rig, with ground truth."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.data import Dataset

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import is_whole
from arbiview_aug.datasets.drive import LazyFrame, Neighbours, camera_fields, check_neighbours, checked_index
from arbiview_aug.datasets.synthetic.render import Renderer, cast, find_candidates, scene_from, small_steps
from arbiview_aug.datasets.synthetic.scene import GROUND_ID, FloatArray, IntArray, Material, Scene, SceneClass
from arbiview_aug.datasets.synthetic.street import make_scene
from arbiview_aug.sample.batching import stacked

NOISE_M = 0.02  # one sigma of the range

Rays = npt.NDArray[np.float32] | FloatArray

_street = lru_cache(maxsize=4)(make_scene)  # drives of several rigs look at the same streets


class RenderedViews(NamedTuple):
    """Ground truth for one rig: tensors (N, ...) if all cameras have one size, else lists of N.

    Attributes:
        images: (3, h, w) uint8 RGB per camera; black where the lens sees nothing.
        depth_m: (h, w) float32 z in the camera frame along the ray through each pixel's centre; infinite for the sky
            and where the lens sees nothing; negative past 90 degrees off a fisheye's axis.
        classes: (h, w) uint8 ``SceneClass`` of that ray.
        instances: (h, w) int16 row of ``boxes_3d`` of that ray, or -1.
    """

    images: Tensor | list[Tensor]
    depth_m: Tensor | list[Tensor]
    classes: Tensor | list[Tensor]
    instances: Tensor | list[Tensor]


class SyntheticDrive(Dataset[dict[str, Any]]):
    """Procedural streets as camera samples with LiDAR-like points and 3D boxes, in the rig's ego frame.

    Scene ``index`` depends on (seed, index) alone: different rigs see the same street from the same place on its road.

    ``drive[i]`` is a dict: ``images`` (N, 3, h, w) uint8 (a list where sizes differ), ``rig``, ``K`` (N, 3, 3) and
    ``cam2ego`` (N, 4, 4) float64, ``points`` (P, 4) float32 x y z intensity (0 to 255), ``boxes_3d`` (B, 7) float32
    centre x y z, length, width, height, yaw, ``box_classes`` (B,) int64 ``BoxClass``, ``token``; with ``neighbours``
    also ``ego2world`` (4, 4) float64 and ``time_s``, and the same street a little earlier and later, when the vehicle
    and the traffic were elsewhere (``Scene.after``).

    Args:
        rig: The cameras; masked pixels are rendered too.
        num_frames: Length of the dataset.
        seed: Seed of the world, not negative.
        supersampling: Rays across a pixel at outlines; 1 for no antialiasing.
        lidar: Whether samples carry ``points``.
        neighbours: Selection of other frames of the drive to add; None for none.

    Raises:
        TypeError: A ``rig`` or ``neighbours`` of another type.
        ValueError: A count or seed out of range.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        num_frames: int,
        seed: int = 0,
        supersampling: int = 2,
        lidar: bool = True,
        neighbours: Neighbours | None = None,
    ) -> None:
        self.rig = _checked_rig(rig)
        self.num_frames = _checked_count("num_frames", num_frames, 1, 1 << 40)
        self.seed = _checked_count("seed", seed, 0, 1 << 60)
        self.lidar = lidar
        check_neighbours(neighbours)
        self.neighbours = neighbours
        self._renderer = Renderer(supersampling=_checked_count("supersampling", supersampling, 1, 8))

    def __len__(self) -> int:
        return self.num_frames

    def scene(self, index: int) -> Scene:
        """The street as plain data; IndexError past the end."""
        return _street(self.seed, checked_index(index, len(self)))

    def __getitem__(self, index: int) -> dict[str, Any]:
        scene, index = self.scene(index), checked_index(index, len(self))
        sample = camera_fields(self.rig, self._images(scene), f"synthetic-{self.seed}-{index}")
        sample |= {"boxes_3d": self._boxes(scene), "box_classes": torch.from_numpy(scene.box_classes.copy())}
        if self.lidar:
            sample["points"] = self.points(index)
        if self.neighbours is not None:
            sample |= {"ego2world": self._ego2world(scene), "time_s": 0.0}
            sample["neighbours"], near = [], product(self.neighbours.signs, range(1, self.neighbours.count + 1))
            for k, (sign, step) in enumerate(near):
                seconds = sign * step * self.neighbours.step_m / scene.speed_mps
                then, token = scene.after(seconds), f"{sample['token']}{seconds:+.3f}s"
                fields = {"rig": self.rig, "boxes_3d": self._boxes(then), "token": token}
                fields |= {"ego2world": self._ego2world(then), "time_s": seconds}
                points = partial(self._points, then, (self.seed, index, 2 + k), self.rig) if self.lidar else None
                sample["neighbours"].append(LazyFrame(fields, partial(self._images, then), points))
        return sample

    def _images(self, scene: Scene) -> Tensor | list[Tensor]:
        views = self._renderer.render(scene, self.rig.cameras, self.rig.ground_z_m)
        return stacked([image for image, *_ in views])

    def _ego2world(self, scene: Scene) -> Tensor:
        """(4, 4) pose of the rig's ego frame; the road is at z = 0 of the world, for every rig."""
        ego2world = scene.ego2street.copy()
        ego2world[2, 3] -= self.rig.ground_z_m
        return torch.from_numpy(ego2world)

    def _boxes(self, scene: Scene) -> Tensor:
        return torch.from_numpy(scene.boxes_ego(self.rig.ground_z_m).astype(np.float32))

    def render(self, index: int, rig: Rig | None = None) -> RenderedViews:
        """Render the true views of scene ``index`` for any rig, put on the scene's road; by default the dataset's own.

        IndexError past the end, TypeError if ``rig`` is not a ``Rig``.
        """
        rig = self.rig if rig is None else _checked_rig(rig)
        views = self._renderer.render(self.scene(index), rig.cameras, rig.ground_z_m)
        return RenderedViews(*(stacked(list(maps)) for maps in zip(*views, strict=True)))

    def points(self, index: int, rig: Rig | None = None) -> Tensor:
        """(P, 4) float32 LiDAR-like points x y z intensity (0 to 255) of scene ``index``, in the rig's ego frame.

        They are those of the rig's ``lidars``, by default the dataset's own; a rig without any has a scanner like an
        HDL-32E.

        IndexError past the end, TypeError if ``rig`` is not a ``Rig``.
        """
        index = checked_index(index, len(self))
        rig = self.rig if rig is None else _checked_rig(rig)
        return self._points(self.scene(index), (self.seed, index, 1), rig)

    def _points(self, scene: Scene, noise: tuple[int, ...], rig: Rig) -> Tensor:
        """Points (P, 4) of a scene, with the noise of a seed."""
        road = np.array([0.0, 0.0, rig.ground_z_m])
        scanners = [(lidar.center_m - road, lidar.rays.T, lidar.range_m) for lidar in rig.lidars]
        if not scanners:
            # On the roof, as on nuScenes' vehicles, are 32 beams of 1,088 columns (Velodyne HDL-32E).
            elevation, azimuth = np.radians(np.linspace(-30.67, 10.67, 32)), np.linspace(0, 2 * math.pi, 1089)[:-1]
            el, az = np.meshgrid(elevation, azimuth, indexing="xy")
            rays = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], -1)
            scanners = [(np.array([0.9, 0.0, 1.9]), rays, (1.0, 90.0))]
        seeds = [(*noise, k) if k else noise for k in range(len(scanners))]
        scans = [self._scan(scene, *scanner, seed) for scanner, seed in zip(scanners, seeds, strict=True)]
        points = np.concatenate(scans)
        points[:, 2] += rig.ground_z_m
        return torch.from_numpy(points.astype(np.float32))

    def _scan(
        self, scene: Scene, position: FloatArray, rays: Rays, range_m: tuple[float, float], seed: tuple[int, ...]
    ) -> FloatArray:
        """(P, 4) x y z and intensity of unit rays (columns, beams, 3) from ``position``, whose z is over the road."""
        R = scene.ego2street[:3, :3]
        origin = R @ position + scene.ego2street[:3, 3]
        ego = rays.astype(np.float64)[:, :, None]
        t, row = cast_rays(scene, origin, (ego @ R.T).astype(np.float32).reshape(len(rays), -1, 3))
        rng = np.random.default_rng(np.random.SeedSequence(seed))
        noise_m, gain = rng.normal(0, NOISE_M, len(t)), rng.uniform(0.8, 1.2, len(t))
        keep = (t > range_m[0]) & (t < range_m[1])
        points = position + ego.reshape(-1, 3)[keep] * (t + noise_m)[keep, None]
        intensity = (albedo(scene, row[keep]) * gain[keep] * 90).clip(0, 255)
        return np.concatenate([points, intensity[:, None]], 1)


def cast_rays(scene: Scene, origin: FloatArray, street: Rays) -> tuple[FloatArray, IntArray]:
    """Distances and rows (n,) of the hits of rays (columns, m, 3) of the street frame; columns are neighbours."""
    columns, m, _ = street.shape
    packets = np.pad(street, ((0, -columns % 8), (0, 0), (0, 0)), mode="edge").reshape(-1, 8 * m, 3)
    with small_steps():
        directions = torch.as_tensor(packets).transpose(1, 2).contiguous()
        local = scene_from(scene, origin)
        start = torch.as_tensor(origin[None].astype(np.float32))
        distance, hit = cast(local, start, directions, *find_candidates(local, directions))
    t, row = (a.numpy().ravel()[: columns * m] for a in (distance.double(), hit))  # without the padding
    return t, row


def albedo(scene: Scene, row: IntArray) -> FloatArray:
    """(n,) light that comes back: glass returns little, retro-reflective plates much."""
    share = scene.color.mean(1)[row.clip(0)]
    share = np.where(row == GROUND_ID, 0.5 * scene.street.asphalt, share)
    material = np.where(row >= 0, scene.material[row.clip(0)], -1)
    factors = np.select([material == Material.GLASSHOUSE, material == Material.SIGN], [0.3, 3.0], 1.0)
    return np.asarray(share * factors)


def _checked_rig(rig: Any) -> Rig:
    if not isinstance(rig, Rig):
        raise TypeError(f"SyntheticDrive rig: expected a Rig (load_rig(name) gives one), got {type(rig).__name__}")
    return rig


def _checked_count(name: str, value: Any, low: int, high: int) -> int:
    if not is_whole(value, low, high):
        raise ValueError(f"SyntheticDrive {name}: expected a whole number from {low} to {high}, got {value!r}")
    return int(value)


def demo_source_rig(size: tuple[int, int] = (256, 704)) -> Rig:
    """A sedan-like six-camera rig at 1.5 m: nuScenes' azimuths, 65 degrees wide, 90 at the back. ``size`` is (h, w)."""
    front, back = ("front", 0.0, 65.0, 1.7, 0.0), ("back", 180.0, 90.0, 0.0, 0.0)
    sides = ("front_left", 55.0, 65.0, 1.5, 0.5), ("front_right", -55.0, 65.0, 1.5, -0.5)
    rear = ("back_left", 110.0, 65.0, 1.0, 0.5), ("back_right", -110.0, 65.0, 1.0, -0.5)
    return _ring((front, *sides, *rear, back), 1.5, size, "sedan")


def demo_target_rig(size: tuple[int, int] = (256, 704)) -> Rig:
    """A van-like five-camera rig at 2.1 m: Waymo's azimuths, 65 degrees wide. ``size`` is (h, w)."""
    sides = ("side_left", 90.0, 65.0, 1.35, 0.2), ("side_right", -90.0, 65.0, 1.35, -0.2)
    left, right = ("front_left", 45.0, 65.0, 1.45, 0.15), ("front_right", -45.0, 65.0, 1.45, -0.15)
    return _ring((("front", 0.0, 65.0, 1.5, 0.0), left, right, *sides), 2.1, size, "van")


def _ring(layout: Sequence[tuple[Any, ...]], height_m: float, size: tuple[int, int], name: str) -> Rig:
    """A rig of cameras by name, azimuth and field of view (degrees), x and y (metres)."""
    looking = partial(Camera.looking, width_px=size[1], height_px=size[0])
    cameras = [
        looking(name=camera, azimuth_deg=azimuth, position_m=(x, y, height_m), horizontal_fov_deg=fov)
        for camera, azimuth, fov, x, y in layout
    ]
    return Rig(cameras, ground_z_m=0.0, name=name)


GROUND_CLASSES = (SceneClass.GROUND, SceneClass.SIDEWALK)  # classes that vehicles and people stand on
