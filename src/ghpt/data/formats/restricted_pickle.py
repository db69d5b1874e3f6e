"""Pickles of numbers, read without running them.

A pickle names functions to call. The reader admits the names that numpy's arrays and numbers need,
and none of them is numpy's: each stands for plain bookkeeping here, from which arrays are then
built with their sizes checked (numpy's own unpickling trusts the sizes and flags it is given).
"""

from __future__ import annotations

import io
import math
import mmap
import pickle
import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_MOST_OPCODES = 10_000
"""Real files need a few hundred; their bulk is in arrays."""
_MOST_FIELDS = 32
_MOST_ITEM = 1 << 16
"""Bytes of one array element (a row of karfly's table has 240)."""

_Stream = io.BytesIO | mmap.mmap


def load_pickle(data: _Stream) -> Any:
    """Return what is pickled from where ``data`` stands: plain values, arrays as `PickledArray`.

    Raises an Exception, of whatever kind, for what is damaged or holds anything else.
    """
    start = data.tell()
    _check_opcodes(data)
    data.seek(start)
    return _Unpickler(data, encoding="latin1").load()


@dataclass
class _Dtype:
    """What a pickle says of a numpy dtype."""

    code: str
    state: tuple[Any, ...] = ()

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.state = state

    def build(self, depth: int = 0) -> np.dtype:
        """Raises ValueError, TypeError or KeyError if it makes no sense."""
        _, order, base, names, fields, size, *_ = self.state
        if depth > 3 or len(names or ()) > _MOST_FIELDS:
            raise ValueError("a dtype is nested too deep, or has too many fields")
        if base is not None:
            built = np.dtype((base[0].build(depth + 1), base[1]))
        elif names is not None:
            columns = [fields[name] for name in names]
            formats = [column[0].build(depth + 1) for column in columns]
            offsets = [column[1] for column in columns]
            built = np.dtype(
                {"names": list(names), "formats": formats, "offsets": offsets, "itemsize": size}
            )
        else:
            built = np.dtype(str(self.code)).newbyteorder(order if order in ("<", ">") else "=")
        if built.hasobject or not 0 < built.itemsize <= _MOST_ITEM:
            raise ValueError(f"{built.itemsize} bytes in an element, or Python objects in an array")
        return built


@dataclass
class PickledArray:
    """What a pickle says of a numpy array."""

    state: tuple[Any, ...] = field(default=())

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.state = state

    def build(self) -> np.ndarray:
        """Return the array. Raises ValueError if it makes no sense."""
        try:
            return self._build()
        except (TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
            raise ValueError(str(error)) from error

    def _build(self) -> np.ndarray:
        _, shape, dtype, fortran, data = self.state
        built = dtype.build()
        if len(shape) > 4 or math.prod(shape) * built.itemsize != len(data):
            raise ValueError(f"{len(data)} bytes do not make an array of shape {shape}")
        return np.frombuffer(data, built).reshape(shape, order="F" if fortran else "C")


def _scalar(dtype: Any, data: bytes) -> PickledArray:
    return PickledArray((1, (), dtype, False, data))


_STAND_INS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": lambda code, align=False, copy=True: _Dtype(code),
    "numpy.ndarray": lambda: None,  # only named, never called
    "numpy.core.multiarray._reconstruct": lambda kind, shape, code: PickledArray(),  # numpy 1
    "numpy._core.multiarray._reconstruct": lambda kind, shape, code: PickledArray(),  # numpy 2
    "numpy.core.multiarray.scalar": _scalar,
    "numpy._core.multiarray.scalar": _scalar,
    "_codecs.encode": lambda text, encoding: text.encode("latin1"),  # bytes, in protocol 2
}
_OPCODES = """
    PROTO FRAME STOP MARK MEMOIZE PUT BINPUT LONG_BINPUT GET BINGET LONG_BINGET GLOBAL
    STACK_GLOBAL REDUCE BUILD NONE NEWTRUE NEWFALSE INT BININT BININT1 BININT2 LONG1 FLOAT
    BINFLOAT STRING BINSTRING SHORT_BINSTRING UNICODE SHORT_BINUNICODE BINUNICODE BINUNICODE8
    SHORT_BINBYTES BINBYTES BINBYTES8 EMPTY_TUPLE TUPLE1 TUPLE2 TUPLE3 TUPLE EMPTY_LIST LIST
    APPEND APPENDS EMPTY_DICT DICT SETITEM SETITEMS POP
"""
"""Those that build plain data. Not among them: making instances, extension codes, references to
outside.
"""


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Callable[..., Any]:
        stand_in = _STAND_INS.get(f"{module}.{name}")
        if stand_in is None:
            raise pickle.UnpicklingError(f"it holds code: it names {module}.{name}")
        # a new one each time: a pickle can set attributes of what it names
        return lambda *args: stand_in(*args)


def _check_opcodes(data: _Stream) -> None:
    """Raise unless the pickle is short and plain, before any of it is carried out."""
    allowed = frozenset(_OPCODES.split())
    # genops needs the two methods that a stream has here, which its annotation does not say
    opcodes = pickletools.genops(data)  # type: ignore[arg-type]
    for count, (opcode, argument, _) in enumerate(opcodes):
        if opcode.name not in allowed:
            raise pickle.UnpicklingError(f"it holds code: opcode {opcode.name}")
        memo = argument if opcode.name in ("PUT", "LONG_BINPUT") else 0
        if count > _MOST_OPCODES or int(memo or 0) > _MOST_OPCODES:
            raise pickle.UnpicklingError("it is too complicated")
