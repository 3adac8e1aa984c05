"""Safe loading of untrusted YAML and JSON: plain data of bounded size, with YAML 1.2's numbers."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path
from typing import Any

import yaml

from arbiview_aug.errors import CalibrationError, described, one_line
from arbiview_aug.files import read_text

MOST_BYTES = 1 << 20
"""Largest calibration file: 8 KiB per camera. Checked before parsing, as YAML takes seconds per megabyte."""

_MOST_VALUES = 200_000


_FLOAT = (
    "tag:yaml.org,2002:float",
    re.compile(r"^(?:[-+]?(?:[0-9]+\.[0-9]*|\.?[0-9]+)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf)|\.(?:nan|NaN))$"),
    list("-+.0123456789"),
)


class _Loader(yaml.SafeLoader):
    """Loader of YAML 1.2's numbers and booleans: ``yes`` and ``1:30`` are text."""


class _Dumper(yaml.SafeDumper):
    """Dumper that quotes text which the loader would read as a number, for example ``08`` and ``12e3``."""


_Loader.yaml_implicit_resolvers = {"<": yaml.SafeLoader.yaml_implicit_resolvers["<"]}
_Loader.add_implicit_resolver("tag:yaml.org,2002:null", re.compile(r"^(?:~|null|Null|NULL|)$"), ["~", "n", "N", ""])
_Loader.add_implicit_resolver("tag:yaml.org,2002:bool", re.compile(r"^(?:true|True|false|False)$"), list("tTfF"))
_Loader.add_implicit_resolver("tag:yaml.org,2002:int", re.compile(r"^[-+]?(?:0|[1-9][0-9]*)$"), list("-+0123456789"))
_Loader.add_implicit_resolver(*_FLOAT)
_Dumper.add_implicit_resolver(*_FLOAT)


def read_plain(path: Path, where: str, most_bytes: int = MOST_BYTES) -> Any:
    """Plain data of a YAML or JSON file; CalibrationError, which begins with ``where``, if it is large or broken."""
    documents = read_documents(path, where, most_bytes)
    if len(documents) != 1:
        raise CalibrationError(f"{where}: expected plain YAML or JSON, one document, got {len(documents)}")
    return documents[0]


def read_documents(path: Path, where: str, most_bytes: int = MOST_BYTES) -> list[Any]:
    """Plain data of each document of a file; OpenCV's first line and tags are removed."""
    text = read_calibration_text(path, where, most_bytes)
    try:
        if path.suffix == ".json":
            return [parse_json(text)]
        text = re.sub(r"\A%YAML.*|!!opencv-(nd-)?matrix", "", text)
        documents = re.split(r"^---\s*$", text, flags=re.MULTILINE)
        return [parse_yaml(document) for document in documents if document.strip()] or [None]
    except (ValueError, yaml.YAMLError, RecursionError) as error:
        raise CalibrationError(f"{where}: expected plain YAML or JSON, got {one_line(error)}") from None


def read_calibration_text(path: Path, where: str, most_bytes: int = MOST_BYTES) -> str:
    """Text of a calibration file; CalibrationError if it cannot be read."""
    try:
        return read_text(path, most_bytes)
    except UnicodeError as error:
        got = f"another encoding ({one_line(error)}): save it as UTF-8"
        raise CalibrationError(f"{where}: expected plain YAML or JSON in UTF-8, got {got}") from None
    except OSError as error:
        raise CalibrationError(f"{where}: expected a file that can be read, got {error.strerror}") from None


def dump_yaml(data: Any) -> str:
    """Plain data as YAML; keys keep their order."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=120)


def parse_json(text: str | bytes) -> Any:
    """Data of a JSON document; ValueError for a repeated key, of which ``json`` would take the last."""
    return json.loads(text, object_pairs_hook=_without_repeats)


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    data = dict(pairs)
    if len(data) < len(pairs):
        key = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise ValueError(f"the key {key[:80]!r} stands twice")
    return data


def parse_yaml(text: str) -> Any:
    """Plain data of a YAML document; YAMLError or ValueError for others, repeated keys, or aliases without bound."""
    loader = _Loader(text)
    try:
        node = loader.get_single_node()
        if node is None:
            return None
        if _size(node, {}) > _MOST_VALUES:
            raise ValueError(f"more than {_MOST_VALUES} values once its aliases are written out")
        return loader.construct_document(node)
    except (AttributeError, LookupError) as error:  # of PyYAML's constructors
        raise ValueError(f"a value that is not what its tag says ({described(error)})") from None
    finally:
        loader.dispose()  # type: ignore[no-untyped-call]


def _size(node: yaml.Node, known: dict[int, int]) -> int:
    """Number of nodes in a tree with its aliases expanded."""
    if not isinstance(node, yaml.CollectionNode):
        return 1
    if id(node) in known:
        if known[id(node)] == 0:
            raise ValueError("an alias within the value that it names")
        return known[id(node)]
    known[id(node)] = 0
    parts = node.value
    if isinstance(node, yaml.MappingNode):
        keys: set[str] = set()
        for key in (key.value for key, _ in parts if isinstance(key, yaml.ScalarNode)):
            if key in keys:
                raise ValueError(f"the key {key[:80]!r} stands twice")
            keys.add(key)
        parts = [part for pair in parts for part in pair]
    known[id(node)] = 1 + sum(_size(part, known) for part in parts)
    return known[id(node)]
