"""Checks of users' cameras, arrays and files; each error names the file, the field, the problem
and the hint.

No reader here allocates what a file only claims to hold: sizes are compared with the file's own
first.
"""

from __future__ import annotations

import codecs
import io
import json
import math
import unicodedata
import warnings
import zipfile
import zlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
import torch

from ghpt.errors import GhptDataError
from ghpt.geometry.cameras import Cameras

Shape = tuple[int | None, ...]
"""An expected shape; None stands for any size."""

_MAX_HEADER = 10_000
"""Bytes of an npy header; numpy's own limit."""
LARGE_JSON = 64 << 20
"""Bytes of a JSON file that holds a recording."""
SMALL_JSON = 4 << 20
"""Bytes of a JSON file that holds a rig's cameras, or one frame."""
_MOST_OBJECTS = 400_000
_MOST_LISTS = 1_500_000
_MOST_VALUES = 12_000_000
"""In a JSON file of ``LARGE_JSON`` bytes: each costs up to a hundred times as many bytes of memory
as of the file.
"""
_RATES = (1e-3, 1e5)
"""Frames per second, from a time lapse to the fastest camera."""
MOST_VIEWS = 1000
"""Cameras of a rig, or views of a recording."""
_MAX_MEMBER = 1 << 28
"""Bytes of one array in an npz, unpacked."""


def check_cameras(
    where: object, names: Sequence[str], K: Any, R: Any, t: Any, distortion: Any
) -> tuple[Cameras, np.ndarray]:
    """V users' cameras (K [V 3 3] pixels, R [V 3 3] and t [V 3] world to camera in mm) and their
    distortion [V C].

    R that is off by rounding (1e-9 to 1e-3) becomes the nearest rotation. Raises GhptDataError for
    fewer than two views, a camera listed twice, and values that are not finite or no pinhole
    camera.
    """
    check_names(where, names)
    views = len(names)
    expected: dict[str, Shape] = {
        "K": (views, 3, 3),
        "R": (views, 3, 3),
        "t": (views, 3),
        "distortion": (views, None),
    }
    arrays = {
        field: check_array(where, field, np.asarray(value), expected[field], "fiu").astype(
            np.float64
        )
        for field, value in zip(expected, (K, R, t, distortion), strict=True)
    }
    for index, name in enumerate(names):
        for field, array in arrays.items():
            if not np.isfinite(array[index]).all():
                problem = "holds a value that is not finite"
                raise GhptDataError(
                    where, f"camera {name}, {field}", problem, "Calibrate this camera again."
                )
        _check_intrinsics(where, name, arrays["K"][index])
        arrays["R"][index] = _rotation(where, name, arrays["R"][index])
    return Cameras(*(torch.from_numpy(arrays[field]) for field in ("K", "R", "t"))), arrays[
        "distortion"
    ]


def _check_intrinsics(where: object, name: str, K: np.ndarray) -> None:
    if not (K[0, 0] > 0 and K[1, 1] > 0):
        problem = f"the focal lengths are {K[0, 0]:g} and {K[1, 1]:g} pixels; they must be positive"
        raise GhptDataError(where, f"camera {name}, K", problem, "Calibrate this camera again.")
    if K[1, 0] != 0 or not np.array_equal(K[2], (0, 0, 1)):
        problem = "is not of the form [[fx s cx] [0 fy cy] [0 0 1]]"
        raise GhptDataError(where, f"camera {name}, K", problem, "Check that K was not transposed.")


def _rotation(where: object, name: str, R: np.ndarray) -> np.ndarray:
    error = np.abs(R @ R.T - np.eye(3)).max()
    det = np.linalg.det(R)
    if error > 1e-3 or det < 0:
        problem = f"R is not a rotation (|R R^T - I| = {error:.3g}, det = {det:.3g})"
        hint = (
            "R must be the 3x3 world-to-camera rotation: "
            "without scale, not mirrored, not a Rodrigues vector."
        )
        raise GhptDataError(where, f"camera {name}, R", problem, hint)
    if error < 1e-9:
        return R
    U, _, Vh = np.linalg.svd(R)
    return U @ Vh


def check_names(
    where: object, names: Sequence[object], available: Sequence[object] | None = None
) -> None:
    """Raise GhptDataError for fewer than two cameras, a camera listed twice, or one that is not
    ``available``.
    """
    counts = Counter(map(repr, names))
    for name in names:
        if counts[repr(name)] > 1:
            problem = f"camera {name} is listed twice"
            raise GhptDataError(where, "cameras", problem, "List each camera once.")
        if available is not None and name not in available:
            there = ", ".join(map(str, available))
            raise GhptDataError(
                where, "cameras", f"there is no camera {name}", f"There are: {there}."
            )
    if len(names) < 2:
        problem = f"{len(names)} camera(s) listed; triangulation needs at least two"
        raise GhptDataError(where, "cameras", problem, "List more cameras.")


def check_view_count(where: object, count: int) -> None:
    """Raise GhptDataError for more than ``MOST_VIEWS`` cameras or views, before anything is made of
    them.
    """
    if count > MOST_VIEWS:
        problem = f"holds more than {MOST_VIEWS} cameras or views"
        raise GhptDataError(where, "", problem, "Check that this is the right file.")


def frame_rate(where: object, value: float | int) -> float | None:
    """A frame rate in frames per second; None for NaN, which our own files write where it is
    unknown.

    Raises GhptDataError for a rate that no camera has: 0, negative, infinite, or beyond ``_RATES``.
    """
    rate = float(value)
    if math.isnan(rate):
        return None
    slowest, fastest = _RATES
    if not slowest <= rate <= fastest:
        problem = f"is {rate:g}, not between {slowest:g} and {fastest:g} frames per second"
        raise GhptDataError(where, "rate_hz", problem, "Give the true rate: rate_hz=60, say.")
    return rate


def read_flag(where: object, field: str, value: object) -> bool:
    """Return a file's true or false, which may be written 1 or 0. Raises GhptDataError."""
    if type(value) is bool or (type(value) is int and value in (0, 1)):
        return bool(value)
    raise GhptDataError(where, field, f"is {value!r}, not true or false", "Write true or false.")


def read_name(where: object, field: str, value: object) -> str:
    """Return a file's name of a camera, which may be a number. Raises GhptDataError."""
    if type(value) is int or (isinstance(value, str) and value.strip()):
        return unicodedata.normalize("NFC", str(value))
    raise GhptDataError(where, field, f"is {value!r}, not a name", "Give each camera a name.")


def numbers_in(value: object) -> np.ndarray | None:
    """A number, a list of numbers or lists of lists of them as float64, in the list's own shape.

    None for anything else: ``true`` and ``"900"`` are no numbers, and lists of unequal lengths no
    array.
    """
    if isinstance(value, np.ndarray):
        return value.astype(np.float64) if value.dtype.kind in "fiu" else None
    if not _all_numbers(value):
        return None
    try:
        return np.array(value, dtype=np.float64)
    except (ValueError, OverflowError):
        return None


def _all_numbers(value: object, depth: int = 3) -> bool:
    """Return whether all that is in lists, of at most this depth, is a number."""
    if isinstance(value, list | tuple):
        return depth > 0 and all(_all_numbers(item, depth - 1) for item in value)
    return type(value) in (int, float)


def check_array(
    where: object, field: str, array: np.ndarray, shape: Shape, kinds: str
) -> np.ndarray:
    """``array`` itself, if it has this shape and its dtype is of these numpy kinds; else
    GhptDataError.
    """
    _check_form(where, field, array.shape, array.dtype, shape, kinds)
    return array


def finite_points(pixels: np.ndarray) -> np.ndarray:
    """Return which points [..., 2] have two finite coordinates."""
    return np.asarray(np.isfinite(pixels).all(-1))


def read_npy(path: Path, shape: Shape, kinds: str) -> np.ndarray:
    """Return a read-only memory map of an npy file.

    Raises GhptDataError unless it holds exactly an array of this form.
    """
    with open_input(path) as handle:
        found, order, dtype = npy_header(path, "", handle, path.stat().st_size)
        offset = handle.tell()
    _check_form(path, "", found, dtype, shape, kinds)
    if math.prod(found) == 0:
        return np.empty(found, dtype)
    return np.asarray(np.memmap(path, dtype, "r", offset, found, order=order))


def read_npz(path: Path, fields: dict[str, tuple[Shape, str]]) -> dict[str, np.ndarray]:
    """Return the named arrays of an npz file. Raises GhptDataError unless all have these forms."""
    arrays = {}
    try:
        with open_input(path) as handle, zipfile.ZipFile(handle) as archive:
            for field, (shape, kinds) in fields.items():
                size = min(archive.getinfo(f"{field}.npy").file_size, _MAX_MEMBER)
                with archive.open(f"{field}.npy") as member:
                    found, order, dtype = npy_header(path, field, member, size)
                    _check_form(path, field, found, dtype, shape, kinds)
                    flat = np.frombuffer(member.read(), dtype)
                    arrays[field] = flat.reshape(found, order=order)
    except KeyError as error:
        raise GhptDataError(
            path, "", f"lacks an array: {error}", f"It must hold {', '.join(fields)}."
        ) from error
    # zipfile raises NotImplementedError for a compression that it does not know, RuntimeError for
    # encryption
    except (
        zipfile.BadZipFile,
        zlib.error,
        EOFError,
        OSError,
        NotImplementedError,
        RuntimeError,
    ) as error:
        raise GhptDataError(
            path, "", f"is not a whole npz file ({error})", "Write it again."
        ) from error
    return arrays


def read_json(path: Path, largest: int = LARGE_JSON, nan: bool = False) -> Any:
    """The content of a JSON file of at most ``largest`` bytes.

    Raises GhptDataError for a file that is larger or holds more values than any of its kind, and
    for one with Infinity, NaN, or a key that is there twice: of two cameras with one name, one
    would be lost. ``nan`` admits NaN, which programs write for what is missing.
    """
    with open_input(path) as handle:
        data = handle.read(largest + 1)
    hint = "Check that this is the right file."
    if len(data) > largest:
        raise GhptDataError(path, "", f"has more than {largest >> 20} MiB", hint)
    # before they are made: a file of 64 MiB could ask for 2 GiB of memory
    for sign, of_largest in ((b"{", _MOST_OBJECTS), (b"[", _MOST_LISTS), (b",", _MOST_VALUES)):
        most = of_largest * largest // LARGE_JSON
        if data.count(sign) > most:
            raise GhptDataError(path, "", f"holds more than {most} times {sign.decode()!r}", hint)

    def constant_value(constant: str) -> float:
        if nan and constant == "NaN":
            return math.nan
        raise ValueError(f"{constant} is no JSON number")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) != len(pairs):
            name = next(key for key, count in Counter(key for key, _ in pairs).items() if count > 1)
            raise ValueError(f"{name!r} is there twice in an object")
        return found

    try:
        return json.loads(data, parse_constant=constant_value, object_pairs_hook=unique)
    except (ValueError, RecursionError) as error:
        raise GhptDataError(
            path, "", f"is not valid JSON ({error})", "Get the file again."
        ) from error


def open_input(path: Path) -> io.BufferedReader:
    """Open a user's file for reading. Raises GhptDataError if that cannot be done."""
    try:
        return open(path, "rb")
    except FileNotFoundError as error:
        raise GhptDataError(
            path, "", "there is no such file", "Check the path and the data's layout."
        ) from error
    except OSError as error:
        raise GhptDataError(
            path, "", f"cannot be read ({error.strerror})", "Check its permissions."
        ) from error


def opening(start: bytes) -> str:
    """Return the text that a file begins with; without an encoding's mark it is UTF-8."""
    marks = (
        (codecs.BOM_UTF8, "utf-8"),
        (codecs.BOM_UTF16_LE, "utf-16-le"),
        (codecs.BOM_UTF16_BE, "utf-16-be"),
    )
    for mark, encoding in marks:
        if start.startswith(mark):
            return start[len(mark) :].decode(encoding, "replace").lstrip()
    return start.decode("utf-8", "replace").lstrip()


def _check_form(
    where: object, field: str, found: tuple[int, ...], dtype: np.dtype, shape: Shape, kinds: str
) -> None:
    if len(found) != len(shape) or any(
        b not in (None, a) for a, b in zip(found, shape, strict=True)
    ):
        expected = " x ".join("any" if size is None else str(size) for size in shape)
        problem = f"has shape {' x '.join(map(str, found))} instead of {expected}"
        raise GhptDataError(where, field, problem, "Check how it was written.")
    if dtype.kind not in kinds:
        names = {
            "f": "floating-point numbers",
            "i": "integers",
            "u": "integers",
            "b": "booleans",
            "V": "records",
        }
        expected = " or ".join(dict.fromkeys(names[kind] for kind in kinds))
        raise GhptDataError(
            where, field, f"holds {dtype}, not {expected}", "Check how it was written."
        )


def npy_header(
    where: object,
    field: str,
    handle: IO[bytes] | zipfile.ZipExtFile,
    size: int,
    pickled: bool = False,
) -> tuple[tuple[int, ...], Literal["C", "F"], np.dtype]:
    """Return shape, order and dtype of the npy array in ``handle``, which then stands at its data.

    Raises GhptDataError unless what follows is as long as the header claims (``size`` counts from
    the start).
    """
    hint = "Write it with numpy.save, or copy it again."
    start = handle.read(12)
    major = start[6] if start.startswith(b"\x93NUMPY") and len(start) == 12 else 0
    if major not in (1, 2):
        raise GhptDataError(where, field, "is not a numpy array file (npy 1.0 or 2.0)", hint)
    if int.from_bytes(start[8 : 10 if major == 1 else 12], "little") > _MAX_HEADER:
        raise GhptDataError(where, field, f"has a header of more than {_MAX_HEADER} bytes", hint)
    handle.seek(8)
    read = (
        np.lib.format.read_array_header_1_0 if major == 1 else np.lib.format.read_array_header_2_0
    )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            shape, fortran, dtype = read(handle)
    except Exception as error:  # numpy lets through whatever Python's parser raises
        raise GhptDataError(where, field, "has a damaged header", hint) from error
    left = size - handle.tell()
    if dtype.hasobject and not pickled:
        raise GhptDataError(where, field, "holds Python objects, which can run code", hint)
    if any(n < 0 for n in shape) or (
        not dtype.hasobject and math.prod(shape) * dtype.itemsize != left
    ):
        claimed = math.prod(shape) * dtype.itemsize
        problem = f"claims {claimed} bytes of {dtype} and holds {left}: it is truncated or damaged"
        raise GhptDataError(where, field, problem, hint)
    return shape, "F" if fortran else "C", dtype
