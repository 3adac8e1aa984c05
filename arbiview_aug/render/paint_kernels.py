"""Contents of holes other than background: objects and nearer pixels, unseen parts to paint, samples of colours."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from arbiview_aug.environment import borrowing, called, compiled
from arbiview_aug.render.plan import NEARER, Paint, nearer_cells
from arbiview_aug.scene.boxes import PARTS, RIM_PART, TOP_PART

_ZERO, _ONE = np.float32(0), np.float32(1)
_SAMPLES = 64  # of objects' colours along a view's shorter side
_BLOCK_PX = 32  # of a row that are looked at together
_INSIDE_PX = 2  # samples lie this far inside their faces: pixels at a border mix two colours
RIM_PX = 3
"""Height of a rim: roofs have frames of some centimetres, below which windows begin."""

_MEDIAN, _TOP_SHARE, _RIM_SHARE, _PAINT_SHARE = 0.5, 0.9, 0.6, 0.8
"""Quantiles nearest to the paint: of sides; of tops, which are seen at grazing angles; of their rims, below which
windows begin; of windows and the paint around them, by their largest channel, from which on all is paint."""

_SURE_SAMPLES, _SAME_HUE = 6, 0.06
"""Samples of a seen top that weigh as much as its paint; largest difference of their hues, as shares of the channels'
sum. Reflected sky makes a top paler; another hue shows what is behind it."""

_LEAST_SAMPLES = 3
"""Samples of a part that suffice for its colour."""

_GAMMA = 2.2
"""Exponent of displayed colours in linear light, as sRGB's on average."""


def find_paint(
    q: npt.NDArray[np.float32],
    face: npt.NDArray[np.int32],
    part: npt.NDArray[np.int32],
    winner: npt.NDArray[np.int8],
    cell: int,
    layers: npt.NDArray[np.uint8],
) -> Paint | None:
    """Find the unseen parts of objects in a view, and complete its layers by objects and by what is near.

    Args:
        q: (h, w) inverse distances, 0 where unknown.
        face: (h, w) faces of objects, -1 elsewhere; (0, 0) without any.
        part: (F,) ``scene.boxes.BoxSurface.face_parts``.
        winner: (h, w) source, -1 for none.
        cell: Side of the cells in which what is near is compared with what it hides, pixels.
        layers: (h, w), 1 (``plan.OCCLUDED``) where a pixel is a hole in a source's image; updated to ``plan.OBJECT``.

    Returns:
        None without objects.
    """
    h, w = winner.shape
    columns, farthest = np.empty((len(face), 2), np.int32), np.empty((-(-h // cell), -(-w // cell)), np.float32)
    face_columns(face, columns)
    farthest_occluded(q, face, layers, cell, farthest)
    side = 2 * nearer_cells(winner.shape, cell) + 1
    limit = cv2.erode(NEARER * farthest, np.ones((side, side), np.uint8))
    mark_objects(q, face, columns, winner, limit, cell, layers)
    if not face.size:
        return None
    step, table = max(1, min(h, w) // _SAMPLES), np.empty((4, 2 * face.size), np.int32)
    starts = np.empty(h + 1, np.int32)
    hidden, sampled = list_parts(face, columns, part, winner, step, table, starts)
    (pixel, hidden_part), (sample, sample_part) = table[:2, :hidden].copy(), table[2:, :sampled].copy()
    nearest = np.empty((4, hidden), np.int32)
    nearest_seen(face, part, winner, pixel, starts, nearest)
    return Paint(pixel, hidden_part, sample, sample_part, nearest)


@compiled
def face_columns(face: Any, columns: Any) -> None:
    """First and last (exclusive) column (h, 2) of the objects in each row of faces (h, w); w and 0 without any."""
    h, w = face.shape
    for y in range(h):
        row, first, last = face[y], np.int32(w), np.int32(0)
        for x in range(w):
            first = min(first, np.int32(x) if row[x] >= 0 else np.int32(w))
        for x in range(w):
            last = max(last, np.int32(x + 1) if row[x] >= 0 else np.int32(0))
        columns[y, 0], columns[y, 1] = first, last


@compiled
def farthest_occluded(q: Any, face: Any, layers: Any, cell: int, farthest: Any) -> None:
    """Least inverse distance (ny, nx) of the occluded background in each cell; infinity without any."""
    (h, w), (ny, nx) = q.shape, farthest.shape
    low, lower = np.empty(w, np.float32), np.empty(w, np.float32)
    for j in range(ny):
        low[:] = np.inf
        for y in range(j * cell, min(j * cell + cell, h)):
            row, layer, any_layer = q[y], layers[y], np.uint8(0)
            for x in range(w):
                any_layer |= layer[x]
            if not any_layer:
                continue
            if face.shape[0]:
                faces = face[y]
                for x in range(w):
                    occluded = (layer[x] == 1) & (faces[x] < 0) & (row[x] > _ZERO)
                    lower[x] = min(low[x], row[x]) if occluded else low[x]
            else:
                for x in range(w):
                    lower[x] = min(low[x], row[x]) if (layer[x] == 1) & (row[x] > _ZERO) else low[x]
            low, lower = lower, low
        for i in range(nx):
            least = low[i * cell]
            for x in range(i * cell, min(i * cell + cell, w)):
                least = min(least, low[x])
            farthest[j, i] = least


@compiled
def mark_objects(q: Any, face: Any, columns: Any, winner: Any, limit: Any, cell: int, layers: Any) -> None:
    """Mark objects, and what is nearer than occluded background next to it.

    Seen pixels above ``limit`` (ny, nx) of their cell, inverse distances, are nearer. Others as in ``find_paint``.
    """
    (h, w), nx = q.shape, limit.shape[1]
    limits, least = np.empty(w, np.float32), np.float32(0)
    for y in range(h):
        row, who, out = q[y], winner[y], layers[y]
        if y % cell == 0:
            least = np.float32(np.inf)
            for i in range(nx):
                least = min(least, limit[y // cell, i])
                for x in range(i * cell, min(i * cell + cell, w)):
                    limits[x] = limit[y // cell, i]
        if least < np.inf:
            for x in range(w):
                out[x] = np.uint8(2) if (row[x] > limits[x]) & (who[x] >= 0) else out[x]
        if face.shape[0]:
            faces, out = face[y, columns[y, 0] : columns[y, 1]], out[columns[y, 0] : columns[y, 1]]
            for x in range(len(out)):
                out[x] = np.uint8(2) if faces[x] >= 0 else out[x]


@compiled
def list_parts(face: Any, columns: Any, part: Any, winner: Any, step: int, table: Any, starts: Any) -> tuple[int, int]:
    """List the unseen pixels of objects, and a sample of seen ones, ``step`` apart; return their numbers.

    The first ``RIM_PX`` seen pixels of the cabin below each column of an unseen roof are samples of its rim. Vehicles
    without another sample give all their seen pixels. Written: ``table`` (4, 2 h w), the first four attributes of
    ``plan.Paint``; ``starts`` (h + 1,), each row's first unseen pixel. Others as in ``find_paint``.
    """
    (h, w), margin = face.shape, _INSIDE_PX
    hidden, sampled, objects = 0, 0, part[-1] // PARTS + 1
    is_known, above, below = np.ones(objects, np.bool_), np.full(objects, h), np.zeros(objects, np.int64)
    for number in range(part.shape[0]):
        if part[number] % PARTS:
            is_known[part[number] // PARTS] = False
    looked = np.empty(w, np.uint8)
    for y in range(h):
        starts[y], first, last = hidden, columns[y, 0], columns[y, 1]
        row, who, looked[0], after = face[y], winner[y], 1, looked[1:]
        here, unseen = row[1:], who[1:]
        for x in range(w - 1):  # the first pixels of faces, too, to learn the objects' rows
            after[x] = np.uint8((here[x] >= 0) & ((unseen[x] < 0) | (here[x] != row[x])))
        for left in range(first, last, _BLOCK_PX):
            block, some = looked[left : min(left + _BLOCK_PX, last)], np.uint8(0)
            for k in range(len(block)):
                some |= block[k]
            for x in range(left, left + len(block) if some else left):
                if not looked[x] or row[x] < 0:
                    continue
                number = row[x]
                thing = part[number] // PARTS
                above[thing], below[thing] = min(above[thing], y), y + 1
                if who[x] >= 0:
                    continue
                table[0, hidden], table[1, hidden] = y * w + x, part[number]
                hidden += 1
                cabin, under = part[number] - TOP_PART, face[min(y + 1, h - 1), x]
                if cabin % PARTS or under < 0 or part[under] != cabin:
                    continue  # no top, or no cabin of the same object below it
                for yy in range(y + 1, min(y + 1 + RIM_PX, h)):
                    if face[yy, x] != under or winner[yy, x] < 0:
                        break
                    table[2, sampled], table[3, sampled] = yy * w + x, cabin + RIM_PART
                    sampled += 1
        if y % step or min(y, h - 1 - y) < margin:
            continue
        for x in range(-(-max(first, margin) // step) * step, min(last, w - margin), step):
            number = row[x]
            if number >= 0 and who[x] >= 0 and face[y - margin, x] == number and face[y + margin, x] == number:
                if row[x - margin] == number and row[x + margin] == number:
                    table[2, sampled], table[3, sampled] = y * w + x, part[number]
                    is_known[part[number] // PARTS] = True
                    sampled += 1
    starts[h], top, bottom = hidden, h, 0
    for k in range(objects):
        if not is_known[k]:
            top, bottom = min(top, above[k]), max(bottom, below[k])
    for y in range(top, bottom):
        for x in range(columns[y, 0], columns[y, 1]):
            number = face[y, x]
            if number >= 0 and not is_known[part[number] // PARTS] and winner[y, x] >= 0:
                table[2, sampled], table[3, sampled] = y * w + x, part[number]
                sampled += 1
    return hidden, sampled


@compiled
def nearest_seen(face: Any, part: Any, winner: Any, pixel: Any, starts: Any, nearest: Any) -> None:
    """Find the seen pixels next to unseen ones in their row and column, across unseen ones of the same body or cabin.

    ``pixel`` (n,) are the unseen pixels, ascending, ``starts`` of ``list_parts``; ``nearest`` (4, n) are written: seen
    pixels to the left, above, to the right, below; -1 for none. Others as in ``find_paint``.
    """
    (h, w), above = face.shape, np.empty(face.shape[1], np.int32)  # last unseen pixel of each column
    body, faces, who = np.empty(len(part), np.int32), face.reshape(-1), winner.reshape(-1)
    for number in range(len(part)):
        body[number] = 2 * (part[number] // PARTS) + (part[number] % PARTS > 0)
    for side in range(2):
        towards, across, along = 2 * side - 1, nearest[2 * side], nearest[2 * side + 1]
        for row in range(h):
            y = h - 1 - row if side else row
            for n in range(starts[y], starts[y + 1]):
                k = starts[y] + starts[y + 1] - 1 - n if side else n
                at = pixel[k]
                x, number = at - y * w, body[faces[at]]
                across[k] = along[k] = -1
                near = at + towards
                if 0 <= x + towards < w and faces[near] >= 0 and body[faces[near]] == number:
                    across[k] = near if who[near] >= 0 else across[k + towards]
                near = at + towards * w
                if 0 <= y + towards < h and faces[near] >= 0 and body[faces[near]] == number:
                    along[k] = near if who[near] >= 0 else along[above[x]]
                above[x] = k


@called
def _select(values: Any, n: int, share: float) -> Any:
    """A quantile of the first n values, not interpolated."""
    return np.partition(values[:n], int(share * n))[int(share * n)]


@called
def _quantile(samples: Any, first: int, end: int, share: float, bright: float, values: Any, colour: Any) -> bool:
    """Write a quantile of each channel of some samples (3, n), or of the brightest ones; False for too few of them.

    ``bright`` is the quantile of their largest channels from which on they count; ``values`` (n,) is scratch.
    """
    if end == first:
        return False
    one, two, three, least = samples[0], samples[1], samples[2], _ZERO
    if bright > 0:  # saturated paint has little luminance
        for k in range(first, end):
            values[k - first] = max(one[k], two[k], three[k])
        least = _select(values, end - first, bright)
    for c in range(3):
        n, channel = 0, samples[c]
        for k in range(first, end):
            if bright <= 0 or max(one[k], two[k], three[k]) >= least:
                values[n] = channel[k]
                n += 1
        colour[c] = _select(values, n, share)
    return end - first >= _LEAST_SAMPLES


@borrowing
def _is_of_rim(windows: Any, body: Any, rim: Any) -> bool:
    """Whether a top has its rim's paint, which is neither the body, nor the windows, nor a mixture of both."""
    along = across = apart = 0.0
    for c in range(3):
        along += (rim[c] - windows[c]) * (body[c] - windows[c])
        across += (body[c] - windows[c]) ** 2
    share = min(max(along / max(across, 1e-9), 0.0), 1.0)
    for c in range(3):
        apart += (rim[c] - windows[c] - share * (body[c] - windows[c])) ** 2
    return apart > across / 4


@borrowing
def _same_hue(paint: Any, top: Any) -> bool:
    """Whether a top (3,), shares of white, has the hue of its paint, however pale by reflected sky."""
    white = np.float64(1 / 50)
    one, two = paint[0] + paint[1] + paint[2] + 3 * white, top[0] + top[1] + top[2] + 3 * white
    along = across = apart = 0.0
    for c in range(3):
        along += ((paint[c] + white) / one - 1 / 3) * ((top[c] + white) / two - 1 / 3)
        across += ((paint[c] + white) / one - 1 / 3) ** 2
    kept = min(max(along / max(across, 1e-9), 0.0), 1.0)
    for c in range(3):
        apart += abs((top[c] + white) / two - 1 / 3 - kept * ((paint[c] + white) / one - 1 / 3))
    return apart < _SAME_HUE


@compiled
def colour_objects(sample: Any, part: Any, white: float, colours: Any) -> None:
    """Find the colours of objects' parts by what sources see of them.

    Sides take the median of what is seen of the body, or of the cabin. A body of which nothing is seen takes the paint
    around the windows. Tops take their paint in the light that lies on the frame's seen tops, and what is seen of them,
    the more the larger the part that is seen. A top that is darker than its body, and nearer to the brightness of the
    frame's windows by ratio, does not count: it is glass where a shape has a bonnet. The light is a line from bodies to
    seen tops in linear light: its slope is light over that on bodies, and its offset is reflected sky. A black and a
    white top that are as bright as their bodies count as one seen top each.

    ``sample`` (3, n) are colours up to ``white``, ``part`` (n,) what each shows; ``colours`` (P, 3) are written, P a
    multiple of ``PARTS``, -1 where unknown.
    """
    ends = np.zeros(colours.shape[0] + 1, np.int64)
    for k in range(part.shape[0]):
        ends[part[k] + 1] += 1
    for k in range(colours.shape[0]):
        ends[k + 1] += ends[k]
    place, ordered, values = ends.copy(), np.empty(sample.shape, np.float32), np.empty(part.shape[0], np.float32)
    for k in range(part.shape[0]):
        for c in range(3):
            ordered[c, place[part[k]]] = sample[c, k]
        place[part[k]] += 1
    objects = colours.shape[0] // PARTS
    tops, sure = np.empty((objects, 3, 3)), np.empty(objects)  # paint, body and seen top of each, linear
    weight, x_sum, y_sum, xx, xy = 2.0, 1.0, 1.0, 1.0, 1.0  # of a black and a white top
    panes, is_glazed = np.empty((objects, 3)), np.empty(objects, np.bool_)
    body, rim, top = np.empty(3), np.empty(3), np.empty(3)
    shades, known = np.empty(objects, np.float32), 0
    for n in range(objects):
        first = PARTS * n
        is_glazed[n] = _quantile(ordered, ends[first], ends[first + 1], _MEDIAN, 0, values, panes[n])
        if is_glazed[n]:
            shades[known] = panes[n].sum()
            known += 1
    glass = np.float64(_select(shades, known, _MEDIAN)) if known else 0.0
    for n in range(objects):
        first, seen = PARTS * n, ends[PARTS * n + RIM_PART] - ends[PARTS * n + TOP_PART]
        windows, has_windows = panes[n], is_glazed[n]
        has_body = _quantile(ordered, ends[first + 1], ends[first + TOP_PART], _MEDIAN, 0, values, body)
        _quantile(ordered, ends[first + TOP_PART], ends[first + RIM_PART], _TOP_SHARE, 0, values, top)
        has_rim = _quantile(ordered, ends[first + RIM_PART], ends[first + PARTS], _RIM_SHARE, 0, values, rim)
        has_rim = has_rim and (not has_body or (has_windows and _is_of_rim(windows, body, rim)))
        if has_windows and not has_body:
            has_body = _quantile(ordered, ends[first], ends[first + 1], _MEDIAN, _PAINT_SHARE, values, body)
        if has_body and top.sum() < body.sum() and top.sum() ** 2 < glass * body.sum():
            seen = 0  # glass
        sure[n] = seen / (seen + _SURE_SAMPLES) if seen or has_rim or has_body else -1
        for c in range(3):
            for k in range(TOP_PART):
                colours[first + k, c] = (windows[c] if has_windows and not k else body[c]) if has_body else -1
            paint = rim[c] if has_rim else body[c] if has_body else top[c]
            tops[n, 0, c] = paint / white
            tops[n, 1, c] = (body[c] if has_body else paint) / white
            tops[n, 2, c] = (top[c] if seen else paint) / white
            colours[first + TOP_PART, c] = colours[first + RIM_PART, c] = -1
        if sure[n] < 0:
            continue
        of_body, of_paint = _same_hue(tops[n, 1], tops[n, 2]), _same_hue(tops[n, 0], tops[n, 2])
        for c in range(3):
            for k in range(3):
                tops[n, k, c] = tops[n, k, c] ** _GAMMA
            x, y, share = tops[n, 1, c], tops[n, 2, c], sure[n] if of_body else 0.0
            weight += share
            x_sum += share * x
            y_sum += share * y
            xx += share * x * x
            xy += share * x * y
        sure[n] *= of_paint
    slope = (weight * xy - x_sum * y_sum) / (weight * xx - x_sum * x_sum)
    offset = (y_sum - slope * x_sum) / weight
    for n in range(objects):
        for c in range(3 if sure[n] >= 0 else 0):
            light = max(slope, 0.0) * tops[n, 0, c] + offset
            light += sure[n] * (tops[n, 2, c] - light)
            colours[PARTS * n + TOP_PART, c] = white * min(max(light, 0.0), 1.0) ** (1 / _GAMMA)


@compiled
def paint(pixel: Any, part: Any, nearest: Any, table: Any, seen: Any, reach: float, rounding: float, view: Any) -> None:
    """Paint the unseen pixels of objects in a view (3, h w); without a colour of their part, not at all.

    They mix the colour of their part in ``table`` (P, 3), whose first channel is negative where unknown, with the
    nearest seen pixels of the same body or cabin, which weigh as much at a distance of ``reach`` pixels. ``pixel``,
    ``part`` and ``nearest`` as in ``plan.Paint``; ``rounding`` is added to what is written.
    """
    w = seen.shape[1]
    mixed = np.empty(3, np.float32)
    for k in range(pixel.shape[0]):
        at = pixel[k]
        if seen[at // w, at % w] or part[k] >= table.shape[0] or table[part[k], 0] < _ZERO:
            continue  # nothing of it is seen: another object's pixels would make it a ghost
        total = _ONE
        for c in range(3):
            mixed[c] = table[part[k], c]
        for way in range(4):
            source = nearest[way, k]
            if source >= 0:
                weight = np.float32(reach) / np.float32(abs(source // w - at // w) + abs(source % w - at % w))
                total += weight
                for c in range(3):
                    mixed[c] += weight * np.float32(view[c, source])
        for c in range(3):
            view[c, at] = mixed[c] / total + np.float32(rounding)


def warm_up() -> None:
    """Compile the kernels of colours, or load them from numba's cache."""
    pixel, colours = np.zeros(1, np.int32), np.ones((1, 3), np.float32)
    colour_objects(colours.T.copy(), pixel, 1.0, np.empty((PARTS, 3), np.float32))
    for view in (np.zeros((3, 4), np.uint8), np.zeros((3, 4), np.float32)):
        paint(pixel, pixel, np.zeros((4, 1), np.int32), colours, np.zeros((2, 2), bool), 1.0, 0.5, view)
