"""How paths, settings and commands are said, so that a reader can type them."""

import logging
import os
import re
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


def shell_override(key: str, value: object) -> str:
    """Return ``key=value`` as a shell and Hydra's grammar take it."""
    plain = re.fullmatch(r"[\w./+-]+", str(value))
    return f"{key}={value}" if plain else f"\"{key}='{value}'\""
