"""poses.c3d: points in the binary format of motion capture (c3d.org), Intel byte order, floating
point.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ghpt.errors import GhptDataError
from ghpt.export.stream import (
    Chunks,
    extent_without_gaps,
    plain,
    plain_names,
    points_of_origin,
    required_rate,
    without_gaps,
)
from ghpt.files import atomic_write
from ghpt.reconstruction import About, Reconstruction, State

_BLOCK = 512
_MOST = 65_535
"""The largest number of 16 bits."""
RESIDUAL_STEP = 0.25
"""Pixels of one step of a residual, which has 8 bits: up to 63.75 px. It is POINT:SCALE too, so
programs that store points as integers reach 8 m.
"""
_CAMERAS = 7
"""Bits of a camera mask."""


def write_c3d(path: Path, about: About, chunks: Chunks) -> None:
    """A frame for each number from the first to the last, in mm, counted from 1
    (``GHPT:FIRST_FRAME`` is the own number of the first, as text).

    A missing joint is (0, 0, 0) with residual -1, a filled one has residual 0 and no camera, as the
    format prescribes; else the residual is the reprojection error in pixels (0.25 to 63.75) and the
    mask the first seven views that made it. Above 65,535 frames the count is in
    TRIAL:ACTUAL_END_FIELD and POINT:LONG_FRAMES.

    The format's coordinates have single precision, so positions are relative to ``about.origin``.
    Where that is not the world's own zero, GHPT:ORIGIN is it: x, y and z in mm, as text, because a
    number has too few digits.

    Raises GhptConfigError where the rate is unknown and GhptDataError for names that the format
    cannot hold.
    """
    rate = required_rate(about, "C3D")
    whole = extent_without_gaps(path, about, chunks)
    frames = whole.last - whole.first + 1
    joints = len(about.joints)
    parameters = _parameters(path, about, rate, frames, whole.first)
    start = 2 + len(parameters) // _BLOCK
    with atomic_write(path) as handle:
        header = struct.pack(
            "<BBHHHHHfHHf",
            2,
            0x50,
            joints,
            0,
            1,
            min(frames, _MOST),
            0,
            -RESIDUAL_STEP,
            start,
            0,
            rate,
        )
        handle.write(header.ljust(_BLOCK, b"\0") + parameters)
        written = 0
        for piece in without_gaps(path, about, chunks, whole):
            written += handle.write(_points(about, piece).tobytes())
        if (
            frames < _MOST
        ):  # from there on readers take all that follows for frames, up to the file's end
            handle.write(bytes(-written % _BLOCK))


def _points(about: About, piece: Reconstruction) -> np.ndarray:
    """x, y, z and the word with the mask in the high byte and the residual in the low one, float32
    [T, J, 4].
    """
    placed = piece.has_position
    observed = piece.state == State.OBSERVED
    bits = 2 ** torch.arange(min(_CAMERAS, piece.views.shape[1]))
    mask = (piece.views[:, :_CAMERAS] * bits[:, None]).sum(1)
    residual = (piece.error / RESIDUAL_STEP).round().nan_to_num(255.0).clamp(1, 255).long()
    word = torch.where(observed, 256 * mask + residual, torch.where(placed, 0, -1))
    points = torch.where(placed[..., None], points_of_origin(about, piece), 0.0)
    return torch.cat([points, word[..., None].double()], dim=-1).numpy().astype("<f4")


def _parameters(path: Path, about: About, rate: float, frames: int, first: int) -> bytes:
    names = plain_names(path, "joints", about.joints)
    long = {"LONG_FRAMES": _floats([frames])} if frames >= _MOST else {}
    origin = {"ORIGIN": _texts([f"{x:.15g}" for x in about.origin])} if any(about.origin) else {}
    groups = {
        "POINT": {
            "USED": _words([len(names)]),
            "SCALE": _floats([-RESIDUAL_STEP]),
            "RATE": _floats([rate]),
            "DATA_START": b"",
            "FRAMES": _words([min(frames, _MOST)]),
            **long,
            "UNITS": _text("mm"),
            **_labels(path, names),
        },
        "ANALOG": {"USED": _words([0])},
        "TRIAL": {
            "ACTUAL_START_FIELD": _words([1, 0]),
            "ACTUAL_END_FIELD": _words([frames % 65536, frames // 65536]),
        },
        "GHPT": {
            "NAME": _text(about.name),
            "SOURCE": _text(about.source),
            "ESTIMATOR": _text(about.estimator),
            "SMOOTHED": _text("yes" if about.smoothed else "no"),
            "FIRST_FRAME": _text(str(first)),
            "RESIDUAL_UNIT": _text("px"),
            "CAMERAS": _texts([_cut(plain(name)) for name in about.camera_names]),
            **origin,
        },
    }
    groups["POINT"]["DATA_START"] = _words([0])
    blocks = -(-(4 + len(_records(path, groups)) + 1) // _BLOCK)  # a zero ends the records
    if blocks > 255:
        raise GhptDataError(
            path, "joints, camera_names", "are too long for C3D", "Give them shorter names"
        )
    groups["POINT"]["DATA_START"] = _words([2 + blocks])
    start = struct.pack("<BBBB", 1, 0x50, blocks, 84)
    return (start + _records(path, groups)).ljust(blocks * _BLOCK, b"\0")


def _records(path: Path, groups: dict[str, dict[str, bytes]]) -> bytes:
    records = b""
    for number, (group, values) in enumerate(groups.items(), 1):
        records += (
            struct.pack("<bb", len(group), -number) + group.encode() + struct.pack("<HB", 3, 0)
        )
        for name, value in values.items():
            if len(value) + 3 > 32767:
                raise GhptDataError(
                    path, name, "are too long together for C3D", "Give them shorter names"
                )
            records += (
                struct.pack("<bb", len(name), number)
                + name.encode()
                + struct.pack("<H", len(value) + 3)
            )
            records += value + b"\0"
    return records


def _labels(path: Path, names: Sequence[str]) -> dict[str, bytes]:
    """LABELS, LABELS2, ...: 255 each."""
    for name in names:
        if len(name.encode()) > 255:
            raise GhptDataError(
                path,
                "joints",
                f"{name[:40]!r}... has more than 255 bytes",
                "Give it a shorter name",
            )
    starts = range(0, len(names), 255)
    return {f"LABELS{s // 255 + 1 if s else ''}": _texts(names[s : s + 255]) for s in starts}


def _texts(texts: Sequence[str]) -> bytes:
    encoded = [text.encode() for text in texts]
    width = max((len(text) for text in encoded), default=1)
    return struct.pack("<bBBB", -1, 2, width, len(encoded)) + b"".join(
        text.ljust(width) for text in encoded
    )


def _text(text: str) -> bytes:
    encoded = _cut(plain(text)).encode()
    return struct.pack("<bBB", -1, 1, len(encoded)) + encoded


def _cut(text: str) -> str:
    """At most 255 bytes of UTF-8."""
    return text.encode()[:255].decode(errors="ignore")


def _words(values: Sequence[int]) -> bytes:
    return _array(2, "H", values)


def _floats(values: Sequence[float | int]) -> bytes:
    return _array(4, "f", values)


def _array(kind: int, form: str, values: Sequence[float | int]) -> bytes:
    sizes = b"\0" if len(values) == 1 else struct.pack("<BB", 1, len(values))
    return struct.pack("<b", kind) + sizes + struct.pack(f"<{len(values)}{form}", *values)
