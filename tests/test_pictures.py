"""The pictures of the documentation are those that scripts/pictures.py makes today."""

import json
import re
import sys
from html.parser import HTMLParser

import pytest

from documented import PAGES, ROOT, text_of

IMAGES = ROOT / "docs" / "images"


@pytest.fixture
def pictures(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "scripts")
    yield __import__("pictures")
    sys.modules.pop("pictures")


def test_the_code_of_every_picture_is_that_which_made_it(pictures):
    """Else run scripts/pictures.py again, look at what it made, and commit that. A picture of a
    whole page may stay where nothing of its looks has changed: then write its digest down.
    """
    assert json.loads((IMAGES / "sources.json").read_text()) == pictures.digests()
    assert {path.name for path in IMAGES.iterdir()} == {*pictures.SOURCES, "sources.json"}


def test_pictures_are_small_and_without_names_of_machines():
    sizes = [path.stat().st_size for path in IMAGES.iterdir()]
    assert sum(sizes) < 1_000_000
    for path in IMAGES.glob("*.svg"):
        text = path.read_text(encoding="utf-8")
        assert "<script" not in text
        assert not re.search(r"href=\"(?!#|data:)", text)


def test_every_page_s_pictures_exist_and_have_a_text():
    for page in PAGES:
        text = text_of(page)
        shown = re.findall(r"!\[([^\]]*)\]\(([^)]+)\)", text)
        tags = Images()
        tags.feed(text)
        for description, path in [*shown, *tags.found]:
            assert description, page
            assert (page.parent / path).is_file(), (page, path)


class Images(HTMLParser):
    """The images of a page, as (alt, src)."""

    def __init__(self):
        super().__init__()
        self.found = []

    def handle_starttag(self, tag, attrs):
        values = dict(attrs)
        if tag == "img":
            self.found.append((values.get("alt"), values.get("src")))
