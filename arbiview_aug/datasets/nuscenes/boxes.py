"""nuScenes' 3D boxes: of keyframes as annotated, between them as the objects moved on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.datasets.nuscenes.tables import TEXTS, TOKENS, Tables, Tokens

MAX_STEP_S = 1.5
"""Annotations farther apart give no velocity; over both neighbours in time, twice as much. As in nuscenes-devkit's
``NuScenes.box_velocity``."""

IntArray = npt.NDArray[np.int32]
SingleArray = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Annotations:
    """All boxes, grouped by sample: those of sample k are rows first[k] to first[k + 1].

    Attributes:
        first: (S + 1,).
        tokens: (B,).
        categories: Names.
        category: (B,) of ``categories``.
        centers_m: (B, 3) in the world.
        sizes_m: (B, 3) length, width, height.
        headings: (B, 3) unit vectors along the lengths, in the world.
        velocities_mps: (B, 3) in the world, NaN where nobody knows.
        sample: (B,).
        later: (B,) the same object's next annotation, -1 for none.
        earlier: (B,) its annotation before, -1 for none.
        times_s: (S,) of the samples.
        scenes: (S,) numbers of their scenes.
        order: (S,) samples sorted by scene and time.
    """

    first: npt.NDArray[np.int64]
    tokens: npt.NDArray[np.bytes_]
    categories: list[str]
    category: IntArray
    centers_m: FloatArray
    sizes_m: SingleArray
    headings: SingleArray
    velocities_mps: SingleArray
    sample: IntArray
    later: IntArray
    earlier: IntArray
    times_s: FloatArray
    scenes: npt.NDArray[np.int64]
    order: npt.NDArray[np.int64]

    def rows(self, sample: int) -> npt.NDArray[np.int64]:
        """The boxes (n,) of a keyframe."""
        return np.arange(self.first[sample], self.first[sample + 1])

    def at_sample(self, sample: int, global2ego: FloatArray) -> SingleArray:
        """(n, 9) boxes of a keyframe: centre, length, width, height (m), yaw (radians), velocity x y (m/s), all in the
        ego frame; velocities that nobody knows are NaN."""
        rows = self.rows(sample)
        return self._in_ego_frame(rows, self.centers_m[rows], self.headings[rows], global2ego)

    def at_time(self, scene: int, time_s: float, global2ego: FloatArray) -> SingleArray:
        """(n, 9) where the objects of a scene were at any time, as ``at_sample``.

        What the keyframes before and after both have moved straight from one to the other; what one of them has, by
        its velocity, or not at all where that is not known.
        """
        of_scene = self.order[slice(*np.searchsorted(self.scenes[self.order], [scene, scene + 1]))]
        at = int(np.searchsorted(self.times_s[of_scene], time_s))
        before = np.concatenate([np.empty(0, np.int64), *map(self.rows, of_scene[max(at - 1, 0) : at])])
        after = np.concatenate([np.empty(0, np.int64), *map(self.rows, of_scene[at : at + 1])])
        stays = np.isin(self.later[before], after)
        one, alone = before[stays], np.concatenate([before[~stays], after[~np.isin(self.earlier[after], before)]])
        two = self.later[one]
        start_s, end_s = self.times_s[self.sample[one]], self.times_s[self.sample[two]]
        share = ((time_s - start_s) / (end_s - start_s))[:, None]
        # A label may be turned round from one keyframe to the next: its box is the same.
        turned = np.sign((self.headings[one] * self.headings[two]).sum(axis=1, keepdims=True))
        moved_m = np.nan_to_num(self.velocities_mps[alone]) * (time_s - self.times_s[self.sample[alone]])[:, None]
        between_m = (1 - share) * self.centers_m[one] + share * self.centers_m[two]
        between = (1 - share) * self.headings[one] + share * turned * self.headings[two]
        centers_m = np.concatenate([between_m, self.centers_m[alone] + moved_m])
        headings = np.concatenate([between, self.headings[alone]])
        return self._in_ego_frame(np.concatenate([one, alone]), centers_m, headings, global2ego)

    def _in_ego_frame(
        self,
        rows: npt.NDArray[np.int64],
        centers_m: FloatArray,
        headings: FloatArray | SingleArray,
        global2ego: FloatArray,
    ) -> SingleArray:
        R = global2ego[:3, :3]
        heading = headings @ R.T
        columns: list[npt.NDArray[Any]] = [
            centers_m @ R.T + global2ego[:3, 3],
            self.sizes_m[rows],
            np.arctan2(heading[:, 1], heading[:, 0])[:, None],
            (self.velocities_mps[rows] @ R.T)[:, :2],
        ]
        return np.concatenate(columns, axis=1).astype(np.float32)


def read_annotations(
    tables: Tables, samples: Mapping[str, int], times_s: FloatArray, scenes: npt.NDArray[np.int64]
) -> Annotations:
    """The annotations of some samples.

    Args:
        tables: The data set.
        samples: Number of each sample's token.
        times_s: (S,) of the samples.
        scenes: (S,) numbers of their scenes.

    Raises:
        DataError: Rows that are malformed or lead nowhere.
    """
    categories = tables.by_token("category")
    names = sorted({*tables.column("category", [*categories.values()], "name", TEXTS)})
    number = {name: k for k, name in enumerate(names)}
    instances = tables.by_token("instance")
    kinds = tables.follow("instance", [*instances.values()], "category_token", "category", categories)
    objects = {token: (k, number[kind["name"]]) for k, (token, kind) in enumerate(zip(instances, kinds, strict=True))}
    table = "sample_annotation"
    unique = Tokens(tables, table)
    none = np.empty((0, 3), np.float32)
    found: list[tuple[Any, ...]] = [
        (np.empty(0, np.int32), np.empty((0, 2), np.int32), np.empty(0, np.bytes_), none.astype(np.float64), none, none)
    ]
    for batch in tables.batches(table):
        of_samples = tables.column(table, batch, "sample_token", TOKENS)
        rows = [row for row, token in zip(batch, of_samples, strict=True) if token in samples]
        sizes_m = tables.numbers(table, rows, "size", (3,))
        for k in np.flatnonzero((sizes_m <= 0).any(axis=1))[:1]:
            raise tables.error(table, "sizes above 0", f"{sizes_m[k].tolist()} in row {rows[k].get('token')!r}")
        of = tables.follow(table, rows, "instance_token", "instance", objects)
        found.append(
            (
                np.array([samples[row["sample_token"]] for row in rows], np.int32),
                np.array(of, np.int32).reshape(-1, 2),
                np.array([token.encode() for token in unique.add(rows)], np.bytes_),
                tables.numbers(table, rows, "translation", (3,)),
                sizes_m[:, [1, 0, 2]].astype(np.float32),  # width, length, height in the table
                tables.rotations(table, rows)[:, :, 0].astype(np.float32),
            )
        )
    unique.check()
    columns = [np.concatenate([batch[k] for batch in found]) for k in range(len(found[0]))]
    order = np.argsort(columns[0], kind="stable")
    sample, of_object, tokens, centers_m, sizes, headings = (column[order] for column in columns)
    earlier, later = _in_time(of_object[:, 0], scenes[sample], times_s[sample])
    return Annotations(
        first=np.searchsorted(sample, np.arange(len(samples) + 1)),
        tokens=tokens,
        categories=names,
        category=of_object[:, 1],
        centers_m=centers_m,
        sizes_m=sizes,
        headings=headings,
        velocities_mps=_velocities_mps(centers_m, times_s[sample], earlier, later),
        sample=sample,
        later=later,
        earlier=earlier,
        times_s=times_s,
        scenes=scenes,
        order=np.lexsort((times_s, scenes)),
    )


def _in_time(of_object: IntArray, scene: npt.NDArray[np.int64], time_s: FloatArray) -> tuple[IntArray, IntArray]:
    """(B,) indices of each annotation's ``prev`` and ``next``, the same object before and after; -1 for none."""
    earlier, later = (np.full(len(of_object), -1, np.int32) for _ in range(2))
    order = np.lexsort((time_s, scene, of_object))
    one, two = order[:-1], order[1:]
    same = (of_object[one] == of_object[two]) & (scene[one] == scene[two])
    earlier[two[same]], later[one[same]] = one[same], two[same]
    return earlier, later


def _velocities_mps(centers_m: FloatArray, time_s: FloatArray, earlier: IntArray, later: IntArray) -> SingleArray:
    """(B, 3) in the world, from the annotation before to the one after; NaN where there is neither, or too late."""
    own = np.arange(len(centers_m))
    start, end = np.where(earlier < 0, own, earlier), np.where(later < 0, own, later)
    seconds = time_s[end] - time_s[start]
    longest_s = np.where((earlier >= 0) & (later >= 0), 2 * MAX_STEP_S, MAX_STEP_S)
    known = (seconds > 0) & (seconds <= longest_s)
    velocities = np.full(centers_m.shape, np.nan, np.float32)
    velocities[known] = (centers_m[end] - centers_m[start])[known] / seconds[known, None]
    return velocities
