"""poses.npz: all of a reconstruction as plain arrays, written and read in parts."""

from __future__ import annotations

import json
import tempfile
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghpt.data.formats.stored_npz import Member, add_member, members_of, read_rows, text_table
from ghpt.errors import GhptDataError
from ghpt.export.stream import PIECE, Chunks, pieces
from ghpt.files import atomic_write
from ghpt.reconstruction import FILE_STATES, About, Reconstruction, State

FORMAT_VERSION = 2
_POINTS = {1: "<f4", 2: "<f8"}
"""How each version that is read stores positions; the first had few digits far from the zero."""
_HINT = "Predict this recording again, or copy the file again"
_TEXTS = ("meta", "joints", "camera_names")


_FIELDS = {"swapped": "flipped"}
"""The fields of ``Reconstruction`` whose arrays have another name in the file."""
_Layout = dict[str, tuple[str, tuple[int, ...]]]


def _layout(views: int, joints: int, version: int = FORMAT_VERSION) -> _Layout:
    """The type of each array and the shape of its rows."""
    return {
        "frame": ("<i8", ()),
        "points": (_POINTS[version], (joints, 3)),
        "state": ("|i1", (joints,)),
        "error": ("<f4", (joints,)),
        "views": ("|b1", (views, joints)),
        "covariance": ("<f4", (joints, 6)),
        "score": ("<f4", ()),
        "swapped": ("|b1", (views,)),
    }


def write_npz(path: Path, about: About, chunks: Chunks) -> None:
    """All fields of ``Reconstruction`` and ``About`` (docs/outputs.md).

    Positions are NaN where missing; errors and covariances where not observed. Stored without
    compression: numpy reads it, in parts too. The same content gives the same bytes.
    """
    layout = _layout(len(about.camera_names), len(about.joints))
    tables = {
        "joints": np.array(about.joints, np.str_),
        "camera_names": np.array(about.camera_names, np.str_),
    }
    tables["rate_hz"] = np.array(np.nan if about.rate_hz is None else about.rate_hz, "<f8")
    tables["unit"] = np.array("mm")
    tables["meta"] = np.array(json.dumps(_meta(about), allow_nan=False))
    count = 0
    with atomic_write(path, verify=read_reconstruction) as handle, ExitStack() as stack:
        # Files without a name: nothing of them is left behind, however the process ends.
        spools = {
            name: stack.enter_context(tempfile.TemporaryFile(dir=path.parent)) for name in layout
        }
        for piece in pieces(path, about, chunks):
            count += len(piece)
            for name, value in _masked(piece).items():
                spools[name].write(value.numpy().astype(layout[name][0]).tobytes())
        with zipfile.ZipFile(handle, "w") as archive:
            for name, (dtype, shape) in layout.items():
                spools[name].seek(0)
                add_member(archive, name, np.dtype(dtype), (count, *shape), spools[name])
            for name, table in tables.items():
                add_member(archive, name, table.dtype, table.shape, table.tobytes())


def _meta(about: About) -> dict[str, Any]:
    plain = ("name", "source", "estimator", "rate_hz", "smoothed", "provenance", "origin")
    meta = {"format": "ghpt reconstruction", "format_version": FORMAT_VERSION, "unit": "mm"}
    return (
        meta
        | {field: getattr(about, field) for field in plain}
        | {"states": {s.name.lower(): int(s) for s in FILE_STATES}}
    )


def _masked(piece: Reconstruction) -> dict[str, torch.Tensor]:
    values = {name: getattr(piece, _FIELDS.get(name, name)).cpu() for name in _layout(1, 1)}
    observed = values["state"] == State.OBSERVED
    values["points"] = torch.where(
        (values["state"] <= State.FILLED)[..., None], values["points"], torch.nan
    )
    values["error"] = torch.where(observed, values["error"], torch.nan)
    values["covariance"] = torch.where(observed[..., None], values["covariance"], torch.nan)
    return values


def read_reconstruction(
    path: str | Path, size: int = PIECE
) -> tuple[About, Iterator[Reconstruction]]:
    """What ``write_npz`` wrote: at most ``size`` frames at a time. Nothing in the file is executed
    or unpacked.

    Raises GhptDataError if it is missing, damaged (every byte is compared with its checksum), of
    another version, or if its arrays do not belong together.
    """
    path = Path(path)
    members, texts, meta = _open(path)
    joints = texts["joints"]
    cameras = texts["camera_names"]
    frames = members["frame"].shape[0] if "frame" in members and members["frame"].shape else 0
    layout = _layout(len(cameras), len(joints), meta["format_version"])
    for name, (dtype, shape) in layout.items():
        if name not in members or members[name][1:] != (np.dtype(dtype), (frames, *shape)):
            raise GhptDataError(path, name, f"is not {dtype} of shape {(frames, *shape)}", _HINT)
    about = About(
        name=meta["name"],
        source=meta["source"],
        estimator=meta["estimator"],
        joints=joints,
        camera_names=cameras,
        rate_hz=meta["rate_hz"],
        smoothed=meta["smoothed"],
        provenance=meta["provenance"],
        origin=_origin(path, meta),
    )
    starts = range(0, frames, size)
    return about, (_read(path, members, start, min(start + size, frames)) for start in starts)


def _origin(path: Path, meta: dict[str, Any]) -> tuple[float, float, float]:
    origin = meta.get("origin", [0.0, 0.0, 0.0])
    numbers = isinstance(origin, list) and [type(x) for x in origin] == [float] * 3
    if not numbers or not np.isfinite(origin).all():
        raise GhptDataError(path, "meta.origin", f"is {origin!r}", _HINT)
    return tuple(origin)


def _open(path: Path) -> tuple[dict[str, Member], dict[str, tuple[str, ...]], dict[str, Any]]:
    try:
        members = members_of(path)
        texts = {name: text_table(path, members, name) for name in _TEXTS}
        meta = json.loads(texts["meta"][0])
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
        raise GhptDataError(
            path, "", f"is not a readable reconstruction ({error})", _HINT
        ) from error
    version = meta.get("format_version") if isinstance(meta, dict) else None
    readable = type(version) is int and version in _POINTS
    if not readable or meta.get("format") != "ghpt reconstruction":
        known = " and ".join(map(str, _POINTS))
        problem = f"is {version!r}; this ghpt reads {known}"
        raise GhptDataError(path, "meta.format_version", problem, _HINT)
    forms = {
        "name": str,
        "source": str,
        "estimator": str,
        "rate_hz": (float, int, type(None)),
        "smoothed": bool,
        "provenance": dict,
    }
    for field, form in forms.items():
        if not isinstance(meta.get(field, ...), form):
            raise GhptDataError(path, f"meta.{field}", f"is {meta.get(field)!r}", _HINT)
    return members, texts, meta


def _read(path: Path, members: dict[str, Member], start: int, stop: int) -> Reconstruction:
    rows = {
        _FIELDS.get(name, name): torch.from_numpy(read_rows(path, members[name], start, stop))
        for name in _layout(1, 1)
    }
    state = rows["state"]
    if ((state < 0) | (state > max(FILE_STATES))).any():
        raise GhptDataError(path, "state", "holds a number that is no state", _HINT)
    placed = (state <= State.FILLED)[..., None].expand_as(rows["points"])
    if not rows["points"][placed].isfinite().all():
        raise GhptDataError(path, "points", "a joint that is not missing has no position", _HINT)
    for name in ("points", "error", "covariance"):
        rows[name] = rows[name].nan_to_num(0.0, 0.0, 0.0)
    rows["points"] = rows["points"].double()
    return Reconstruction(**rows)
