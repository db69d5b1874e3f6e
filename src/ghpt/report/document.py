"""A document: headings, paragraphs, tables and figures, for the terminal, Markdown and HTML alike.

A renderer (`ghpt.report.terminal`, `ghpt.report.markdown`, `ghpt.report.html`) escapes every text
for its own medium. Names, paths and command lines therefore enter a document as they are.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from enum import StrEnum


@dataclass(frozen=True)
class Code:
    """A name, a path or a command line, set as code."""

    text: str


@dataclass(frozen=True)
class Strong:
    """A text in bold; ``colour`` takes the place of bold in the terminal."""

    text: str
    colour: str = ""


@dataclass(frozen=True)
class Emphasis:
    """A text in italics."""

    text: str


@dataclass(frozen=True)
class Link:
    """A reference to a `Heading` of the same document by its anchor."""

    text: str
    anchor: str


Span = str | Code | Strong | Emphasis | Link
Text = Span | tuple[Span, ...]
"""One span or several, without a line break: renderers turn a line break into a space."""


@dataclass(frozen=True)
class Heading:
    """A heading of level 2 or below; a document's title is its only one of level 1."""

    text: Text
    level: int = 2
    anchor: str = ""
    """Name by which a `Link` refers to the heading."""


@dataclass(frozen=True)
class Paragraph:
    """A paragraph of text."""

    text: Text


@dataclass(frozen=True)
class Bullets:
    """A list with a bullet before each item."""

    items: Sequence[Text]


@dataclass(frozen=True)
class Table:
    """A table with one header row; every row has as many cells as the header."""

    header: Sequence[Text]
    rows: Sequence[Sequence[Text]]
    title: Text = ""
    caption: tuple[Text, ...] = ()
    """Lines below the table."""
    left_columns: Collection[int] = (0,)
    """Columns that are aligned to the left, as words are; the others are aligned to the right."""
    last_rows: Collection[int] = ()
    """Rows that end a group; the terminal draws a rule below each."""


@dataclass(frozen=True)
class Figure:
    """A picture in a file of its own."""

    path: str
    """Path relative to the document's folder."""
    caption: str


class Tone(StrEnum):
    """How good the news of a `Notice` is."""

    GOOD = "good"
    LOOK = "look"
    BAD = "bad"


@dataclass(frozen=True)
class Notice:
    """A paragraph that stands out: the verdict."""

    text: Text
    tone: Tone


@dataclass(frozen=True)
class Player:
    """The page of a 3D player in the document's folder, shown within the document."""

    path: str
    """Path relative to the document's folder."""
    caption: str


@dataclass(frozen=True)
class CodeBlock:
    """Lines of code."""

    code: str
    language: str = ""
    summary: str = ""
    """A text before the block; in HTML the block is folded under it."""


Block = Heading | Paragraph | Notice | Bullets | Table | Figure | Player | CodeBlock


@dataclass(frozen=True)
class Document:
    """A title and the blocks below it."""

    title: Text
    """Empty where the document has none."""
    blocks: Sequence[Block]


def spans(text: Text) -> tuple[Span, ...]:
    """Return the text as a tuple of its spans."""
    return text if isinstance(text, tuple) else (text,)


_MARKUP = re.compile(r"`([^`]+)`|\*\*([^*]+)\*\*|\*([^*]+)\*|(\{\})")


def prose(template: str, *values: Text) -> tuple[Span, ...]:
    """Return a text in which `` `x` `` is code, ``**x**`` strong, ``*x*`` emphasis, ``{}`` a value.

    Only the template has markup: a value is shown as it is. Raises ValueError unless the template
    has as many places as there are values.
    """
    result: list[Span] = []
    remaining = list(values)
    end = 0
    for match in _MARKUP.finditer(template):
        result.append(template[end : match.start()])
        code, strong, emphasis, place = match.groups()
        if place is not None:
            if not remaining:
                raise ValueError(f"{template!r} has more places than the {len(values)} values")
            result.extend(spans(remaining.pop(0)))
        elif code is not None:
            result.append(Code(code))
        elif strong is not None:
            result.append(Strong(strong))
        else:
            result.append(Emphasis(emphasis))
        end = match.end()
    if remaining:
        raise ValueError(f"{template!r} has fewer places than the {len(values)} values")
    result.append(template[end:])
    return tuple(span for span in result if span)


def printable(text: str) -> str:
    """Return the text on one line, with a space for each character that would steer a terminal."""
    return "".join(letter if letter.isprintable() else " " for letter in text)


def plain_text(text: Text) -> str:
    """Return the text without its markup, on one line."""
    return "".join(printable(span if isinstance(span, str) else span.text) for span in spans(text))
