"""One ``RigRetarget`` in several threads gives what it gives in one."""

from __future__ import annotations

import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from operator import attrgetter
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from arbiview_aug import PlanCache, RigRetarget
from arbiview_aug.image_ops import Memory
from arbiview_aug.lru_cache import LRUCache
from tests.extremes import misuse


@pytest.fixture(autouse=True)
def switches_often() -> Any:
    """Threads take turns a thousand times as often as they would."""
    before = sys.getswitchinterval()
    sys.setswitchinterval(5e-6)
    yield
    sys.setswitchinterval(before)


def sample(k: int) -> dict[str, Any]:
    """One of several calibrations, so that plans are built, found and dropped."""
    generator = torch.Generator().manual_seed(k)
    images = torch.randint(0, 256, (2, 3, *misuse.SIZE), generator=generator, dtype=torch.uint8)
    return {"images": images, "rig": misuse.rig(spread_deg=30.0 + k % 7), "scene": f"s{k}"}


def test_memory_comes_back_while_its_lock_is_held() -> None:
    """The garbage collector may free an array in the thread that asks for another."""
    memory = Memory()

    def free_within() -> None:
        array = memory.empty((1 << 20,), np.uint8)
        with memory._lock:
            del array

    thread = threading.Thread(target=free_within, daemon=True)
    thread.start()
    thread.join(10)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    "settings",
    [
        {"cache": PlanCache(max_bytes=2**30)},
        {"cache": PlanCache(max_bytes=20_000)},  # plans are dropped all the time
        pytest.param(
            {"match_exposure": True, "quality": "accurate", "cache": PlanCache(share_overlap="scene", max_bytes=1)},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_threads_do_not_disturb_each_other(settings: dict[str, Any]) -> None:
    retarget = RigRetarget(misuse.rig().shifted(z_m=0.2), geometry="street", **settings)
    count = 70 if "quality" not in settings else 20
    fresh = RigRetarget(misuse.rig().shifted(z_m=0.2), geometry="street", **{**settings, "cache": PlanCache()})
    with ThreadPoolExecutor(4) as threads:
        rendered = list(threads.map(lambda k: retarget(sample(k % 35))["images"], range(count)))
    for k, images in enumerate(rendered):
        assert torch.equal(images, fresh(sample(k % 35))["images"])
    assert retarget.plans.hits + retarget.plans.misses == count
    assert retarget.plans.size <= retarget.cache.max_bytes or len(retarget.plans) == 1


def test_a_cache_reads_few_sizes_for_each_value_and_sees_values_grow() -> None:
    reads, grown = [], [0]

    def size(value: int) -> int:
        reads.append(value)
        return 1 + grown[0]

    cache: LRUCache[int, int] = LRUCache(300, size)
    for k in range(1000):
        cache.get(k, lambda k=k: k)
    assert len(cache) == 300 and len(reads) < 20_000
    grown[0] = 2
    for k in range(1000, 1050):
        cache.get(k, lambda k=k: k)
    assert len(cache) == 100


def test_caches_keep_count() -> None:
    cache: LRUCache[bytes, Any] = LRUCache(20, attrgetter("nbytes"))

    def get(k: int) -> int:
        key = bytes([k * k % 7])
        return int(cache.get(key, lambda: SimpleNamespace(nbytes=5, key=key)).key == key)

    with ThreadPoolExecutor(4) as threads:
        assert sum(threads.map(get, range(5000))) == 5000
    assert cache.hits + cache.misses == 5000
