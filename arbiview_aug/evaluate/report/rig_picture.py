"""Drawings of rigs: fields of view from above, heights over the road from the side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from arbiview_aug.cameras.camera import Camera
from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.report.pictures import Picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = ("#1f64c8", "#d65414", "#1e8c3c", "#8c3caa", "#966e14")


def draw_rigs(rigs: Sequence[Rig]) -> Picture:
    # Without pyplot: no global state and no display.
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    canvas = FigureCanvasAgg(rig_figure(rigs))
    canvas.draw()
    return np.ascontiguousarray(np.asarray(canvas.buffer_rgba())[..., :3])


def rig_figure(rigs: Sequence[Rig]) -> Figure:
    """Draw one column per rig: from above (forward is up) and from the side (forward is to the right).

    Wedges show horizontal fields of view above and vertical ones below. A telephoto camera's wedge is longer. All
    columns share one scale, with the other rigs' outlines behind. Heights are over each rig's own road.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8 * len(rigs), 10.5), dpi=100, layout="constrained")
    rows = figure.subplots(2, len(rigs), squeeze=False, sharex="row", sharey="row", height_ratios=(7, 3))
    for column, (above, side) in enumerate(rows.T):
        for k, rig in enumerate(rigs):
            colour, here = COLOURS[k % len(COLOURS)], k == column
            for camera in rig:
                for axes, outline in ((above, _wedge_from_above(camera)), (side, _wedge_from_side(camera, rig))):
                    axes.fill(
                        *outline.T,
                        facecolor=(colour, 0.15 if here else 0),
                        edgecolor=(colour, 1 if here else 0.3),
                    )
            if here:
                _label_from_above(above, rig)
                _label_from_side(side, rig)
                above.set_title(f"{rig.name or 'rig'}: {len(rig)} cameras", color=colour)
        above.set(xlabel="left (m)", ylabel="forward (m)", aspect="equal")
        side.set(xlabel="forward (m)", ylabel="height over the road (m)", aspect="equal")
        side.axhline(0, color="grey", linewidth=3)
        above.grid(alpha=0.3)
        side.grid(alpha=0.3)
        above.margins(0.15)
        side.margins(0.7, 0.05)
    above.invert_xaxis()
    return figure


def _label_from_above(axes: Any, rig: Rig) -> None:
    """Write each camera's name and field of view at the end of its wedge."""
    for camera in rig:
        forward, left = np.cos(np.radians(camera.azimuth_deg)), np.sin(np.radians(camera.azimuth_deg))
        axes.text(
            camera.center_m[1] + (_radius_m(camera) + 0.2) * left,
            camera.center_m[0] + (_radius_m(camera) + 0.2) * forward,
            f"{camera.name}\n{camera.fov_deg[0]:.0f}° x {camera.fov_deg[1]:.0f}°",
            fontsize=8,
            ha="right" if left > 0.3 else "left" if left < -0.3 else "center",
            va="bottom" if forward > 0 else "top",
        )


def _label_from_side(axes: Any, rig: Rig) -> None:
    """List names and heights beside the drawing: rear cameras left, front ones right."""
    order = sorted(rig, key=lambda camera: (camera.center_m[0], camera.azimuth_deg))
    for side, cameras in (("left", order[: len(order) // 2]), ("right", order[len(order) // 2 :])):
        lines = [f"{camera.name} {camera.center_m[2] - rig.ground_z_m:.2f} m" for camera in cameras]
        x = 0.01 if side == "left" else 0.99
        axes.text(x, 0.96, "\n".join(lines), transform=axes.transAxes, ha=side, va="top", fontsize=8)


def _wedge_from_above(camera: Camera) -> np.ndarray:
    """(n, 2) outline in ego y, x: the horizontal field of view about the optical axis."""
    fov = min(camera.fov_deg[0], 359.0)
    angle = np.radians(camera.azimuth_deg + np.linspace(-fov / 2, fov / 2, max(2, int(fov / 3))))
    arc = camera.center_m[1::-1] + _radius_m(camera) * np.stack([np.sin(angle), np.cos(angle)], -1)
    return np.concatenate([camera.center_m[None, 1::-1], arc])


def _wedge_from_side(camera: Camera, rig: Rig) -> np.ndarray:
    """(n, 2) outline in ego x and height over the road: the vertical field of view."""
    row = np.linspace(-0.5, camera.height_px - 0.5, 25)
    rays = camera.unproject(np.stack([np.full_like(row, camera.K[0, 2]), row], -1)).directions
    centre = camera.center_m - (0, 0, rig.ground_z_m)
    return np.concatenate([centre[None], centre + 1.1 * rays])[:, [0, 2]]


def _radius_m(camera: Camera) -> float:
    return float(np.clip(5.0 * np.sqrt(60.0 / max(camera.fov_deg[0], 1.0)), 2.6, 6.5))
