"""poses.npz: all of a reconstruction as plain arrays, written and read in parts."""

from __future__ import annotations

import json
import tempfile
import zipfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import EllipsisType
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

from ghpt.data.formats.stored_npz import Member, add_member, members_of, read_rows, text_table
from ghpt.errors import GhptDataError
from ghpt.export.stream import PIECE, Chunks, pieces
from ghpt.files import atomic_write
from ghpt.geometry.masking import where
from ghpt.reconstruction import FILE_STATES, About, Reconstruction, State
from ghpt.skeleton import HUMAN36M, JOINTS, NamePair

FORMAT_VERSION = 3
_POINTS = {1: "<f4", 2: "<f8", 3: "<f8"}
"""How each version that is read stores positions; the first had few digits far from the zero."""
_WITH_SUPPORTED = 3
"""The first version that has the state SUPPORTED, as number 1; before, the others had one less."""
_MORE = "more_"
"""Begins the names of the arrays of what is behind the 17 joints."""
_HINT = "Predict this recording again, or copy the file again"
_FORMAT = "ghpt reconstruction"


@dataclass(frozen=True)
class _Array:
    """One array of the file, and the field of ``Reconstruction`` that it holds."""

    name: str
    field: str
    dtype: str
    row: tuple[int, ...]
    """Shape of one frame."""
    joints: tuple[EllipsisType | slice, ...] = (...,)
    """Which values of the field it holds."""


def _layout(
    views: int, joints: int, more: int, version: int = FORMAT_VERSION
) -> tuple[_Array, ...]:
    """Return the arrays with a row for each frame.

    ``more``: key points behind the joints, which have arrays of their own.
    """
    arrays = _joint_arrays("", views, slice(0, joints), joints, version)
    if more:
        arrays += _joint_arrays(_MORE, views, slice(joints, joints + more), more, version)
    return (
        _Array("frame", "frame", "<i8", ()),
        *arrays,
        _Array("score", "score", "<f4", ()),
        _Array("swapped", "flipped", "|b1", (views,)),
    )


def _joint_arrays(
    prefix: str, views: int, chosen: slice, count: int, version: int
) -> tuple[_Array, ...]:
    rows = (slice(None), chosen)
    by_view = (slice(None), slice(None), chosen)
    return (
        _Array(f"{prefix}points", "points", _POINTS[version], (count, 3), rows),
        _Array(f"{prefix}state", "state", "|i1", (count,), rows),
        _Array(f"{prefix}error", "error", "<f4", (count,), rows),
        _Array(f"{prefix}views", "views", "|b1", (views, count), by_view),
        _Array(f"{prefix}covariance", "covariance", "<f4", (count, 6), rows),
    )


def _joint_count(joints: Sequence[str]) -> int:
    """Return how many of the joints the arrays without a prefix hold.

    They are the 17, where these come first, so that who reads 17 joints finds them; else all.
    """
    return len(JOINTS) if tuple(joints[: len(JOINTS)]) == JOINTS else len(joints)


@dataclass(frozen=True)
class _Meta:
    """The text ``meta`` of a file, as JSON: what is no array of a row for each frame."""

    format: str
    format_version: int
    unit: str
    name: str
    source: str
    estimator: str
    rate_hz: float | None
    smoothed: bool
    provenance: dict[str, Any]
    origin: tuple[float, float, float]
    world: str
    bones: tuple[NamePair, ...]
    states: dict[str, int]

    @classmethod
    def describe(cls, about: About) -> _Meta:
        return cls(
            format=_FORMAT,
            format_version=FORMAT_VERSION,
            unit="mm",
            name=about.name,
            source=about.source,
            estimator=about.estimator,
            rate_hz=about.rate_hz,
            smoothed=about.smoothed,
            provenance=about.provenance,
            origin=about.origin,
            world=about.world,
            bones=about.bones,
            states={state.name.lower(): int(state) for state in FILE_STATES},
        )


def write_npz(path: Path, about: About, chunks: Chunks) -> None:
    """Write all fields of ``Reconstruction`` and ``About`` (docs/outputs.md).

    Positions are NaN where missing; errors and covariances where not observed. Stored without
    compression: numpy reads it, in parts too. The same content gives the same bytes.
    """
    first = _joint_count(about.joints)
    layout = _layout(len(about.camera_names), first, len(about.joints) - first)
    meta = json.dumps(asdict(_Meta.describe(about)), allow_nan=False)
    rate_hz = np.nan if about.rate_hz is None else about.rate_hz
    tables = {
        "joints": np.array(about.joints[:first], np.str_),
        "camera_names": np.array(about.camera_names, np.str_),
        "rate_hz": np.array(rate_hz, "<f8"),
        "unit": np.array("mm"),
        "meta": np.array(meta),
    }
    if about.joints[first:]:
        tables[f"{_MORE}joints"] = np.array(about.joints[first:], np.str_)
    with atomic_write(path, verify=read_reconstruction) as handle, ExitStack() as stack:
        # Files without a name: nothing of them is left behind, however the process ends.
        spools: list[IO[bytes]] = []
        for _ in layout:
            spools.append(stack.enter_context(tempfile.TemporaryFile(dir=path.parent)))
        count = 0
        for piece in pieces(path, about, chunks):
            count += len(piece)
            masked = _mask_missing(piece)
            for array, spool in zip(layout, spools, strict=True):
                value = getattr(masked, array.field)[array.joints].numpy()
                spool.write(value.astype(array.dtype).tobytes())
        with zipfile.ZipFile(handle, "w") as archive:
            for array, spool in zip(layout, spools, strict=True):
                spool.seek(0)
                shape = (count, *array.row)
                add_member(archive, array.name, np.dtype(array.dtype), shape, spool)
            for name, table in tables.items():
                add_member(archive, name, table.dtype, table.shape, table.tobytes())


def _mask_missing(piece: Reconstruction) -> Reconstruction:
    """Return the frames on the CPU, with NaN for what is not known."""
    piece = Reconstruction(**{name: value.cpu() for name, value in vars(piece).items()})
    observed = piece.is_measured
    return replace(
        piece,
        points=where(piece.has_position, piece.points, torch.nan),
        error=where(observed, piece.error, torch.nan),
        covariance=where(observed, piece.covariance, torch.nan),
    )


def read_reconstruction(
    path: str | Path,
    size: int = PIECE,
) -> tuple[About, Iterator[Reconstruction]]:
    """Read what ``write_npz`` wrote, at most ``size`` frames at a time.

    Nothing in the file is executed or unpacked. Raises GhptDataError if it is missing, damaged
    (every byte is compared with its checksum), of another version, or if its arrays do not belong
    together.
    """
    path = Path(path)
    file = _open(path)
    starts = range(0, file.frames, size)
    about = About(
        name=file.meta.name,
        source=file.meta.source,
        estimator=file.meta.estimator,
        joints=(*file.joints, *file.more_joints),
        camera_names=file.camera_names,
        rate_hz=file.meta.rate_hz,
        smoothed=file.meta.smoothed,
        provenance=file.meta.provenance,
        origin=file.meta.origin,
        world=file.meta.world,
        bones=file.meta.bones,
    )
    return about, (file.read(start, min(start + size, file.frames)) for start in starts)


@dataclass(frozen=True)
class _File:
    """An opened file whose arrays fit one another."""

    path: Path
    members: dict[str, Member]
    joints: tuple[str, ...]
    more_joints: tuple[str, ...]
    camera_names: tuple[str, ...]
    meta: _Meta
    frames: int

    @property
    def layout(self) -> tuple[_Array, ...]:
        version = self.meta.format_version
        return _layout(len(self.camera_names), len(self.joints), len(self.more_joints), version)

    def check_layout(self) -> None:
        """Raise GhptDataError unless all arrays are there, of their types and shapes."""
        for array in self.layout:
            shape = (self.frames, *array.row)
            member = self.members.get(array.name)
            if member is None or member[1:] != (np.dtype(array.dtype), shape):
                problem = f"is not {array.dtype} of shape {shape}"
                raise GhptDataError(self.path, array.name, problem, _HINT)

    def read(self, start: int, stop: int) -> Reconstruction:
        """Read the frames from position ``start`` up to ``stop``."""
        parts: dict[str, list[Tensor]] = {}
        for array in self.layout:
            values = read_rows(self.path, self.members[array.name], start, stop)
            parts.setdefault(array.field, []).append(torch.from_numpy(values))
        rows = {
            field: values[0] if len(values) == 1 else torch.cat(values, _JOINT_AXIS[field])
            for field, values in parts.items()
        }
        piece = Reconstruction(**rows)
        if self.meta.format_version < _WITH_SUPPORTED:
            piece = replace(
                piece, state=piece.state + (piece.state > State.OBSERVED).to(torch.int8)
            )
        unknown = (piece.state < 0) | (piece.state > max(FILE_STATES))
        if unknown.any():
            raise GhptDataError(self.path, "state", "holds a number that is no state", _HINT)
        if not piece.points[piece.has_position].isfinite().all():
            problem = "a joint that is not missing has no position"
            raise GhptDataError(self.path, "points", problem, _HINT)
        return replace(
            piece,
            points=piece.points.nan_to_num(0.0, 0.0, 0.0).double(),
            error=piece.error.nan_to_num(0.0, 0.0, 0.0),
            covariance=piece.covariance.nan_to_num(0.0, 0.0, 0.0),
        )


def _open(path: Path) -> _File:
    try:
        members = members_of(path)
        (text, *_) = text_table(path, members, "meta")
        joints = text_table(path, members, "joints")
        more = f"{_MORE}joints"
        more_joints = text_table(path, members, more) if more in members else ()
        camera_names = text_table(path, members, "camera_names")
        meta = json.loads(text)
    except FileNotFoundError as error:
        raise GhptDataError(path, "", "there is no such file", "Check the path") from error
    except (
        OSError,
        ValueError,
        TypeError,
        EOFError,
        IndexError,
        RuntimeError,
        zipfile.BadZipFile,
    ) as error:
        problem = f"is not a readable reconstruction ({error})"
        raise GhptDataError(path, "", problem, _HINT) from error
    frame = members.get("frame")
    frames = frame.shape[0] if frame is not None and frame.shape else 0
    file = _File(path, members, joints, more_joints, camera_names, _parse_meta(path, meta), frames)
    file.check_layout()
    return file


_JOINT_AXIS = {"points": 1, "state": 1, "error": 1, "views": 2, "covariance": 1}
"""Of the fields that have joints."""
_META_TYPES: dict[str, tuple[type, ...]] = {
    "name": (str,),
    "source": (str,),
    "estimator": (str,),
    "rate_hz": (float, int, type(None)),
    "smoothed": (bool,),
    "provenance": (dict,),
    "world": (str,),
}
_OLD_WORLD = "the cameras' own"
"""That of files that do not say theirs."""


def _parse_meta(path: Path, meta: Any) -> _Meta:
    """Return the checked text ``meta``. Raises GhptDataError."""
    content: dict[str, Any] = {"world": _OLD_WORLD}
    content |= meta if isinstance(meta, dict) else {}
    version = content.get("format_version")
    own = content.get("format") == _FORMAT
    if type(version) is not int or version not in _POINTS or not own:
        known = " and ".join(map(str, _POINTS))
        problem = f"is {version!r}; this ghpt reads {known}"
        raise GhptDataError(path, "meta.format_version", problem, _HINT)
    for field, types in _META_TYPES.items():
        if not isinstance(content.get(field, ...), types):
            raise GhptDataError(path, f"meta.{field}", f"is {content.get(field)!r}", _HINT)
    others: dict[str, Any] = {field: content[field] for field in _META_TYPES}
    return _Meta(
        format=_FORMAT,
        format_version=version,
        unit="mm",
        origin=_parse_origin(path, content.get("origin", [0.0, 0.0, 0.0])),
        bones=_parse_bones(path, content.get("bones", HUMAN36M.bone_names)),
        states={},
        **others,
    )


def _parse_bones(path: Path, bones: Any) -> tuple[NamePair, ...]:
    listed = bones if isinstance(bones, list | tuple) else [bones]
    for bone in listed:
        if not isinstance(bone, list | tuple) or [type(end) for end in bone] != [str, str]:
            raise GhptDataError(path, "meta.bones", f"holds {bone!r}", _HINT)
    return tuple((start, end) for start, end in listed)


def _parse_origin(path: Path, origin: Any) -> tuple[float, float, float]:
    numbers = isinstance(origin, list) and [type(x) for x in origin] == [float] * 3
    if not numbers or not np.isfinite(origin).all():
        raise GhptDataError(path, "meta.origin", f"is {origin!r}", _HINT)
    x, y, z = origin
    return x, y, z
