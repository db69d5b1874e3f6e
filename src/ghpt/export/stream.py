"""What all writers share: successive frames, checked, in pieces of bounded size, and numbers as
text.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import NamedTuple

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


class Extent(NamedTuple):
    """The recording's own numbers of the first and last frame, and how many frames there are."""

    first: int
    last: int
    count: int


def pieces(path: Path, about: About, chunks: Chunks) -> Iterator[Reconstruction]:
    """All frames, at most ``PIECE`` at a time. Raises GhptDataError (for the file ``path`` that is
    being written) unless frame numbers rise and shapes fit the names.
    """
    shape = (len(about.camera_names), len(about.joints))
    last = None
    for chunk in chunks():
        if chunk.views.shape[1:] != shape:
            problem = f"are {shape[0]} and {shape[1]} in name, {chunk.views.shape[1]} and {chunk.views.shape[2]} in number"
            raise GhptDataError(
                path, "camera_names, joints", problem, "Predict this recording again"
            )
        if not len(chunk):
            continue
        frame = (
            chunk.frame
            if last is None
            else torch.cat([chunk.frame.new_tensor([last]), chunk.frame])
        )
        falls = torch.nonzero(frame.diff() <= 0)[:, 0].tolist()
        if falls:
            problem = f"{int(frame[falls[0] + 1])} comes after {int(frame[falls[0]])}"
            raise GhptDataError(path, "frame", problem, "Number the frames in rising order")
        last = int(frame[-1])
        yield from (part(chunk, start, start + PIECE) for start in range(0, len(chunk), PIECE))


def part(chunk: Reconstruction, start: int, stop: int) -> Reconstruction:
    """Frames from position ``start`` up to ``stop``."""
    return Reconstruction(
        **{field.name: getattr(chunk, field.name)[start:stop] for field in fields(chunk)}
    )


def extent(path: Path, about: About, chunks: Chunks) -> Extent:
    """Of all frames. Raises GhptDataError where there is none."""
    first = None
    last = 0
    count = 0
    for piece in pieces(path, about, chunks):
        first = int(piece.frame[0]) if first is None else first
        last = int(piece.frame[-1])
        count = count + len(piece)
    if first is None:
        raise GhptDataError(
            path, "frame", "there is no frame to write", "Check that the key points have frames"
        )
    return Extent(first, last, count)


def extent_without_gaps(path: Path, about: About, chunks: Chunks) -> Extent:
    """``extent``, for formats whose rows are equally spaced in time. Raises GhptDataError if next
    to all frames would be absent: such numbers are times or names.
    """
    whole = extent(path, about, chunks)
    if whole.last - whole.first > _MOST_ABSENT * whole.count + _ALWAYS_ABSENT:
        problem = f"{whole.count} frames have numbers from {whole.first} to {whole.last}"
        raise GhptDataError(
            path, "frame", problem, "Number the frames one after another, or leave this format out"
        )
    return whole


def without_gaps(
    path: Path, about: About, chunks: Chunks, whole: Extent
) -> Iterator[Reconstruction]:
    """All frames from the first number to the last, in pieces: one that is absent has no joint
    (``FEW_VIEWS``).
    """
    following = whole.first
    for piece in pieces(path, about, chunks):
        stop = int(piece.frame[-1]) + 1
        for start in range(following, stop, PIECE):
            yield _between(piece, start, min(start + PIECE, stop))
        following = stop


def _between(piece: Reconstruction, start: int, stop: int) -> Reconstruction:
    """The frames with numbers from ``start`` up to ``stop``, those that are absent among them."""
    low, high = torch.searchsorted(piece.frame, piece.frame.new_tensor([start, stop])).tolist()
    there = part(piece, low, high)
    if high - low == stop - start:
        return there
    numbers = torch.arange(start, stop, dtype=piece.frame.dtype)
    values = {"frame": numbers}
    for field in (field.name for field in fields(piece) if field.name != "frame"):
        value = getattr(there, field)
        absent = State.FEW_VIEWS if field == "state" else 0
        values[field] = value.new_full((len(numbers), *value.shape[1:]), int(absent))
        values[field][there.frame - start] = value
    return Reconstruction(**values)


def required_rate(about: About, format: str) -> float:
    """Frames per second. Raises GhptConfigError where it is not known."""
    if about.rate_hz is None:
        raise GhptConfigError(
            "rate_hz", f"is unknown, and {format} needs it", "Give rate_hz=30 (frames per second)"
        )
    if not (math.isfinite(about.rate_hz) and about.rate_hz > 0):
        raise GhptConfigError(
            "rate_hz", f"is {about.rate_hz}", "Give the frames per second, e.g. rate_hz=30"
        )
    return about.rate_hz


def plain(name: str) -> str:
    """A name on one line: control characters, which end cells and lines, become _."""
    return "".join(c if c.isprintable() else "_" for c in name) or "_"


def plain_names(path: Path, field: str, names: tuple[str, ...]) -> list[str]:
    """``plain`` of each. Raises GhptDataError if two are then the same."""
    found = [plain(name) for name in names]
    if len(set(found)) != len(found):
        twice = next(name for name in found if found.count(name) > 1)
        raise GhptDataError(
            path, field, f"{twice!r} is the name of two", "Give each a name of its own"
        )
    return found


def points_of_origin(about: About, piece: Reconstruction) -> Float[Tensor, "T J 3"]:
    """Positions in a world whose zero is ``about.origin``, float64: small enough for float32."""
    points = piece.points.double()
    return points - points.new_tensor(about.origin)


def text_rows(cells: np.ndarray, numbers: np.ndarray, separator: str, ending: str) -> str:
    """A line for each row of ``cells``: texts and %-formats, which ``numbers`` fill row by row. The
    same in every locale.
    """
    return "".join(separator.join(row) + ending for row in cells.tolist()) % tuple(numbers.tolist())
