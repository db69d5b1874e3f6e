"""poses.html: one page with a 3D player, for any browser; it loads nothing else."""

from __future__ import annotations

import base64
import json
import math
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ghpt.export.scene import (
    Scene,
    bones_of,
    frustum,
    origin_note,
    side_of,
    title,
    to_z_up,
    upward,
)
from ghpt.export.stream import Chunks, extent, local_points, pieces
from ghpt.export.together import persons_of
from ghpt.files import atomic_write
from ghpt.geometry.masking import where
from ghpt.reconstruction import About, Reconstruction

MOST_FRAMES = 6000
"""A page holds no more: 2.5 MB with 17 joints. Of longer recordings it has every n-th frame, and
says so."""
_MOST_JOINTS = 300_000
"""In all frames of a page: those of 50 joints at the most frames, 7 MB."""
_FRUSTUM = 300.0
"""Depth at which cameras are drawn, mm."""


@dataclass(frozen=True)
class _Frames:
    """What the page plays."""

    frame: np.ndarray
    """[T]"""
    points: np.ndarray
    """[T, J, 3], mm from ``About.origin``; 0 where missing."""
    state: np.ndarray
    """[T, J]"""
    error: np.ndarray
    """[T], the mean over the observed joints, pixels; NaN where there is none."""


def write_html(path: Path, about: About, chunks: Chunks, scene: Scene | None = None) -> None:
    """Write a page that plays the skeleton, left blue and right orange.

    Filled joints are hollow, missing ones absent; below it is the reprojection error. ``scene``:
    cameras to draw. Up is the world axis nearest to the body's. Positions are relative to
    ``about.origin``, which the page tells.
    """
    whole = extent(path, about, chunks)
    most = min(MOST_FRAMES, max(1, _MOST_JOINTS // max(len(about.joints), 1)))
    stride = math.ceil(whole.count / most)
    parts = []
    up = torch.zeros(3, dtype=torch.float64)
    count = 0
    for piece in pieces(path, about, chunks):
        first = -count % stride
        parts.append(_select_frames(about, piece, slice(first, None, stride)))
        up = up + upward(about.joints, piece)
        count = count + len(piece)
    frames = _join(parts)
    to_page = to_z_up(up)
    intervals = np.diff(frames.frame)
    data = {
        "title": title(about),
        "about": _describe(about, len(frames.frame), whole.count, stride),
        "rate_hz": about.rate_hz,
        "joints": about.joints,
        "bones": bones_of(about),
        "people": persons_of(about.joints),
        "sides": [side_of(joint) for joint in about.joints],
        "stride": int(np.median(intervals)) if len(intervals) else 1,
        "frame": _base64(frames.frame, "<f8"),
        "state": _base64(frames.state, "|u1"),
        "error": _base64(frames.error, "<f4"),
        "points": _base64(frames.points @ to_page.numpy().T, "<f4"),
        "axes": to_page.T.tolist(),
        "cameras": _cameras(about, scene, to_page),
    }
    # "</script>" in a name would end the data
    text = json.dumps(data, allow_nan=False).replace("<", "\\u003c")
    head, rest = _resource("player.html").split("%DATA%")
    middle, tail = rest.split("%PLAYER%")
    with atomic_write(path, "w") as handle:
        handle.writelines([head, text, middle, _resource("player.js"), tail])


def _resource(name: str) -> str:
    file = resources.files("ghpt.export") / name
    return file.read_text(encoding="utf-8")


def _select_frames(about: About, piece: Reconstruction, rows: slice) -> _Frames:
    observed = piece.is_measured[rows]
    total = torch.where(observed, piece.error[rows], 0.0).sum(1)
    count = observed.sum(1)
    mean = torch.where(count > 0, total / count.clamp(min=1), torch.nan)
    points = where(piece.has_position, local_points(about, piece), 0.0)
    return _Frames(
        frame=piece.frame[rows].numpy(),
        points=points[rows].numpy(),
        state=piece.state[rows].numpy(),
        error=mean.numpy(),
    )


def _join(parts: list[_Frames]) -> _Frames:
    return _Frames(
        frame=np.concatenate([part.frame for part in parts]),
        points=np.concatenate([part.points for part in parts]),
        state=np.concatenate([part.state for part in parts]),
        error=np.concatenate([part.error for part in parts]),
    )


def _describe(about: About, kept: int, count: int, stride: int) -> str:
    rate = f"{about.rate_hz:g} frames/s" if about.rate_hz else None
    notes = [
        about.estimator,
        f"{len(about.camera_names)} cameras",
        f"{count} frames",
        rate or "rate unknown (played at 30 frames/s)",
        f"mm, axes: {about.world}",
    ]
    if about.smoothed:
        notes.append("smoothed")
    if stride > 1:
        notes.append(f"shown: 1 frame of {stride}, {kept} in all")
    if any(about.origin):
        notes.append(origin_note(about))
    return " · ".join(notes)


def _cameras(
    about: About,
    scene: Scene | None,
    to_page: Float[Tensor, "3 3"],
) -> list[dict[str, Any]]:
    if scene is None:
        return []
    origin = torch.tensor(about.origin, dtype=torch.float64)
    cameras = scene.cameras.relative_to(origin)
    centres = (cameras.centre @ to_page.T).tolist()
    corners = (frustum(cameras, _FRUSTUM) @ to_page.T).tolist()
    views = zip(about.camera_names, centres, corners, strict=True)
    return [{"name": name, "centre": centre, "corners": image} for name, centre, image in views]


def _base64(values: np.ndarray, dtype: str) -> str:
    data = np.ascontiguousarray(values, dtype).tobytes()
    return base64.b64encode(data).decode()
