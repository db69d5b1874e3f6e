"""A document in the terminal."""

from __future__ import annotations

import rich.table
import rich.text
from rich.console import Console

from ghpt.report.document import (
    Block,
    Bullets,
    CodeBlock,
    Document,
    Emphasis,
    Figure,
    Heading,
    Notice,
    Paragraph,
    Player,
    Span,
    Strong,
    Table,
    Text,
    Tone,
    printable,
    spans,
)

_TONES = {Tone.GOOD: "green", Tone.LOOK: "yellow", Tone.BAD: "red"}


def print_document(document: Document, console: Console | None = None) -> None:
    """Print the document to ``console``, by default to standard output."""
    console = console or Console()
    if document.title:
        console.print(style_text(document.title, "bold"), soft_wrap=True)
    for block in document.blocks:
        _print_block(block, console)


def style_text(text: Text, style: str = "") -> rich.text.Text:
    """Return the text for the terminal, in which ``[red]`` and ``:smile:`` are letters."""
    parts = [(_plain_span(span), _style(span)) for span in spans(text)]
    return rich.text.Text.assemble(*parts, style=style)


def _plain_span(span: Span) -> str:
    return printable(span if isinstance(span, str) else span.text)


def _style(span: Span) -> str:
    match span:
        case Strong(_, colour):
            return colour or "bold"
        case Emphasis():
            return "italic"
        case _:
            return ""


def _print_block(block: Block, console: Console) -> None:
    match block:
        case Table():
            console.print(_table(block))
        case Heading(text):
            console.print(style_text(text, "bold"), soft_wrap=True)
        case Paragraph(text):
            console.print(style_text(text), soft_wrap=True)
        case Notice(text, tone):
            console.print(style_text(text, _TONES[tone]), soft_wrap=True)
        case Bullets(items):
            for item in items:
                console.print(style_text(("- ", *spans(item))), soft_wrap=True)
        case Figure(path, caption) | Player(path, caption):
            console.print(style_text(f"{caption}: {path}"), soft_wrap=True)
        case CodeBlock(code, _, summary):
            if summary:
                console.print(style_text(f"{summary}:"), soft_wrap=True)
            for line in code.splitlines():
                console.print(style_text(line), soft_wrap=True)


def _table(table: Table) -> rich.table.Table:
    lines = [style_text(line, "table.caption") for line in table.caption]
    result = rich.table.Table(
        title=style_text(table.title, "table.title") if table.title else None,
        caption=rich.text.Text("\n").join(lines) if lines else None,
        title_justify="left",
        caption_justify="left",
    )
    for column, name in enumerate(table.header):
        left = column in table.left_columns
        result.add_column(style_text(name), justify="left" if left else "right")
    for number, row in enumerate(table.rows):
        result.add_row(*map(style_text, row), end_section=number in table.last_rows)
    return result
