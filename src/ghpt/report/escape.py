"""Names, paths and command lines as what they are: never as Markdown, nor as the terminal's markup."""

from __future__ import annotations

import re

from rich.text import Text

_ANYWHERE = re.compile(r"([\\`*<>\[\]|~&$])")
_AT_AN_EDGE = re.compile(r"(?<![^\W_])(_)|(_)(?![^\W_])")
"""Within a word, as in cam_01, an underscore is no Markdown."""


class Markdown(str):
    """Text that is Markdown already, and stays as it is."""


def printable(text: object) -> str:
    """The text in one line: line breaks and whatever else steers a terminal become spaces."""
    return "".join(letter if letter.isprintable() else " " for letter in str(text))


def escaped(text: object) -> Markdown:
    """The text as Markdown that shows it, in a line or in a cell of a table."""
    if isinstance(text, Markdown):
        return text
    safe = _ANYWHERE.sub(r"\\\1", printable(text))
    return Markdown(_AT_AN_EDGE.sub(lambda match: f"\\{match[0]}", safe))


def code(text: object) -> Markdown:
    """The text as a code span of Markdown."""
    shown = printable(text)
    fence = "`" * (_longest_run(shown) + 1)
    # a space at both ends keeps a backtick there apart from the fence, and is not shown
    space = " " if "`" in shown else ""
    return Markdown(f"{fence}{space}{shown}{space}{fence}")


def code_block(text: str, language: str) -> Markdown:
    """Lines of code as a block of Markdown."""
    fence = "`" * max(3, _longest_run(text) + 1)
    return Markdown(f"{fence}{language}\n{text}\n{fence}")


def plain(text: object, style: str = "") -> Text:
    """The text for the terminal, in which ``[red]`` and ``:smile:`` are letters as all others."""
    lines = str(text).split("\n")
    return Text("\n".join(map(printable, lines)), style=style)


def _longest_run(text: str) -> int:
    return max((len(run) for run in re.findall("`+", text)), default=0)
