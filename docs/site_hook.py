"""MkDocs hook: add the Markdown pages that live beside code, run notebooks, and make links between files links between
pages."""

from __future__ import annotations

import posixpath
import re
from base64 import b64decode
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import jupytext
from mkdocs.structure.files import File, Files
from nbclient import NotebookClient

ROOT = Path(__file__).parents[1]
BESIDE_CODE = (
    "README.md",
    "CHANGELOG.md",
    "integrations/*/*.md",
)
"""Files outside ``docs`` that are pages or pictures of the site."""

_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")


def on_files(files: Files, *, config: Any) -> Files:
    """Add the files beside code, of which the README is the home page, and the notebooks with their pictures."""
    for path in sorted(path for pattern in BESIDE_CODE for path in ROOT.glob(pattern)):
        name = path.relative_to(ROOT).as_posix()
        files.append(File.generated(config, "index.md" if name == "README.md" else name, abs_src_path=str(path)))
    for path in sorted(ROOT.glob("docs/notebooks/*.py")):
        markdown, pictures = run_notebook(path, path.read_text())
        page = File.generated(config, f"notebooks/{path.stem}.md", content=markdown)
        page.abs_src_path = str(path)  # links to the notebook are links to its page
        files.append(page)
        for name, png in pictures.items():
            files.append(File.generated(config, f"notebooks/{name}", content=png))
    return files


@cache  # while mkdocs serve builds again and again
def run_notebook(path: Path, text: str) -> tuple[str, dict[str, bytes]]:
    """Run a notebook in jupytext's percent format; its Markdown with what cells put out, and its pictures by name."""
    notebook = jupytext.reads(text, "py:percent")
    with TemporaryDirectory() as folder:
        NotebookClient(notebook, coalesce_streams=True, resources={"metadata": {"path": folder}}).execute()
    parts, pictures = [], dict[str, bytes]()
    for cell in notebook.cells:
        parts.append(cell.source if cell.cell_type == "markdown" else f"```python\n{cell.source}\n```")
        for output in cell.get("outputs", ()):
            data = output.get("data", {})
            if "image/png" in data:
                name = f"{path.stem}-{len(pictures)}.png"
                pictures[name] = b64decode(data["image/png"])
                parts.append(f"![What the cell shows]({name})")
            elif output.get("name") != "stderr":
                parts.append(f"```text\n{data.get('text/plain') or output.text}\n```")
    return "\n\n".join(parts), pictures


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
