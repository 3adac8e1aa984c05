"""Inputs and outputs of compiled planning: named arrays with their shapes, types, frames and units."""

from __future__ import annotations

from typing import Any, NamedTuple


class Images(NamedTuple):
    """An array for each of K sources, of different sizes, by its address: the caller keeps them alive, C-contiguous."""

    address: Any  # (K,) int64
    size: Any  # (K, 2) int64 rows and columns, 0 for none


class View(NamedTuple):
    """A target view (h, w) with nodes (ny, nx)."""

    planes: Any  # (3, h, w) float32 unit rays of the pixels; (3, 0, 0) for a pinhole
    P: Any  # (14,) float32 ``Camera.parameters``
    R: Any  # (3, 3) float64 rotation to the ego frame
    center_m: Any  # (3,) float64 in the ego frame
    cone: Any  # (4,) float64 middle of a cone around the rays, camera frame, and its half angle
    y: Any  # (ny,) int64 rows of the nodes
    x: Any  # (nx,) int64 columns of the nodes
    rays: Any  # (3, ny, nx) float32 unit rays of the nodes
    step: int  # side of a cell, pixels


class Sources(NamedTuple):
    """The K source cameras that may see a view, as they are read: some are halved."""

    A: Any  # (K, 3, 3) float32 rotation from the target's frame
    o: Any  # (K, 3) float32 the target's centre in the source's frame; 0 where the scene counts as infinitely far
    kind: Any  # (K,) int64 code of the lens
    P: Any  # (K, 14) float32 ``Camera.parameters``
    size: Any  # (K, 2) int64 height and width, not halved
    bounds: Any  # (K, 6) float32 least columns and rows of the image, largest ones; last pixel of a halved one, or -1
    offset_m: Any  # (K, 3) float32 the target's centre minus the source's, target's frame
    bonus: Any  # (K,) float32 factor of the weight
    slot: Any  # (K, 3) int32 number of the source; column and row of its image in the atlas
    to_mask: Images  # float32 distance of each cell of ``CELL_PX`` to the own car, pixels
    clean: Images  # uint8, 0 where the image shows the own car


class Surfaces(NamedTuple):
    """The scene as a view sees it."""

    q: Any  # (h, w) float32 inverse distances along the pixels' rays, 1/m
    face: Any  # (h, w) int32 faces of objects, -1 elsewhere; (0, 0) without any
    behind: Any  # (ny, nx) float32 inverse distances of the background on the nodes
    uncertainty: Any  # (ny, nx) float32 expected error of the inverse distance on the nodes, 1/m


class Occluders(NamedTuple):
    """Occluders of points for each of K sources; see ``surface.OcclusionMap``."""

    beyond: Images  # float32 inverse distances beyond which points are hidden, 1/m
    solid: Images  # int32 number of the solid that hides them, -1 for none
    scale: Any  # (K,) float32 size of these images over that of the image that is read
    before_m: Any  # (K, F) float32 metres that the source lies before the plane of each face; (K, 0) without objects
    is_guess: bool  # the background was not measured: everything in front of it hides it


class Nodes(NamedTuple):
    """Inputs of the weights of K sources on the nodes of a view; written by ``measure_nodes``."""

    score: Any  # (K, ny, nx) float32 weight, 0 where the source sees nothing
    border: Any  # (K, ny, nx) float32 distance to the border of what the source sees, target pixels; 0 if not ``near``
    parallax: Any  # (K, ny, nx) float32 expected displacement, target pixels
    resolution: Any  # (K, ny, nx) float32 source pixels per target pixel along the worse axis
    near: Any  # (K, ny, nx) bool, whether the source's image may contain pixels of the cells around
    halvings: Any  # (K,) int64 of the source's image before it is read; -1 where no pixel can lie in it


class Pixels(NamedTuple):
    """The plan of a view's pixels; written by ``plan_pixels``."""

    winner: Any  # (h, w) int8 number of the winning source, -1 for none
    xy: Any  # (h, w) int32, two int16: whole pixels in the atlas
    frac: Any  # (h, w) uint16 32nds of a pixel
    count: Any  # (1,) int64 number of pixels into which a second source is blended; given as 0
    pixel: Any  # (h w,) int64 these pixels, of the flattened view; (0,) without seams, as all that follow
    second_xy: Any  # (h w,) int32 ``xy`` in the second source
    share: Any  # (h w,) float32 its share
    second_frac: Any  # (h w,) uint16
    second: Any  # (h w,) int8 its number
    in_image: Any  # (h, w) uint8, not 0 where some source's image contains the pixel; (0, 0) where nothing hides
    won: Any  # (128,) int64 pixels that each source wins; given as 0
