"""Values that are kept from call to call: the least recently used go first."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class LRUCache(Generic[K, V]):
    """Values by key, the least recently used dropped once they are too many together; the last one always stays.

    Threads may share it: two that miss the same value at once both make it, so that none waits for another's, and all
    get the first.

    Args:
        limit: What the held values may have together.
        size: What one value has: bytes, or 1 to count them.

    Attributes:
        hits: How many values were held when they were asked for.
        misses: How many were not.
    """

    def __init__(self, limit: int, size: Callable[[V], int]) -> None:
        self.limit, self.hits, self.misses = limit, 0, 0
        self._size = size
        self._values: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: K, make: Callable[[], V]) -> V:
        """The value of this key, made if it is not held."""
        with self._lock:
            if key in self._values:
                self.hits += 1
                self._values.move_to_end(key)
                return self._values[key]
            self.misses += 1
        made = make()
        with self._lock:
            value = self._values.setdefault(key, made)
            held = sum(map(self._size, self._values.values()))
            while held > self.limit and len(self._values) > 1:
                held -= self._size(self._values.popitem(last=False)[1])
        return value

    @property
    def size(self) -> int:
        """What the held values have together."""
        with self._lock:
            return sum(map(self._size, self._values.values()))

    def __len__(self) -> int:
        return len(self._values)
