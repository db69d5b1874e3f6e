"""A document as one HTML page that needs no other file."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from html import escape
from importlib.resources import files

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
    Paragraph,
    Span,
    Strong,
    Table,
    Text,
    plain_text,
    printable,
    spans,
)


def render_html(document: Document, pictures: Mapping[str, bytes]) -> str:
    """Return the document as a page, with a navigation of the headings that have an anchor.

    ``pictures`` holds the SVG of each `Figure` by its path. They are in the page, and nothing is
    fetched. Raises KeyError for a figure without a picture.
    """
    template = files("ghpt.report").joinpath("page.html").read_text(encoding="utf-8")
    headings = [block for block in document.blocks if isinstance(block, Heading) and block.anchor]
    links = "".join(f"<li>{_link(heading.anchor, heading.anchor)}</li>" for heading in headings)
    body = "\n".join(_block(block, pictures) for block in document.blocks)
    page = template.replace("<!--TITLE-->", escape(plain_text(document.title)))
    return page.replace("<!--LINKS-->", links).replace("<!--BODY-->", body)


def _block(block: Block, pictures: Mapping[str, bytes]) -> str:
    match block:
        case Heading(text, level, anchor):
            identity = f' id="{escape(anchor)}"' if anchor else ""
            return f"<h{level}{identity}>{_inline(text)}</h{level}>"
        case Paragraph(text):
            return f"<p>{_inline(text)}</p>"
        case Bullets(items):
            lines = "".join(f"<li>{_inline(item)}</li>" for item in items)
            return f"<ul>{lines}</ul>"
        case Table():
            return _table(block)
        case Figure(path, caption):
            return _picture(pictures[path], caption)
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


def _picture(svg: bytes, caption: str) -> str:
    source = base64.b64encode(svg).decode()
    return f'<p><img alt="{escape(caption)}" src="data:image/svg+xml;base64,{source}"></p>'


def _code_block(block: CodeBlock) -> str:
    lines = f"<pre>{escape(block.code)}</pre>"
    if not block.summary:
        return lines
    return f"<details><summary>{escape(block.summary)}</summary>{lines}</details>"
