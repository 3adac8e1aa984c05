"""The code of the integrations' READMEs, for tests that run it."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path


def snippets(folder: str, replaced: Mapping[str, str] | None = None) -> list[str]:
    """The Python blocks of an integration's README.

    Args:
        folder: Folder of the integration.
        replaced: New text by the text that stands there: paths, mostly.

    Raises:
        ValueError: A text to replace does not stand there.
    """
    text = (Path(__file__).parent / folder / "README.md").read_text()
    for old, new in (replaced or {}).items():
        if old not in text:
            raise ValueError(f"{folder}/README.md: expected {old!r} in it")
        text = text.replace(old, new)
    return re.findall(r"```python\n(.*?)```", text, re.DOTALL)
