"""poses.html: one page with a 3D player, for any browser; it loads nothing else."""

from __future__ import annotations

import base64
import json
import math
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ghpt.export.scene import (
    Scene,
    bones_of,
    frustum,
    origin_note,
    side_of,
    title,
    to_z_up,
    upright,
)
from ghpt.export.stream import Chunks, extent, pieces, points_of_origin
from ghpt.files import atomic_write
from ghpt.reconstruction import About, Reconstruction, State

MOST_FRAMES = 6000
"""A page holds no more: 2.5 MB. Of longer recordings it has every n-th frame, and says so."""
_FRUSTUM = 300.0
"""Depth at which cameras are drawn, mm."""


def write_html(path: Path, about: About, chunks: Chunks, scene: Scene | None = None) -> None:
    """A page that plays the skeleton: left blue, right orange; filled joints hollow, missing ones
    absent; below it the reprojection error. ``scene``: cameras to draw. Up is the world axis
    nearest to the body's.

    Positions are relative to ``about.origin``, which the page tells."""
    whole = extent(path, about, chunks)
    stride = math.ceil(whole.count / MOST_FRAMES)
    arrays = []
    up = torch.zeros(3, dtype=torch.float64)
    at = 0
    for piece in pieces(path, about, chunks):
        arrays.append(_arrays(about, piece, slice(-at % stride, None, stride)))
        up = up + upright(about.joints, piece)
        at = at + len(piece)
    turn = to_z_up(up)
    frame, points, state, error = (np.concatenate(parts) for parts in zip(*arrays, strict=True))
    # The distance of the frames that are kept, in frame numbers.
    step = int(np.median(np.diff(frame))) if len(frame) > 1 else 1
    data = {
        "title": title(about),
        "about": _about(about, len(frame), whole.count, stride),
        "rate_hz": about.rate_hz,
        "joints": about.joints,
        "bones": bones_of(about.joints),
        "sides": [side_of(joint) for joint in about.joints],
        "stride": step,
        "frame": _base64(frame, "<f8"),
        "state": _base64(state, "|u1"),
        "error": _base64(error, "<f4"),
        "points": _base64(points @ turn.numpy().T, "<f4"),
        "axes": turn.T.tolist(),
        "cameras": _cameras(about, scene, turn),
    }
    text = json.dumps(data, allow_nan=False).replace(
        "<", "\\u003c"
    )  # "</script>" in a name would end the data
    folder = resources.files("ghpt.export")
    page, player = (
        (folder / file).read_text(encoding="utf-8") for file in ("player.html", "player.js")
    )
    before, between, after = _split(page, "%DATA%", "%PLAYER%")
    with atomic_write(path, "w") as handle:
        handle.writelines([before, text, between, player, after])


def _split(page: str, first: str, second: str) -> tuple[str, str, str]:
    before, rest = page.split(first)
    between, after = rest.split(second)
    return before, between, after


def _arrays(about: About, piece: Reconstruction, kept: slice) -> tuple[np.ndarray, ...]:
    """frame, points, state and the mean error of the observed joints (NaN: none), of the frames
    kept.
    """
    observed = (piece.state == State.OBSERVED)[kept]
    total = torch.where(observed, piece.error[kept], 0.0).sum(1)
    mean = torch.where(observed.any(1), total / observed.sum(1).clamp(min=1), torch.nan)
    points = torch.where(piece.has_position[..., None], points_of_origin(about, piece), 0.0)[kept]
    return tuple(value.numpy() for value in (piece.frame[kept], points, piece.state[kept], mean))


def _about(about: About, shown: int, count: int, stride: int) -> str:
    words = [f"{about.estimator}", f"{len(about.camera_names)} cameras", f"{count} frames"]
    words += [
        f"{about.rate_hz:g} frames/s" if about.rate_hz else "rate unknown (played at 30 frames/s)"
    ]
    words += ["smoothed"] if about.smoothed else []
    words += [f"shown: 1 frame of {stride}, {shown} in all"] if stride > 1 else []
    words += [origin_note(about)] if origin_note(about) else []
    return " · ".join(words)


def _cameras(about: About, scene: Scene | None, turn: torch.Tensor) -> list[dict[str, Any]]:
    if scene is None:
        return []
    cameras = scene.cameras.relative_to(torch.tensor(about.origin, dtype=torch.float64))
    centres = cameras.centre @ turn.T
    corners = frustum(cameras, _FRUSTUM) @ turn.T
    each = zip(about.camera_names, centres.tolist(), corners.tolist(), strict=True)
    return [{"name": name, "centre": centre, "corners": points} for name, centre, points in each]


def _base64(values: np.ndarray, dtype: str) -> str:
    return base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode()
