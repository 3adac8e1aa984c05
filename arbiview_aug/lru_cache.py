"""Thread-safe LRU cache bounded by total value size."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable
from typing import Any, Generic, TypeVar

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class LRUCache(Generic[K, V]):
    """Thread-safe LRU cache bounded by total value size, with a count of ``misses``.

    The last value always stays. Threads that miss the same key at once each make the value and all get the first one.
    Pickles as empty. ``size`` of one value is picklable; None counts values. Values may grow: all sizes are read again
    after an eighth as many misses as there are values.
    """

    def __init__(self, limit: int, size: Callable[[V], int] | None = None) -> None:
        self.limit, self.misses, self._size = limit, 0, size or _one
        self._values: OrderedDict[K, V] = OrderedDict()
        self._lock = threading.Lock()
        self._total = self._next_count = 0

    def get(self, key: K, make: Callable[[], V]) -> V:
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
                return self._values[key]
            self.misses += 1
        new = make()
        with self._lock:
            value = self._values.setdefault(key, new)
            if self.misses >= self._next_count:
                self._total = sum(map(self._size, self._values.values()))
                self._next_count = self.misses + len(self._values) // 8
            else:
                self._total += self._size(value)
            while self._total > self.limit and len(self._values) > 1:
                self._total -= self._size(self._values.popitem(last=False)[1])
        return value

    @property
    def size(self) -> int:
        with self._lock:
            return sum(map(self._size, self._values.values()))

    def __len__(self) -> int:
        return len(self._values)

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.limit, self._size)


def _one(_: object) -> int:
    return 1
