"""The course of a recording: what happens when, in few enough columns for a picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int8
from torch import Tensor

from ghpt.geometry.masking import where
from ghpt.reconstruction import Reconstruction

_COLUMNS = 400
_POSES = 60
"""At most so many, evenly spread, are kept as they are."""


@dataclass(frozen=True)
class Course:
    """A reconstruction in C columns of successive frames; J joints, B bones, P whole poses."""

    frame: Float[np.ndarray, " C"]
    """The first frame number of each column."""
    state: Int8[Tensor, "C J"]
    """The worst state of its frames, so that no gap is lost."""
    length: Float[Tensor, "C B"]
    """Mean lengths of the bones, mm; NaN where none is there."""
    middle: Float[Tensor, "C 3"]
    """Mean of the joints that have a position, mm; NaN where none has."""
    points: Float[Tensor, "P J 3"]
    """Poses, mm."""
    placed: Bool[Tensor, "P J"]
    """The joints of the poses that have a position."""


def sample_course(
    chunks: Iterator[Reconstruction], total: int, bones: Sequence[tuple[int, int]]
) -> Course:
    """Return the course of ``total`` frames, and the lengths of these pairs of joints."""
    columns = min(total, _COLUMNS)
    step = max(1, -(-total // _POSES))
    parts: list[_Sums] = []
    points = []
    placed = []
    count = 0
    ends = torch.tensor(list(bones), dtype=torch.long).reshape(-1, 2)
    for chunk in chunks:
        column = (torch.arange(count, count + len(chunk)) * columns) // max(total, 1)
        parts.append(_sum_columns(chunk, column, columns, ends))
        chosen = slice(-count % step, None, step)
        points.append(chunk.points[chosen].double())
        placed.append(chunk.has_position[chosen])
        count += len(chunk)
    whole = _add(parts)
    return Course(
        frame=whole.frame.numpy(),
        state=whole.state,
        length=whole.length / whole.measured,
        middle=whole.middle / whole.present[:, None],
        points=torch.cat(points),
        placed=torch.cat(placed),
    )


@dataclass(frozen=True)
class _Sums:
    """What a part of the frames adds to the columns."""

    frame: Float[Tensor, " C"]
    state: Int8[Tensor, "C J"]
    length: Float[Tensor, "C B"]
    measured: Float[Tensor, "C B"]
    middle: Float[Tensor, "C 3"]
    present: Float[Tensor, " C"]


def _sum_columns(
    chunk: Reconstruction, column: Int[Tensor, " T"], columns: int, ends: Int[Tensor, "B 2"]
) -> _Sums:
    joints = chunk.state.shape[1]
    there = chunk.has_position
    points = where(there, chunk.points.double(), 0.0)
    start, end = ends.unbind(-1)
    both = (there[:, start] & there[:, end]).double()
    length = (points[:, start] - points[:, end]).norm(dim=-1) * both

    def total(values: Tensor) -> Tensor:
        return values.new_zeros(columns, *values.shape[1:]).index_add(0, column, values)

    frames = torch.full((columns,), torch.inf, dtype=torch.float64)
    rows = column[:, None].expand(-1, joints)
    worst = chunk.state.new_zeros(columns, joints)
    return _Sums(
        frame=frames.scatter_reduce(0, column, chunk.frame.double(), "amin"),
        state=worst.scatter_reduce(0, rows, chunk.state, "amax"),
        length=total(length),
        measured=total(both),
        middle=total(points.sum(1)),
        present=total(there.sum(1).double()),
    )


def _add(parts: Sequence[_Sums]) -> _Sums:
    def total(name: str) -> Tensor:
        return torch.stack([getattr(part, name) for part in parts]).sum(0)

    return _Sums(
        frame=torch.stack([part.frame for part in parts]).amin(0),
        state=torch.stack([part.state for part in parts]).amax(0),
        length=total("length"),
        measured=total("measured"),
        middle=total("middle"),
        present=total("present"),
    )
