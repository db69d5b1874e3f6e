"""The documentation's site builds, fetches nothing, and has every page and every public module."""

import importlib.util
import json
import re
import subprocess
import sys
from html.parser import HTMLParser

import pytest

from documented import PAGES, ROOT, text_of
from sizes import NIGHTLY


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    found = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert found.returncode == 0, found.stderr
    return folder


class Fetched(HTMLParser):
    """The addresses that a browser loads for a page, and what the page can be pointed at."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.anchors.add(values.get("id") or "")
        if tag in ("script", "img", "iframe", "source", "video", "audio", "embed"):
            self.addresses.append(values.get("src") or "")
        if tag == "link" and values.get("rel") not in ("canonical", "next", "prev"):
            self.addresses.append(values.get("href") or "")


@pytest.mark.skipif(not NIGHTLY, reason="the site, which takes 12 s, is built at night")
def test_the_site_builds_without_a_warning_and_fetches_nothing_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) >= len(PAGES)
    for page in pages:
        elsewhere = [a for a in Fetched(page.read_text()).addresses if re.match(r"(\w+:)?//", a)]
        assert not elsewhere, page
    for style in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(\w+:)?//|@import", style.read_text()), style


@pytest.mark.skipif(not NIGHTLY, reason="the site, which takes 12 s, is built at night")
def test_every_entry_of_the_api_reference_is_on_its_page(site):
    pages = (site / "api").glob("*.html")
    anchors = set().union(*(Fetched(page.read_text()).anchors for page in pages))
    assert sorted(set(entries()) - anchors) == []


def load_hooks():
    spec = importlib.util.spec_from_file_location("hooks", ROOT / "docs" / "hooks.py")
    hooks = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(hooks)
    return hooks


def test_notebooks_have_no_outputs_and_are_pages_of_the_site():
    hooks = load_hooks()
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for path in (ROOT / "docs").glob("notebooks/*.ipynb"):
        cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
        assert all(cell.get("outputs", []) == [] for cell in cells)
        page = hooks.render_notebook(path)
        assert page.count("```") == 2 * sum(cell["cell_type"] == "code" for cell in cells)
        assert f"notebooks/{path.stem}.md" in nav


def entries() -> list[str]:
    """What the pages of the API reference ask mkdocstrings for."""
    hooks = load_hooks()
    pages = [page.read_text(encoding="utf-8") for page in (ROOT / "docs" / "api").glob("*.md")]
    markdown = "\n".join(map(hooks.on_page_markdown, pages))
    return re.findall(r"^::: (\S+)$", markdown, re.MULTILINE)


def test_every_public_module_is_in_the_api_reference():
    source = ROOT / "src"
    modules = [
        ".".join(path.relative_to(source).with_suffix("").parts)
        for path in (source / "ghpt").rglob("*.py")
        if not path.stem.startswith("_")
    ]
    assert {"ghpt.models.pose.problem", "ghpt.geometry.cameras"} <= set(modules)
    assert sorted(set(modules) - set(entries())) == []
    assert [name for name in entries() if importlib.util.find_spec(name) is None] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_files_are_right_on_github(page):
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text_of(page))
    assert [link for link in links if "://" not in link and not (page.parent / link).exists()] == []
