"""A picture of rigs: from above with fields of view, from the side with heights over the road.

Each rig has a column of its own at the same scale; the other rigs stand behind it in their colours, without names.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.report.pictures import INK, PAPER, Colour, Picture, put_text, text_size

COLOURS: tuple[Colour, ...] = ((31, 100, 200), (214, 84, 20), (30, 140, 60), (140, 60, 170), (150, 110, 20))

_WIDTH, _TOP_HEIGHT, _SIDE_HEIGHT = 800, 700, 330  # of a column, in pixels
_TOP_PX_PER_M = 42.0
_SIDE_PX_PER_M = 64.0
_FAINT: Colour = (225, 225, 225)
_GREY: Colour = (140, 140, 140)
_LABEL_SCALE = 0.43


def draw_rigs(rigs: Sequence[Rig]) -> Picture:
    """One column per rig: view from above (forward is up), view from the left side (forward is to the right).

    Wedges show horizontal fields of view in the upper half and vertical ones in the lower; a telephoto camera's wedge
    is longer. Heights are over the rig's own road, so that rigs with different origins compare.
    """
    columns = []
    for k in range(len(rigs)):
        others = [(rig, j) for j, rig in enumerate(rigs) if j != k]
        columns.append(np.concatenate([_from_above(rigs[k], k, others), _from_the_side(rigs[k], k, others)]))
        columns.append(np.full((columns[-1].shape[0], 2, 3), _FAINT, np.uint8))
    return np.concatenate(columns[:-1], 1)


def _colour(k: int) -> Colour:
    return COLOURS[k % len(COLOURS)]


def _from_above(rig: Rig, index: int, others: Sequence[tuple[Rig, int]]) -> Picture:
    picture = np.full((_TOP_HEIGHT, _WIDTH, 3), PAPER, np.uint8)
    middle = _middle([rig, *(o for o, _ in others)])
    origin = np.array([_WIDTH / 2, _TOP_HEIGHT / 2 + 20]) + _TOP_PX_PER_M * np.array([middle[1], middle[0]])

    def pixel(xy: np.ndarray) -> np.ndarray:
        """Ego (x forward, y left) -> picture (right, down)."""
        return origin + _TOP_PX_PER_M * np.stack([-xy[..., 1], -xy[..., 0]], -1)

    for radius in (2, 4, 6, 8):
        _circle(picture, origin, radius * _TOP_PX_PER_M, _FAINT)
        put_text(picture, f"{radius} m", tuple(pixel(np.array([0.0, -radius + 0.1]))), scale=0.35, colour=_GREY)
    _line(picture, pixel(np.array([-0.3, 0.0])), pixel(np.array([0.3, 0.0])), _GREY)
    _line(picture, pixel(np.array([0.0, -0.3])), pixel(np.array([0.0, 0.3])), _GREY)
    for other, k in others:
        for camera in other:
            cv2.polylines(picture, [_rounded(pixel(_wedge(camera)))], True, _mixed(_colour(k), 0.35), 1, cv2.LINE_AA)
    colour = _colour(index)
    for camera in rig:
        _fill(picture, _rounded(pixel(_wedge(camera))), colour, 0.12)
    for camera in rig:
        cv2.polylines(picture, [_rounded(pixel(_wedge(camera)))], True, colour, 1, cv2.LINE_AA)
    taken: list[tuple[float, float, float, float]] = [(0, 0, _WIDTH, 34)]
    for camera in rig:
        centre = pixel(camera.center_m[:2])
        cv2.circle(picture, tuple(_rounded(centre)), 4, colour, -1, cv2.LINE_AA)
        _label_at_wedge(picture, camera, pixel, taken)
    name = rig.name or "rig"
    put_text(picture, f"{name}: {len(rig)} cameras, from above (forward is up)", (12, 24), scale=0.6, colour=colour)
    return picture


def _wedge(camera: Camera) -> np.ndarray:
    """(n, 2) outline in ego x, y: the horizontal field of view about the optical axis, of fixed area up to bounds."""
    fov = min(camera.fov_deg[0], 359.0)
    angle = np.radians(camera.azimuth_deg + np.linspace(-fov / 2, fov / 2, max(2, int(fov / 3))))
    arc = camera.center_m[:2] + _radius_m(camera) * np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([camera.center_m[None, :2], arc])


def _radius_m(camera: Camera) -> float:
    return float(np.clip(5.0 * np.sqrt(60.0 / max(camera.fov_deg[0], 1.0)), 2.6, 6.5))


def _label_at_wedge(
    picture: Picture,
    camera: Camera,
    pixel: Callable[[np.ndarray], np.ndarray],
    taken: list[tuple[float, float, float, float]],
) -> None:
    """The camera's name and field of view just outside its wedge, moved until it covers no other label."""
    direction = np.array([np.cos(np.radians(camera.azimuth_deg)), np.sin(np.radians(camera.azimuth_deg))])
    lines = [camera.name, f"{camera.fov_deg[0]:.0f} x {camera.fov_deg[1]:.0f} deg"]
    height, width = text_size(lines[0], _LABEL_SCALE)[0] + 4, max(text_size(line, _LABEL_SCALE)[1] for line in lines)
    for step in range(40):
        # Outward first, then up and down in growing steps.
        offset = 0.15 + 0.12 * step if step < 8 else 0.15
        x, y = pixel(camera.center_m[:2] + (_radius_m(camera) + offset) * direction)
        if step >= 8:
            y += (step - 6) // 2 * height * (1 if step % 2 else -1)
        x -= width * (0.5 + 0.5 * direction[1])  # a label on the left ends at its wedge, one on the right begins there
        x = float(np.clip(x, 4, _WIDTH - width - 4))
        y -= height * (1 + direction[0])  # and one ahead stands above its wedge, one behind below
        y = float(np.clip(y, 38, _TOP_HEIGHT - 2 * height - 4))
        box = (x - 3, y - 2, x + width + 3, y + 2 * height + 2)
        if not any(box[0] < t[2] and t[0] < box[2] and box[1] < t[3] and t[1] < box[3] for t in taken):
            break
    taken.append(box)
    for k, line in enumerate(lines):
        at = (x, y + (k + 1) * height - 2)
        put_text(picture, line, at, scale=_LABEL_SCALE, colour=INK if k == 0 else _GREY, halo=PAPER)


def _from_the_side(rig: Rig, index: int, others: Sequence[tuple[Rig, int]]) -> Picture:
    picture = np.full((_SIDE_HEIGHT, _WIDTH, 3), PAPER, np.uint8)
    middle = _middle([rig, *(o for o, _ in others)])
    road = _SIDE_HEIGHT - 40.0

    def pixel(xz: np.ndarray) -> np.ndarray:
        """Ego (x forward, height over the road) -> picture."""
        return np.array([_WIDTH / 2, road]) + _SIDE_PX_PER_M * np.stack([xz[..., 0] - middle[0], -xz[..., 1]], -1)

    for half_metres in range(1, 8):
        y = road - _SIDE_PX_PER_M * half_metres / 2
        _line(picture, np.array([170, y]), np.array([_WIDTH - 170, y]), _FAINT)
        if half_metres % 2 == 0:
            put_text(picture, f"{half_metres // 2} m", (_WIDTH / 2, y - 3), scale=0.35, colour=_GREY, anchor="middle")
    cv2.rectangle(picture, (0, round(road)), (_WIDTH, round(road) + 4), _GREY, -1)
    put_text(picture, "road", (_WIDTH / 2, road + 20), scale=0.4, colour=_GREY, anchor="middle")
    for other, k in others:
        for camera in other:
            at = tuple(_rounded(pixel(_centre_xz(camera, other))))
            cv2.circle(picture, at, 4, _mixed(_colour(k), 0.5), 1, cv2.LINE_AA)
    colour = _colour(index)
    for camera in rig:
        _fill(picture, _rounded(pixel(_side_wedge(camera, rig))), colour, 0.18)
    for camera in rig:
        cv2.circle(picture, tuple(_rounded(pixel(_centre_xz(camera, rig)))), 4, colour, -1, cv2.LINE_AA)
    # The names stand in two lists beside the picture, rear cameras left, front cameras right, joined by thin lines.
    order = sorted(rig, key=lambda c: (c.center_m[0], c.azimuth_deg))
    for anchor, cameras in (("left", order[: len(order) // 2]), ("right", order[len(order) // 2 :])):
        cameras = sorted(cameras, key=lambda c: -c.center_m[2])
        for k, camera in enumerate(cameras):
            x, y = (12.0 if anchor == "left" else _WIDTH - 12.0), 56.0 + k * 30.0
            text = f"{camera.name} {camera.center_m[2] - rig.ground_z_m:.2f} m"
            width = text_size(text, _LABEL_SCALE)[1]
            end = np.array([x + (width + 4) * (1 if anchor == "left" else -1), y - 4])
            _line(picture, end, pixel(_centre_xz(camera, rig)), _mixed(colour, 0.4))
            put_text(picture, text, (x, y), scale=_LABEL_SCALE, anchor="left" if anchor == "left" else "right")
    put_text(picture, "from the side (forward is to the right)", (12, 22), scale=0.5, colour=colour)
    return picture


def _centre_xz(camera: Camera, rig: Rig) -> np.ndarray:
    return np.array([camera.center_m[0], camera.center_m[2] - rig.ground_z_m])


def _side_wedge(camera: Camera, rig: Rig) -> np.ndarray:
    """(n, 2) outline in ego x, height: the vertical field of view as it appears from the side."""
    column = np.linspace(-0.5, camera.height_px - 0.5, 25)
    rays = camera.unproject(np.stack([np.full_like(column, camera.K[0, 2]), column], -1)).directions
    centre = _centre_xz(camera, rig)
    return np.concatenate([centre[None], centre + 1.1 * rays[:, [0, 2]]])


def _middle(rigs: Sequence[Rig]) -> np.ndarray:
    """(x, y) in the middle of all cameras."""
    centres = np.concatenate([rig.cam2ego[:, :2, 3] for rig in rigs])
    return np.asarray((centres.min(0) + centres.max(0)) / 2)


def _rounded(points: np.ndarray) -> np.ndarray:
    return np.round(points).astype(np.int32)


def _mixed(colour: Colour, share: float) -> Colour:
    r, g, b = (round(share * c + (1 - share) * p) for c, p in zip(colour, PAPER, strict=True))
    return r, g, b


def _line(picture: Picture, a: np.ndarray, b: np.ndarray, colour: Colour) -> None:
    cv2.line(picture, tuple(_rounded(a)), tuple(_rounded(b)), colour, 1, cv2.LINE_AA)


def _circle(picture: Picture, centre: np.ndarray, radius: float, colour: Colour) -> None:
    cv2.circle(picture, tuple(_rounded(centre)), round(radius), colour, 1, cv2.LINE_AA)


def _fill(picture: Picture, polygon: np.ndarray, colour: Colour, opacity: float) -> None:
    layer = picture.copy()
    cv2.fillPoly(layer, [polygon], colour, cv2.LINE_AA)
    cv2.addWeighted(layer, opacity, picture, 1 - opacity, 0, dst=picture)
