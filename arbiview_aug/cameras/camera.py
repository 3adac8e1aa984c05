"""Cameras: intrinsics, lens and pose; projection and its inverse; resizing and cropping.

Conventions (pinned by ``tests/cameras/test_camera.py``):

- Pixel centres are integers: (0, 0) is the centre of the top-left pixel, points are (x, y), sizes (h, w).
- ``cam2ego`` maps camera points to the ego frame: ``p_ego = cam2ego @ p_cam``. Camera axes: x right, y down,
  z forward. Ego axes: x forward, y left, z up, metres. The paper's rotation R_i is ``cam2ego[:3, :3].T``.
- Angles at the public face are in degrees, geometry is float64.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.framing import Fit, framing
from arbiview_aug.cameras.lens import LENSES, BoolArray, FloatArray, Lens, LensName, intrinsics_for_fov
from arbiview_aug.cameras.rotations import CAMERA_AXES_IN_EGO, rotation_x, rotation_z
from arbiview_aug.cameras.validation import (
    MAX_SIZE_PX,
    checked_array,
    checked_calibration,
    checked_pixels,
    checked_size,
)
from arbiview_aug.errors import CalibrationError, shown

UNPROJECT_TOLERANCE_PX = 1e-6  # largest reprojection error of a valid ray
_ANGLES, _METRES = "finite angles in degrees", "finite (x, y, z) in metres"


class Projection(NamedTuple):
    """Pixels of projected points.

    Attributes:
        uv: (..., 2) pixels (x, y); meaningless where ``valid`` is False, but finite if the points are.
        depth_m: (...,) z in the camera frame.
        valid: (...,) in front of the camera and on the lens's unfolded branch; says nothing about image bounds.
    """

    uv: FloatArray
    depth_m: FloatArray
    valid: BoolArray


class Rays(NamedTuple):
    """Unit viewing directions (..., 3) and whether the lens could be inverted there (...,)."""

    directions: FloatArray
    valid: BoolArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Camera:
    """One calibrated camera.

    Args:
        name: Unique within its rig.
        width_px: Image width.
        height_px: Image height.
        K: (3, 3) intrinsics in pixels, ``[[fx, s, cx], [0, fy, cy], [0, 0, 1]]``.
        cam2ego: (4, 4) pose, camera to ego.
        lens: ``pinhole``; ``radtan`` (OpenCV's k1 k2 p1 p2 [k3 [k4 k5 k6]]); ``fisheye`` (Kannala-Brandt,
            OpenCV's k1..k4); ``ftheta`` and ``ftheta_backward`` (NVIDIA's polynomial, k2..k5); ``double_sphere``
            (xi alpha) and ``eucm`` (alpha beta), as Kalibr has them. The formulas are in docs/formats.md.
            ``opencv_radtan``, ``opencv_fisheye`` and ``ds`` are other names.
        distortion: Coefficients of the lens.
        mask: (H, W) bool, True where the scene is seen, False on the ego car's body.

    Raises:
        CalibrationError: An impossible value; the message names the camera and the fix.
    """

    name: str
    width_px: int
    height_px: int
    K: FloatArray
    cam2ego: FloatArray
    lens: LensName = "pinhole"
    distortion: tuple[float, ...] = ()
    mask: BoolArray | None = None

    def __post_init__(self) -> None:
        self.__dict__.update(checked_calibration(**self.__dict__))

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Copies are read-only too, and their centres are views: kernels are compiled for such arrays.
        self.__dict__.update({key: value for key, value in state.items() if key != "center_m"})
        for array in (self.K, self.cam2ego, *([] if self.mask is None else [self.mask])):
            array.setflags(write=False)

    @property
    def _where(self) -> str:
        return f"camera {shown(self.name)}"

    @classmethod
    def looking(
        cls,
        *,
        name: str,
        azimuth_deg: float,
        elevation_deg: float = 0.0,
        roll_deg: float = 0.0,
        position_m: tuple[float, float, float] = (0.0, 0.0, 1.5),
        width_px: int,
        height_px: int,
        horizontal_fov_deg: float | None = None,
        K: Any = None,
        lens: LensName = "pinhole",
        distortion: tuple[float, ...] = (),
        mask: Any = None,
    ) -> Camera:
        """A camera by its viewing direction: the paper's R = R_z(θ) R_x(φ) (Sec. FAVS, Stage 1).

        ``cam2ego[:3, :3] = R_z(azimuth) B R_x(elevation) R_z(roll)``, where B puts the resting camera's axes
        (right, down, forward) on the ego axes (-y, -z, +x). R_z(azimuth) turns about the ego's z axis (up):
        positive looks to the left. R_x(elevation) turns about the camera's x axis (right): positive looks up.
        Roll turns about the optical axis: positive turns the camera clockwise as seen from behind it.
        Further arguments are those of ``Camera``.

        Args:
            azimuth_deg: 0 looks forward, 90 to the left.
            elevation_deg: 0 looks level, 90 straight up.
            roll_deg: 0 for an upright image.
            position_m: Optical centre in the ego frame.
            horizontal_fov_deg: Angle between the outer edges of the image, measured along the row of the principal
                point; gives a K with square pixels and a principal point in the middle, or where a tangential
                distortion makes both halves of the angle equal. Either this or ``K``.

        Raises:
            CalibrationError: Impossible values; both or neither of K and horizontal_fov_deg.
        """
        if (K is None) == (horizontal_fov_deg is None):
            raise CalibrationError(f"camera {name!r}: expected either K or horizontal_fov_deg, got both or none")
        where, angles = f"camera {shown(name)}", (azimuth_deg, elevation_deg, roll_deg)
        azimuth, elevation, roll = checked_array(where, "azimuth, elevation, roll", angles, (3,), _ANGLES)
        cam2ego = np.eye(4)
        cam2ego[:3, 3] = checked_array(where, "position_m", position_m, (3,), _METRES)
        cam2ego[:3, :3] = rotation_z(azimuth) @ CAMERA_AXES_IN_EGO @ rotation_x(elevation) @ rotation_z(roll)
        fields: dict[str, Any] = {"lens": lens, "distortion": distortion, "mask": mask, "cam2ego": cam2ego}
        camera = cls(name=name, width_px=width_px, height_px=height_px, K=np.eye(3) if K is None else K, **fields)
        if horizontal_fov_deg is None:
            return camera
        return replace(camera, K=intrinsics_for_fov(name, horizontal_fov_deg, camera.size, camera.lens_model))

    @cached_property
    def size(self) -> tuple[int, int]:
        """(height, width) in pixels."""
        return self.height_px, self.width_px

    @cached_property
    def center_m(self) -> FloatArray:
        """(3,) optical centre in the ego frame."""
        return self.cam2ego[:3, 3]

    @property
    def azimuth_deg(self) -> float:
        """Direction of the optical axis in the ego's x-y plane: 0 forward, 90 to the left."""
        return math.degrees(math.atan2(self.cam2ego[1, 2], self.cam2ego[0, 2]))

    @property
    def elevation_deg(self) -> float:
        """Angle of the optical axis above the ego's x-y plane."""
        return math.degrees(math.asin(max(-1.0, min(1.0, self.cam2ego[2, 2]))))

    @property
    def fov_deg(self) -> tuple[float, float]:
        """(horizontal, vertical) angle between the image's outer edges, through the principal point.

        Edges beyond the lens's image circle are counted at the circle.
        """
        cx, cy = self.K[0, 2], self.K[1, 2]
        edges = np.array([[-0.5, cy], [self.width_px - 0.5, cy], [cx, -0.5], [cx, self.height_px - 0.5]])
        d, valid = self.unproject_cam(edges)
        theta = np.arctan2(np.stack([d[:2, 0], d[2:, 1]]), np.stack([d[:2, 2], d[2:, 2]]))  # [axis, edge]
        fold = self.lens_model.fold_rad
        theta = np.where(valid.reshape(2, 2), theta, [-fold, fold])
        return tuple(float(x) for x in np.degrees(theta[:, 1] - theta[:, 0]))  # type: ignore[return-value]

    @cached_property
    def content_key(self) -> bytes:
        """Digest of size, lens, K, pose and mask; the name is not part of it."""
        mask = b"" if self.mask is None else np.packbits(self.mask).tobytes()
        lens = repr((self.size, self.lens, self.distortion)).encode()
        return hashlib.sha256(lens + self.K.tobytes() + self.cam2ego.tobytes() + mask).digest()

    @cached_property
    def mask_key(self) -> bytes:
        """Digest of the mask; empty without one."""
        if self.mask is None:
            return b""
        return hashlib.sha256(repr(self.size).encode() + np.packbits(self.mask).tobytes()).digest()

    @cached_property
    def parameters(self) -> npt.NDArray[np.float32]:
        """``parameters_at(1)``."""
        return self.parameters_at(1.0)

    def parameters_at(self, scale: float) -> npt.NDArray[np.float32]:
        """Intrinsics and lens of the image resized by ``scale`` as kernels read them: fx, skew, cx, fy, cy, fold limit,
        eight lens coefficients (14,). Resizing keeps outer edges, as ``image_ops.at_level`` does.
        """
        K = self.K.copy()
        K[:2] *= scale
        K[:2, 2] += (scale - 1) / 2
        fold = min(self.lens_model.fold_limit, 1e12)
        coefficients = self.lens_model.kernel_coefficients
        further = (*coefficients, *(0.0,) * (8 - len(coefficients)))
        return np.array([K[0, 0], K[0, 1], K[0, 2], K[1, 1], K[1, 2], fold, *further], np.float32)

    @cached_property
    def lens_model(self) -> Lens:
        """The lens with this camera's coefficients."""
        return LENSES[self.lens](self.distortion)

    @cached_property
    def is_rectilinear(self) -> bool:
        """Whether the lens keeps straight lines straight."""
        return self.lens_model.is_rectilinear

    @cached_property
    def half_angle_rad(self) -> float:
        """Largest angle between the optical axis and a ray of the image; π if the lens cannot be inverted there."""
        return _half_angle_rad(*self.size, self.lens, self.distortion, self.K.tobytes())

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Camera):
            return NotImplemented
        return self.name == other.name and self.content_key == other.content_key

    def __hash__(self) -> int:
        return hash((self.name, self.content_key))

    def __repr__(self) -> str:
        h_fov, v_fov = self.fov_deg
        x, y, z = self.center_m
        lens = "" if self.is_rectilinear else f" {self.lens}"
        mask = "" if self.mask is None else f" mask {1 - self.mask.mean():.0%} own car"
        return (
            f"Camera({self.name} {self.width_px}x{self.height_px}{lens} fov {h_fov:.1f}x{v_fov:.1f} deg "
            f"azimuth {self.azimuth_deg:+.1f} elevation {self.elevation_deg:+.1f} deg "
            f"at ({x:.2f}, {y:.2f}, {z:.2f}) m{mask})"
        )

    def project(self, points_ego: Any) -> Projection:
        """Pixels of ego-frame points (..., 3)."""
        points = np.asarray(points_ego, dtype=np.float64)
        return self.project_cam((points - self.center_m) @ self.cam2ego[:3, :3])

    def project_cam(self, points_cam: FloatArray) -> Projection:
        """Pixels of camera-frame points or directions (..., 3)."""
        x, y, z = points_cam[..., 0], points_cam[..., 1], points_cam[..., 2]
        xd, yd, valid = self.lens_model.distort(x, y, z)
        u = self.K[0, 0] * xd + self.K[0, 1] * yd + self.K[0, 2]
        v = self.K[1, 1] * yd + self.K[1, 2]
        if not self.is_rectilinear:  # angles of infinities are numbers
            with np.errstate(invalid="ignore", over="ignore"):
                valid = valid & np.isfinite(u + v + z)
        return Projection(np.stack([u, v], -1), z, valid)

    def unproject(self, uv: Any) -> Rays:
        """Unit viewing directions in the ego frame of pixels (..., 2); rays start at ``center_m``.

        ``valid`` is False outside the image circle and past the lens's fold: no ray projects to within
        ``UNPROJECT_TOLERANCE_PX`` of the pixel.
        """
        directions, valid = self.unproject_cam(np.asarray(uv, dtype=np.float64))
        return Rays(directions @ self.cam2ego[:3, :3].T, valid)

    def unproject_cam(self, uv: FloatArray) -> Rays:
        """As ``unproject``, in the camera frame."""
        yd = (uv[..., 1] - self.K[1, 2]) / self.K[1, 1]
        xd = (uv[..., 0] - self.K[0, 2] - self.K[0, 1] * yd) / self.K[0, 0]
        directions = self.lens_model.undistort(xd, yd)
        if self.is_rectilinear:
            x, y, z = np.moveaxis(directions, -1, 0)  # faster than a reduction over the short axis
            return Rays(directions, np.isfinite(x) & np.isfinite(y) & np.isfinite(z))
        again = self.project_cam(directions)
        with np.errstate(invalid="ignore"):
            converged = np.abs(again.uv - uv).max(-1) <= UNPROJECT_TOLERANCE_PX
        return Rays(directions, again.valid & converged)

    def contains(self, uv: FloatArray, margin_px: float = 0.0) -> BoolArray:
        """Whether pixels (..., 2) lie within the outermost pixel centres, widened by a margin."""
        u, v = uv[..., 0] + margin_px, uv[..., 1] + margin_px
        w, h = self.width_px - 1 + 2 * margin_px, self.height_px - 1 + 2 * margin_px
        return (u >= 0) & (u <= w) & (v >= 0) & (v <= h)

    def pixel_grid(self) -> FloatArray:
        """(h, w, 2) pixel centres (x, y)."""
        u, v = np.meshgrid(np.arange(self.width_px, dtype=np.float64), np.arange(self.height_px, dtype=np.float64))
        return np.stack([u, v], -1)

    def resize(self, size: tuple[int, int], fit: Fit = "stretch") -> Camera:
        """The camera of the image resized to (h, w): outer edges stay, so centres move by half pixels.

        Args:
            size: (h, w) in pixels.
            fit: ``stretch`` scales each side separately, ``crop`` covers the size and cuts at the top and both sides,
                ``pad`` fits inside and adds bars there, where a mask is False.

        Raises:
            CalibrationError: An impossible size, or one that ``crop`` would cut from too large an image.
        """
        if fit != "stretch":
            frame = framing(self.name, self.size, size, fit)
            scaled = self.resize(frame.scaled)
            if frame.has_bars and self.mask is None:
                scaled = replace(scaled, mask=np.ones(frame.scaled, bool))
            return scaled.crop(frame.top, frame.left, frame.size)
        h, w = checked_size(self._where, size)
        mask = self.mask
        if mask is not None:
            mask = cv2.resize(mask.astype(np.uint8), (w, h), interpolation=cv2.INTER_NEAREST_EXACT).astype(bool)
        return replace(self, width_px=w, height_px=h, K=resize_matrix(self.size, (h, w)) @ self.K, mask=mask)

    def crop(self, top: int, left: int, size: tuple[int, int]) -> Camera:
        """The camera of the window of ``size`` (h, w) whose first pixel is (left, top).

        The window may exceed the image; a mask is False there.
        """
        h, w = checked_size(self._where, size)
        K = self.K.copy()
        top, left = (checked_pixels(self._where, f, n, -MAX_SIZE_PX) for f, n in (("top", top), ("left", left)))
        K[:2, 2] -= left, top
        mask = None
        if self.mask is not None:
            mask = np.zeros((h, w), bool)
            y0, y1 = np.clip((top, top + h), 0, self.height_px)
            x0, x1 = np.clip((left, left + w), 0, self.width_px)
            mask[y0 - top : y1 - top, x0 - left : x1 - left] = self.mask[y0:y1, x0:x1]
        return replace(self, width_px=w, height_px=h, K=K, mask=mask)

    def moved(self, ego2ego: Any) -> Camera:
        """The same camera in another ego frame: ``cam2ego`` becomes ``ego2ego @ cam2ego``."""
        move = checked_array(self._where, "ego2ego", ego2ego, (4, 4))
        with np.errstate(over="ignore", invalid="ignore"):  # ``Camera`` refuses such a pose
            cam2ego = move @ self.cam2ego
        return replace(self, cam2ego=cam2ego)

    def turned(self, *, yaw_deg: float = 0.0, pitch_deg: float = 0.0, roll_deg: float = 0.0) -> Camera:
        """Turn about the centre: yaw about the ego's z (left), pitch about the camera's x (up), roll about its z.

        The mask stays on the ego car: it is re-sampled, and pixels that the old image did not show are not masked.
        """
        yaw, pitch, roll = checked_array(self._where, "yaw, pitch, roll", (yaw_deg, pitch_deg, roll_deg), (3,), _ANGLES)
        cam2ego = self.cam2ego.copy()
        cam2ego[:3, :3] = rotation_z(yaw) @ cam2ego[:3, :3] @ rotation_x(pitch) @ rotation_z(roll)
        return with_mask_of(self, replace(self, cam2ego=cam2ego, mask=None), outside=True)

    def shifted(self, x_m: float = 0.0, y_m: float = 0.0, z_m: float = 0.0) -> Camera:
        """Moved along the ego's axes."""
        cam2ego = self.cam2ego.copy()
        cam2ego[:3, 3] += checked_array(self._where, "shift", (x_m, y_m, z_m), (3,), _METRES)
        return replace(self, cam2ego=cam2ego)

    def undistorted(self) -> Camera:
        """The pinhole camera with the same K, size and pose; the mask is re-sampled to it."""
        if self.is_rectilinear:
            return self
        pinhole = replace(self, lens="pinhole", distortion=(), mask=None)
        return with_mask_of(self, pinhole, outside=False)


def with_mask_of(seen: Camera, camera: Camera, *, outside: bool) -> Camera:
    """``camera`` with the mask of ``seen``, at the same centre, and ``outside`` in pixels that its image lacks."""
    if seen.mask is None:
        return camera
    views = ((c.lens, c.distortion, c.K.tobytes(), c.cam2ego[:3, :3].tobytes()) for c in (seen, camera))
    if len({*views}) == 1:
        return replace(camera, mask=seen.mask)
    to_seen = seen.cam2ego[:3, :3].T @ camera.cam2ego[:3, :3]
    mask: Any = seen.mask.astype(np.uint8)
    border: Any = {"borderMode": cv2.BORDER_CONSTANT, "borderValue": int(outside)}
    (h, w), H = camera.size, seen.K @ to_seen @ np.linalg.inv(camera.K)
    is_in_front = (H[2] @ [[0, w, 0, w], [0, 0, h, h], [1, 1, 1, 1]] > 0).all()
    if seen.is_rectilinear and camera.is_rectilinear and is_in_front:  # a homography is much faster
        mask = cv2.warpPerspective(mask, H, (w, h), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP, **border)
    else:
        directions, has_ray = camera.unproject_cam(camera.pixel_grid())
        uv, _, valid = seen.project_cam(directions @ to_seen.T)
        uv = np.where((has_ray & valid)[..., None], uv, -9.0).astype(np.float32)
        mask = cv2.remap(mask, uv, None, cv2.INTER_NEAREST, **border)  # type: ignore[call-overload]
    return replace(camera, mask=mask.astype(bool))


@lru_cache(256)  # from frame to frame poses change, but lenses stay
def _half_angle_rad(h: int, w: int, lens: LensName, distortion: tuple[float, ...], K: bytes) -> float:
    K_px: Any = np.frombuffer(K).reshape(3, 3)
    camera = Camera(name="lens", width_px=w, height_px=h, K=K_px, cam2ego=np.eye(4), lens=lens, distortion=distortion)
    border = np.stack(np.meshgrid(np.linspace(-0.5, w - 0.5, 9), np.linspace(-0.5, h - 0.5, 9)), -1)
    directions, valid = camera.unproject_cam(border)
    return math.acos(float(np.clip(directions[..., 2].min(), -1, 1))) if valid.all() else math.pi


def resize_matrix(size: tuple[int, int], new_size: tuple[int, int]) -> FloatArray:
    """(3, 3) pixel map of a resize between (h, w) sizes: x' = s x + (s - 1) / 2, so that outer edges coincide."""
    sy, sx = new_size[0] / size[0], new_size[1] / size[1]
    return np.array([[sx, 0.0, 0.5 * sx - 0.5], [0.0, sy, 0.5 * sy - 0.5], [0.0, 0.0, 1.0]])
