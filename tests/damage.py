"""Files as disks and people spoil them."""

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ghpt.errors import GhptDataError

_WORDS = (
    b"nan",
    b"inf",
    b"-1",
    b"1e400",
    b"[]",
    b"{}",
    b"null",
    b'"x"',
    b"9" * 30,
    b"\xff",
    b"[[[",
    b":",
    b",",
)


def damage(path: Path, read: Callable[[Path], Any], times: int) -> set[str]:
    """Spoil the file so many times, each time anew: what came of reading it, "read" or "named"
    (GhptDataError).
    """
    whole = path.read_bytes()
    chance = random.Random(0)
    outcomes = set()
    for _ in range(times):
        path.write_bytes(_spoilt(whole, chance))
        try:
            read(path)
            outcomes.add("read")
        except GhptDataError:
            outcomes.add("named")
    return outcomes


def _spoilt(whole: bytes, chance: random.Random) -> bytes:
    data = bytearray(whole)
    place = chance.randrange(len(data))
    kind = chance.choice(("byte", "digit", "word", "gap", "end"))
    if kind == "byte":
        data[place] = chance.randrange(256)
    elif kind == "digit":
        digits = [i for i, byte in enumerate(data) if chr(byte).isdigit()] or [place]
        data[chance.choice(digits)] = ord(chance.choice("0123456789"))
    elif kind == "word":
        data[place : place + chance.randrange(12)] = chance.choice(_WORDS)
    elif kind == "gap":
        del data[place : place + chance.randrange(1, 40)]
    else:
        del data[place:]
    return bytes(data)
