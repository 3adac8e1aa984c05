"""Sound values and files with something wrong in them, drawn by hypothesis; and what a call may do with them."""

from __future__ import annotations

import copy
import json
import operator
import warnings
from collections.abc import Callable, Iterator
from functools import reduce
from typing import Any

import numpy as np
from hypothesis import strategies as st

from arbiview_aug.errors import ArbiviewError
from tests.helpers import HangError, limited

HANG_S = 10.0
"""CPU seconds for a call: the slowest takes about one."""

NUMBERS = (float("nan"), float("inf"), -1e308, 1e300, 1e30, -1.0, 0.0, 1e-30, 5e-324, 1e5, 0.5)
"""In place of a number."""

_RAW = {"digits": "7" * 5000, "deep": "[" * 3000 + "]" * 3000, "circle": "&a [*a]", "mappings": '{"a":' * 3000 + "}"}
"""By word: texts that no writer of JSON writes. They replace the word in the file."""

_LETTERS = st.sampled_from([bytes([letter]) for letter in b'{}[]",:0e9-\x00\xff&*!%'])


def nested(depth: int, *inmost: Any) -> list[Any]:
    """Lists within lists."""
    value: list[Any] = [*inmost]
    for _ in range(depth):
        value = [value]
    return value


TEXT_JUNK = (
    *(None, "x", "", True, False, 0, -1, 1.5, 10**400, float("nan"), float("inf"), -1e308, 1e-320, 2**63, "7"),
    *([], {}, ["x"], [None], [[1.0], [2.0, 3.0]], {"name": "x", "file": {}}, "a\0b", "\ud800", "x" * 5000),
    *("../x", "/dev/zero", nested(200), *_RAW),
)
"""JSON values that no key expects."""

TEXTS = ("", "{}", "null", "3", '"x"', "[", "[]", "[null]", "[[]]", "[{}]", "[3]", "\ufeff[]", "[" * 5000, "[{}] x")
"""In place of a file of JSON."""


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Keys and indices that lead to each part of nested dicts and lists, eight deep at most: there may be circles."""
    if len(path) == 8:
        return
    parts = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, part in parts:
        yield (*path, key)
        yield from places(part, (*path, key))


@st.composite
def mutated(
    draw: st.DrawFn,
    value: Any,
    junk: st.SearchStrategy[Any],
    change: Callable[[Any], st.SearchStrategy[Any]] | None = None,
) -> Any:
    """A copy with one part dropped, repeated, changed, or replaced by junk.

    Args:
        value: Nested dicts and lists.
        junk: Values that may stand anywhere.
        change: Changes of a part that is neither number, dict nor list; None for junk alone.
    """
    value = copy.deepcopy(value)
    paths = list(places(value))
    if not paths:
        return draw(junk)
    *above, key = draw(st.sampled_from(paths))
    parent = reduce(operator.getitem, above, value)
    part = parent[key]
    way = draw(st.sampled_from(["drop", "repeat", "junk", "junk", "change", "change", "change"]))
    if way == "drop":
        del parent[key]
    elif way == "repeat" and isinstance(parent, list):
        parent.insert(key, copy.copy(part))
    elif way == "repeat":
        parent[draw(st.sampled_from(["x", 1, None, ("a", 2)]))] = part
    elif way == "change" and type(part) in (int, float) and abs(part) < 1e300:
        parent[key] = draw(st.sampled_from([*NUMBERS, -part, part * 1000, part + 1e-7]))
    elif way == "change" and change is not None and not isinstance(part, dict | list):
        parent[key] = draw(change(part))
    else:
        parent[key] = draw(junk)
    return value


@st.composite
def mutated_bytes(draw: st.DrawFn, sound: bytes) -> bytes:
    """A file with up to five places where bytes are others, more or fewer, or cut off; its head more often."""
    text = bytearray(sound)
    for _ in range(draw(st.integers(1, 5))):
        at = draw(st.integers(0, min(300, len(text))) | st.integers(0, len(text)))
        text[at : at + draw(st.sampled_from([0, 1, 1, 9]))] = draw(_LETTERS | st.binary(max_size=1))
    return bytes(text[: draw(st.just(len(text)) | st.integers(0, len(text)))])


def written(data: Any) -> bytes:
    """A file of JSON with the raw texts where their words stand."""
    text = json.dumps(data, skipkeys=True)
    for word, raw in _RAW.items():
        text = text.replace(f'"{word}"', raw)
    return text.encode()


@st.composite
def mutated_json(draw: st.DrawFn, data: Any) -> bytes:
    """A file of JSON with one or two values wrong, or its text."""
    way = draw(st.sampled_from(["values"] * 7 + ["bytes"] * 2 + ["text"]))
    if way == "bytes":
        return draw(mutated_bytes(written(data)))
    if way == "text":
        return draw(st.sampled_from(TEXTS)).encode()
    for _ in range(draw(st.sampled_from([1, 1, 2]))):
        data = draw(mutated(data, st.sampled_from(TEXT_JUNK)))
    return written(data)


def works(call: Callable[[], object], refusals: tuple[type[Exception], ...] = (ArbiviewError,)) -> bool:
    """Whether a call works; it may also refuse with a message. Another exception or a hang fails the test."""
    try:
        with limited(HANG_S), warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            call()
    except refusals as error:
        assert str(error), "no message"
        return False
    except HangError:
        raise AssertionError(f"over {HANG_S} s of CPU") from None
    return True
