"""Our own npz file of key points (docs/calibration.md says what it holds)."""

from __future__ import annotations

import io
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from ghpt.data.formats.skeletons import recognise
from ghpt.data.formats.validate import (
    Shape,
    check_view_count,
    finite_points,
    frame_rate,
    npy_header,
    open_input,
    read_npz,
)
from ghpt.data.people.detections import Detections, joints_for
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError
from ghpt.files import atomic_write

_MOST_MEMBERS = 1000
_OFFICE = frozenset(("[Content_Types].xml", "mimetype"))
"""Of which one is in the archive that a spreadsheet is."""
_LONGEST_NAMES = 1 << 20
"""Bytes of a list of texts."""


def write_key_points(
    path: str | Path,
    views: Sequence[str],
    joints: Sequence[str],
    frame: Int[np.ndarray, " T"],
    points: KeyPoints,
    rate_hz: float | None = None,
) -> None:
    """Write one person's key points [T V K] as the npz file that ``read_key_points`` reads."""
    # Any: numpy's types take any of the names for its option allow_pickle
    arrays: dict[str, Any] = {
        "key_points": points.pixels,
        "views": np.array(views, dtype=np.str_),
        "joints": np.array(joints, dtype=np.str_),
        "frame": frame,
        "confidence": points.confidence,
        "seen": points.valid,
    }
    if rate_hz is not None:
        arrays["rate_hz"] = np.array(rate_hz)
    with atomic_write(path) as handle:
        # zip's check sums guard the values but not the list of names, where damage may hide what
        # comes after it
        np.savez_compressed(handle, members=np.array(sorted(arrays)), **arrays)


def read_own(path: Path, skeleton: str | None) -> Detections:
    """Return the one person of our npz file; ``skeleton`` overrules what it says.

    Raises GhptDataError.
    """
    members = _members(path)
    _check_members(path, members)
    pixels = read_npz(path, {"key_points": ((None, None, None, 2), "f")})["key_points"]
    pixels = pixels.astype(np.float64)
    frames, view_count, joint_count, _ = pixels.shape
    check_view_count(path, view_count)
    arrays = _read_optional(path, members, pixels.shape[:3])
    finite = finite_points(pixels)
    valid = finite & arrays.get("seen", finite)
    pixels = np.where(valid[..., None], pixels, 0)
    views = _texts(path, "views")
    check_names(path, "views", views, view_count)
    if skeleton is None and "skeleton" in members:
        skeleton = _texts(path, "skeleton")[0]
    if skeleton is None and "joints" in members:
        joints = _texts(path, "joints")
    else:
        people = pixels.reshape(-1, joint_count, 2)
        name = skeleton or recognise(path, people, valid.reshape(-1, joint_count))
        joints = joints_for(path, name, joint_count)
    check_names(path, "joints", joints, joint_count)
    confidence = arrays.get("confidence", np.ones(valid.shape)).astype(np.float64)
    confidence = np.nan_to_num(confidence).clip(0, 1)
    frame = arrays.get("frame", np.arange(frames)).astype(np.int64)
    if not frames or (np.diff(frame) <= 0).any():
        problem = "is empty, or does not rise"
        raise GhptDataError(path, "frame", problem, "Number the frames in order.")
    rate = arrays.get("rate_hz")
    rate_hz = None if rate is None else frame_rate(path, float(rate))
    points = KeyPoints(pixels, np.where(valid, confidence, 0), valid)
    return Detections.of_person(path, views, joints, frame, points, rate_hz)


def check_names(path: Path, field: str, names: tuple[str, ...], expected: int) -> None:
    """Raise GhptDataError unless there are so many names, all different."""
    if len(names) != expected or len(set(names)) != len(names):
        problem = f"names {len(names)} for {expected} of key_points, or one twice"
        raise GhptDataError(path, field, problem, "Give each a name of its own.")


def _read_optional(path: Path, members: set[str], shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    """Return the arrays that a file may lack, of these frames, views and joints."""
    forms: dict[str, tuple[Shape, str]] = {
        "confidence": (shape, "f"),
        "seen": (shape, "b"),
        "frame": (shape[:1], "iu"),
        "rate_hz": ((), "fiu"),
    }
    return read_npz(path, {field: form for field, form in forms.items() if field in members})


def _check_members(path: Path, members: set[str]) -> None:
    for field in ("key_points", "views"):
        if field not in members:
            hint = "See docs/calibration.md for what the file holds."
            raise GhptDataError(path, field, "is missing", hint)
    if "members" in members and members - {"members"} != {*_texts(path, "members")}:
        problem = "are others than when it was written"
        raise GhptDataError(path, "members", problem, "Write it again.")


_DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError)
"""What zipfile raises for a damaged archive, or one of a kind that it does not know."""


def _members(path: Path) -> set[str]:
    try:
        with open_input(path) as handle:
            handle.seek(-min(path.stat().st_size, 1 << 16), io.SEEK_END)
            ending = handle.read().rpartition(b"PK\x05\x06")[2]
        # before zipfile makes an object of each
        if (count := int.from_bytes(ending[6:8], "little")) > _MOST_MEMBERS:
            raise GhptDataError(path, "", f"holds {count} arrays or more", "Write it again.")
        with zipfile.ZipFile(path) as archive:
            names = archive.namelist()
    except _DAMAGED as error:
        raise GhptDataError(
            path, "", f"is not a whole npz file ({error})", "Write it again."
        ) from error
    _check_archive(path, names)
    return {name.removesuffix(".npy") for name in names}


def _check_archive(path: Path, names: Sequence[str]) -> None:
    """Raise GhptDataError for an archive of files that are no arrays."""
    if any(name.endswith(".npy") for name in names):
        return
    if _OFFICE.intersection(names):
        hint = "Save each sheet as CSV, as the tool wrote it, and name the folder of these."
        raise GhptDataError(path, "", "is a spreadsheet, not key points", hint)
    listed = ", ".join(names[:3]) or "nothing"
    hint = "Unpack it and name the folder."
    raise GhptDataError(path, "", f"is an archive of files ({listed}), not of arrays", hint)


def _texts(path: Path, field: str) -> tuple[str, ...]:
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{field}.npy") as member:
            size = archive.getinfo(f"{field}.npy").file_size
            shape, _, dtype = npy_header(path, field, member, size)
            if dtype.kind != "U" or len(shape) > 1 or size > _LONGEST_NAMES:
                hint = "Write it with numpy.array([...], dtype=str)."
                raise GhptDataError(path, field, "is not a list of texts", hint)
            return tuple(map(str, np.frombuffer(member.read(), dtype).reshape(-1)))
    except (*_DAMAGED, UnicodeError) as error:
        raise GhptDataError(path, field, f"is damaged ({error})", "Write it again.") from error
