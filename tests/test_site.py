"""The documentation's site builds, fetches nothing, and has every page and every public module."""

import re
import subprocess
import sys
from html.parser import HTMLParser

import pytest

from documented import PAGES, ROOT


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


def test_the_site_builds_without_a_warning_and_fetches_nothing_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) >= len(PAGES)
    for page in pages:
        elsewhere = [a for a in Fetched(page.read_text()).addresses if re.match(r"(\w+:)?//", a)]
        assert not elsewhere, page
    for style in site.rglob("*.css"):
        assert not re.search(r"url\([\"']?(\w+:)?//|@import", style.read_text()), style


def test_every_public_module_is_in_the_api_reference(site):
    anchors = set().union(
        *(Fetched(page.read_text()).anchors for page in (site / "api").glob("*.html"))
    )
    source = ROOT / "src"
    modules = [
        ".".join(path.relative_to(source).with_suffix("").parts)
        for path in (source / "ghpt").rglob("*.py")
        if not path.stem.startswith("_")
    ]
    assert {"ghpt.models.pose.problem", "ghpt.geometry.cameras"} <= set(modules)
    assert sorted(set(modules) - anchors) == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_between_files_are_right_on_github(page):
    links = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text())
    assert [link for link in links if "://" not in link and not (page.parent / link).exists()] == []
