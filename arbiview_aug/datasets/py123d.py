"""Logs of py123d: one Arrow format for Argoverse 2, nuScenes, nuPlan, KITTI-360, PandaSet, Waymo and others."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.rotations import poses_from, rotation_from_quaternion
from arbiview_aug.choices import Reduce
from arbiview_aug.datasets.drive import Drive, LazyFrame, Neighbours, Recording, camera_fields, checked_index
from arbiview_aug.datasets.image_io import area_reduced, reduced_rig
from arbiview_aug.datasets.lidar_files import checked_points
from arbiview_aug.datasets.registry import log_folders
from arbiview_aug.environment import optional_package
from arbiview_aug.errors import ArbiviewError, CalibrationError, DataError, calibration_of, described
from arbiview_aug.sample.batching import stacked

_MEI_HALF_FOV_RAD, _MEI_ERROR_PX = np.deg2rad(95.0), 0.5
_FTHETA_CONSTANT_PX = 0.01


@dataclass(frozen=True)
class _Log:
    """A log: py123d's scene of the whole log, and its cameras by py123d's identity, posed in the ego frame."""

    folder: Path
    scene: Any
    cameras: Mapping[Any, Camera]
    ground_z_m: float
    lidars: Sequence[Any]
    dataset: str

    @classmethod
    def open(cls, folder: Path, scene: Any, names: Sequence[str] | None) -> _Log:
        where, metadatas = f"py123d log {folder}", scene.get_camera_metadatas().values()
        read = [m for m in metadatas if names is None or m.camera_name in names]
        if not read:
            raise DataError(f"{where}: expected cameras{f' {names}' if names else ''}, found none of them")
        if (ego := scene.get_ego_state_se3_metadata()) is None:
            raise DataError(f"{where}: expected the ego's poses (ego_state_se3.arrow), found none")
        cameras = {m.camera_id: _camera(m, where) for m in sorted(read, key=lambda m: int(m.camera_id))}
        merged = "lidar.lidar_merged" in scene.get_all_modality_metadatas()
        lidars = ["lidar_merged"] if merged else [*scene.get_lidar_metadatas()]
        road_m, dataset = float(ego.center_to_imu_se3.z - ego.half_height), str(scene.get_log_metadata().dataset)
        return cls(folder, scene, cameras, road_m, lidars, dataset)

    def pose(self, iteration: int, column: str, *modality: Any) -> FloatArray | None:
        """(4, 4) pose in the world; None where the modality recorded nothing."""
        pose = self.scene.get_modality_column_at_iteration(iteration, column, *modality)
        return None if pose is None else poses_from(np.array(pose, np.float64)[:7])

    def ego2world(self, iteration: int) -> FloatArray | None:
        """(4, 4); None where it was not recorded."""
        return self.pose(iteration, "imu_se3", "ego_state_se3")


class Py123dDataset(Recording):
    """The iterations of py123d's logs, in the order of their folders and times.

    A sample is a dict, everything in the ego frame (py123d's IMU frame) at the iteration's time: ``images`` (N, 3, h,
    w) uint8 RGB, or a list if sizes differ; ``rig``; ``K`` and ``cam2ego`` float64, cameras posed as at their
    exposure; ``token`` (split, log and microseconds); ``ego2world`` (4, 4) float64; ``time_s``; and, if the log has
    them, ``points`` (P, 3) float32, and ``boxes_3d`` (B, 9) float32 with ``box_names``: as of ``NuScenesDataset``.
    ``neighbours`` are other iterations of the same log. A sample has the cameras that recorded in its iteration.

    A fisheye camera of the MEI model becomes the ``fisheye`` lens that is nearest to it, within half a pixel; its
    tangential terms are left out, as py123d does. An f-theta lens has its forward polynomial. The road is at the
    bottom of the vehicle's box.

    Args:
        root: py123d's data root (with ``logs``), the folder of logs, a split, or a log.
        reduce: Reduce the images to 1, 1/2 or 1/4 of their size.
        load_points: Whether to read the LiDARs' points.
        neighbours: Selection of other frames of the drive to add; None for none.
        cameras: Names of the cameras to read, or one name; None for all.

    Raises:
        ImportError: py123d is not installed.
        TypeError: ``neighbours`` is neither ``Neighbours`` nor None.
        DataError: No log, or one that py123d cannot read.
        CalibrationError: A camera whose lens no lens here approximates.
    """

    writer = "arbiview_aug.cli.convert.writer:LogFrames"

    def __init__(
        self,
        root: str | Path,
        *,
        reduce: Reduce = 1,
        load_points: bool = True,
        neighbours: Neighbours | None = None,
        cameras: Sequence[str] | str | None = None,
    ) -> None:
        super().__init__(root, reduce, load_points, neighbours)
        scene_of = optional_package("py123d.api.scene.arrow.arrow_scene_api", "py123d").ArrowSceneAPI
        arrow = optional_package("pyarrow", "py123d")
        folders = log_folders(self.root)
        if not folders:
            raise DataError(f"py123d {root}: expected logs (folders with sync.arrow), found none")
        cameras = [cameras] if isinstance(cameras, str) else cameras
        self._logs: list[_Log] = []
        frames: list[tuple[int, int, int]] = []
        for folder in folders:
            with _reading(folder):
                for path in sorted(folder.glob("*.arrow")):
                    if not path.is_file():  # a pipe would be waited for
                        got = f"expected a regular file {path.name}, got something else"
                        raise DataError(f"py123d log {folder}: {got}")
                    with arrow.memory_map(str(path)) as file:  # pyarrow reads outside of it where offsets are damaged
                        arrow.ipc.open_file(file).read_all().validate(full=True)
                log = _Log.open(folder, scene_of(folder), cameras)
                times_us = [int(time.time_us) for time in log.scene.get_all_iteration_timestamps()]
            frames += [(len(self._logs), k, time_us) for k, time_us in enumerate(times_us)]
            self._logs.append(log)
        if unknown := {*(cameras or ())} - {camera.name for log in self._logs for camera in log.cameras.values()}:
            raise DataError(f"py123d {root}: cameras: expected names of its cameras, got {', '.join(sorted(unknown))}")
        self._frames, self.is_one_drive = frames, len(folders) == 1
        self.tokens = [f"{self._logs[n].folder.parent.name}-{self._logs[n].folder.name}-{us}" for n, _, us in frames]
        self._drive = None if neighbours is None else self._find_drive()

    def time_s(self, index: int) -> float:
        return 1e-6 * self._frames[index][2]

    def _at(self, index: int) -> tuple[_Log, int]:
        """A sample's log, and its iteration there."""
        number, iteration, _ = self._frames[index]
        return self._logs[number], iteration

    def files(self, index: int) -> list[Path]:
        """Files of the log; images and points that a log names elsewhere are not among them."""
        log, _ = self._at(index)
        return sorted(path for path in log.folder.iterdir() if path.suffix in (".arrow", ".mp4"))

    def __getitem__(self, index: int) -> dict[str, Any]:
        index = checked_index(index, len(self))
        (log, iteration), token = self._at(index), self.tokens[index]
        with _reading(log.folder):
            fields = self._fields(index)
        images = _images(log, iteration, fields["rig"].names, self.reduce)
        sample = fields | camera_fields(fields["rig"], images, token)
        if self.load_points and (points := _points(log, iteration, token)) is not None:
            sample["points"] = points
        if self._drive is not None:
            sample["neighbours"] = self._neighbours(self._drive, index)
        return sample

    def _fields(self, index: int) -> dict[str, Any]:
        """Everything but the images and points."""
        log, iteration = self._at(index)
        ego2world = log.ego2world(iteration)
        if ego2world is None:
            raise DataError(f"py123d log {log.folder}: iteration {iteration}: expected the ego's pose, got none")
        world2ego = np.linalg.inv(ego2world).astype(np.float64, copy=False)
        poses = [log.pose(iteration, "camera_to_global_se3", "camera", identity) for identity in log.cameras]
        posed = zip(log.cameras.values(), poses, strict=True)
        rig = [replace(camera, cam2ego=world2ego @ cam2world) for camera, cam2world in posed if cam2world is not None]
        if not rig:
            raise DataError(f"py123d log {log.folder}: iteration {iteration}: expected a camera's image, got none")
        fields = {"token": self.tokens[index], "time_s": self.time_s(index), "ego2world": torch.from_numpy(ego2world)}
        fields["rig"] = reduced_rig(Rig(rig, ground_z_m=log.ground_z_m, name=log.dataset), self.reduce)
        detections = log.scene.get_box_detections_se3_at_iteration(iteration)
        if detections is not None:
            fields["boxes_3d"] = torch.from_numpy(_boxes(detections, world2ego))
            fields["box_names"] = [detection.attributes.label.serialize() for detection in detections]
        return fields

    def _find_drive(self) -> Drive:
        """Read the poses of all iterations; those without are no neighbours."""
        poses = {}
        for index in range(len(self)):
            log, iteration = self._at(index)
            with _reading(log.folder):
                if (pose := log.ego2world(iteration)) is not None:
                    poses[index] = pose[:3, 3]
        parts = np.array([self._frames[index][0] for index in poses], np.int64)
        return Drive(list(poses), np.array(list(poses.values())).reshape(-1, 3), parts)

    def _neighbour(self, index: int) -> LazyFrame:
        log, iteration = self._at(index)
        with _reading(log.folder):
            fields = self._fields(index)
        points = partial(_points, log, iteration, self.tokens[index]) if self.load_points else None
        return LazyFrame(fields, partial(_images, log, iteration, fields["rig"].names, self.reduce), points)


def _images(log: _Log, iteration: int, names: Sequence[str], reduce: Reduce) -> torch.Tensor | list[torch.Tensor]:
    images = []
    for identity, camera in log.cameras.items():
        if camera.name in names:
            with _reading(log.folder):
                image = log.scene.get_camera_at_iteration(iteration, identity).rgb_image
                where = f"py123d log {log.folder}: iteration {iteration}: camera {camera.name!r}"
                if image.shape != (*camera.size, 3) or image.dtype != np.uint8:
                    raise DataError(f"{where}: expected {(*camera.size, 3)} uint8, got {image.shape} {image.dtype}")
                images.append(torch.from_numpy(area_reduced(image, reduce)).permute(2, 0, 1).contiguous())
    return stacked(images)


def _points(log: _Log, iteration: int, token: str) -> torch.Tensor | None:
    with _reading(log.folder):
        scans = [log.scene.get_lidar_at_iteration(iteration, lidar) for lidar in log.lidars]
        clouds = [np.asarray(scan.point_cloud_3d, np.float32) for scan in scans if scan is not None]
    return checked_points(np.concatenate(clouds), f"of {token}") if clouds else None


def _camera(metadata: Any, where: str) -> Camera:
    """A camera at the ego's origin; CalibrationError for another lens."""
    where = f"{where}: camera {metadata.camera_name!r}"
    model = metadata.camera_model.serialize()
    if model == "pinhole" and metadata.intrinsics is not None:
        numbers, bent = metadata.intrinsics, None if metadata.is_undistorted else metadata.distortion
        K = np.array([[numbers.fx, numbers.skew, numbers.cx], [0, numbers.fy, numbers.cy], [0, 0, 1]])
        distortion: Any = () if bent is None else (bent.k1, bent.k2, bent.p1, bent.p2, bent.k3)
        lens = "pinhole" if bent is None else "radtan"
    elif model == "fisheye_mei" and metadata.projection is not None and metadata.mirror_parameter is not None:
        lens, (K, distortion) = "fisheye", _fisheye(metadata, where)
    elif model == "ftheta" and metadata.intrinsics is not None:
        lens, (K, distortion) = "ftheta", _ftheta(metadata.intrinsics, where)
    else:
        fix = "name the other cameras, cameras="
        raise CalibrationError(f"{where}: expected a calibrated pinhole, MEI or f-theta lens, got {model}; {fix}")
    optics: dict[str, Any] = {"K": K, "lens": lens, "distortion": tuple(map(float, distortion))}
    optics |= {"width_px": int(metadata.width), "height_px": int(metadata.height)}
    with calibration_of(where):
        return Camera(name=metadata.camera_name, cam2ego=np.eye(4), **optics)


def _fisheye(metadata: Any, where: str) -> tuple[FloatArray, FloatArray]:
    """K and k1..k4 of the ``fisheye`` lens nearest to a MEI lens, by least squares over the image."""
    xi, to = float(metadata.mirror_parameter), metadata.projection
    k1, k2 = (0.0, 0.0) if metadata.distortion is None else (metadata.distortion.k1, metadata.distortion.k2)
    corner = np.maximum([to.u0, to.v0], [metadata.width - 1 - to.u0, metadata.height - 1 - to.v0])
    reach = float(np.hypot(*(corner / [to.gamma1, to.gamma2])))
    theta = np.linspace(0.0, _MEI_HALF_FOV_RAD, 2000)[1:]
    rho = np.sin(theta) / np.maximum(np.cos(theta) + xi, 1e-9)
    radius = rho * (1 + k1 * rho**2 + k2 * rho**4)
    end = int(np.argmax(np.append((np.diff(radius) <= 0) | (radius[1:] > reach), True))) + 1
    theta, radius = theta[:end], radius[:end]
    powers = np.stack([theta**n for n in (3, 5, 7, 9)], axis=-1)
    wanted = radius * (1 + xi) - theta  # the slope on the axis is 1 / (1 + xi)
    coefficients = np.linalg.lstsq(powers, wanted, rcond=None)[0]
    error_px = float(np.abs(powers @ coefficients - wanted).max() / (1 + xi) * max(to.gamma1, to.gamma2))
    if not error_px <= _MEI_ERROR_PX:
        expected = f"a MEI lens within {_MEI_ERROR_PX} px of a fisheye lens"
        raise CalibrationError(f"{where}: expected {expected}, got {error_px:.2f} px")
    return np.array([[to.gamma1 / (1 + xi), 0, to.u0], [0, to.gamma2 / (1 + xi), to.v0], [0, 0, 1]]), coefficients


def _ftheta(intrinsics: Any, where: str) -> tuple[FloatArray, FloatArray]:
    """K and k2..k5 of the ``ftheta`` lens with NVIDIA's forward polynomial, in pixels of radians."""
    constant, focal, *powers = (float(c) for c in intrinsics.fw_poly)
    if not abs(constant) <= _FTHETA_CONSTANT_PX or not focal > 0:
        expected = "a forward polynomial without a constant term and with a positive linear one"
        raise CalibrationError(f"{where}: expected {expected}, got {intrinsics.fw_poly}")
    K = np.array([[focal, 0, intrinsics.cx], [0, focal, intrinsics.cy], [0, 0, 1]])
    return K, np.array([*powers, *(0.0,) * (4 - len(powers))]) / focal


def _boxes(detections: Any, world2ego: FloatArray) -> Any:
    """(B, 9) float32 in the ego frame."""
    rows = np.array([box.bounding_box_se3.array for box in detections], np.float64).reshape(-1, 10)
    moved = world2ego[:3, :3] @ rotation_from_quaternion(rows[:, 3:7])
    yaw = np.arctan2(moved[:, 1, 0], moved[:, 0, 0])
    velocities = [box.velocity_3d for box in detections]
    velocity = np.array([[np.nan] * 3 if v is None else [v.x, v.y, v.z] for v in velocities]).reshape(-1, 3)
    centre = rows[:, :3] @ world2ego[:3, :3].T + world2ego[:3, 3]
    return np.column_stack([centre, rows[:, 7:10], yaw, (velocity @ world2ego[:3, :3].T)[:, :2]]).astype(np.float32)


@contextmanager
def _reading(folder: Path) -> Iterator[None]:
    """Turn errors of py123d and pyarrow, which are of many types, into DataError."""
    try:
        yield
    except ArbiviewError:
        raise
    except Exception as error:
        raise DataError(f"py123d log {folder}: expected a log that py123d reads, got {described(error)}") from None
