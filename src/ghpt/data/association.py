"""Who is who in the views of calibrated cameras: the detections of a frame that agree on one body in space."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from ghpt.geometry.cameras import Cameras, project
from ghpt.geometry.triangulation import Status, triangulate

_AGREE = 0.12
"""A detection agrees with a body where the median distance of their joints is below this part of its size."""
_LEAST_JOINTS = 4
"""Joints that a detection and a body must share to be compared."""
_MOST_PEOPLE, _MOST_PAIRS = 8, 32
"""Of more people in a view the best are taken; of more pairs of views, so many spread evenly."""
_NEAR = 0.35
"""A body is another frame's if the median distance of their joints is below this part of its height."""
_MOST_TRACKS = 64
"""That are followed at once: those seen last."""
_VALUES = 1 << 22
"""Distances that are in memory at once."""


@dataclass(frozen=True)
class _Views:
    """The detections of T frames, padded to P in each view."""

    index: Int[Tensor, "T V P"]
    """Of the detection; -1 where there is none."""
    points: Float[Tensor, "T V P J 2"]
    seen: Bool[Tensor, "T V P J"]
    size: Float[Tensor, "T V P"]
    """Diagonal of the box around the joints, pixels."""


def associate(
    cameras: Cameras,
    frames: int,
    row: Int[np.ndarray, " N"],
    view: Int[np.ndarray, " N"],
    key_points: Float[np.ndarray, "N J 2"],
    seen: Bool[np.ndarray, "N J"],
    confidence: Float[np.ndarray, "N J"],
) -> list[Int[np.ndarray, "T V"]]:
    """For each person, the best first, the index of their detection in each frame and view; -1 where there is none.

    Within a frame, every two detections in two views are triangulated (undistorted pixels), and the body that they make
    projected into all views: it is supported by the nearest detection of each view, as far as that agrees with it. The
    best supported body takes its detections, then the best of the rest, as long as two views agree. From frame to
    frame, bodies are the same person's where their joints stay near; what is left are tracks, and those that are never
    there at once are joined, the longest first: a person who was seen beside another is not that one. The best person
    has the greatest sum, over frames and views, of size times mean confidence, over that of the best in the view.
    """
    size, sure = _size(key_points, seen), np.where(seen, confidence, 0).mean(-1)
    quality = size * sure
    best = np.array([quality[view == v].max(initial=0) for v in range(int(view.max(initial=0)) + 1)])
    quality = quality / np.maximum(best, 1e-9)[view]
    table = _table(frames, len(cameras.K), row, view, quality)
    members, bodies, known, frame = [], [], [], []
    step = _chunk(table)
    for start in range(0, frames, step):
        part = table[start : start + step]
        views = _views(part, key_points, seen, size)
        found, of = _groups(cameras, views)
        points, there = _bodies(cameras, found, key_points, seen)
        members.append(found)
        bodies.append(points)
        known.append(there)
        frame.append(of + start)
    chosen, frame = np.concatenate(members), np.concatenate(frame)
    track = _tracks(frame, np.concatenate(bodies), np.concatenate(known))
    worth = np.where(chosen >= 0, quality[chosen], 0).sum(1)
    return _people(frames, frame, track, worth, chosen)


def _size(key_points: Float[np.ndarray, "N J 2"], seen: Bool[np.ndarray, "N J"]) -> Float[np.ndarray, " N"]:
    low = np.where(seen[..., None], key_points, np.inf).min(1)
    high = np.where(seen[..., None], key_points, -np.inf).max(1)
    return np.linalg.norm(np.where(np.isfinite(low), high - np.where(np.isfinite(low), low, 0), 0), axis=-1)


def _table(
    frames: int, views: int, row: Int[np.ndarray, " N"], view: Int[np.ndarray, " N"], quality: Float[np.ndarray, " N"]
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


def _views(table: Int[np.ndarray, "T V P"], key_points: np.ndarray, seen: np.ndarray, size: np.ndarray) -> _Views:
    there = table >= 0
    return _Views(
        torch.from_numpy(table),
        torch.from_numpy(key_points[table].astype(np.float64)),
        torch.from_numpy(seen[table] & there[..., None]),
        torch.from_numpy(np.maximum(size[table], 1e-9)),
    )


def _groups(cameras: Cameras, views: _Views) -> tuple[Int[np.ndarray, "G V"], Int[np.ndarray, " G"]]:
    """The detections of each body, and its frame."""
    distance = _distances(cameras, views)
    taken = views.index < 0
    members, frames = [], []
    for _ in range(views.index.shape[2]):
        nearest, who = torch.where(taken[:, None], torch.inf, distance).min(-1)
        support = (1 - nearest / _AGREE).clamp(min=0)
        enough = (support > 0).sum(-1) >= 2
        best = torch.where(enough, support.sum(-1), 0.0).argmax(-1)
        frame = torch.nonzero(enough.any(-1))[:, 0]
        seed = best[frame]
        agrees, person = support[frame, seed] > 0, who[frame, seed]
        at = (frame[:, None].expand_as(person)[agrees], torch.arange(person.shape[1]).expand_as(person)[agrees])
        taken[(*at, person[agrees])] = True
        found = torch.where(agrees, views.index[frame].gather(2, person[..., None])[..., 0], -1)
        members.append(found.numpy())
        frames.append(frame.numpy())
    return np.concatenate(members), np.concatenate(frames)


def _distances(cameras: Cameras, views: _Views) -> Float[Tensor, "T S V P"]:
    """Median distance of the joints of each body (of two detections) to each detection, over that one's size."""
    _, count, people = views.index.shape
    pairs = _pairs(count)
    first, second = (x.reshape(-1) for x in torch.meshgrid(torch.arange(people), torch.arange(people), indexing="ij"))
    who = torch.stack([first, second], -1)
    of_view = pairs[:, None].expand(-1, len(who), -1).reshape(-1, 2)
    of_person = who[None].expand(len(pairs), -1, -1).reshape(-1, 2)
    pixels, seen = views.points[:, of_view, of_person], views.seen[:, of_view, of_person]
    two = triangulate(cameras.index(of_view), pixels, seen.double())
    ok = two.status == int(Status.OK)
    shown, depth = project(cameras, two.points)
    both = (ok[:, :, None] & (depth > 0))[:, :, :, None] & views.seen[:, None]
    apart = torch.linalg.vector_norm(shown[:, :, :, None] - views.points[:, None], dim=-1)
    return _median(apart, both) / views.size[:, None]


def _median(values: Float[Tensor, "*B J"], there: Bool[Tensor, "*B J"]) -> Float[Tensor, "*B"]:
    """The lower median of what is there; inf where that is too little."""
    count = there.sum(-1)
    ordered = torch.where(there, values, torch.inf).sort(dim=-1).values
    middle = ordered.gather(-1, (count - 1).clamp(min=0)[..., None] // 2)[..., 0]
    return torch.where(count >= _LEAST_JOINTS, middle, torch.inf)


def _bodies(
    cameras: Cameras, members: Int[np.ndarray, "G V"], key_points: np.ndarray, seen: np.ndarray
) -> tuple[Float[np.ndarray, "G J 3"], Bool[np.ndarray, "G J"]]:
    used = seen[members] & (members >= 0)[..., None]
    found = triangulate(
        cameras, torch.from_numpy(key_points[members].astype(np.float64)), torch.from_numpy(used).double()
    )
    return found.points.numpy(), found.ok.numpy()


def _tracks(
    frame: Int[np.ndarray, " G"], bodies: Float[np.ndarray, "G J 3"], known: Bool[np.ndarray, "G J"]
) -> Int[np.ndarray, " G"]:
    """The number of each body's track: in each frame bodies go to the tracks whose last body is nearest."""
    track = np.full(len(frame), -1)
    order = np.argsort(frame, kind="stable")
    last, count = np.zeros(0, np.int64), 0
    for now in np.split(order, np.flatnonzero(np.diff(frame[order])) + 1) if len(order) else ():
        cost = _apart(bodies, known, last, now)
        rows, columns = linear_sum_assignment(np.minimum(cost, 10 * _NEAR))
        near = cost[rows, columns] < _NEAR
        track[now[columns[near]]] = track[last[rows[near]]]
        new = now[track[now] < 0]
        track[new] = count + np.arange(len(new))
        count += len(new)
        last = np.concatenate([now, np.delete(last, rows[near])])[:_MOST_TRACKS]
    return track


def _apart(
    bodies: np.ndarray, known: np.ndarray, last: Int[np.ndarray, " A"], now: Int[np.ndarray, " B"]
) -> Float[np.ndarray, "A B"]:
    both = torch.from_numpy(known[last][:, None] & known[now])
    distance = torch.from_numpy(np.linalg.norm(bodies[last][:, None] - bodies[now], axis=-1))
    height = _size(bodies[now], known[now])
    return _median(distance, both).numpy() / np.maximum(height, 1e-9)


def _people(
    frames: int,
    frame: Int[np.ndarray, " G"],
    track: Int[np.ndarray, " G"],
    worth: Float[np.ndarray, " G"],
    members: Int[np.ndarray, "G V"],
) -> list[Int[np.ndarray, "T V"]]:
    """Tracks that are never there at once, joined; by what they are worth together."""
    total = np.bincount(track, worth) if len(track) else np.zeros(0)
    order = np.argsort(track, kind="stable")
    bodies = np.split(order, np.flatnonzero(np.diff(track[order])) + 1) if len(order) else []
    people: list[tuple[float, np.ndarray]] = []
    for number in np.argsort(-total, kind="stable"):
        of = bodies[number]
        alone = (i for i, (_, chosen) in enumerate(people) if not (chosen[frame[of]] >= 0).any())
        if (place := next(alone, None)) is None:
            place = len(people)
            people.append((0.0, np.full((frames, members.shape[1]), -1)))
        people[place][1][frame[of]] = members[of]
        people[place] = (people[place][0] + float(total[number]), people[place][1])
    return [chosen for _, chosen in sorted(people, key=lambda person: -person[0])]
