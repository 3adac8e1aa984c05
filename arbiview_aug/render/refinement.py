"""Refinements to reuse between frames: depth from overlap, held by calibration and by what a sample calls its scene."""

from __future__ import annotations

from arbiview_aug.lru_cache import LRUCache
from arbiview_aug.render.overlap_depth import OverlapDepth


class RefinementCache(LRUCache[tuple[bytes, object], OverlapDepth]):
    """Refinements to reuse: within a scene that stands still, or when the same samples come again in the next epoch.

    Frames with the same calibration and the same ``sample[key]`` share the refinement of the first of them. The least
    recently used are dropped once ``max_bytes`` are held. Pickles, and copies, as empty: each DataLoader worker fills
    its own.

    Args:
        key: Entry of the samples that names what may share, a scene's or a sample's token; None: all frames of one
            calibration share, which is right for a vehicle at rest only.
        max_bytes: Memory for refinements, about 4 MB each for six cameras.
    """

    def __init__(self, key: str | None = None, max_bytes: int = 128 * 2**20) -> None:
        super().__init__(max_bytes, lambda depth: depth.nbytes)
        self.key, self.max_bytes = key, max_bytes

    def __repr__(self) -> str:
        return f"RefinementCache(key={self.key!r})"

    def __reduce__(self) -> tuple[type[RefinementCache], tuple[str | None, int]]:
        return RefinementCache, (self.key, self.max_bytes)
