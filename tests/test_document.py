"""A document shows a name as it is, whatever it is made of: as Markdown, HTML and in the
terminal."""

import io
from html.parser import HTMLParser
from itertools import pairwise

import pytest
from markdown_it import MarkdownIt
from rich.console import Console

from ghpt.report.document import (
    Bullets,
    Code,
    CodeBlock,
    Document,
    Emphasis,
    Figure,
    Heading,
    Link,
    Paragraph,
    Strong,
    Table,
    plain_text,
    prose,
)
from ghpt.report.html import render_html
from ghpt.report.markdown import render_markdown
from ghpt.report.terminal import print_document

NAMES = (
    "a|b<c>[red]",
    "`x`",
    "*a* _b_ __c__",
    "[l](http://x)",
    "~~a~~ &lt;",
    "\\|",
    "$a$",
    "<b>",
    "_",
    "cam_01",
    "# a",
    "- a",
    "10. a",
)


def shown_by_markdown(text: str) -> list[tuple[str, str]]:
    """The kind and the text of all headings, paragraphs and cells."""
    shown = []
    for opening, inline in pairwise(MarkdownIt("gfm-like", {"linkify": False}).parse(text)):
        if inline.type == "inline":
            kinds = {part.type for part in inline.children}
            assert not {"html_inline", "link_open", "image"} & kinds
            shown.append((opening.type, "".join(part.content for part in inline.children)))
    return shown


class ShownByHtml(HTMLParser):
    """The text of the page's headings, paragraphs, items and cells."""

    def __init__(self, page: str):
        super().__init__()
        self.tag = ""
        self.shown: list[tuple[str, str]] = []
        self.feed(page[page.index("<main") :])

    def handle_starttag(self, tag, attributes):
        if tag in ("h1", "h2", "p", "li", "td", "th"):
            self.shown.append((tag, ""))

    def handle_data(self, data):
        if data.strip():
            tag, text = self.shown[-1]
            self.shown[-1] = (tag, text + data)


def shown_in_the_terminal(document: Document) -> str:
    buffer = io.StringIO()
    print_document(document, Console(file=buffer, width=120, color_system=None))
    return buffer.getvalue()


def document_of(name: str) -> Document:
    table = Table(["view", name], [[name, Code(name)], ["b", Strong(name)]])
    blocks = [Paragraph(name), Bullets([name, Code(name)]), table]
    return Document(f"A {name} b", blocks)


@pytest.mark.parametrize("name", NAMES)
def test_markdown_shows_a_name_as_it_is(name):
    assert shown_by_markdown(render_markdown(document_of(name))) == [
        ("heading_open", f"A {name} b"),
        ("paragraph_open", name),
        ("paragraph_open", name),
        ("paragraph_open", name),
        ("th_open", "view"),
        ("th_open", name),
        ("td_open", name),
        ("td_open", name),
        ("td_open", "b"),
        ("td_open", name),
    ]


@pytest.mark.parametrize("name", NAMES)
def test_html_shows_a_name_as_it_is(name):
    assert ShownByHtml(render_html(document_of(name), {})).shown == [
        ("h1", f"A {name} b"),
        ("p", name),
        ("li", name),
        ("li", name),
        ("th", "view"),
        ("th", name),
        ("td", name),
        ("td", name),
        ("td", "b"),
        ("td", name),
    ]


@pytest.mark.parametrize("name", NAMES)
def test_the_terminal_shows_a_name_as_it_is(name):
    assert shown_in_the_terminal(document_of(name)).count(name) == 8


def test_a_name_with_a_line_break_or_a_control_character_stays_on_one_line():
    document = Document("", [Bullets(["a\n# b\x1b[31m"])])
    assert render_markdown(document) == "- a # b \\[31m\n"
    assert shown_in_the_terminal(document) == "- a # b [31m\n"
    assert "<li>a # b [31m</li>" in render_html(document, {})


def test_code_with_backticks_does_not_end_its_block():
    code = "a\n```\n# b"
    text = render_markdown(Document("", [CodeBlock(code, "bash")]))
    assert MarkdownIt().parse(text)[0].content == f"{code}\n"


def test_a_table_in_markdown_is_aligned_as_plain_text():
    table = Table(["view", "px"], [["a", "10.5"], ["left", "9"]], "Errors", ("median", "of all"))
    assert render_markdown(Document("", [table])).splitlines() == [
        "**Errors**",
        "",
        "| view |   px |",
        "|------|-----:|",
        "| a    | 10.5 |",
        "| left |    9 |",
        "",
        "median",
        "of all",
    ]


def test_a_picture_is_in_the_page():
    document = Document("", [Figure("figures/a.svg", "a <curve>")])
    assert "![a \\<curve\\>](figures/a.svg)" in render_markdown(document)
    page = render_html(document, {"figures/a.svg": b"<svg/>"})
    assert '<img alt="a &lt;curve&gt;" src="data:image/svg+xml;base64,PHN2Zy8+">' in page


def test_a_link_leads_to_its_heading():
    document = Document("", [Paragraph(Link("there", "place")), Heading("A place", 2, "place")])
    assert render_markdown(document) == '[there](#place)\n\n<a id="place"></a>\n\n## A place\n'
    page = render_html(document, {})
    assert '<p><a href="#place">there</a></p>' in page
    assert '<h2 id="place">A place</h2>' in page
    assert '<li><a href="#place">place</a></li>' in page


def test_code_with_a_summary_is_folded_under_it():
    document = Document("", [CodeBlock("a < b", "bash", "By hand")])
    assert render_markdown(document) == "By hand:\n\n```bash\na < b\n```\n"
    folded = "<details><summary>By hand</summary><pre>a &lt; b</pre></details>"
    assert folded in render_html(document, {})


def test_only_the_template_of_prose_has_markup():
    text = prose("**Now** `x` of *all*: {} and {}.", "*a*", Code("{}"))
    assert text == (
        Strong("Now"),
        " ",
        Code("x"),
        " of ",
        Emphasis("all"),
        ": ",
        "*a*",
        " and ",
        Code("{}"),
        ".",
    )
    assert plain_text(text) == "Now x of all: *a* and {}."


@pytest.mark.parametrize("template", ["{}", "{} {} {}"])
def test_prose_has_as_many_places_as_values(template):
    with pytest.raises(ValueError, match="places"):
        prose(template, "a", "b")
