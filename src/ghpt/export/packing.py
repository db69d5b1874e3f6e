"""Arrays in few letters, for a page: 16-bit steps, their differences over time, deflated."""

from __future__ import annotations

import base64
import zlib
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

_MISSING = 65535
_LARGEST = _MISSING - 1
_LEVEL = 6


@dataclass(frozen=True)
class Packed:
    """An array [T, ...] as `unpack` of player.js reads it."""

    data: str
    """Base64 of a deflated block: the low bytes of all numbers, then the high ones; each number
    is the difference from that of the frame before, modulo 65536.
    """
    row: int
    """Numbers in a frame."""
    step: float | None = None
    """None: the numbers are as they are; else they count steps from ``offset``, and 65535 is a
    missing one.
    """
    offset: float | None = None

    def plain(self) -> dict[str, Any]:
        """Return the fields that are given, as plain data."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def pack_integers(values: Int[np.ndarray, "T ..."]) -> Packed:
    """Return numbers from 0 to 65535."""
    return _pack(values.astype(np.uint16))


def pack_floats(values: Float[np.ndarray, "T ..."], step: float) -> Packed:
    """Return numbers rounded to ``step``, or where they are too far apart to a larger one.

    What is not finite is missing. Outliers are moved to the border of the range, which is three
    times as wide as that of all but 0.2 % of the numbers.
    """
    finite = np.isfinite(values)
    offset, highest = _range(values[finite])
    step = max(step, (highest - offset) / _LARGEST)
    steps = np.rint((np.where(finite, values, offset).clip(offset, highest) - offset) / step)
    packed = _pack(np.where(finite, steps, _MISSING).astype(np.uint16))
    return Packed(packed.data, packed.row, step, offset)


def _range(known: Float[np.ndarray, " N"]) -> tuple[float, float]:
    if not known.size:
        return 0.0, 0.0
    low, high = np.quantile(known, [0.001, 0.999])
    width = high - low
    return float(max(known.min(), low - width)), float(min(known.max(), high + width))


def _pack(numbers: np.ndarray) -> Packed:
    rows = numbers.reshape(len(numbers), -1)
    changes = np.diff(rows, axis=0, prepend=np.zeros_like(rows[:1]))
    low = (changes & 255).astype(np.uint8).tobytes()
    high = (changes >> 8).astype(np.uint8).tobytes()
    text = base64.b64encode(zlib.compress(low + high, _LEVEL)).decode()
    return Packed(text, rows.shape[1])
