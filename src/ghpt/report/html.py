"""A document as one HTML page that needs no other file."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Mapping
from html import escape
from importlib.resources import files
from pathlib import Path
from urllib.parse import quote

from matplotlib.figure import Figure as DrawnFigure

from ghpt.files import atomic_write
from ghpt.report.document import (
    Block,
    Bullets,
    Code,
    CodeBlock,
    Document,
    Emphasis,
    Figure,
    Heading,
    Link,
    Notice,
    Paragraph,
    Player,
    Span,
    Strong,
    Table,
    Text,
    plain_text,
    printable,
    spans,
)
from ghpt.report.drawing import draw


def write_html(path: str | Path, document: Document, figures: Mapping[str, DrawnFigure]) -> None:
    """Write the document as a page. ``figures``: what each `Figure` shows, by its path."""
    pictures = {name: draw(figure, "svg") for name, figure in figures.items()}
    with atomic_write(path, "w") as handle:
        handle.write(render_html(document, pictures))


def render_html(document: Document, pictures: Mapping[str, bytes]) -> str:
    """Return the document as a page, with a navigation of the headings of level 2.

    ``pictures`` holds the SVG of each `Figure` by its path. They are in the page, and nothing is
    fetched. Raises KeyError for a figure without a picture.
    """
    template = files("ghpt.report").joinpath("page.html").read_text(encoding="utf-8")
    every = [block for block in document.blocks if isinstance(block, Heading)]
    headings = [heading for heading in every if heading.level == 2]
    links = "".join(f"<li>{_link(_short_name(each), _anchor(each))}</li>" for each in headings)
    body = "\n".join(_block(block, pictures) for block in document.blocks)
    page = template.replace("<!--TITLE-->", escape(plain_text(document.title)))
    return page.replace("<!--LINKS-->", links).replace("<!--BODY-->", body)


def _anchor(heading: Heading) -> str:
    """Return the name by which links refer to a heading."""
    return heading.anchor or re.sub(r"\W+", "-", plain_text(heading.text)).strip("-").lower()


def _short_name(heading: Heading) -> str:
    """Return what the navigation calls a heading: the anchor, where there is one."""
    return heading.anchor or plain_text(heading.text)


def _block(block: Block, pictures: Mapping[str, bytes]) -> str:
    match block:
        case Heading(text, level):
            return f'<h{level} id="{escape(_anchor(block))}">{_inline(text)}</h{level}>'
        case Paragraph(text):
            return f"<p>{_inline(text)}</p>"
        case Notice(text, tone):
            return f'<p class="notice {tone}">{_inline(text)}</p>'
        case Bullets(items):
            lines = "".join(f"<li>{_inline(item)}</li>" for item in items)
            return f"<ul>{lines}</ul>"
        case Table():
            return _table(block)
        case Figure(path, caption):
            return _picture(pictures[path], caption)
        case Player():
            return _player(block)
        case CodeBlock():
            return _code_block(block)


def _inline(text: Text) -> str:
    return "".join(map(_span, spans(text)))


def _span(span: Span) -> str:
    match span:
        case Code(text):
            return f"<code>{_escape(text)}</code>"
        case Strong(text):
            return f"<strong>{_escape(text)}</strong>"
        case Emphasis(text):
            return f"<em>{_escape(text)}</em>"
        case Link(text, anchor):
            return _link(text, anchor)
        case str():
            return _escape(span)


def _escape(text: str) -> str:
    return escape(printable(text))


def _link(text: str, anchor: str) -> str:
    return f'<a href="#{escape(anchor)}">{_escape(text)}</a>'


def _table(table: Table) -> str:
    title = f"<p><strong>{_inline(table.title)}</strong></p>\n" if table.title else ""
    caption = "<br>".join(map(_inline, table.caption))
    header = _row(table.header, "th", table)
    rows = "\n".join(_row(row, "td", table) for row in table.rows)
    head = f"<thead>{header}</thead>"
    body = f"<tbody>\n{rows}\n</tbody>"
    below = f"\n<p>{caption}</p>" if caption else ""
    return f'{title}<div class="table"><table>{head}{body}</table></div>{below}'


def _row(cells: Iterable[Text], tag: str, table: Table) -> str:
    parts = []
    for column, cell in enumerate(cells):
        right = "" if column in table.left_columns else ' style="text-align:right"'
        parts.append(f"<{tag}{right}>{_inline(cell)}</{tag}>")
    return f"<tr>{''.join(parts)}</tr>"


_DARK_COLOURS = {
    "#000000": "#e4e4e0",
    "#222222": "#e4e4e0",
    "#333333": "#d4d4d0",
    "#dddddd": "#3a3d42",
    "#e5e5e5": "#3a3d42",
    "#ffffff": "#16181c",
}
"""What the ink, the grid and the paper of a figure are in the dark."""


def _dark_style() -> str:
    """Return the style that gives an SVG of matplotlib the colours of a dark page."""
    rules = ["svg{fill:#e4e4e0}"]
    for light, dark in _DARK_COLOURS.items():
        rules += [
            f'[style*="{name}: {light}"]{{{name}:{dark}!important}}' for name in ("fill", "stroke")
        ]
    return f"<style>@media (prefers-color-scheme:dark){{{''.join(rules)}}}</style>"


def _player(player: Player) -> str:
    path = escape(quote(player.path))
    caption = _escape(player.caption)
    frame = f'<iframe src="{path}" title="{caption}" loading="lazy"></iframe>'
    return f'{frame}\n<p><a href="{path}">{caption}</a></p>'


def _picture(svg: bytes, caption: str) -> str:
    head, opening, rest = svg.partition(b"<defs>")
    dark = head + _dark_style().encode() + opening + rest if opening else svg
    source = base64.b64encode(dark).decode()
    image = f'<img alt="{escape(caption)}" src="data:image/svg+xml;base64,{source}">'
    return f'<p class="figure">{image}</p>'


def _code_block(block: CodeBlock) -> str:
    lines = f"<pre>{escape(block.code)}</pre>"
    if not block.summary:
        return lines
    return f"<details><summary>{escape(block.summary)}</summary>{lines}</details>"
