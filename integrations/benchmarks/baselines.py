"""Renderers of other projects, as simple references.

All map (source rig, its images, target rig in the source's ego frame) to views. Images are (h, w, 3) RGB, 0-255.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from arbiview_aug.cameras.rig import Rig
from arbiview_aug.evaluate.images import Image, RenderedView, as_arrays, as_tensors, to_bytes
from arbiview_aug.evaluate.methods import Method, Sample, own_index
from arbiview_aug.render.rendered import render_opencv
from arbiview_aug.render.view_planner import build_plan

Renderer = Callable[[Rig, Sequence[Image], Rig], list[RenderedView]]  # source rig, its images, target rig to views


def own_camera(source: Rig, images: Sequence[Image], target: Rig) -> list[RenderedView]:
    """Warp one source camera, of the same name or else the nearest direction, to each target camera.

    "Geometric" of the paper's Table 2: projection by H = K' R' Rᵀ K⁻¹, without fusion.
    """
    views = []
    for camera in target:
        index = own_index(source, camera)
        alone = source.with_cameras([source[index]])
        plan = build_plan(alone, target.with_cameras([camera]), geometry="infinity")
        (view,) = as_arrays(render_opencv(plan, as_tensors([images[index]])))
        views.append(RenderedView(view, plan.coverage[0]))
    return views


def crop_and_slide(source: Rig, images: Sequence[Image], target: Rig) -> list[RenderedView]:
    """Slide a window over the side-cropped images in ring order, as DriveSuprim's rotation augmentation does.

    Each image is cropped (or stretched) to the columns half-way to its neighbours' azimuths, at a constant number of
    pixels per degree. The strips form a closed panorama, from which a target camera gets the window of its azimuth and
    field of view. Perspective, pitch and position are ignored; everything is covered.
    """
    ring = sorted(range(len(source)), key=lambda k: -source[k].azimuth_deg)  # from left to right
    azimuth = np.array([source[k].azimuth_deg for k in ring])
    gap = (azimuth - np.roll(azimuth, -1)) % 360  # to the next on the right
    if len(ring) == 1:
        gap = np.array([source[0].fov_deg[0]])
    height = max(h for h, _ in source.sizes)
    strips, centre_px, x = [], [], 0.0
    per_degree = float(np.median([source[k].width_px / source[k].fov_deg[0] for k in ring]))
    for n, k in enumerate(ring):
        camera, image = source[k], to_bytes(images[k])
        left, right = gap[n - 1] / 2, gap[n] / 2
        px_per_degree = camera.width_px / camera.fov_deg[0]
        middle = float(camera.K[0, 2]) + 0.5  # counted from the image's edge
        a = int(np.clip(round(middle - left * px_per_degree), 0, camera.width_px - 1))
        b = int(np.clip(round(middle + right * px_per_degree), a + 1, camera.width_px))
        wide = max(1, round((left + right) * per_degree))
        strips.append(cv2.resize(image[:, a:b], (wide, height), interpolation=cv2.INTER_LINEAR))
        centre_px.append(x + left * per_degree)
        x += wide
    panorama = np.concatenate(strips, axis=1)
    views = []
    for camera in target:
        # The nearest strip's centre, shifted by the turn from it.
        turn = (azimuth - camera.azimuth_deg + 180) % 360 - 180
        n = int(np.abs(turn).argmin())
        middle = centre_px[n] + turn[n] * per_degree
        half = per_degree * camera.fov_deg[0] / 2
        columns = np.arange(round(middle - half), round(middle + half)) % panorama.shape[1]
        view = np.asarray(cv2.resize(panorama[:, columns], camera.size[::-1]), np.uint8)
        views.append(RenderedView(view, np.ones(camera.size, bool)))
    return views


BASELINES: dict[str, Renderer] = {"own camera": own_camera, "crop and slide": crop_and_slide}


def method_of(name: str, renderer: Renderer) -> Method:
    """Wrap a renderer as a method."""

    def render(sample: Sample, target: Rig) -> list[RenderedView]:
        rig: Rig = sample["rig"]
        return renderer(rig, as_arrays(sample["images"]), target.in_frame_of(rig))

    return Method(name, render)
