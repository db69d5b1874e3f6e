"""CSV tables of numbers, opened with care: of any encoding, cut ones told, no endless lines.

A spreadsheet of a country whose numbers have decimal commas saves semicolons or tabs between the
columns; such a table is read as if it had commas there and points in its numbers.
"""

from __future__ import annotations

import codecs
import csv
import io
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

import numpy as np
from jaxtyping import Float

from ghpt.data.formats.validate import open_input
from ghpt.errors import GhptDataError

_LARGEST = 2 << 30
_LONGEST_LINE = 1 << 18
_SEPARATORS = ";\t"
"""Between the columns of a spreadsheet's tables, where a comma may be a decimal one."""


class Lines(Protocol):
    """A table that is read line by line."""

    def readline(self, size: int) -> str:
        """Return the next line, or its first ``size`` characters; an empty text at the end."""


class _Translated:
    """Lines in which some characters stand for others."""

    def __init__(self, lines: Lines, characters: dict[int, str]) -> None:
        self.lines = lines
        self.characters = characters

    def readline(self, size: int) -> str:
        return self.lines.readline(size).translate(self.characters)


@contextmanager
def open_table(path: Path) -> Iterator[Lines]:
    """Open a table at its first line.

    Raises GhptDataError for one that is too large, or that ends within a line.
    """
    if path.stat().st_size > _LARGEST:
        raise GhptDataError(path, "", f"has more than {_LARGEST >> 30} GiB", "Split the recording.")
    with open_input(path) as raw:
        utf16 = raw.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        encoding = "utf-16" if utf16 else "utf-8-sig"
        raw.seek(-min(2, path.stat().st_size), 2)
        if not raw.read().strip(b"\0").endswith((b"\n", b"\r")):
            problem = "ends in the middle of a line: it is truncated"
            raise GhptDataError(path, "", problem, "Copy it again.")
        raw.seek(0)
        with io.TextIOWrapper(raw, encoding=encoding, errors="replace", newline="") as handle:
            first = handle.readline(_LONGEST_LINE)
            handle.seek(0)
            separator = next((sign for sign in _SEPARATORS if sign in first), None)
            if separator is None:
                yield handle
            else:
                yield _Translated(handle, str.maketrans({",": ".", separator: ","}))


def read_header(handle: Lines) -> list[str]:
    """Return the names in the next line."""
    line = handle.readline(_LONGEST_LINE)
    return [name.strip() for name in next(csv.reader([line]), [])]


def read_numbers(
    handle: Lines,
    columns: Sequence[int],
    converters: Mapping[int, Callable[[str], float]] | None = None,
) -> Float[np.ndarray, "N C"]:
    """Return some columns of the rest of a table; an empty cell is NaN.

    ``converters`` says of some columns what their texts mean. Raises ValueError for what is no
    number.
    """
    own: dict[int | str, Callable[[str], float]] = {}
    for column in columns:
        own[column] = (converters or {}).get(column, _number)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of a table without rows
        table = np.loadtxt(
            _lines(handle),
            delimiter=",",
            usecols=columns,
            converters=own,
            ndmin=2,
            comments=None,
        )
    return table.reshape(-1, len(columns))


def _lines(handle: Lines) -> Iterator[str]:
    while line := handle.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise ValueError("a line of it does not end")
        yield line


def _number(cell: str) -> float:
    return float(cell) if cell.strip() else np.nan
