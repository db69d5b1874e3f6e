"""What mkdocs does for this site: pages that lie outside of docs/, where GitHub wants them,
notebooks, and API pages.
"""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[1]
OUTSIDE = {"benchmarks.md": "benchmarks/README.md", "changelog.md": "CHANGELOG.md"}
"""Page of the site -> file."""


def on_files(files: Files, config: Any) -> Files:
    """Add the pages from outside, and a page for each notebook."""
    for page, file in OUTSIDE.items():
        files.append(
            File.generated(config, page, content=(ROOT / file).read_text(encoding="utf-8"))
        )
    for notebook in sorted((ROOT / "docs").glob("notebooks/*.ipynb")):
        page = f"notebooks/{notebook.stem}.md"
        files.append(File.generated(config, page, content=render_notebook(notebook)))
    return files


def render_notebook(path: Path) -> str:
    """Return a notebook as Markdown: its texts, and its cells of code in fences."""
    parts = []
    for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
        text = "".join(cell["source"])
        if cell["cell_type"] == "code":
            language = "bash" if text.startswith("!") else "python"
            text = f"```{language}\n{text}\n```"
        parts.append(text)
    parts.append(f"[This page as a notebook]({path.name})")
    return "\n\n".join(parts) + "\n"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Links that are right on GitHub lead to the same pages here; ``::: ghpt.models.*`` is every
    module of it.
    """
    for page, file in OUTSIDE.items():
        markdown = markdown.replace(f"](../{file}", f"]({page}")
    markdown = re.sub(r"\]\((notebooks/\w+)\.ipynb\)", r"](\1.md)", markdown)
    return re.sub(
        r"^::: ([\w.]+)\.\*$",
        lambda match: "\n\n".join(_entries(match[1])),
        markdown,
        flags=re.MULTILINE,
    )


def on_page_content(html: str, **_: Any) -> str:
    """A docstring's ``::`` before an example is a colon."""
    return html.replace("::</p>", ":</p>")


def _entries(package: str) -> Iterator[str]:
    """One ``:::`` for each package within, where it says something, and for each public module."""
    source = ROOT / "src"
    folder = source / package.replace(".", "/")
    paths = folder.glob("*.py") if package == "ghpt" else folder.rglob("*.py")
    for path in sorted(paths, key=lambda path: (path.parent, path.stem != "__init__", path.stem)):
        name = ".".join(path.relative_to(source).with_suffix("").parts)
        if path.stem == "__init__" and path.read_text(encoding="utf-8").strip():
            yield f"::: {name.removesuffix('.__init__')}"
        elif not path.stem.startswith("_"):
            yield f"::: {name}"
