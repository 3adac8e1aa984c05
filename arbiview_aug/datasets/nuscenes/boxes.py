"""nuScenes' 3D boxes: as annotated at keyframes, interpolated between them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress
from typing import Any

import numpy as np
import numpy.typing as npt

from arbiview_aug.cameras.lens import FloatArray
from arbiview_aug.cameras.rotations import poses_from
from arbiview_aug.datasets.nuscenes.tables import TEXTS, TOKENS, Row, Tables, Tokens
from arbiview_aug.errors import warn

MAX_STEP_S = 1.5  # between annotations for a velocity; doubled for central differences (``NuScenes.box_velocity``)

IntArray = npt.NDArray[np.int32]
SingleArray = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Annotations:
    """All B boxes of S samples, grouped by sample: those of sample k are rows first[k] to first[k + 1]."""

    first: npt.NDArray[np.int64]  # (S + 1,) first row of each sample, and the end
    tokens: npt.NDArray[np.bytes_]  # (B,) tokens of the annotations
    categories: list[str]  # names of the categories
    category: IntArray  # (B,) index into ``categories``
    centers_m: FloatArray  # (B, 3) world frame
    sizes_m: SingleArray  # (B, 3) length, width, height
    headings: SingleArray  # (B, 3) unit vectors along the lengths, world frame
    velocities_mps: SingleArray  # (B, 3) world frame, NaN where unknown
    sample: IntArray  # (B,) index of the sample
    later: IntArray  # (B,) the same object's next annotation, -1 for none
    earlier: IntArray  # (B,) its previous annotation, -1 for none
    times_s: FloatArray  # (S,) times of the samples
    scenes: npt.NDArray[np.int64]  # (S,) numbers of their scenes
    order: npt.NDArray[np.int64]  # (S,) samples sorted by scene and time

    def rows(self, sample: int) -> npt.NDArray[np.int64]:
        """The boxes (n,) of a keyframe."""
        return np.arange(self.first[sample], self.first[sample + 1])

    def at_sample(self, sample: int, global2ego: FloatArray) -> SingleArray:
        """(n, 9) boxes of a keyframe in the ego frame: centre, length, width, height (m), yaw (radians), velocity x y
        (m/s, NaN where unknown)."""
        rows = self.rows(sample)
        return self._in_ego_frame(rows, self.centers_m[rows], self.headings[rows], global2ego)

    def at_time(self, scene: int, time_s: float, global2ego: FloatArray) -> SingleArray:
        """(n, 9) boxes of a scene at any time, as ``at_sample``.

        Objects in the keyframes before and after are interpolated linearly. Objects in one of them move with their
        velocity, or stand still if it is unknown.
        """
        samples = self.order[slice(*np.searchsorted(self.scenes[self.order], [scene, scene + 1]))]
        at = int(np.searchsorted(self.times_s[samples], time_s))
        before = np.concatenate([np.empty(0, np.int64), *map(self.rows, samples[max(at - 1, 0) : at])])
        after = np.concatenate([np.empty(0, np.int64), *map(self.rows, samples[at : at + 1])])
        in_both = np.isin(self.later[before], after)
        start, end = before[in_both], self.later[before[in_both]]
        single = np.concatenate([before[~in_both], after[~np.isin(self.earlier[after], before)]])
        start_s, end_s = self.times_s[self.sample[start]], self.times_s[self.sample[end]]
        share = ((time_s - start_s) / (end_s - start_s))[:, None]
        # A label's heading may flip between keyframes; the box is the same.
        flip = np.sign((self.headings[start] * self.headings[end]).sum(axis=1, keepdims=True))
        offset_m = np.nan_to_num(self.velocities_mps[single]) * (time_s - self.times_s[self.sample[single]])[:, None]
        between_m = (1 - share) * self.centers_m[start] + share * self.centers_m[end]
        between = (1 - share) * self.headings[start] + share * flip * self.headings[end]
        centers_m = np.concatenate([between_m, self.centers_m[single] + offset_m])
        headings = np.concatenate([between, self.headings[single]])
        return self._in_ego_frame(np.concatenate([start, single]), centers_m, headings, global2ego)

    def _in_ego_frame(
        self, rows: npt.NDArray[np.int64], centers_m: FloatArray, headings: npt.NDArray[Any], global2ego: FloatArray
    ) -> SingleArray:
        R = global2ego[:3, :3]
        heading, velocity = headings @ R.T, self.velocities_mps[rows] @ R.T
        center, yaw = centers_m @ R.T + global2ego[:3, 3], np.arctan2(heading[:, 1], heading[:, 0])
        return np.column_stack([center, self.sizes_m[rows], yaw, velocity[:, :2]]).astype(np.float32)


def read_annotations(
    tables: Tables, samples: Mapping[str, int], times_s: FloatArray, scenes: npt.NDArray[np.int64]
) -> Annotations:
    """Read the annotations of the samples (number by token), which have times (S,) and numbers of scenes (S,).

    DataError for a malformed row, or a dangling token.
    """
    categories = tables.by_token("category")
    names = sorted({*tables.column("category", [*categories.values()], "name", TEXTS)})
    instances = tables.by_token("instance")
    kinds = tables.follow("instance", [*instances.values()], "category_token", "category", categories)
    objects = {token: (k, names.index(kinds[k]["name"])) for k, token in enumerate(instances)}
    table, none = "sample_annotation", np.empty((0, 3), np.float32)
    unique = Tokens(tables, table)
    empty = np.empty(0, np.int32), np.empty((0, 2), np.int32), np.empty(0, np.bytes_)
    annotations: list[tuple[Any, ...]] = [(*empty, none.astype(np.float64), none, none)]
    left_out: list[Any] = []
    for batch in tables.batches(table):
        of_samples = tables.column(table, batch, "sample_token", TOKENS)
        rows = [row for row, token in zip(batch, of_samples, strict=True) if token in samples]
        is_whole = _are_whole(rows)
        left_out += (row.get("token") for row in compress(rows, ~is_whole))
        rows = [*compress(rows, is_whole)]
        sizes_m = tables.numbers(table, rows, "size", (3,))
        numbered = tables.follow(table, rows, "instance_token", "instance", objects)
        numbers = np.array([samples[row["sample_token"]] for row in rows], np.int32)
        tokens = np.array([token.encode() for token in unique.add(rows)], np.bytes_)
        poses = poses_from(tables.poses(table, rows))
        sizes, headings = sizes_m[:, [1, 0, 2]].astype(np.float32), poses[:, :3, 0].astype(np.float32)
        pairs = np.array(numbered, np.int32).reshape(-1, 2)
        annotations.append((numbers, pairs, tokens, poses[:, :3, 3], sizes, headings))
    if left_out:
        count = f"{len(left_out)} boxes, row {left_out[0]!r} first,"
        warn(f"nuScenes {tables.root}: {table}: {count} have no size above 0, or a number that is not finite: left out")
    unique.check()
    columns = [np.concatenate([batch[k] for batch in annotations]) for k in range(len(annotations[0]))]
    order = np.argsort(columns[0], kind="stable")
    sample, instance_and_category, tokens, centers_m, sizes, headings = (column[order] for column in columns)
    # Each object's previous and next annotation, and its velocity between them where they are close enough in time.
    instance, time_s, itself = instance_and_category[:, 0], times_s[sample], np.arange(len(sample))
    earlier, later = (np.full(len(sample), -1, np.int32) for _ in range(2))
    in_time = np.lexsort((time_s, scenes[sample], instance))
    one, two = in_time[:-1], in_time[1:]
    same = (instance[one] == instance[two]) & (scenes[sample[one]] == scenes[sample[two]])
    earlier[two[same]], later[one[same]] = one[same], two[same]
    start, end = (np.where(others < 0, itself, others) for others in (earlier, later))
    seconds = time_s[end] - time_s[start]
    longest_s = np.where((earlier >= 0) & (later >= 0), 2 * MAX_STEP_S, MAX_STEP_S)
    known = (seconds > 0) & (seconds <= longest_s)
    velocities = np.full(centers_m.shape, np.nan, np.float32)
    velocities[known] = (centers_m[end] - centers_m[start])[known] / seconds[known, None]
    return Annotations(
        first=np.searchsorted(sample, np.arange(len(samples) + 1)),
        tokens=tokens,
        categories=names,
        category=instance_and_category[:, 1],
        centers_m=centers_m,
        sizes_m=sizes,
        headings=headings,
        velocities_mps=velocities,
        sample=sample,
        later=later,
        earlier=earlier,
        times_s=times_s,
        scenes=scenes,
        order=np.lexsort((times_s, scenes)),
    )


def _are_whole(rows: Sequence[Row]) -> npt.NDArray[np.bool_]:
    """(B,) whether a box has finite numbers and sizes above 0; True for other mistakes, which are named later."""
    try:
        numbers = np.array([[*row["size"], *row["translation"], *row["rotation"]] for row in rows], np.float64)
        return np.asarray(np.isfinite(numbers).all(axis=1) & (numbers[:, :3] > 0).all(axis=1))
    except (KeyError, TypeError, ValueError, OverflowError, IndexError):
        return np.ones(len(rows), bool)
