"""poses.trc: markers as OpenSim's TRCFileAdapter reads them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.errors import check
from ghpt.export.stream import (
    Chunks,
    Extent,
    equidistant_extent,
    equidistant_pieces,
    plain,
    plain_names,
    require_rate,
    text_rows,
)
from ghpt.files import atomic_write
from ghpt.reconstruction import About

_KEYS = (
    "DataRate",
    "CameraRate",
    "NumFrames",
    "NumMarkers",
    "Units",
    "OrigDataRate",
    "OrigDataStartFrame",
    "OrigNumFrames",
)


@dataclass(frozen=True)
class _Unit:
    per_mm: float
    form: str
    """How positions are written: 10 nm, at any distance from the world's zero."""


_UNITS = {"mm": _Unit(1.0, "%.5f"), "m": _Unit(1e-3, "%.8f")}
_TO_Y_UP = {
    "x": ((1, -1), (0, 1), (2, 1)),
    "y": ((0, 1), (1, 1), (2, 1)),
    "z": ((0, 1), (2, 1), (1, -1)),
    "-x": ((1, 1), (0, -1), (2, 1)),
    "-y": ((0, 1), (1, -1), (2, -1)),
    "-z": ((0, 1), (2, -1), (1, 1)),
}
"""For a world with this axis up: (axis, sign) of the file's x, y, z. All are rotations."""


def write_trc(
    path: Path,
    about: About,
    chunks: Chunks,
    unit: str = "mm",
    world_up: str | None = None,
) -> None:
    """Write a row for each frame from the first to the last number, tabs between.

    What is missing is blank, never NaN. ``unit``: ``mm`` or ``m``. ``world_up``: the axis of the
    world that points up (``z``, ``-y``, ...); the file's y then does, as OpenSim's models expect.
    None leaves the world's own axes. Times count from the first frame. Raises GhptConfigError where
    the rate is unknown.
    """
    check(unit in _UNITS, "trc.unit", f"is {unit!r}", f"Choose one of {', '.join(_UNITS)}")
    known_up = world_up is None or world_up in _TO_Y_UP
    hint = "Choose x, y, z, -x, -y, -z or null"
    check(known_up, "trc.world_up", f"is {world_up!r}", hint)
    rate = require_rate(about, "TRC")
    whole = equidistant_extent(path, about, chunks)
    to_file = _to_file(unit, world_up)
    joints = len(about.joints)
    forms = np.array(["%d", "%.9f", *[_UNITS[unit].form] * (3 * joints)])
    with atomic_write(path, "w") as handle:
        handle.write(_header(path, about, unit, rate, whole))
        for piece in equidistant_pieces(path, about, chunks, whole):
            frame = piece.frame.numpy()
            time = (frame - whole.first) / rate
            points = (piece.points.double() @ to_file.T).flatten(1).numpy()
            numbers = np.column_stack([frame, time, points])
            present = np.ones(numbers.shape, bool)
            present[:, 2:] = piece.has_position.numpy().repeat(3, axis=1)
            cells = np.where(present, forms, "")
            handle.write(text_rows(cells, numbers[present], "\t", "\t\n"))


def _to_file(unit: str, world_up: str | None) -> Float[Tensor, "3 3"]:
    """Return the matrix that takes the world (mm) to the file's axes and unit."""
    matrix = torch.zeros(3, 3, dtype=torch.float64)
    for row, (axis, sign) in enumerate(_TO_Y_UP[world_up or "y"]):
        matrix[row, axis] = sign * _UNITS[unit].per_mm
    return matrix


def _header(path: Path, about: About, unit: str, rate: float, whole: Extent) -> str:
    names = plain_names(path, "joints", about.joints)
    rows = whole.last - whole.first + 1
    hertz = f"{rate:.15g}"
    values = [hertz, hertz, rows, len(names), unit, hertz, whole.first, rows]
    axes = "".join(f"X{j}\tY{j}\tZ{j}\t" for j in range(1, len(names) + 1))
    # OpenSim takes no cell from after a line's last tab if it is blank, so every line of cells
    # ends with one.
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{plain(path.name)}",
        "\t".join(_KEYS),
        "\t".join(map(str, values)),
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t\t",
        "\t\t" + axes,
        "",
    ]
    return "\n".join(lines) + "\n"
