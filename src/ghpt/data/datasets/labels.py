"""karfly's ``human36m-multiview-labels-GTbboxes.npy``: a pickle, read without running it.

A pickle names functions to call. The reader admits the four names that numpy's arrays need, and
none of them is numpy's: each stands for plain bookkeeping here, from which arrays are then built
with their sizes checked (numpy's own unpickling trusts the sizes and flags it is given).
"""

from __future__ import annotations

import math
import mmap
import pickle
import pickletools
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from ghpt.data.formats.validate import check_array, npy_header, open_input
from ghpt.errors import GhptDataError

LABELS_FILE = "human36m-multiview-labels-GTbboxes.npy"
_HINT = "Get the file again, or prepare it anew with karfly/learnable-triangulation-pytorch."
_MAX_OPCODES = 10_000
"""The real file needs a few hundred; its bulk is in arrays."""
_MAX_FIELDS = 32
_MAX_ITEM = 1 << 16
"""Bytes of one array element (a row of the table has 240)."""


@dataclass(frozen=True)
class Labels:
    """The labels of N frames of S subjects by C cameras, in the file's order."""

    path: Path
    subjects: tuple[str, ...]
    cameras: tuple[str, ...]
    actions: tuple[str, ...]
    """With the take: ``Greeting-2``."""
    K: Float[np.ndarray, "S C 3 3"]
    R: Float[np.ndarray, "S C 3 3"]
    t: Float[np.ndarray, "S C 3"]
    distortion: Float[np.ndarray, "S C 5"]
    subject: Int[np.ndarray, " N"]
    """Index into ``subjects`` of each frame."""
    action: Int[np.ndarray, " N"]
    frame: Int[np.ndarray, " N"]
    key_points: Float[np.ndarray, "N 17 3"]
    """World frame, mm, joints in the order of ``ghpt.skeleton.JOINTS``."""


def read_labels(path: Path) -> Labels:
    """Read and check a labels file.

    Raises GhptDataError if it is not what it should be or holds code.
    """
    content = _read_pickle(path)
    subjects = _names(path, "subject_names", content)
    cameras = _names(path, "camera_names", content)
    actions = _names(path, "action_names", content)
    rigs = _structured(path, "cameras", content, (len(subjects), len(cameras)))
    table = _structured(path, "table", content, (None,))
    subject = _column(table, "subject_idx", (None,), "iu")
    action = _column(table, "action_idx", (None,), "iu")
    _check_range(subject, table, "subject_idx", "subject_names", len(subjects))
    _check_range(action, table, "action_idx", "action_names", len(actions))
    return Labels(
        path=path,
        subjects=subjects,
        cameras=cameras,
        actions=actions,
        K=_column(rigs, "K", (None, None, 3, 3), "f"),
        R=_column(rigs, "R", (None, None, 3, 3), "f"),
        t=_column(rigs, "t", (None, None, 3, 1), "f")[..., 0],
        distortion=_column(rigs, "dist", (None, None, 5), "f"),
        subject=subject,
        action=action,
        frame=_column(table, "frame_idx", (None,), "iu"),
        key_points=_column(table, "keypoints", (None, 17, 3), "f"),
    )


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
        if depth > 3 or len(names or ()) > _MAX_FIELDS:
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
        if built.hasobject or not 0 < built.itemsize <= _MAX_ITEM:
            raise ValueError(f"{built.itemsize} bytes in an element, or Python objects in an array")
        return built


@dataclass
class _Array:
    """What a pickle says of a numpy array."""

    state: tuple[Any, ...] = field(default=())

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self.state = state

    def build(self) -> np.ndarray:
        """Raises ValueError, TypeError or KeyError if it makes no sense."""
        _, shape, dtype, fortran, data = self.state
        built = dtype.build()
        if len(shape) > 4 or math.prod(shape) * built.itemsize != len(data):
            raise ValueError(f"{len(data)} bytes do not make an array of shape {shape}")
        return np.frombuffer(data, built).reshape(shape, order="F" if fortran else "C")


_STAND_INS: dict[str, Callable[..., Any]] = {
    "numpy.dtype": lambda code, align=False, copy=True: _Dtype(code),
    "numpy.ndarray": lambda: None,  # only named, never called
    "numpy.core.multiarray._reconstruct": lambda kind, shape, code: _Array(),  # numpy 1
    "numpy._core.multiarray._reconstruct": lambda kind, shape, code: _Array(),  # numpy 2
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


def _read_pickle(path: Path) -> dict[str, Any]:
    """Return the pickled dict, its arrays still as `_Array`."""
    with open_input(path) as handle:
        _, _, dtype = npy_header(path, "", handle, path.stat().st_size, pickled=True)
        if not dtype.hasobject:
            raise GhptDataError(path, "", f"holds {dtype}, not a pickled dict", _HINT)
        with mmap.mmap(handle.fileno(), 0, access=mmap.ACCESS_READ) as data:
            try:
                data.seek(handle.tell())
                _check_opcodes(data)
                data.seek(handle.tell())
                content = _Unpickler(data, encoding="latin1").load()
                (content,) = content.state[4]
            except Exception as error:  # damaged pickles raise almost anything
                problem = f"is not a labels file ({error!s:.200})"
                raise GhptDataError(path, "", problem, _HINT) from error
    if not isinstance(content, dict):
        raise GhptDataError(path, "", f"holds a {type(content).__name__}, not a dict", _HINT)
    return content


def _check_opcodes(data: mmap.mmap) -> None:
    """Raise unless the pickle is short and plain, before any of it is carried out."""
    allowed = frozenset(_OPCODES.split())
    # mmap has the two methods that genops needs, which its annotation does not say
    opcodes = pickletools.genops(data)  # type: ignore[arg-type]
    for count, (opcode, argument, _) in enumerate(opcodes):
        if opcode.name not in allowed:
            raise pickle.UnpicklingError(f"it holds code: opcode {opcode.name}")
        memo = argument if opcode.name in ("PUT", "LONG_BINPUT") else 0
        if count > _MAX_OPCODES or int(memo or 0) > _MAX_OPCODES:
            raise pickle.UnpicklingError("it is too complicated")


def _names(path: Path, key: str, content: dict[str, Any]) -> tuple[str, ...]:
    names = content.get(key)
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise GhptDataError(path, key, "is not a list of names", _HINT)
    return tuple(names)


@dataclass(frozen=True)
class _Table:
    """A structured array of the file."""

    path: Path
    key: str
    array: np.ndarray


def _structured(
    path: Path,
    key: str,
    content: dict[str, Any],
    shape: tuple[int | None, ...],
) -> _Table:
    array = content.get(key)
    if not isinstance(array, _Array):
        raise GhptDataError(path, key, "is missing, or not an array", _HINT)
    try:
        built = array.build()
    except (ValueError, TypeError, KeyError, IndexError, AttributeError, OverflowError) as error:
        raise GhptDataError(path, key, f"is not a numpy array ({error})", _HINT) from error
    return _Table(path, key, check_array(path, key, built, shape, "V"))


def _column(table: _Table, name: str, shape: tuple[int | None, ...], kinds: str) -> np.ndarray:
    where = f"{table.key}[{name!r}]"
    if name not in (table.array.dtype.names or ()):
        raise GhptDataError(table.path, where, "is missing", _HINT)
    return check_array(table.path, where, table.array[name], shape, kinds)


def _check_range(
    index: Int[np.ndarray, " N"],
    table: _Table,
    name: str,
    names: str,
    count: int,
) -> None:
    """Raise GhptDataError unless every index is one of ``count`` names."""
    if len(index) and (index.min() < 0 or index.max() >= count):
        problem = f"goes from {index.min()} to {index.max()}, with {count} {names}"
        raise GhptDataError(table.path, f"{table.key}[{name!r}]", problem, _HINT)
