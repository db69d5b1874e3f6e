"""A document as Markdown."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

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
    printable,
    spans,
)

_SPECIAL = re.compile(r"([\\`*<>\[\]|~&$])")
_UNDERSCORE = re.compile(r"(?<![^\W_])(_)|(_)(?![^\W_])")
"""An underscore at the edge of a word; within a word, as in cam_01, it is no Markdown."""
_LINE_START = re.compile(r"^(?:([#+-]+)|(\d+)([.)]))(?=\s|$)")
"""What would make a heading, a rule or a list of a line."""


def write_markdown(path: str | Path, document: Document) -> None:
    """Write the document as Markdown."""
    with atomic_write(path, "w") as handle:
        handle.write(render_markdown(document))


def render_markdown(document: Document) -> str:
    """Return the document as Markdown."""
    title = [f"# {_inline(document.title)}"] if document.title else []
    blocks = [_block(block) for block in document.blocks]
    return "\n\n".join([*title, *blocks]) + "\n"


def _block(block: Block) -> str:
    match block:
        case Heading(text, level, anchor):
            heading = f"{'#' * level} {_inline(text)}"
            return f'<a id="{anchor}"></a>\n\n{heading}' if anchor else heading
        case Paragraph(text):
            return _line(text)
        case Notice(text):
            return f"> {_inline(text)}"
        case Bullets(items):
            return "\n".join(f"- {_line(item)}" for item in items)
        case Table():
            return _table(block)
        case Figure(path, caption):
            return f"![{_escape(caption)}]({path})"
        case Player(path, caption):
            return f"[{_escape(caption)}]({path})"
        case CodeBlock():
            return _code_block(block)


def _line(text: Text) -> str:
    """A text that begins a line, which must not turn into a heading or a list."""
    return _LINE_START.sub(_escape_line_start, _inline(text))


def _escape_line_start(match: re.Match[str]) -> str:
    symbols, digits, point = match.groups()
    return f"\\{symbols}" if symbols else f"{digits}\\{point}"


def _inline(text: Text) -> str:
    return "".join(map(_span, spans(text)))


def _span(span: Span) -> str:
    match span:
        case Code(text):
            return _code(text)
        case Strong(text):
            return f"**{_escape(text)}**"
        case Emphasis(text):
            return f"*{_escape(text)}*"
        case Link(text, anchor):
            return f"[{_escape(text)}](#{anchor})"
        case str():
            return _escape(span)


def _escape(text: str) -> str:
    safe = _SPECIAL.sub(r"\\\1", printable(text))
    return _UNDERSCORE.sub(r"\\_", safe)


def _code(text: str) -> str:
    shown = printable(text)
    fence = "`" * (_longest_run(shown) + 1)
    # A space at both ends keeps a backtick there apart from the fence, and is not shown.
    space = " " if "`" in shown else ""
    return f"{fence}{space}{shown}{space}{fence}"


def _code_block(block: CodeBlock) -> str:
    fence = "`" * max(3, _longest_run(block.code) + 1)
    lines = f"{fence}{block.language}\n{block.code}\n{fence}"
    return f"{_line(block.summary)}:\n\n{lines}" if block.summary else lines


def _longest_run(text: str) -> int:
    """The number of backticks in the longest run of them."""
    return max((len(run) for run in re.findall("`+", text)), default=0)


def _table(table: Table) -> str:
    """The table as Markdown that is aligned as plain text too."""
    header = [_cell(cell) for cell in table.header]
    rows = [[_cell(cell) for cell in row] for row in table.rows]
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    left = [column in table.left_columns for column in range(len(header))]
    rule = "|".join(map(_rule, widths, left))
    lines = [_row(header, widths, left), f"|{rule}|"]
    lines += [_row(row, widths, left) for row in rows]
    title = [f"**{_inline(table.title)}**"] if table.title else []
    caption = ["\n".join(map(_line, table.caption))] if table.caption else []
    return "\n\n".join([*title, "\n".join(lines), *caption])


def _cell(text: Text) -> str:
    """A cell's text; a bar divides cells even within code, so that code must escape it too."""
    parts = []
    for span in spans(text):
        shown = _span(span)
        parts.append(shown.replace("|", "\\|") if isinstance(span, Code) else shown)
    return "".join(parts)


def _rule(width: int, left: bool) -> str:
    return "-" * (width + 2) if left else "-" * (width + 1) + ":"


def _row(cells: Sequence[str], widths: Sequence[int], left: Sequence[bool]) -> str:
    columns = zip(cells, widths, left, strict=True)
    aligned = [
        cell.ljust(width) if at_left else cell.rjust(width) for cell, width, at_left in columns
    ]
    return f"| {' | '.join(aligned)} |"
