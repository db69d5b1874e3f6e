"""The names of views and cameras in settings, where a name such as 54138969 arrives as a number."""

from __future__ import annotations

import math
from collections.abc import Iterable

Name = str | int | float | bool | None
"""What a name becomes on its way through the command line: ``54138969``, ``1e5``, ``true`` and
``null`` become an integer, a number, a truth and nothing.
"""


def chosen_name(value: Name, existing: Iterable[str]) -> str:
    """The name that ``value`` was typed for.

    A text, and whatever reads like an existing name, is that name. Another value stands for the one
    existing name that is read as this value: 100000.0 for ``1e5``, and 7 for ``07``. Where there is
    none or more than one, the value comes back as text, which the caller then finds or does not.
    """
    names = list(dict.fromkeys(existing))
    text = str(value)
    if isinstance(value, str) or text in names:
        return text
    same = [name for name in names if _read_as(name, value)]
    return same[0] if len(same) == 1 else text


def _read_as(name: str, value: int | float | bool | None) -> bool:
    """Whether the command line takes ``name`` for this value."""
    if value is None:
        return name.lower() == "null"
    if isinstance(value, bool):
        return name.lower() == str(value).lower()
    try:
        number = type(value)(name)
    except ValueError:
        return False
    return number == value or (math.isnan(number) and math.isnan(value))
