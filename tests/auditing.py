"""What code tries to reach of the system, by Python's audit events."""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

_attempts: list[str] = []
_watched: tuple[str, ...] = ()
_harmless: tuple[str, ...] = ()


def _is_writing(event: str, arguments: tuple[Any, ...]) -> bool:
    return (
        event == "open" and isinstance(arguments[1], str) and bool(set(arguments[1]) & set("wax+"))
    )


def _note(event: str, arguments: tuple[Any, ...]) -> None:
    if not _watched:
        return
    is_watched = event.startswith(_watched) and not event.startswith(_harmless)
    if is_watched or _is_writing(event, arguments):
        _attempts.append(f"{event} {arguments[:2]!r:.200}")


sys.addaudithook(_note)  # cannot be removed; does nothing while nothing is watched


@contextmanager
def watch(watched: tuple[str, ...], harmless: tuple[str, ...] = ()) -> Iterator[list[str]]:
    """Yield the list of the attempts within the block to write a file, and of the events that begin
    with a watched and with no harmless name.
    """
    global _watched, _harmless
    _attempts.clear()
    _harmless = harmless
    _watched = watched
    try:
        yield _attempts
    finally:
        _watched = ()
