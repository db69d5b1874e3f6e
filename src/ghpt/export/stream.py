"""What all writers share: successive frames, checked, in pieces of bounded size, as text too."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.errors import GhptConfigError, GhptDataError
from ghpt.reconstruction import About, Reconstruction, State

Chunks = Callable[[], Iterator[Reconstruction]]
"""Successive parts of a reconstruction, from the first frame; may be called more than once."""

PIECE = 4096
"""Frames that a writer holds at a time, however long the parts are that it gets."""

_MOST_ABSENT = 50
_ALWAYS_ABSENT = 100_000
"""Formats without gaps take this many absent frames for each frame there is, and these in any case.
"""


@dataclass(frozen=True)
class Extent:
    """The recording's own numbers of the first and last frame, and how many frames there are."""

    first: int
    last: int
    count: int


def pieces(path: Path, about: About, chunks: Chunks) -> Iterator[Reconstruction]:
    """Yield all frames, at most ``PIECE`` at a time.

    Raises GhptDataError (for the file ``path`` that is being written) unless frame numbers rise and
    shapes fit the names.
    """
    last = None
    for chunk in chunks():
        _check_shape(path, about, chunk)
        if len(chunk):
            _check_numbers(path, chunk, last)
            last = int(chunk.frame[-1])
        for start in range(0, len(chunk), PIECE):
            yield part(chunk, start, start + PIECE)


def _check_shape(path: Path, about: About, chunk: Reconstruction) -> None:
    _, views, joints = chunk.views.shape
    names = (len(about.camera_names), len(about.joints))
    if (views, joints) != names:
        problem = f"are {names[0]} and {names[1]} in name, {views} and {joints} in number"
        hint = "Predict this recording again"
        raise GhptDataError(path, "camera_names, joints", problem, hint)


def _check_numbers(path: Path, chunk: Reconstruction, last: int | None) -> None:
    """Raise GhptDataError unless frame numbers rise, from ``last`` on."""
    frame = chunk.frame
    if last is not None:
        frame = torch.cat([frame.new_tensor([last]), frame])
    falls = torch.nonzero(frame.diff() <= 0)[:, 0].tolist()
    if falls:
        first = falls[0]
        problem = f"{int(frame[first + 1])} comes after {int(frame[first])}"
        raise GhptDataError(path, "frame", problem, "Number the frames in rising order")


def part(chunk: Reconstruction, start: int, stop: int) -> Reconstruction:
    """Return the frames from position ``start`` up to ``stop``."""
    rows = {field.name: getattr(chunk, field.name)[start:stop] for field in fields(chunk)}
    return Reconstruction(**rows)


def extent(path: Path, about: About, chunks: Chunks) -> Extent:
    """Return the extent of all frames. Raises GhptDataError where there is none."""
    first = None
    last = 0
    count = 0
    for piece in pieces(path, about, chunks):
        first = int(piece.frame[0]) if first is None else first
        last = int(piece.frame[-1])
        count = count + len(piece)
    if first is None:
        hint = "Check that the key points have frames"
        raise GhptDataError(path, "frame", "there is no frame to write", hint)
    return Extent(first, last, count)


def equidistant_extent(path: Path, about: About, chunks: Chunks) -> Extent:
    """Return ``extent``, for formats whose rows are equally spaced in time.

    Raises GhptDataError if next to all frames would be absent: such numbers are times or names.
    """
    whole = extent(path, about, chunks)
    if whole.last - whole.first > _MOST_ABSENT * whole.count + _ALWAYS_ABSENT:
        problem = f"{whole.count} frames have numbers from {whole.first} to {whole.last}"
        hint = "Number the frames one after another, or leave this format out"
        raise GhptDataError(path, "frame", problem, hint)
    return whole


def equidistant_pieces(
    path: Path,
    about: About,
    chunks: Chunks,
    whole: Extent,
) -> Iterator[Reconstruction]:
    """Yield all frames from the first number to the last, in pieces.

    A frame that is absent has no joint (``FEW_VIEWS``).
    """
    following = whole.first
    for piece in pieces(path, about, chunks):
        stop = int(piece.frame[-1]) + 1
        for start in range(following, stop, PIECE):
            yield _select_numbers(piece, start, min(start + PIECE, stop))
        following = stop


def _select_numbers(piece: Reconstruction, start: int, stop: int) -> Reconstruction:
    """Return the frames with numbers from ``start`` up to ``stop``, absent ones among them."""
    limits = piece.frame.new_tensor([start, stop])
    low, high = torch.searchsorted(piece.frame, limits).tolist()
    present = part(piece, low, high)
    if high - low == stop - start:
        return present
    numbers = torch.arange(start, stop, dtype=piece.frame.dtype)
    values = {"frame": numbers}
    for field in (field.name for field in fields(piece) if field.name != "frame"):
        value = getattr(present, field)
        absent = State.FEW_VIEWS if field == "state" else 0
        padded = value.new_full((len(numbers), *value.shape[1:]), int(absent))
        padded[present.frame - start] = value
        values[field] = padded
    return Reconstruction(**values)


def require_rate(about: About, format: str) -> float:
    """Return the frames per second. Raises GhptConfigError where they are not known."""
    rate_hz = about.rate_hz
    if rate_hz is None:
        problem = f"is unknown, and {format} needs it"
        raise GhptConfigError("rate_hz", problem, "Give rate_hz=30 (frames per second)")
    if not (math.isfinite(rate_hz) and rate_hz > 0):
        hint = "Give the frames per second, e.g. rate_hz=30"
        raise GhptConfigError("rate_hz", f"is {rate_hz}", hint)
    return rate_hz


def plain(name: str) -> str:
    """Return a name on one line: control characters, which end cells and lines, become _."""
    characters = [c if c.isprintable() else "_" for c in name]
    return "".join(characters) or "_"


def plain_names(path: Path, field: str, names: tuple[str, ...]) -> list[str]:
    """Return ``plain`` of each. Raises GhptDataError if two are then the same."""
    found = [plain(name) for name in names]
    if len(set(found)) != len(found):
        repeated = next(name for name in found if found.count(name) > 1)
        problem = f"{repeated!r} is the name of two"
        raise GhptDataError(path, field, problem, "Give each a name of its own")
    return found


def local_points(about: About, piece: Reconstruction) -> Float[Tensor, "T J 3"]:
    """Return positions in a world whose zero is ``about.origin``, float64.

    They are small enough for float32.
    """
    points = piece.points.double()
    return points - points.new_tensor(about.origin)


def text_rows(cells: np.ndarray, numbers: np.ndarray, separator: str, ending: str) -> str:
    """Return a line for each row of ``cells``: texts and %-formats.

    ``numbers`` fill the formats row by row, the same in every locale.
    """
    lines = [separator.join(row) + ending for row in cells.tolist()]
    return "".join(lines) % tuple(numbers.tolist())
