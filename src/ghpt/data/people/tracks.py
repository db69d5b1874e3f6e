"""The bodies of successive frames as people: tracks of what stays near, joined where they can be
one.
"""

from __future__ import annotations

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


def extent(
    points: Float[np.ndarray, "N J D"], valid: Bool[np.ndarray, "N J"]
) -> Float[np.ndarray, " N"]:
    """Diagonal of the box around what is seen; 0 for nothing."""
    low = np.where(valid[..., None], points, np.inf).min(1)
    high = np.where(valid[..., None], points, -np.inf).max(1)
    return np.linalg.norm(
        np.where(np.isfinite(low), high - np.where(np.isfinite(low), low, 0), 0), axis=-1
    )


def tracks(
    frame: Int[np.ndarray, " G"], bodies: Float[np.ndarray, "G J 3"], known: Bool[np.ndarray, "G J"]
) -> Int[np.ndarray, " G"]:
    """The number of each body's track: in each frame bodies go to the tracks whose last body is
    nearest.
    """
    track = np.full(len(frame), -1)
    order = np.argsort(frame, kind="stable")
    last = np.zeros(0, np.int64)
    count = 0
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
    both = known[last][:, None] & known[now]
    distance = np.linalg.norm(bodies[last][:, None] - bodies[now], axis=-1)
    count = both.sum(-1)
    ordered = np.sort(np.where(both, distance, np.inf), axis=-1)
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[..., None] // 2, -1)[..., 0]
    return np.where(count >= _LEAST_JOINTS, middle, np.inf) / np.maximum(
        extent(bodies[now], known[now]), 1e-9
    )


def joined(
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
