"""SyntheticDrive: a map-style dataset of street scenes seen by any rig, with ground truth."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor
from torch.utils.data import Dataset

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.choices import is_number, is_whole
from arbiview_aug.datasets.drive import LazyFrame, Neighbours, camera_fields, check_neighbours, checked_index
from arbiview_aug.datasets.synthetic.raycast import GROUND_ID, cast, find_candidates, scene_from
from arbiview_aug.datasets.synthetic.render import Renderer, small_steps
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER, FloatArray, IntArray, Material, Scene, SceneClass
from arbiview_aug.datasets.synthetic.street import make_scene
from arbiview_aug.sample.batching import stacked

LIDAR_POSITION_M = (0.9, 0.0, 1.9)  # ego x, y and height over the road: on the roof, as on nuScenes' vehicles
LIDAR_BEAMS_DEG = (-30.67, 10.67)  # elevations of the lowest and the highest of 32 beams (Velodyne HDL-32E)
LIDAR_COLUMNS = 1088
LIDAR_RANGE_M = (1.0, 90.0)
_BEAMS = 32
PULSE_M = 0.5
"""Surfaces of one beam within this distance return one echo from between them: pulses last 3 to 5 ns."""

Rays = npt.NDArray[np.float32] | FloatArray

_street = lru_cache(maxsize=4)(make_scene)  # drives of several rigs look at the same streets


@dataclass(frozen=True, kw_only=True)
class ScanErrors:
    """How scanners of ``SyntheticDrive`` depart from exact rays.

    Attributes:
        noise_m: One sigma of the range, not negative.
        divergence_deg: Angle between the edges of a beam, 0 to 5: it returns from what its middle and four rays at its
            edge meet first, mixed over ``PULSE_M``. 0 for a single ray.
        reach_m: Distance at which 63 % of the rays return from a white surface that faces the scanner. Others return
            with a probability of 1 - exp(-albedo cos(incidence) (reach_m / distance)²). Infinite: all return.

    Raises:
        ValueError: A value out of range.
    """

    noise_m: float = 0.02
    divergence_deg: float = 0.0
    reach_m: float = math.inf

    def __post_init__(self) -> None:
        wanted = "metres from 0", "0 to 5 degrees", "metres above 0, or infinity"
        bounds = (0, sys.float_info.max), (0, 5), (math.ulp(0.0), math.inf)
        for (field, value), (low, high), expected in zip(vars(self).items(), bounds, wanted, strict=True):
            if not is_number(value) or not low <= value <= high:
                raise ValueError(f"scan errors: {field}: expected {expected}, got {value!r}")


class RenderedViews(NamedTuple):
    """Ground truth for one rig: tensors (N, ...) if all cameras have one size, else lists of N.

    Attributes:
        images: (3, h, w) uint8 RGB per camera; black where the lens sees nothing.
        depth_m: (h, w) float32 z in the camera frame along the ray through each pixel's centre; infinite for the sky
            and where the lens sees nothing; negative past 90 degrees off a fisheye's axis.
        classes: (h, w) uint8 ``SceneClass`` of that ray.
        instances: (h, w) int16 row of ``boxes_3d`` of that ray, -1 for none.
    """

    images: Tensor | list[Tensor]
    depth_m: Tensor | list[Tensor]
    classes: Tensor | list[Tensor]
    instances: Tensor | list[Tensor]

    def visible_pixels(self, num_boxes: int) -> Tensor:
        """(N, num_boxes) int64 number of pixels of each camera that show each box's object."""
        counts = [torch.bincount(view.flatten().long() + 1, minlength=num_boxes + 1) for view in self.instances]
        return torch.stack(counts)[:, 1:]


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
        lidar: Whether samples carry ``points``; or how the scanners err.
        neighbours: Which other frames of the drive come with a sample; None for none.

    Raises:
        TypeError: A ``rig``, ``lidar`` or ``neighbours`` of another type.
        ValueError: A count or seed out of range.
    """

    def __init__(
        self,
        rig: Rig,
        *,
        num_frames: int,
        seed: int = 0,
        supersampling: int = 2,
        lidar: bool | ScanErrors = True,
        neighbours: Neighbours | None = None,
    ) -> None:
        self.rig = _checked_rig(rig)
        self.num_frames = _checked_count("num_frames", num_frames, 1, 1 << 40)
        self.seed = _checked_count("seed", seed, 0, 1 << 60)
        if not isinstance(lidar, bool | ScanErrors):
            raise TypeError(f"SyntheticDrive lidar: expected True, False or ScanErrors(...), got {lidar!r}")
        self.lidar = bool(lidar)
        self._errors = lidar if isinstance(lidar, ScanErrors) else ScanErrors()
        check_neighbours(neighbours)
        self.neighbours = neighbours
        self._renderer = Renderer(supersampling=_checked_count("supersampling", supersampling, 1, 8))

    def __len__(self) -> int:
        return self.num_frames

    def __repr__(self) -> str:
        rig = f"rig {self.rig.name or '(unnamed)'}: {len(self.rig)} cameras"
        return f"SyntheticDrive({len(self)} frames, seed {self.seed}, {rig})"

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
            steps = [sign * k for sign in self.neighbours.signs for k in range(1, self.neighbours.count + 1)]
            moments = [step * self.neighbours.step_m / scene.speed_mps for step in steps]
            noise = [(self.seed, index, 2 + k) for k in range(len(moments))]
            near = [(scene.after(s), s, sample["token"], seed) for s, seed in zip(moments, noise, strict=True)]
            sample["neighbours"] = [self._neighbour(*frame) for frame in near]
        return sample

    def _neighbour(self, scene: Scene, seconds: float, token: str, noise: tuple[int, ...]) -> LazyFrame:
        fields = {"rig": self.rig, "boxes_3d": self._boxes(scene), "token": f"{token}{seconds:+.3f}s"}
        fields |= {"ego2world": self._ego2world(scene), "time_s": seconds}
        points = partial(self._points, scene, noise) if self.lidar else None
        return LazyFrame(fields, partial(self._images, scene), points)

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
        return self._points(self.scene(index), (self.seed, index, 1), None if rig is None else _checked_rig(rig))

    def _points(self, scene: Scene, noise: tuple[int, ...], rig: Rig | None = None) -> Tensor:
        """The points of a scene, whose noise has a seed of its own."""
        rig = self.rig if rig is None else rig
        road = np.array([0.0, 0.0, rig.ground_z_m])
        scanners = [(lidar.center_m - road, lidar.rays.T, lidar.range_m) for lidar in rig.lidars]
        if not scanners:
            elevation = np.radians(np.linspace(*LIDAR_BEAMS_DEG, _BEAMS))
            azimuth = np.linspace(0, 2 * math.pi, LIDAR_COLUMNS, endpoint=False)
            el, az = np.meshgrid(elevation, azimuth, indexing="xy")
            rays = np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], -1)
            scanners = [(np.array(LIDAR_POSITION_M), rays, LIDAR_RANGE_M)]
        seeds = [(*noise, k) if k else noise for k in range(len(scanners))]
        scans = [scan_scene(scene, *one, self._errors, seed) for one, seed in zip(scanners, seeds, strict=True)]
        points = np.concatenate(scans)
        points[:, 2] += rig.ground_z_m
        return torch.from_numpy(points.astype(np.float32))


def scan_scene(
    scene: Scene,
    position: FloatArray,
    rays: Rays,
    range_m: tuple[float, float],
    errors: ScanErrors,
    seed: tuple[int, ...],
) -> FloatArray:
    """(P, 4) x y z and intensity, 0 to 255, of rays (columns, beams, 3) in the ego frame, unit vectors.

    They leave ``position`` (3,), whose z is over the road, and return from distances between both of ``range_m``.
    """
    R = scene.ego2street[:3, :3]
    origin = R @ position + scene.ego2street[:3, 3]
    beam = _beam(rays.astype(np.float64), math.radians(errors.divergence_deg / 2))  # [columns, beams, S, 3]
    street = (beam @ R.T).astype(np.float32).reshape(len(rays), -1, 3)
    t, row = _echoes(*_cast(scene, origin, street), beam.shape[2])
    ego = beam[:, :, 0].reshape(-1, 3)
    rng = np.random.default_rng(np.random.SeedSequence(seed))
    noise_m, gain = rng.normal(0, errors.noise_m, len(t)), rng.uniform(0.8, 1.2, len(t))
    keep = (t > range_m[0]) & (t < range_m[1])
    if errors.reach_m < math.inf:
        drawn = rng.random(len(t))
        hits = origin + (ego[keep] @ R.T) * t[keep, None]
        signal = _albedo(scene, row[keep]) * _incidence(scene, hits, ego[keep] @ R.T, row[keep])
        keep[keep] = drawn[keep] < 1 - np.exp(-signal * (errors.reach_m / t[keep]) ** 2)
    points = position + ego[keep] * (t + noise_m)[keep, None]
    intensity = (_albedo(scene, row[keep]) * gain[keep] * 90).clip(0, 255)
    return np.concatenate([points, intensity[:, None]], 1)


def _beam(rays: FloatArray, half_rad: float) -> FloatArray:
    """(columns, beams, 1 or 5, 3) rays of beams: the middle, and four at the edge."""
    if half_rad == 0:
        return rays[:, :, None]
    side = np.cross([0.0, 0.0, 1.0], rays)
    side /= np.maximum(np.linalg.norm(side, axis=-1, keepdims=True), 1e-9)
    up = np.cross(rays, side)
    beam = np.stack([rays, *(rays + math.tan(half_rad) * edge for edge in (side, -side, up, -up))], 2)
    return np.asarray(beam / np.linalg.norm(beam, axis=-1, keepdims=True))


def _cast(scene: Scene, origin: FloatArray, street: Rays) -> tuple[FloatArray, IntArray]:
    """Distances and rows (n,) of what rays (columns, m, 3) of the street frame meet; columns are neighbours."""
    columns, m, _ = street.shape
    packets = np.pad(street, ((0, -columns % 8), (0, 0), (0, 0)), mode="edge").reshape(-1, 8 * m, 3)
    with small_steps():
        directions = torch.as_tensor(packets).transpose(1, 2).contiguous()
        local = scene_from(scene, origin)
        start = torch.as_tensor(origin[None].astype(np.float32))
        distance, hit = cast(local, start, directions, find_candidates(local, directions))
    t, row = (a.numpy().ravel()[: columns * m] for a in (distance.double(), hit))  # without the padding
    return t, row


def _echoes(t: FloatArray, row: IntArray, rays: int) -> tuple[FloatArray, IntArray]:
    """Distances and rows (n,) of the first echoes of beams of ``rays`` rays (n * rays,)."""
    if rays == 1:
        return t, row
    t, row = t.reshape(-1, rays), row.reshape(-1, rays)
    finite = np.isfinite(t)
    # One surface has one echo, from its middle: at grazing incidence its part of the beam is longer than a pulse.
    same = row[:, :, None] == row[:, None]
    t = np.where(finite, (np.where(finite, t, 0)[:, None] * same).sum(2) / same.sum(2), np.inf)
    n, order = np.arange(len(t)), t.argmin(1)
    chosen = t[n, order]
    with np.errstate(invalid="ignore"):  # of the sky
        together = finite & (np.abs(t - chosen[:, None]) <= PULSE_M)
    mean = np.where(together, t, 0).sum(1) / np.maximum(together.sum(1), 1)
    return np.where(np.isfinite(chosen), mean, np.inf), row[n, order]


def _albedo(scene: Scene, row: IntArray) -> FloatArray:
    """(n,) light that comes back: glass returns little, retro-reflective plates much."""
    albedo = scene.color.mean(1)[row.clip(0)]
    albedo = np.where(row == GROUND_ID, 0.5 * scene.street.asphalt, albedo)
    material = np.where(row >= 0, scene.material[row.clip(0)], -1)
    factors = np.select([material == Material.GLASSHOUSE, material == Material.SIGN], [0.3, 3.0], 1.0)
    return np.asarray(albedo * factors)


def _incidence(scene: Scene, points: FloatArray, rays: FloatArray, row: IntArray) -> FloatArray:
    """(n,) cosines between rays (n, 3) and the normals where they meet surfaces, at points (n, 3)."""
    normal = np.tile([0.0, 0.0, 1.0], (len(row), 1))  # the road's
    kind = np.where(row >= 0, scene.kind[row.clip(0)], -1)
    flat, curved = np.flatnonzero(kind == BOX), np.flatnonzero((kind >= 0) & (kind != BOX))
    planes = scene.planes[row[flat]]
    before = np.einsum("nfi,ni->nf", planes[..., :3], points[flat]) - planes[..., 3]
    normal[flat] = planes[np.arange(len(flat)), before.argmax(1), :3]
    k = row[curved]
    local = np.einsum("nji,nj->ni", scene.rotation[k], points[curved] - scene.center[k]) / scene.half[k]
    gradient, is_cap = local / scene.half[k], np.abs(local[:, 2]) > 1 - 1e-3
    is_cylinder = kind[curved] == CYLINDER
    gradient[is_cylinder, 2] = 0
    gradient[is_cylinder & is_cap] = 0, 0, 1
    gradient /= np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-9)
    normal[curved] = np.einsum("nij,nj->ni", scene.rotation[k], gradient)
    return np.asarray(np.abs((normal * rays).sum(1)))


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


def _ring(
    layout: Sequence[tuple[str, float, float, float, float]], height_m: float, size: tuple[int, int], name: str
) -> Rig:
    """A rig of cameras by name, azimuth and field of view (degrees), x and y (metres)."""
    looking = partial(Camera.looking, width_px=size[1], height_px=size[0])
    cameras = [
        looking(name=camera, azimuth_deg=azimuth, position_m=(x, y, height_m), horizontal_fov_deg=fov)
        for camera, azimuth, fov, x, y in layout
    ]
    return Rig(cameras, ground_z_m=0.0, name=name)


GROUND_CLASSES = (SceneClass.GROUND, SceneClass.SIDEWALK)  # classes that vehicles and people stand on
