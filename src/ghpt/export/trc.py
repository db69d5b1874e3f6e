"""poses.trc: markers as OpenSim's TRCFileAdapter reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from ghpt.errors import check
from ghpt.export.stream import (
    Chunks,
    extent_without_gaps,
    plain,
    plain_names,
    required_rate,
    text_rows,
    without_gaps,
)
from ghpt.files import atomic_write
from ghpt.reconstruction import About

_KEYS = "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames"
_UNITS = {"mm": (1.0, "%.5f"), "m": (1e-3, "%.8f")}
"""Factor from mm, and decimals: 10 nm, at any distance from the world's zero."""
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
    path: Path, about: About, chunks: Chunks, unit: str = "mm", world_up: str | None = None
) -> None:
    """A row for each frame from the first to the last number, tabs between; what is missing is
    blank, never NaN.

    ``unit``: ``mm`` or ``m``. ``world_up``: the axis of the world that points up (``z``, ``-y``,
    ...); the file's y then does, as OpenSim's models expect. None leaves the world's own axes.
    Times count from the first frame. Raises GhptConfigError where the rate is unknown.
    """
    check(unit in _UNITS, "trc.unit", f"is {unit!r}", f"Choose one of {', '.join(_UNITS)}")
    check(
        world_up is None or world_up in _TO_Y_UP,
        "trc.world_up",
        f"is {world_up!r}",
        "Choose x, y, z, -x, -y, -z or null",
    )
    rate = required_rate(about, "TRC")
    whole = extent_without_gaps(path, about, chunks)
    names = plain_names(path, "joints", about.joints)
    joints = len(about.joints)
    rows = whole.last - whole.first + 1
    hertz = f"{rate:.15g}"
    values = [hertz, hertz, rows, joints, unit, hertz, whole.first, rows]
    axes = "".join(f"X{j}\tY{j}\tZ{j}\t" for j in range(1, joints + 1))
    turn = torch.zeros(3, 3, dtype=torch.float64)
    for row, (axis, sign) in enumerate(_TO_Y_UP[world_up or "y"]):
        turn[row, axis] = sign * _UNITS[unit][0]
    forms = np.array(["%d", "%.9f", *[_UNITS[unit][1]] * (3 * joints)])
    with atomic_write(path, "w") as handle:
        handle.write(f"PathFileType\t4\t(X/Y/Z)\t{plain(path.name)}\n")
        handle.write(_KEYS + "\n" + "\t".join(map(str, values)) + "\n")
        # OpenSim takes no cell from after a line's last tab if it is blank, so every line of cells
        # ends with one.
        handle.write("Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t\t\n\t\t" + axes + "\n\n")
        for piece in without_gaps(path, about, chunks, whole):
            frame = piece.frame.numpy()
            points = (piece.points.double() @ turn.T).flatten(1).numpy()
            numbers = np.column_stack([frame, (frame - whole.first) / rate, points])
            there = np.ones(numbers.shape, bool)
            there[:, 2:] = piece.has_position.numpy().repeat(3, axis=1)
            handle.write(text_rows(np.where(there, forms, ""), numbers[there], "\t", "\t\n"))
