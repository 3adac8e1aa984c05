"""Mistakes of single cameras that images show: points on them, neighbours that disagree, the own car."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, islice, pairwise
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.cameras.validation import Finding, doubts, is_rigid, likely_poses, pose_doubt
from arbiview_aug.sample.calibration import as_array
from arbiview_aug.sample.frame import Frame
from arbiview_aug.sample.inputs import camera_findings
from arbiview_aug.sample.masks import CLEANING, without_specks
from arbiview_aug.scene.surface import Points

Gray = npt.NDArray[np.float32]

# --- points on images -------------------------------------------------------------------------------------------------
EDGE_WIDTH_PX, _NEARER, _LEAST_EDGES = 160, 0.2, 50
"""Width of the images that points are compared with; least step of the logarithm of depth, over two pixels, at edges of
objects; least number of such pixels. Levinson and Thrun (2013) calibrate online by the same evidence."""

CLEAR_FIT, FIT_GAIN = 0.1, 0.05
"""Fit of points that are right, and the least gain of a better reading: between those of right points and of mirrored
or turned ones on real frames and synthetic streets."""


class EdgeFit(NamedTuple):
    """How well edges of objects in the points lie on edges of an image."""

    gain: float  # mean rank of the image's gradient at edges of the points, less that at other points: -0.5 to 0.5
    edges: int  # number of pixels with edges

    def beats(self, other: EdgeFit) -> bool:
        """Whether it is clearly better: by ``FIT_GAIN`` and four standard errors of uniform ranks."""
        gain, edges = other if other.edges >= _LEAST_EDGES else (0.0, self.edges)  # it sees too few
        error = 0.29 * np.sqrt(1 / max(self.edges, 1) + 1 / max(edges, 1))
        least = _LEAST_EDGES if other.edges >= _LEAST_EDGES else 2 * _LEAST_EDGES
        return self.edges >= least and self.gain > max(CLEAR_FIT, gain + max(FIT_GAIN, 4 * error))


def gray(camera: Camera, image: torch.Tensor, width_px: int) -> tuple[Camera, Gray]:
    """The camera and its image (3, H, W) in grey levels, both at a width."""
    pixels = image.detach().cpu().float().mean(dim=0).numpy() * (1 if image.dtype == torch.uint8 else 255)
    scale = min(1.0, width_px / camera.width_px)
    size = max(1, round(camera.height_px * scale)), max(1, round(camera.width_px * scale))
    return camera.resize(size), np.asarray(cv2.resize(pixels, size[::-1], interpolation=cv2.INTER_AREA), np.float32)


def edge_ranks(pixels: Gray) -> Gray:
    """Rank in [0, 1] of each pixel's horizontal gradient."""
    gradient = np.abs(cv2.Sobel(pixels, cv2.CV_32F, 1, 0)).ravel()
    return (gradient.argsort().argsort() / gradient.size).reshape(pixels.shape).astype(np.float32)


def edge_fit(camera: Camera, ranks: Gray, points: Points) -> EdgeFit:
    """Compare points with an image of the camera's size by ``edge_ranks``."""
    seen = camera.project(points)
    inside = seen.valid & camera.contains(seen.uv)
    x, y = np.round(seen.uv[inside]).astype(int).T
    depth = np.full(camera.size, np.inf, np.float32)
    np.minimum.at(depth, (y, x), np.log(np.linalg.norm(points[inside] - camera.center_m, axis=1)))
    nearest = cv2.erode(depth, np.ones((3, 3)))
    sides = np.roll(nearest, 2, axis=1), np.roll(nearest, -2, axis=1)
    known = np.isfinite(depth) & np.isfinite(sides[0]) & np.isfinite(sides[1])
    known[:, :3] = known[:, -3:] = False
    edges = known & (np.maximum(*sides) - np.where(known, nearest, 0) > _NEARER)
    if camera.mask is not None:
        edges, known = edges & camera.mask, known & camera.mask
    if not edges.any() or (known == edges).all():
        return EdgeFit(0.0, 0)
    return EdgeFit(float(ranks[edges].mean() - ranks[known & ~edges].mean()), int(edges.sum()))


def total(fits: Sequence[EdgeFit]) -> EdgeFit:
    """The mean fit of several images, by their edges."""
    edges = sum(fit.edges for fit in fits)
    return EdgeFit(sum(fit.gain * fit.edges for fit in fits) / max(edges, 1), edges)


def fit_findings(rig: Rig, views: Sequence[tuple[Camera, Gray]], points: Points) -> Iterator[Finding]:
    """Cameras that points misfit although they fit others, if another pose or image is clearly better."""
    fits = [edge_fit(camera, ranks, points) for camera, ranks in views]
    for k, (camera, ranks) in enumerate(views):
        rest = total(fits[:k] + fits[k + 1 :])
        if pose_doubt(camera, True) is not None or fits[k].gain > CLEAR_FIT or rest.gain < CLEAR_FIT:
            continue
        where, expected = f"camera {camera.name!r}", "points on the edges of its image"
        order = "are the images in another order?"
        tries = [(where, f"they fit that of {other.name!r}", order, camera, image) for other, image in views]
        tries = [way for way in tries if way[-1] is not ranks and way[-1].shape == ranks.shape]
        for pose, found, fix in likely_poses(camera, rig.ground_z_m, True):
            tries.append((f"{where}: cam2ego", found, fix, replace(camera, cam2ego=pose), ranks))
        better = (way for way in tries if edge_fit(*way[3:], points).beats(fits[k]))
        yield from (Finding(at, expected, found, fix) for at, found, fix, *_ in islice(better, 1))


# --- neighbouring cameras ---------------------------------------------------------------------------------------------
DISAGREE_DEG, _LEAST_MATCHES = 1.0, 15
"""Angle of a mistake, above that of cameras that fire apart while the car moves; least number of matches."""

_WIDTH_PX, _RATIO, _NEAREST_M, _FALSE_DEG = 800, 0.8, 2.0, 10.0
"""Width of the images; Lowe's ratio; the nearest scene; matches farther apart are false."""


class Features(NamedTuple):
    """SIFT features of one camera's image."""

    camera: Camera
    directions: FloatArray  # (n, 3) in the ego frame
    descriptors: np.ndarray  # (n, 128) float32


def neighbour_errors(rig: Rig, images: Sequence[torch.Tensor]) -> dict[tuple[str, str], FloatArray]:
    """Angles in degrees by which matches in the overlap of two cameras miss each other at any distance of the scene."""
    features = [_features(*gray(camera, image, _WIDTH_PX)) for camera, image in zip(rig, images, strict=True)]
    errors = {(a.camera.name, b.camera.name): _match_errors(a, b) for a, b in combinations(features, 2)}
    return {names: found for names, found in errors.items() if len(found) >= _LEAST_MATCHES}


def _features(camera: Camera, pixels: Gray) -> Features:
    mask = None if camera.mask is None else camera.mask.astype(np.uint8)
    points, descriptors = cv2.SIFT.create().detectAndCompute(pixels.astype(np.uint8), mask)
    if not points:
        return Features(camera, np.zeros((0, 3)), np.zeros((0, 128), np.float32))
    rays = camera.unproject(np.array([point.pt for point in points]))
    return Features(camera, rays.directions[rays.valid], descriptors[rays.valid])


def _match_errors(*pair: Features) -> FloatArray:
    """Errors in degrees of mutual matches in the overlap of two images; empty if too few agree."""
    directions, descriptors = [], []
    for features, other in (pair, pair[::-1]):
        seen = other.camera.project(other.camera.center_m + features.directions)
        overlap = seen.valid & other.camera.contains(seen.uv)
        if overlap.sum() < _LEAST_MATCHES:
            return np.zeros(0)
        directions.append(features.directions[overlap])
        descriptors.append(features.descriptors[overlap])
    ways = []
    for a, b in (descriptors, descriptors[::-1]):
        nearest = cv2.BFMatcher().knnMatch(a, b, k=2)
        ways.append({(m.queryIdx, m.trainIdx) for m, other in nearest if m.distance < _RATIO * other.distance})
    both = [(a, b) for a, b in ways[0] if (b, a) in ways[1]]
    if len(both) < _LEAST_MATCHES:
        return np.zeros(0)
    first, second = (there[list(rows)] for there, rows in zip(directions, zip(*both, strict=True), strict=True))
    apart = pair[1].camera.center_m - pair[0].camera.center_m
    at = first - np.linspace(0, 1 / _NEAREST_M, 40)[:, None, None] * apart
    cosine = (at / np.linalg.norm(at, axis=-1, keepdims=True) * second).sum(axis=-1)
    errors = np.degrees(np.arccos(np.clip(cosine, -1, 1))).min(axis=0)
    return errors[errors < _FALSE_DEG] if (errors < _FALSE_DEG).mean() > 0.6 else np.zeros(0)


def neighbour_findings(errors: dict[tuple[str, str], FloatArray]) -> Iterator[Finding]:
    """Pairs of cameras whose matches disagree alike by more than ``DISAGREE_DEG``."""
    for (name, other), angles in errors.items():
        middle = float(np.median(angles))
        if middle > DISAGREE_DEG and ((angles > middle / 2) & (angles < 2 * middle)).mean() > 0.6:
            found = f"{middle:.1f} degrees apart in the median of {len(angles)} matches"
            fix = "calibrate them again; or were the images taken at different times while the car turned?"
            yield Finding(f"cameras {name!r} and {other!r}", "the same directions in their overlap", found, fix)


# --- the own car ------------------------------------------------------------------------------------------------------
_ROAD_AHEAD_M, _FLOW_PX, _GRADIENT, _STEADY = 12.0, 3.0, 3.0, 0.85
"""Edges of the own car are in all frames. The road there is nearer than the first and would have moved across the edge
by the second. The edge's mean gradient is at least the third, in grey levels a pixel, and at least the fourth of the
mean of the frames' gradients."""

_MOVED = 0.5  # largest change of one vehicle's poses: some data sets add its way between the cameras' times
_LEAST_FRAMES = 3  # that show the own car
_LEAST_WIDTH = 0.2
"""Least length of such an edge as a share of the width, above that of edges in moving traffic."""


def own_car_share(
    camera: Camera, images: Sequence[torch.Tensor], ego2world: Sequence[FloatArray], ground_z_m: float
) -> float:
    """Share of the images below edges of the own car; 0 without edges."""
    small = [gray(camera, image, EDGE_WIDTH_PX) for image in images]
    camera = small[0][0]
    gradients = np.stack([np.stack([cv2.Sobel(p, cv2.CV_32F, *d) / 8 for d in ((1, 0), (0, 1))], -1) for _, p in small])
    mean = gradients.mean(axis=0)
    strength = np.linalg.norm(mean, axis=-1)
    across = mean / np.maximum(strength, 1e-6)[..., None]
    stays = (strength > _GRADIENT) & ((gradients * across).sum(axis=-1).min(axis=0) > strength / 2)
    stays &= strength > _STEADY * np.linalg.norm(gradients, axis=-1).mean(axis=0)
    pixels = camera.pixel_grid()
    rays = camera.unproject(pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        away_m = (ground_z_m - camera.center_m[2]) / rays.directions[..., 2]
    stays &= rays.valid & (away_m > 0) & (away_m < _ROAD_AHEAD_M)
    road = camera.center_m + away_m[stays][:, None] * rays.directions[stays]
    flow = np.zeros(len(road))
    for before, after in pairwise(ego2world):
        pose = np.linalg.inv(after) @ before
        moved = camera.project(road @ pose[:3, :3].T + pose[:3, 3])
        past = np.abs(((moved.uv - pixels[stays]) * across[stays]).sum(axis=-1))
        flow = np.maximum(flow, np.where(moved.valid, past, np.inf))
    edges = np.zeros(camera.size, np.uint8)
    edges[stays] = flow > _FLOW_PX
    _, labels, stats, _ = cv2.connectedComponentsWithStats(cv2.dilate(edges, np.ones((3, 3))), connectivity=8)
    longest = stats[:, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]].max(axis=1) >= _LEAST_WIDTH * camera.width_px
    longest[0] = False
    below = np.maximum.accumulate(longest[labels] & (edges > 0), axis=0)
    return float(below.mean())


def check_own_car(frames: Sequence[Frame]) -> list[Finding]:
    """Cameras without a mask that see their moving vehicle, in frames with poses."""
    first, rigs = frames[0].rig, [frame.rig for frame in frames]
    poses = [pose for frame in frames if (pose := ego_pose(frame)) is not None]
    same = all(rig.names == first.names and rig.sizes == first.sizes for rig in rigs)
    same = same and all(np.allclose(rig.cam2ego, first.cam2ego, atol=_MOVED) for rig in rigs)
    findings = []
    for k, camera in enumerate(first if same and len(poses) == len(frames) >= _LEAST_FRAMES else ()):
        images = [frame.images[k] for frame in frames]
        if camera.mask is None and (share := own_car_share(camera, images, poses, first.ground_z_m)):
            found = f"no mask, and edges that stay while the road moves: about {share:.0%} of the image"
            fix = "mask it in the rig file: True on the scene"
            findings.append(Finding(f"camera {camera.name!r}: mask", "a mask that hides the own car", found, fix))
    return findings


def ego_pose(frame: Frame) -> FloatArray | None:
    """The frame's ``ego2world`` (4, 4); None without one, or if it is no pose: only neighbours need one."""
    pose = frame.further.get("ego2world")
    pose = None if pose is None else np.asarray(as_array("ego2world", pose), np.float64)
    return pose if pose is not None and is_rigid(pose) else None


# --- a rig ------------------------------------------------------------------------------------------------------------
_MOST_HIDDEN = 0.9  # of an image by its mask; a fisheye's rim hides up to a half


def check_rig(rig: Rig, images: Sequence[torch.Tensor] = (), *, masks: bool = True) -> list[Finding]:
    """Mistakes in poses, intrinsics, images' rims and, if ``masks``, masks of a rig."""
    findings = [*doubts(rig.cameras, rig.ground_z_m), *camera_findings(rig, images)]
    for camera in rig:
        if camera.mask is None or not masks:
            continue
        where = f"camera {camera.name!r}: mask"
        if turned := int((without_specks(camera.mask) != camera.mask).sum()):
            findings.append(Finding(where, "whole regions", f"specks of {turned} pixels", f"clean it: {CLEANING}"))
        hidden, upper = (1 - mask.mean() for mask in (camera.mask, camera.mask[: camera.height_px // 3]))
        if hidden > _MOST_HIDDEN or (upper > 0.8 > hidden):
            share = f"{hidden:.0%} of the image" if hidden > _MOST_HIDDEN else f"{upper:.0%} of the upper third"
            findings.append(Finding(where, "True on the scene", f"{share} hidden", "pass ~mask"))
    return findings
