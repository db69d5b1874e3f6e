"""Lists of names that pandas stores as a pickle, read as text: nothing is unpickled.

A pickle is a program. Of its instructions those are followed here that put texts into tuples and
lists; one that could make anything else ends the reading.
"""

from __future__ import annotations

import pickletools
from collections.abc import Callable
from typing import Any

_MOST = 200_000
"""Instructions: 10,000 columns need a third of that."""
_MARK = object()
_TEXTS = ("UNICODE", "BINUNICODE", "SHORT_BINUNICODE", "BINUNICODE8")
_NUMBERS = ("INT", "BININT", "BININT1", "BININT2")
_PUTS = ("PUT", "BINPUT", "LONG_BINPUT")
_GETS = ("GET", "BINGET", "LONG_BINGET")
_NOTHING = ("PROTO", "FRAME", "STOP")


def read_names(data: bytes) -> list[tuple[str, ...]]:
    """Return a pickled list of tuples of texts. Raises ValueError for anything else."""
    stack: list[Any] = []
    memory: dict[int, Any] = {}
    argument: Any
    for count, (code, argument, _) in enumerate(pickletools.genops(data)):
        if count > _MOST:
            raise ValueError("there are too many names")
        if code.name in (*_TEXTS, *_NUMBERS):
            stack.append(argument)
        elif code.name in _PUTS:
            memory[int(argument)] = stack[-1]
        elif code.name == "MEMOIZE":
            memory[len(memory)] = stack[-1]
        elif code.name in _GETS:
            stack.append(memory[int(argument)])
        elif code.name in _MAKERS:
            _MAKERS[code.name](stack)
        elif code.name not in _NOTHING:
            raise ValueError(f"{code.name} makes more than names")
    return _check_names(stack)


def _check_names(stack: list[Any]) -> list[tuple[str, ...]]:
    names = stack[-1] if len(stack) == 1 else None
    if not isinstance(names, list) or not all(isinstance(name, tuple) for name in names):
        raise ValueError("it is no list of names")
    if not all(isinstance(part, str) for name in names for part in name):
        raise ValueError("a name is no text")
    return names


def _pop_marked(stack: list[Any]) -> list[Any]:
    """Take what lies above the last mark, and the mark, from the stack."""
    items: list[Any] = []
    while stack[-1] is not _MARK:
        items.append(stack.pop())
    stack.pop()
    return items[::-1]


def _append(stack: list[Any], items: list[Any]) -> None:
    if not isinstance(stack[-1], list):
        raise ValueError("it appends to what is no list")
    stack[-1].extend(items)


def _tuple_of(count: int) -> Callable[[list[Any]], None]:
    def make(stack: list[Any]) -> None:
        items = [stack.pop() for _ in range(count)]
        stack.append(tuple(items[::-1]))

    return make


_MAKERS: dict[str, Callable[[list[Any]], None]] = {
    "MARK": lambda stack: stack.append(_MARK),
    "LIST": lambda stack: stack.append(_pop_marked(stack)),
    "EMPTY_LIST": lambda stack: stack.append([]),
    "APPEND": lambda stack: _append(stack, [stack.pop()]),
    "APPENDS": lambda stack: _append(stack, _pop_marked(stack)),
    "TUPLE": lambda stack: stack.append(tuple(_pop_marked(stack))),
    "EMPTY_TUPLE": lambda stack: stack.append(()),
    "TUPLE1": _tuple_of(1),
    "TUPLE2": _tuple_of(2),
    "TUPLE3": _tuple_of(3),
}
