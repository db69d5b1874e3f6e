"""The bodies of successive frames as people.

What stays near is a track; tracks that can be one person's are joined.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

_NEAR = 0.35
"""A body is another frame's if the median distance of their joints is below this part of its
height.
"""
_MOST_TRACKS = 64
"""That are followed at once: those seen last."""
_LEAST_JOINTS = 4
"""Joints that two bodies must share to be compared."""


@dataclass(frozen=True)
class Bodies:
    """G bodies of some frames, in any order."""

    frame: Int[np.ndarray, " G"]
    points: Float[np.ndarray, "G J 3"]
    valid: Bool[np.ndarray, "G J"]

    def __len__(self) -> int:
        return len(self.frame)


def box_diagonal(
    points: Float[np.ndarray, "N J D"], valid: Bool[np.ndarray, "N J"]
) -> Float[np.ndarray, " N"]:
    """Return the diagonal of the box around the valid points; 0 where there is none."""
    mask = valid[..., None]
    low = np.where(mask, points, np.inf).min(1)
    high = np.where(mask, points, -np.inf).max(1)
    known = np.isfinite(low)
    low = np.where(known, low, 0)
    extent = np.where(known, high - low, 0)
    return np.linalg.norm(extent, axis=-1)


def track_bodies(bodies: Bodies) -> Int[np.ndarray, " G"]:
    """Return the number of each body's track.

    In each frame bodies go to the tracks whose last body is nearest.
    """
    track = np.full(len(bodies), -1)
    last = np.zeros(0, np.int64)
    count = 0
    for now in _split_by(bodies.frame):
        cost = _distances(bodies, last, now)
        rows, columns = linear_sum_assignment(np.minimum(cost, 10 * _NEAR))
        near = cost[rows, columns] < _NEAR
        track[now[columns[near]]] = track[last[rows[near]]]
        new = now[track[now] < 0]
        track[new] = count + np.arange(len(new))
        count += len(new)
        others = np.delete(last, rows[near])
        last = np.concatenate([now, others])[:_MOST_TRACKS]
    return track


def join_tracks(
    frames: int,
    bodies: Bodies,
    track: Int[np.ndarray, " G"],
    worth: Float[np.ndarray, " G"],
    members: Int[np.ndarray, "G V"],
) -> list[Int[np.ndarray, "T V"]]:
    """Return the members [T V] of each person, the best first; -1 where there is none.

    A person's tracks are never there at once. Persons are ordered by what their bodies are worth
    together.
    """
    total = np.bincount(track, worth) if len(track) else np.zeros(0)
    of_track = _split_by(track)
    persons: list[np.ndarray] = []
    worths: list[float] = []
    for number in np.argsort(-total, kind="stable"):
        own = of_track[number]
        rows = bodies.frame[own]
        free = (i for i, person in enumerate(persons) if not (person[rows] >= 0).any())
        place = next(free, None)
        if place is None:
            place = len(persons)
            persons.append(np.full((frames, members.shape[1]), -1))
            worths.append(0.0)
        persons[place][rows] = members[own]
        worths[place] += float(total[number])
    order = sorted(range(len(persons)), key=lambda place: -worths[place])
    return [persons[place] for place in order]


def _split_by(number: Int[np.ndarray, " G"]) -> list[Int[np.ndarray, " N"]]:
    """Return the positions of each number, in the order of the numbers."""
    if not len(number):
        return []
    order = np.argsort(number, kind="stable")
    starts = np.flatnonzero(np.diff(number[order])) + 1
    return np.split(order, starts)


def _distances(
    bodies: Bodies, last: Int[np.ndarray, " A"], now: Int[np.ndarray, " B"]
) -> Float[np.ndarray, "A B"]:
    """Return the median distance of the joints that two bodies share, in heights of the second.

    It is inf where they share too few.
    """
    before = bodies.points[last]
    after = bodies.points[now]
    both = bodies.valid[last][:, None] & bodies.valid[now]
    distance = np.linalg.norm(before[:, None] - after, axis=-1)
    distance = np.where(both, distance, np.inf)
    count = both.sum(-1)
    middle = np.maximum(count - 1, 0) // 2
    ordered = np.sort(distance, axis=-1)
    median = np.take_along_axis(ordered, middle[..., None], -1)[..., 0]
    median = np.where(count >= _LEAST_JOINTS, median, np.inf)
    height = box_diagonal(after, bodies.valid[now])
    return median / np.maximum(height, 1e-9)
