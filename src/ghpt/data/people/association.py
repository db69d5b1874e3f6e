"""Persons told apart in the views of calibrated cameras.

The detections of a frame that agree on one body in space are one person's.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.data.people.tracks import Bodies, box_diagonal, join_tracks, track_bodies
from ghpt.data.points import KeyPoints
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.triangulation import Triangulation, triangulate

_FAR = 0.12
"""Distance of a joint, as a part of the size of the person in the image, at which it says nothing
for a body.
"""
_AGREE = 0.4
"""A detection agrees with a body that it supports by more, of at most 1."""
_LEAST_JOINTS = 4
"""Joints that a detection and a body must share to be compared."""
_MOST_PEOPLE = 8
_MOST_PAIRS = 32
"""Of more people in a view the best are taken; of more pairs of views, so many spread evenly."""
_VALUES = 1 << 22
"""Distances that are in memory at once."""


@dataclass(frozen=True)
class _Candidates:
    """The detections of T frames, padded to P in each view."""

    index: Int[Tensor, "T V P"]
    """Of the detection; -1 where there is none."""
    points: Float[Tensor, "T V P J 2"]
    valid: Bool[Tensor, "T V P J"]
    scale: Float[Tensor, "T V P"]
    """Diagonal of the box around the joints, pixels."""


def associate(
    cameras: Cameras,
    frames: int,
    row: Int[np.ndarray, " N"],
    view: Int[np.ndarray, " N"],
    points: KeyPoints,
) -> list[Int[np.ndarray, "T V"]]:
    """Return for each person the index of their detection in each frame and view.

    It is -1 where there is none; the best person comes first. ``row`` and ``view`` are those of the
    N detections, whose undistorted key points are ``points`` [N J].

    1. Within a frame, every two detections in two views are triangulated, and the body that they
       make is projected into all views, where those detections support it that are near.
    2. The best supported body takes its detections, then the best of the rest, as long as two views
       agree; at last each detection goes to the body, from all of its views, that it supports most.
    3. From frame to frame, bodies are the same person's where their joints stay near; what is left
       are tracks, and those that are never there at once are joined, the longest first: a person
       who was seen beside another is not that one.
    4. The best person has the greatest sum, over frames and views, of size times mean confidence,
       over that of the best in the view.
    """
    if not len(row):
        return []
    scale = box_diagonal(points.pixels, points.valid)
    prominence = _prominence(points, scale, view)
    table = _table(frames, len(cameras.K), row, view, prominence)
    members = []
    parts = []
    step = _frames_at_once(table)
    for start in range(0, frames, step):
        candidates = _pad(table[start : start + step], points, scale)
        found, frame = _group(cameras, candidates)
        members.append(found)
        parts.append(_triangulate_bodies(cameras, found, frame + start, points))
    chosen = np.concatenate(members)
    bodies = Bodies(
        frame=np.concatenate([part.frame for part in parts]),
        points=np.concatenate([part.points for part in parts]),
        valid=np.concatenate([part.valid for part in parts]),
    )
    worth = np.where(chosen >= 0, prominence[chosen], 0).sum(1)
    return join_tracks(frames, bodies, track_bodies(bodies), worth, chosen)


def _prominence(
    points: KeyPoints, scale: Float[np.ndarray, " N"], view: Int[np.ndarray, " N"]
) -> Float[np.ndarray, " N"]:
    """Return each detection's size times mean confidence, over that of the best in its view."""
    confidence = np.where(points.valid, points.confidence, 0).mean(-1)
    prominence = scale * confidence
    views = range(int(view.max(initial=0)) + 1)
    best = np.array([prominence[view == v].max(initial=0) for v in views])
    return prominence / np.maximum(best, 1e-9)[view]


def _table(
    frames: int,
    views: int,
    row: Int[np.ndarray, " N"],
    view: Int[np.ndarray, " N"],
    prominence: Float[np.ndarray, " N"],
) -> Int[np.ndarray, "T V P"]:
    """Return the indices of the detections of each frame and view, the best first."""
    order = np.lexsort((-prominence, view, row))
    cell = (row * views + view)[order]
    starts = np.flatnonzero(np.diff(cell, prepend=-1))
    lengths = np.diff(starts, append=len(cell))
    rank = np.arange(len(cell)) - np.repeat(starts, lengths)
    most = min(int(rank.max(initial=0)) + 1, _MOST_PEOPLE)
    table = np.full((frames * views, most), -1)
    kept = rank < most
    table[cell[kept], rank[kept]] = order[kept]
    return table.reshape(frames, views, most)


def _view_pairs(views: int) -> Int[Tensor, "Q 2"]:
    pairs = torch.tensor(list(combinations(range(views), 2)))
    if len(pairs) <= _MOST_PAIRS:
        return pairs
    return pairs[torch.linspace(0, len(pairs) - 1, _MOST_PAIRS).round().long()]


def _frames_at_once(table: Int[np.ndarray, "T V P"]) -> int:
    views, people = table.shape[1:]
    bodies = len(_view_pairs(views)) * people**2
    return max(1, _VALUES // (bodies * views * people * 17))


def _pad(
    table: Int[np.ndarray, "T V P"], points: KeyPoints, scale: Float[np.ndarray, " N"]
) -> _Candidates:
    there = table >= 0
    valid = points.valid[table] & there[..., None]
    return _Candidates(
        index=torch.from_numpy(table),
        points=torch.from_numpy(points.pixels[table].astype(np.float64)),
        valid=torch.from_numpy(valid),
        scale=torch.from_numpy(np.maximum(scale[table], 1e-9).astype(np.float64)),
    )


def _group(
    cameras: Cameras, candidates: _Candidates
) -> tuple[Int[np.ndarray, "G V"], Int[np.ndarray, " G"]]:
    """Return the detections of each body, and its frame."""
    support = _support_of_pairs(cameras, candidates)
    taken = candidates.index < 0
    members = []
    frames = []
    for _ in range(candidates.index.shape[2]):
        most, detection = torch.where(taken[:, None], 0.0, support).max(-1)
        agrees = most > _AGREE
        enough = agrees.sum(-1) >= 2
        total = torch.where(agrees, most, 0.0).sum(-1)
        best = torch.where(enough, total, -1.0).argmax(-1)
        frame = torch.nonzero(enough.any(-1))[:, 0]
        seed = best[frame]
        person = torch.where(agrees[frame, seed], detection[frame, seed], -1)
        at = torch.nonzero(person >= 0)
        taken[frame[at[:, 0]], at[:, 1], person[person >= 0]] = True
        members.append(person)
        frames.append(frame)
    return _settle(cameras, candidates, torch.cat(members), torch.cat(frames))


def _settle(
    cameras: Cameras, candidates: _Candidates, members: Int[Tensor, "G V"], frame: Int[Tensor, " G"]
) -> tuple[Int[np.ndarray, "G V"], Int[np.ndarray, " G"]]:
    """Give each detection to the body that it supports most.

    The body gets it if none supports that body more in this view.
    """
    own = (frame[:, None], torch.arange(members.shape[1]), members)
    valid = candidates.valid[own] & (members >= 0)[..., None]
    found = triangulate(cameras, candidates.points[own], valid.double())
    support = _support(cameras, found, candidates, frame)
    support = torch.where(candidates.index[frame] < 0, 0.0, support)
    rows = frame[:, None, None].expand_as(support)
    most = torch.zeros_like(candidates.scale).scatter_reduce_(0, rows, support, "amax")
    strongest = torch.where(support >= most[frame], support, 0.0)
    value, detection = strongest.max(-1)
    index = candidates.index[frame].gather(2, detection[..., None])[..., 0]
    settled = torch.where(value > _AGREE, index, -1)
    kept = (settled >= 0).sum(-1) >= 2
    return settled[kept].numpy(), frame[kept].numpy()


def _support_of_pairs(cameras: Cameras, candidates: _Candidates) -> Float[Tensor, "T S V P"]:
    """Return how much each detection supports each body that two detections make."""
    frames, count, people = candidates.index.shape
    pairs = _view_pairs(count)
    person = torch.arange(people)
    first, second = torch.meshgrid(person, person, indexing="ij")
    persons = torch.stack([first.reshape(-1), second.reshape(-1)], -1)
    of_view = pairs[:, None].expand(-1, len(persons), -1).reshape(-1, 2)
    of_person = persons[None].expand(len(pairs), -1, -1).reshape(-1, 2)
    pixels = candidates.points[:, of_view, of_person]
    valid = candidates.valid[:, of_view, of_person]
    two = triangulate(cameras.index(of_view), pixels, valid.double())
    bodies = two.points.shape[1]
    frame = torch.arange(frames)[:, None].expand(frames, bodies).reshape(-1)
    flat = Triangulation(*(getattr(two, field.name).flatten(0, 1) for field in fields(two)))
    support = _support(cameras, flat, candidates, frame)
    return support.unflatten(0, (frames, bodies))


def _support(
    cameras: Cameras, bodies: Triangulation, candidates: _Candidates, frame: Int[Tensor, " G"]
) -> Float[Tensor, "G V P"]:
    """Return how much each detection of its frame supports each body.

    It is the mean, over the joints that both have, of 1 - distance / (_FAR x scale), at least 0;
    and 0 where they share too few.
    """
    projected, depth = project(cameras, bodies.points)
    visible = bodies.ok[:, None] & (depth > 0)
    both = visible[:, :, None] & candidates.valid[frame]
    offset = projected[:, :, None] - candidates.points[frame]
    distance = torch.linalg.vector_norm(offset, dim=-1)
    reach = (_FAR * candidates.scale[frame])[..., None]
    near = (1 - distance / reach).clamp(min=0)
    count = both.sum(-1)
    mean = torch.where(both, near, 0.0).sum(-1) / count.clamp(min=1)
    return torch.where(count >= _LEAST_JOINTS, mean, 0.0)


def _triangulate_bodies(
    cameras: Cameras,
    members: Int[np.ndarray, "G V"],
    frame: Int[np.ndarray, " G"],
    points: KeyPoints,
) -> Bodies:
    valid = points.valid[members] & (members >= 0)[..., None]
    pixels = torch.from_numpy(points.pixels[members].astype(np.float64))
    found = triangulate(cameras, pixels, torch.from_numpy(valid).double())
    return Bodies(frame, found.points.numpy(), found.ok.numpy())
