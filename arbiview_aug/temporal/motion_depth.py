"""Depth of a frame's images from the frames before and after it: what both sides say, and nothing else.

Each side is matched and aggregated by itself; a pixel is kept where the two come to the same distance, where that
distance moves it by enough to be measured (not near the focus of expansion, nor far away), and where enough of its
neighbours are kept too. What moved by itself is not at the distance that it seems to have: labelled objects are left
out, in both frames; unlabelled ones that keep pace, or come straight ahead, cannot be told apart.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.lens import BoolArray, FloatArray
from arbiview_aug.cameras.projection import project_rays
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.render.pixel_projection import Layer
from arbiview_aug.sample.neighbours import Neighbour
from arbiview_aug.scene.box_raster import draw_boxes
from arbiview_aug.scene.depth_maps import motion_camera, points_of_depth
from arbiview_aug.temporal.plane_sweep import INVALID, SweptSurface, reduced_grey, scores_opencv, scores_torch
from arbiview_aug.temporal.pose_check import CORRECTED_PX, MENDS, MOST_ERROR_PX, PoseSamples, pose_error
from arbiview_aug.temporal.semi_global import aggregate

BEST_TRAVEL_M, TRAVEL_M = 1.2, (0.4, 3.0)
"""Between the current frame and a side's: less measures nothing, more hides too much from one of the two. The one
nearest to the first is taken."""

AGREEMENT = 0.15
"""Share by which the two sides' inverse distances may differ. On two synthetic streets of 128x352 pixels, 0.1 keeps
0.66 of the pixels, 0.95 of them within a tenth of the truth, 0.15 keeps 0.71 and 0.94; on three of 225x400, 0.05 kept
0.56 and 0.965, 0.1 0.69 and 0.957, 0.15 0.73 and 0.948. What is rendered differs by 0.2 dB either way."""

_AGREEMENT_PER_M = 1e-3  # and absolutely, 1/m: beyond 100 m distances do not matter

FARTHEST_M = 80.0
"""What is farther is left to the far wall of the street, 20 to 40 m away: from 0.6 m beside, the two are half a pixel
apart in an image 400 px wide."""

LEAST_SHIFT_PX = 0.06
"""A pixel is measured where a tenth of its inverse distance moves it by so much on all sides: what errs more, the sides
do not agree on. On synthetic streets of 225x400 pixels, dB over the static street from 0.6 m higher and 1 m aside:
0.5 px 2.8 and 2.7, 0.25 px 3.2 and 3.7, 0.12 px 3.4 and 4.1, 0.06 px 3.5 and 4.3; 0.03 is no better."""

_SPECKLE_PX = 100
"""Smaller patches of one distance are errors more often than objects, at 400 px: without, 0.3 to 0.6 dB less."""

_AIR_M = 0.4  # around labels, as for what neighbouring frames fill


@dataclass(frozen=True, eq=False)
class MotionDepth:
    """What motion says of the distances in one frame.

    Attributes:
        depth_m: (h, w) float32 of each camera, z-depth at the size of ``motion_camera``; 0 where nothing is known.
        words: How it was found, or why it was not.
    """

    depth_m: tuple[Layer, ...]
    words: str

    @property
    def density(self) -> float:
        """Share of all pixels whose distance is known; 0 where it was declined."""
        return float(np.mean([np.mean(depth > 0) for depth in self.depth_m]))

    def points(self, rig: Rig) -> FloatArray:
        """(P, 3) in the ego frame, metres, with the rig of the frame."""
        pairs = zip(rig, self.depth_m, strict=True)
        return np.concatenate(
            [points_of_depth(motion_camera(camera), depth.astype(np.float64)) for camera, depth in pairs]
        )

    def __str__(self) -> str:
        if self.density == 0:
            return f"depth from motion: none, {self.words}; the static street stands"
        return f"depth from motion: {self.density:.0%} of the pixels, {self.words}"


class _Side(NamedTuple):
    """A neighbour, ready to be read: its cameras at the size that is worked at, and their grey images."""

    neighbour: Neighbour
    cameras: list[Camera]
    greys: list[Layer]

    def moved(self, move: FloatArray) -> _Side:
        """With its cameras elsewhere."""
        return self._replace(cameras=[camera.moved(move) for camera in self.cameras])


class _Found(NamedTuple):
    """Inverse distances (h, w) of one camera, 1/m, and which of them are believed."""

    inverse_distance: Layer
    kept: BoolArray


Load = Callable[[Neighbour], Sequence[torch.Tensor] | None]
"""Images of a neighbour, or None where they cannot be had: then another one is taken."""


def motion_depth(
    rig: Rig,
    images: Sequence[torch.Tensor],
    neighbours: Sequence[Neighbour],
    boxes: FloatArray | None,
    load: Load,
    device: torch.device | str = "cpu",
) -> MotionDepth:
    """Depth of a frame from one neighbour before and one after it; where there is but one, from that.

    Poses are checked on what comes out (``poses``): small errors are mended and the images matched again.

    Args:
        rig: Of the current frame.
        images: (3, H, W) of its cameras: uint8, or float in [0, 1].
        neighbours: Other frames of the drive, in the current frame's ego frame.
        boxes: (B, 7) labelled objects of the current frame, ego frame: they are left out.
        load: Gives a neighbour's images.
        device: Where scores are computed.
    """
    device = torch.device(device)
    own = [_without_objects(motion_camera(camera), boxes) for camera in rig]

    def none(why: str) -> MotionDepth:
        return MotionDepth(tuple(np.zeros(camera.size, np.float32) for camera in own), why)

    found_sides = (
        next((s for n in of if (s := _loaded(n, load)) is not None), None) for of in _by_side(rig, neighbours)
    )
    sides = [side for side in found_sides if side is not None]
    if not sides:
        least, most = TRAVEL_M
        return none(f"no frame {least:g} to {most:g} m before or after it can be used")
    greys = [reduced_grey(camera, image) for camera, image in zip(rig, images, strict=True)]
    families = [SweptSurface(camera, rig.ground_z_m) for camera in own]
    words = f"from {' and '.join(side.neighbour.name for side in sides)}"
    for mend in range(MENDS + 1):
        found = [_of_camera(f, grey, k, sides, device) for k, (f, grey) in enumerate(zip(families, greys, strict=True))]
        errors = [pose_error(_reads(families, greys, found, side)) for side in sides]
        known = [error for error in errors if error is not None]
        if len(known) < len(sides):
            lost = sides[errors.index(None)].neighbour.name
            return none(f"too little of frame {lost} is alike to tell whether its pose is right")
        worst = max(known, key=lambda error: error.error_px)
        if worst.error_px <= CORRECTED_PX:
            break
        if mend < MENDS:
            words += f"{'; poses mended by' if mend == 0 else ', then'} {' and '.join(map(str, known))}"
            sides = [side.moved(error.mended) for side, error in zip(sides, known, strict=True)]
        elif worst.error_px > MOST_ERROR_PX:
            return none(f"the pose of frame {sides[known.index(worst)].neighbour.name} errs by {worst}")
    return MotionDepth(tuple(_depth_m(f, one) for f, one in zip(families, found, strict=True)), words)


def _by_side(rig: Rig, neighbours: Sequence[Neighbour]) -> tuple[list[Neighbour], list[Neighbour]]:
    """Those behind the vehicle and those ahead of it, the best travel first."""
    behind: list[Neighbour] = []
    ahead: list[Neighbour] = []
    for one in neighbours:
        if TRAVEL_M[0] <= one.travel_m <= TRAVEL_M[1]:
            away_m = float(
                np.mean([there.center_m[0] - here.center_m[0] for here, there in zip(rig, one.rig, strict=True)])
            )
            (ahead if away_m > 0 else behind).append(one)
    for side in (behind, ahead):
        side.sort(key=lambda one: (abs(one.travel_m - BEST_TRAVEL_M), one.number))
    return behind, ahead


def _loaded(neighbour: Neighbour, load: Load) -> _Side | None:
    images = load(neighbour)
    if images is None:
        return None
    cameras = [_without_objects(motion_camera(camera), neighbour.boxes) for camera in neighbour.rig]
    greys = [reduced_grey(camera, image) for camera, image in zip(neighbour.rig, images, strict=True)]
    return _Side(neighbour, cameras, greys)


def _without_objects(camera: Camera, boxes: FloatArray | None) -> Camera:
    """A camera whose mask hides labelled objects."""
    shown = _showing(camera, boxes)
    if not shown.any():
        return camera
    return replace(camera, mask=~shown if camera.mask is None else camera.mask & ~shown)


def _showing(camera: Camera, boxes: FloatArray | None) -> BoolArray:
    """(h, w) pixels that show labelled objects, with air around them."""
    shown = np.zeros(camera.size, bool)
    if boxes is not None and len(boxes):
        grown = boxes[:, :7] + np.array([0, 0, 0, 2 * _AIR_M, 2 * _AIR_M, 2 * _AIR_M, 0])
        shown.reshape(-1)[draw_boxes(camera, grown).pixel] = True
    return shown


def _of_camera(family: SweptSurface, grey: Layer, k: int, sides: Sequence[_Side], device: torch.device) -> _Found:
    """The distances that one camera's pixels have by all sides, where these agree.

    Of two sides each is asked alone. Where one of them does not see a point, what surrounds it there decides
    (``aggregation``). A single side is asked a second time, from its own pixels.
    """
    totals, alone, seen = None, [], []
    for side in sides:
        scores = _scores(family, grey, side.cameras[k], side.greys[k], device)
        smooth = aggregate(scores)
        alone.append(_best(family, smooth)[0])
        totals = smooth if totals is None else totals + smooth
        seen.append(scores)
    assert totals is not None
    q, index = _best(family, totals)
    visible = torch.stack([scores.gather(0, index[None])[0] > INVALID for scores in seen]).any(0).cpu().numpy()
    if len(sides) == 2:
        alike = _alike(alone[0], alone[1])
    else:
        alike = _confirmed(family, q, grey, sides[0].cameras[k], sides[0].greys[k], device)
    kept = visible & alike & (q > 1 / FARTHEST_M)
    for side in sides:
        kept &= np.hypot(*np.moveaxis(_shift(family, side.cameras[k], q), -1, 0)) >= LEAST_SHIFT_PX
    return _Found(q, kept)


def _confirmed(
    family: SweptSurface, q: Layer, grey: Layer, camera: Camera, other: Layer, device: torch.device
) -> BoolArray:
    """(h, w) whether a neighbour's own pixels, asked in turn, come to the same distances."""
    back = SweptSurface(camera, family.ground_z_m)
    own, _ = _best(back, aggregate(_scores(back, other, family.camera, grey, device)))
    there: Any = cv2.remap(own, _positions(family, camera, q).astype(np.float32), None, cv2.INTER_NEAREST)  # type: ignore[call-overload]
    offset = family.camera.center_m - camera.center_m
    away = np.linalg.norm(offset * q[..., None] + family.directions, axis=-1)
    return _alike(there, (q / np.maximum(away, 1e-9)).astype(np.float32))


def _scores(family: SweptSurface, grey: Layer, camera: Camera, other: Layer, device: torch.device) -> torch.Tensor:
    if device.type == "cpu":
        return torch.from_numpy(scores_opencv(family, grey, camera, other))
    return scores_torch(family, grey, camera, other, device)


def _alike(one: Layer, two: Layer) -> BoolArray:
    return np.asarray(np.abs(one - two) <= AGREEMENT * np.maximum(one, two) + _AGREEMENT_PER_M)


def _reads(
    families: Sequence[SweptSurface], greys: Sequence[Layer], found: Sequence[_Found], side: _Side
) -> list[PoseSamples]:
    """A side's images read over what was found."""
    return [
        PoseSamples(
            family, camera, grey, other, *one, _positions(family, camera, one[0]), _shift(family, camera, one[0])
        )
        for family, camera, grey, other, one in zip(families, side.cameras, greys, side.greys, found, strict=True)
    ]


def _shift(family: SweptSurface, camera: Camera, q: Layer) -> FloatArray:
    """(h, w, 2) by how much a side's pixels move if inverse distances grow by a tenth: along the epipolar lines."""
    return _positions(family, camera, q * np.float32(1.1)) - _positions(family, camera, q)


def _positions(family: SweptSurface, camera: Camera, inverse_distance: Layer) -> FloatArray:
    offset = family.camera.center_m - camera.center_m
    uv, valid = project_rays(camera, family.directions, inverse_distance.astype(np.float64), offset)
    return np.where(valid[..., None], uv, -1e4)


def _best(family: SweptSurface, scores: torch.Tensor) -> tuple[Layer, torch.Tensor]:
    """The best inverse distances (h, w), between hypotheses by a parabola, and the index of the nearest one."""
    peak, index = scores.max(0)
    last = len(scores) - 1
    before, after = (scores.gather(0, (index + d).clamp(0, last)[None])[0] for d in (-1, 1))
    bend = before - 2 * peak + after
    inside = (index > 0) & (index < last) & (bend < -1e-6)
    offset = torch.where(inside, 0.5 * (before - after) / torch.where(inside, bend, 1), 0).clamp(-0.5, 0.5)
    wall = (index + offset).cpu().numpy() * family.walls[1]
    return np.asarray(family.inverse_distance(wall), np.float32), index


def _depth_m(family: SweptSurface, found: _Found) -> Layer:
    """z-depth (h, w) of what is kept: nothing of labelled objects, of the own car, or in small patches."""
    camera, q = family.camera, found.inverse_distance
    kept = found.kept if camera.mask is None else found.kept & camera.mask
    kept = _without_speckles(q, kept)
    ahead = family.directions @ camera.cam2ego[:3, 2]
    return np.where(kept & (ahead > 1e-6), ahead / np.maximum(q, 1e-9), 0).astype(np.float32)


def _without_speckles(q: Layer, kept: BoolArray) -> BoolArray:
    """What is kept (h, w), without small patches: a patch goes on where inverse distance changes by less than
    ``AGREEMENT``."""
    scale = 1000.0  # of the logarithm, in int16: from 1 mm to more than anything
    levels: Any = np.where(kept, np.log(np.maximum(q, 1e-3) / 1e-3) * scale + 1, 0).astype(np.int16)
    cv2.filterSpeckles(levels, 0, _SPECKLE_PX, AGREEMENT * scale)
    return levels > 0
