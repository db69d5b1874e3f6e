"""How paths, settings and commands are said, so that a reader can type them."""

import logging
import os
import re
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_SCRIPTS = re.compile(
    r"(?:python )?\b(demo|detect|train|test|predict|calibrate|cameras|reproduce)\.py\b"
)


@contextmanager
def until_reader_leaves() -> Iterator[None]:
    """End the program with status 1, and without a word, when nobody reads its output any more."""
    said = logging.raiseExceptions
    logging.raiseExceptions = False  # a line of the log that nobody reads would print a trace
    try:
        yield
        sys.stdout.flush()
    except BrokenPipeError:  # as `head` does when it has its lines
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    finally:
        logging.raiseExceptions = said


def as_started(text: str) -> str:
    """Return a text with the project's scripts named as this program was started.

    Where that was ``ghpt train``, ``python test.py`` becomes ``ghpt test``.
    """
    return _SCRIPTS.sub(r"ghpt \1", text) if sys.argv[0].startswith("ghpt ") else text


def name_as_started(record: logging.LogRecord) -> bool:
    """Apply `as_started` to a line of the log. Returns True: it is a filter that keeps all."""
    record.msg = as_started(record.getMessage())
    record.args = ()
    return True


def display_path(path: Path) -> str:
    """Return a path as short as it can be typed here."""
    relative = os.path.relpath(path)
    return str(path) if relative.startswith("..") else relative


def slash_path(text: str) -> str:
    """Return a text with slashes if it is a path of Windows with a drive or a server, quoted or
    not.

    To Hydra a backslash before a quote, or before another one, is no letter of the path: a quoted
    C:\\data\\ would not end. Windows takes both.
    """
    is_path = re.match(r"""["']?([A-Za-z]:\\|\\\\\w)""", text)
    return text.replace("\\", "/") if is_path else text


def shell_override(key: str, value: object) -> str:
    """Return ``key=value`` as a shell and Hydra's grammar take it."""
    text = slash_path(str(value))
    if re.fullmatch(r"[\w./+-]+", text, re.ASCII):
        return f"{key}={text}"
    quoted = re.sub(r"(\\*)('|$)", r"\1\1\2", text).replace("'", "\\'")
    word = f"{key}='{quoted}'"
    return shlex.quote(word) if re.search(r'[$"`!]|\\\\', word) else f'"{word}"'
