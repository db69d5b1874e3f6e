"""CSV of tracks: DeepLabCut's and LightningPose's, and SLEAP's analysis."""

from __future__ import annotations

import csv
import re
from pathlib import Path

import numpy as np

from ghpt.data.formats.csv_tables import open_table, read_header, read_numbers
from ghpt.data.formats.source import Source
from ghpt.data.formats.tracks import Tracks, grid_of_columns, read_tracks
from ghpt.data.people.detections import Detections
from ghpt.errors import GhptDataError

_HEADER = ("scorer", "individuals", "bodyparts", "coords")
"""What the rows of DeepLabCut's header begin with; one person's has no individuals."""
_SLEAP = ("track", "frame_idx")
"""SLEAP's columns of who it is, and when."""
_COORDINATES = ("x", "y", "score")
"""Of a key point, behind its name and a point."""
_LAST_NUMBER = re.compile(r"(\d{1,15})\D*$")
_EXPORT = "Export it again."


def is_deeplabcut(text: str) -> bool:
    """Return whether a file that begins so is DeepLabCut's or LightningPose's."""
    return re.match("scorer[,;\t]", text) is not None


def is_sleap_analysis(text: str) -> bool:
    """Return whether a file that begins so is SLEAP's analysis."""
    return re.match("[,;\t]".join(_SLEAP), text) is not None


def read_deeplabcut_csv(source: Source) -> Detections:
    """Return everybody in a folder with DeepLabCut's or LightningPose's CSV of each camera.

    Raises GhptDataError.
    """
    return read_tracks(source, (".csv",), _deeplabcut)


def read_sleap_csv(source: Source) -> Detections:
    """Return everybody in a folder with SLEAP's analysis CSV of each camera.

    Raises GhptDataError.
    """
    return read_tracks(source, (".csv",), _sleap)


def _deeplabcut(file: Path) -> Tracks:
    try:
        with open_table(file) as handle:
            levels = [read_header(handle)]
            while levels[-1][:1] != ["coords"] and len(levels) < len(_HEADER):
                levels.append(read_header(handle))
            names = tuple(level[0] for level in levels if level)
            if names not in (_HEADER, (_HEADER[0], *_HEADER[2:])):
                raise ValueError(f"its first rows are not {', '.join(_HEADER)}")
            columns = list(zip(*levels, strict=True))
            # hand-made labels have the parts of the image's path before it
            first = next(i for i, column in enumerate(columns) if column[-1] == "x")
            chosen = range(first - 1, len(columns))
            table = read_numbers(handle, chosen, {first - 1: _frame_number})
        frames = table[:, 0].astype(np.int64)
        return Tracks.of_grid(frames, *grid_of_columns(columns[first:], table[:, 1:]))
    except (ValueError, StopIteration, csv.Error) as error:
        raise GhptDataError(file, "", f"is damaged ({error})", _EXPORT) from error


def _frame_number(cell: str) -> float:
    """Return the number of a row, or the one at the end of its image's name."""
    found = _LAST_NUMBER.search(cell)
    if found is None:
        raise ValueError(f"{cell[:40]!r} has no frame number")
    return float(found[1])


def _sleap(file: Path) -> Tracks:
    """Return a table with a row for each frame and track; no track has no name."""
    numbers: dict[str, int] = {"": -1}

    def number_track(cell: str) -> float:
        return numbers.setdefault(cell.strip(), len(numbers) - 1)

    try:
        with open_table(file) as handle:
            header = read_header(handle)
            joints = tuple(name[:-2] for name in header if name.endswith(".x"))
            place = [header.index(name) for name in _SLEAP]
            place += [header.index(f"{joint}.{of}") for joint in joints for of in _COORDINATES]
            table = read_numbers(handle, place, {place[0]: number_track})
    except (ValueError, csv.Error) as error:
        raise GhptDataError(file, "", f"is damaged ({error})", _EXPORT) from error
    frame = np.nan_to_num(table[:, 1], nan=-1).astype(np.int64)
    if (frame < 0).any():
        raise GhptDataError(file, _SLEAP[1], "is not a frame number in every row", _EXPORT)
    values = table[:, 2:].reshape(len(table), len(joints), len(_COORDINATES))
    return Tracks(np.unique(frame), frame, table[:, 0].astype(np.int64), values, joints)
