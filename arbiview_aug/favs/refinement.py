"""Refinements to reuse between frames: depth from overlap, held by calibration and by what a sample calls its scene."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable

from arbiview_aug.favs.overlap_depth import OverlapDepth


class RefinementCache:
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
        self.key, self.max_bytes = key, max_bytes
        self.hits = self.misses = 0
        self._held: OrderedDict[tuple[bytes, object], OverlapDepth] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, name: tuple[bytes, object], compute: Callable[[], OverlapDepth]) -> OverlapDepth:
        """The refinement of a calibration's content key and the sample's own, computed if it is not held."""
        with self._lock:
            if name in self._held:
                self.hits += 1
                self._held.move_to_end(name)
                return self._held[name]
            self.misses += 1
        found = compute()
        with self._lock:
            found = self._held.setdefault(name, found)  # another thread's came first: all share the first
            held = sum(depth.nbytes for depth in self._held.values())
            while held > self.max_bytes and len(self._held) > 1:
                held -= self._held.popitem(last=False)[1].nbytes
        return found

    def __repr__(self) -> str:
        return f"RefinementCache(key={self.key!r})"

    def __reduce__(self) -> tuple[type[RefinementCache], tuple[str | None, int]]:
        return RefinementCache, (self.key, self.max_bytes)
