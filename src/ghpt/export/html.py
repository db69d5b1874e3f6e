"""poses.html: one page with a 3D player, for any browser; it loads nothing else but videos."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import resources
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ghpt.export.packing import Packed, pack_floats, pack_integers
from ghpt.export.scene import (
    Evidence,
    Scene,
    bones_of,
    frustum,
    origin_note,
    side_of,
    title,
    to_z_up,
    upward,
)
from ghpt.export.stream import Chunks, extent, local_points, part, pieces
from ghpt.export.together import persons_of
from ghpt.files import atomic_write
from ghpt.geometry.lens import COEFFICIENTS
from ghpt.geometry.masking import where
from ghpt.reconstruction import About, Reconstruction

MOST_FRAMES = 40_000
"""A page holds no more. Of longer recordings it has every n-th frame, and says so."""
_MOST_JOINTS = 2_000_000
"""In all frames of a page."""
_MOST_KEY_POINTS = 4_000_000
"""In all views of all frames."""
_FRUSTUM = 300.0
"""Depth at which cameras are drawn, mm."""
_POINT_STEP = 0.5
"""mm: how finely positions are kept."""
_PIXEL_STEP = 0.25
_ERROR_STEP = 0.05
"""Pixels."""


@dataclass(frozen=True)
class _Frames:
    """What the page plays."""

    frame: Int[np.ndarray, " T"]
    points: Float[np.ndarray, "T J 3"]
    """mm from ``About.origin``; NaN where missing."""
    state: Int[np.ndarray, "T J"]
    error: Float[np.ndarray, " T"]
    """The mean over the observed joints, pixels; NaN where there is none."""
    key_points: Float[np.ndarray, "T V K 2"]
    """Undistorted pixels, NaN where missing; K is 0 without evidence."""


def write_html(path: Path, about: About, chunks: Chunks, scene: Scene | None = None) -> None:
    """Write a page that plays the skeleton, left blue and right orange.

    Filled joints are hollow, missing ones absent; below it is the reprojection error. ``scene``:
    cameras to draw, and with evidence their views, in which the key points are beside the
    reprojected joints. Up is the world axis nearest to the body's. Positions are relative to
    ``about.origin``, which the page tells, and rounded to 0.5 mm (in a recording larger than 30 m
    to more), key points to 0.25 pixels.
    """
    whole = extent(path, about, chunks)
    stride = _stride(about, scene, whole.count)
    parts = []
    up = torch.zeros(3, dtype=torch.float64)
    count = 0
    for piece, evidence in _pieces_with_evidence(path, about, chunks, scene):
        rows = slice(-count % stride, None, stride)
        parts.append(_select_frames(about, piece, evidence, rows))
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
        "frame": _runs(frames.frame),
        "state": pack_integers(frames.state).plain(),
        "error": pack_floats(frames.error, _ERROR_STEP).plain(),
        "points": pack_floats(frames.points @ to_page.numpy().T, _POINT_STEP).plain(),
        "axes": to_page.T.tolist(),
        "cameras": _cameras(about, scene, to_page),
        **_evidence_data(scene, frames.key_points),
        "others": _others(about, scene, frames.frame, to_page),
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


def _stride(about: About, scene: Scene | None, count: int) -> int:
    """Return of how many frames the page has one."""
    most = min(MOST_FRAMES, _MOST_JOINTS // max(len(about.joints), 1))
    if scene is not None and scene.evidence is not None:
        seen = len(about.camera_names) * len(about.joints)
        most = min(most, _MOST_KEY_POINTS // max(seen, 1))
    return math.ceil(count / max(most, 1))


def _pieces_with_evidence(
    path: Path, about: About, chunks: Chunks, scene: Scene | None
) -> Iterator[tuple[Reconstruction, Evidence | None]]:
    if scene is None or scene.evidence is None:
        yield from zip(pieces(path, about, chunks), repeat(None), strict=False)
        return
    evidence = scene.evidence()
    for chunk in chunks():
        own = next(evidence)
        start = 0
        for piece in pieces(path, about, lambda chunk=chunk: iter([chunk])):  # type: ignore[misc]
            yield piece, own.part(start, start + len(piece))
            start += len(piece)


def _select_frames(
    about: About, piece: Reconstruction, evidence: Evidence | None, rows: slice
) -> _Frames:
    chosen = part(piece, 0, len(piece))
    observed = chosen.is_measured[rows]
    total = torch.where(observed, chosen.error[rows], 0.0).sum(1)
    count = observed.sum(1)
    mean = torch.where(count > 0, total / count.clamp(min=1), torch.nan)
    points = where(chosen.has_position, local_points(about, chosen), torch.nan)
    key_points = points.new_zeros(len(mean), len(about.camera_names), 0, 2)
    if evidence is not None:
        key_points = where(evidence.valid[rows], evidence.key_points[rows].double(), torch.nan)
    return _Frames(
        frame=chosen.frame[rows].numpy(),
        points=points[rows].numpy(),
        state=chosen.state[rows].numpy(),
        error=mean.numpy(),
        key_points=key_points.numpy(),
    )


def _join(parts: list[_Frames]) -> _Frames:
    return _Frames(
        frame=np.concatenate([part.frame for part in parts]),
        points=np.concatenate([part.points for part in parts]),
        state=np.concatenate([part.state for part in parts]),
        error=np.concatenate([part.error for part in parts]),
        key_points=np.concatenate([part.key_points for part in parts]),
    )


def _runs(frame: Int[np.ndarray, " T"]) -> list[tuple[int, int, int]]:
    """Return the numbers as runs: the first, the step, and how many there are."""
    runs: list[tuple[int, int, int]] = []
    for number in frame.tolist():
        if runs:
            first, step, count = runs[-1]
            if count == 1:
                runs[-1] = (first, number - first, 2)
                continue
            if number == first + step * count:
                runs[-1] = (first, step, count + 1)
                continue
        runs.append((number, 1, 1))
    return runs


def _describe(about: About, kept: int, count: int, stride: int) -> str:
    rate = f"{about.rate_hz:g} frames/s" if about.rate_hz else None
    notes = [
        "synthetic data" if about.source == "synthetic" else about.source,
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
    count = len(about.camera_names)
    images = scene.images
    lens = torch.zeros(count, COEFFICIENTS) if images is None else images.lens
    size = 2 * cameras.K[:, :2, 2] if images is None else images.size
    videos = (images.videos if images is not None else ()) or (None,) * count
    columns = {
        "centre": cameras.centre @ to_page.T,
        "corners": frustum(cameras, _FRUSTUM) @ to_page.T,
        "R": (cameras.R @ to_page.T).flatten(1),
        "t": cameras.t,
        "K": cameras.K.flatten(1),
        "lens": lens,
        "size": size,
    }
    views = []
    for view, name in enumerate(about.camera_names):
        numbers = {column: values[view].tolist() for column, values in columns.items()}
        views.append({"name": name, "video": videos[view], **numbers})
    return views


def _evidence_data(scene: Scene | None, key_points: Float[np.ndarray, "T V K 2"]) -> dict[str, Any]:
    """Return the key points, how many there are in a view, and which joints they are."""
    kinds = key_points.shape[2]
    pairs = scene.key_point_joints if scene is not None else ()
    packed: Packed | None = None
    if kinds and np.isfinite(key_points).any():
        packed = pack_floats(key_points, _PIXEL_STEP)
    return {
        "kinds": kinds,
        "pairs": pairs,
        "key_points": None if packed is None else packed.plain(),
    }


def _others(
    about: About,
    scene: Scene | None,
    frame: Int[np.ndarray, " T"],
    to_page: Float[Tensor, "3 3"],
) -> list[dict[str, Any]]:
    if scene is None:
        return []
    origin = torch.tensor(about.origin, dtype=torch.float64)
    found = []
    for other in scene.others:
        points = (other.points(torch.from_numpy(frame)) - origin) @ to_page.T
        packed = pack_floats(points.numpy(), _POINT_STEP).plain()
        joints = points.shape[1]
        found.append({"name": other.name, "bones": other.bones, "joints": joints, "points": packed})
    return found
