"""A cache of depth from overlap, by calibration and by the name of the scene."""

from __future__ import annotations

from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.overlap_depth import OverlapDepth


class RefinementCache(LRUCache[tuple[bytes, object], OverlapDepth]):
    """LRU cache of depth from overlap, for scenes that stand still or samples that come again in the next epoch.

    Frames with the same calibration and the same ``sample[key]`` share the refinement of the first of them. Pickles and
    copies are empty: each DataLoader worker fills its own.

    Args:
        key: Key of the sample's scene or sample token. None shares one refinement among all frames of a calibration,
            which is only right for a vehicle at rest.
        max_bytes: Memory for refinements, about 4 MB each for six cameras.
    """

    def __init__(self, key: str | None = None, max_bytes: int = 128 * 2**20) -> None:
        super().__init__(max_bytes, lambda depth: depth.nbytes)
        self.key, self.max_bytes = key, max_bytes

    def __repr__(self) -> str:
        return f"RefinementCache(key={self.key!r})"

    def __reduce__(self) -> tuple[type[RefinementCache], tuple[str | None, int]]:
        return RefinementCache, (self.key, self.max_bytes)
