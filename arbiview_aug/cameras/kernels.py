"""Compiled projection, one row of pixels at a time: viewing rays of a camera, and pixels of camera-frame points.

Each loop writes one array, so that the compiler turns it into vector instructions. All is float32: positions in images
of 1600 px are precise to 1/500 px.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from arbiview_aug.cameras.lens import MIN_DEPTH
from arbiview_aug.environment import borrowing, compiled, inlined

Row = Any  # float32 (n,): kernels are typed by numba

FAR_AWAY_PX = np.float32(1e5)
"""Position of points that a camera cannot project: outside every image, and precise in float32."""

LENS_CODES = {
    "pinhole": 0, "radtan": 1, "fisheye": 2, "ftheta": 3, "ftheta_backward": 4, "double_sphere": 5, "eucm": 5
}  # fmt: skip
"""Code of each lens in ``project_row``."""

_ZERO, _ONE, _TWO, _THREE = np.float32(0), np.float32(1), np.float32(2), np.float32(3)
_FOUR, _FIVE = np.float32(4), np.float32(5)
_NEWTON_STEPS, _LEAST_SLOPE = 4, np.float32(1e-2)
_HALF = np.float32(0.5)
_NO_CONE = np.float32(-9)
_CONE_ROOM = np.float32(1.05)
_LEAST = np.float32(MIN_DEPTH)
_TINY = np.float32(1e-30)
_TAN_22_5 = np.float32(0.41421356)
_QUARTER_PI, _HALF_PI, _PI = np.float32(np.pi / 4), np.float32(np.pi / 2), np.float32(np.pi)
# Minimax polynomial of (atan(t) - t) / t^3 in t^2 for |t| <= tan(22.5 deg), error 2e-8 (Cephes, atanf).
_ATAN = tuple(np.float32(c) for c in (8.05374449538e-2, -1.38776856032e-1, 1.99777106478e-1, -3.33329491539e-1))
_A0, _A1, _A2, _A3 = _ATAN


@inlined
def pinhole_rays_row(P: Row, v: float, first: int, rx: Row, ry: Row, rz: Row) -> None:
    """Unit rays of the pixels of row ``v`` from column ``first`` on, camera frame."""
    y = (np.float32(v) - P[4]) / P[3]
    per_fx, cx = _ONE / P[0], P[2] + P[1] * y
    start = np.int32(first)
    for i in range(rx.shape[0]):
        rx[i] = (np.float32(start + np.int32(i)) - cx) * per_fx
    for i in range(rx.shape[0]):
        rz[i] = _ONE / np.sqrt(rx[i] * rx[i] + y * y + _ONE)
    for i in range(rx.shape[0]):
        rx[i] *= rz[i]
    for i in range(rx.shape[0]):
        ry[i] = y * rz[i]


@borrowing
def rays_row(planes: Row, P: Row, y: int, x0: int, rx: Row, ry: Row, rz: Row) -> None:
    """Unit rays (n,) of the pixels of row ``y`` from column ``x0`` on, camera frame."""
    if planes.shape[1] == 0:
        pinhole_rays_row(P, y, x0, rx, ry, rz)
    else:
        n = rx.shape[0]
        a, b, c = planes[0, y, x0 : x0 + n], planes[1, y, x0 : x0 + n], planes[2, y, x0 : x0 + n]
        for i in range(n):  # rx[:] = a takes three times as long
            rx[i] = a[i]
        for i in range(n):
            ry[i] = b[i]
        for i in range(n):
            rz[i] = c[i]


@compiled
def cell_cones(planes: Row, P: Row, size: Row, step: int, cones: Row) -> None:
    """Cones (4, ny, nx) around the rays of square cells: the middle's ray, and how far any other's unit vector is off.

    At the border of a lens's image circle, where pixels have no ray, it is around those there are. A cell without any
    gets a negative width: nothing lies in its cone.
    """
    h, w = size
    _, ny, nx = cones.shape
    lines = np.empty((3, 3, w), np.float32)  # of rays: the cells' first, middle and last row
    first = np.int64(0)  # a literal would compile ``rays_row`` once more
    for j in range(ny):
        top, bottom = j * step, min(j * step + step, h) - 1
        for line in range(3):
            at = top if line == 0 else (top + bottom) // 2 if line == 1 else bottom
            rays_row(planes, P, at, first, lines[line, 0], lines[line, 1], lines[line, 2])
        for i in range(nx):
            left, right = i * step, min(i * step + step, w) - 1
            m = (left + right) // 2
            x, y, z = lines[1, 0, m], lines[1, 1, m], lines[1, 2, m]
            most, least = _ZERO, x * x + y * y + z * z
            for corner in range(4):
                row, column = 2 * (corner & 1), right if corner & 2 else left
                a, b, c = lines[row, 0, column], lines[row, 1, column], lines[row, 2, column]
                most = max(most, (a - x) * (a - x) + (b - y) * (b - y) + (c - z) * (c - z))
                least = min(least, a * a + b * b + c * c)
            if least <= _HALF:
                rays = planes[:, top : bottom + 1, left : right + 1]
                x, y, z = _ZERO, _ZERO, _ZERO
                for row in range(rays.shape[1]):
                    for column in range(rays.shape[2]):
                        x, y, z = x + rays[0, row, column], y + rays[1, row, column], z + rays[2, row, column]
                length, most = np.sqrt(x * x + y * y + z * z), _NO_CONE
                if length > _ZERO:
                    x, y, z = x / length, y / length, z / length
                for row in range(rays.shape[1]):
                    for column in range(rays.shape[2]):
                        a, b, c = rays[0, row, column], rays[1, row, column], rays[2, row, column]
                        if a * a + b * b + c * c > _HALF:
                            most = max(most, (a - x) * (a - x) + (b - y) * (b - y) + (c - z) * (c - z))
            spread = np.sqrt(most) * _CONE_ROOM if most >= _ZERO else _NO_CONE
            cones[0, j, i], cones[1, j, i], cones[2, j, i], cones[3, j, i] = x, y, z, spread


@borrowing
def turn_row(rx: Row, ry: Row, rz: Row, q: Row, A: Row, o: Row, x: Row, y: Row, z: Row) -> None:
    """Points A r + q o of rays r (n,) in another camera's frame, times their inverse distance q (n,)."""
    a, b, c, d = A[0, 0], A[0, 1], A[0, 2], o[0]
    for i in range(x.shape[0]):
        x[i] = a * rx[i] + b * ry[i] + c * rz[i] + d * q[i]
    a, b, c, d = A[1, 0], A[1, 1], A[1, 2], o[1]
    for i in range(x.shape[0]):
        y[i] = a * rx[i] + b * ry[i] + c * rz[i] + d * q[i]
    a, b, c, d = A[2, 0], A[2, 1], A[2, 2], o[2]
    for i in range(x.shape[0]):
        z[i] = a * rx[i] + b * ry[i] + c * rz[i] + d * q[i]


@borrowing
def project_row(x: Row, y: Row, z: Row, kind: int, P: Row, a: Row, b: Row, u: Row, v: Row) -> None:
    """Pixels u, v (n,) of camera-frame points; ``FAR_AWAY_PX`` where there is none. ``a`` and ``b`` are scratch."""
    n = u.shape[0]
    fx, skew, cx, fy, cy = P[0], P[1], P[2], P[3], P[4]
    if kind >= 2:
        if kind == 5:
            _sphere_row(x, y, z, P, a)
        else:
            _angular_row(x, y, z, kind, P, a, b, u)
        # The radius over the points' own; x and y stay in front of it.
        for i in range(n):
            valid = a[i] > -_ONE
            u[i] = (fx * x[i] + skew * y[i]) * a[i] + cx if valid else FAR_AWAY_PX
        for i in range(n):
            v[i] = fy * y[i] * a[i] + cy if a[i] > -_ONE else FAR_AWAY_PX
        return
    for i in range(n):  # the inverse depth, 0 where there is no pixel
        in_front = z[i] * z[i] > _LEAST * _LEAST * (x[i] * x[i] + y[i] * y[i] + z[i] * z[i])
        a[i] = _ONE / z[i] if (z[i] > _ZERO) & in_front else _ZERO
    if kind == 0:
        for i in range(n):
            u[i] = (fx * x[i] + skew * y[i]) * a[i] + cx if a[i] > _ZERO else FAR_AWAY_PX
        for i in range(n):
            v[i] = fy * y[i] * a[i] + cy if a[i] > _ZERO else FAR_AWAY_PX
        return
    k1, k2, p1, p2 = P[6], P[7], P[8], P[9]
    k3, k4, k5, k6 = P[10], P[11], P[12], P[13]
    fold2 = P[5] * P[5]
    for i in range(n):  # past the fold the polynomial is not the lens
        r2 = (x[i] * x[i] + y[i] * y[i]) * a[i] * a[i]
        v[i] = a[i] if r2 <= fold2 else _ZERO
    for i in range(n):
        a[i] = v[i]
    for i in range(n):
        r2 = (x[i] * x[i] + y[i] * y[i]) * a[i] * a[i]
        b[i] = (_ONE + r2 * (k1 + r2 * (k2 + r2 * k3))) / (_ONE + r2 * (k4 + r2 * (k5 + r2 * k6)))
    for i in range(n):
        xn, yn = x[i] * a[i], y[i] * a[i]
        xd = xn * b[i] + _TWO * p1 * xn * yn + p2 * (_THREE * xn * xn + yn * yn)
        yd = yn * b[i] + p1 * (xn * xn + _THREE * yn * yn) + _TWO * p2 * xn * yn
        u[i] = fx * xd + skew * yd + cx if a[i] > _ZERO else FAR_AWAY_PX
    for i in range(n):
        xn, yn = x[i] * a[i], y[i] * a[i]
        yd = yn * b[i] + p1 * (xn * xn + _THREE * yn * yn) + _TWO * p2 * xn * yn
        v[i] = fy * yd + cy if a[i] > _ZERO else FAR_AWAY_PX


@borrowing
def angle_row(r: Row, z: Row, out: Row) -> None:
    """atan2(r, z) (n,) in [0, pi] for r >= 0, by the octant that r and |z| lie in."""
    for i in range(r.shape[0]):
        far = abs(z[i])
        low, high = min(r[i], far), max(max(r[i], far), _TINY)
        turned = low > _TAN_22_5 * high
        s = (low - high if turned else low) / (low + high if turned else high)
        s2 = s * s
        angle = s + s * s2 * (_A3 + s2 * (_A2 + s2 * (_A1 + s2 * _A0)))
        angle = angle + _QUARTER_PI if turned else angle
        angle = _HALF_PI - angle if r[i] > far else angle
        out[i] = _PI - angle if z[i] < _ZERO else angle


@inlined
def _angular_row(x: Row, y: Row, z: Row, kind: int, P: Row, scale: Row, r: Row, radius: Row) -> None:
    """The radius of a fisheye or f-theta lens over r (n,), -2 past its fold and on the axis behind the camera."""
    k1, k2, k3, k4, fold = P[6], P[7], P[8], P[9], P[5]
    n = x.shape[0]
    for i in range(n):
        r[i] = np.sqrt(x[i] * x[i] + y[i] * y[i])
    angle_row(r, z, scale)
    if kind == 2:
        for i in range(n):
            theta = scale[i]
            t2 = theta * theta
            radius[i] = theta * (_ONE + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
    else:
        first = 6 if kind == 3 else 10  # of a forward polynomial
        s1, s2, s3, s4 = P[first], P[first + 1], P[first + 2], P[first + 3]
        for i in range(n):
            theta = scale[i]
            radius[i] = theta * (_ONE + theta * (s1 + theta * (s2 + theta * (s3 + theta * s4))))
        for _ in range(_NEWTON_STEPS if kind == 4 else 0):  # theta is a polynomial of the radius
            for i in range(n):
                q = radius[i]
                off = q * (_ONE + q * (k1 + q * (k2 + q * (k3 + q * k4)))) - scale[i]
                slope = _ONE + q * (_TWO * k1 + q * (_THREE * k2 + q * (_FOUR * k3 + q * _FIVE * k4)))
                radius[i] = q - off / max(slope, _LEAST_SLOPE)
    for i in range(n):
        on_axis = r[i] <= np.float32(1e-7) * abs(z[i])
        near = _ONE / max(z[i], _TINY) if z[i] > _ZERO else -_TWO
        inside = scale[i] <= fold
        value = near if on_axis else radius[i] / max(r[i], _TINY)
        scale[i] = value if inside else -_TWO


@inlined
def _sphere_row(x: Row, y: Row, z: Row, P: Row, scale: Row) -> None:
    """Scale (n,) of x and y that a double-sphere or EUCM lens projects by, -2 past its cone."""
    xi, alpha, beta, behind = P[6], P[7], P[8], np.cos(P[5])
    for i in range(x.shape[0]):
        r2 = x[i] * x[i] + y[i] * y[i]
        length = np.sqrt(r2 + z[i] * z[i])
        moved = z[i] + xi * length
        divisor = alpha * np.sqrt(beta * r2 + moved * moved) + (_ONE - alpha) * moved
        inside = (z[i] >= behind * length) & (divisor > _LEAST * length)
        scale[i] = _ONE / divisor if inside else -_TWO


@compiled
def project_image(rays: Row, q: Row, A: Row, o: Row, kind: int, P: Row, u: Row, v: Row) -> None:
    """Source pixels (h, w) of points on rays (3, h, w) at inverse distances (h, w)."""
    h, w = q.shape
    rows = np.empty((5, w), np.float32)
    x, y, z, a, b = rows[0], rows[1], rows[2], rows[3], rows[4]
    for j in range(h):
        turn_row(rays[0, j], rays[1, j], rays[2, j], q[j], A, o, x, y, z)
        project_row(x, y, z, kind, P, a, b, u[j], v[j])


@compiled
def edge_distance_row(u: Row, v: Row, size: Any, to_mask: Any, cell_px: int, edge_px: Row) -> None:
    """Distances (n,) of columns ``u`` and rows ``v`` to the border of what a source sees, as ``rays.edge_distance``.

    ``to_mask`` (H, W) is the distance of each cell of ``cell_px`` to the mask, pixels; (0, 0) without one.
    """
    h, w = size
    rows, columns = to_mask.shape
    for i in range(u.shape[0]):
        edge = min(min(u[i], w - 1 - u[i]), min(v[i], h - 1 - v[i])) + 0.5
        if rows and edge >= 0:
            row, column = min(int(v[i] / cell_px), rows - 1), min(int(u[i] / cell_px), columns - 1)
            edge = min(edge, to_mask[max(row, 0), max(column, 0)])
        edge_px[i] = edge
