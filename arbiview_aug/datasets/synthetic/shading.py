"""The colour of what a ray meets: materials, light, haze and sky. Flat tensors in, (n, 3) display RGB in [0, 1] out."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import torch
import torch.nn.functional as F
from torch import Tensor

from arbiview_aug.datasets.synthetic.materials import (
    MATERIALS,
    Surface,
    band,
    cell_hash,
    dot,
    fade,
    mix,
    noise,
    octave,
    pulses,
    step,
)
from arbiview_aug.datasets.synthetic.raycast import GROUND_ID, SKY_ID
from arbiview_aug.datasets.synthetic.scene import BOX, CYLINDER, BoxClass, Material, Scene, SceneClass, Street

FloatGrid = npt.NDArray[np.float32]

_CHUNK = 32768  # hits shaded at a time: each temporary stays in the cache
_HAZE_M = 1100.0  # distance at which half of the light is the air's
SHADOW_CELL_M = 0.125
SHADOW_X_M, SHADOW_Y_M = (-80.0, 80.0), (-32.0, 32.0)


class SceneTables(NamedTuple):
    """A scene's rows as float32 and int64 tensors."""

    scene: Scene
    kind: Tensor
    material: Tensor
    center: Tensor
    rotation: Tensor
    half: Tensor
    planes: Tensor
    color: Tensor
    param: Tensor
    light: Tensor

    @classmethod
    def build(cls, scene: Scene) -> SceneTables:
        columns = {name: getattr(scene, name) for name in cls._fields[1:-1]}
        rounded = {name: a.astype(np.float32) if a.dtype.kind == "f" else a for name, a in columns.items()}
        tensors = {name: torch.tensor(array) for name, array in rounded.items()}
        return cls(scene=scene, light=torch.as_tensor(light_map(scene)), **tensors)


class Hits(NamedTuple):
    """Hits of rays on surfaces."""

    point: Tensor  # [n, 3] street frame, metres
    direction: Tensor  # [n, 3] unit ray directions, street frame
    t: Tensor  # [n] distance, metres
    pitch: Tensor  # [n] angle between neighbouring rays, radians
    primitive: Tensor  # [n] row of the scene, GROUND_ID or SKY_ID


def faces(tables: SceneTables, point: Tensor, primitive: Tensor) -> Tensor:
    """(n,) index of the box side that a hit lies on; 0 for other primitives."""
    face = torch.zeros_like(primitive)
    rows = (primitive >= 0).nonzero()[:, 0]
    rows = rows[tables.kind[primitive[rows]] == BOX]
    by_part = [tables.planes[:, :, c].contiguous() for c in range(4)]
    for part in rows.split(_CHUNK):
        k, p = primitive[part], point.index_select(0, part)
        nx, ny, nz, b = (table.index_select(0, k) for table in by_part)  # [m, 6] each
        face[part] = (nx * p[:, 0:1] + ny * p[:, 1:2] + nz * p[:, 2:3] - b).argmax(1)
    return face


def shade(tables: SceneTables, hits: Hits, face: Tensor) -> Tensor:
    """(n, 3) colours of hits on box sides ``face`` (n,)."""
    out = torch.zeros_like(hits.point)
    material = tables.material[hits.primitive.clamp_min(0)]
    material = torch.where(hits.primitive == GROUND_ID, int(Material.ROAD), material)
    material = torch.where(hits.primitive == SKY_ID, -1, material)
    for m in (-1, *Material):
        for rows in (material == int(m)).nonzero()[:, 0].split(_CHUNK):
            if len(rows):
                part = Hits(*(a.index_select(0, rows) for a in hits))
                is_sky = m == -1
                out[rows] = sky_color(tables.scene, part) if is_sky else _lit(tables, part, face[rows], m)
    return out.clamp(0, 1)


def _lit(tables: SceneTables, hits: Hits, face: Tensor, material: int) -> Tensor:
    light = tables.scene.light
    across = hits.t * hits.pitch
    normal = torch.tensor([0.0, 0.0, 1.0]).expand_as(hits.point)
    if material != Material.ROAD:
        half, rotation = (a.index_select(0, hits.primitive) for a in (tables.half, tables.rotation))
        offset = hits.point - tables.center.index_select(0, hits.primitive)
        local = offset[:, 0:1] * rotation[:, 0] + offset[:, 1:2] * rotation[:, 1] + offset[:, 2:3] * rotation[:, 2]
        normal = _normals(tables, hits.primitive, face, local, half, rotation)
    slant = across / dot(normal, hits.direction).abs().clamp_min(0.01)
    ambient = 1 - 0.30 * light.sun_strength
    sun = torch.tensor(light.sun)[None]
    toward = dot(normal, sun).clamp_min(0) * light.sun_strength
    if material in (Material.ROAD, Material.SLAB):
        x, y = hits.point[:, 0], hits.point[:, 1]
        flat = (hits.direction[:, 0] ** 2 + hits.direction[:, 1] ** 2).clamp_min(1e-8)
        hx2, hy2 = hits.direction[:, 0] ** 2 / flat, hits.direction[:, 1] ** 2 / flat
        fx = (slant**2 * hx2 + across**2 * hy2).sqrt()
        fy = (slant**2 * hy2 + across**2 * hx2).sqrt()
        sky_share, sun_share = sample_light(tables.light, x, y)
        street, salt = tables.scene.street, tables.scene.salt
        if material == Material.ROAD:
            color = road_color(street, salt, x, y, fx, fy)
        else:
            base = tables.color.index_select(0, hits.primitive)
            color = slab_color(street, salt, hits.point, face == 4, fx, fy, base)
        shine = sky_share * (ambient * (0.62 + 0.38 * normal[:, 2]) + 0.95 * toward * sun_share)
    else:
        surface = Surface(
            tables.scene, hits.point, local, half, face, hits.direction, normal, across, slant,
            tables.color.index_select(0, hits.primitive), tables.param.index_select(0, hits.primitive), hits.primitive,
        )  # fmt: skip
        color = MATERIALS[Material(material)](surface)
        # Faces that look down see the road instead of the sky; light falls off close to the road.
        low = 0.72 + 0.28 * (hits.point[:, 2] * (1 / 0.7)).clamp(0, 1)
        shine = low * (ambient * (0.68 + 0.32 * normal[:, 2]) + 0.85 * toward)
    return mix(color * shine[:, None], torch.tensor(light.horizon), hits.t / (hits.t + _HAZE_M))


def _normals(tables: SceneTables, k: Tensor, face: Tensor, local: Tensor, half: Tensor, rotation: Tensor) -> Tensor:
    kind = tables.kind[k]
    flat = tables.planes.view(-1, 4).index_select(0, k * 6 + face)[:, :3]
    if bool((kind == BOX).all()):
        return flat
    gradient = local / (half * half)
    cap = (local[:, 2].abs() > half[:, 2] * (1 - 1e-4) - 1e-5) & (kind == CYLINDER)
    gradient[:, 2] = torch.where(cap, local[:, 2].sign() * 1e6, torch.where(kind == CYLINDER, 0.0, gradient[:, 2]))
    length = (gradient[:, 0] ** 2 + gradient[:, 1] ** 2 + gradient[:, 2] ** 2).sqrt().clamp_min(1e-9)
    gradient = gradient / length[:, None]
    x, y, z = (gradient[:, k : k + 1] * rotation[:, :, k] for k in range(3))
    return torch.where((kind == BOX)[:, None], flat, x + y + z)


def sky_color(scene: Scene, hits: Hits) -> Tensor:
    """(n, 3) sky along the hits' directions: a gradient with clouds on a plane overhead."""
    light, d = scene.light, hits.direction
    zenith, horizon = (torch.tensor(c) for c in (light.zenith, light.horizon))
    up = d[:, 2].clamp_min(0)
    color = mix(horizon, zenith, (up * 1.5).clamp(0, 1).sqrt())
    scale = 1 / (up + 0.10)
    x, y, f = d[:, 0] * scale, d[:, 1] * scale, hits.pitch * scale * scale
    salt = scene.salt + 900
    n = octave(x, y, 2.2, f, salt) + 0.55 * octave(x, y, 0.9, f, salt + 1) + 0.3 * octave(x, y, 0.4, f, salt + 2)
    n = n + 0.15 * octave(x, y, 0.17, f, salt + 3)
    cover = step(n, -0.1, 0.9) * light.clouds * (up * 8).clamp(0, 1)
    white = torch.tensor([0.94, 0.945, 0.95])
    return mix(color, white, cover * 0.9)


def road_color(street: Street, salt: int, x: Tensor, y: Tensor, fx: Tensor, fy: Tensor) -> Tensor:
    """(n, 3) asphalt with wear and markings at points (n,) of the road plane with footprints (n,) along x and y."""
    f, wear = torch.maximum(fx, fy), street.wear
    tone = street.asphalt * (1 + 0.10 * octave(x, y, 7.0, f, salt) + 0.09 * octave(x, y, 1.7, f, salt + 1))
    # Streaks along the road, polished wheel tracks, a darker oil strip between them.
    streak = noise(x * (1 / 9.0), y * (1 / 0.45), salt + 2) * fade(torch.maximum(fx * 0.05, fy), 0.45)
    streak = streak + 0.7 * noise(x * (1 / 4.0), y * (1 / 0.15), salt + 3) * fade(torch.maximum(fx * 0.04, fy), 0.15)
    lane = y * (1 / street.lane_width_m)
    across = (lane - lane.floor() - 0.5).abs() * street.lane_width_m
    track, oil = step(0.45 - (across - 0.8).abs(), 0.0, 0.35), step(0.4 - across, 0.0, 0.4)
    tone = tone * (1 + 0.07 * streak + 0.05 * track - 0.06 * oil)
    grain = octave(x, y, 0.30, f, salt + 4) * 0.07 + octave(x, y, 0.11, f, salt + 5) * 0.10
    grain = grain + octave(x, y, 0.045, f, salt + 6) * 0.16
    tone = tone * (1 + grain * (0.7 + 0.3 * wear))
    tone = _patches(street, salt, tone, x, y, fx, fy)
    # Cracks along the zero crossings of bent noise: an open net of long ones, a fine one in worn places.
    bend = octave(x, y, 0.5, f, salt + 50) * 0.22
    for k, (along, apart, width, depth) in enumerate(((4.5, 1.6, 0.016, 0.5), (0.8, 0.5, 0.008, 0.4))):
        n = noise(x * (1 / along) + bend / along, y * (1 / apart) + bend / apart, salt + 51 + k)
        distance = n.abs() * (0.45 * apart)  # the noise falls by about 2 over its wavelength
        line = ((width + f / 2 - distance) / f.clamp_min(width)).clamp(0, 1) * fade(f, apart * 0.5)
        where = step(noise(x * 0.11, y * 0.16, salt + 55 + k), -0.2 + 0.5 * k, 0.5 + 0.4 * k)
        thinned = (width / f.clamp_min(width)).clamp(0.25, 1)
        tone = tone * (1 - depth * min(1.0, wear) * line * where * thinned)
    # Stains: one in some cells of 2.5 m.
    i, j = (x * 0.4).floor(), (y * 0.4).floor()
    h = [cell_hash(i, j, salt + 60 + m) for m in range(4)]
    dx, dy = x - (i + 0.25 + 0.5 * h[0]) * 2.5, y - (j + 0.25 + 0.5 * h[1]) * 2.5
    d = (dx * dx + dy * dy).sqrt() / (0.08 + 0.45 * h[2] * h[2]) + 0.35 * octave(x, y, 0.25, f, salt + 64)
    tone = tone * (1 - 0.30 * step(1 - d, 0.0, 0.6) * (h[3] < 0.45 * wear) * fade(f, 0.8))
    edge = torch.minimum(y + street.half_width_m[0], street.half_width_m[1] - y)
    outside = ((x - street.crossing_x_m).abs() > street.crossing_half_m).float()
    dirt = step(0.55 - edge, 0.0, 0.5) * (0.6 + 0.4 * octave(x, y, 0.5, f, salt + 9)) * outside
    color = (tone * (1 - 0.28 * dirt))[:, None] * torch.tensor([1.0, 1.0, 1.015])
    flaking = octave(x, y, 0.35, f, salt + 10) + 0.5 * octave(x, y, 0.08, f, salt + 11)
    worn = 0.80 - 0.30 * wear * step(flaking, 0.1, 0.9)
    paint, centre = _markings(street, x, y, fx, fy)
    white = torch.tensor([0.80, 0.80, 0.78])
    yellow = torch.tensor([0.80, 0.62, 0.16]) if street.yellow_centre else white
    return mix(mix(color, white, paint * worn), yellow, centre * worn)


def _patches(street: Street, salt: int, tone: Tensor, x: Tensor, y: Tensor, fx: Tensor, fy: Tensor) -> Tensor:
    """Rectangular repairs with a sealed rim, utility trenches across the road, manhole covers, the lane joint."""
    width = street.lane_width_m
    for k, (length, share) in enumerate(((13.0, 0.42), (5.0, 0.22))):
        i, j = (x / length).floor(), (y / width).floor()
        h = [cell_hash(i, j, salt + 20 + 8 * k + m) for m in range(5)]
        there = (h[0] < share * street.wear).float()
        x0, y0 = (i + 0.05 + 0.4 * h[1]) * length, (j + 0.06 + 0.35 * h[2]) * width
        x1, y1 = x0 + (0.12 + 0.4 * h[3]) * length, y0 + (0.22 + 0.35 * h[1]) * width
        inner = band(x, x0, x1, fx) * band(y, y0, y1, fy) * there
        outer = band(x, x0 - 0.04, x1 + 0.04, fx) * band(y, y0 - 0.04, y1 + 0.04, fy) * there
        tone = tone * (1 + inner * (0.34 * h[4] - 0.24)) * (1 - 0.40 * (outer - inner))
    plot = (x * (1 / 19.0)).floor()
    trench = cell_hash(plot, torch.zeros_like(x), salt + 40)
    start = (plot + 0.8 * trench) * 19.0
    tone = tone * (1 - 0.16 * band(x, start, start + 0.5 + trench, fx) * (trench > 0.5))
    tone = tone * (1 - 0.25 * band(y - (y / width).round() * width, 0.10, 0.125, fy))
    i, j = (x * (1 / 14.0)).floor(), (y / width).floor()
    h0, h1 = (cell_hash(i, j, salt + 41 + m) for m in range(2))
    dx, dy = x - (i + 0.2 + 0.6 * h1) * 14.0, y - (j + 0.5) * width
    disc = ((0.34 - (dx * dx + dy * dy).sqrt()) / torch.maximum(fx, fy).clamp_min(0.01) + 0.5).clamp(0, 1)
    return tone * (1 - 0.35 * disc * (h0 < 0.4) * fade(torch.maximum(fx, fy), 0.9))


def _markings(street: Street, x: Tensor, y: Tensor, fx: Tensor, fy: Tensor) -> tuple[Tensor, Tensor]:
    """Coverage by white paint and by the centre line's paint."""
    dashes = pulses(x, 9.0, 3.0, fx)
    centre = band(y.abs(), 0.08, 0.20, fy) if street.solid_centre else band(y, -0.07, 0.07, fy) * dashes
    edge = street.lanes * street.lane_width_m
    paint = torch.zeros_like(x)
    for side in (-1, 1):
        if street.parking[side > 0]:
            paint = paint + band(y, side * edge - 0.06, side * edge + 0.06, fy)
            # bays for parking, marked by short lines
            bay = sorted((side * edge, side * (edge + 2.0)))
            paint = paint + band(y, bay[0], bay[1], fy) * pulses(x, 6.0, 0.10, fx)
        for k in range(1, street.lanes):
            line = side * k * street.lane_width_m
            paint = paint + band(y, line - 0.06, line + 0.06, fy) * dashes
    if math.isinf(street.crossing_x_m):
        return paint.clamp(0, 1), centre
    half, along = street.crossing_half_m, x - street.crossing_x_m
    margin = 5.2 if street.zebra else 1.2
    outside = 1 - band(along, -half - margin, half + margin, fx)
    paint, centre = paint * outside, centre * outside
    right, left = street.half_width_m
    stop = band(along, -half - margin - 0.4, -half - margin, fx) * band(y, -edge, -0.2, fy)
    stop = stop + band(along, half + margin, half + margin + 0.4, fx) * band(y, 0.2, edge, fy)
    paint = paint + stop
    if street.zebra:
        stripes = pulses(y, 1.0, 0.5, fy) * band(y, -right + 0.3, left - 0.3, fy)
        paint = paint + stripes * (band(along, -half - 4.2, -half - 1.2, fx) + band(along, half + 1.2, half + 4.2, fx))
    across = band(along, -0.07, 0.07, fx) * pulses(y, 9.0, 3.0, fy) * (1 - band(y, -right - 4, left + 4, fy))
    return (paint + across).clamp(0, 1), centre


def slab_color(street: Street, salt: int, p: Tensor, top: Tensor, fx: Tensor, fy: Tensor, base: Tensor) -> Tensor:
    """(n, 3) kerb stones, grass, paving and yards at points (n, 3); ``top`` (n,) is False on the kerb's face."""
    x, y, f, left = p[:, 0], p[:, 1], torch.maximum(fx, fy), p[:, 1] > 0
    widths = torch.tensor([street.half_width_m, street.sidewalk_m, street.verge_m])
    half_width, sidewalk, verge_width = torch.where(left, widths[:, 1:], widths[:, :1])
    behind = y.abs() - half_width
    corner = ((x - street.crossing_x_m).abs() - street.crossing_half_m).clamp(max=1e4)  # infinite without a crossing
    kerb = torch.maximum(band(behind, -1.0, 0.16, fy), band(corner, -1.0, 0.16, fx))
    kerb = torch.where(top, kerb, torch.ones_like(kerb))
    dark = 1 + 0.10 * octave(x, y, 1.3, f, salt + 70)
    dark = dark + 0.10 * octave(x, y, 0.2, f, salt + 71) + 0.10 * octave(x, y, 0.06, f, salt + 74)
    # paving: 0.6 m slabs of slightly different tone with joints
    i, j = (x * (1 / 0.6)).floor(), (y * (1 / 0.6)).floor()
    tone = 1 + 0.14 * (cell_hash(i, j, salt + 72) - 0.5) * fade(f, 0.6)
    joints = torch.maximum(pulses(x, 0.6, 0.02, fx), pulses(y, 0.6, 0.02, fy))
    color = base * (dark * tone * (1 - 0.4 * joints))[:, None]
    blades = 1 + 0.20 * octave(x, y, 0.9, f, salt + 73)
    blades = blades + 0.28 * octave(x, y, 0.16, f, salt + 75) + 0.3 * octave(x, y, 0.05, f, salt + 76)
    grass = torch.tensor([0.25, 0.29, 0.15]) * blades[:, None]
    away = (corner > 2.6).float()
    # Yards: some plots are paved, some are lawns.
    plot = cell_hash((x * (1 / 19.0)).floor(), left, salt + 77) < 0.6
    lawn = band(behind, sidewalk, 1e4, fy) * away * plot
    verge = band(behind, 0.16, 0.16 + verge_width, fy) * away
    color = mix(color, grass, torch.maximum(lawn, verge))
    stones = torch.maximum(pulses(x, 1.0, 0.015, fx), pulses(y, 1.0, 0.015, fy))
    stone = torch.tensor([0.60, 0.595, 0.58]) * (dark * (1 - 0.35 * stones))[:, None]
    return mix(color, stone, kerb)


def light_map(scene: Scene) -> FloatGrid:
    """(2, rows along y, columns along x) float32: share of the sky's and of the sun's light that reaches the ground."""
    xs, ys = (np.arange(a, b, SHADOW_CELL_M, dtype=np.float32) + SHADOW_CELL_M / 2 for a, b in (SHADOW_X_M, SHADOW_Y_M))
    sky, sun = np.ones((2, len(ys), len(xs)), np.float32)

    def window(lo: np.ndarray, hi: np.ndarray) -> tuple[slice, slice]:
        a = np.searchsorted(xs, [lo[0], hi[0]]), np.searchsorted(ys, [lo[1], hi[1]])
        return slice(a[1][0], a[1][1]), slice(a[0][0], a[0][1])

    for box, label in zip(scene.boxes, scene.box_classes, strict=True):
        is_vehicle = label < BoxClass.PEDESTRIAN  # people and two-wheelers cover little ground
        spread = 0.9 if is_vehicle else 0.45
        reach = np.hypot(box[3], box[4]) / 2 + spread
        rows, cols = window(box[:2] - reach, box[:2] + reach)
        dx, dy = xs[None, cols] - np.float32(box[0]), ys[rows, None] - np.float32(box[1])
        c, s = np.float32(np.cos(box[6])), np.float32(np.sin(box[6]))
        u, v = np.abs(c * dx + s * dy) - box[3] / 2, np.abs(c * dy - s * dx) - box[4] / 2
        outside = np.sqrt(np.maximum(u, 0) ** 2 + np.maximum(v, 0) ** 2)
        depth = np.minimum(np.maximum(u, v), 0)
        # Half the sky is occluded at the sill, nearly all of it deep underneath.
        shade = np.clip(1 - outside / spread, 0, 1) ** 3 * 0.5
        if is_vehicle:
            shade = shade + np.clip(-depth / 0.45, 0, 1) * 0.36
        sky[rows, cols] *= 1 - shade.astype(np.float32)
    d = np.array(scene.light.sun)
    for k in np.flatnonzero(scene.cls != SceneClass.SIDEWALK) if scene.light.sun_strength > 0 else ():
        foot = scene.corners[k, :, :2] - d[:2] / d[2] * scene.corners[k, :, 2:].clip(0)
        rows, cols = window(foot.min(0), foot.max(0))
        if rows.start < rows.stop and cols.start < cols.stop:
            shaded = _shaded_by_box if scene.kind[k] == BOX else _shaded_by_quadric
            dim = 0.75 if scene.cls[k] == SceneClass.VEGETATION else 1.0  # light passes through leaves
            sun[rows, cols] *= 1 - np.float32(dim) * shaded(scene, int(k), xs[None, cols], ys[rows, None], d)
    both = F.avg_pool2d(F.pad(torch.from_numpy(np.stack([sky, sun]))[None], (1, 1, 1, 1), mode="replicate"), 3, 1)
    return both[0].numpy()


def _shaded_by_box(scene: Scene, k: int, x: FloatGrid, y: FloatGrid, d: np.ndarray) -> npt.NDArray[np.bool_]:
    """(rows, columns): rays along ``d`` from the points (x, y, 0) that pass through box ``k``."""
    enter, leave = (np.full((y.shape[0], x.shape[1]), s * np.inf, np.float32) for s in (-1, 1))
    for plane in scene.planes[k]:
        speed = float(plane[:3] @ d) or -1e-9
        t = (np.float32(plane[3] / speed) - np.float32(plane[0] / speed) * x) - np.float32(plane[1] / speed) * y
        if speed < 0:
            np.maximum(enter, t, out=enter)
        else:
            np.minimum(leave, t, out=leave)
    return np.asarray((enter < leave) & (leave > 0))


def _shaded_by_quadric(scene: Scene, k: int, x: FloatGrid, y: FloatGrid, d: np.ndarray) -> npt.NDArray[np.bool_]:
    """As ``_shaded_by_box`` for an ellipsoid or a capped cylinder."""
    A, c = (scene.rotation[k].T / scene.half[k][:, None]).astype(np.float32), scene.center[k].astype(np.float32)
    ox, oy, oz = (row[0] * (x - c[0]) + row[1] * (y - c[1]) - row[2] * c[2] for row in A)
    ex, ey, ez = A @ d.astype(np.float32)
    flat = scene.kind[k] == CYLINDER
    rz, ez_ = (0 * oz, np.float32(0)) if flat else (oz, ez)
    a, beta = ex * ex + ey * ey + ez_ * ez_, ex * ox + ey * oy + ez_ * rz
    root = beta * beta - a * (ox * ox + oy * oy + rz * rz - 1)
    half = np.sqrt(np.maximum(root, 0))
    enter, leave = (-beta - half) / a, (half - beta) / a
    if flat:
        t0, t1 = (-1 - oz) / (ez or np.float32(1e-9)), (1 - oz) / (ez or np.float32(1e-9))
        enter, leave = np.maximum(enter, np.minimum(t0, t1)), np.minimum(leave, np.maximum(t0, t1))
    return np.asarray((root > 0) & (enter < leave) & (leave > 0))


def sample_light(table: Tensor, x: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
    """Sky and sun shares (n,) at ground points (n,) from a light map; the border value outside."""
    u = (x - SHADOW_X_M[0]) * (2 / (SHADOW_X_M[1] - SHADOW_X_M[0])) - 1
    v = (y - SHADOW_Y_M[0]) * (2 / (SHADOW_Y_M[1] - SHADOW_Y_M[0])) - 1
    grid = torch.stack([u.clamp(-1, 1), v.clamp(-1, 1)], -1)[None, None]
    out = F.grid_sample(table[None], grid, mode="bilinear", padding_mode="border", align_corners=False)[0, :, 0]
    return out[0], out[1]
