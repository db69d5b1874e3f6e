"""One person followed through the frames of a view, without regard to the other views."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Int

from ghpt.data.people.detections import Detections

_JUMP = 2.0
"""How much of a person's prominence (at most 1) a jump by their own size costs."""

People = Float[np.ndarray, "_ K 3"]
"""The people of a frame: x, y, confidence of their joints; pixels."""


def follow_views(people: Detections) -> Int[np.ndarray, "T V"]:
    """Return the index of the person who is followed through each view by itself (`follow`).

    The index is -1 where there is nobody.
    """
    chosen = people.first()
    points = people.points
    confidence = np.where(points.valid, points.confidence, 0)
    several = people.counts() > 1
    for view in np.flatnonzero(several.any(0)):
        indices = np.flatnonzero(people.view == view)
        rows, starts = np.unique(people.row[indices], return_index=True)
        values = np.concatenate([points.pixels[indices], confidence[indices, :, None]], -1)
        frames = np.split(values, starts[1:])
        chosen[rows, view] = indices[starts + follow(frames)]
    return chosen


def follow(people: Sequence[People]) -> Int[np.ndarray, " T"]:
    """Return for each frame the index of the one person that is followed, -1 where nobody is.

    Of all ways to choose one person in each frame, it is the one with the greatest sum of
    prominences less jumps (Viterbi). The prominence of a person is their size times their mean
    confidence over that of the best in this view; a jump is the median distance of their joints to
    those in the frame before, over their size, at most 1, and costs ``_JUMP`` times as much. So
    whoever is large and sure most of the time is kept through frames where another is larger for a
    while.
    """
    chosen = np.full(len(people), -1)
    there = [t for t, found in enumerate(people) if len(found)]
    if not there:
        return chosen
    prominences = [_prominence(people[t]) for t in there]
    best = max(float(values.max()) for values in prominences) or 1.0
    score = prominences[0] / best
    came_from: list[np.ndarray | None] = []
    for step, (before, now) in enumerate(pairwise(there), start=1):
        cost = _JUMP * _jump(people[before], people[now])
        gain = score[:, None] - cost
        came_from.append(gain.argmax(0))
        score = gain.max(0) + prominences[step] / best
    person = int(score.argmax())
    for t, back in zip(reversed(there), [*reversed(came_from), None], strict=True):
        chosen[t] = person
        person = -1 if back is None else int(back[person])
    return chosen


def valid_joints(people: Float[np.ndarray, "*B K 3"]) -> Bool[np.ndarray, "*B K"]:
    """Return which joints were found: those whose confidence is above 0."""
    return people[..., 2] > 0


def _size(people: People) -> Float[np.ndarray, " P"]:
    valid = valid_joints(people)[..., None]
    pixels = people[..., :2]
    low = np.where(valid, pixels, np.inf).min(1, initial=np.inf)
    high = np.where(valid, pixels, -np.inf).max(1, initial=-np.inf)
    known = np.isfinite(low)
    low = np.where(known, low, 0)
    extent = np.where(known, high - low, 0)
    return np.linalg.norm(extent, axis=-1)


def _prominence(people: People) -> Float[np.ndarray, " P"]:
    confidence = np.where(valid_joints(people), people[..., 2], 0)
    return _size(people) * confidence.mean(-1)


def _jump(
    before: Float[np.ndarray, "P K 3"], now: Float[np.ndarray, "Q K 3"]
) -> Float[np.ndarray, "P Q"]:
    """Return the median distance of the joints that both have, in sizes of the person, at most 1.

    It is 1 where they share no joint.
    """
    both = valid_joints(before)[:, None] & valid_joints(now)[None]
    offset = before[:, None, :, :2] - now[None, :, :, :2]
    distance = np.linalg.norm(offset, axis=-1)
    distance = np.where(both, distance, np.inf)
    middle = np.maximum(both.sum(-1) - 1, 0) // 2
    ordered = np.sort(distance, axis=-1)
    median = np.take_along_axis(ordered, middle[..., None], -1)[..., 0]
    size = np.maximum(_size(before)[:, None], _size(now)[None])
    return np.minimum(median / size.clip(1e-9), 1.0)
