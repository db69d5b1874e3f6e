"""poses.c3d: points in the binary format of motion capture (c3d.org): Intel order, floats."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ghpt.errors import GhptDataError
from ghpt.export.stream import (
    Chunks,
    equidistant_extent,
    equidistant_pieces,
    local_points,
    plain,
    plain_names,
    require_rate,
)
from ghpt.files import atomic_write
from ghpt.geometry.masking import where
from ghpt.reconstruction import About, Reconstruction

_BLOCK = 512
_MOST = 65_535
"""The largest number of 16 bits."""
RESIDUAL_STEP = 0.25
"""Pixels of one step of a residual, which has 8 bits: up to 63.75 px. It is POINT:SCALE too, so
programs that store points as integers reach 8 m.
"""
_CAMERAS = 7
"""Bits of a camera mask."""
_MAGIC = 0x50
_LONGEST = 255
"""Bytes of a text, and blocks of the parameters."""
_SHORTER = "Give them shorter names"

Groups = dict[str, dict[str, bytes]]
"""Encoded parameters by name, for each group."""


def write_c3d(path: Path, about: About, chunks: Chunks) -> None:
    """Write a frame for each number from the first to the last, in mm, counted from 1.

    ``GHPT:FIRST_FRAME`` is the own number of the first, as text. A missing joint is (0, 0, 0) with
    residual -1, a filled one has residual 0 and no camera, as the format prescribes; else the
    residual is the reprojection error in pixels (0.25 to 63.75) and the mask the first seven views
    that made it. Above 65,535 frames the count is in TRIAL:ACTUAL_END_FIELD and POINT:LONG_FRAMES.

    The format's coordinates have single precision, so positions are relative to ``about.origin``.
    Where that is not the world's own zero, GHPT:ORIGIN is it: x, y and z in mm, as text, because a
    number has too few digits.

    Raises GhptConfigError where the rate is unknown and GhptDataError for names that the format
    cannot hold.
    """
    rate = require_rate(about, "C3D")
    whole = equidistant_extent(path, about, chunks)
    frames = whole.last - whole.first + 1
    parameters = _parameters(path, about, rate, frames, whole.first)
    data_start = 2 + len(parameters) // _BLOCK
    with atomic_write(path) as handle:
        handle.write(_header(len(about.joints), frames, rate, data_start))
        handle.write(parameters)
        written = 0
        for piece in equidistant_pieces(path, about, chunks, whole):
            written += handle.write(_points(about, piece).tobytes())
        # of longer files readers take all that follows for frames, up to the file's end
        if frames < _MOST:
            handle.write(bytes(-written % _BLOCK))


def _header(joints: int, frames: int, rate: float, data_start: int) -> bytes:
    """Return the first block."""
    header = struct.pack(
        "<BBHHHHHfHHf",
        2,  # the block of the parameters
        _MAGIC,
        joints,
        0,  # analog measurements in a frame
        1,  # the first frame
        min(frames, _MOST),
        0,  # the largest gap that was filled
        -RESIDUAL_STEP,
        data_start,
        0,  # analog samples in a frame
        rate,
    )
    return header.ljust(_BLOCK, b"\0")


def _points(about: About, piece: Reconstruction) -> np.ndarray:
    """Return x, y, z and a word, float32 [T, J, 4].

    The word has the mask of cameras in the high byte and the residual in the low one.
    """
    has_position = piece.has_position
    observed = piece.is_measured
    bits = 2 ** torch.arange(min(_CAMERAS, piece.views.shape[1]))
    mask = (piece.views[:, :_CAMERAS] * bits[:, None]).sum(1)
    steps = (piece.error / RESIDUAL_STEP).round().nan_to_num(255.0)
    residual = steps.clamp(1, 255).long()
    unobserved = torch.where(has_position, 0, -1)
    word = torch.where(observed, 256 * mask + residual, unobserved)
    points = where(has_position, local_points(about, piece), 0.0)
    values = torch.cat([points, word[..., None].double()], dim=-1)
    return values.numpy().astype("<f4")


def _parameters(path: Path, about: About, rate: float, frames: int, first: int) -> bytes:
    """Return the blocks of the parameters."""
    # the records are as long whatever number DATA_START is
    length = len(_records(path, _groups(path, about, rate, frames, first, data_start=0)))
    blocks = -(-(4 + length + 1) // _BLOCK)  # a zero ends the records
    if blocks > _LONGEST:
        raise GhptDataError(path, "joints, camera_names", "are too long for C3D", _SHORTER)
    records = _records(path, _groups(path, about, rate, frames, first, 2 + blocks))
    start = struct.pack("<BBBB", 1, _MAGIC, blocks, 84)
    return (start + records).ljust(blocks * _BLOCK, b"\0")


def _groups(
    path: Path,
    about: About,
    rate: float,
    frames: int,
    first: int,
    data_start: int,
) -> Groups:
    names = plain_names(path, "joints", about.joints)
    cameras = [_truncate(plain(name)) for name in about.camera_names]
    point = {
        "USED": _words([len(names)]),
        "SCALE": _floats([-RESIDUAL_STEP]),
        "RATE": _floats([rate]),
        "DATA_START": _words([data_start]),
        "FRAMES": _words([min(frames, _MOST)]),
    }
    if frames >= _MOST:
        point |= {"LONG_FRAMES": _floats([frames])}
    point |= {"UNITS": _text("mm"), **_labels(path, names)}
    trial = {
        "ACTUAL_START_FIELD": _words([1, 0]),
        "ACTUAL_END_FIELD": _words([frames % 65536, frames // 65536]),
    }
    own = {
        "NAME": _text(about.name),
        "SOURCE": _text(about.source),
        "ESTIMATOR": _text(about.estimator),
        "SMOOTHED": _text("yes" if about.smoothed else "no"),
        "FIRST_FRAME": _text(str(first)),
        "RESIDUAL_UNIT": _text("px"),
        "WORLD": _text(about.world),
        "CAMERAS": _texts(cameras),
    }
    if any(about.origin):
        own |= {"ORIGIN": _texts([f"{x:.15g}" for x in about.origin])}
    return {"POINT": point, "ANALOG": {"USED": _words([0])}, "TRIAL": trial, "GHPT": own}


def _records(path: Path, groups: Groups) -> bytes:
    records = []
    for number, (group, values) in enumerate(groups.items(), 1):
        records.append(struct.pack("<bb", len(group), -number))
        records.append(group.encode())
        records.append(struct.pack("<HB", 3, 0))
        for name, value in values.items():
            length = len(value) + 3
            if length > 32767:
                raise GhptDataError(path, name, "are too long together for C3D", _SHORTER)
            records.append(struct.pack("<bb", len(name), number))
            records.append(name.encode())
            records.append(struct.pack("<H", length))
            records.append(value + b"\0")
    return b"".join(records)


def _labels(path: Path, names: Sequence[str]) -> dict[str, bytes]:
    """Return LABELS, LABELS2, ...: 255 each."""
    for name in names:
        if len(name.encode()) > _LONGEST:
            problem = f"{name[:40]!r}... has more than 255 bytes"
            raise GhptDataError(path, "joints", problem, "Give it a shorter name")
    labels = {}
    for start in range(0, len(names), _LONGEST):
        number = start // _LONGEST + 1
        suffix = str(number) if number > 1 else ""
        labels[f"LABELS{suffix}"] = _texts(names[start : start + _LONGEST])
    return labels


def _texts(texts: Sequence[str]) -> bytes:
    encoded = [text.encode() for text in texts]
    width = max((len(text) for text in encoded), default=1)
    start = struct.pack("<bBBB", -1, 2, width, len(encoded))
    return start + b"".join(text.ljust(width) for text in encoded)


def _text(text: str) -> bytes:
    encoded = _truncate(plain(text)).encode()
    return struct.pack("<bBB", -1, 1, len(encoded)) + encoded


def _truncate(text: str) -> str:
    """Return at most 255 bytes of UTF-8."""
    return text.encode()[:_LONGEST].decode(errors="ignore")


def _words(values: Sequence[int]) -> bytes:
    return _array(2, "H", values)


def _floats(values: Sequence[float | int]) -> bytes:
    return _array(4, "f", values)


def _array(kind: int, form: str, values: Sequence[float | int]) -> bytes:
    count = len(values)
    sizes = b"\0" if count == 1 else struct.pack("<BB", 1, count)
    return struct.pack("<b", kind) + sizes + struct.pack(f"<{count}{form}", *values)
