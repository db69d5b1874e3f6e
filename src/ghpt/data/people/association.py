"""Who is who in the views of calibrated cameras: the detections of a frame that agree on one body
in space.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ghpt.data.people.tracks import extent, joined, tracks
from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.triangulation import triangulate

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
class _Views:
    """The detections of T frames, padded to P in each view."""

    index: Int[Tensor, "T V P"]
    """Of the detection; -1 where there is none."""
    points: Float[Tensor, "T V P J 2"]
    valid: Bool[Tensor, "T V P J"]
    size: Float[Tensor, "T V P"]
    """Diagonal of the box around the joints, pixels."""


def associate(
    cameras: Cameras,
    frames: int,
    row: Int[np.ndarray, " N"],
    view: Int[np.ndarray, " N"],
    key_points: Float[np.ndarray, "N J 2"],
    valid: Bool[np.ndarray, "N J"],
    confidence: Float[np.ndarray, "N J"],
) -> list[Int[np.ndarray, "T V"]]:
    """For each person, the best first, the index of their detection in each frame and view; -1
    where there is none.

    Within a frame, every two detections in two views are triangulated (undistorted pixels), and the
    body that they make projected into all views, where those detections support it that are near.
    The best supported body takes its detections, then the best of the rest, as long as two views
    agree; at last each detection goes to the body, from all of its views, that it supports most.
    From frame to frame, bodies are the same person's where their joints stay near; what is left are
    tracks, and those that are never there at once are joined, the longest first: a person who was
    seen beside another is not that one. The best person has the greatest sum, over frames and
    views, of size times mean confidence, over that of the best in the view.
    """
    if not len(row):
        return []
    size = extent(key_points, valid)
    sure = np.where(valid, confidence, 0).mean(-1)
    quality = size * sure
    best = np.array(
        [quality[view == v].max(initial=0) for v in range(int(view.max(initial=0)) + 1)]
    )
    quality = quality / np.maximum(best, 1e-9)[view]
    table = _table(frames, len(cameras.K), row, view, quality)
    members = []
    bodies = []
    known = []
    frame = []
    step = _chunk(table)
    for start in range(0, frames, step):
        part = table[start : start + step]
        views = _views(part, key_points, valid, size)
        found, of = _groups(cameras, views)
        points, there = _bodies(cameras, found, key_points, valid)
        members.append(found)
        bodies.append(points)
        known.append(there)
        frame.append(of + start)
    chosen = np.concatenate(members)
    frame = np.concatenate(frame)
    track = tracks(frame, np.concatenate(bodies), np.concatenate(known))
    worth = np.where(chosen >= 0, quality[chosen], 0).sum(1)
    return joined(frames, frame, track, worth, chosen)


def _table(
    frames: int,
    views: int,
    row: Int[np.ndarray, " N"],
    view: Int[np.ndarray, " N"],
    quality: Float[np.ndarray, " N"],
) -> Int[np.ndarray, "T V P"]:
    """The indices of the detections of each frame and view, the best first."""
    order = np.lexsort((-quality, view, row))
    place = (row * views + view)[order]
    starts = np.flatnonzero(np.diff(place, prepend=-1))
    rank = np.arange(len(place)) - np.repeat(starts, np.diff(starts, append=len(place)))
    most = min(int(rank.max(initial=0)) + 1, _MOST_PEOPLE)
    table = np.full((frames * views, most), -1)
    kept = rank < most
    table[place[kept], rank[kept]] = order[kept]
    return table.reshape(frames, views, most)


def _pairs(views: int) -> Int[Tensor, "Q 2"]:
    pairs = torch.tensor(list(combinations(range(views), 2)))
    if len(pairs) <= _MOST_PAIRS:
        return pairs
    return pairs[torch.linspace(0, len(pairs) - 1, _MOST_PAIRS).round().long()]


def _chunk(table: Int[np.ndarray, "T V P"]) -> int:
    views, people = table.shape[1:]
    bodies = len(_pairs(views)) * people**2
    return max(1, _VALUES // (bodies * views * people * 17))


def _views(
    table: Int[np.ndarray, "T V P"], key_points: np.ndarray, valid: np.ndarray, size: np.ndarray
) -> _Views:
    there = table >= 0
    return _Views(
        torch.from_numpy(table),
        torch.from_numpy(key_points[table].astype(np.float64)),
        torch.from_numpy(valid[table] & there[..., None]),
        torch.from_numpy(np.maximum(size[table], 1e-9).astype(np.float64)),
    )


def _groups(
    cameras: Cameras, views: _Views
) -> tuple[Int[np.ndarray, "G V"], Int[np.ndarray, " G"]]:
    """The detections of each body, and its frame."""
    support = _support_of_pairs(cameras, views)
    taken = views.index < 0
    members = []
    frames = []
    for _ in range(views.index.shape[2]):
        most, who = torch.where(taken[:, None], 0.0, support).max(-1)
        agrees = most > _AGREE
        enough = agrees.sum(-1) >= 2
        best = torch.where(enough, torch.where(agrees, most, 0.0).sum(-1), -1.0).argmax(-1)
        frame = torch.nonzero(enough.any(-1))[:, 0]
        seed = best[frame]
        person = torch.where(agrees[frame, seed], who[frame, seed], -1)
        at = torch.nonzero(person >= 0)
        taken[frame[at[:, 0]], at[:, 1], person[person >= 0]] = True
        members.append(person)
        frames.append(frame)
    return _settled(cameras, views, torch.cat(members), torch.cat(frames))


def _settled(
    cameras: Cameras, views: _Views, members: Int[Tensor, "G V"], frame: Int[Tensor, " G"]
) -> tuple[Int[np.ndarray, "G V"], Int[np.ndarray, " G"]]:
    """Each detection with the body that it supports most, if that has none that supports it more in
    this view.
    """
    of = (frame[:, None], torch.arange(members.shape[1]), members)
    found = triangulate(
        cameras, views.points[of], (views.valid[of] & (members >= 0)[..., None]).double()
    )
    support = _support(cameras, found.points, found.ok, views, frame)
    support = torch.where(views.index[frame] < 0, 0.0, support)
    most = torch.zeros_like(views.size).scatter_reduce_(
        0, frame[:, None, None].expand_as(support), support, "amax"
    )
    own, who = torch.where(support >= most[frame], support, 0.0).max(-1)
    settled = torch.where(own > _AGREE, views.index[frame].gather(2, who[..., None])[..., 0], -1)
    kept = (settled >= 0).sum(-1) >= 2
    return settled[kept].numpy(), frame[kept].numpy()


def _support_of_pairs(cameras: Cameras, views: _Views) -> Float[Tensor, "T S V P"]:
    """How much each detection supports each body that two detections make."""
    _, count, people = views.index.shape
    pairs = _pairs(count)
    first, second = (
        x.reshape(-1)
        for x in torch.meshgrid(torch.arange(people), torch.arange(people), indexing="ij")
    )
    who = torch.stack([first, second], -1)
    of_view = pairs[:, None].expand(-1, len(who), -1).reshape(-1, 2)
    of_person = who[None].expand(len(pairs), -1, -1).reshape(-1, 2)
    pixels = views.points[:, of_view, of_person]
    valid = views.valid[:, of_view, of_person]
    two = triangulate(cameras.index(of_view), pixels, valid.double())
    frame = torch.arange(len(views.index))[:, None].expand(two.points.shape[:2]).reshape(-1)
    support = _support(cameras, two.points.flatten(0, 1), two.ok.flatten(0, 1), views, frame)
    return support.unflatten(0, two.points.shape[:2])


def _support(
    cameras: Cameras,
    bodies: Float[Tensor, "G J 3"],
    known: Bool[Tensor, "G J"],
    views: _Views,
    frame: Int[Tensor, " G"],
) -> Float[Tensor, "G V P"]:
    """Mean over the joints that both have of 1 - distance / (_FAR x size), at least 0; 0 where they
    share too few.
    """
    shown, depth = project(cameras, bodies)
    both = (known[:, None] & (depth > 0))[:, :, None] & views.valid[frame]
    apart = torch.linalg.vector_norm(shown[:, :, None] - views.points[frame], dim=-1)
    near = (1 - apart / (_FAR * views.size[frame])[..., None]).clamp(min=0)
    count = both.sum(-1)
    return torch.where(
        count >= _LEAST_JOINTS, torch.where(both, near, 0.0).sum(-1) / count.clamp(min=1), 0.0
    )


def _bodies(
    cameras: Cameras, members: Int[np.ndarray, "G V"], key_points: np.ndarray, valid: np.ndarray
) -> tuple[Float[np.ndarray, "G J 3"], Bool[np.ndarray, "G J"]]:
    used = valid[members] & (members >= 0)[..., None]
    found = triangulate(
        cameras,
        torch.from_numpy(key_points[members].astype(np.float64)),
        torch.from_numpy(used).double(),
    )
    return found.points.numpy(), found.ok.numpy()
