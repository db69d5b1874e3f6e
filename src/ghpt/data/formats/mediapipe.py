"""caliscope's CSV of MediaPipe's landmarks: a row for each point, camera and synchronised frame."""

from __future__ import annotations

import codecs
import csv
import io
import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ghpt.data.formats.skeletons import SKELETONS
from ghpt.data.formats.validate import open_input
from ghpt.data.people.detections import Detections
from ghpt.data.points import KeyPoints
from ghpt.errors import GhptDataError

COLUMNS = ("sync_index", "port", "point_id", "img_loc_x", "img_loc_y")
_LARGEST = 2 << 30
_LONGEST_LINE = 1 << 12
_MOST_PORTS = 1000
_WRITE = "It must be an xy_*.csv that caliscope wrote."
_PLACES = np.full(221, -1)
"""The place in ``mediapipe_75`` of a ``point_id``: of the body, the right and the left hand."""
_PLACES[:33] = np.arange(33)
_PLACES[100:121] = np.arange(33, 54)
_PLACES[200:221] = np.arange(54, 75)

_LARGEST_NUMBER = 1e12


def is_caliscope(text: str) -> bool:
    """Return whether a file that starts so is one of caliscope's 2D tables.

    Its columns may be parted by commas or not.
    """
    header = text.splitlines()[0] if text else ""
    names = {name.strip().strip('"') for name in re.split("[,;\t]", header)}
    return set(COLUMNS) <= names


def read_caliscope(path: Path) -> Detections:
    """Return the one person of the table: 33 landmarks in the views ``cam_<port>``.

    They are 75 with hands; points of the face are left out. The frame numbers are ``sync_index``.
    There is no confidence in these files. Raises GhptDataError for a table that is damaged, or that
    has a point twice.
    """
    table = _table(path)
    landmark = table[:, 2]
    known = (landmark >= 0) & (landmark < len(_PLACES))
    table = table[known & np.isfinite(table).all(1)]
    place = _PLACES[table[:, 2].astype(np.int64)]
    table = table[place >= 0]
    joint = place[place >= 0]
    body = len(SKELETONS["mediapipe_33"])
    if not (joint < body).any():
        problem = f"has no body landmark (0 to {body - 1})"
        raise GhptDataError(path, "point_id", problem, _WRITE)
    has_hands = bool((joint >= body).any())
    names = SKELETONS["mediapipe_75" if has_hands else "mediapipe_33"]
    frame, port = table[:, :2].astype(np.int64).T
    frames, row = np.unique(frame, return_inverse=True)
    ports, view = np.unique(port, return_inverse=True)
    if len(ports) > _MOST_PORTS:
        raise GhptDataError(path, "port", f"names {len(ports)} cameras", _WRITE)
    cell = (row * len(ports) + view) * len(names) + joint
    if len(np.unique(cell)) != len(cell):
        problem = "a point is there twice in a frame of a camera"
        raise GhptDataError(path, "point_id", problem, _WRITE)
    shape = (len(frames), len(ports), len(names))
    points = np.zeros((*shape, 2))
    valid = np.zeros(shape, np.bool_)
    points.reshape(-1, 2)[cell] = table[:, 3:5]
    valid.reshape(-1)[cell] = True
    views = tuple(f"cam_{port}" for port in ports)
    key_points = KeyPoints(points, valid.astype(np.float64), valid)
    return Detections.of_person(path, views, names, frames, key_points)


def _table(path: Path) -> Float[np.ndarray, "N 5"]:
    if path.stat().st_size > _LARGEST:
        raise GhptDataError(path, "", f"has more than {_LARGEST >> 30} GiB", "Split the recording.")
    with open_input(path) as raw:
        utf16 = raw.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        encoding = "utf-16" if utf16 else "utf-8-sig"
        raw.seek(-min(2, path.stat().st_size), 2)
        if not raw.read().strip(b"\0").endswith((b"\n", b"\r")):
            problem = "ends in the middle of a line: it is truncated"
            raise GhptDataError(path, "", problem, "Copy it again.")
        raw.seek(0)
        with io.TextIOWrapper(raw, encoding=encoding, errors="replace", newline="") as handle:
            table = _rows(path, handle)
    index = table[:, :3]
    index = index[np.isfinite(index)]
    whole = (index == np.round(index)).all()
    if not whole or not (np.abs(np.nan_to_num(table)) < _LARGEST_NUMBER).all():
        problem = "holds an index that is not whole, or a number beyond 1e12"
        raise GhptDataError(path, "", problem, _WRITE)
    return table


def _lines(handle: io.TextIOBase) -> Iterator[str]:
    while line := handle.readline(_LONGEST_LINE):
        if len(line) == _LONGEST_LINE:
            raise ValueError("a line of it does not end")
        yield line


def _number(cell: str) -> float:
    """Return a cell's number; an empty one is a point that was not found."""
    return float(cell) if cell.strip() else np.nan


def _rows(path: Path, handle: io.TextIOBase) -> Float[np.ndarray, "N 5"]:
    line = handle.readline(_LONGEST_LINE)
    if ";" in line or "\t" in line:
        hint = (
            "Save it with commas between the columns and points in the numbers "
            "(a spreadsheet may have changed it)."
        )
        raise GhptDataError(path, "", "has columns that commas do not part", hint)
    try:
        header = [name.strip() for name in next(csv.reader([line]))]
        columns = [header.index(name) for name in COLUMNS]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of a table without rows
            table = np.loadtxt(
                _lines(handle),
                delimiter=",",
                usecols=columns,
                converters=dict.fromkeys(columns, _number),
                ndmin=2,
            )
    except (ValueError, StopIteration, csv.Error) as error:
        raise GhptDataError(path, "", f"is damaged ({error})", _WRITE) from error
    return table.reshape(-1, len(COLUMNS))
