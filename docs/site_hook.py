"""MkDocs hook: add the Markdown pages that live beside code, and make links between files links between pages."""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
BESIDE_CODE = (
    "README.md",
    "CHANGELOG.md",
    "integrations/*/*.md",
    "integrations/*/results/*.png",
    "arbiview_aug/generator/weights/*.md",
)
"""Files outside ``docs`` that are pages or pictures of the site."""

_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")


def on_files(files: Files, *, config: Any) -> Files:
    """Add the files beside code; the README is the home page."""
    for path in sorted(path for pattern in BESIDE_CODE for path in ROOT.glob(pattern)):
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, "index.md" if name == "README.md" else name, abs_src_path=str(path)))
    return files


def on_page_markdown(markdown: str, *, page: Any, config: Any, files: Files) -> str:
    """Point relative links at the site's pages; a link to a file that is no page becomes its text."""
    pages = {Path(file.abs_src_path).resolve(): file.src_uri for file in files if file.abs_src_path}
    folder = Path(page.file.abs_src_path).parent

    def linked(match: re.Match[str]) -> str:
        mark, text, target, anchor = match.groups()
        path = (folder / target).resolve()
        if path in pages:
            uri = posixpath.relpath(pages[path], posixpath.dirname(page.file.src_uri) or ".")
            return f"{mark}[{text}]({uri}{anchor or ''})"
        return text if "://" not in target and path.exists() else match.group()

    return _LINK.sub(linked, markdown)
