"""npz archives whose arrays are stored as they are: they are written and read in parts."""

import math
import re
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

_BLOCK = 1 << 20
_HEADER = re.compile(
    rb"\{'descr': '(?P<dtype>[<|][bifU]\d{1,7})', 'fortran_order': False, "
    rb"'shape': \((?P<shape>[\d, ]{0,99})\), \} *\n"
)


class Member(NamedTuple):
    """Where an array lies in the file: byte offset of its first value, and its form."""

    offset: int
    dtype: np.dtype
    shape: tuple[int, ...]


def add_member(
    archive: zipfile.ZipFile,
    name: str,
    dtype: np.dtype,
    shape: tuple[int, ...],
    content: IO[bytes] | bytes,
) -> None:
    """Write an array, given as its bytes or as a file of them.

    The same content gives the same bytes.
    """
    info = zipfile.ZipInfo(f"{name}.npy", date_time=(1980, 1, 1, 0, 0, 0))
    info.create_system = 3
    header = {"descr": np.lib.format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
    with archive.open(info, "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, header)
        if isinstance(content, bytes):
            member.write(content)
        else:
            shutil.copyfileobj(content, member, _BLOCK)


def members_of(path: Path) -> dict[str, Member]:
    """Where each array lies in the file. Raises ValueError or BadZipFile for anything but plain
    stored arrays.
    """
    size = path.stat().st_size
    with open(path, "rb") as handle, zipfile.ZipFile(handle) as archive:
        entries = archive.infolist()
        if any(
            e.compress_type != zipfile.ZIP_STORED or e.file_size != e.compress_size for e in entries
        ):
            raise ValueError("a member is compressed")
        if sum(e.file_size for e in entries) > size:
            raise ValueError("members overlap")
        if bad := archive.testzip():
            raise ValueError(f"{bad} does not fit its checksum")
        return {entry.filename.removesuffix(".npy"): _member_at(handle, entry) for entry in entries}


def _member_at(handle: IO[bytes], entry: zipfile.ZipInfo) -> Member:
    handle.seek(entry.header_offset + 26)
    lengths = np.frombuffer(handle.read(4), "<u2")
    start = entry.header_offset + 30 + int(lengths.sum())
    handle.seek(start)
    prefix = handle.read(10)
    header = handle.read(int.from_bytes(prefix[8:], "little"))
    parsed = _HEADER.fullmatch(header) if prefix[:8] == b"\x93NUMPY\x01\x00" else None
    if parsed is None:
        raise ValueError(f"{entry.filename} is no array of numbers or text")
    shape = tuple(int(length) for length in parsed["shape"].replace(b",", b" ").split())
    dtype = np.dtype(parsed["dtype"].decode())
    offset = start + len(prefix) + len(header)
    if math.prod(shape) * dtype.itemsize != start + entry.file_size - offset:
        raise ValueError(f"{entry.filename} does not hold what its header says")
    return Member(offset, dtype, shape)


def text_table(path: Path, members: Mapping[str, Member], name: str) -> tuple[str, ...]:
    """A one-dimensional array of text. Raises ValueError if it is none."""
    if name not in members or members[name].dtype.kind != "U":
        raise ValueError(f"there is no text {name}")
    member = members[name]
    count = int(np.prod(member.shape))
    return tuple(str(text) for text in np.fromfile(path, member.dtype, count, offset=member.offset))


def read_rows(path: Path, member: Member, start: int, stop: int) -> np.ndarray:
    """The rows of a member's first dimension from ``start`` up to ``stop``, and no others."""
    each = math.prod(member.shape[1:])
    offset = member.offset + start * each * member.dtype.itemsize
    return np.fromfile(path, member.dtype, (stop - start) * each, offset=offset).reshape(
        -1, *member.shape[1:]
    )
